"""The gripper's word: a step that fits a load is weighed and set, and told; what does not fit is a collision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_arms import six_axis_tree
from made_bundles import without_constants
from made_live import Keeper, ScriptedSource, samples_of

from tauext import _core
from tauext._core import Load, LoadPhase
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.cell_file import load_cell
from tauext.monitor.changes import ChangeFinder, FoundLoad
from tauext.monitor.control_lines import obey
from tauext.monitor.loads import Expected, expected_of_text
from tauext.monitor.loop import Loop

PICKED, SAMPLES = 2500, 6500
MASS = 1.6
LIMITS = [6.0, 6.0, 5.0, 1.5, 1.5, 1.5]


def drive_torque(tree: _core.Tree, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Averages over the steps of what the drives exert."""
    p, beta = tree.momentum(q, dq)
    mean = np.vstack([beta[:1], 0.5 * (beta[1:] + beta[:-1])])
    return mean + np.vstack([np.zeros((1, 6)), np.diff(p, axis=0) / 1e-3])


@pytest.fixture(scope="module")
def arm(empty):
    return knowing_bundle(empty)


def knowing_bundle(tree: _core.Tree) -> tuple[_core.Bundle, Recording]:
    """A bundle that knows the empty arm exactly, and its motion as it picks up MASS."""
    rng = np.random.default_rng(4)
    t = np.arange(SAMPLES) * 1e-3
    size, speed, phase = rng.uniform(0.3, 0.9, (1, 6)), rng.uniform(0.8, 2.2, (1, 6)), rng.uniform(0, 6, (1, 6))
    q, dq = size * np.sin(speed * t[:, None] + phase), size * speed * np.cos(speed * t[:, None] + phase)
    tau = drive_torque(tree, q, dq)
    joints = tuple(link.joint_name for link in tree.links)
    free = Recording("picks", joints, np.round(t * 1e9).astype(np.int64), q, dq, tau, 1000.0, "averaged", "t", "5" * 64)
    bundle = make_bundle("six", build_setup(tree, free, ObserverConfig(window_s=0.1)), 0.02, free)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = LIMITS
    bundle.contact_sliding_limit_nm = bundle.contact_near_stiction_limit_nm = LIMITS
    links = tree.links
    at = bundle.load_settings
    links[at.link] = at.merged(Load(MASS, [0.03, -0.02, 0.06]), links[at.link])
    tau = tau.copy()
    tau[PICKED + 1 :] = drive_torque(_core.Tree(links, tree.gravity), q, dq)[PICKED + 1 :]
    return bundle, replace(free, tau=tau)


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    return six_axis_tree(tmp_path_factory.mktemp("arm"))


def rows(recording: Recording, begin: int, end: int | None) -> list[np.ndarray]:
    whole = recording.signals
    return [np.ascontiguousarray(a[begin:end]) for a in whole]


def in_amperes(bundle: _core.Bundle) -> _core.Bundle:
    """The bundle whose last joint answers in amperes: how far off its axis a load is stays open for a while."""
    less = without_constants(_core.Bundle.from_bytes(bundle.to_bytes()), [5])
    less.sliding_limit_nm = less.near_stiction_limit_nm = [*LIMITS[:5], 10 * LIMITS[5]]  # its own weight is in r there
    less.contact_sliding_limit_nm = less.contact_near_stiction_limit_nm = less.sliding_limit_nm
    less.largest_torque_nm = [100.0] * 6
    prior = less.prior
    prior.most_load_nm = [60.0] * 6
    less.prior = prior
    less.answer_reference()
    return less


@pytest.mark.parametrize("bundle_of", [lambda bundle: bundle, in_amperes])
def test_a_load_that_is_expected_is_weighed_and_set(arm, bundle_of):
    bundle, picks = arm
    monitor = _core.Monitor(bundle_of(bundle))
    monitor.run(*rows(picks, 0, PICKED - 200))
    monitor.expect_load(2.0, 3.0)
    said = monitor.run(*rows(picks, PICKED - 200, None))
    assert (said["alarm"] == 0).all() and monitor.load.mass == pytest.approx(MASS, rel=0.05)
    phases = [LoadPhase(phase).name for phase in dict.fromkeys(said["load_phase"].tolist())]
    assert phases == ["expecting", "deciding", "found", "weighing"]
    usual = 0.05 / 3**0.5 * MASS  # constants known to 5 % each, as if three joints weighed it
    assert bundle_of is in_amperes or usual < monitor.last.load_error_kg < 0.2
    assert picks.t_ns[PICKED] < monitor.last.load_found_ns and np.abs(said["load_nm"][-1]).max() == 0


