"""A simulated SO-101 whose torques are known: errors of torques, and contacts found.

    python packages/lerobot/benchmarks/so101_sim.py OUT [--seed 0] [--rates 50 30 100] [--tables]

OUT/RATEhz has the recordings, as a servo bus reports them, and the truth. OUT/RATEhz/SOURCE has tauext's results with
the torque from one source; each step is a tauext command. Existing files are used again.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import COLLISION, arguments, head, quantiles_ms, rms, table_row, tauext, trained, write_tables
from tauext_lab.evaluate.collisions import GRACE_S, Collision, find_collisions, first_rise, judge_latched
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.errors import sensor_reference
from tauext_lab.evaluate.events import event_time
from tauext_lab.evaluate.free_motion import FALSE_ALARM_QUIET_S, beginnings, time_since_touch
from unseen.recordings import Take
from unseen.servos import description, servo_arm, so101, write_take

from tauext import _core, estimate_recording
from tauext.bundle.estimates import Estimates
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording

RATES_HZ = (50, 30, 100)
SOURCES = ("duty", "supply-current", "goal")
TEN_MINUTES = tuple(Take(f"train-{k}", "train", 5) for k in (1, 2))
TESTS = tuple(Take(f"free-{k}", "test", 10) for k in range(1, 5))
TOUCHED = tuple(Take(f"touched-{k}", "collisions", 10, 60) for k in range(1, 4))
HOUR = tuple(Take(f"train-{k}", "train", 10) for k in range(3, 8))
TAKES = {take: 10 + number for number, take in enumerate(TEN_MINUTES + TESTS + TOUCHED + HOUR)}
"""With the number of their draws."""


def tested(rate_hz: int) -> tuple[Take, ...]:
    """Takes to test on: 70 minutes at the first rate, 40 at the others."""
    return TESTS + TOUCHED if rate_hz == RATES_HZ[0] else TESTS[:2] + TOUCHED[:2]


def simulate(out: Path, rate_hz: int, seed: int) -> None:
    """Recordings at a rate: those for ten minutes of training, at the first also what an hour needs."""
    maker, folder = so101(), out / f"{rate_hz}hz"
    folder.mkdir(parents=True, exist_ok=True)
    for take in (*TEN_MINUTES, *tested(rate_hz), *(HOUR if rate_hz == RATES_HZ[0] else ())):
        if not (folder / f"{take.name}.parquet").exists():
            write_take(maker, servo_arm(maker, seed), rate_hz, take, TAKES[take], seed, folder)
            print(f"{folder.name}/{take.name}", flush=True)


@dataclass(frozen=True)
class Trial:
    """What one bundle is trained on."""

    rate_hz: int
    source: str
    model: bool = True
    hour: bool = False
    recipe: str = "tauext"
    constant: bool = False
    """Limits are constants, instead of following the error that the motion announces."""

    @property
    def data(self) -> str:
        return f"{self.rate_hz}hz/{self.source}{'' if self.model else '-none'}{'-hour' if self.hour else ''}"

    @property
    def bundle(self) -> str:
        return f"{self.data}-{self.recipe}{'-constant' if self.constant else ''}.tauext"


def trials(rates: Sequence[int]) -> list[Trial]:
    """What is trained: all sources at every rate; at the first also other recipes, no model, an hour."""
    first = rates[0]
    return [
        *(Trial(first, source) for source in SOURCES),
        *(Trial(first, "duty", recipe=recipe) for recipe in ("friction", "observer")),
        *(Trial(first, source, model=False) for source in ("duty", "goal")),
        *(Trial(first, source, constant=True) for source in SOURCES),
        Trial(first, "duty", hour=True),
        *(Trial(rate, source) for rate in rates[1:] for source in SOURCES),
    ]


def make(out: Path, trial: Trial) -> Path:
    """The bundle of a trial; its dataset beside it."""
    data, raw = out / trial.data, out / f"{trial.rate_hz}hz"
    if not (data / "split.json").exists():
        takes = TEN_MINUTES + (HOUR if trial.hour else ()) + tested(trial.rate_hz)
        arm = data.with_suffix(".toml")
        arm.write_text(description(so101(), takes, trial.source, trial.model))
        files = [raw / f"{take.name}.parquet" for take in takes]
        tauext("import", "--source", *files, "--arm", arm, "--out", data, printed=data.with_suffix(".import.txt"))
    bundle = out / trial.bundle
    words: tuple = () if trial.model else ("--case", "none")
    if trial.constant:
        settings = bundle.with_suffix(".toml")
        settings.write_text('error_scale = "off"\n')
        words += ("--config", settings)
    words += ("--accept", "effort-sign") if trial.source == "goal" else ()  # see the page: steps of 30 Hz
    return trained(data, bundle, *words, recipe=trial.recipe)


# --- Torques against the truth.


def truth(raw: Path, name: str) -> dict[str, np.ndarray]:
    """True signals of a take at its samples, (samples, joints)."""
    with np.load(raw / f"{name}.truth.npz") as stored:
        return dict(stored)


def signed_current(raw: Path, name: str) -> np.ndarray:
    """As the bus reported it with the duty's sign, (samples, joints)."""
    table = pq.read_table(raw / f"{name}.parquet", columns=[f"signed_{joint}" for joint in so101().joints])
    return np.column_stack([column.to_numpy() for column in table.columns])


