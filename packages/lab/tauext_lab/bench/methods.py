"""Methods of the benchmark: recipes and methods of tauext, a Python function of anybody's, or a file of estimates."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tauext.bundle.bundle_file import load_bundle
from tauext.config import CaseName, TrainConfig
from tauext.data.dataset import Dataset
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.typed_table import values_of
from tauext.monitor.estimate import estimate_recording
from tauext.progress import Reporter, Show
from tauext.recipes import baselines, recipe_of, recipes
from tauext.train.stage import train_bundle
from tauext_lab.bench.track import function_of
from tauext_lab.evaluate.config import OTHER_METHODS
from tauext_lab.evaluate.missed_curve import held_ratio
from tauext_lab.other_methods import train_other_methods

WARM_UP_S = 2.0
"""At the begin of each recording, time that counts for no method: estimates may be NaN there."""


@dataclass(frozen=True)
class Answer:
    """What a method estimates of one recording."""

    ratio: np.ndarray
    """Of the largest joint to its own limit, held as long as an alarm needs, (samples,)."""
    tau_ext: np.ndarray | None = None
    """(samples, joints), in the unit of the recordings' tau; None: the method has none."""
    alarm: np.ndarray | None = None
    """(samples,) bool: the method's own alarm; None: where the ratio exceeds 1."""


@dataclass
class Quietly:
    """Shows progress, and keeps the sentences of trainings, which would drown the benchmark's own."""

    report: Reporter
    said: list[str] = field(default_factory=list)

    def say(self, sentence: str) -> None:
        self.said.append(sentence)

    def progress(self, title: str) -> AbstractContextManager[Show]:
        return self.report.progress(title)


@dataclass(frozen=True)
class Given:
    """What a method is trained on: nothing of the test."""

    dataset: Dataset
    """Its sets train, validation and calibration may be used."""
    track: str
    settings: dict[str, object]
    """Of recipes, from the track."""
    accept: Sequence[str]
    case: CaseName | None
    seed: int
    threads: int
    folder: Path
    report: Quietly

    def training(self) -> list[Recording]:
        """Recordings of all sets that are not test, with the labels of contacts alone."""
        sets = ("train", "validation", "calibration")
        return [blind(one, labels=True) for name in sets for one in self.dataset.recordings(name)]


Estimator = Callable[[Recording], Answer]


class Method(Protocol):
    """A method by its name."""

    @property
    def name(self) -> str: ...

    def key(self) -> str:
        """Changes with the method: results of an older state are not used again."""

    def fit(self, given: Given) -> Estimator:
        """Train it. Raises TauextError with the reason why it cannot be."""


def blind(recording: Recording, labels: bool = False) -> Recording:
    """The signals that a robot without sensors has: no true torque, and unless asked for no contacts."""
    hidden = ("tau_ext", "tau_ext_sensor", "tau_jts", *(() if labels else ("contact", "contact_link")))
    known = {name: value for name, value in recording.provenance.items() if name not in ("contacts", "seed", "number")}
    without: dict[str, Any] = dict.fromkeys(hidden)
    return replace(recording, **without, provenance=known)


def method_of(name: str) -> Method:
    """The method that --method names.

    Raises:
        ConfigError: there is no such method.
    """
    if name.endswith((".csv", ".parquet")):
        return EstimatesFile(Path(name))
    if ".py:" in name:
        return Foreign(name)
    if name in OTHER_METHODS:
        return Other(name)
    called, _, steps = name.partition("@")
    recipe = baselines().get(called, called)
    if recipe in recipes():
        if steps and not (steps.isdigit() and int(steps) and recipe_of(recipe).network):
            raise ConfigError(f"--method {name}: only a recipe with a network has steps, as in dense@10000")
        return OfRecipe(name, recipe, int(steps) if steps else None)
    known = ", ".join(dict.fromkeys([*recipes(), *baselines(), *OTHER_METHODS]))
    raise ConfigError(f"--method {name}: must be FILE.py:FUNCTION, a CSV or Parquet file of estimates, or of {known}")