def test_a_line_of_text_says_what_is_expected():
    assert expected_of_text("seconds=3 at_most=2.5") == Expected(3.0, 2.5)
    assert expected_of_text("at_most = 2, seconds = 1") == Expected(1.0, 2.0)


@pytest.mark.parametrize(
    "text", ["", "3 2.5", "seconds=3", "seconds=3 at_most=x", "seconds=3 kg=2", "seconds=3 seconds=3"]
)
def test_a_line_that_says_none_is_refused(text):
    with pytest.raises(ConfigError, match="expect"):
        expected_of_text(text)


@pytest.mark.slow
def test_a_live_monitor_obeys_a_line_and_reports_what_was_found(arm):
    bundle, picks = arm
    said: list[str] = []

    def ask(verdict):
        if verdict.row == PICKED - 200:
            said.append(obey("expect seconds=99 at_most=3", keeper.control, "a line"))
            said.append(obey("expect seconds=2 at_most=3", keeper.control, "a line"))

    keeper = Keeper(ask)
    Loop(bundle, ScriptedSource(samples_of(picks, slice(0, SAMPLES))), [keeper]).run()
    assert said[0].startswith("error: a payload can be expected for 60 s") and said[1] == "ok"
    told = [change for change in keeper.changes if isinstance(change, FoundLoad)]
    assert 1 <= len(told) <= 4 and told[-1].mass_kg == pytest.approx(MASS, abs=2 * told[-1].error_kg)
    assert PICKED < told[0].row < PICKED + 1000
    assert all(verdict.estimates["alarm"][0] == 0 for verdict in keeper.verdicts)
    assert told[0].words(())[0].startswith("the expected payload was picked up: carries 1.")
    assert "carries nothing" in FoundLoad(0, 0, 0.0, 0.1).words(())[0]


def test_a_profile_says_what_is_expected(arm, tmp_path):
    bundle, picks = arm
    text = "[profiles]\nlowest = 1.0\nhighest = 3.0\n[profiles.usual]\n[profiles.grasping]\n"
    path = tmp_path / "cell.toml"
    path.write_text(text + "expect = { seconds = 2, at_most = 3.0 }\n")
    keeper = Keeper(lambda verdict: verdict.row == PICKED - 200 and keeper.control.use_profile("grasping", "test"))
    profiles = load_cell(path, picks.joints).profiles
    Loop(bundle, ScriptedSource(samples_of(picks, slice(0, PICKED + 800))), [keeper], profiles=profiles).run()
    assert any(isinstance(change, FoundLoad) for change in keeper.changes)
    path.write_text(text + "expect = { seconds = 99, at_most = 3.0 }\n")
    with pytest.raises(ConfigError, match="profile grasping: a payload can be expected for 60 s"):
        Loop(bundle, ScriptedSource([]), profiles=load_cell(path, picks.joints).profiles)
    path.write_text(text + "expect = { seconds = 2 }\n")
    with pytest.raises(ConfigError, match="at_most is missing"):
        load_cell(path, picks.joints)


def test_only_what_is_news_is_reported_of_a_load_that_is_weighed_on():
    said = {
        "health": np.full(6, 1), "causes": np.zeros(6, int), "alarm": np.zeros(6, int),
        "cause_joint": np.full(6, -1), "drift_saturated": np.zeros((6, 1), bool),
        "load_found_ns": np.array([0, 2, 3, 4, 5, 5]), "load_error_kg": np.array([0, 0.2, 0.2, 0.1, 0.1, 0.1]),
        "load_kg": np.array([0, 1.0, 1.1, 1.5, 1.5, 1.5]),
    }  # fmt: skip
    told = [change for change in ChangeFinder().find(0, np.arange(6), said) if isinstance(change, FoundLoad)]
    assert [(one.row, one.mass_kg) for one in told] == [(1, 1.0), (3, 1.5)]
