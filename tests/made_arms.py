"""Arms and settings that tests share: two written out by hand, and arms of realistic numbers as URDF.

URDF, so that every oracle reads the same text.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.robot.read import load_tree

IDENTITY = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
ROTOR_INERTIA = (0.6, 0.3)

PLANAR_MJCF = f"""
<mujoco>
  <option timestep="0.001" gravity="0 -9.81 0" integrator="Euler"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 0 1" armature="{ROTOR_INERTIA[0]}"/>
      <inertial pos="0.12079 0 0" mass="8.191" diaginertia="0.06 0.06 0.06"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" type="hinge" axis="0 0 1" armature="{ROTOR_INERTIA[1]}"/>
        <inertial pos="0.16078 0 0" mass="9.920" diaginertia="0.07 0.07 0.07"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def planar_arm() -> _core.Tree:
    """The paper's two links in the x-y plane, gravity along -y: the same arm as PLANAR_MJCF."""
    links = []
    for k, (name, mass, com, inertia) in enumerate(
        (("shoulder", 8.191, 0.12079, 0.06), ("elbow", 9.920, 0.16078, 0.07))
    ):
        link = _core.Link()
        link.joint_name, link.parent, link.rotation = name, k - 1, IDENTITY
        link.translation = [0.3 * k, 0, 0]
        link.mass, link.com, link.inertia = mass, [com, 0, 0], [inertia, inertia, inertia, 0, 0, 0]
        link.rotor_inertia = ROTOR_INERTIA[k]
        links.append(link)
    return _core.Tree(links, [0, -9.81, 0])


