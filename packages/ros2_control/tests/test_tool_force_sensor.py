"""The ros2_control package, built by its CMakeLists.txt against mocked headers, run by a mocked controller manager."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio_oracle as oracle
import pytest
from made_bundles import SEVEN_AXIS, constant_error_scale
from made_cpp import build, build_of_library, run
from ruamel.yaml import YAML

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.robot.frames import wrench_frames
from tauext.robot.read import load_tree

PACKAGE = Path(__file__).parents[1]
MOCK = PACKAGE / "tests" / "mock"
VALUES = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z", "error", "health", "alarm")
HEALTH, ALARM = VALUES.index("health"), VALUES.index("alarm")
FRAME = _core.WrenchAxes.frame
POSE = np.array([0.3, -0.6, 0.5, -1.7, 0.4, 1.3, 0.2])
JOINTS = [f"joint{k}" for k in range(1, 8)]
PUSH = np.array([3.0, -20.0, 12.0, 0.5, -0.4, 0.2])
"""Force [N] and moment [N m] on the arm at the origin of link7, along its axes."""
PUSHED_FROM, ROWS = 800, 1600
WARMING_UP, OK, STALE = 0, 1, 2
COLLISION = 2


def torques() -> tuple[np.ndarray, np.ndarray]:
    """What the drives hold at rest, by Pinocchio: against the arm's weight, and against PUSH besides, [N m]."""
    pin = oracle.pin
    arm = oracle.read_model(SEVEN_AXIS.read_text())
    order = [arm.joints[arm.getJointId(name)].idx_q for name in JOINTS]
    q = np.zeros(arm.nq)
    q[order] = POSE
    weight = pin.computeGeneralizedGravity(arm, arm.createData(), q)[order]
    return weight, oracle.frame_jacobian(arm, POSE, JOINTS, "link7", pin.LOCAL).T @ PUSH


def samples() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """t_ns, q, dq, tau of an arm at rest that is pushed from a row on."""
    weight, push = torques()
    tau = np.tile(weight, (ROWS, 1))
    tau[PUSHED_FROM:] -= push
    t_ns = 5_000_000_000 + np.arange(ROWS, dtype=np.int64) * 1_000_000
    counts = 1e-6 * (np.arange(ROWS) % 2)  # an encoder that never changes is a fault
    return t_ns, POSE + counts[:, None], np.zeros((ROWS, 7)), tau


pytestmark = pytest.mark.slow  # compiles the package


@pytest.fixture(scope="module")
def bundle() -> _core.Bundle:
    """An exact model of an arm without friction."""
    t_ns, q, dq, tau = (signal[:PUSHED_FROM] for signal in samples())
    free = Recording("free", tuple(JOINTS), t_ns, q, dq, tau, 1000.0, "instant", "test", "5" * 64)
    made = make_bundle("seven", build_setup(load_tree(SEVEN_AXIS), free, ObserverConfig(window_s=0.1)), 0.02, free)
    limits = [5.0] * 7
    made.sliding_limit_nm = made.near_stiction_limit_nm = limits
    made.contact_sliding_limit_nm = made.contact_near_stiction_limit_nm = limits
    made.error_scale = constant_error_scale([0.8, 0.9, 0.6, 0.5, 0.3, 0.2, 0.15])
    settings = made.wrench_settings
    settings.frames = wrench_frames(SEVEN_AXIS, load_tree(SEVEN_AXIS))
    made.wrench_settings = settings
    load = made.load_settings
    load.frame, load.link, load.translation = "tool0", 6, [0.0, 0.0, 0.1]
    made.load_settings = load
    made.set_reference(t_ns, q, dq, tau)
    return made


@pytest.fixture(scope="module")
def place(tmp_path_factory, bundle) -> Path:
    """A folder with the built package, the mocked controller manager and a bundle."""
    library = build_of_library(tmp_path_factory.mktemp("library"))
    folder = tmp_path_factory.mktemp("ros2_control")
    code, _, err = run("cmake", "--install", library, "--prefix", folder / "tauext")
    assert code == 0, err
    mocked(folder / "ros", folder / "tauext")
    build(
        PACKAGE,
        folder / "built",
        "-DCMAKE_BUILD_TYPE=Debug",
        "-DCMAKE_CXX_FLAGS=-Wall -Wextra -Wpedantic -Wshadow -Werror",
        f"-DCMAKE_PREFIX_PATH={folder / 'ros'}",
    )
    code, _, err = run(
        "g++", "-std=c++20", "-Wall", "-Wextra", "-Werror", f"-I{MOCK}", PACKAGE / "tests" / "controller_manager.cpp",
        "-o", folder / "controller_manager", "-ldl",
    )  # fmt: skip
    assert code == 0, err
    bundle.save(str(folder / "arm.tauext"))
    return folder


