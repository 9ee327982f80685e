"""Arms and settings that several tests share, written out by hand so that they depend on no robot file."""

from __future__ import annotations

import numpy as np

from tauext import _core

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
