"""What a mutation does to a recording: each changes what it names and nothing else."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import LinkConfig, RigConfig, changed_rig

from tauext import _core
from tauext.data.importing import import_dataset
from tauext.data.recording import Recording

SIGNALS = ("q", "dq", "tau")
STUCK_TRIES = 20


@dataclass(frozen=True)
class Facts:
    """What a mutation's size is measured by, joint by joint, of a dataset's training recordings."""

    largest: dict[str, np.ndarray]
    """|dq| [rad/s] and |tau| [N m], (n,)."""
    nm_per_ampere: np.ndarray
    """Of the drives: what a torque is divided by that is logged as a current, (n,)."""


@dataclass(frozen=True)
class Change:
    """One mutation of a recording."""

    what: str
    """A case of `changed`, or one of cases.py: load, donor-NAME, label-WHAT."""
    signals: tuple[str, ...] = SIGNALS
    joints: tuple[int, ...] = ()
    """None: all."""
    size: float = 0.0
    length: float = 0.0
    """Samples of a spike; seconds of a signal that is stuck, infinite: all of them."""


def facts_of(recordings: Sequence[Recording], nm_per_ampere: Sequence[float]) -> Facts:
    largest = {s: np.max([np.abs(getattr(r, s)).max(axis=0) for r in recordings], axis=0) for s in ("dq", "tau")}
    return Facts(largest, np.array(nm_per_ampere))


def changed(recording: Recording, change: Change, facts: Facts, rng: np.random.Generator) -> Recording:
    """The recording after the mutation; its name, and what it does not name, stay.

    Raises:
        RecordingError: no recording may be so.
    """
    if change.what == "time-unit":
        return _time_unit(recording, change.size)
    if change.what == "thinned":
        return _thinned(recording, int(change.size))
    joints, size, time_s = list(change.joints) or list(range(len(recording.joints))), change.size, recording.time_s
    rows, sign = _rows_of(recording, change, joints, rng)
    signals = {name: getattr(recording, name).copy() for name in change.signals}
    for name, values in signals.items():
        match change.what:
            case "factor":  # another unit, or the opposite sign
                values[:, joints] *= size
            case "amperes":  # currents that stand as torques
                values[:, joints] /= facts.nm_per_ampere[joints]
            case "exchange":  # two joints' columns, one for the other
                values[:, joints] = values[:, joints[::-1]]
            case "zero":  # positions count from elsewhere, by so many rad
                values[:, joints] += size
            case "delay":  # later by so many seconds than the other signals
                for j in joints:
                    values[:, j] = np.interp(time_s - size, time_s, values[:, j])
            case "stuck":
                values[rows, joints] = values[rows.start, joints]
            case "spike" if name == "q":  # a position is off by rad
                values[rows, joints] += sign * size
            case "spike":  # a velocity or torque is so many times the largest
                values[rows, joints] = sign * size * facts.largest[name][joints]
            case _:
                raise KeyError(change.what)
    return replace(recording, **signals)


def _rows_of(recording: Recording, change: Change, joints: list[int], rng: np.random.Generator) -> tuple[slice, float]:
    """The rows that are spiked or stuck, and the sign of a spike."""
    samples, first = recording.samples, recording.samples // 10
    if change.what == "spike":
        count = int(change.length)
        begin = int(rng.integers(first, max(first + 1, samples - count)))
        return slice(begin, begin + count), float(rng.choice([-1, 1]))
    if change.what == "stuck" and np.isfinite(change.length):  # where the joint moves most, of some places
        count = min(round(change.length * recording.rate_hz), samples)
        tries = rng.integers(0, max(1, samples - count), STUCK_TRIES)
        moved = [np.ptp(recording.q[at : at + count, joints], axis=0).max() for at in tries]
        begin = int(tries[int(np.argmax(moved))])
        return slice(begin, begin + count), 1.0
    return slice(0, samples), 1.0


def _time_unit(recording: Recording, size: float) -> Recording:
    """Stamps counted from the first, times the size; the nominal rate follows, as an import takes it from them."""
    steps = np.round((recording.t_ns - recording.t_ns[0]) * size).astype(np.int64)
    return replace(recording, t_ns=recording.t_ns[0] + steps, rate_hz=recording.rate_hz / size)


def _thinned(recording: Recording, step: int) -> Recording:
    """Every so manieth row alone."""
    signals = {
        name: values[::step]
        for name in (*SIGNALS, "t_ns", "tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature", "contact",
                     "contact_link")
        if (values := getattr(recording, name)) is not None
    }  # fmt: skip
    return replace(recording, rate_hz=recording.rate_hz / step, **signals)


SMOOTH_HZ = 10.0
LOAD_RADIUS_M = 0.05
DONOR_S = 30.0


def with_load(recording: Recording, tree: _core.Tree, share: float) -> Recording:
    """The recording as if a ball of this share of the arm's moving mass were carried at its end, on the same path.

    dp/dt + beta of the arm with the ball less that without it, of smooth positions.
    """
    links = tree.links
    mass = share * sum(link.mass for link in links)
    last = links[-1]
    # Twice the way to the link's centre of mass is about its end.
    at = 2 * np.array(last.com)
    both = (last.mass * np.array(last.com) + mass * at) / (last.mass + mass)
    xx, yy, zz, xy, xz, yz = last.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + 0.4 * mass * LOAD_RADIUS_M**2 * np.eye(3)
    for one, place in ((last.mass, np.array(last.com)), (mass, at)):
        arm = place - both
        inertia += one * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    last.mass, last.com = last.mass + mass, both.tolist()
    last.inertia = [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    loaded = _core.Tree(links, tree.gravity)
    time_s = recording.time_s
    sos = butter(2, SMOOTH_HZ, fs=recording.rate_hz, output="sos")
    q = sosfiltfilt(sos, recording.q, axis=0)
    dq = np.gradient(q, time_s, axis=0)
    (p, beta), (p_bare, beta_bare) = loaded.momentum(q, dq), tree.momentum(q, dq)
    torque = np.gradient(p - p_bare, time_s, axis=0) + beta - beta_bare
    return replace(recording, tau=recording.tau + torque)


def as_if_of(donor: Recording, own: Recording) -> Recording:
    """The donor under the joints, robot and rate of a dataset's own recording: someone named the wrong file."""
    time_s = np.arange(int(donor.duration_s * own.rate_hz)) / own.rate_hz
    signals = {
        name: np.column_stack([np.interp(time_s, donor.time_s, column) for column in getattr(donor, name).T])
        for name in ("q", "dq", "tau")
    }
    own_signals = {name: None for name in ("tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature", "contact",
                                           "contact_link")}  # fmt: skip
    return replace(own, t_ns=np.round(time_s * 1e9).astype(np.int64), **(own_signals | signals))