def mocked(prefix: Path, library: Path) -> None:
    """CMake packages by the names and targets of ROS 2 that hold the mocked headers.

    Args:
        library: where tauext_vendor has installed the core.
    """
    depends = [one.text for one in ElementTree.parse(PACKAGE / "package.xml").iter("depend")]
    extra = {
        "ament_cmake": "function(ament_package)\nendfunction()\n",
        "pluginlib": "function(pluginlib_export_plugin_description_file category file)\n"
        "  if(NOT EXISTS ${CMAKE_CURRENT_SOURCE_DIR}/${file})\n    message(FATAL_ERROR ${file})\n  endif()\n"
        "endfunction()\n",
        "tauext_vendor": f'list(PREPEND CMAKE_PREFIX_PATH "{library}")\n',
    }
    for name in ("ament_cmake", *depends):
        folder = prefix / "lib" / "cmake" / name
        folder.mkdir(parents=True)
        target = f"add_library({name}::{name} INTERFACE IMPORTED)\n"
        target += f'target_include_directories({name}::{name} INTERFACE "{MOCK}")\n'
        (folder / f"{name}Config.cmake").write_text(target + extra.get(name, ""))


def started(place: Path, *parameters: object, rate_hz: int = 1000, text: str = "") -> tuple[int, list[str], str]:
    library = place / "built" / "libtauext_ros2_control.so"
    return run(place / "controller_manager", library, rate_hz, *parameters, text=text)


def ran(place: Path, lines: list[str], *parameters: str) -> list[str]:
    """What the controller printed of these cycles, without an error."""
    code, out, err = started(place, f"bundle={place}/arm.tauext", *parameters, text="\n".join(lines))
    assert code == 0, err
    return out


def cycles(signals: tuple[np.ndarray, ...]) -> list[str]:
    t_ns, *of_joints = signals
    rows = np.stack(of_joints, axis=2).reshape(len(t_ns), -1).tolist()  # position, velocity, effort of each joint
    return [" ".join(map(repr, [t, *row])) for t, row in zip(t_ns.tolist(), rows, strict=True)]


def values(lines: list[str]) -> np.ndarray:
    return np.array([[float(cell) for cell in line.split()] for line in lines])


def test_the_exported_wrench_is_the_push_on_the_arm_and_that_of_the_monitor(place, bundle):
    signals = samples()
    required, exported, *rows, allocations = ran(place, cycles(signals), "frame=link7")
    assert required.split() == [f"{joint}/{kind}" for joint in JOINTS for kind in ("position", "velocity", "effort")]
    assert exported.split() == [f"tool_force/{name}" for name in VALUES]
    updating, configuring = map(int, allocations.split())
    assert updating == 0 < configuring
    found = values(rows)
    monitor, wanted = _core.Monitor(bundle), []
    for t_ns, *sample in zip(*signals, strict=True):
        answer, wrench = monitor.step(int(t_ns), *sample), monitor.wrench("link7", FRAME)
        error_n = np.sqrt(np.trace(wrench.covariance[:3, :3])) if wrench.known else np.nan
        wanted.append([*wrench.force, *wrench.moment, error_n, answer.health.value, answer.held_alarm.value])
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)
    warm = found[:, HEALTH] == OK
    assert np.isnan(found[~warm][:, :HEALTH]).all() and np.isfinite(found[warm]).all()
    assert set(found[:, HEALTH]) == {WARMING_UP, OK} and warm[PUSHED_FROM:].all()
    assert not found[:PUSHED_FROM, ALARM].any() and found[-1, ALARM] == COLLISION
    np.testing.assert_allclose(found[PUSHED_FROM - 1, :6], 0, atol=0.01)
    np.testing.assert_allclose(found[-1, :6], PUSH, rtol=0.02, atol=0.05)  # 16/K0 after the onset


def test_a_force_at_a_point_has_its_moment_about_the_frame_and_joints_other_names(place, bundle):
    point = [0.0, 0.02, 0.1]
    names = ",".join(f"arm_{joint}" for joint in JOINTS)
    out = ran(place, cycles(samples()), "point=0,0.02,0.1", f"joints={names}")
    assert out[0].split()[:3] == ["arm_joint1/position", "arm_joint1/velocity", "arm_joint1/effort"]
    force, moment, (error_n, *_) = np.split(values(out[-2:-1])[0], [3, 6])
    monitor = _core.Monitor(bundle)
    monitor.run(*samples())
    wanted = monitor.force("tool0", point, FRAME)  # the load frame
    np.testing.assert_allclose(force, wanted.force, rtol=1e-6)
    np.testing.assert_allclose(moment, np.cross(point, force), atol=1e-9)
    assert error_n == pytest.approx(np.sqrt(np.trace(wanted.covariance)))


