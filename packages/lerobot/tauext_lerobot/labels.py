"""A LeRobot dataset with external torque, contact and collision added to every frame."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext import _core
from tauext.data.description import Arm
from tauext.data.importers.raw import RawSignals
from tauext.data.recording import runs_of
from tauext.data.servo import velocity_and_torque
from tauext.errors import ConfigError, RecordingError, TauextError
from tauext.files.atomic_write import expect_empty, new_folder
from tauext.files.plain_file import json_of, read_text
from tauext.files.preflight import expect_folder
from tauext.progress import Reporter
from tauext_lerobot.frames import UNKNOWN, Labels, ServoFrames, bare_name, element_names, expect_rate, labels_of
from tauext_lerobot.lerobot_folder import INFO, STATE, LerobotFolder, open_folder, raw_episode, readable

# --- Labels in the features of a LeRobot dataset: elements of its state, or separate features.


Into = Literal["state", "features"]
OWN = ("observation.tau_ext", "observation.contact", "observation.collision")
HUGGINGFACE = b"huggingface"


@dataclass(frozen=True)
class FeaturePlan:
    """Where the labels' columns go: elements of features."""

    places: dict[str, tuple[list[int], list[int]]]
    """Per feature: columns of the labels, and their indices among the feature's elements."""
    features: dict[str, dict]
    """All features of the labelled dataset."""
    added: dict[str, int]
    """Per feature: number of elements appended to the existing ones."""


def plan_features(folder: LerobotFolder, joints: Sequence[str], into: Into) -> FeaturePlan:
    """Plan where labels go; elements with the same names are replaced.

    Raises:
        ConfigError: the dataset has no state with named elements.
    """
    names: list[Any]
    features, wanted = copy.deepcopy(folder.features), element_names(joints)
    if into == "features":
        of_joints = list(range(len(joints)))
        names = [[bare_name(joint) for joint in joints], None, None]
        columns = [of_joints, [len(joints)], [len(joints) + 1]]
        places = {}
        for feature, columns_of_it, named in zip(OWN, columns, names, strict=True):
            features[feature] = {"dtype": "float32", "shape": [len(columns_of_it)], "names": named}
            places[feature] = (columns_of_it, list(range(len(columns_of_it))))
        return FeaturePlan(places, features, {feature: len(own[0]) for feature, own in places.items()})
    state = features.get(STATE, {})
    shape = state.get("shape") or [0]
    names = folder.names(STATE, int(shape[0])) if STATE in features else []
    if not names or not isinstance(state.get("names"), list | dict):
        raise ConfigError(
            f"{folder.path}: the elements of {STATE} have no names, so labels cannot be distinguished among them: "
            "use --into features for separate features"
        )
    new = [name for name in wanted if name not in names]
    listed = [*names, *new]
    state["names"], state["shape"] = listed, [len(listed)]
    places = {STATE: (list(range(len(wanted))), [listed.index(name) for name in wanted])}
    return FeaturePlan(places, features, {STATE: len(new)})


def with_labels(table: pa.Table, labels: np.ndarray, plan: FeaturePlan) -> pa.Table:
    """Add labels (rows, columns) to the frames of a data file; everything else is unchanged."""
    for feature, (columns, places) in plan.places.items():
        values = _elements(table, feature, len(table))
        wide = np.zeros((len(table), max(values.shape[1], max(places) + 1)), dtype=values.dtype)
        wide[:, : values.shape[1]] = values
        wide[:, places] = labels[:, columns]
        table = _set(table, feature, wide)
    return table.replace_schema_metadata(_metadata(table.schema, plan))


def recorded(table: pa.Table, plan: FeaturePlan) -> np.ndarray | None:
    """Existing labels of the frames, (rows, columns) as with_labels() takes them; None: some are missing."""
    total = sum(len(columns) for columns, _ in plan.places.values())
    held = np.zeros((len(table), total), dtype=np.float32)
    for feature, (columns, places) in plan.places.items():
        values = _elements(table, feature, len(table))
        if values.shape[1] <= max(places):
            return None
        held[:, columns] = values[:, places]
    return held


