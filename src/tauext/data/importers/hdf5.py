"""HDF5 and MATLAB files: named arrays to signals, a group of arrays for each run."""

from __future__ import annotations

import math
import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.cells import USUAL_CLOCK, paired_stamps, stated_hz
from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, short_list, whole
from tauext.errors import RecordingError
from tauext.files.preflight import in_words
from tauext.files.unpacking import Unpacked, most_unpacked

# --- Named arrays of a file: which are signals, and which of their axes counts samples.


MOST_WIDE = 64
"""Largest number of elements of a signal a sample."""
MOST_DEEP = 32
"""Groups in groups; recorders nest four."""


@dataclass(frozen=True)
class Array:
    """An array of numbers in a file."""

    path: tuple[str, ...]
    """Groups or structs, and the array's name."""
    shape: tuple[int, ...]
    """Without axes of one element."""
    held: Any
    """The array itself, or what the reader finds it by."""
    labels: tuple[str, ...] = ()
    """Names of its elements, where the file has them."""
    named: bool = False
    """Whether the labels are names of columns, not of elements."""

    def columns(self, name: str, samples: int) -> tuple[str, ...]:
        """Names of its columns: `name`, or `name[0]`, `name[1]`... ; empty if no single axis counts the samples."""
        if sample_axis(self.shape, samples) is None:
            return ()
        count = int(np.prod(self.shape)) // samples
        if self.named and len(self.labels) == count:
            return tuple(f"{name.removesuffix(self.path[-1])}{label}" for label in self.labels)
        if count == 1:
            return (name,)
        labels = self.labels if len(self.labels) == count else map(str, range(count))
        return tuple(f"{name}[{label}]" for label in labels) if count <= MOST_WIDE else ()


@dataclass
class Content:
    """What a file holds."""

    arrays: list[Array] = field(default_factory=list)
    scalars: dict[tuple[str, ...], float] = field(default_factory=dict)
    words: dict[tuple[str, ...], tuple[str, ...]] = field(default_factory=dict)
    """Lists of texts."""
    objects: list[str] = field(default_factory=list)
    """MATLAB objects with their class."""
    units: dict[tuple[str, ...], str] = field(default_factory=dict)
    """Units that attributes of arrays state."""

    def add(self, path: tuple[str, ...], shape: Sequence[int], held: Any) -> None:
        """Add an array; one of a single number is a scalar."""
        self.arrays.append(Array(path, tuple(int(n) for n in shape if n != 1), held))

    def label(self) -> None:
        """Name the elements of arrays by names that the array has, or its group, or one above."""
        names = {path[:-1]: words for path, words in self.words.items() if JOINT_NAMES.fullmatch(path[-1])}
        for k, array in enumerate(self.arrays):
            for depth in range(len(array.path), -1, -1):
                words = names.get(array.path[:depth], ())
                if not array.labels and len(words) > 1 and len(words) in array.shape and len(set(words)) == len(words):
                    self.arrays[k] = array = replace(array, labels=words)


JOINT_NAMES = re.compile(
    r"((joint|motor|axis|dof|column|field|channel|signal)s?_?)?names?|joints|columns|channels|labels", re.IGNORECASE
)


def sample_axis(shape: tuple[int, ...], samples: int) -> int | None:
    """The one axis that counts samples; None if there is none or several."""
    return shape.index(samples) if shape.count(samples) == 1 else None


def sample_count(path: Path, arrays: Sequence[Array]) -> int:
    """Number of samples: the length of a clock, else the most common length, weighted by the count of numbers."""
    signals = [one for one in arrays if _is_signal(one.shape)]
    is_clock = re.compile(rf"t|tout|{USUAL_CLOCK.pattern}", re.IGNORECASE)
    clocks = {one.shape[0] for one in signals if len(one.shape) == 1 and is_clock.fullmatch(one.path[-1])}
    votes: Counter[int] = Counter()
    for one in signals:
        votes[max(one.shape)] += int(np.prod(one.shape)) // max(one.shape)
    fitting = [n for n in clocks if any(n in one.shape and len(one.shape) > 1 for one in signals)]
    if not votes:
        raise RecordingError(f"{path}: {_no_signals(arrays)}")
    samples = fitting[0] if len(fitting) == 1 else max(votes, key=lambda length: (votes[length], length))
    wide = [one for one in signals if len(one.shape) > 1 and samples in one.shape]
    square = [one for one in wide if sample_axis(one.shape, samples) is None]
    unclear = square if len(square) == len(wide) else []
    if not fitting and not any(one.shape == (samples,) for one in signals):
        unclear = unclear or [one for one in wide if max(one.shape) <= MOST_WIDE]
    if unclear:
        one = unclear[0]
        raise RecordingError(
            f"{path}: which axis of '{one.path[-1]}' {_by(one.shape)} counts samples is not clear; add an array "
            f"`time` (samples,), and record more samples than {max(one.shape)}"
        )
    return samples