def test_a_declared_contact_is_in_effect_again_after_a_pause_and_raises_no_alarm_within_its_bounds(place):
    lines = cycles(samples())
    lines.insert(20, "off")
    for at_most_n, alarm in ((40, 0), (10, COLLISION)):  # the push has 23.5 N
        found = values(ran(place, lines, "frame=link7", "at_most_nm=5", f"at_most_n={at_most_n}")[2:-1])
        assert np.nanmax(found[:, ALARM]) == alarm  # NaN while inactive
        np.testing.assert_allclose(found[-1, :6], PUSH, rtol=0.02, atol=0.05)


def test_a_held_interface_is_a_missing_sample_and_a_nan_or_a_pause_makes_the_force_unknown(place):
    lines = cycles(samples())[: PUSHED_FROM + 20]
    lines[705] = re.sub(r" \S+$", " h", lines[705])
    lines[750] = re.sub(r" \S+$", " nan", lines[750])
    lines.insert(740, "off")
    found = values(ran(place, lines)[2:-1])
    assert found[704:707, HEALTH].tolist() == [OK, STALE, OK]
    np.testing.assert_array_equal(found[705, :6], found[704, :6])  # the last known force
    assert np.isnan(found[740]).all()
    assert found[741, HEALTH] == WARMING_UP and np.isnan(found[741:, :HEALTH]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bundle": ""}, "parameter bundle: the path of a bundle is missing"),
        ({"bundle": "none.tauext"}, "none.tauext"),
        ({"frame": "tool9"}, "parameter frame: 'tool9' must be one of joint1, "),
        ({"point": "1,2"}, "parameter point: must be three numbers, [m] along the frame's axes, or empty"),
        ({"point": "1,nan,2"}, "parameter point: must be three numbers"),
        ({"at_most_n": "-1"}, "parameters at_most_n, at_most_nm: "),
        ({"at_most_nm": "nan"}, "parameters at_most_n, at_most_nm: "),
        ({"joints": "a,b"}, "parameter joints: a, b: must be 7 names, one for each joint of the bundle"),
        ({"rate_hz": 500}, "parameter update_rate: 500 Hz must be the bundle's 1000 Hz"),
        ({"frame": "1,2"}, "parameter 'frame' has invalid type"),
    ],
)
def test_a_wrong_parameter_is_refused_in_one_line(place, changes, message):
    settings = {"bundle": f"{place}/arm.tauext"} | changes
    rate_hz = settings.pop("rate_hz", 1000)
    code, out, err = started(place, *(f"{name}={value}" for name, value in settings.items()), rate_hz=rate_hz)
    assert code in (2, 3) and not out
    assert err.count("\n") == 1 and message in err


def described() -> ElementTree.Element:
    """The plug-in's description for pluginlib."""
    (only,) = ElementTree.parse(PACKAGE / "tauext_ros2_control.xml").iter("class")
    return only


def test_the_plug_in_is_described_by_its_class():
    name, base = described().get("type"), described().get("base_class_type")
    source = (PACKAGE / "src" / "tool_force_sensor.cpp").read_text()
    assert f"PLUGINLIB_EXPORT_CLASS({name}, {base})" in source
    assert described().get("name") == name.replace("::", "/")


def test_the_example_names_one_sensor_and_frame_for_all_controllers():
    example = YAML(typ="safe").load((PACKAGE / "examples" / "controllers.yaml").read_text())
    of = {name: content["ros__parameters"] for name, content in example.items()}
    (sensor,) = (name for name, kind in of["controller_manager"].items() if kind == {"type": described().get("name")})
    declared = re.findall(r'auto_declare<.*>\("(\w+)"', (PACKAGE / "src" / "tool_force_sensor.cpp").read_text())
    assert set(of[sensor]) <= set(declared) and len(declared) == 6
    admittance, broadcaster = of["admittance_controller"], of["force_torque_sensor_broadcaster"]
    assert {admittance["ft_sensor"]["name"], broadcaster["sensor_name"]} == {sensor}
    frames = {of[sensor]["frame"], admittance["ft_sensor"]["frame"]["id"], broadcaster["frame_id"]}
    assert len(frames) == 1
    tool = admittance["gravity_compensation"]["CoG"]
    assert not any([tool["force"], *tool["pos"]])