def planar_torque(q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """What the planar arm's drives exert without friction at 125 Hz, averaged: r of an observer that is fast enough."""
    t_ns = np.arange(len(q), dtype=np.int64) * 8_000_000
    fast = _core.ObserverSettings(
        gain_per_s=1e4, timing=_core.TorqueTiming.averaged, sample_period_ns=8_000_000, network_stride=1
    )
    return _core.observe(planar_arm(), fast, t_ns, q, dq, np.zeros_like(q)).residual


def prismatic_mass(mass: float) -> _core.Tree:
    """One mass that slides along z, without gravity."""
    link = _core.Link()
    link.joint_name, link.type, link.rotation, link.mass = "slide", _core.JointType.prismatic, IDENTITY, mass
    return _core.Tree([link], [0, 0, 0])


def no_model(tree: _core.Tree) -> _core.Tree:
    links = []
    for link in tree.links:
        link.mass = link.rotor_inertia = 0.0
        link.inertia = [0.0] * 6
        links.append(link)
    return _core.Tree(links, tree.gravity)


def settings(timing: str = "held", rate_hz: float = 1000.0, gain_per_s: float = 20.0) -> _core.ObserverSettings:
    return _core.ObserverSettings(
        gain_per_s=gain_per_s,
        timing=getattr(_core.TorqueTiming, timing),
        sample_period_ns=round(1e9 / rate_hz),
        network_stride=max(1, round(0.01 * rate_hz)),
    )


def regular_times(samples: int, rate_hz: float = 1000.0) -> np.ndarray:
    return np.arange(samples, dtype=np.int64) * round(1e9 / rate_hz)


@dataclass(frozen=True)
class Part:
    """A joint and the link it carries; `parent` is a part's name, None for the base."""

    joint: str
    parent: str | None
    kind: str
    xyz: np.ndarray
    rpy: np.ndarray
    axis: np.ndarray
    mass: float
    com: np.ndarray
    com_rpy: np.ndarray
    inertia: np.ndarray  # (3, 3), about the centre of mass, in axes turned by com_rpy
    rotor_inertia: float

    @property
    def link(self) -> str:
        return f"{self.joint}_link"


def urdf(parts: list[Part], extra: str = "") -> str:
    """The arm as URDF; rotor inertia stands in transmissions, seen from before a gear of 100."""
    lines = ['<robot name="arm" xmlns:drake="drake.mit.edu">', '<link name="base"/>']
    for part in parts:
        i = part.inertia.ravel().tolist()
        lines.append(
            f'<link name="{part.link}"><inertial>{_origin(part.com, part.com_rpy)}<mass value="{part.mass!r}"/>'
            f'<inertia ixx="{i[0]!r}" iyy="{i[4]!r}" izz="{i[8]!r}" ixy="{i[1]!r}" ixz="{i[2]!r}" iyz="{i[5]!r}"/>'
            "</inertial></link>"
            f'<joint name="{part.joint}" type="{part.kind}">{_origin(part.xyz, part.rpy)}'
            f'<parent link="{f"{part.parent}_link" if part.parent else "base"}"/><child link="{part.link}"/>'
            f'<axis xyz="{_numbers(part.axis)}"/><limit lower="-3" upper="3" effort="100" velocity="3"/></joint>'
            f'<transmission name="{part.joint}_drive"><joint name="{part.joint}"/><actuator name="{part.joint}_motor">'
            f'<drake:gear_ratio value="100"/><drake:rotor_inertia value="{part.rotor_inertia / 1e4!r}"/>'
            "</actuator></transmission>"
        )
    return "\n".join([*lines, extra, "</robot>"])


PLANAR_RIG = """
[robot]
model = "arm.urdf"
joints = ["shoulder", "elbow"]
names = ["base", "tip"]
"""
"""Of arm.toml: the arm below, its joints renamed."""


def planar_rig() -> list[Part]:
    """The paper's two links in a vertical plane."""
    return [
        Part(joint, parent, "revolute", np.array([0, 0, along]), np.zeros(3), np.array([0.0, 1.0, 0.0]), mass,
             np.array([0, 0, com]), np.zeros(3), np.diag([inertia, inertia, 0.01]), rotor)
        for joint, parent, along, mass, com, inertia, rotor in (
            ("shoulder", None, 0.0, 8.191, 0.12079, 0.06, 0.6),
            ("elbow", "shoulder", 0.3, 9.920, 0.16078, 0.07, 0.3),
        )
    ]  # fmt: skip


def six_axis() -> list[Part]:
    """An industrial arm: quarter turns between axes, and small misalignments as a calibration finds them."""
    return _serial(6, seed=6, heaviest_kg=28.0)


def six_axis_tree(folder: Path) -> _core.Tree:
    """The six-axis arm as the core reads it."""
    path = folder / "arm.urdf"
    path.write_text(urdf(six_axis()))
    return load_tree(path)


def seven_axis() -> list[Part]:
    """A light 7-axis arm, its odd joints continuous."""
    parts = _serial(7, seed=7, heaviest_kg=4.0)
    return [replace(part, kind="continuous") if i % 2 == 0 else part for i, part in enumerate(parts)]


def branched() -> list[Part]:
    """A linear axis that carries a torso with two arms of two joints, one of which ends in a slide."""
    rng = np.random.default_rng(8)
    return [
        _part(rng, "rail", None, 40.0, kind="prismatic"),
        _part(rng, "torso", "rail", 15.0),
        _part(rng, "left_shoulder", "torso", 4.0),
        _part(rng, "right_shoulder", "torso", 4.0),
        _part(rng, "left_elbow", "left_shoulder", 2.0),
        _part(rng, "right_slide", "right_shoulder", 1.5, kind="prismatic"),
    ]


ARMS = {arm.__name__: arm for arm in (planar_rig, six_axis, seven_axis, branched)}


def random_states(size: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in +-3 rad (or m) and speeds in +-2 rad/s, (count, size) each."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (count, size)), rng.uniform(-2, 2, (count, size))


def _serial(count: int, seed: int, heaviest_kg: float) -> list[Part]:
    rng = np.random.default_rng(seed)
    return [
        _part(rng, f"joint{i + 1}", f"joint{i}" if i else None, heaviest_kg * 0.75**i, quarter_turns=i)
        for i in range(count)
    ]


def _part(
    rng: np.random.Generator,
    joint: str,
    parent: str | None,
    mass: float,
    kind: str = "revolute",
    quarter_turns: int = 0,
) -> Part:
    axis = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=3)
    size = rng.uniform(0.05, 0.2, 3)  # half sides of a box of this mass: a physical inertia
    principal = mass / 3 * (np.sum(size**2) - size**2)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Part(
        joint,
        parent,
        kind,
        xyz=rng.uniform(-0.3, 0.3, 3),
        rpy=np.array([(-1) ** quarter_turns * np.pi / 2 if quarter_turns else 0.0, 0, 0]) + 0.05 * rng.normal(size=3),
        axis=axis / np.linalg.norm(axis),
        mass=mass,
        com=rng.uniform(-0.1, 0.1, 3),
        com_rpy=rng.uniform(-1, 1, 3),
        inertia=(turn * principal) @ turn.T,
        rotor_inertia=rng.uniform(0.02, 0.8),
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _origin(xyz: np.ndarray, rpy: np.ndarray) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'