def _is_signal(shape: tuple[int, ...]) -> bool:
    return bool(shape) and 0 not in shape and int(np.prod(shape)) // max(shape) <= MOST_WIDE


def _by(shape: Sequence[int]) -> str:
    return f"({' x '.join(map(str, shape))})"


def _no_signals(arrays: Sequence[Array]) -> str:
    listed = short_list([f"{one.path[-1]} {_by(one.shape)}" for one in arrays], 12) or "none"
    return (
        "no array of numbers in it looks like a signal, (samples,) or (samples, joints) of at most "
        f"{MOST_WIDE} joints; its arrays: {listed}"
    )


# --- Runs: groups with the same arrays, each of its own length.


def runs_of(path: Path, arrays: Sequence[Array]) -> list[tuple[tuple[str, ...], list[Array]]]:
    """Groups that are recordings of their own, in natural order, with their arrays; one () if the file is one.

    Groups of one parent are runs if their names are numbered words such as `demo_0`, or if they have the same arrays
    with other lengths.
    """
    children: dict[tuple[str, ...], dict[str, list[Array]]] = {}
    for one in arrays:
        for depth in range(len(one.path) - 1):
            children.setdefault(one.path[:depth], {}).setdefault(one.path[depth], []).append(one)
    for parent in sorted(children, key=len):
        by_stem: dict[str, list[str]] = {}
        for name in children[parent]:
            match = re.fullmatch(r"(.*?)[\W_]*\d+", name)
            by_stem.setdefault(match[1] if match else "\0", []).append(name)
        for stem, names in by_stem.items():
            groups = {name: children[parent][name] for name in sorted(names, key=_natural)}
            if _are_runs(path, stem or (parent[-1] if parent else ""), len(parent) + 1, groups):
                return [((*parent, name), held) for name, held in groups.items()]
    return [((), list(arrays))]


def _are_runs(path: Path, stem: str, depth: int, groups: Mapping[str, Sequence[Array]]) -> bool:
    runs = "demo|run|episode|ep|traj(ectory)?|trial|test|rec(ording)?|session|exp(eriment)?|rollout|seq(uence)?|motion"
    parts = "joint|j|axis|a|motor|actuator|servo|link|arm|robot|sensor|signals?"
    if re.fullmatch(runs, stem.lower()) and any(_is_signal(one.shape) for held in groups.values() for one in held):
        return True
    if len(groups) < 2 or re.fullmatch(parts, stem.lower()):
        return False
    names = [{one.path[depth:] for one in held} for held in groups.values()]
    try:
        lengths = {sample_count(path, held) for held in groups.values()}
    except RecordingError:
        return False
    return all(one == names[0] for one in names) and len(lengths) > 1


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


# --- From the content of a file to raw recordings.


Opened = Callable[[], AbstractContextManager[Callable[[Any], Any]]]
"""Opens the file; gives a function that returns the array, or a dataset, that `held` stands for."""