# --- Methods of tauext.


@dataclass(frozen=True)
class OfRecipe:
    """A bundle of a recipe, with the limits and hold times of its default settings."""

    name: str
    recipe: str
    max_steps: int | None = None

    def key(self) -> str:
        return self.recipe

    def fit(self, given: Given) -> Estimator:
        settings = values_of(TrainConfig, given.settings, "track.toml: [train]")
        settings |= {"recipe": self.recipe, "seed": given.seed, "threads": given.threads}
        if self.max_steps is not None:
            settings["max_steps"] = self.max_steps
        path = given.folder / f"{self.name}.tauext"
        train_bundle(
            given.dataset, path, given.case, config=TrainConfig(**settings), report=given.report,
            accept=[*given.accept, "limit-wide", "limit-fine"],
        )  # fmt: skip
        bundle = load_bundle(path)

        def estimate(recording: Recording) -> Answer:
            found = estimate_recording(bundle, recording, given.threads)
            return Answer(held_ratio(found, bundle.hold_s), np.where(found.healthy[:, None], found.tau_ext, np.nan))

        return estimate


@dataclass(frozen=True)
class Other:
    """A method of tauext_lab.other_methods."""

    name: str

    def key(self) -> str:
        return self.name

    def fit(self, given: Given) -> Estimator:
        made = train_other_methods([self.name], given.training(), given.seed, given.report).get(self.name)
        if made is None:
            raise ConfigError(given.report.said[-1].partition(": ")[2])
        tau_ext = getattr(made, "tau_ext", None)
        return lambda one: Answer(largest(made.ratio(one)), None if tau_ext is None else tau_ext(one))


# --- A function of anybody's: fit(recordings) -> estimator, estimator(recording) -> tau_ext[, alarm].


@dataclass(frozen=True)
class Foreign:
    """FILE.py:FUNCTION. Whatever it raises or returns becomes a TauextError with its name."""

    given_name: str

    @property
    def name(self) -> str:
        return self.given_name.rpartition(":")[2]

    def key(self) -> str:
        path = Path(self.given_name.rpartition(":")[0])
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""

    def fit(self, given: Given) -> Estimator:
        recordings = given.training()
        made = self._called("fit", function_of(Path(), self.given_name), recordings)
        if not callable(made):
            raise ConfigError(f"fit() returned {type(made).__name__}; it must return a function of a recording")

        def answer(recording: Recording) -> tuple[np.ndarray, Any]:
            found = self._called("the estimator", made, recording)
            tau_ext, alarm = found if isinstance(found, tuple) and len(found) == 2 else (found, None)
            return expect_estimate(tau_ext, recording), alarm

        limit = largest_free(recordings, [answer(blind(one))[0] for one in recordings])
        return lambda one: own_answer(*answer(one), limit, one)

    @staticmethod
    def _called(what: str, function: Callable[..., Any], given: Any) -> Any:
        try:
            return function(given)
        except (Exception, SystemExit) as error:
            raise ConfigError(f"{what} raised {type(error).__name__}: {error}") from error


def expect_estimate(tau_ext: Any, recording: Recording) -> np.ndarray:
    """The estimate as floats, NaN in warm-up alone.

    Raises:
        ConfigError: no numbers, another shape, or a later NaN.
    """
    try:
        values = np.asarray(tau_ext, dtype=float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"tau_ext of '{recording.name}' must be numbers ({error})") from error
    if values.shape != recording.q.shape:
        raise ConfigError(f"tau_ext of '{recording.name}' has shape {values.shape}; it must be {recording.q.shape}")
    bad = ~np.isfinite(values).all(axis=1) & (recording.time_s >= WARM_UP_S)
    if bad.any():
        at_s = recording.time_s[np.argmax(bad)]
        raise ConfigError(
            f"tau_ext of '{recording.name}' is not finite at {at_s:.3f} s; it must be from {WARM_UP_S:g} s on"
        )
    return values


