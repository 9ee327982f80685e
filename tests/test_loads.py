"""What the arm carries: the frame it is told in, who may tell it, and that an arm that knows it shows no push."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_arms import random_states, seven_axis, six_axis, urdf
from made_bundles import without_constants
from made_live import Keeper, ScriptedSource, samples_of
from tauext_lab.report.flight import facts
from tauext_lab.report.flight_file import load_flight

from tauext import _core
from tauext._core import Load
from tauext.cli import main
from tauext.config import ObserverConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError, RobotError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.cell_file import load_cell
from tauext.monitor.changes import LoadChange
from tauext.monitor.control_lines import obey
from tauext.monitor.loads import load_and_ago_of_text, load_of_text, read_loads
from tauext.monitor.loop import Loop
from tauext.robot.frames import load_frame
from tauext.robot.read import load_tree
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

TOOL = Load(1.9, [0.03, -0.04, 0.08], [0.012, 0.014, 0.007, 0.001, -0.002, 0.0015], 0.0)
PICKED = 2500
"""The sample after which the arm carries TOOL."""


def fixed(name: str, parent: str, body: Load | None = None) -> str:
    """A link that is fixed to another, turned and moved, with a body's mass or none."""
    inertial = ""
    if body is not None:
        xx, yy, zz, xy, xz, yz = body.inertia
        inertial = (
            f'<inertial><origin xyz="{" ".join(map(str, body.com))}"/><mass value="{body.mass}"/>'
            f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" iyz="{yz}"/></inertial>'
        )
    return (
        f'<link name="{name}">{inertial}</link><joint name="{name}_fixed" type="fixed"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="0.02 -0.03 0.1" rpy="0.3 -0.5 0.9"/></joint>'
    )


def six_axis_urdf(tmp_path, body: Load | None = None) -> str:
    """Six axes with a flange and a tool0 behind them; `body` is held there in the file itself."""
    path = tmp_path / ("holding.urdf" if body else "arm.urdf")
    path.write_text(urdf(six_axis(), fixed("flange", "joint6_link") + fixed("tool0", "flange", body)))
    return str(path)


# The frame.


def settings_of(path: str, tree: _core.Tree, name: str | None = None) -> _core.LoadSettings:
    frame = load_frame(path, tree, name)
    settings = _core.LoadSettings()
    settings.link, settings.refused = frame.link, ""
    settings.rotation, settings.translation = frame.rotation.ravel().tolist(), frame.translation.tolist()
    return settings


def holding(tree: _core.Tree, settings: _core.LoadSettings, load: Load) -> _core.Tree:
    links = tree.links
    links[settings.link] = settings.merged(load, links[settings.link])
    return _core.Tree(links, tree.gravity)


def test_a_load_given_in_the_frame_of_tool0_weighs_what_the_same_body_weighs_there_by_pinocchio(tmp_path):
    from pinocchio_oracle import momentum, read_model

    path = six_axis_urdf(tmp_path)
    tree = load_tree(path)
    names = [link.joint_name for link in tree.links]
    with open(six_axis_urdf(tmp_path, TOOL)) as file:
        rotor = {part.joint: part.rotor_inertia for part in six_axis()}
        oracle = read_model(file.read(), rotor)
    assert load_frame(path, tree).name == "tool0"
    q, dq = random_states(6, 50, seed=1)
    p, beta = holding(tree, settings_of(path, tree), TOOL).momentum(q, dq)
    p_pin, beta_pin = momentum(oracle, q, dq, names)
    np.testing.assert_allclose(p, p_pin, atol=1e-9)
    np.testing.assert_allclose(beta, beta_pin, atol=1e-8)
    assert np.abs(beta - tree.momentum(q, dq)[1]).max() > 10  # it weighs something


def test_without_a_fixed_link_the_frame_is_that_of_the_last_link_in_the_file(tmp_path):
    path = tmp_path / "seven.urdf"
    path.write_text(urdf(seven_axis()))
    tree = load_tree(path)
    frame = load_frame(path, tree)
    assert (frame.name, frame.link) == ("joint7_link", 6)
    np.testing.assert_allclose(frame.translation, 0, atol=1e-12)
    np.testing.assert_allclose(frame.rotation @ seven_axis()[6].axis, [0, 0, 1], atol=1e-12)  # core links turn about z