def recordings(path: Path, kind: str, separator: str, content: Content, opened: Opened) -> list[RawRecording]:
    """A raw recording for each run in the content of a file.

    Raises:
        RecordingError: there is no signal in any.
    """
    content.label()
    found: list[RawRecording] = []
    refused: list[str] = []
    runs = runs_of(path, content.arrays)
    for group, arrays in runs:
        where = path if not group else f"{path}: {separator.join(group)}"
        try:
            samples = sample_count(Path(where), arrays)
        except RecordingError as error:
            if len(runs) == 1:
                remedy = (
                    f". MATLAB objects cannot be read: {short_list(content.objects)}; save their numbers as plain "
                    "arrays (t = x.Time; q = x.Data; or table2struct(x, 'ToScalar', true))"
                )
                raise RecordingError(f"{error}{remedy if content.objects else ''}") from None
            refused.append(str(error).removeprefix(f"{path}: "))
            continue
        names = {one.path: separator.join(one.path[len(group) :]) for one in arrays}
        columns = {one.path: one.columns(names[one.path], samples) for one in arrays}
        others = {names[one.path]: one.shape for one in arrays if not columns[one.path] and one.shape}
        notes = _left_out(others, samples, content.objects)
        stem = f"{path.stem}-{'-'.join(group[-1:])}" if group else path.stem
        used = [one for one in arrays if columns[one.path]]
        blocks = partial(_blocks, path, kind, used, [c for one in used for c in columns[one.path]], samples, opened)
        above = {one.path[:depth] for one in used for depth in range(len(one.path) + 1)}
        rates = {entry: stated_hz(entry[-1], value) for entry, value in content.scalars.items() if entry[:-1] in above}
        stated = {separator.join(entry): hz for entry, hz in rates.items() if hz}
        units = {names[one.path]: content.units[one.path] for one in used if one.path in content.units}
        found.append(RawRecording(stem, path, kind, blocks, notes, stated_hz=stated, units=units))
    if not found:
        raise RecordingError(f"{path}: {refused[0] if refused else _no_signals(content.arrays)}")
    if refused:
        found[0].notes.append(f"{len(refused)} of {len(runs)} runs left out; the first: {refused[0]}")
    inside = {one.path for _, arrays in runs for one in arrays}
    if outside := [separator.join(one.path) for one in content.arrays if one.path not in inside and one.shape]:
        found[0].notes.append(f"arrays outside of the runs left out: {short_list(outside)}")
    return found


def _left_out(others: Mapping[str, tuple[int, ...]], samples: int, objects: Sequence[str]) -> list[str]:
    """Notes on the arrays that are no signals, of which `others` has the shapes."""
    reasons = {
        f"arrays of another length than {samples} left out": [
            f"{name} ({max(shape)})" for name, shape in others.items() if samples not in shape
        ],
        "square arrays left out, since the axis of samples is not clear": [
            f"{name} {_by(shape)}" for name, shape in others.items() if shape.count(samples) > 1
        ],
        f"arrays of more than {MOST_WIDE} numbers a sample left out": [
            f"{name} {_by(shape)}" for name, shape in others.items() if shape.count(samples) == 1
        ],
        "MATLAB objects left out": objects,
    }
    return [f"{reason}: {short_list(listed)}" for reason, listed in reasons.items() if listed]


def _blocks(
    path: Path, kind: str, used: Sequence[Array], names: Sequence[str], samples: int, opened: Opened
) -> Iterator[RawSignals]:
    with whole(path, kind, BROKEN), opened() as array_of:
        for first in range(0, samples, BLOCK_ROWS):
            rows = slice(first, min(first + BLOCK_ROWS, samples))
            parts = [_rows(array_of(one.held), rows, samples) for one in used]
            numbers = np.column_stack(parts).astype(np.float64, copy=False)
            yield RawSignals("", tuple(names), paired_stamps(names, numbers), numbers)


def _rows(array: Any, rows: slice, samples: int) -> np.ndarray:
    """Rows of an array of any orientation, (rows, elements)."""
    axis = array.shape.index(samples)
    part = array[tuple(rows if k == axis else slice(None) for k in range(len(array.shape)))]
    return np.moveaxis(part, axis, 0).reshape(rows.stop - rows.start, -1)


# --- HDF5 files, and MATLAB files of version 7.3, which are HDF5 inside.


BROKEN = (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError)
"""Exceptions of h5py on damaged files."""
MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_CHUNK = 1 << 27
"""Largest chunk of a dataset, [bytes]: the library unpacks all of it for a few rows."""
MOST_WORDS = 1 << 20
"""Largest list of names or of cells, [bytes]."""


def open_hdf5(path: Path, separator: str = "/", kind: str = "HDF5") -> list[RawRecording]:
    """Read datasets (samples,), (samples, joints) or (joints, samples), with groups in their names.

    Axes of one element do not count. Fields of compound datasets are `name.field`. Groups with the same datasets and
    lengths of their own, such as `demo_0`, are recordings of their own. Elements have the names of a list
    `joint_names` beside them. Datasets of other lengths are left out and listed in the notes; scalars and attributes
    such as `rate_hz` are stated rates.
    """

    @contextmanager
    def opened() -> Iterator[Callable[[Any], Any]]:
        with _open(path) as file:
            yield partial(_dataset, file)

    with whole(path, kind, BROKEN), _open(path) as file:
        content = _Walk(file, kind != "HDF5").content
        for one in content.arrays:
            _expect_readable(path, file[one.held[0]])
    return recordings(path, kind, separator, content, opened)


