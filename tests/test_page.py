"""The demo without its page: the arm's physics, pushes, reactions, alarms, cache and processes."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from made_bundles import SEVEN_AXIS
from made_page import SHORT

from tauext.cli import main
from tauext.commission.processes import start_worker
from tauext.errors import ConfigError
from tauext.page import bundles as demo_bundles
from tauext.page import workers
from tauext.page.bundles import LESSONS, bundle_folder, cache_folder, find_bundles, train_bundles
from tauext.page.door import free_port
from tauext.page.headless import describe, scripted_pushes
from tauext.page.page import open_server
from tauext.page.simulation import RESUME_RAD, RESUME_S, Simulation
from tauext.robot.load import load_tree
from tauext.sim.arms import ARMS
from tauext.sim.config import RigConfig
from tauext.sim.contacts import force_torque
from tauext.sim.plant import Drag, Mover, Plant, estimated_force
from tauext.sim.rig import measure, roll_out


@pytest.fixture(scope="module", params=ARMS)
def arm(request):
    return ARMS[request.param]()


@pytest.fixture
def trained(rig_bundles):
    return rig_bundles


def watched(trained, reaction="stop"):
    """The rig at rest, its monitors warm."""
    simulation = Simulation(ARMS["rig"]())
    simulation.watch_with({name: str(path) for name, path in trained.items()}, "tauext")
    simulation.set_reaction(reaction)
    simulation.rest()
    for _ in range(2000):
        simulation.step()
    simulation.mover.doing = "moving"  # a reaction needs motion; this one has nowhere to go
    simulation.mover._plan(0.0, np.zeros(2), 1e6)
    simulation.snapshot()
    return simulation


def test_samples_one_by_one_are_those_of_a_rollout(arm):
    silent = replace(arm.sensors, torque_noise_nm=(0.0,) * len(arm.joints))
    arm = replace(arm, sensors=silent)
    mover, plant = Mover(arm), Plant(arm)
    setpoints, samples = [], []
    for _ in range(500):
        q_des, dq_des = mover.step(plant.data.qpos, plant.data.qvel, plant.gravity_nm)
        setpoints.append(np.stack([q_des, dq_des], axis=1).ravel())
        samples.append(plant.step(q_des, dq_des))
    truth = roll_out(arm, arm.model, np.array(arm.home), np.array(setpoints))
    measured = measure(arm, truth, np.zeros_like(truth.q), np.random.default_rng(0))
    for signal, first in (("q", 0), ("dq", 100), ("tau", 0)):  # only the batch knows the speed of the first sample
        np.testing.assert_allclose([getattr(s, signal) for s in samples[first:]], measured[signal][first:], atol=1e-9)


def test_a_push_on_link_5_is_pinocchios_jacobian_transposed():
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(SEVEN_AXIS))
    data = model.createData()
    plant = Plant(ARMS["seven"]())
    plant.data.qpos[:] = np.linspace(-0.5, 0.7, 7)
    mujoco.mj_forward(plant.model, plant.data)
    pin.computeJointJacobians(model, data, plant.data.qpos)
    pin.updateFramePlacements(model, data)
    origin, rotation = plant.body_pose(4)
    local, force = np.array([0.03, -0.02, 0.07]), np.array([10.0, -20.0, 30.0])
    frame = model.addFrame(pin.Frame("grabbed", 5, pin.SE3(np.eye(3), local), pin.FrameType.OP_FRAME))
    data = model.createData()
    jacobian = pin.computeFrameJacobian(model, data, plant.data.qpos, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    np.testing.assert_allclose(plant.jacobian(origin + rotation @ local, 4), jacobian, atol=1e-12)
    sample = plant.step(plant.data.qpos, np.zeros(7), force, origin + rotation @ local, 4)
    np.testing.assert_allclose(sample.tau_ext, jacobian.T @ force, atol=1e-10)
    assert (sample.tau_ext[5:] == 0).all()


def test_a_push_on_the_rig_is_the_planar_torque():
    plant, q = Plant(ARMS["rig"]()), np.array([0.4, -1.1])
    plant.data.qpos[:] = q
    mujoco.mj_forward(plant.model, plant.data)
    origin, rotation = plant.body_pose(1)
    point, force = origin + rotation @ [0.0, 0.1, 0.2], np.array([12.0, 5.0, -7.0])
    tau_ext = plant.step(q, np.zeros(2), force, point, 1).tau_ext
    expected = force_torque(RigConfig(), q[None], 1, force[None, [0, 2]], point[None, [0, 2]])[0]
    np.testing.assert_allclose(tau_ext, expected, atol=1e-10)


def test_the_packaged_arm_is_the_one_of_the_benchmarks(tmp_path):
    path = tmp_path / "seven.xml"
    path.write_text(ARMS["seven"]().xml)
    ours, urdf = load_tree(path), load_tree(SEVEN_AXIS)
    rng = np.random.default_rng(0)
    q, dq = rng.uniform(-2, 2, (20, 7)), rng.uniform(-2, 2, (20, 7))
    for a, b in zip(ours.momentum(q, dq), urdf.momentum(q, dq), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_drag_pulls_like_a_spring_and_no_harder_than_it_may(arm):
    plant = Plant(arm)
    last = len(arm.joints) - 1
    origin, rotation = plant.body_pose(last)
    drag = Drag.grab(plant, last, origin + rotation @ [0.0, 0.0, 0.05])
    np.testing.assert_allclose(drag.force_n(plant)[0], 0.0, atol=1e-9)
    drag.target_m = drag.target_m + [0.1, 0.0, 0.0]
    np.testing.assert_allclose(drag.force_n(plant)[0], [0.1 * arm.push.stiffness_n_m, 0.0, 0.0], atol=1e-9)
    drag.target_m = drag.target_m + [9.0, 9.0, 0.0]
    assert np.linalg.norm(drag.force_n(plant)[0]) == pytest.approx(arm.push.largest_n)


def test_the_force_is_found_from_exact_torques_as_far_as_joints_feel_it():
    plant, force = Plant(ARMS["seven"]()), np.array([5.0, -6.0, 7.0])
    origin, rotation = plant.body_pose(6)
    jacobian = plant.jacobian(origin + rotation @ [0.0, 0.0, 0.1], 6)
    found, directions = estimated_force(jacobian.T @ force, jacobian)
    assert directions == 3
    np.testing.assert_allclose(found, force, atol=1e-9)
    rig = Plant(ARMS["rig"]())  # upright: its first link feels what is across it, along x
    jacobian = rig.jacobian(np.array([0.0, 0.0, 0.2]), 0)
    found, directions = estimated_force(jacobian.T @ force, jacobian)
    assert directions == 1
    np.testing.assert_allclose(found, [5.0, 0.0, 0.0], atol=1e-9)
    assert estimated_force(np.zeros(2), np.zeros((3, 2)))[1] == 0


def test_a_push_stays_on_its_link_and_belongs_to_who_took_hold():
    simulation = Simulation(ARMS["rig"]())
    point = simulation.plant.body_pose(1)[0] + [0.0, 0.12, 0.1]
    simulation.grab("one", 1, point)
    simulation.pull("other", point + 1.0)
    simulation.release("other")
    np.testing.assert_array_equal(simulation.drag.target_m, point)
    simulation.pull("one", point + 1.0)
    simulation.release("one")
    assert simulation.drag is None


def pushed(simulation, joint, force_direction, steps=1000):
    """Drag a point of this joint's link this way for so many samples; the alarms."""
    origin, rotation = simulation.plant.body_pose(joint)
    point = origin + rotation @ [0.0, 0.0, 0.25]
    simulation.grab("test", joint, point)
    simulation.pull("test", point + 0.3 * np.asarray(force_direction))
    for _ in range(steps):
        simulation.step()
    return simulation.take_events()


