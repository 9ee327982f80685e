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
from tauext.data.free_motion import cut
from tauext.data.importing import import_dataset
from tauext.data.recording import FLAGS, Recording
from tauext.data.recording import SIGNALS as ALL_SIGNALS
from tauext.robot.inertial import point_inertia, six_of, with_more_at_end

SIGNALS = ("q", "dq", "tau")


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
        step = int(change.size)  # every so manieth row alone
        return replace(cut(recording, slice(None, None, step)), rate_hz=recording.rate_hz / step)
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
        tries = rng.integers(0, max(1, samples - count), 20)
        moved = [np.ptp(recording.q[at : at + count, joints], axis=0).max() for at in tries]
        begin = int(tries[int(np.argmax(moved))])
        return slice(begin, begin + count), 1.0
    return slice(0, samples), 1.0


def _time_unit(recording: Recording, size: float) -> Recording:
    """Stamps counted from the first, times the size; the nominal rate follows, as an import takes it from them."""
    steps = np.round((recording.t_ns - recording.t_ns[0]) * size).astype(np.int64)
    return replace(recording, t_ns=recording.t_ns[0] + steps, rate_hz=recording.rate_hz / size)


def with_load(recording: Recording, tree: _core.Tree, share: float) -> Recording:
    """The recording as if a ball of 5 cm and this share of the arm's moving mass were carried at its end, on the same
    path: dp/dt + beta of the arm with the ball less that without it, of smooth positions."""
    mass = share * sum(link.mass for link in tree.links)
    at = 2 * np.array(tree.links[-1].com)  # twice the way to the link's centre of mass is about its end
    inertia = point_inertia(mass, at) + 0.4 * mass * 0.05**2 * np.eye(3)
    loaded = with_more_at_end(tree, np.r_[mass, mass * at, six_of(inertia)])
    time_s = recording.time_s
    q = sosfiltfilt(butter(2, 10.0, fs=recording.rate_hz, output="sos"), recording.q, axis=0)
    dq = np.gradient(q, time_s, axis=0)
    (p, beta), (p_bare, beta_bare) = loaded.momentum(q, dq), tree.momentum(q, dq)
    torque = np.gradient(p - p_bare, time_s, axis=0) + beta - beta_bare
    return replace(recording, tau=recording.tau + torque)


def as_if_of(donor: Recording, own: Recording) -> Recording:
    """The donor under the joints, robot and rate of a dataset's own recording: someone named the wrong file."""
    time_s = np.arange(int(donor.duration_s * own.rate_hz)) / own.rate_hz
    signals = {
        name: np.column_stack([np.interp(time_s, donor.time_s, column) for column in getattr(donor, name).T])
        for name in SIGNALS
    }
    nothing = dict.fromkeys(set(ALL_SIGNALS) | set(FLAGS))
    return replace(own, **(nothing | {"t_ns": np.round(time_s * 1e9).astype(np.int64)} | signals))


def other_rig(robot_sha256: str) -> dict[str, Recording]:
    """Recordings of another planar arm, and of the rig with 1.6 times the friction."""
    links = (LinkConfig(0.4, 11.0, 0.18, 0.18, 0.12, 0.6), LinkConfig(0.25, 6.0, 0.11, 0.11, 0.05, 0.25))
    arms = {"arm": RigConfig(links=links), "friction": changed_rig(20, 1.6)}
    return {
        name: simulate_recording(config, "free", 30.0, 7, 500 + k, robot_sha256)
        for k, (name, config) in enumerate(arms.items())
    }


def cut_to(donor: Recording, own: Recording) -> Recording:
    """The donor's first samples, as long as the recording in whose place it stands, under its name."""
    part = cut(donor, slice(min(donor.samples, own.samples)))
    return replace(part, name=own.name, robot_sha256=own.robot_sha256)


Spans = dict[str, list[list[float]]]


def broken_intervals(spans: Spans, file: str, what: str, size: float, rng: np.random.Generator) -> Spans:
    """[contact.intervals] with one thing wrong about this file's: label-dropped, label-shifted by `size` s, ..."""
    own, others = spans[file], [of for name, of in spans.items() if name != file]
    one, misspelt = int(rng.integers(len(own))), file.replace("-", "_") if "-" in file else f"{file}s"
    new: dict[str, Spans] = {
        "label-dropped": {file: [*own[:one], *own[one + 1 :]]},
        "label-all-dropped": {file: []},
        "label-shifted": {file: [[max(0.0, start + size), max(0.1, end + size)] for start, end in own]},
        "label-other-file": {file: others[0] if others else []},
        "label-beyond": {file: [[start + 1000.0, end + 1000.0] for start, end in own]},
        "label-milliseconds": {file: [[1e3 * start, 1e3 * end] for start, end in own]},
        "label-misspelt": {file: [], misspelt: own},
    }
    return {name: of for name, of in (spans | new[what]).items() if of}


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