def _open(path: Path) -> Any:
    """The file, also while another program writes it, where that allows readers."""
    import h5py

    try:
        return h5py.File(path, rdcc_nbytes=MOST_CHUNK)
    except OSError as error:
        if "already open" not in str(error):
            raise
    try:
        return h5py.File(path, swmr=True, rdcc_nbytes=MOST_CHUNK)
    except OSError as error:
        raise RecordingError(
            f"{path}: the program that writes it has not closed it; close it there, and copy it again"
        ) from error


@dataclass(frozen=True)
class _Field:
    """A field of a compound dataset, as an array."""

    dataset: Any
    name: str

    @property
    def shape(self) -> tuple[int, ...]:
        return (*self.dataset.shape, *self.dataset.dtype[self.name].shape)

    def __getitem__(self, at: tuple[slice, ...]) -> np.ndarray:
        return np.asarray(self.dataset[at[: self.dataset.ndim]][self.name])


@dataclass(frozen=True)
class _Stack:
    """Vectors of one length as an array (samples, vectors)."""

    parts: tuple[Any, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.parts[0].size, len(self.parts))

    def __getitem__(self, at: tuple[slice, ...]) -> np.ndarray:
        return np.column_stack([np.ravel(part[()])[at[0]] for part in self.parts])


def _dataset(file: Any, held: tuple[str, ...]) -> Any:
    """The dataset, a field of it, or several vectors."""
    name, *others = held
    if others and others[0].startswith("."):
        return _Field(file[name], others[0][1:])
    return _Stack(tuple(file[one] for one in held)) if others else file[name]


def _expect_readable(path: Path, dataset: Any) -> None:
    """Raise RecordingError where rows are stated but not in the file, or cannot be unpacked a few at a time."""
    import h5py

    stored, plist = dataset.id.get_storage_size(), dataset.id.get_create_plist()
    if dataset.size and not stored:
        raise RecordingError(
            f"{path}: '{dataset.name}' states {dataset.shape[0]:,} rows, and none was written; record the file again"
        )
    if dataset.chunks and (size := math.prod(dataset.chunks) * dataset.dtype.itemsize) > MOST_CHUNK:
        raise RecordingError(
            f"{path}: '{dataset.name}' is stored in chunks of {in_words(size)}, and {in_words(MOST_CHUNK)} are the "
            "most; write it with smaller chunks, of some thousand rows"
        )
    if dataset.nbytes > most_unpacked(max(path.stat().st_size, stored)):
        raise RecordingError(
            f"{path}: '{dataset.name}' states {in_words(dataset.nbytes)}, and {in_words(stored)} are stored; no "
            "recording is packed like that"
        )
    for k in range(plist.get_nfilters()):
        number, *_, name = plist.get_filter(k)
        if not h5py.h5z.filter_avail(number):
            label = name.decode(errors="replace") or str(number)
            raise RecordingError(
                f"{path}: '{dataset.name}' is compressed by the filter '{label}', which is not available here; write "
                "the file with gzip, or without compression"
            )


def _expect_inside(dataset: Any) -> None:
    """Raise RecordingError where a dataset is stored in other files: a log must not read any file of the computer."""
    others = [str(one[0]) for one in dataset.external or ()]
    if dataset.is_virtual:
        others += [source.file_name for source in dataset.virtual_sources() if source.file_name != "."]
    if others:
        raise RecordingError(
            f"{dataset.file.filename}: '{dataset.name}' is stored in other files ({short_list(map(repr, others), 3)}), "
            "which are not read; write the numbers into this file, for example with h5repack"
        )