def test_a_push_raises_the_alarm_at_the_joint_that_feels_it(trained):
    first = pushed(watched(trained), 0, [1.0, 0.0, 0.0])
    assert {e.joint for e in first if e.method == "tauext"} == {0}
    simulation = watched(trained)
    simulation.mover._start = simulation.mover.q_des + [0.0, 1.2]
    for _ in range(3000):  # the elbow bends, the monitor settles
        simulation.step()
    simulation.resume()
    simulation.mover._plan(0.0, np.zeros(2), 1e6)
    for _ in range(round(2000 * RESUME_S)):
        simulation.step()
    simulation.snapshot()
    origin, rotation = simulation.plant.body_pose(1)
    towards_shoulder = -(origin + rotation @ [0.0, 0.0, 0.25])  # no lever about joint 1
    towards_shoulder[1] = 0.0
    second = pushed(simulation, 1, towards_shoulder / np.linalg.norm(towards_shoulder), steps=300)
    assert second and {e.joint for e in second if e.method == "tauext"} == {1}
    assert all(e.after_push_s is not None and e.after_push_s < 0.3 for e in first + second)


def test_the_delay_counts_from_the_contact_torque_over_the_limit_and_not_from_the_grab(trained):
    simulation = watched(trained)
    origin, rotation = simulation.plant.body_pose(0)
    point = origin + rotation @ [0.0, 0.0, 0.25]
    simulation.grab("test", 0, point)  # held for half a second before it pulls
    for _ in range(500):
        simulation.pull("test", simulation.drag.point_m(simulation.plant))
        simulation.step()
    assert not simulation.take_events()
    over_s = None
    simulation.pull("test", point + [0.3, 0.0, 0.0])
    for _ in range(200):
        simulation.step()
        if over_s is None and (np.abs(simulation.tau_ext_nm) > simulation._estimates["tauext"].limit_nm).any():
            over_s = simulation.plant.time_s
    (event,) = [e for e in simulation.take_events() if (e.method, e.alarm) == ("tauext", "collision")]
    assert event.after_push_s > 0.5
    assert event.after_limit_s == pytest.approx(event.time_s - over_s) and event.after_limit_s < 0.1


