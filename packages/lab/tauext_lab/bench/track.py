"""A track: a folder that states where recordings come from, what their contacts are, and what is training and test."""

from __future__ import annotations

import gzip
import hashlib
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from tauext.config import Seconds, Settings
from tauext.data.dataset import Dataset, Split, load_dataset
from tauext.data.importing import import_dataset
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import Text, read_table
from tauext.progress import SILENT, Reporter
from tauext_lab.evaluate.config import EventsConfig

TRACKS = Path(__file__).with_name("tracks")
"""The tracks that the package has; each may be named instead of its folder."""


@dataclass(frozen=True)
class SourceFile(Settings):
    """A file of others, which the track does not contain."""

    name: Text
    """Its name for the import."""
    sha256: Text
    """Of the content; in a folder it may lie gzipped, as NAME.gz."""
    licence: Text
    repository: str = ""
    """Git repository that holds it; empty: the track's."""
    commit: str = ""
    path: str = ""
    """In the repository; empty: it is not there in this form, and must be in the folder of --data."""


@dataclass(frozen=True)
class Simulated(Settings):
    """A track that is made from its seed: the paper's rig with friction of a family."""

    friction: Literal["lugre", "maxwell-slip", "belt"]
    """lugre is the rig's own, the family of recipe prior."""
    seed: int = 0
    minutes: float = 15.0
    """Of free motion in all, of which 15 % are test."""
    test_hours: float = 1.0
    """Further free motion to test on."""
    collision_recordings: int = 6
    """Of 90 s with ten collisions each."""


@dataclass(frozen=True)
class Track(Settings):
    """The content of track.toml."""

    title: Text
    evidence: Text
    """Evidence class, see docs/results/index.md."""
    labels: Text
    """The rule by which contacts were labelled."""
    truth: bool = False
    """Whether the recordings' tau_ext is the true external torque, and no other estimate."""
    timed: bool = True
    """Whether labels are exact enough for delays; false: read off the signals by eye."""
    repository: str = ""
    commit: str = ""
    made_by: str = ""
    """FILE.py:FUNCTION in the track's folder, called with the files by name and the folder to write a dataset to;
    empty: arm.toml describes the import."""
    leave_one_out: bool = False
    """Each recording of the training set is tested after a training on the others; there are no other sets."""
    tolerance_s: Seconds = 0.1
    """Before and after a label, an alarm belongs to it."""
    rest_s: Seconds = 0.5
    """After that, time that is neither a contact nor free."""
    accept: tuple[str, ...] = ()
    """Findings of the data check that recipes accept."""
    files: tuple[SourceFile, ...] = ()
    simulated: Simulated | None = None
    train: dict[str, object] = field(default_factory=dict)
    """Settings of recipes, as in the file of `tauext train --config`."""

    @property
    def events(self) -> EventsConfig:
        return EventsConfig(tolerance_s=self.tolerance_s)


def track_folder(given: Path) -> Path:
    """The folder of a track, or of a track of the package by its name.

    Raises:
        ConfigError: there is no such track.
    """
    for folder in (given, TRACKS / given):
        if (folder / "track.toml").is_file():
            return folder
    known = ", ".join(map(str, package_tracks()))
    raise ConfigError(f"--track {given}: is no folder with a track.toml; tracks of the package are {known}")


def package_tracks() -> list[Path]:
    """Names of the tracks that the package has, each of which track_folder() finds."""
    return sorted(Path(one.parent.name) for one in TRACKS.glob("*/track.toml"))


def load_track(folder: Path) -> Track:
    """The content of FOLDER/track.toml.

    Raises:
        ConfigError: a key is unknown or missing, or a value breaks its rule.
    """
    path = folder / "track.toml"
    content = read_toml(path)
    files, simulated, train = (content.pop(name, None) for name in ("files", "simulated", "train"))
    track = read_table(Track, content, f"{path}:")
    if (simulated is None) == (not files):
        raise ConfigError(f"{path}: must have either [[files]] or [simulated]")
    listed = [read_table(SourceFile, one, f"{path}: [[files]]") for one in files or ()]
    made = None if simulated is None else read_table(Simulated, simulated, f"{path}: [simulated]")
    return replace(track, files=tuple(listed), simulated=made, train=train or {})


def digest(folder: Path) -> str:
    """Of all files of a track: results of another state of it are not used again."""
    files = sorted(one for one in folder.rglob("*") if one.is_file() and "__pycache__" not in one.parts)
    return hashlib.sha256(b"".join(bytes(one.name, "utf-8") + one.read_bytes() for one in files)).hexdigest()


# --- Files of others: from a folder, or by git; none is used unless its content is the one that was labelled.


