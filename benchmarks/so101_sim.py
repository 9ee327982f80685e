"""A simulated SO-101 whose torques are known: errors of torques, and contacts found.

    python benchmarks/so101_sim.py OUT [--seed 0] [--only simulate bundles tables] [--rates 50 30 100]

OUT/RATEhz has the recordings, as a servo bus reports them, and the truth. OUT/RATEhz/SOURCE has tauext's results with
the torque from one source; each step is a tauext command. Existing files are used again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common import arguments, head, joined, table_row, tauext, write_tables
from tauext_lab.evaluate.collisions import GRACE_S, Collision, find_collisions, first_rise, judge_latched
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.errors import sensor_reference
from tauext_lab.evaluate.events import event_time
from tauext_lab.evaluate.free_motion import FALSE_ALARM_QUIET_S, beginnings, time_since_touch
from unseen.recordings import Take
from unseen.servos import description, servo_arm, so101, write_take

from tauext import _core, estimate_recording
from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording

RATES_HZ = (50, 30, 100)
TEN_MINUTES = tuple(Take(f"train-{k}", "train", 5) for k in (1, 2))
TESTS = tuple(Take(f"free-{k}", "test", 10) for k in range(1, 5))
TOUCHED = tuple(Take(f"touched-{k}", "collisions", 10, 60) for k in range(1, 4))
HOUR = tuple(Take(f"train-{k}", "train", 10) for k in range(3, 8))
TAKES = {take: 10 + number for number, take in enumerate(TEN_MINUTES + TESTS + TOUCHED + HOUR)}
"""With the number of their draws."""


def tested(rate_hz: int) -> tuple[Take, ...]:
    """Takes to test on: 70 minutes at the first rate, 40 at the others."""
    return TESTS + TOUCHED if rate_hz == RATES_HZ[0] else TESTS[:2] + TOUCHED[:2]


def simulate(out: Path, seed: int) -> None:
    """All recordings: at every rate those for ten minutes of training, at the first also what an hour needs."""
    maker = so101()
    arm = servo_arm(maker, seed)
    first = [(RATES_HZ[0], take) for take in (*TEN_MINUTES, *tested(RATES_HZ[0]))]
    others = [(rate, take) for rate in RATES_HZ[1:] for take in (*TEN_MINUTES, *tested(rate))]
    for rate, take in [*first, *others, *((RATES_HZ[0], take) for take in HOUR)]:
        folder = out / f"{rate}hz"
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / f"{take.name}.parquet").exists():
            write_take(maker, arm, rate, take, TAKES[take], seed, folder)
            print(f"{folder.name}/{take.name}", flush=True)


SOURCES = ("duty", "supply-current", "goal", "linear")
STEPS = ("simulate", "bundles", "tables")


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
    def bundle(self) -> str:
        return f"{self.data}-{self.recipe}{'-constant' if self.constant else ''}.tauext"

    @property
    def data(self) -> str:
        return f"{self.rate_hz}hz/{self.source}{'' if self.model else '-none'}{'-hour' if self.hour else ''}"

    @property
    def takes(self) -> tuple[Take, ...]:
        return TEN_MINUTES + (HOUR if self.hour else ()) + tested(self.rate_hz)


def trials(rates: Sequence[int]) -> list[Trial]:
    """What is trained: all sources at every rate; at the first also other recipes, no model, an hour."""
    first = rates[0]
    more = [
        *(Trial(first, "duty", recipe=recipe) for recipe in ("friction", "observer")),
        *(Trial(first, source, model=False) for source in ("duty", "goal")),
        *(Trial(first, source, constant=True) for source in SOURCES[:-1]),
        *(Trial(first, source, hour=True) for source in ("duty",)),
    ]
    return (
        [Trial(first, source) for source in SOURCES]
        + more
        + [Trial(rate, source) for rate in rates[1:] for source in SOURCES[:-1]]
    )


def make(out: Path, trial: Trial) -> Path:
    """The bundle of a trial; its dataset beside it."""
    data, raw = out / trial.data, out / f"{trial.rate_hz}hz"
    if not (data / "split.json").exists():
        law = linear_law(raw, [take.name for take in TEN_MINUTES], so101().joints).round(4).tolist()
        linear = law if trial.source == "linear" else ()
        arm = data.with_suffix(".toml")
        arm.write_text(description(so101(), trial.takes, trial.source, trial.model, linear))
        files = [raw / f"{take.name}.parquet" for take in trial.takes]
        imported = data.with_suffix(".import.txt")
        tauext("import", "--source", *files, "--arm", arm, "--out", data, printed=imported)
    bundle = out / trial.bundle
    if not bundle.exists():
        case = () if trial.model else ("--case", "none")
        if trial.constant:
            settings = bundle.with_suffix(".toml")
            settings.write_text('error_scale = "off"\n')
            case += ("--config", settings)
        case += ("--accept", "effort-sign") if trial.source == "goal" else ()  # see the page: steps of 30 Hz
        printed = bundle.with_suffix(".train.txt")
        tauext("train", "--data", data, "--recipe", trial.recipe, *case, "--out", bundle, printed=printed)
        print(bundle, flush=True)
    return bundle


def torque_tables(out: Path, rates: Sequence[int]) -> list[str]:
    lines = head("torque from | Hz | free motion: RMS error, Nm | joint by joint | in contact | joint by joint")
    joints = so101().joints
    for rate in rates:
        names = [take.name for take in tested(rate)]
        raw = out / f"{rate}hz"
        law = linear_law(raw, [take.name for take in TEN_MINUTES], joints)
        linear = {name: law * registers(raw, name, "signed", joints) for name in names}
        lines.append(torque_row(f"linear law of the current | {rate}", raw, linear))
        for source in SOURCES[:-1]:
            data = out / Trial(rate, source).data
            if (data / "split.json").exists():
                torques = {recording.name: recording.tau for recording in tests_of(data)}
                lines.append(torque_row(f"{source}, the type's constants | {rate}", raw, torques))
            if (bundle := out / Trial(rate, source).bundle).exists():
                factor = np.array(_core.Bundle.load(str(bundle)).observer.nm_per_unit or 1.0)
                corrected = {name: factor * torque for name, torque in torques.items()}
                lines.append(torque_row(f"{source}, corrected in training | {rate}", raw, corrected))
    return lines


def contact_tables(out: Path, rates: Sequence[int]) -> list[str]:
    first = "torque from | Hz | model | training, min | recipe | error free, in contact, Nm"
    lines = head(CONTACT_COLUMNS.format(first=first))
    for trial in trials(rates):
        bundle = out / trial.bundle
        if bundle.exists():
            verdicts, errors = judged(bundle, out / trial.data)
            what = (trial.source, trial.rate_hz, "urdf" if trial.model else "none", 60 if trial.hour else 10)
            recipe, wrong = trial.recipe + ", constant limits" * trial.constant, joined(errors, ".3f", ", ")
            lines.append(table_row(*what, recipe, wrong, contact_cells(verdicts, verdicts.strong)))
            print(lines[-1], flush=True)
    return lines


# --- Alarms against what is true: one judge for every method.


AFTER_CONTACT_S = 3.0
"""An alarm so soon after a contact is counted apart: the arm snaps back, and its gears settle."""


@dataclass
class Verdicts:
    """One method on all test recordings of one rate."""

    peaks_nm: list[float] = field(default_factory=list)
    """Largest true torque of each contact."""
    found: list[bool] = field(default_factory=list)
    strong: list[bool] = field(default_factory=list)
    """Over 1.5 times the limits of the method that limits are known of, for its hold time and 20 ms."""
    delays_s: list[float] = field(default_factory=list)
    false_free: int = 0
    false_after: int = 0
    free_hours: float = 0.0

    def add(self, recording: Recording, alarm: np.ndarray, healthy: np.ndarray) -> list[Collision]:
        """Take in one recording, with contacts or without; says its contacts.

        Args:
            alarm: (samples,) bool.
            healthy: (samples,) bool: while a method can say nothing, time is not free.
        """
        free = ~event_time(recording, EventsConfig().tolerance_s) & healthy
        self.free_hours += float(free.sum()) / recording.rate_hz / 3600
        begun = beginnings(alarm, round(FALSE_ALARM_QUIET_S * recording.rate_hz))
        since_s = time_since_touch(recording) if recording.contact is not None else np.full(recording.samples, np.inf)
        false_since_s = since_s[begun[free[begun]]]
        after = int((false_since_s <= AFTER_CONTACT_S).sum())
        self.false_after, self.false_free = self.false_after + after, self.false_free + len(false_since_s) - after
        touches = find_collisions(recording)
        for touch in touches:
            window = slice(touch.begin, min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples))
            rise = first_rise(alarm[window], bool(alarm[touch.begin - 1]))
            self.peaks_nm.append(float(touch.true_peak_nm.max()))
            self.found.append(rise is not None)
            if rise is not None:
                self.delays_s.append(float(recording.t_ns[window][rise] - recording.t_ns[touch.begin]) * 1e-9)
        return touches

    def add_estimates(self, recording: Recording, estimates: Estimates, hold_s: float, gain_per_s: float) -> None:
        """Take in what a bundle said, as a monitor would have latched it."""
        assert estimates.held_alarm is not None
        touches = self.add(recording, estimates.held_alarm == COLLISION, estimates.healthy)
        reference = sensor_reference(recording, gain_per_s)
        self.strong += [judge_latched(t, recording, estimates, hold_s, reference).strong for t in touches]

    def found_among(self, chosen: Sequence[bool] | np.ndarray) -> tuple[int, int]:
        """Found, and how many there are, of the contacts that are chosen."""
        chosen = np.asarray(chosen, dtype=bool)
        return int(np.array(self.found)[chosen].sum()), int(chosen.sum())


# --- Cells.


EDGES_NM = (0.02, 0.1, 0.2, 0.4, 0.8, 50.0)


def truth(raw: Path, name: str) -> dict[str, np.ndarray]:
    """True signals of a take at its samples, (samples, joints)."""
    with np.load(raw / f"{name}.truth.npz") as stored:
        return dict(stored)


def registers(raw: Path, name: str, what: str, joints: Sequence[str]) -> np.ndarray:
    """What the bus said of a take, (samples, joints)."""
    table = pq.read_table(raw / f"{name}.parquet", columns=[f"{what}_{joint}" for joint in joints])
    return np.column_stack([column.to_numpy() for column in table.columns])


def linear_law(raw: Path, takes: Sequence[str], joints: Sequence[str]) -> np.ndarray:
    """The constant of each joint, [N m/A], by which the signed current explains the motor's true torque in free motion
    best: better than anybody without a torque sensor could fit it."""
    a = np.concatenate([registers(raw, take, "signed", joints) for take in takes])
    b = np.concatenate([truth(raw, take)["motor_nm"] for take in takes])
    return np.asarray((a * b).sum(axis=0) / (a * a).sum(axis=0))


def tests_of(data: Path) -> list[Recording]:
    """Free motion and contacts of a dataset."""
    split = load_split(data)
    return [load_recording(data / name) for name in (*split.test, *split.collisions)]


def torque_row(name: str, raw: Path, torques: Mapping[str, np.ndarray]) -> str:
    """RMS error of the motor's torque in free motion and while something touches the arm, joint by joint.

    Args:
        torques: of every test take, (samples, joints), [N m].
    """
    free, touched = [], []
    for take, torque in torques.items():
        true = truth(raw, take)
        touching = (true["tau_ext"] != 0).any(axis=1)
        error = torque - true["motor_nm"]
        free.append(error[~touching])
        touched.append(error[touching])
    cells = []
    for errors in (free, touched):
        square = np.concatenate(errors) ** 2
        cells += [f"{np.sqrt(square.mean()):.3f}", joined(np.sqrt(square.mean(axis=0)), ".3f")]
    return table_row(name, *cells)


def judged(bundle_path: Path, data: Path) -> tuple[Verdicts, list[float]]:
    """What a bundle said on the test recordings; RMS of tau_ext less the truth in free motion and in contacts."""
    bundle, verdicts = _core.Bundle.load(str(bundle_path)), Verdicts()
    free, touched = [], []
    for recording in tests_of(data):
        estimates = estimate_recording(bundle, recording)
        verdicts.add_estimates(recording, estimates, bundle.hold_s, bundle.observer.gain_per_s)
        assert recording.tau_ext is not None
        error = (estimates.tau_ext - recording.tau_ext)[estimates.healthy]
        touching = (recording.tau_ext != 0).any(axis=1)[estimates.healthy]
        free.append(error[~touching])
        touched.append(error[touching])
    return verdicts, [float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) for errors in (free, touched)]


def contact_cells(verdicts: Verdicts, strong: Sequence[bool]) -> str:
    """Found of the strong ones, of all, by strength; false alarms; delay."""
    peaks = np.array(verdicts.peaks_nm)
    cells = [_share(verdicts.found_among(strong)), _share(verdicts.found_among(np.ones(len(peaks))))]
    for low, high in zip(EDGES_NM[:-1], EDGES_NM[1:], strict=True):
        found, of = verdicts.found_among((peaks >= low) & (peaks < high))
        cells.append(f"{found}/{of}")
    delays = np.array(verdicts.delays_s)
    delay = f"{1000 * np.median(delays):.0f}, {1000 * np.quantile(delays, 0.95):.0f}" if len(delays) else "–"
    return " | ".join([*cells, f"{verdicts.false_free} | {verdicts.false_after} | {verdicts.free_hours:.2f}", delay])


def _share(counts: tuple[int, int]) -> str:
    found, of = counts
    return f"{found}/{of} ({found / of:.0%})" if of else "0/0"


STRENGTHS = " | ".join([f"{a:g} to {b:g} Nm" for a, b in zip(EDGES_NM[:-2], EDGES_NM[1:-1], strict=True)])
CONTACT_COLUMNS = (
    "{first} | found at 1.5 times the limit | of all | "
    f"{STRENGTHS} | over {EDGES_NM[-2]:g} Nm | false | after a contact | in h | delay, ms: median, 95 %"
)


def main() -> None:
    parser = arguments(__doc__, "out", seed=0)
    parser.add_argument("--rates", type=int, nargs="+", choices=RATES_HZ, default=list(RATES_HZ))
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS))
    options = parser.parse_args()
    out = options.out.resolve()
    if "simulate" in options.only:
        simulate(out, options.seed)
    if "bundles" in options.only:
        for trial in trials(options.rates):
            make(out, trial)
    if "tables" in options.only:
        write_tables(out, [*torque_tables(out, options.rates), "", *contact_tables(out, options.rates)])


if __name__ == "__main__":
    main()
