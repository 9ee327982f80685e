"""Simulated recordings as a drive would log them: CSV files of currents, arm.toml, and apart from them the truth."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import in_parallel, tauext
from tauext_lab.sim.rig import encoder, low_pass, velocity

from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, arm_of
from unseen.simulation import RATE_HZ, Contact, Run, draw_contacts, draw_motion, label, simulate

DRIVE_VELOCITY_RAD_S = 200.0
ROOM_C, RISE_K = 22.0, 15.0
"""Of a motor: where it starts, and by how much it gets warmer."""
MOTOR_SOONER = 0.8
"""Time constant of the motor, where the sensor is, over that of the gear, where the friction is."""
TEMPERATURE_NOISE_K, TEMPERATURE_STEP_K = 0.3, 0.5
LARGEST_JITTER = 0.4
"""Of the sample period: stamps still increase."""
KNOWN_TO = 0.1
STRONG = 3.0
"""A contact is strong if its torque at some joint is this many times the held-out error."""
LATER_WARM_S = 60.0
"""How warm the arm is when the test begins: another time of the day, after a minute of work."""


@dataclass(frozen=True)
class Take:
    """One recording to be made."""

    name: str
    part: str
    minutes: float
    contacts: int = 0
    warm_from_s: float = 0.0


TAKES = (
    Take("train-1", "train", 3),
    Take("train-2", "train", 3, 6, 180),
    Take("train-3", "train", 3, 0, 360),
    Take("train-4", "train", 3, 6, 540),
    Take("free-1", "test", 5, 0, LATER_WARM_S),
    Take("free-2", "test", 5, 0, LATER_WARM_S + 300),
    Take("contacts-1", "collisions", 5, 25, LATER_WARM_S + 600),
    Take("contacts-2", "collisions", 5, 25, 0),
)


def write_take(maker: Maker, seed: int, number: int, folder: Path, takes: Sequence[Take]) -> None:
    """Simulate takes[number] of the arm that `seed` drew, and write NAME.csv and NAME.truth.json."""
    arm, take, rng = arm_of(maker, seed), takes[number], maker.random(seed, 1 + number)
    samples = round(take.minutes * 60 * RATE_HZ)
    contacts = draw_contacts(take.contacts, take.minutes * 60, len(maker.joints), rng)
    setpoints = draw_motion(maker, samples, RATE_HZ, rng)
    known = load_tree(maker.model, maker.joints)
    run = simulate(arm, known, setpoints, maker.torque_nm, contacts, take.warm_from_s)
    celsius = motor_temperature(arm, take.warm_from_s, samples, maker.random(seed, 200 + number))
    write_csv(folder / f"{take.name}.csv", maker, arm, run, contacts, rng, celsius)
    peaks = [peak_nm(run.tau_ext, c) for c in contacts]
    truth = [asdict(c) | {"peak_nm": peak.tolist()} for c, peak in zip(contacts, peaks, strict=True)]
    (folder / f"{take.name}.truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    np.savez_compressed(folder / f"{take.name}.truth.npz", tau_ext=run.tau_ext[::8].astype(np.float32))


def simulate_takes(maker: Maker, seed: int, raw: Path, takes: Sequence[Take], workers: int = 1) -> list[Path]:
    """The CSV files of these takes; written where there is no truth beside them yet."""
    raw.mkdir(parents=True, exist_ok=True)
    missing = [k for k, take in enumerate(takes) if not (raw / f"{take.name}.truth.npz").exists()]
    in_parallel(workers, write_take, [(maker, seed, number, raw, takes) for number in missing])
    return [raw / f"{take.name}.csv" for take in takes]


def make_dataset(
    maker: Maker,
    seed: int,
    folder: Path,
    takes: Sequence[Take],
    workers: int = 1,
    *,
    name: str = "data",
    more: Mapping[str, Sequence[str]] | None = None,
    **described: Any,
) -> Path:
    """FOLDER/NAME: simulated in FOLDER/csv and imported as described, unless it exists.

    Args:
        more: other CSV files of that folder, without their ending, by their part of the split.
        described: see description().
    """
    raw, data, more = folder / "csv", folder / name, more or {}
    if not data.is_dir():
        files = simulate_takes(maker, seed, raw, takes, workers)
        takes = [*takes, *(Take(one, part, 0) for part, names in more.items() for one in names)]
        arm = raw / f"arm-{name}.toml"
        arm.write_text(description(maker, seed, takes, **described))
        files += [raw / f"{one}.csv" for names in more.values() for one in names]
        tauext("import", "--source", *files, "--arm", arm, "--out", data)
    return data


def motor_temperature(arm: TrueArm, warm_from_s: float, samples: int, rng: np.random.Generator) -> np.ndarray:
    """What sensors in the motors say, (samples, joints), [degC]: they warm up sooner than the gears, and are coarse."""
    t = warm_from_s + np.arange(samples)[:, None] / RATE_HZ
    celsius = ROOM_C + RISE_K * -np.expm1(-t / (MOTOR_SOONER * arm.warm_s))
    noise = TEMPERATURE_NOISE_K * rng.standard_normal((samples, len(arm.coulomb_nm)))
    return np.round((celsius + noise) / TEMPERATURE_STEP_K) * TEMPERATURE_STEP_K


def description(
    maker: Maker, seed: int, takes: Sequence[Take], model: bool = True, temperature: bool = False, constants: Any = None
) -> str:
    """The text of arm.toml as its integrator would write it.

    Args:
        model: whether the maker gave a URDF.
        temperature: whether that of the motors is imported.
        constants: torque constants; None: off by up to 10 % or unknown.
    """
    warm = 'temperature = {columns = "temperature_{joint}", unit = "degC"}\n' if temperature else ""
    constants = told_constants(maker, seed, model) if constants is None else constants
    numbers = ", ".join(f'"{number}"' for number in range(1, len(maker.joints) + 1))
    return f"""\
