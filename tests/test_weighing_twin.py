"""Loads that the core finds beside those that NumPy does, and weighed inside the loop beside a recording."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import slow_weighing
from made_arms import six_axis, urdf
from made_live import Keeper, ScriptedSource, samples_of
from made_recordings import Drive, made_motion

from tauext import _core
from tauext.cli.json_lines import found_facts
from tauext.cli.text_lines import weigh_words
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.changes import WeighChange
from tauext.monitor.control_lines import obey
from tauext.monitor.loop import Loop
from tauext.monitor.weighing import identify, load_frame, see
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters
from tauext.robot.load import load_tree

MASS, COM = 1.6, np.array([0.03, -0.05, 0.08])
QUIET = Drive(friction=0.0, noise=0.003)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> _core.Tree:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(urdf(six_axis()))
    return load_tree(path)


def carrying(tree: _core.Tree, mass: float, com: np.ndarray) -> _core.Tree:
    links = tree.links
    inertia = 6e-4 * mass * np.eye(3) + mass * (com @ com * np.eye(3) - np.outer(com, com))
    phi = np.r_[mass, mass * com, np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2], 0.0]
    links[-1] = with_inertial_parameters(links[-1], inertial_parameters(links[-1]) + phi)
    return _core.Tree(links, tree.gravity)


@pytest.fixture(scope="module")
def recordings(arm) -> dict[str, Recording]:
    def moved(tree: _core.Tree, seed: int) -> Recording:
        return made_motion(tree, 0.2, pieces=1, seed=seed, drive=QUIET).recordings[0]

    free = moved(arm, 4)
    weight = _core.Tree(arm.links, [20.0, 5.0, 0.0])  # beta of a weight along these axes is what pushes
    pull = _core.load_columns(weight, _core.LoadFrame(5), free.q, 0 * free.dq)[1][..., 0]
    return {
        "free": free,
        "loaded": moved(carrying(arm, MASS, COM), 3),
        "pushed": replace(free, tau=free.tau + pull),
        "lifted": moved(carrying(arm, -0.5, COM), 5),
    }


def bundle_of(tree: _core.Tree, recording: Recording, rubs: bool = False) -> _core.Bundle:
    """The plain observer; rubs: with a prior whose gears rub more under a load."""
    bundle = make_bundle("arm", build_setup(tree, recording, ObserverConfig()), 0.02, recording)
    spread = recording.tau.std(axis=0)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = (5 * (0.01 * spread + 0.02)).tolist()
    bundle.possible_torque_nm = [1e6] * tree.size
    if rubs:
        prior = _core.PriorSettings()
        prior.terms = [_core.Term(_core.TermKind.load, j, speed=0.05) for j in range(tree.size)]
        prior.weights = (-0.1 * np.eye(tree.size)).ravel().tolist()
        bundle.prior = prior
    return bundle


@pytest.mark.parametrize("what", ["free", "loaded", "pushed", "lifted"])
@pytest.mark.parametrize("rubs", [False, True])
def test_the_core_finds_what_numpy_does(arm, recordings, what, rubs):
    bundle = bundle_of(arm, recordings["free"], rubs)
    frame, seen = load_frame(bundle), see(bundle, recordings[what])
    for parts in ([seen], [seen.part(seen.time_s < 3.0), seen.part((seen.time_s > 4.0) & (seen.time_s < 5.5))]):
        found, slow = identify(bundle, frame, parts), slow_weighing.identify(bundle, frame, parts)
        assert found.verdict == slow.verdict
        assert found.seconds == pytest.approx(slow.seconds)
        for name in ("mass_kg", "mass_error_kg", "misfit"):
            assert getattr(found, name) == pytest.approx(getattr(slow, name), rel=1e-8, abs=1e-9), name
        for name in ("com_m", "com_error_m", "phi", "covariance", "com_covariance"):
            was, now = getattr(slow, name), getattr(found, name)
            np.testing.assert_allclose(now, was, rtol=1e-7, atol=1e-9 * np.abs(was).max(), err_msg=name)
        assert (found.mass_seen, found.at_bound) == (slow.mass_seen, slow.at_bound)
        assert len(found.unseen) == len(slow.unseen)
        for kind, fit in found.fits.items():
            assert fit.cost == pytest.approx(slow.fits[kind].cost, rel=1e-8), kind
            np.testing.assert_allclose(fit.values, slow.fits[kind].values, rtol=1e-7, atol=1e-8, err_msg=kind)
            assert fit.correlation == pytest.approx(slow.fits[kind].noise.correlation)


def test_sums_are_those_of_numpy():
    rng = np.random.default_rng(1)
    z, sigma = rng.standard_normal((250, 3, _core.LoadSums.COLUMNS)), rng.uniform(0.1, 1, (250, 3))
    worth, sums, slow = rng.uniform(0, 1, (250, 3)), _core.LoadSums(3), slow_weighing.Normal.empty(3)
    slow.gram, slow.blocks = np.zeros((2, 3, 20, 20))
    for rows in (slice(0, 130), slice(130, 250)):
        sums.add(z[rows], sigma[rows], worth[rows])
        slow.add(z[rows], sigma[rows], worth[rows])
    np.testing.assert_allclose(sums.whole, slow.gram, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(sums.blocks, slow.blocks, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(sums.worth, slow.worth)
    assert sums.rows == 250
    with pytest.raises(_core.CoreError, match=r"must have the shape \(rows, 3, 20\)"):
        sums.add(z[:, :2].copy(), sigma, worth)
    with pytest.raises(_core.CoreError, match="sigma and worth"):
        sums.add(z, sigma[:5], worth)


def settable(bundle: _core.Bundle) -> _core.Bundle:
    bundle.assume_load()
    return bundle


def test_the_monitor_finds_what_the_command_does(arm, recordings):
    loaded = recordings["loaded"]
    bundle = settable(bundle_of(arm, recordings["free"]))
    monitor = _core.Monitor(bundle)
    assert monitor.why_no_weighing() == "" and not monitor.weighing
    monitor.start_weighing()
    monitor.run(loaded.t_ns, loaded.q, loaded.dq, loaded.tau)
    assert monitor.weighing
    found, whole = monitor.estimate_load(), identify(bundle, load_frame(bundle), [see(bundle, loaded)])
    assert found.verdict == "load"
    assert found.seconds == whole.seconds
    assert abs(found.mass_kg - whole.mass_kg) < 0.01 * whole.mass_error_kg
    assert np.linalg.norm(found.com_m - whole.com_m) < 1e-4
    assert abs(found.load.mass - MASS) < 0.02
    load = found.load
    monitor.set_load(load.mass, load.com, load.inertia, error_share=load.error_share)
    assert monitor.estimate_load().verdict == "too little"
    again = replace(loaded, t_ns=loaded.t_ns + loaded.t_ns[-1] + 10_000_000)
    monitor.run(again.t_ns, again.q, again.dq, again.tau)
    rest = monitor.estimate_load()
    assert rest.verdict == "nothing" and abs(rest.mass_kg) < 0.05
    assert abs(rest.load.mass - MASS) < 0.02
    monitor.stop_weighing()
    assert not monitor.weighing


def test_where_nothing_can_be_weighed_says_why(arm, recordings):
    bundle = bundle_of(arm, recordings["free"])
    with pytest.raises(_core.CoreError, match="reach of a load = 0 m must be above 0"):
        _core.Monitor(settable(bundle)).start_weighing(0.0)
    bundle.load_settings = _core.LoadSettings()
    with pytest.raises(_core.CoreError, match="no load can be weighed: the bundle names no frame for a load"):
        _core.Monitor(bundle).start_weighing()


def test_two_loads_are_one(arm):
    one, two = _core.Load(1.0, [0.1, 0.0, 0.0], [0.01, 0.02, 0.02, 0, 0, 0]), _core.Load(3.0, [-0.1, 0.0, 0.2])
    both = _core.loads_together(one, two)
    np.testing.assert_allclose([both.mass, *both.com], [4.0, -0.05, 0.0, 0.15])
    # Steiner: 1 kg and 3 kg apart by (0.2, 0, 0.2) m turn about their centre as 0.75 kg there
    np.testing.assert_allclose(both.inertia, [0.04, 0.08, 0.05, 0, 0.03, 0], atol=1e-12)


def test_a_live_monitor_weighs_when_a_line_asks(arm, recordings, capsys):
    bundle, loaded = settable(bundle_of(arm, recordings["free"])), recordings["loaded"]
    unreachable = ["0", "1e9", "nan", "-1"]
    lines = {
        19: [f"weigh reach={reach}" for reach in unreachable],
        20: ["weigh reach=far", "weigh now", "weigh reach=0.25"],
        40: ["weigh tell"],
        700: ["weigh tell", "weigh stop"],
    }
    said: list[str] = []

    def ask(verdict):
        for line in lines.get(verdict.row, ()):
            said.append(obey(line, keeper.control, "a line"))

    keeper = Keeper(ask)
    loop = Loop(bundle, ScriptedSource(samples_of(loaded, slice(0, 800))), [keeper])
    loop.run()
    rule = "must be 0.001 to 100 m, how far away a load's centre of mass may be"
    assert said[:4] == [f"error: reach = {float(reach)} {rule}" for reach in unreachable]
    choices = "must be `reach=METRES`, `tell`, `stop` or nothing"
    assert said[4:6] == [f"error: weigh: {text!r} {choices}" for text in ("reach=far", "now")]
    assert said[6:] == ["ok"] * 4
    told = [change for change in keeper.changes if isinstance(change, WeighChange)]
    assert [(one.row, one.what, one.by) for one in told] == [
        (21, "start", "a line"), (41, "tell", "a line"), (701, "tell", "a line"), (701, "stop", "a line"),
    ]  # fmt: skip
    assert told[0].found is None and told[1].found.verdict == "too little"
    assert abs(told[2].found.mass_kg - MASS) < 0.05 and told[2].found.reach_m == 0.25
    assert not loop.monitor.weighing
    sentences = [weigh_words(change) for change in told]
    assert sentences[0] == ["weighs what the arm carries beside nothing, by a line"]
    assert sentences[1] == ["0.00 s of healthy motion are too little to weigh a load"]
    assert sentences[2][0].startswith("load 1.6")
    facts = found_facts(told[2])
    assert facts["found"]["verdict"] == "load" and json.loads(json.dumps(facts)) == facts
    assert facts["load"]["mass_kg"] == told[2].found.load.mass and 0 < facts["load"]["error_share"] <= 1
    bundle.load_settings = _core.LoadSettings()
    with pytest.raises(ConfigError, match="the bundle names no frame for a load"):
        Loop(bundle, ScriptedSource([])).weigh("start", "test")
