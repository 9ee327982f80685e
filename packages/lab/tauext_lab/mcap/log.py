"""Samples, estimates, forces and events of one arm as an MCAP file, which Foxglove, Rerun and PlotJuggler show.

All messages are standard types of ROS 2 with their definitions in the file, so a viewer needs no package. Joint values
are JointStates: every viewer plots them by the joint's name, and its `effort` is what they are, a torque. The arm is a
URDF with transforms, which all of these viewers draw; Rerun draws no markers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tauext import _core
from tauext.bundle.estimates import ALARMS, DECLARED, HEALTHS, lacking
from tauext.errors import ConfigError
from tauext.files.preflight import expect_new_file
from tauext.files.provenance import VERSION
from tauext.monitor.changes import Change
from tauext.monitor.event_stream import StatusClock
from tauext_lab.mcap.messages import LAST_NS, Template, cdr, definition, stamp
from tauext_lab.mcap.viewer_urdf import viewer_urdf
from tauext_lab.mcap.writer import McapWriter

DRAWN_HZ = 30.0
"""Rate of what is drawn: transforms, the arrow, and limits, which change slowly."""
M_PER_N = 0.002
"""Length of an arrow: 100 N are 20 cm."""
JOINT_STATE, WRENCH, TF = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped", "tf2_msgs/msg/TFMessage"
MARKERS, LOG = "visualization_msgs/msg/MarkerArray", "rcl_interfaces/msg/Log"
STRING, NUMBER = "std_msgs/msg/String", "std_msgs/msg/UInt8"
DELETE = 2  # action of a marker
ARROW_NUMBERS = 8
LEAST_M = 1e-4
"""Shortest arrow: viewers refuse a length of 0."""
NO_FORCE = np.full(3, np.nan)
TOUCH = "touch"
"""Frame at the place of the newest touch, its axes parallel to the base's."""


Rate = Literal["samples", "declared", "drawn"]
"""Samples with a message: all; those of `drawn`, and with a declared contact in effect; at DRAWN_HZ and at events."""


@dataclass(frozen=True)
class Shown:
    """A column of the estimates as a topic: a JointState whose effort is the column."""

    topic: str
    column: str
    text: str
    factor: float = 1.0
    rate: Rate = "drawn"


SHOWN = (
    Shown("tau_ext", "tau_ext", "torque, positive where the environment pushes the joint forwards", rate="samples"),
    Shown("declared", "declared_nm", "part of tau_ext that expected contacts explain", rate="declared"),
    Shown("band", "contact_sigma_nm", "two standard errors of tau_ext during and after a contact", 2.0),
    Shown("limit", "limit_nm", "|tau_ext| that nothing explains above it is a collision"),
    Shown("contact_limit", "contact_limit_nm", "|tau_ext| that nothing explains above it is a contact"),
)
"""A column more is a line more."""
STATES = {
    "health": ("health", HEALTHS),
    "alarm": ("alarm", ALARMS),
    "declared_state": ("declared", DECLARED),
}
"""Topics of columns that are numbers, with a word for each number."""
SIZES = {"size": ("declared_size", 1.0), "band": ("declared_sigma", 2.0), "moment": ("declared_moment_nm", 1.0)}
"""The declared contact in effect: series, column and factor."""
COLUMNS = (
    *dict.fromkeys([one.column for one in SHOWN] + [column for column, _ in [*SIZES.values(), *STATES.values()]]),
    *("declared_contact", "load_nm", "sigma_nm"),
)
"""Columns of Monitor.run that the file is made of."""
OF_FORCE = ("tau_ext", "load_nm", "sigma_nm", "contact_sigma_nm", "declared_size")
"""Those that a force is made of."""


def expect_log(path: Path) -> None:
    """Raise ConfigError unless an MCAP file can be made under this name, which nothing has yet."""
    if path.suffix != ".mcap":
        raise ConfigError(f"{path}: the name of an MCAP file ends in .mcap")
    expect_new_file(path)
    if path.exists():
        raise ConfigError(f"{path}: exists already; choose another name, or remove it")