def linear_law(raw: Path) -> np.ndarray:
    """The constant of each joint, [N m/A], by which the signed current explains the motor's true torque in free motion
    best: better than anybody without a torque sensor could fit it."""
    a = np.concatenate([signed_current(raw, take.name) for take in TEN_MINUTES])
    b = np.concatenate([truth(raw, take.name)["motor_nm"] for take in TEN_MINUTES])
    return np.asarray((a * b).sum(axis=0) / (a * a).sum(axis=0))


def torque_tables(out: Path, rates: Sequence[int]) -> list[str]:
    lines = head("torque from | Hz | free motion: RMS error, Nm | in contact")
    for rate in rates:
        raw = out / f"{rate}hz"
        ways = {"linear law": {t.name: linear_law(raw) * signed_current(raw, t.name) for t in tested(rate)}}
        for source in SOURCES:
            trial = Trial(rate, source)
            if (out / trial.bundle).exists():
                ways[f"{source}, the type's constants"] = {one.name: one.tau for one in tests_of(out / trial.data)}
                factor = np.array(_core.Bundle.load(str(out / trial.bundle)).observer.nm_per_unit or 1.0)
                plain = ways[f"{source}, the type's constants"]
                ways[f"{source}, corrected in training"] = {name: factor * tau for name, tau in plain.items()}
        lines += [table_row(name, rate, *torque_errors(raw, torques)) for name, torques in ways.items()]
    return lines


def torque_errors(raw: Path, torques: Mapping[str, np.ndarray]) -> list[str]:
    """RMS error of the motor's torque in free motion and while something touches the arm, of every test take."""
    parts: tuple[list, list] = ([], [])
    for take, torque in torques.items():
        true = truth(raw, take)
        touching = (true["tau_ext"] != 0).any(axis=1)
        for part, rows in zip(parts, (~touching, touching), strict=True):
            part.append((torque - true["motor_nm"])[rows])
    return [f"{rms(np.concatenate(errors)):.3f}" for errors in parts]


def tests_of(data: Path) -> list[Recording]:
    """Free motion and contacts of a dataset."""
    split = load_split(data)
    return [load_recording(data / name) for name in (*split.test, *split.collisions)]


# --- Alarms against what is true.