def test_reactions_change_what_the_arm_does(trained):
    where = {}
    for reaction in ("stop", "comply", "ignore"):
        simulation = watched(trained, reaction)
        before = simulation.plant.data.qpos.copy()
        assert any(e.alarm == "collision" for e in pushed(simulation, 1, [1.0, 0.0, 0.0], steps=1500))
        assert simulation.mover.doing == {"ignore": "moving"}.get(reaction, reaction)
        where[reaction] = np.abs(simulation.plant.data.qpos - before).max()
    assert where["stop"] < 0.02  # a stiff drive bends by torque / stiffness
    assert where["comply"] > 5 * where["stop"]


def test_a_retreat_goes_back_the_way_it_came_without_a_jump(arm):
    mover, rest = Mover(arm), np.zeros(len(arm.joints))
    path = [mover.step(rest, rest, rest)[0] for _ in range(1500)]
    mover.react("retreat")
    path += [mover.step(rest, rest, rest)[0] for _ in range(1000)]
    speed = np.diff(path, axis=0) * arm.rate_hz
    jump = np.abs(np.diff(speed[1400:], axis=0)).max()
    assert jump < 0.05  # 50 rad/s^2; a speed that ends at once leaves all of it
    assert np.abs(speed[1499]).max() > 0.15
    np.testing.assert_allclose(path[-1], path[1500 - 400], atol=0.03)  # where it was 0.4 s before, to one trail point


def test_a_stop_comes_to_rest_and_resume_moves_on(arm):
    mover, rest = Mover(arm), np.zeros(len(arm.joints))
    for _ in range(1500):
        mover.step(rest, rest, rest)
    mover.react("stop")
    held = [mover.step(rest, rest, rest) for _ in range(300)]
    np.testing.assert_array_equal(held[-1][1], 0.0)
    np.testing.assert_array_equal(held[-1][0], held[220][0])
    mover.resume()
    assert np.abs(mover.step(rest, rest, rest)[0] - held[-1][0]).max() < 1e-3
    for _ in range(1000):
        mover.step(rest, rest, rest)
    assert np.abs(mover.q_des - held[-1][0]).max() > 0.01


def test_more_friction_is_felt_and_leaves_the_state(arm):
    plant = Plant(arm)
    for _ in range(50):
        plant.step(np.array(arm.home) + 0.01, np.zeros(len(arm.joints)))
    before = plant.data.qpos.copy(), plant.data.qvel.copy()
    plant.set_friction(2.0)
    np.testing.assert_array_equal(plant.data.qpos, before[0])
    np.testing.assert_array_equal(plant.data.qvel, before[1])