class McapLog:
    """An MCAP file under its final name: what was written before a kill can be read."""

    def __init__(self, path: Path, bundle: _core.Bundle, source: str, frame: str | None = None):
        """
        Args:
            source: name of the source or the recording.
            frame: frame of the force; None: the load frame, else the last link.

        Raises:
            ConfigError: there is a file of this name, or none can be written.
        """
        expect_log(path)
        self.samples = 0
        """Samples in the file."""
        self._path, self._joints = path, tuple(link.joint_name for link in bundle.links)
        self._units = tuple(bundle.estimate_units)
        self._arm = Arm(bundle, frame) if any(link.mass > 0 for link in bundle.links) else None
        self._clock: StatusClock | None = None
        self._last_ns = 0
        self._contacts: dict[int, ForceAt] = {}
        """The force of each declared contact, by the monitor's number."""
        self._touched = NO_FORCE
        """Force of the touch that stands, along the base's axes."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = McapWriter(path, "ros2", f"tauext {VERSION}")
            self._add_channels(bundle, source)
        except OSError as error:
            raise self._refusal(error) from error

    @property
    def without(self) -> str:
        """What the file does not hold, and why; empty: it holds everything."""
        if self._arm is None:
            return "no arm, transforms and forces: the bundle has no model of the arm"
        return f"no forces: {self._arm.refused}" if self._arm.refused else ""

    def add(
        self,
        t_ns: np.ndarray,
        q: np.ndarray,
        dq: np.ndarray,
        tau: np.ndarray,
        estimates: Mapping[str, np.ndarray],
        changes: Sequence[Change],
    ) -> None:
        """Add successive samples, and write them.

        Args:
            t_ns: (rows,), [ns].
            q, dq, tau: (rows, joints), in the units of the source.
            estimates: their rows of Monitor.run.
            changes: at these samples.

        Raises:
            ConfigError: the disk is full or fails, or a stamp cannot be a time of ROS.
        """
        if len(t_ns) and (t_ns.min() < 0 or t_ns.max() > LAST_NS):
            raise ConfigError(f"{self._path}: stamps must be 0 to {LAST_NS} ns since 1970 in an MCAP file of ROS 2")
        try:
            self._add(t_ns, q, dq, tau, estimates, changes)
            self._writer.flush()
        except OSError as error:
            raise self._refusal(error) from error
        self.samples += len(t_ns)

    def close(self) -> None:
        """Write the summary of the file; remove a file without samples.

        Raises:
            ConfigError: the disk is full or fails.
        """
        try:
            self._writer.close()
            if not self.samples:
                self._path.unlink(missing_ok=True)
        except OSError as error:
            raise self._refusal(error) from error

    def _refusal(self, error: OSError) -> ConfigError:
        return ConfigError(f"{self._path}: cannot be written ({error.strerror or error})")

    # --- Topics.

    def _add_channels(self, bundle: _core.Bundle, source: str) -> None:
        channel, arm = self._channel, self._arm
        units = ", ".join(dict.fromkeys(bundle.torque_units))
        self._joint_states = channel("/joint_states", JOINT_STATE, f"samples of {source}; effort in {units}")
        self._sample = Template(JOINT_STATE, 3 * len(self._joints), self._measured)
        units = ", ".join(dict.fromkeys(self._units))
        without = lacking(bundle)
        self._shown = [
            (one, channel(f"/tauext/{one.topic}", JOINT_STATE, f"effort: {one.text}, in {units}"))
            for one in SHOWN
            if one.column not in without
        ]
        self._torque = Template(JOINT_STATE, len(self._joints), self._estimated)
        self._states = [
            (column, channel(f"/tauext/{topic}", NUMBER, _numbers(words))) for topic, (column, words) in STATES.items()
        ]
        text = "expected contact in effect: force [N], or torque of its joint, and two standard errors; moment [N m]"
        self._declared = channel("/tauext/declared_size", JOINT_STATE, text)
        self._sizes = Template(
            JOINT_STATE, len(SIZES), lambda at, values: {"header": {"stamp": at}, "name": SIZES, "effort": values}
        )
        self._events = channel("/tauext/events", LOG, f"bundle {bundle.name}")
        if arm is None:
            return
        self._tf, self._tf_static = channel("/tf", TF, "links"), channel("/tf_static", TF, "frames on links")
        self._description = channel("/robot_description", STRING, "links of the bundle as a URDF")
        if not arm.refused:
            acts = "of the environment on the arm, N and N m about the origin of its frame, along the frame's axes"
            self._wrench = channel("/tauext/wrench", WRENCH, f"force and moment {acts}")
            self._touch = channel(
                "/tauext/touch", WRENCH, f"force on the arm at its place, frame {TOUCH}, along the base's axes"
            )
            self._arrows = channel("/tauext/force", MARKERS, f"forces on the arm as arrows, {M_PER_N:g} m a N")

    def _channel(self, topic: str, kind: str, text: str) -> int:
        return self._writer.add_channel(topic, kind, definition(kind), {"tauext": text})

    def _measured(self, at: dict[str, int], values: list[float]) -> dict[str, Any]:
        n = len(self._joints)
        arrays = {"position": values[:n], "velocity": values[n : 2 * n], "effort": values[2 * n :]}
        return {"header": {"stamp": at}, "name": self._joints} | arrays

    def _estimated(self, at: dict[str, int], values: list[float]) -> dict[str, Any]:
        return {"header": {"stamp": at}, "name": self._joints, "effort": values}

    def _put(self, channel: int, kind: str, t_ns: int, fields: Mapping[str, Any]) -> None:
        """A single message."""
        self._writer.add(channel, np.array([t_ns]), np.frombuffer(cdr(kind, fields), np.uint8)[None])

    # --- Content.

    def _add(
        self,
        t_ns: np.ndarray,
        q: np.ndarray,
        dq: np.ndarray,
        tau: np.ndarray,
        estimates: Mapping[str, np.ndarray],
        changes: Sequence[Change],
    ) -> None:
        for change in changes:
            self._event(change)
        touched = self._touches(t_ns, changes)
        if not len(t_ns):
            return
        if self._clock is None:
            self._begin(int(t_ns[0]))
        put, drawn = self._writer.add, self._drawn(t_ns, changes)
        put(self._joint_states, t_ns, self._sample.fill(t_ns, np.concatenate([q, dq, tau], axis=1)))
        in_effect = estimates["declared_contact"] >= 0
        rates = {"samples": np.arange(len(t_ns)), "drawn": drawn}
        rates["declared"] = np.union1d(drawn, np.flatnonzero(in_effect))
        for one, channel in self._shown:
            rows = rates[one.rate]
            put(channel, t_ns[rows], self._torque.fill(t_ns[rows], rounded(one.factor * estimates[one.column][rows])))
        for column, channel in self._states:
            values = estimates[column][drawn].astype(np.uint8)
            put(channel, t_ns[drawn], np.pad(values[:, None], ((0, 0), (4, 0))) | ENCAPSULATION)
        sizes = np.stack([factor * estimates[column][in_effect] for column, factor in SIZES.values()], axis=1)
        put(self._declared, t_ns[in_effect], self._sizes.fill(t_ns[in_effect], rounded(sizes)))
        if (arm := self._arm) is None:
            return
        put(self._tf, t_ns[drawn], arm.transforms(t_ns[drawn], q[drawn]))
        if arm.refused:
            return
        which, is_drawn = estimates["declared_contact"], np.isin(np.arange(len(t_ns)), drawn)
        for number in np.unique(which).tolist():
            at, rows = self._contacts.get(number, arm.force), np.flatnonzero(which == number)
            found = at.find(q[rows], dq[rows], {name: estimates[name][rows] for name in OF_FORCE})
            force, moment = (rounded(part) for part in found)
            known, shown = np.isfinite(force).all(axis=1), is_drawn[rows]
            wrenches = np.concatenate([force, moment], axis=1)[known]
            put(self._wrench, t_ns[rows[known]], at.wrench.fill(t_ns[rows[known]], wrenches))
            for some, messages in at.arrows(t_ns[rows[shown]], force[shown], touched[rows[shown]]):
                put(self._arrows, t_ns[rows[shown][some]], messages)

    def _begin(self, t_ns: int) -> None:
        """What is written once."""
        self._clock = StatusClock(t_ns, round(1e9 / DRAWN_HZ))
        if self._arm is not None:
            self._put(self._description, STRING, t_ns, {"data": self._arm.urdf})
            self._put(self._tf_static, TF, t_ns, {"transforms": self._arm.fixed(t_ns)})

    def _drawn(self, t_ns: np.ndarray, changes: Sequence[Change]) -> np.ndarray:
        """Rows at DRAWN_HZ, and those with a change."""
        if t_ns[0] < self._last_ns or self._clock is None:  # the clock of the source started again
            self._clock = StatusClock(int(t_ns[0]), round(1e9 / DRAWN_HZ))
        self._last_ns = int(t_ns[-1])
        at = np.isin(t_ns, [change.t_ns for change in changes])
        at[self._clock.rows(t_ns)] = True
        return np.flatnonzero(at)

    def _event(self, change: Change) -> None:
        """Words of the event, and the force of a touch."""
        t_ns = change.t_ns
        for words in change.words(self._joints, self._units):
            log = {"stamp": stamp(t_ns), "level": change.urgency, "name": "tauext", "msg": words}
            self._put(self._events, LOG, t_ns, log)
        if self._arm is None or self._arm.refused:
            return
        if change.declared is not None:
            which, bounds = change.declared
            known = self._contacts.get(which)
            if known is None or known.contact != bounds:  # numbers are used again
                self._contacts[which] = self._arm.force_of(bounds)
        if (place := change.touched) is not None:
            self._put(self._tf, TF, t_ns, {"transforms": [self._arm.touched_at(t_ns, place.point)]})
            self._put(self._touch, WRENCH, t_ns, wrench_fields(stamp(t_ns), TOUCH, [*place.force, 0.0, 0.0, 0.0]))

    def _touches(self, t_ns: np.ndarray, changes: Sequence[Change]) -> np.ndarray:
        """Force of the touch that stands at these samples, (rows, 3); NaN without one."""
        held = np.full((len(t_ns), 3), self._touched)
        for change in changes:
            if (place := change.touched) is not None:
                self._touched = np.array(place.force)
            elif change.ends_alarm and change.raised is None:
                self._touched = NO_FORCE
            else:
                continue
            held[t_ns >= change.t_ns] = self._touched
        return held


def rounded(values: np.ndarray) -> np.ndarray:
    """To the precision of single floats, as in files of estimates: zeros at the end of a number take no space."""
    return values.astype(np.float32).astype(float)


ENCAPSULATION = np.array([0, 1, 0, 0, 0], np.uint8)
"""First bytes of CDR, little-endian; the message is the byte after them."""


def _numbers(words: Sequence[str]) -> str:
    return ", ".join(f"{number} {word}" for number, word in enumerate(words))


# --- The arm: its links and frames, and the force at one frame.


class Arm:
    """The links of a bundle as transforms and a URDF, and the forces at its frames."""

    def __init__(self, bundle: _core.Bundle, frame: str | None = None):
        """frame: None: the load frame, else the last link."""
        self._links, self._model = bundle.links, _core.WrenchModel(bundle)
        self.refused = self._model.refused
        """Reason for which no force can be estimated; empty: none."""
        self._frames = self._model.frames
        names = [one.name for one in self._frames]
        self.base = "base" if "base" not in names else "tauext_base"
        self.force = ForceAt(self._model, frame or names[min(len(self._links), len(names) - 1)])
        """The force where no declared contact is in effect."""
        self.urdf = viewer_urdf(self._links, bundle.capsules, self._frames, self.base)
        self._turns = np.array([quaternion(np.reshape(link.rotation, (3, 3))) for link in self._links])
        self._moved = Template(TF, 7 * len(self._links), self._transforms)

    def force_of(self, contact: _core.DeclaredContact) -> ForceAt:
        """The force of a declared contact; of one of a joint the usual one."""
        return ForceAt(self._model, contact.frame, contact) if contact.frame else self.force

    def transforms(self, t_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Messages with the pose of each link in its parent at these positions, (rows, bytes)."""
        poses = np.empty((len(q), len(self._links), 7))
        for j, link in enumerate(self._links):
            turn = np.reshape(link.rotation, (3, 3))
            slides = link.type == _core.JointType.prismatic
            shift, half = (q[:, j], 0 * q[:, j]) if slides else (0 * q[:, j], q[:, j] / 2)
            poses[:, j, :3] = link.translation + shift[:, None] * turn[:, 2]
            x, y, z, w = self._turns[j]
            s, c = np.sin(half), np.cos(half)
            poses[:, j, 3:] = np.stack([x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s], axis=1)
        return self._moved.fill(t_ns, poses.reshape(len(q), 7 * len(self._links)))

    def fixed(self, t_ns: int) -> list[dict[str, Any]]:
        """Transforms of the frames that are fixed to links."""
        at, joints = stamp(t_ns), [link.joint_name for link in self._links]
        return [
            transform(at, joints[one.link], one.name, [*one.translation, *quaternion(np.reshape(one.rotation, (3, 3)))])
            for one in self._frames[len(joints) :]
        ]

    def touched_at(self, t_ns: int, point: Sequence[float]) -> dict[str, Any]:
        """Transform of the frame TOUCH; point: in the base's frame, [m]."""
        return transform(stamp(t_ns), self.base, TOUCH, [*point, 0.0, 0.0, 0.0, 1.0])

    def _transforms(self, at: dict[str, int], values: list[float]) -> dict[str, Any]:
        names = [link.joint_name for link in self._links]
        parents = [self.base if link.parent < 0 else names[link.parent] for link in self._links]
        each = zip(parents, names, range(0, len(values), 7), strict=True)
        return {"transforms": [transform(at, parent, name, values[k : k + 7]) for parent, name, k in each]}