@dataclass
class Verdicts:
    """One method on all test recordings of one rate."""

    found: list[bool] = field(default_factory=list)
    strong: list[bool] = field(default_factory=list)
    """Over 1.5 times the limits of the method that limits are known of, for its hold time and 20 ms."""
    delays_s: list[float] = field(default_factory=list)
    false_free: int = 0
    false_after: int = 0
    """False alarms within 3 s after a contact: the arm snaps back, and its gears settle."""
    free_hours: float = 0.0

    def add(self, recording: Recording, alarm: np.ndarray, healthy: np.ndarray) -> list[Collision]:
        """Take in one recording, with contacts or without; returns its contacts.

        Args:
            alarm: (samples,) bool.
            healthy: (samples,) bool: while a method can say nothing, time is not free.
        """
        free = ~event_time(recording, EventsConfig().tolerance_s) & healthy
        self.free_hours += float(free.sum()) / recording.rate_hz / 3600
        begun = beginnings(alarm, round(FALSE_ALARM_QUIET_S * recording.rate_hz))
        since_s = time_since_touch(recording) if recording.contact is not None else np.full(recording.samples, np.inf)
        false_since_s = since_s[begun[free[begun]]]
        after = int((false_since_s <= 3.0).sum())
        self.false_after, self.false_free = self.false_after + after, self.false_free + len(false_since_s) - after
        touches = find_collisions(recording)
        for touch in touches:
            window = slice(touch.begin, min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples))
            rise = first_rise(alarm[window], bool(alarm[touch.begin - 1]))
            self.found.append(rise is not None)
            if rise is not None:
                self.delays_s.append(float(recording.t_ns[window][rise] - recording.t_ns[touch.begin]) * 1e-9)
        return touches

    def add_estimates(self, recording: Recording, estimates: Estimates, hold_s: float, gain_per_s: float) -> None:
        """Take in what a bundle reported, as a monitor would have latched it."""
        assert estimates.held_alarm is not None
        touches = self.add(recording, estimates.held_alarm == COLLISION, estimates.healthy)
        reference = sensor_reference(recording, gain_per_s)
        self.strong += [judge_latched(t, recording, estimates, hold_s, reference).strong for t in touches]


def contact_row(out: Path, trial: Trial) -> str:
    """What a bundle reported on the test recordings."""
    bundle, verdicts, errors = _core.Bundle.load(str(out / trial.bundle)), Verdicts(), []
    for recording in tests_of(out / trial.data):
        estimates = estimate_recording(bundle, recording)
        verdicts.add_estimates(recording, estimates, bundle.hold_s, bundle.observer.gain_per_s)
        assert recording.tau_ext is not None
        errors.append((estimates.tau_ext - recording.tau_ext)[estimates.healthy])
    found, strong = np.array(verdicts.found), np.array(verdicts.strong)
    return table_row(
        trial.source, trial.rate_hz, "urdf" if trial.model else "none", 60 if trial.hour else 10,
        trial.recipe + ", constant limits" * trial.constant, f"{rms(np.concatenate(errors)):.3f}",
        *(f"{of.sum()}/{len(of)} ({of.mean():.0%})" for of in (found[strong], found)),
        verdicts.false_free, verdicts.false_after, f"{verdicts.free_hours:.2f}", quantiles_ms(verdicts.delays_s),
    )  # fmt: skip


def main() -> None:
    parser = arguments(__doc__, "out", seed=0)
    parser.add_argument("--rates", type=int, nargs="+", choices=RATES_HZ, default=list(RATES_HZ))
    parser.add_argument("--tables", action="store_true", help="of the bundles that exist")
    options = parser.parse_args()
    out = options.out.resolve()
    if not options.tables:
        for rate in options.rates:
            simulate(out, rate, options.seed)
        for trial in trials(options.rates):
            make(out, trial)
    lines = head(
        "torque from | Hz | model | training, min | recipe | error, Nm | found at 1.5 times the limit | of all | false "
        "| after a contact | in h | delay, ms: median, 95 %"
    )
    lines += [contact_row(out, trial) for trial in trials(options.rates) if (out / trial.bundle).exists()]
    write_tables(out, [*torque_tables(out, options.rates), "", *lines])


if __name__ == "__main__":
    main()