def test_a_higher_sensitivity_holds_from_the_next_sample_on(trained):
    simulation = watched(trained)
    simulation.set_method("observer")  # its limits are the same at rest and in motion
    limits = simulation.snapshot().limit_nm
    simulation.set_sensitivity(2.0)
    simulation.step()
    assert simulation._estimates["observer"].health.name == "ok"
    np.testing.assert_allclose(simulation.snapshot().limit_nm, limits / 2)
    with pytest.raises(ConfigError, match=r"sensitivity = 0 must be 0\.1 to 10"):
        simulation.set_sensitivity(0)


def test_a_snapshot_drops_what_nobody_asked_for(trained):
    simulation = watched(trained)
    for _ in range(5000):
        simulation.step()
    assert len(simulation.snapshot().trace) == 100


def test_scripted_pushes_are_found(trained):
    pushes, false = scripted_pushes(ARMS["rig"](), trained, 5.0, seed=0)
    assert len(pushes) == 1 and pushes[0].joint == 1
    assert any(e.method == "tauext" and e.alarm == "collision" for e in pushes[0].events)
    assert "push on the link of joint2" in describe(pushes, false, ARMS["rig"]())


def test_what_a_push_left_in_static_friction_is_no_collision_after_resume_and_a_push_is(trained):
    simulation = Simulation(ARMS["rig"]())
    simulation.watch_with({"tauext": str(trained["tauext"])}, "tauext")
    simulation.set_sensitivity(0.65)  # limits from so little motion cost a false alarm, here in braking

    def step(steps):
        for _ in range(steps):
            simulation.step()
        return simulation._estimates["tauext"].alarm.name

    step(3000)
    simulation.rest()
    assert step(1500) == "none"
    pushed(simulation, 0, [1.0, 0.0, 0.0])
    simulation.release("test")
    assert step(500) == "collision"
    simulation.monitors["tauext"].acknowledge()
    assert step(50) == "collision"  # again, though nothing pushes
    simulation.resume()
    simulation.take_events()
    step(200)
    assert not simulation.take_events()
    found = [e for e in pushed(simulation, 0, [1.0, 0.0, 0.0]) if e.alarm == "collision"]
    assert [e.joint for e in found] == [0] and found[0].after_push_s < 0.1


def test_an_alarm_of_a_method_blind_to_stiction_is_told_when_the_joints_have_moved(trained):
    """It was acknowledged since resume(); one that went unsaid would stand for ever, and hide every other."""
    simulation = watched(trained)
    pushed(simulation, 1, [1.0, 0.0, 0.0])
    simulation.drag = None
    simulation.resume()
    simulation.take_events()
    for _ in range(200):
        simulation.step()
    simulation.set_sensitivity(10.0)  # everything is a collision now
    raised = []
    for _ in range(3000):
        simulation.step()
        raised += [(e, simulation.plant.data.qpos.copy()) for e in simulation.take_events() if e.method == "observer"]
    event, where = next((e, q) for e, q in raised if e.alarm == "collision")
    moved = np.abs(where - simulation._resumed_at).min()
    assert moved > 0.9 * RESUME_RAD or event.time_s - simulation._resumed_s >= RESUME_S


def test_bundles_are_found_again_and_only_for_the_same_settings(trained, tmp_path):
    arm, cache = ARMS["rig"](), trained["tauext"].parent.parent
    folder = bundle_folder(arm, "exact", SHORT, 0, cache)
    assert find_bundles(folder, SHORT) == trained
    others = [
        bundle_folder(arm, "none", SHORT, 0, cache),
        bundle_folder(arm, "exact", SHORT, 1, cache),
        bundle_folder(arm, "exact", replace(SHORT, recordings=5), 0, cache),
        bundle_folder(ARMS["seven"](), "exact", SHORT, 0, cache),
    ]
    assert len({folder, *others}) == 5 and not any(find_bundles(other, SHORT) for other in others)
    copy = tmp_path / folder.name
    copy.mkdir()
    for path in trained.values():
        (copy / path.name).write_bytes(path.read_bytes()[:-100])
    assert find_bundles(copy, SHORT) is None


