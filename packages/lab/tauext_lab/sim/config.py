"""Every number of the virtual rig, in frozen dataclasses; docs/paper.md gives the source of each."""

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Protocol

from tauext.errors import ConfigError


@dataclass(frozen=True)
class LinkConfig:
    """One link of a planar arm and the joint that carries it; its frame is at that joint, z along the link."""

    length_m: float
    """Distance from this joint to the next, or to the tip."""
    mass_kg: float
    com_m: float
    """Distance from the joint to the centre of mass, along the link, in the robot file."""
    true_com_m: float
    """Distance from the joint to the centre of mass in the simulated arm: the robot file errs by the difference."""
    inertia_kg_m2: float
    """Inertia about an axis along the joint's through the centre of mass."""
    rotor_inertia_kg_m2: float
    """Motor inertia times gear ratio squared."""


@dataclass(frozen=True)
class DriveConfig:
    """PD drive of one joint: torque = stiffness (q_des - q) + damping (dq_des - dq), held for one sample."""

    stiffness_nm_rad: float
    damping_nm_s_rad: float


@dataclass(frozen=True)
class FrictionConfig:
    """Friction of one joint: LuGre bristles z, viscous part and gear ripple.

    sigma_0 z + sigma_1 dz/dt + viscous dq, where dz/dt = dq - sigma_0 |dq| z / g(dq) and
    g(dq) = coulomb + load_share |load| + (static - coulomb) exp(-(dq / stribeck)^2). The load is the torque through the
    gear, drive - friction - rotor inertia ddq.
    """

    coulomb_nm: float
    static_nm: float
    load_share: float
    """Growth of Coulomb and static friction with the load."""
    stribeck_rad_s: float
    viscous_nm_s_rad: float
    bristle_nm_rad: float
    """Presliding stiffness sigma_0: the joint breaks away after about static / bristle radians."""
    bristle_damping_nm_s_rad: float
    """Damping sigma_1 of the arm on its bristles."""
    ripple_nm: float
    """Amplitude of the torque ripple of motor and gear over the joint's position."""
    ripple_cycles: int
    """Periods of the ripple in one turn of the joint."""


PAPER_LINKS = (
    LinkConfig(
        length_m=0.3, mass_kg=8.191, com_m=0.12079, true_com_m=0.1587, inertia_kg_m2=0.0666, rotor_inertia_kg_m2=0.6
    ),
    LinkConfig(
        length_m=0.3, mass_kg=9.920, com_m=0.16078, true_com_m=0.1671, inertia_kg_m2=0.0806, rotor_inertia_kg_m2=0.25
    ),
)
PAPER_DRIVES = (
    DriveConfig(stiffness_nm_rad=8000.0, damping_nm_s_rad=250.0),
    DriveConfig(stiffness_nm_rad=3000.0, damping_nm_s_rad=60.0),
)
PAPER_FRICTION = (
    FrictionConfig(
        coulomb_nm=4.0,
        static_nm=4.0,
        load_share=0.16,
        stribeck_rad_s=0.05,
        viscous_nm_s_rad=3.2,
        bristle_nm_rad=156_000.0,
        bristle_damping_nm_s_rad=120.0,
        ripple_nm=0.6,
        ripple_cycles=200,
    ),
    FrictionConfig(
        coulomb_nm=2.97,
        static_nm=2.97,
        load_share=0.073,
        stribeck_rad_s=0.05,
        viscous_nm_s_rad=3.97,
        bristle_nm_rad=6600.0,
        bristle_damping_nm_s_rad=25.0,
        ripple_nm=0.3,
        ripple_cycles=200,
    ),
)


@dataclass(frozen=True)
class SensorConfig:
    """Effects of the rig's instruments on the signals."""

    encoder_counts: int = 2**17
    """Counts of the encoder in one turn of the joint."""
    velocity_cutoff_rad_s: float = 300.0
    """Cut-off of the first-order low-pass on the difference of the encoder's counts."""
    torque_noise_nm: tuple[float, ...] = (0.6, 0.7)
    """Standard deviation of the measured motor torque, white, one value a joint."""
    jts_noise_nm: tuple[float, ...] = (0.2, 0.1)
    """Standard deviation of the joint torque sensor, white, one value a joint."""
    reference_cutoff_rad_s: float = 20.0
    """Cut-off of the first-order low-pass of the external torque that the joint torque sensor gives."""


@dataclass(frozen=True)
class MotionConfig:
    """Quintic moves from rest to rest between random targets, all joints together, with pauses."""

    range_deg: float = 180.0
    """Joint targets are uniform in plus or minus this range."""
    mean_speed_deg_s: tuple[float, float] = (20.0, 50.0)
    """The mean speed of the joint that moves furthest is uniform between these, one draw a move."""
    least_travel_deg: float = 45.0
    """A target is drawn again while no joint would move this far: short moves at these speeds would jerk."""
    pause_s: tuple[float, float] = (0.0, 0.4)
    """Time at rest before a move, uniform between these."""


@dataclass(frozen=True)
class PulseConfig:
    """Force pulses on the links: a shape in time, a height, a length, a place and a direction each."""

    height_n: tuple[float, float] = (10.0, 100.0)
    """Peak force of a pulse, uniform between these."""
    length_s: tuple[float, float] = (0.02, 1.0)
    """Length of a pulse from its first to its last force, log-uniform between these."""
    place: tuple[float, float] = (0.1, 1.0)
    """Place on the link as a share of its length, uniform between these."""
    cone_deg: float = 60.0
    """The force leans from the link's normal by at most this angle, uniform."""
    peak_nm: tuple[float, float] = (1.0, 60.0)
    """A pulse is drawn again until the largest sensor reference it would make at rest lies between these."""


