"""The weight in the hand of the demo's seven-axis arm: its physics, who is told of it, and what is weighed."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from made_page import SHORT, SMOOTH_ARM, smooth_bundle

from tauext.bundle.bundle_file import load_bundle
from tauext.errors import ConfigError
from tauext.page.bundles import bundle_folder
from tauext.page.headless import carried_weights, describe_weights
from tauext.page.panel import hand_text
from tauext.page.simulation import EVERY_S, LEAST_S, WEIGHED_S, Simulation, Weigher, weigh, weighed_words
from tauext.page.snapshot import Held, ball
from tauext.sim.arms import ARMS
from tauext.sim.plant import Mover, Plant

LIMIT_NM = 3.0
"""What the observer leaves of an arm without friction is torque noise, a tenth of it; 2 kg weigh 10 N m and more."""


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    """An observer that may be told of loads, and one that may not."""
    folder = tmp_path_factory.mktemp("hand")
    bundle, _ = smooth_bundle(folder, LIMIT_NM)
    bundle.assume_load()
    bundle.save(str(folder / "tauext.tauext"))
    settings = bundle.load_settings
    settings.refused = "this one takes none"
    bundle.load_settings = settings
    bundle.save(str(folder / "deaf.tauext"))
    return {"tauext": folder / "tauext.tauext", "deaf": folder / "deaf.tauext"}


def moving(bundles, method="tauext"):
    """Two seconds after its start; it goes on whatever is said."""
    simulation = Simulation(SMOOTH_ARM, seed=1)
    simulation.watch_with({name: str(path) for name, path in bundles.items()}, method)
    simulation.set_reaction("ignore")
    run(simulation, 2.0)
    return simulation


def run(simulation, seconds):
    """Collisions in so many seconds, by method."""
    found = {}
    for _ in range(round(seconds * simulation.arm.rate_hz)):
        simulation.step()
        for event in simulation.take_events():
            if event.alarm == "collision":
                found.setdefault(event.method, event)
    return found


def test_the_weights_torque_is_the_difference_of_two_arms():
    arm = ARMS["seven"]()
    plant, mover, load = Plant(arm), Mover(arm), ball(arm, 3.0)
    plant.hold(load)
    for _ in range(500):
        q, dq = plant.data.qpos.copy(), plant.data.qvel.copy()
        sample = plant.step(*mover.step(q, dq, plant.gravity_nm))
    needed = []
    for model in (arm.model, arm.changed_model(1.0, load)):
        data, torque = mujoco.MjData(model), np.zeros(7)
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_forward(model, data)
        data.qacc[:] = plant.data.qacc
        mujoco.mj_rne(model, data, 1, torque)
        needed.append(torque)
    np.testing.assert_allclose(sample.tau_held, needed[0] - needed[1], atol=5e-3)  # speeds are of one step later
    assert np.abs(sample.tau_held).max() > 5.0
    plant.hold(None)
    assert not plant.step(q, dq).tau_held.any()


def test_more_friction_leaves_the_weight_in_the_hand():
    plant = Plant(SMOOTH_ARM)
    plant.hold(ball(SMOOTH_ARM, 2.0))
    plant.set_friction(2.0)
    assert plant.model.body("held").mass == 2.0
    assert plant.model.nv == 7


def test_a_weight_that_nobody_told_of_is_a_collision_and_is_weighed(bundles):
    simulation = moving(bundles)
    simulation.hold(2.0, load_set=False)
    found = run(simulation, 3.0)["tauext"]
    assert found.by_weight and found.after_push_s is None and found.time_s < 2.2
    snapshot = simulation.snapshot()
    assert snapshot.poses.shape == (7, 7) and snapshot.held == Held(2.0, 1.999, False, "")
    np.testing.assert_allclose(snapshot.trace[-1, 22:], simulation._sample.tau_held, atol=0.05)  # the truth for it
    weighed = weigh(load_bundle(bundles["tauext"]), SMOOTH_ARM, simulation.recent())
    assert weighed.verdict == "load" and abs(weighed.mass_kg - 2.0) < 0.05
    np.testing.assert_allclose(weighed.com_m[2], SMOOTH_ARM.hand_m, atol=0.02)
    assert weighed_words(weighed).startswith(f"Fits a load of {weighed.mass_kg:.2f} ±")
    origin, rotation = simulation.plant.body_pose(6)
    simulation.grab("test", 6, origin + rotation @ [0.0, 0.0, 0.1])
    simulation.pull("test", origin + [0.0, 0.4, 0.3])
    run(simulation, 4.0)
    pushed = weigh(load_bundle(bundles["tauext"]), SMOOTH_ARM, simulation.recent())
    assert pushed.verdict == "contact" and "something touches the arm" in weighed_words(pushed)
    assert simulation.monitors["tauext"].load.mass == 0.0


def test_a_weight_that_was_told_is_no_push_and_neither_is_its_going(bundles):
    simulation = moving(bundles)
    simulation.hold(3.0, load_set=True)
    found = run(simulation, 1.5)
    assert list(found) == ["deaf"] and found["deaf"].by_weight
    assert simulation.hand.held("tauext") == Held(3.0, 1.999, True, "")
    assert not simulation.tau_ext_nm.any()
    simulation.let_go()
    assert list(run(simulation, 1.0)) in ([], ["deaf"])
    assert simulation.snapshot().held is None and simulation.monitors["tauext"].load.mass == 0.0


def test_told_afterwards_is_as_told_in_time(bundles):
    estimates = []
    for late in (False, True):
        simulation = moving(bundles)
        simulation.hold(2.0, load_set=not late)
        run(simulation, 1.0)
        if late:
            simulation.set_load(True)
        run(simulation, 0.001)
        estimates.append(np.array(simulation._estimates["tauext"].tau_ext))
    np.testing.assert_allclose(*estimates, atol=0.05)  # of 10 N m and more; e^-10 of them is left
    simulation.set_load(False)
    assert np.abs(estimates[0]).max() < 1.0
    run(simulation, 0.5)
    assert np.abs(simulation._estimates["tauext"].tau_ext).max() > LIMIT_NM


def test_monitors_that_come_later_are_told_too_and_a_refusal_is_given_its_reason(bundles):
    simulation = moving(bundles, "deaf")
    simulation.hold(2.0, load_set=True)
    run(simulation, 0.01)
    simulation.watch_nothing()
    simulation.watch_with({name: str(path) for name, path in bundles.items()}, "deaf")
    assert simulation.monitors["tauext"].load.mass == 2.0
    held = simulation.snapshot().held
    assert not held.load_set and "this one takes none" in held.refused
    assert "refused the load" in hand_text(held, "", True) and "this one takes none" in hand_text(held, "", True)


def test_moving_on_reacts_to_nothing_for_a_while(bundles):
    simulation = moving({"tauext": bundles["tauext"]})
    simulation.set_reaction("stop")
    simulation.hold(3.0, load_set=False)
    run(simulation, 0.3)
    assert simulation.mover.doing == "stop"
    simulation.move_on()
    assert "tauext" in run(simulation, 1.0)
    assert simulation.mover.doing == "moving"


def test_only_an_arm_with_a_hand_takes_weights_of_those_on_offer():
    with pytest.raises(ConfigError, match="arm rig has no hand"):
        Simulation(ARMS["rig"]()).hold(2.0, True)
    with pytest.raises(ConfigError, match="mass_kg = 9 must be 1 to 3"):
        Simulation(SMOOTH_ARM).hold(9.0, True)
    assert carried_weights(ARMS["rig"](), {}, seed=0) == []


def test_bundles_know_nothing_of_the_hand(tmp_path):
    folders = {
        bundle_folder(replace(SMOOTH_ARM, hand_m=hand_m), "exact", SHORT, 0, tmp_path) for hand_m in (None, 0.2, 0.3)
    }
    assert len(folders) == 1


def test_an_arm_that_stands_is_weighed_no_more_and_a_new_weight_is():
    weigher = Weigher(SMOOTH_ARM)

    def wants(time_s, doing, since_s=10.0):
        held = None if since_s is None else Held(2.0, since_s, False, "")
        return weigher.wants(SimpleNamespace(time_s=time_s, doing=doing, held=held))

    assert not wants(9.0, "moving", None) and weigher.words == ""
    assert wants(10.1, "moving") and weigher.words == "Weighing ..."
    assert not wants(10.2, "moving")  # not again so soon
    assert wants(10.2 + EVERY_S, "stop")  # what it did before is still in the last seconds
    weigher.words = "said"
    assert not wants(10.3 + WEIGHED_S - LEAST_S, "stop") and weigher.words == "said"
    assert wants(20.0, "stop", since_s=19.9) and weigher.words == "Weighing ..."


def test_the_script_puts_a_weight_in_untold_and_told(bundles):
    told_nothing, told = carried_weights(SMOOTH_ARM, bundles, seed=0, held_s=1.5)
    assert told_nothing.mass_kg == told.mass_kg and 1.0 <= told.mass_kg <= 3.0
    assert "tauext" in told_nothing.collisions and "tauext" not in told.collisions
    lines = describe_weights([told_nothing, told], SMOOTH_ARM, bundles).splitlines()
    assert lines[0].endswith("kg into the hand, not set in the monitors") and lines[4].endswith(
        "kg into the hand, set in the monitors"
    )
    assert lines[6] == "          tauext    nothing" and "this one takes none" in lines[5]
    assert lines[3].startswith("          weighed   Fits a load of")