[robot]
model = {json.dumps(str(maker.model.resolve()) if model else "")}
joints = {json.dumps(list(maker.joints))}
names = [{numbers}]

[time]
column = "time"

[signals]
q = {{columns = "position_{{joint}}", unit = "rad"}}
dq = {{columns = "{"velocity_{joint}" if maker.measured_velocity else ""}", unit = "rad/s"}}
tau = {{columns = "current_{{joint}}", unit = "A", torque_constant = {json.dumps(constants)}}}
{warm}
[contact]
column = "touched"

{split_text(takes, ".csv")}"""


def split_text(takes: Sequence[Take], ending: str) -> str:
    """[split] of arm.toml: the files of the takes, by their parts."""
    lines = ["[split]"]
    for part in ("train", "validation", "test", "collisions"):
        lines.append(f"{part} = {json.dumps([take.name + ending for take in takes if take.part == part])}")
    return "\n".join(lines) + "\n"


def nm_per_given(maker: Maker, seed: int, model: bool = True) -> np.ndarray:
    """True torque over that of an imported recording, (joints,)."""
    given = told_constants(maker, seed, model)
    return arm_of(maker, seed).nm_per_ampere / (1.0 if given == "unknown" else given)


def told_constants(maker: Maker, seed: int, model: bool) -> list[float] | str:
    """What the integrator believes: constants off by up to 10 %; "unknown" where a model may tell, as some makers say
    nothing. All arms of one type get those of its data sheet."""
    arm = arm_of(maker, seed)
    if maker.type_seed is not None:
        return list(maker.nm_per_ampere)
    wrong = maker.random(seed, 99).uniform(1 - KNOWN_TO, 1 + KNOWN_TO, len(maker.joints))
    return (arm.nm_per_ampere * wrong).round(3).tolist() if maker.constants_known or not model else "unknown"


def readings(maker: Maker, arm: TrueArm, run: Run, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions [rad] and currents [A] as encoders and drives measure them, each (samples, joints) at RATE_HZ."""
    ampere = low_pass(run.motor_nm / arm.nm_per_ampere, 1 / arm.current_filter_s, 1 / RATE_HZ)
    ampere += arm.current_noise_a * rng.standard_normal(ampere.shape)
    return encoder(run.q, 2**maker.encoder_bits), np.round(ampere / arm.current_step_a) * arm.current_step_a


def logged(
    maker: Maker, arm: TrueArm, run: Run, constants: np.ndarray | float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """t_ns, q, dq, tau at the controller's rate, as an import would have them; stamps do not jitter."""
    q, ampere = readings(maker, arm, run, rng)
    keep = slice(0, None, RATE_HZ // maker.rate_hz)
    signals = {"q": q, "dq": velocity(q, DRIVE_VELOCITY_RAD_S, 1 / RATE_HZ), "tau": ampere * constants}
    t_ns = np.arange(len(q), dtype=np.int64) * (1_000_000_000 // RATE_HZ)
    return {"t_ns": t_ns[keep]} | {name: np.ascontiguousarray(one[keep]) for name, one in signals.items()}


def write_csv(
    path: Path, maker: Maker, arm: TrueArm, run: Run, contacts: list[Contact], rng: np.random.Generator,
    celsius: np.ndarray,
) -> None:  # fmt: skip
    """What the controller logs at its own rate: stamps that jitter, and on some arms with samples missing.

    Args:
        celsius: temperature of the motors, (samples, joints).
    """
    import pyarrow as pa
    from pyarrow import csv

    q, ampere = readings(maker, arm, run, rng)
    keep = slice(0, None, RATE_HZ // maker.rate_hz)
    time_s = np.arange(len(q))[keep] / RATE_HZ
    jitter_s = maker.stamp_jitter_s * rng.standard_normal(len(time_s))
    jitter_s = np.clip(jitter_s, -LARGEST_JITTER / maker.rate_hz, LARGEST_JITTER / maker.rate_hz)
    columns = {"time": (time_s + jitter_s).round(6)}
    signals = {"position": q, "current": ampere, "temperature": celsius}
    if maker.measured_velocity:
        signals["velocity"] = velocity(q, DRIVE_VELOCITY_RAD_S, 1 / RATE_HZ)
    for name, signal in signals.items():
        for j in range(q.shape[1]):
            columns[f"{name}_{j + 1}"] = signal[keep, j].round(7)
    columns["touched"] = label(contacts, time_s)
    table = pa.table(columns)
    if maker.missing_share:
        table = table.filter(rng.uniform(size=len(time_s)) >= maker.missing_share)
    csv.write_csv(table, path)


def peak_nm(tau_ext: np.ndarray, contact: Contact) -> np.ndarray:
    """Largest torque of a contact at each joint, (joints,)."""
    rows = slice(round(contact.start_s * RATE_HZ), round(contact.end_s * RATE_HZ) + 1)
    return np.abs(tau_ext[rows]).max(axis=0)


def truth_of(recording: str, truths: Mapping[str, Sequence[dict]]) -> Sequence[dict]:
    """The contacts of the take that a recording is of: the import cuts long ones, TAKE-00, TAKE-01 ..."""
    return truths[recording if recording in truths else recording.rpartition("-")[0]]


def nearest(truth: Sequence[dict], label_s: float) -> dict:
    """The contact that a label at this time of its take stands for."""
    return min(truth, key=lambda one: abs(one["label_s"][0] - label_s))