def test_where_links_branch_the_way_goes_on_to_a_usual_name_or_ends(tmp_path):
    path = tmp_path / "arm.urdf"
    for camera, tool, found in (("camera", "left_tool0", "left_tool0"), ("camera", "finger", "flange")):
        more = fixed("flange", "joint6_link") + fixed(camera, "flange") + fixed(tool, "flange")
        path.write_text(urdf(six_axis(), more))
        assert load_frame(path, load_tree(path)).name == found
    assert load_frame(path, load_tree(path), "camera").name == "camera"
    inner = load_frame(path, load_tree(path), "joint3_link")
    assert inner.link == 2
    with pytest.raises(RobotError, match="'base' is no link that a joint in use moves; those are joint1_link"):
        load_frame(path, load_tree(path), "base")


def test_an_arm_of_several_ends_asks_which(tmp_path):
    from made_arms import branched

    path = tmp_path / "two_arms.urdf"
    path.write_text(urdf(branched()))
    tree = load_tree(path)
    with pytest.raises(RobotError, match="2 ends, behind left_elbow, right_slide"):
        load_frame(path, tree)
    assert load_frame(path, tree, "right_slide_link").link == 5


def test_bodies_without_joints_of_an_mjcf_count_and_the_payload_of_an_import_does_not(tmp_path):
    from made_arms import PLANAR_MJCF

    path = tmp_path / "arm.xml"
    hand = '<body name="hand" pos="0.25 0 0" euler="0 0 30"><body name="tauext_payload"/></body></body></body>'
    path.write_text(PLANAR_MJCF.replace("</body>\n    </body>", hand, 1))
    frame = load_frame(path, load_tree(path))
    assert frame.name == "hand"
    np.testing.assert_allclose(np.linalg.norm(frame.translation), 0.25)


# An arm that picks something up.