def _elements(table: pa.Table, feature: str, rows: int) -> np.ndarray:
    if feature not in table.column_names:
        return np.zeros((rows, 0), dtype=np.float32)
    column = table.column(feature).combine_chunks()
    if not hasattr(column.type, "value_type"):
        return column.to_numpy(zero_copy_only=False).reshape(rows, 1)
    values = column.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(rows, len(values) // max(rows, 1))


def _set(table: pa.Table, feature: str, values: np.ndarray) -> pa.Table:
    """Set a column and keep its list type; a new column is a fixed-size list, or plain numbers for one element."""
    there = table.schema.get_field_index(feature)
    flat = pa.array(np.ascontiguousarray(values).ravel())
    if there < 0 and values.shape[1] == 1:
        return table.append_column(feature, flat)
    kind = table.schema.field(there).type if there >= 0 else None
    if kind is not None and (pa.types.is_list(kind) or pa.types.is_large_list(kind)):
        size, lists = (np.int32, pa.ListArray) if pa.types.is_list(kind) else (np.int64, pa.LargeListArray)
        column = lists.from_arrays(pa.array(np.arange(0, values.size + 1, values.shape[1], dtype=size)), flat)
    else:
        column = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return table.append_column(feature, column) if there < 0 else table.set_column(there, feature, column)


def _metadata(schema: pa.Schema, plan: FeaturePlan) -> dict[bytes, bytes] | None:
    """Update the datasets library's record of column types, if there is one."""
    metadata = dict(schema.metadata or {})
    if HUGGINGFACE not in metadata:
        return metadata or None
    content: dict[str, Any] = json.loads(metadata[HUGGINGFACE])
    features = content.get("info", {}).get("features", {})
    template = next((f for f in features.values() if f.get("length", -1) > 0), {"_type": "Sequence"})
    for feature in plan.places:
        length = plan.features[feature]["shape"][0]
        value = {"dtype": plan.features[feature]["dtype"], "_type": "Value"}
        kept = features.get(feature)
        if kept is not None and "length" in kept:
            features[feature] = kept | ({"length": length} if kept["length"] > 0 else {})
        elif kept is None:
            features[feature] = (
                value if length == 1 else {"feature": value, "length": length, "_type": template["_type"]}
            )
    return metadata | {HUGGINGFACE: json.dumps(content).encode()}


# --- LeRobot's statistics of the labels' columns, per episode and for the dataset.


QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats = dict[str, np.ndarray]


def episode_stats(values: np.ndarray) -> Stats:
    """min, max, mean, std, count and quantiles of the columns of one episode, (frames, columns).

    Quantiles are values of the data, since flags have no values in between; LeRobot takes its own from a histogram.
    """
    values = values.astype(np.float64)
    stats = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0, method="inverted_cdf")
    return stats | {"count": np.array([len(values)])} | dict(zip(QUANTILES, quantiles, strict=True))