class _Walk:
    """Collects the content of a file, one item after the other."""

    def __init__(self, file: Any, matlab: bool) -> None:
        self.file, self.matlab = file, matlab
        self.content, self.frames = Content(), set[str]()
        if not matlab:
            self.attributes((), file)
        file.visititems(self.visit)

    def number(self, path: tuple[str, ...], value: Any) -> None:
        if isinstance(value, int | float | np.number) or (isinstance(value, np.ndarray) and value.size == 1):
            with suppress(TypeError, ValueError):  # a text
                self.content.scalars[path] = float(np.ravel(value)[0])

    def attributes(self, path: tuple[str, ...], item: Any) -> None:
        for name in item.attrs:
            value = item.attrs.get(name)
            self.number((*path, str(name)), value)
            if re.fullmatch(r"units?", str(name), re.IGNORECASE) and np.ndim(value) == 0:
                self.content.units[path] = _word(value)
            if JOINT_NAMES.fullmatch(str(name)) and np.ndim(value) == 1:
                self.content.words[(*path, str(name))] = tuple(map(_word, value))

    def visit(self, name: str, item: Any) -> None:
        import h5py

        path = tuple(name.split("/"))
        if len(path) > MOST_DEEP:
            raise RecordingError(f"{self.file.filename}: groups lie more than {MOST_DEEP} deep in each other")
        if name.startswith("#"):
            return  # internal data of MATLAB objects
        if not self.matlab:
            self.attributes(path, item)
        if isinstance(item, h5py.Dataset):
            self.dataset(path, item)
        elif not self.matlab and _word(item.attrs.get("pandas_type", "")) == "frame":
            self.frame(path, item)

    def frame(self, path: tuple[str, ...], group: Any) -> None:
        """A pandas table: blocks of columns of one type, and the index."""
        import h5py

        for name in group:
            if isinstance(group.get(name, getlink=True), h5py.HardLink) and isinstance(group[name], h5py.Dataset):
                _expect_inside(group[name])
            else:
                continue
            if match := re.fullmatch(r"block(\d+)_values", name):
                items = group[f"block{match[1]}_items"]
                words = tuple(_word(one) for one in items[()]) if items.nbytes <= MOST_WORDS else ()
                self.content.add((*path, name), group[name].shape, (group[name].name,))
                self.content.arrays[-1] = replace(self.content.arrays[-1], labels=words, named=True)
        if "axis1" in group and group["axis1"].dtype.kind in "iuf":
            self.content.add((*path, "index"), group["axis1"].shape, (group["axis1"].name,))
        self.frames.add(group.name)

    def dataset(self, path: tuple[str, ...], item: Any) -> None:
        import h5py

        _expect_inside(item)
        kind = _word(item.attrs.get("MATLAB_class", ""))
        if item.parent.name in self.frames or item.shape is None or item.attrs.get("MATLAB_empty", 0):
            return
        if "MATLAB_object_decode" in item.attrs and kind not in ("logical", "char", "cell", "struct", ""):
            self.content.objects.append(f"{'.'.join(path)} ({kind})")
        elif h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            if item.nbytes <= MOST_WORDS:
                self.references(path, item, kind == "cell")
        elif item.dtype.names:
            for name in item.dtype.names:
                sub, field_path = item.dtype[name], (*path[:-1], f"{path[-1]}.{name}")
                if sub.base.kind in "fiub":
                    self.content.add(field_path, (*item.shape, *sub.shape), (item.name, f".{name}"))
        elif item.dtype.kind in "fiub" and kind != "char":
            if item.size == 1:
                self.number(path, item[()])
            self.content.add(path, item.shape, (item.name,))
        elif item.dtype.kind in "SO" and item.ndim == 1 and JOINT_NAMES.fullmatch(path[-1]):
            if item.size <= MOST_WIDE and item.nbytes <= MOST_WORDS:
                self.content.words[path] = tuple(_word(one) for one in item[()])

    def references(self, path: tuple[str, ...], item: Any, cell: bool) -> None:
        """Cells, and the fields of arrays of structs."""
        import h5py

        targets = [self.file[one] for one in np.ravel(item[()]) if one]
        for target in targets:
            if isinstance(target, h5py.Dataset):
                _expect_inside(target)
        if cell and all(_word(t.attrs.get("MATLAB_class", "")) == "char" for t in targets):
            self.content.words[path] = tuple("".join(map(chr, np.ravel(t[()]).tolist())) for t in targets)
            return
        vectors = [t for t in targets if isinstance(t, h5py.Dataset) and t.dtype.kind in "fiub" and t.size > 1]
        one_length = len({t.size for t in vectors}) == 1 and all(t.size == max(t.shape) for t in vectors)
        if cell and one_length and len(vectors) == len(targets) > 1:
            self.content.add(path, (vectors[0].size, len(vectors)), tuple(t.name for t in vectors))
            return
        for k, target in enumerate(targets):
            at = (*path, str(k + 1))
            if isinstance(target, h5py.Group):
                for name, child in target.items():
                    if isinstance(child, h5py.Dataset):
                        self.dataset((*at, name), child)
            else:
                # runs in parallel cells, or in an array of structs
                self.dataset((str(k + 1), *path) if cell else (*path[:-1], str(k + 1), path[-1]), target)