class ForceAt:
    """The force that acts on the arm at a frame, and its messages."""

    def __init__(self, model: _core.WrenchModel, frame: str, contact: _core.DeclaredContact | None = None):
        """contact: a declared contact at this frame, whose force is the one that acts; None: force and moment."""
        self.frame, self.contact = frame, contact
        self._model = model
        self._point = np.zeros(3) if contact is None else np.array(contact.point)
        self.wrench = Template(WRENCH, 6, lambda at, values: wrench_fields(at, frame, values))
        self._arrows = {
            shown: Template(MARKERS, ARROW_NUMBERS * sum(shown), partial(self._arrow_fields, shown))
            for shown in product((False, True), (False, True))
        }

    def find(self, q: np.ndarray, dq: np.ndarray, estimates: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Force [N], and moment [N m] about the frame's origin, along the frame's axes, (rows, 3) each; NaN: unknown.

        Of a declared contact the force along its line, else at its point; with a moment only if one is declared.
        """
        contact = self.contact
        if contact is not None and not contact.at_most_nm and contact.half_angle_deg == 0 and any(contact.axis):
            axis = np.array(contact.axis) / np.linalg.norm(contact.axis)
            ways = np.tile(axis, (len(q), 1))
            if contact.axes == _core.WrenchAxes.base:
                turns = np.array([self._model.pose(self.frame, one.tolist())[0] for one in q])
                ways = np.einsum("kij,i->kj", turns, axis)
            force = estimates["declared_size"][:, None] * ways
            return force, np.cross(self._point, force)
        alone = contact is not None and not contact.at_most_nm
        rows = (q, estimates["tau_ext"] - estimates["load_nm"], estimates["sigma_nm"])
        point, own = self._point.tolist() if alone else None, _core.WrenchAxes.frame
        found = self._model.wrenches(self.frame, *rows, point, own, estimates["contact_sigma_nm"], dq)
        return found["force"], found["moment"]

    def arrows(
        self, t_ns: np.ndarray, force: np.ndarray, touched: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Messages with the arrows that are known, and their rows; each message has all that stand.

        Args:
            force: along the frame's axes, (rows, 3), [N].
            touched: at the frame TOUCH.
        """
        known = [np.isfinite(one).all(axis=1) for one in (force, touched)]
        tips = (self._point, np.zeros(3))
        for shown, template in self._arrows.items():
            rows = np.flatnonzero((known[0] == shown[0]) & (known[1] == shown[1]))
            if not len(rows):
                continue
            each = zip((force, touched), tips, shown, strict=True)
            numbers = [arrows_of(one[rows], tip) for one, tip, is_shown in each if is_shown]
            yield rows, template.fill(t_ns[rows], np.concatenate(numbers, axis=1) if numbers else None)

    def _arrow_fields(self, shown: tuple[bool, bool], at: dict[str, int], values: list[float]) -> dict[str, Any]:
        """Both markers; one that is not shown is deleted."""
        markers, left = [], iter(values)
        for frame, is_shown in zip((self.frame, TOUCH), shown, strict=True):
            numbers = [next(left) for _ in range(ARROW_NUMBERS)] if is_shown else None
            markers.append(arrow_fields(at, frame, numbers))
        return {"markers": markers}


def transform(at: dict[str, int], parent: str, child: str, pose: Sequence[float]) -> dict[str, Any]:
    """Fields of a geometry_msgs/TransformStamped; pose: x, y, z and the quaternion x, y, z, w."""
    placed = {"translation": xyz(pose[:3]), "rotation": dict(zip("xyzw", pose[3:], strict=True))}
    return {"header": {"stamp": at, "frame_id": parent}, "child_frame_id": child, "transform": placed}


def wrench_fields(at: dict[str, int], frame: str, values: Sequence[float]) -> dict[str, Any]:
    """Fields of a WrenchStamped; values: force, then moment."""
    wrench = {"force": xyz(values[:3]), "torque": xyz(values[3:])}
    return {"header": {"stamp": at, "frame_id": frame}, "wrench": wrench}


def arrows_of(force: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """Arrows with their tips at a point: tail, turn from x to the force as a quaternion, length, (rows, 8)."""
    size = np.linalg.norm(force, axis=1, keepdims=True)
    x, y, z = (force / np.maximum(size, 1e-12)).T
    turn = np.stack([np.zeros_like(x), -z, y, 1 + x], axis=1)
    turn[x < -1 + 1e-9] = [0.0, 0.0, 1.0, 0.0]
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return np.concatenate([tip - M_PER_N * force, turn, np.maximum(M_PER_N * size, LEAST_M)], axis=1)


def arrow_fields(at: dict[str, int], frame: str, numbers: Sequence[float] | None) -> dict[str, Any]:
    """Fields of a marker; numbers: of arrows_of(); None: no arrow."""
    name = TOUCH if frame == TOUCH else "force"
    marker: dict[str, Any] = {"header": {"stamp": at, "frame_id": frame}, "ns": name, "frame_locked": True}
    if numbers is None:
        return marker | {"action": DELETE}
    red, green, blue = (0.85, 0.15, 0.1) if frame == TOUCH else (0.1, 0.4, 0.85)
    pose = {"position": xyz(numbers[:3]), "orientation": dict(zip("xyzw", numbers[3:7], strict=True))}
    scale = {"x": numbers[7], "y": 0.012, "z": 0.025}
    return marker | {"pose": pose, "scale": scale, "color": {"r": red, "g": green, "b": blue, "a": 1.0}}


def xyz(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def quaternion(rotation: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation matrix: the eigenvector of the largest eigenvalue of a symmetric matrix of its entries
    (Bar-Itzhack, JGCD 23, 2000)."""
    r = rotation
    rows = [
        [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
        [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
        [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
    ]
    found: list[float] = np.linalg.eigh(np.array(rows, float))[1][:, -1].tolist()  # of the lower triangle
    return found if found[3] >= 0 else [-one for one in found]