def motion(samples: int = 6000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    t = np.arange(samples) * 1e-3
    size, speed, phase = rng.uniform(0.3, 0.9, (1, 6)), rng.uniform(0.8, 2.2, (1, 6)), rng.uniform(0, 6, (1, 6))
    q = size * np.sin(speed * t[:, None] + phase)
    return np.round(t * 1e9).astype(np.int64), q, size * speed * np.cos(speed * t[:, None] + phase)


FRICTION = 0.04
"""Of each joint, as a share of what weighs on its gear."""


def drive_torque(tree: _core.Tree, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Averages over the steps of what the drives exert, friction that grows with the load on the gear included."""
    p, beta = tree.momentum(q, dq)
    torque = beta + FRICTION * np.abs(beta) * np.tanh(dq / 0.1)
    mean = np.vstack([torque[:1], 0.5 * (torque[1:] + torque[:-1])])
    return mean + np.vstack([np.zeros((1, 6)), np.diff(p, axis=0) / 1e-3])


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A bundle that knows the empty arm and its friction exactly, and the arm's motion as it picks TOOL up."""
    folder = tmp_path_factory.mktemp("arm")
    path = six_axis_urdf(folder)
    empty, loaded = load_tree(path), load_tree(six_axis_urdf(folder, TOOL))
    t_ns, q, dq = motion()
    tau = drive_torque(empty, q, dq)
    tau[PICKED + 1 :] = drive_torque(loaded, q, dq)[PICKED + 1 :]
    names = tuple(link.joint_name for link in empty.links)
    free = Recording("free", names, t_ns, q, dq, tau, 1000.0, "averaged", "test", "5" * 64)
    setup = build_setup(empty, free, ObserverConfig(window_s=0.1))
    prior = _core.PriorSettings()
    prior.terms = [_core.Term(_core.TermKind.load, j, speed=0.1) for j in range(6)]
    prior.weights = (-FRICTION * np.eye(6)).ravel().tolist()
    bundle = make_bundle("six", replace(setup, prior=prior), 0.02, free)
    settings = bundle.load_settings
    frame = load_frame(path, empty)
    settings.frame, settings.link = frame.name, frame.link
    settings.rotation, settings.translation = frame.rotation.ravel().tolist(), frame.translation.tolist()
    bundle.load_settings = settings
    return bundle, free, folder


def arrays(recording: Recording, rows: slice) -> list[np.ndarray]:
    return [np.ascontiguousarray(a[rows]) for a in recording.signals]


def set_tool(monitor: _core.Monitor, since_ns: int | None = None) -> None:
    monitor.set_load(TOOL.mass, TOOL.com, TOOL.inertia, since_ns=since_ns, error_share=0.0)


def test_announced_at_the_grasp_no_push_is_seen_and_unannounced_it_weighs_on_every_joint(arm):
    bundle, free, _ = arm
    told, untold = _core.Monitor(bundle), _core.Monitor(bundle)
    before = told.run(*arrays(free, slice(0, PICKED + 1)))
    set_tool(told)
    after = told.run(*arrays(free, slice(PICKED + 1, None)))
    seen = untold.run(*arrays(free, slice(0, None)))
    healthy = before["health"] == 1
    assert healthy.sum() > 1500 and np.abs(before["tau_ext"][healthy]).max() < 1e-9
    assert np.abs(after["tau_ext"]).max() < 1e-9
    assert (np.abs(seen["tau_ext"][PICKED + 1000 :]).max(axis=0) > 0.3).all()  # the last joint's load is near its axis
    assert np.abs(seen["tau_ext"][PICKED + 1000 :]).max() > 10


def test_what_is_refused_says_why_and_changes_nothing(arm):
    bundle, free, _ = arm
    monitor = _core.Monitor(bundle)
    monitor.run(*arrays(free, slice(0, 2000)))
    for wrong, message in (
        ({"mass": -1.0}, r"mass = -1 kg must be >= 0"),
        ({"mass": 1e3}, r"mass = 1000 kg must be at most"),
        ({"mass": float("nan")}, "not finite"),
        ({"mass": 1.0, "com": [0, 0, 9.0]}, "9 m from the origin of tool0"),
        ({"mass": 1.0, "inertia": [0.1, 0.1, 0.3, 0, 0, 0]}, "no body has the payload's inertia"),
        ({"mass": 1.0, "error_share": 2.0}, "error_share = 2 must be 0 to 1"),
    ):
        with pytest.raises(_core.CoreError, match=message):
            monitor.set_load(**wrong)
        assert message.split()[-1] in monitor.why_no_load(Load(**wrong)) and monitor.load == Load()
    assert monitor.why_no_load(TOOL) == "" and np.abs(monitor.last.tau_ext).max() < 1e-9
    set_tool(monitor)
    state = monitor.save_state()
    other = _core.Monitor(bundle)
    other.restore_state(state)
    assert other.load == TOOL and other.load_settings.frame == "tool0"
    monitor.clear_load()
    assert monitor.load.mass == 0


# Who tells it.


def test_a_line_of_text_says_a_load():
    told = load_of_text("mass=2.8, com=0 -1e-2 0.05, inertia=0.01,0.02,0.02, error=0.1")
    assert told == Load(2.8, [0, -0.01, 0.05], [0.01, 0.02, 0.02, 0, 0, 0], 0.1)
    assert load_of_text(" none ") == Load() and load_of_text("mass = 1") == Load(1.0)
    assert load_and_ago_of_text("mass=1 ago=0.5") == (Load(1.0), 0.5) and load_and_ago_of_text("none ago=2")[1] == 2


@pytest.mark.parametrize(
    "text",
    ["", "2.8", "mass", "mass=", "mass=x", "mass=nan", "mass=1 mass=2", "mass=1 2", "mass=1 com=1,2", "com=1,2,3"]
    + ["mass=1 inertia=1,2", "mass=1 weight=2", "none mass=1", "mass=1 ago=1"],
)
def test_a_line_that_says_none_is_refused(text):
    with pytest.raises(ConfigError, match="load "):
        load_of_text(text)


LOADS = """
[[load]]
from_s = 2.501
mass = 1.9
com = [0.03, -0.04, 0.08]
inertia = [0.012, 0.014, 0.007, 0.001, -0.002, 0.0015]
error = 0.0
[[load]]
from_s = 4.0
mass = 0
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("from_s = 4.0", "from_s = 1.0", "..load.. 2 from_s = 1 must not be before"),
        ("from_s = 4.0", "from_s = 1e308", "..load.. 2 from_s = 1e[+]308 must be a number from 0 to 1e[+]09"),
        ("mass = 1.9", "", "..load.. 1 mass is missing"),
        ("com = [0.03, -0.04, 0.08]", "com = [1.0]", "com = .* must be a list of 3, each a number"),
        ("error = 0.0", "eror = 0.0", "unknown key 'eror'"),
        ("[[load]]", "[[loads]]", "unknown key 'loads'"),
        ("from_s = 4.0", "from_s = true", "must be a number"),
    ],
)
def test_a_file_of_loads_that_breaks_a_rule_says_which(tmp_path, old, new, message):
    path = tmp_path / "loads.toml"
    assert old in LOADS
    path.write_text(LOADS.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        read_loads(path)


def json_lines(capsys) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_run_tells_the_monitor_of_loads_with_their_times(arm, capsys):
    bundle, free, folder = arm
    bundle.save(str(folder / "six.tauext"))
    save_recording(free, folder / "free.parquet")
    (folder / "loads.toml").write_text(LOADS)
    command = ["run", str(folder / "six.tauext"), str(folder / "free.parquet"), "--json", "--status-hz", "100"]
    assert main([*command, "--loads", str(folder / "loads.toml")]) == 0
    lines = json_lines(capsys)
    told = [line for line in lines if line["event"] == "load"]
    assert [(one["row"], one["mass_kg"]) for one in told] == [(2501, 1.9), (4000, 0.0)]
    worst = {
        when: max(abs(v) for line in lines if line["event"] == "status" and low < line["row"] < high
                  for v in line["tau_ext_nm"] if v is not None)
        for when, low, high in (("empty", 1000, 2500), ("carrying", 2502, 4000), ("gone", 4500, 6000))
    }  # fmt: skip
    assert worst["empty"] < 1e-9 and worst["carrying"] < 1e-9 and worst["gone"] > 5
    assert main([*command, "--load", "mass=1.9 com=0.03,-0.04,0.08"]) == 0
    assert [line["row"] for line in json_lines(capsys) if line["event"] == "load"] == [0]
    assert main([*command, "--load", "mass=1e3"]) == 2
    assert "mass = 1000 kg must be at most" in capsys.readouterr().err
    assert main(["show", str(folder / "six.tauext")]) == 0
    assert "frame tool0" in capsys.readouterr().out


def test_flights_know_what_the_arm_was_taken_to_carry(arm, tmp_path, capsys):
    bundle, free, _ = arm
    bundle.save(str(tmp_path / "six.tauext"))
    save_recording(free, tmp_path / "free.parquet")
    (tmp_path / "loads.toml").write_text(LOADS)
    command = ["run", str(tmp_path / "six.tauext"), str(tmp_path / "free.parquet"), "--flights", str(tmp_path / "f")]
    assert main([*command, "--loads", str(tmp_path / "loads.toml"), "--before-s", "2"]) == 0
    assert "carries 1.9 kg, centre of mass 0.03 -0.04 0.08 m" in capsys.readouterr().out
    flight = load_flight(
        max((tmp_path / "f").glob("*collision.parquet"), key=lambda path: path.stat().st_mtime_ns)
    )  # of the alarm after the load was taken off too early
    assert [(one["t_ns"], one["mass_kg"]) for one in flight.facts["loads"]][-1] == (4_000_000_000, 0.0)
    assert any("The payload of the arm was set to" in line and "on nothing" in line for line in flight.explanation)
    assert any("fit a payload of 1.9" in line for line in flight.explanation)
    assert dict(facts(flight))["carried"].endswith("s on") and "1.9 kg" in dict(facts(flight))["carried"]


def test_a_live_monitor_obeys_lines_and_profiles(arm, tmp_path):
    bundle, free, _ = arm
    said: list[str] = []

    def ask(verdict):
        if verdict.row == PICKED + 300:
            said.append(obey("load mass=99", keeper.control, "a line"))
            words = "mass=1.9 com=0.03,-0.04,0.08 inertia=0.012,0.014,0.007,0.001,-0.002,0.0015 error=0"
            said.append(obey(f"load {words} ago=0.3", keeper.control, "a line"))
        if verdict.row == 4000:
            keeper.control.use_profile("empty", "test")

    (tmp_path / "cell.toml").write_text(
        '[profiles]\nlowest = 1.0\nhighest = 3.0\n[profiles.usual]\n[profiles.empty]\nload = "none"\n'
    )
    keeper = Keeper(ask)
    profiles = load_cell(tmp_path / "cell.toml", free.joints).profiles
    loop = Loop(bundle, ScriptedSource(samples_of(free, slice(0, 5000))), [keeper], profiles=profiles)
    loop.run()
    assert said[0].startswith("error: the payload's mass = 99 kg") and said[1] == "ok"
    told = [change for change in keeper.changes if isinstance(change, LoadChange)]
    assert [(one.row, one.load.mass, one.by) for one in told] == [
        (PICKED + 301, 1.9, "a line"),
        (4001, 0.0, "profile empty"),
    ]
    tau_ext = np.concatenate([verdict.estimates["tau_ext"] for verdict in keeper.verdicts])
    assert np.abs(tau_ext[PICKED + 301 : 4001]).max() < 1e-9 < np.abs(tau_ext[4500:]).max()


def test_a_profile_with_a_load_that_the_bundle_refuses_is_refused_at_the_start(arm, tmp_path):
    bundle, free, _ = arm
    text = "[profiles]\nlowest = 1.0\nhighest = 3.0\n[profiles.heavy]\nload = { mass = 99.0, com = [0, 0, 0.1] }\n"
    (tmp_path / "cell.toml").write_text(text)
    with pytest.raises(ConfigError, match="profile heavy: the payload's mass = 99 kg"):
        Loop(bundle, ScriptedSource([]), profiles=load_cell(tmp_path / "cell.toml", free.joints).profiles)
    (tmp_path / "cell.toml").write_text(text.replace("com =", "centre ="))
    with pytest.raises(ConfigError, match=r"\[profiles.heavy.load\] unknown key 'centre'"):
        load_cell(tmp_path / "cell.toml", free.joints)


# What training puts into the bundle.


def test_training_finds_the_frame_and_the_mass_that_a_drive_cannot_hold(arm, tmp_path):
    _, free, folder = arm
    path = folder / "arm.urdf"
    tree = load_tree(path)
    pieces = [replace(free, name=f"part{k}", **signals(free, slice(1200 * k, 1200 * k + 1200))) for k in range(3)]
    from tauext.config import PAPER_CASES

    out = tmp_path / "trained.tauext"
    train_on_recordings(
        TrainingInput(path, PAPER_CASES["exact"], pieces[:2], pieces[2:], model=tree),
        TrainConfig(recipe="observer"),
        out,
    )
    settings = _core.Bundle.load(str(out)).load_settings
    assert settings.frame == "tool0" and settings.settable
    # By hand: drives give 100 Nm each, and what a kilogram at tool0 weighs on a joint is the arm with it less without.
    q = np.concatenate([piece.q for piece in pieces[:2]])
    body = six_axis_urdf(tmp_path, Load(1.0, inertia=[1e-9] * 3 + [0.0] * 3))
    weight = load_tree(body).momentum(q, 0 * q)[1] - tree.momentum(q, 0 * q)[1]
    assert settings.largest_mass_kg == pytest.approx(100 / np.abs(weight).max(), rel=1e-6)
    facts_of_it = json.loads(_core.Bundle.load(str(out)).provenance)["load"]
    assert facts_of_it["frame"] == "tool0"
    with pytest.raises(ConfigError, match="load frame 'elbow' is no link"):
        config = TrainConfig(recipe="observer", load_frame="elbow")
        train_on_recordings(
            TrainingInput(path, PAPER_CASES["exact"], pieces[:2], pieces[2:], model=tree),
            config,
            tmp_path / "other.tauext",
        )


def signals(recording: Recording, rows: slice) -> dict[str, np.ndarray]:
    return {name: getattr(recording, name)[rows] for name in ("t_ns", "q", "dq", "tau")}


# An arm that was found in its motion.


def test_halves_of_good_motion_agree_on_what_a_load_weighs_and_halves_of_little_do_not():
    from made_recordings import made_motion
    from test_kinematics import CONFIG, LOWER_M, UPPER_M, X, Y, Z, setup_of
    from test_kinematics import arm as arm_of_four

    from tauext.fit.find_kinematics import Kinematics
    from tauext.train.load_frame import load_disagreement

    tree = arm_of_four()
    origins = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.2 + UPPER_M], [0.1, 0, 0.2 + UPPER_M + LOWER_M]])
    true = Kinematics(np.array([Z, Y, Y, X]), origins)
    setup = setup_of(tree)
    wide = made_motion(tree, 1.0, pieces=2, ranges=0.8).recordings
    narrow = made_motion(tree, 1.0, pieces=2, ranges=0.1).recordings  # hardly any of gravity's change is seen
    known, unknown = (load_disagreement(setup, made, CONFIG, true) for made in (wide, narrow))
    assert known < 0.1 < unknown
    assert load_disagreement(setup, made_motion(tree, 0.15, pieces=1).recordings, CONFIG, true) is None


def test_a_last_axis_that_nothing_weighs_on_may_point_anywhere():
    from made_recordings import made_motion
    from test_kinematics import arm as arm_of_four

    from tauext.train.load_frame import last_axis_shows

    tree = arm_of_four()
    made = made_motion(tree, 0.2, pieces=1).recordings
    assert last_axis_shows(tree.links, tree.gravity, made, error_nm=0.05)
    links = tree.links
    links[-1].com = [0.0, 0.0, 0.1]  # on the axis: balanced
    assert not last_axis_shows(links, tree.gravity, made, error_nm=0.05)


def test_a_joint_in_amperes_does_not_forbid_loads_and_its_limit_rises_by_all_that_one_may_show(arm):
    bundle, free, _ = arm
    ampere = replace(free, tau=free.tau / [1, 1, 1, 1, 1, 5.0])
    less = without_constants(_core.Bundle.from_bytes(bundle.to_bytes()), [5])
    prior = less.prior
    prior.most_load_nm = [1.2 * 50.0] * 6
    less.prior = prior
    less.largest_torque_nm = [100.0] * 6
    less.answer_reference()
    units = less.most_units_per_nm
    assert units == pytest.approx([0, 0, 0, 0, 0, 1 + 100 / 50])
    told, known, untold = _core.Monitor(less), _core.Monitor(bundle), _core.Monitor(bundle)
    for monitor in (told, known):
        set_tool(monitor)
    rows = slice(0, 2500)
    said, same, bare = told.run(*arrays(ampere, rows)), known.run(*arrays(free, rows)), untold.run(*arrays(free, rows))
    late = slice(1500, None)
    np.testing.assert_allclose(said["residual"][late, :5], same["residual"][late, :5], atol=1e-9)
    shows = np.abs(bare["residual"] - same["residual"])[late, 5]  # the load's torque as r sees it
    # A sample later: the load's own filter steps behind the answer.
    np.testing.assert_allclose(said["doubt"][late, 5][1:], units[5] * shows[:-1], rtol=1e-6, atol=1e-9)
    assert shows.max() > 0.1 and np.abs(said["doubt"][late, :5]).max() < 1e-9
    without_constants(less, [2, 3, 4, 5]).assume_load()
    assert less.load_settings.refused.startswith("only 2 of 6 joints in N m")
    assert less.load_settings.refused.endswith("and the pull of a mass is in newtons")