@dataclass(frozen=True)
class PadConfig:
    """A padded body (a hand, for example) that meets a link, pushes, and leaves; its path is planned in the link's
    frame."""

    mass_kg: float = 1.0
    radius_m: float = 0.05
    stiffness_n_m: float = 2500.0
    """Stiffness of the spring that carries the body along its planned path."""
    damping_n_s_m: float = 100.0
    padding_s: float = 0.02
    """Time constant of the contact (MuJoCo's solref): longer is softer."""
    clearance_m: float = 0.1
    """Distance from the link's surface at which the body waits."""
    depth_m: tuple[float, float] = (0.008, 0.06)
    """How far past the link's surface the path goes, log-uniform between these: it sets the force."""
    speed_m_s: tuple[float, float] = (0.1, 1.5)
    """Peak approach speed, relative to the link, log-uniform between these."""
    hold_s: tuple[float, float] = (0.02, 1.0)
    """Time at full depth, log-uniform between these."""
    place: tuple[float, float] = (0.15, 1.0)
    """Place on the link as a share of its length, uniform between these."""


class Drivetrain(Protocol):
    """Properties of every simulated arm, whatever its links: drives, friction and instruments of its joints."""

    @property
    def name(self) -> str: ...
    @property
    def drives(self) -> tuple[DriveConfig, ...]: ...
    @property
    def friction(self) -> tuple[FrictionConfig, ...]: ...
    @property
    def sensors(self) -> SensorConfig: ...
    @property
    def rotor_inertia_kg_m2(self) -> tuple[float, ...]: ...
    @property
    def rate_hz(self) -> int: ...


@dataclass(frozen=True)
class RigConfig:
    """A virtual planar arm, its drives and instruments, and what it does. The defaults are the paper's MOCCA."""

    name: str = "paper-arm"
    links: tuple[LinkConfig, ...] = PAPER_LINKS
    drives: tuple[DriveConfig, ...] = PAPER_DRIVES
    friction: tuple[FrictionConfig, ...] = PAPER_FRICTION
    sensors: SensorConfig = field(default_factory=SensorConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    pulses: PulseConfig = field(default_factory=PulseConfig)
    pads: PadConfig = field(default_factory=PadConfig)
    rate_hz: int = 1000
    """Sample rate; the drives and the simulation step at it."""
    recording_s: float = 90.0
    """Length of a free-motion recording; shorter where fewer than twenty would result from the given minutes."""
    collision_recording_s: float = 90.0
    collisions_per_recording: int = 10
    gap_s: float = 3.0
    """Least time without a collision before the first, between two and after the last of a recording."""

    @property
    def rotor_inertia_kg_m2(self) -> tuple[float, ...]:
        """Rotor inertia of every joint."""
        return tuple(link.rotor_inertia_kg_m2 for link in self.links)

    def __post_init__(self) -> None:
        joints = len(self.links)
        for name, values in (
            ("drives", self.drives),
            ("friction", self.friction),
            ("sensors.torque_noise_nm", self.sensors.torque_noise_nm),
            ("sensors.jts_noise_nm", self.sensors.jts_noise_nm),
        ):
            if len(values) != joints:
                raise ConfigError(f"{name} has {len(values)} entries; it must have one a link, {joints}")
        if joints not in (1, 2):
            raise ConfigError(f"links = {joints} must be 1 or 2: between two others a pad cannot reach a link")
        for name, value in _numbers(self):
            if value < 0.0:
                raise ConfigError(f"{name} = {value:g} must be >= 0")


def changed_rig(encoder_bits: int, friction: float) -> RigConfig:
    """The paper's rig with encoders of 2^encoder_bits counts a turn, and so many times its friction."""
    rig = RigConfig()
    sensors = replace(rig.sensors, encoder_counts=2**encoder_bits)
    return replace(rig, friction=changed_friction(rig.friction, friction), sensors=sensors)


def changed_friction(joints: tuple[FrictionConfig, ...], factor: float) -> tuple[FrictionConfig, ...]:
    """Coulomb, static, viscous and load-dependent friction times this factor. Bristles and ripple stay: a joint bends
    as stiffly as before, and further before it breaks away."""
    return tuple(
        replace(
            joint,
            coulomb_nm=factor * joint.coulomb_nm,
            static_nm=factor * joint.static_nm,
            load_share=factor * joint.load_share,
            viscous_nm_s_rad=factor * joint.viscous_nm_s_rad,
        )
        for joint in joints
    )


def _numbers(config: Any, prefix: str = "") -> list[tuple[str, float]]:
    """Every number of a config with its dotted name; of a (low, high) pair both ends."""
    found = []
    for f in fields(config):
        value = getattr(config, f.name)
        for k, item in enumerate(value if isinstance(value, tuple) else (value,)):
            name = f"{prefix}{f.name}" + (f"[{k}]" if isinstance(value, tuple) else "")
            if is_dataclass(item):
                found += _numbers(item, f"{name}.")
            elif isinstance(item, int | float):
                found.append((name, item))
    return found