def other_rig(robot_sha256: str) -> dict[str, Recording]:
    """Recordings of another planar arm, and of the rig with 1.6 times the friction."""
    arms = {
        "arm": RigConfig(
            links=(LinkConfig(0.4, 11.0, 0.18, 0.18, 0.12, 0.6), LinkConfig(0.25, 6.0, 0.11, 0.11, 0.05, 0.25))
        ),
        "friction": changed_rig(20, 1.6),
    }
    return {
        name: simulate_recording(config, "free", DONOR_S, 7, 500 + k, robot_sha256)
        for k, (name, config) in enumerate(arms.items())
    }


def cut_to(donor: Recording, own: Recording) -> Recording:
    """The donor's first samples, as long as the recording in whose place it stands, under its name."""
    count = min(donor.samples, own.samples)
    signals = {
        name: values[:count]
        for name in ("t_ns", "q", "dq", "tau", "tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "contact",
                     "contact_link", "temperature")
        if (values := getattr(donor, name)) is not None
    }  # fmt: skip
    return replace(donor, name=own.name, robot_sha256=own.robot_sha256, **signals)


Spans = dict[str, list[list[float]]]
BEYOND_S = 1000.0


def broken_intervals(spans: Spans, file: str, what: str, size: float, rng: np.random.Generator) -> Spans:
    """[contact.intervals] with one thing wrong about this file's.

    Args:
        what: label-dropped, label-all-dropped, label-shifted by `size` s, label-other-file, label-beyond the end,
            label-milliseconds, label-misspelt.
    """
    new = {name: [list(span) for span in of] for name, of in spans.items()}
    others = [name for name in spans if name != file]
    if what == "label-dropped":
        del new[file][int(rng.integers(len(new[file])))]
    elif what == "label-all-dropped":
        del new[file]
    elif what == "label-shifted":
        new[file] = [[max(0.0, start + size), max(0.1, end + size)] for start, end in new[file]]
    elif what == "label-other-file":
        new[file] = new[others[0]] if others else []
    elif what == "label-beyond":
        new[file] = [[start + BEYOND_S, end + BEYOND_S] for start, end in new[file]]
    elif what == "label-milliseconds":
        new[file] = [[1e3 * start, 1e3 * end] for start, end in new[file]]
    else:
        assert what == "label-misspelt"
        new[file.replace("-", "_") if "-" in file else f"{file}s"] = new.pop(file)
    return {name: of for name, of in new.items() if of}