@pytest.mark.parametrize("how", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_an_interrupted_training_leaves_nothing(tmp_path, how):
    def stop(share, what):
        if share > 0.1:
            raise how

    with pytest.raises(how):
        train_bundles(ARMS["rig"](), "exact", SHORT, 0, tmp_path, stop)
    assert not list(tmp_path.iterdir())


def test_what_a_killed_training_left_goes_after_a_day(tmp_path, monkeypatch):
    old, new = tmp_path / "a.part-1", tmp_path / "a.part-2"
    old.mkdir()
    new.mkdir()
    made_s = old.stat().st_mtime
    os.utime(new, (made_s + 2, made_s + 2))
    monkeypatch.setattr(demo_bundles.time, "time", lambda: made_s + demo_bundles.STALE_S + 1)
    demo_bundles._sweep(tmp_path)
    assert not old.exists() and new.exists()


def test_the_cache_stands_where_xdg_says(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "tauext" / "demo"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the specification says to ignore it
    assert cache_folder() == Path.home() / ".cache" / "tauext" / "demo"
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ConfigError, match="bundles cannot be kept there .* set XDG_CACHE_HOME"):
        train_bundles(ARMS["rig"](), "exact", SHORT, 0, file)
    with pytest.raises(ConfigError, match="error = wrong must be one of exact, mass, none"):
        train_bundles(ARMS["rig"](), "wrong", SHORT, 0, tmp_path)


def test_every_arm_has_a_lesson():
    assert LESSONS.keys() == ARMS.keys()


def test_the_clock_gives_up_time_that_is_lost(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(workers.time, "perf_counter", lambda: now[0])
    clock = workers.RealTime(0.001)
    now[0] += 0.0105
    assert clock.due() == 10
    now[0] += 5.0
    assert clock.due() == 1
    now[0] += 0.0025
    assert clock.due() == 2
    assert clock.factor() < 0.1


def test_the_simulation_runs_in_a_process_that_ends_with_its_pipe(trained):
    process, pipe = start_worker(workers.run_simulation, "rig", 0)
    pipe.send(("watch_with", {name: str(path) for name, path in trained.items()}, "tauext"))
    pipe.send(("no_such_command",))
    pipe.send((workers.SNAPSHOT,))
    assert pipe.poll(30)
    snapshot = pipe.recv()
    assert snapshot.method == "tauext" and snapshot.poses.shape == (2, 7)
    pipe.send(("hold", 2.0, True))  # the rig has no hand; it goes on
    pipe.send((workers.RECENT,))
    assert pipe.poll(30)
    stretch = pipe.recv()
    assert stretch.q.shape == (len(stretch.t_ns), 2) and (np.diff(stretch.t_ns) == 1_000_000).all()
    pipe.close()
    process.join(10)
    assert process.exitcode == 0


def test_a_busy_port_is_passed_over(monkeypatch):
    import socket

    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        assert free_port("127.0.0.1", port) > port
        monkeypatch.setattr("tauext.page.door.PORTS", 1)
        with pytest.raises(ConfigError, match=f"port = {port}: .* in use; choose another with --port"):
            free_port("127.0.0.1", port)
    with pytest.raises(ConfigError, match="port = 0 must be 1 to 65535"):
        free_port("127.0.0.1", 0)
    with pytest.raises(ConfigError, match="host = 192.0.2.1 must be an address of this machine"):
        free_port("192.0.2.1", 8080)


def test_a_missing_viser_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match=r"pip install 'tauext\[live\]'"):
        open_server("127.0.0.1", 8080)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--headless-seconds", "0"], "headless_seconds = 0.0 must be above 0, at most 3600"),
        (["--seed", "-1"], "seed = -1 must be >= 0"),
        (["--port", "99999", "--no-open"], "port = 99999 must be 1 to 65535"),
    ],
)
def test_wrong_options_are_refused(capsys, arguments, message):
    assert main(["demo", *arguments]) == 2
    assert message in capsys.readouterr().err
