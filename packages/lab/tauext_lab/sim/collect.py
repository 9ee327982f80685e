"""Recordings and a dataset folder from the virtual rig."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from tauext.data.dataset import save_split, split_recordings
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.files.plain_file import FORMAT, json_of, read_text
from tauext.files.preflight import expect_folder, span
from tauext.files.provenance import VERSION, write_json
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.contacts import contact_torque, draw_pads, draw_pulses, pulse_torque
from tauext_lab.sim.other_friction import OtherRig, roll_out_other
from tauext_lab.sim.rig import Kind, Truth, arm_xml, build_scene, draw_motion, joint_names, measure, roll_out

# --- One recording of the virtual rig, from its seed to its measured signals.


KINDS: tuple[Kind, ...] = ("free", "pulses", "pads")
SETTLE_S = 1.0
"""Cut off the front: the arm starts on its setpoint, without the sag and the friction it will have."""


def simulate_recording(
    config: RigConfig, kind: Kind, length_s: float, seed: int, number: int, robot_sha256: str = ""
) -> Recording:
    """Simulate recording `number` of its kind; the same arguments give the same samples, whatever else is simulated."""
    moving, touching, measuring = (
        np.random.default_rng(stream)
        for stream in np.random.SeedSequence(seed, spawn_key=(KINDS.index(kind), number)).spawn(3)
    )
    settle = round(SETTLE_S * config.rate_hz)
    samples = round(length_s * config.rate_hz)
    q_des, dq_des = draw_motion(config.motion, len(config.links), samples + settle, config.rate_hz, moving)
    truth, tau_ext, force = simulate_motion(config, kind, q_des, dq_des, settle, touching)
    measured = measure(config, truth, tau_ext, measuring)
    touched = np.asarray((force > 0.0).any(axis=1))
    return Recording(
        name=f"{kind}-{number:03d}",
        joints=tuple(joint_names(config)),
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / config.rate_hz),
        **measured,
        tau_ext=tau_ext,
        q_des=q_des[settle:],
        contact=touched.astype(np.int8),
        contact_link=np.where(touched, force.argmax(axis=1), -1).astype(np.int8),
        rate_hz=float(config.rate_hz),
        torque_timing="held",
        source=f"virtual rig {config.name}",
        robot_sha256=robot_sha256,
        provenance={"contacts": "none" if kind == "free" else kind, "seed": seed, "number": number},
    )


def simulate_motion(
    config: RigConfig, kind: Kind, q_des: np.ndarray, dq_des: np.ndarray, settle: int, rng: np.random.Generator
) -> tuple[Truth, np.ndarray, np.ndarray]:
    """Simulate the motion along these setpoints (samples, joints), the first `settle` samples cut off.

    Returns: true signals; true external torque (samples, joints), [N m]; force on each link (samples, links), [N].
    """
    drives = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    if kind == "pulses":
        pulses = np.zeros((len(q_des), 3 * len(config.links)))
        pulses[settle:] = draw_pulses(config, q_des[settle:], rng)
        truth = _rolled(config, kind, q_des[0], np.hstack([drives, pulses])).after(settle)
        return truth, *pulse_torque(config, truth.q, pulses[settle:])
    free = _rolled(config, "free", q_des[0], drives)
    if kind == "free":
        truth = free.after(settle)
        return truth, np.zeros_like(truth.q), np.zeros_like(truth.q)
    pads = draw_pads(config, free.q, settle, rng)
    start = np.concatenate([q_des[0], pads[0, ::2]])
    truth = _rolled(config, kind, start, np.hstack([drives, pads])).after(settle)
    return truth, *contact_torque(config, truth.q, truth.touch)


def _rolled(config: RigConfig, kind: Kind, start: np.ndarray, controls: np.ndarray) -> Truth:
    if isinstance(config, OtherRig):
        return roll_out_other(config, kind, start, controls)
    return roll_out(config, build_scene(config, kind), start, controls)


# --- A dataset folder from the virtual rig: recordings, robot file, split and what made them.


LEAST_RECORDINGS = 20
"""Smallest number of free-motion recordings: whole recordings are dealt to train, validation and test."""
FIRST_CALIBRATION, FIRST_TEST = 1_000_000, 2_000_000
"""Numbers of recordings of free motion that are not of the split: their random streams are their own."""
BYTES_A_SAMPLE = 30.0
"""Size of a recording on disk, each joint: 37 are measured; the lower value keeps the disk check a lower bound."""
LEAST_LENGTH_S = 3.0
"""Shortest length of a recording: the observer's warm-up and the network's window take the first 1.5 s."""

Progress = Callable[[str, int, int], None]


def simulate_dataset(
    out_dir: Path,
    config: RigConfig,
    seed: int,
    minutes: float,
    collision_recordings: int,
    progress: Progress | None = None,
    calibration_hours: float = 0.0,
    test_hours: float = 0.0,
) -> None:
    """Write a dataset folder as docs/reference/files.md describes it.

    Every recording has random streams of its own and is written when it is whole: an interrupted run goes on where it
    stopped, and the files do not depend on the number of threads.

    Args:
        out_dir: made where it does not exist; may hold an interrupted or finished run of the same settings.
        minutes: free motion in all.
        collision_recordings: recordings with collisions, by pulses and by pads in turn.
        progress: called with what was just written, how many recordings are there, and how many there will be.
        calibration_hours: free motion beside the `minutes`, for limits alone.
        test_hours: more free motion to test on, beside that of the split.

    Raises:
        ConfigError: the folder holds another dataset, or recordings would be too short to be of use.
    """
    seconds = 60.0 * minutes + 3600.0 * (calibration_hours + test_hours)
    _expect_room(out_dir, config, seconds + config.collision_recording_s * collision_recordings)
    more = {"calibration": calibration_hours, "test": test_hours}
    sets = _planned(config, minutes, collision_recordings, more)
    takes = [take for set_name in sets for take in sets[set_name]]
    robot = arm_xml(config)
    robot_sha256 = hashlib.sha256(robot.encode()).hexdigest()
    started = time.monotonic()
    settings = {"minutes": minutes, "collision_recordings": collision_recordings}
    settings |= {f"{set_name}_hours": hours for set_name, hours in more.items() if hours > 0}
    _claim(out_dir, _settings(config, seed, settings))
    with atomic_write(out_dir / "robot.xml") as file:
        file.write_text(robot)

    def make(take: _Take) -> Kind:
        path = out_dir / take.name
        if not path.exists():
            save_recording(simulate_recording(config, take.kind, take.seconds, seed, take.number, robot_sha256), path)
        return take.kind

    try:
        _make_all(takes, make, progress)
    except BaseException:
        _unclaim(out_dir)
        raise
    names = {set_name: [take.name for take in sets[set_name]] for set_name in sets}
    split = split_recordings(names["free"], seed, minimum=LEAST_RECORDINGS, collisions=names["collisions"])
    more_test = (*split.test, *names["test"])
    save_split(replace(split, test=more_test, calibration=tuple(names["calibration"])), out_dir)
    write_json({"simulate": round(time.monotonic() - started, 3)}, out_dir / "wall_time_s.json")


def _make_all(takes: Sequence[_Take], make: Callable[[_Take], Kind], progress: Progress | None) -> None:
    """Make the recordings, one a core at the same time; an error or Ctrl-C ends those that have not begun."""
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        for done, future in enumerate(as_completed([pool.submit(make, take) for take in takes]), start=1):
            kind = future.result()
            if progress is not None:
                progress("free motion" if kind == "free" else f"collisions by {kind}", done, len(takes))
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class _Take:
    """A recording to make; the number selects its random streams."""

    name: str
    kind: Kind
    seconds: float
    number: int


def _planned(
    config: RigConfig, minutes: float, collision_recordings: int, more_hours: dict[str, float]
) -> dict[str, list[_Take]]:
    """Recordings by what they are for: free motion, collisions, and more motion for calibration and test."""
    count, length_s = _cut(minutes, config)
    touching: tuple[Kind, Kind] = ("pulses", "pads")
    sets = {
        "free": [_Take(f"free-{k:03d}.parquet", "free", length_s, k) for k in range(count)],
        "collisions": [
            _Take(f"collisions-{k:03d}.parquet", touching[k % 2], config.collision_recording_s, k)
            for k in range(collision_recordings)
        ],
    }
    for set_name, first in (("calibration", FIRST_CALIBRATION), ("test", FIRST_TEST)):
        sets[set_name] = [
            _Take(f"{set_name}-{k:04d}.parquet", "free", config.recording_s, first + k)
            for k in range(round(3600 * more_hours[set_name] / config.recording_s))
        ]
    return sets


def _expect_room(out_dir: Path, config: RigConfig, seconds: float) -> None:
    """Raise ConfigError unless the folder can be written to, and holds recordings of so many seconds in all."""
    size = BYTES_A_SAMPLE * config.rate_hz * len(config.drives) * seconds
    written = sum(path.stat().st_size for path in out_dir.glob("*.parquet")) if out_dir.is_dir() else 0
    expect_folder(out_dir, max(size - written, 0.0), f"a dataset of {span(seconds)}")


def _cut(minutes: float, config: RigConfig) -> tuple[int, float]:
    """How many recordings of free motion, and their length in seconds: at least twenty, of at most recording_s."""
    count = max(LEAST_RECORDINGS, round(60.0 * minutes / config.recording_s))
    length_s = 60.0 * minutes / count
    if length_s < LEAST_LENGTH_S:
        raise ConfigError(
            f"minutes = {minutes:g} must be >= {LEAST_RECORDINGS * LEAST_LENGTH_S / 60.0:g}: "
            f"{LEAST_RECORDINGS} recordings of at least {LEAST_LENGTH_S:g} s"
        )
    return count, length_s


def _settings(config: RigConfig, seed: int, settings: dict) -> dict:
    """All settings on which the recordings depend, as plain JSON."""
    settings = settings | {"config": asdict(config)}
    return {
        "format": FORMAT,
        "command": "simulate",
        "version": VERSION,
        "seed": seed,
        "settings": json.loads(json.dumps(settings)),
        "libraries": {name: version(name) for name in ("mujoco", "numpy", "pyarrow")},
    }


def _claim(out_dir: Path, settings: dict) -> None:
    """Make the folder, or check that it was made with these settings, which run.json holds."""
    run = out_dir / "run.json"
    if run.exists():
        try:
            found = json_of(read_text(run))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{run}: not readable ({error}); choose another folder") from error
        if found != settings:
            raise ConfigError(
                f"{out_dir}: holds a dataset of other settings ({_first_difference(found, settings)}); "
                "choose another folder or remove it"
            )
        return
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise ConfigError(f"{out_dir}: is not empty and holds no simulated dataset; choose another folder")
    out_dir.mkdir(parents=True, exist_ok=True)
    write_json(settings, run)


def _unclaim(out_dir: Path) -> None:
    """Where no recording came about, leave nothing that would block another simulation."""
    if not any(out_dir.glob("*.parquet")):
        for name in ("run.json", "robot.xml"):
            (out_dir / name).unlink(missing_ok=True)
        with suppress(OSError):  # not made here, and in use
            out_dir.rmdir()


def _first_difference(found: object, wanted: object, name: str = "run.json") -> str:
    """Where two JSON values differ first: `name: found, not wanted`."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted(wanted.keys() | found.keys()):
            if found.get(key) != wanted.get(key):
                return _first_difference(found.get(key), wanted.get(key), str(key))
    return f"{name}: {found}, not {wanted}"