def broken_flags(recording: Recording, other: Recording, what: str, size: float, rng: np.random.Generator) -> Recording:
    """The same in a recording's own column; `other` is the recording whose labels it gets by mistake."""
    assert recording.contact is not None
    contact = recording.contact.copy()
    if what == "label-dropped":
        edges = np.flatnonzero(np.diff((contact == 1).astype(int), prepend=0, append=0))
        pick = 2 * int(rng.integers(len(edges) // 2))
        contact[edges[pick] : edges[pick + 1]] = 0
    elif what == "label-all-dropped":
        contact[:] = 0
    elif what == "label-shifted":
        rows = round(size * recording.rate_hz)
        contact = np.roll(contact, rows)
        contact[slice(rows) if rows >= 0 else slice(rows, None)] = 0
    else:
        assert what == "label-other-file" and other.contact is not None
        contact[:] = np.resize(other.contact, len(contact))
    return replace(recording, contact=contact, contact_link=None)


def imported(toml: Path, change: Callable[[Spans, list[str]], Spans], folder: Path) -> None:
    """Import the training sources of a description, its intervals changed, into this folder.

    Args:
        change: takes the intervals of all files, and the training sources.

    Raises:
        TauextError: the import refuses.
    """
    text = toml.read_text()
    content = tomllib.loads(text)
    sources = list(content["split"]["train"])
    spans = {name: of for name, of in content["contact"]["intervals"].items() if name in sources}
    lines = [f"{json.dumps(name)} = {json.dumps(of)}" for name, of in change(spans, sources).items()]
    text = re.sub(r"(?s)\[contact\.intervals\].*?(?=\n\[)", "\n".join(["[contact.intervals]", *lines, ""]), text)
    text = re.sub(r"(?s)\[split\].*", f"[split]\ntrain = {json.dumps(sources)}\n", text)
    arm = toml.with_name(f"{folder.parent.name}-{folder.name}.toml")  # the description's paths are relative to it
    arm.write_text(text)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        import_dataset([toml.with_name(name) for name in sources], arm, folder, "tauext", lambda line: None)
    finally:
        arm.unlink()


EVERY_S, LENGTH_S = 1.5, (0.1, 0.4)
FIRST_S = 1.5
"""The observer is warm."""
SIZES = (0.1, 1.0)
"""Of the torque that a joint usually stays below: some are found and some are not."""


def pushed(recording: Recording, usual_nm: np.ndarray, seed: Sequence[int]) -> Recording:
    """The recording as if pushes acted on it: half sines of joint torque, which the motor gives besides, and labels.

    The drive of a stiff arm keeps its path, so that positions and velocities stay and tau gains the opposite of the
    external torque. A push on a link turns the joints before it; the farther ones less, by chance.
    """
    rng = np.random.default_rng(list(seed))
    tau_ext = np.zeros_like(recording.tau)
    contact = np.zeros(recording.samples, dtype=np.int8)
    time_s = recording.time_s
    for slot_s in np.arange(FIRST_S, recording.duration_s - EVERY_S, EVERY_S):
        start_s, length_s = slot_s + rng.uniform(0, EVERY_S - LENGTH_S[1] - 0.5), rng.uniform(*LENGTH_S)
        inside = (time_s >= start_s) & (time_s <= start_s + length_s)
        last = int(rng.integers(len(recording.joints)))
        share = float(np.exp(rng.uniform(*np.log(SIZES))))
        size = share * usual_nm * rng.uniform(-1, 1, len(usual_nm)) * (np.arange(len(usual_nm)) < last)
        size[last] = share * usual_nm[last] * rng.choice([-1, 1])
        tau_ext[inside] = np.sin(np.pi * (time_s[inside, None] - start_s) / length_s) * size
        contact[inside] = 1
    return replace(recording, tau=recording.tau - tau_ext, tau_ext=tau_ext, contact=contact)
