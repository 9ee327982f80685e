"""The plain arm as MJCF: what an integrator knows of it, and the base of every scene."""

from tauext.sim.config import RigConfig

LINK_RADIUS_M = 0.05
LINK_SPACING_M = 0.12
"""Links lie side by side, one plane each, so that the arm can fold; the motion itself is planar."""


def joint_names(config: RigConfig) -> list[str]:
    """Names of the joints, from the base outward."""
    return [f"joint{i + 1}" for i in range(len(config.links))]


def arm_xml(config: RigConfig) -> str:
    """MJCF of a planar arm in the vertical x-z plane, joints about +y, upright where every joint is zero.

    Holds links, masses and rotor inertia, neither friction nor actuators; the same text is simulated and handed out.
    """
    lines = [
        f'<mujoco model="{config.name}">',
        '  <compiler angle="radian"/>',
        f'  <option timestep="{1.0 / config.rate_hz!r}" integrator="Euler">',
        '    <flag eulerdamp="disable"/>',
        "  </option>",
        "  <worldbody>",
    ]
    offset_m = 0.0
    for i, link in enumerate(config.links):
        pad = "  " * (i + 2)
        lines += [
            f'{pad}<body name="link{i + 1}" pos="0 0 {offset_m!r}">',
            f'{pad}  <joint name="joint{i + 1}" type="hinge" axis="0 1 0" armature="{link.rotor_inertia_kg_m2!r}"/>',
            f'{pad}  <inertial pos="0 0 {link.com_m!r}" mass="{link.mass_kg!r}" '
            f'diaginertia="{link.inertia_kg_m2!r} {link.inertia_kg_m2!r} {_axial_inertia(link.mass_kg)!r}"/>',
            f'{pad}  <geom name="link{i + 1}" type="capsule" size="{LINK_RADIUS_M!r}" contype="1" conaffinity="0" '
            f'fromto="0 {i * LINK_SPACING_M!r} 0 0 {i * LINK_SPACING_M!r} {link.length_m!r}"/>',
        ]
        offset_m = link.length_m
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(len(config.links)))]
    lines += ["  </worldbody>", "</mujoco>"]
    return "\n".join(lines) + "\n"


def _axial_inertia(mass_kg: float) -> float:
    """Inertia of a solid cylinder about its own axis: never felt in planar motion, but a body needs one."""
    return 0.5 * mass_kg * LINK_RADIUS_M**2