def _word(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


# --- MATLAB files: version 5 to 7 by SciPy, version 7.3 as HDF5.


MATLAB_COMPRESSED = 15
"""Type of a compressed element."""
MATLAB_MAGICS = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")


def open_matlab(path: Path) -> list[RawRecording]:
    """Read the arrays of a MATLAB file, in structs or not; a field's name is `struct.field`.

    Arrays of structs and cells whose elements have lengths of their own are recordings of their own. For all else see
    open_hdf5().
    """
    with path.open("rb") as file:
        if file.read(len(MATLAB_MAGICS[1])) == MATLAB_MAGICS[1]:
            return open_hdf5(path, ".", "MATLAB 7.3")
    from scipy.io import loadmat

    # SciPy raises many types on damaged files.
    with whole(path, "a MATLAB file", (Exception,)), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _expect_unpacked(path)
        loaded = loadmat(path, struct_as_record=False, squeeze_me=True)
        content = Content()
        for name, value in loaded.items():
            if not str(name).startswith("__") or type(value).__name__ == "MatlabOpaque":
                _add_matlab(content, (str(name),), value)

    @contextmanager
    def opened() -> Iterator[Callable[[Any], Any]]:
        yield lambda held: held

    return recordings(path, "MATLAB", ".", content, opened)


def _expect_unpacked(path: Path) -> None:
    """Refuse a MATLAB file that unpacks to far more than its size, before SciPy unpacks it."""
    unpacked = Unpacked(path)
    if path.stat().st_size * 1032 <= unpacked.most:  # DEFLATE packs no better
        return
    with path.open("rb") as file:
        order = "<" if file.read(128)[126:128] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, left = struct.unpack(f"{order}II", tag)
            end = file.tell() + left
            if kind == MATLAB_COMPRESSED:
                stream = zlib.decompressobj()
                while left > 0 and (packed := file.read(min(left, 1 << 16))):
                    left -= len(packed)
                    while packed and not stream.eof:
                        unpacked.add(len(stream.decompress(packed, 1 << 20)))
                        packed = stream.unconsumed_tail
            file.seek(end)


def _add_matlab(content: Content, path: tuple[str, ...], value: Any) -> None:
    kind = type(value).__name__
    if kind in ("MatlabOpaque", "MatlabObject"):
        content.objects.append(_opaque(path, value))
    elif hasattr(value, "_fieldnames"):
        for name in value._fieldnames:
            _add_matlab(content, (*path, name), getattr(value, name))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        content.add(path, value.shape, np.squeeze(value))
    elif isinstance(value, int | float | np.number):
        content.scalars[path] = float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "OU":
        _add_cells(content, path, np.ravel(value))


def _add_cells(content: Content, path: tuple[str, ...], cells: np.ndarray) -> None:
    """Elements of a cell or of an array of structs."""
    if all(isinstance(one, str) for one in cells):
        content.words[path] = tuple(map(str, cells))
        return
    vectors = [one for one in cells if isinstance(one, np.ndarray) and one.dtype.kind in "fiub" and one.ndim == 1]
    if len(vectors) == len(cells) > 1 and len({len(one) for one in vectors}) == 1:
        content.add(path, (len(vectors[0]), len(vectors)), np.column_stack(vectors))
        return
    for k, one in enumerate(cells):
        _add_matlab(content, (*path, str(k + 1)) if hasattr(one, "_fieldnames") else (str(k + 1), *path), one)


def _opaque(path: tuple[str, ...], value: Any) -> str:
    """Name and class of a MATLAB object."""
    try:
        one = np.ravel(value)[0]
        name, kind = (_word(one[key]) for key in ("s0", "s2"))
    except (IndexError, KeyError, TypeError, ValueError):
        name, kind = path[-1], str(getattr(value, "classname", "object"))
    return f"{name} ({kind})"