def fetch(track: Track, data: Path | None, out: Path) -> dict[str, Path]:
    """The files of a track by their names, copied to a folder.

    Args:
        data: folder that holds them, at any depth; those that it lacks are fetched from their repositories.

    Raises:
        ConfigError: a file is missing, cannot be fetched, or has another checksum.
    """
    out.mkdir(parents=True, exist_ok=True)
    found = {}
    for one in track.files:
        target = found[one.name] = out / one.name
        if target.is_file() and _sha256(target.read_bytes()) == one.sha256:
            continue
        content = _from_folder(one, data) if data is not None else None
        if content is None:
            content = _by_git(one, track, out / "repositories")
        if (sha256 := _sha256(content)) != one.sha256:
            raise ConfigError(
                f"{one.name}: its sha256 is {sha256[:12]}..., the track's is {one.sha256[:12]}...: it is not the file "
                "that was labelled, and is not used"
            )
        target.write_bytes(content)
    return found


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _from_folder(one: SourceFile, data: Path) -> bytes | None:
    """Content of the file in the folder; of several of this name, the one with the right checksum if there is one.

    A file that its repository has under another name is found by that name, too. None: there is none.
    """
    names = dict.fromkeys((one.name, Path(one.path).name or one.name))
    paths = [path for name in names for end in ("", ".gz") for path in sorted(data.rglob(name + end))]
    contents = [gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes() for path in paths]
    return next((content for content in contents if _sha256(content) == one.sha256), contents[0] if contents else None)


def _by_git(one: SourceFile, track: Track, folder: Path) -> bytes:
    """Content of a file at its commit, of which alone the file is fetched: neither history nor other files."""
    repository, commit = one.repository or track.repository, one.commit or track.commit
    if not (repository and commit and one.path):
        raise ConfigError(f"{one.name}: is in no repository in this form; give a folder that holds it with --data")
    clone = str(folder / _sha256(repository.encode())[:12])
    try:  # each step can be repeated, so an interrupted fetch leaves nothing that stops the next
        _git("init", "--quiet", "--bare", clone)
        _git("-C", clone, "config", "remote.origin.url", repository)
        _git("-C", clone, "fetch", "--quiet", "--depth=1", "--filter=blob:none", "origin", commit)
        return _git("-C", clone, "show", f"{commit}:{one.path}")
    except (OSError, subprocess.CalledProcessError) as error:
        why = (getattr(error, "stderr", b"") or str(error).encode()).decode(errors="replace").strip().splitlines()
        last = why[-1] if why else "git failed"
        raise ConfigError(f"{one.name}: could not be fetched from {repository} at {commit[:12]} ({last})") from error


def _git(*words: str) -> bytes:
    quiet = os.environ | {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}
    return subprocess.run(["git", *words], check=True, capture_output=True, env=quiet).stdout


# --- The dataset of a track, made once.


def make_dataset(track: Track, folder: Path, data: Path | None, out: Path, report: Reporter) -> Dataset:
    """The dataset OUT/data of a track, made unless it exists and the track is the same.

    Raises:
        TauextError: files cannot be used, or the import fails.
    """
    made, of_track, state = out / "data", out / "data.sha256", digest(folder)
    if track.simulated is not None:
        _simulate(track.simulated, made, report)
    elif not (made.is_dir() and of_track.is_file() and of_track.read_text() == state):
        files = fetch(track, data, out / "files")
        part = out / "data.half-done"
        shutil.rmtree(part, ignore_errors=True)
        if track.made_by:
            function_of(folder, track.made_by)(files, part)
        else:
            arm = shutil.copy(folder / "arm.toml", out / "files")
            sources = [path for path in files.values() if path.suffix not in (".urdf", ".xml", ".stl")]
            import_dataset(sources, Path(arm), part, "tauext", SILENT.say)
        shutil.rmtree(made, ignore_errors=True)
        part.rename(made)
        of_track.write_text(state)
    return load_dataset(made)


def _simulate(made: Simulated, out: Path, report: Reporter) -> None:
    from tauext_lab.sim.collect import simulate_dataset
    from tauext_lab.sim.config import RigConfig
    from tauext_lab.sim.other_friction import OtherRig

    config = RigConfig() if made.friction == "lugre" else OtherRig(name=made.friction, family=made.friction)
    with report.progress(f"simulate {made.friction}") as show:
        simulate_dataset(
            out, config, made.seed, made.minutes, made.collision_recordings,
            lambda what, done, total: show(done, total, what), test_hours=made.test_hours,
        )  # fmt: skip


def function_of(folder: Path, name: str) -> Callable[..., Any]:
    """The function FILE.py:NAME, whose file lies in the folder or is a path.

    Raises:
        ConfigError: there is no such file or function, or the file cannot be run.
    """
    file, _, function = name.rpartition(":")
    path = folder / file
    spec = importlib.util.spec_from_file_location(path.stem, path) if path.is_file() else None
    if not function.isidentifier() or spec is None or spec.loader is None:
        raise ConfigError(f"{name}: must be FILE.py:FUNCTION of a Python file; {path} is none")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{path}: raised {type(error).__name__} as it was imported: {error}") from error
    if not callable(found := getattr(module, function, None)):
        raise ConfigError(f"{path}: has no function '{function}'")
    return found


def folds(track: Track, dataset: Dataset) -> Sequence[Dataset]:
    """The dataset, or where each recording is tested once, one dataset for each."""
    if not track.leave_one_out:
        return [dataset]
    names = dataset.split.train
    return [
        replace(dataset, split=Split(tuple(other for other in names if other != one), test=(one,))) for one in names
    ]