def dataset_stats(episodes: Sequence[Stats]) -> Stats:
    """Merge the statistics of episodes as LeRobot does: means and variances weighted by counts, quantiles as means of
    quantiles, also weighted."""
    count = np.array([stats["count"][0] for stats in episodes], dtype=np.float64)[:, None]
    stacked = {key: np.stack([stats[key] for stats in episodes]) for key in episodes[0] if key != "count"}
    mean = (stacked["mean"] * count).sum(0) / count.sum()
    variance = ((stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2) * count).sum(0) / count.sum()
    merged = {"min": stacked["min"].min(0), "max": stacked["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    quantiles = {key: (stacked[key] * count).sum(0) / count.sum() for key in QUANTILES}
    return merged | {"count": np.array([int(count.sum())])} | quantiles


def put_stats(held: dict[str, list] | None, stats: Stats, places: Sequence[int], columns: Sequence[int]) -> dict:
    """Insert the statistics of columns at their places into a feature's; those of its other elements stay.

    Args:
        held: existing statistics of the feature; None: the feature is new and gets all kinds.
    """
    kinds = [key for key in held if key in stats] if held else list(stats)
    made: dict[str, list] = dict(held) if held else {}
    for kind in kinds:
        if kind == "count":
            made[kind] = [int(stats[kind][0])]
            continue
        listed = list(made.get(kind) or [])
        listed += [0.0] * (max(places) + 1 - len(listed))
        for place, column in zip(places, columns, strict=True):
            listed[place] = float(stats[kind][column])
        made[kind] = listed
    return made


# --- The label stage.


@dataclass
class LabelReport:
    """Counts of labelled frames."""

    episodes: int = 0
    frames: int = 0
    unknown: int = 0
    """Frames without an estimate, such as those of the warm-up in each episode."""
    contact: int = 0
    """Frames in contact."""
    collisions: int = 0
    """Number of collisions, not of frames in collision."""
    held: int = 0
    """Frames that had labels before."""
    equal: int = 0
    """Frames of `held` whose labels were equal to the last bit."""


def label_dataset(
    dataset: Path, bundle: _core.Bundle, arm: Arm, out: Path, into: Into = "state", reporter: Reporter | None = None
) -> LabelReport:
    """Write a copy of a LeRobot dataset with the labels of a bundle.

    Every episode begins with a new monitor. Features and statistics of each episode and of the dataset are updated.
    Videos are linked where the file system supports it; all other files are copied. The folder is written atomically.

    Args:
        dataset: folder of a dataset, v3.0 or v2.1; read only.
        arm: the description that the bundle's recordings were imported with.
        out: folder to write, which must be empty or not there.
        into: state: elements of observation.state, as the plugin lerobot_robot_tauext records them; features: separate
            features.

    Raises:
        RecordingError: a damaged dataset, or one of another version; positions in other units than described.
        BundleError: the bundle has other joints or another rate, or takes no servo signals.
        ConfigError: a column of the description is missing, or the folder cannot be written.
    """
    folder = open_folder(dataset)
    expect_rate(bundle, folder.fps)
    expect_empty(out)
    if out.resolve().is_relative_to(dataset.resolve()):
        raise ConfigError(f"{out} is inside the dataset; choose a folder outside")
    expect_folder(out)
    plan = plan_features(folder, arm.names, into)
    work = Labelling(folder, bundle, arm, plan)
    with new_folder(out) as part:
        files = {file.relative_to(folder.path) for file in folder.data_files()}
        for file in sorted(path for path in folder.path.rglob("*") if path.is_file()):
            if (name := file.relative_to(folder.path)) not in files:
                _copy(file, part / name)
        for name in sorted(files):
            frames = work.data_file(folder.path / name, part / name)
            if reporter is not None:
                reporter.say(f"{name}: {frames} frames")
        work.meta(part)
    return work.report


class Labelling:
    """Labels the episodes of one dataset and counts frames."""

    def __init__(self, folder: LerobotFolder, bundle: _core.Bundle, arm: Arm, plan: FeaturePlan):
        self.report = LabelReport(episodes=len(folder.lengths))
        self._folder, self._bundle, self._arm, self._plan = folder, bundle, arm, plan
        self._stats: dict[int, Stats] = {}

    def data_file(self, source: Path, target: Path) -> int:
        """Write a data file with labels; returns its number of frames."""
        with readable(source, "it"):
            table = pq.read_table(source)
            numbers, frames = (_whole(table, name) for name in ("episode_index", "frame_index"))
        columns = np.zeros((len(table), len(self._arm.names) + 2), dtype=np.float32)
        for number in np.unique(numbers):
            rows = np.flatnonzero(numbers == number)
            if int(number) not in self._folder.lengths:
                raise RecordingError(f"{source}: episode {number} is not in the metadata")
            if not np.array_equal(np.sort(frames[rows]), np.arange(self._folder.lengths[int(number)])):
                raise RecordingError(
                    f"{source}: the frames of episode {number} are not 0 to {self._folder.lengths[int(number)] - 1}"
                )
            columns[rows] = self._labels(int(number)).columns[frames[rows]]
        with readable(source, "the description of its columns"):
            held = recorded(table, self._plan)
            table = with_labels(table, columns, self._plan)
        if held is not None:
            self.report.held += len(held)
            self.report.equal += int((held == columns).all(axis=1).sum())
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, target)
        return len(table)

    def _labels(self, number: int) -> Labels:
        """Label one episode and count its frames."""
        raw = raw_episode(self._folder, number)
        try:
            labels = episode_labels(raw.name, next(iter(raw.blocks())), self._bundle, self._arm)
        except TauextError as error:
            error.args = (f"{self._folder.path}: episode {number}: {error.args[0]}", *error.args[1:])
            raise
        self.report.frames += len(labels.contact)
        self.report.unknown += int((labels.contact == UNKNOWN).sum())
        self.report.contact += int((labels.contact == 1).sum())
        self.report.collisions += len(runs_of(labels.collision == 1))
        self._stats[number] = episode_stats(labels.columns)
        return labels

    def meta(self, part: Path) -> None:
        """Update features and statistics in the copied metadata."""
        if missing := [str(number) for number in self._folder.lengths if number not in self._stats]:
            raise RecordingError(f"{self._folder.path}: no data file holds frames of episode {', '.join(missing)}")
        info = json_of(read_text(part / INFO))
        info["features"] = self._plan.features
        _write_json(info, part / INFO)
        if self._folder.version == "v3.0":
            for file in sorted((part / "meta/episodes").glob("chunk-*/file-*.parquet")):
                with self._read(part, file):
                    table = self._episode_columns(pq.read_table(file))
                file.unlink()
                pq.write_table(table, file)
        elif (file := part / "meta/episodes_stats.jsonl").is_file():
            with self._read(part, file):
                lines = [json_of(line) for line in read_text(file).splitlines() if line.strip()]
                for line in lines:
                    self._put(line["stats"], self._stats[line["episode_index"]])
            _replace(file, "".join(json.dumps(line) + "\n" for line in lines))
        if (file := part / "meta/stats.json").is_file():
            with self._read(part, file):
                stats = json_of(read_text(file))
                self._put(stats, dataset_stats([self._stats[number] for number in self._folder.lengths]))
            _write_json(stats, file)

    def _read(self, part: Path, file: Path) -> AbstractContextManager[None]:
        """Errors of reading a copy name the original file."""
        return readable(self._folder.path / file.relative_to(part), "it")

    def _put(self, stats: dict[str, dict], own: Stats) -> None:
        for feature, (columns, places) in self._plan.places.items():
            held = stats.get(feature)
            stats[feature] = put_stats(None if feature in self._plan.added and not held else held, own, places, columns)

    def _episode_columns(self, table: pa.Table) -> pa.Table:
        """Update statistics of v3.0 episodes: columns stats/FEATURE/KIND with one list per episode."""
        rows = table.to_pylist()
        for feature, (columns, places) in self._plan.places.items():
            kinds = [name.split("/")[2] for name in table.column_names if name.startswith(f"stats/{feature}/")]
            any_feature = [name.split("/")[2] for name in table.column_names if name.startswith("stats/timestamp/")]
            made = []
            for row in rows:
                held = {kind: row[f"stats/{feature}/{kind}"] for kind in kinds}
                stats = put_stats(held or None, self._stats[row["episode_index"]], places, columns)
                made.append(stats if held else {kind: stats[kind] for kind in any_feature if kind in stats})
            for kind in made[0] if made else ():
                name, values = f"stats/{feature}/{kind}", [one[kind] for one in made]
                at = table.schema.get_field_index(name)
                column = pa.array(values, type=table.schema.field(at).type if at >= 0 else None)
                table = table.append_column(name, column) if at < 0 else table.set_column(at, name, column)
        return table.replace_schema_metadata(
            {k: v for k, v in (table.schema.metadata or {}).items() if k != b"huggingface"}
        )


def episode_labels(name: str, block: RawSignals, bundle: _core.Bundle, arm: Arm) -> Labels:
    """Label one episode's frames with a new monitor; a missing number is a fault, -1."""
    t_ns = block.t_ns
    assert t_ns is not None
    signals = ServoFrames(bundle, arm, block.names, name).signals(t_ns, block.columns)
    q = signals.pop("q")
    dq, tau = velocity_and_torque(bundle.servo, t_ns, q, signals)
    estimates = _core.estimate(bundle, t_ns, q, dq, tau, os.cpu_count() or 1, None)
    return labels_of(estimates["health"], estimates["held_alarm"], estimates["tau_ext"].astype(np.float32))


def _whole(table: pa.Table, name: str) -> np.ndarray:
    """A column of whole numbers.

    Raises:
        ValueError: the column is not of an integer type.
    """
    numbers = table.column(name).to_numpy()
    if numbers.dtype.kind not in "iu":
        raise ValueError(f"{name} is not a whole number in every row")
    return numbers


def _copy(source: Path, target: Path) -> None:
    """Link a video, since videos are never rewritten, where the file system supports it; copy any other file.

    A video that is a symbolic link is copied: a hard link would tie the output to a file outside the dataset.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.suffix == ".mp4" and not source.is_symlink():
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system, or one without links
    shutil.copyfile(source, target)


def _replace(path: Path, text: str) -> None:
    path.unlink()
    path.write_text(text, encoding="utf-8")


def _write_json(content: object, path: Path) -> None:
    _replace(path, json.dumps(content, indent=4, ensure_ascii=False) + "\n")