def own_answer(tau_ext: np.ndarray, alarm: Any, limit: np.ndarray, recording: Recording) -> Answer:
    """The answer of a method with these limits, and an alarm of its own if it has one.

    Args:
        alarm: None; flags (samples,), which count at the method's own limits; or ratios to its own limits, (samples,)
            or (samples, joints), which replace |tau_ext| over the limits.
    """
    if alarm is None:
        return Answer(largest(np.abs(tau_ext) / limit), tau_ext)
    given = np.asarray(alarm)
    if given.shape not in ((recording.samples,), recording.q.shape) or given.dtype.kind not in "bif":
        raise ConfigError(
            f"the alarm of '{recording.name}' has shape {given.shape} of {given.dtype}; it must be flags or ratios to "
            f"thresholds, ({recording.samples},), or ratios {recording.q.shape}"
        )
    if given.dtype.kind == "b":
        flags = np.asarray(given.reshape(recording.samples, -1).any(axis=1))
        return Answer(largest(np.abs(tau_ext) / limit), tau_ext, flags)
    return Answer(largest(given.reshape(recording.samples, -1)), tau_ext)


def largest(ratio: np.ndarray) -> np.ndarray:
    """Of the joints, (samples,); NaN counts as 0."""
    return np.nan_to_num(reduce(np.maximum, np.asarray(ratio, dtype=float).T))


def largest_free(recordings: Sequence[Recording], estimates: Sequence[np.ndarray]) -> np.ndarray:
    """Limits of a method that has none: the largest |tau_ext| of each joint in the training's free motion, as the
    paper's, (joints,)."""
    free = [
        np.abs(tau_ext[free_samples(one) & (one.time_s >= WARM_UP_S)]).max(axis=0, initial=0.0)
        for one, tau_ext in zip(recordings, estimates, strict=True)
    ]
    return np.maximum(np.max(free, axis=0), 1e-9)


# --- Estimates in a file, made elsewhere.


@dataclass(frozen=True)
class EstimatesFile:
    """CSV or Parquet with the columns track, recording, t_ns, tau_ext_1 ... tau_ext_n, and optionally alarm.

    Rows of the training recordings, too: limits follow from them.
    """

    path: Path

    @property
    def name(self) -> str:
        return self.path.stem

    def key(self) -> str:
        return hashlib.sha256(self.path.read_bytes()).hexdigest() if self.path.is_file() else ""

    def fit(self, given: Given) -> Estimator:
        from pyarrow import csv, parquet

        try:
            table = parquet.read_table(self.path) if self.path.suffix == ".parquet" else csv.read_csv(self.path)
        except Exception as error:  # of the system, or one of pyarrow's many
            raise ConfigError(f"{self.path}: not readable ({error})") from error
        if missing := [name for name in ("track", "recording", "t_ns", "tau_ext_1") if name not in table.column_names]:
            known = ", ".join(table.column_names)
            raise ConfigError(f"{self.path}: has no column {missing[0]}; its columns are {known}")
        columns = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
        of_track = columns["track"].astype(str) == given.track

        def rows(recording: Recording) -> tuple[np.ndarray, Any]:
            at = np.flatnonzero(of_track & (columns["recording"].astype(str) == recording.name))
            if not np.array_equal(columns["t_ns"][at], recording.t_ns):
                raise ConfigError(
                    f"{self.path}: must have one row for each of the {recording.samples} samples of '{recording.name}' "
                    f"of track {given.track}, by t_ns; it has {len(at)}"
                )
            names = [f"tau_ext_{k + 1}" for k in range(len(recording.joints))]
            if missing := [name for name in names if name not in columns]:
                raise ConfigError(f"{self.path}: has no column {missing[0]}")
            alarm = columns["alarm"][at] if "alarm" in columns else None
            return expect_estimate(np.stack([columns[name][at] for name in names], axis=1), recording), alarm

        training = given.training()
        limit = largest_free(training, [rows(one)[0] for one in training])
        return lambda one: own_answer(*rows(one), limit, one)
