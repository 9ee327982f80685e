"""The force of an alarm's touch at a frame that the user names: its numbers, words and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_place_changes import JOINTS, said_of
from test_places import bundle as bundle

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.places import FrameForce, PlaceFinder, frame_force_words, place_facts, place_words

POSE = [0.3, -0.6, 0.5, -1.7, 0.4, 1.3, 0.2]
FORCE = np.array([4.0, -3.0, -22.0])
DOWN = FrameForce("tool0", (3.0, 4.0, -25.0), tuple(np.diag([1.0, 4.0, 2.25]).ravel()), 0, 0.7)


def test_the_force_at_the_frame_comes_with_the_place(bundle):
    tau = _core.WrenchModel(bundle).columns("joint7", POSE)[:3].T @ FORCE
    rows = 400
    alarm = np.zeros(rows, dtype=np.uint8)
    alarm[100:300] = 2
    said = said_of(np.outer(alarm > 0, tau), alarm)
    t_ns, q = np.arange(rows, dtype=np.int64) * 1_000_000, np.tile(POSE, (rows, 1))
    told = [PlaceFinder(bundle, frame).find(0, t_ns, q, 0 * q, said)[0] for frame in ("joint7", None)]
    force = told[0].force
    assert force is not None and told[1].force is None and told[0].row == told[1].row
    np.testing.assert_allclose(force.force_n, FORCE, atol=0.3)
    assert force.consistent > 0.9 and 0 < force.off_n < 10
    words, facts = place_words(told[0], JOINTS), place_facts(told[0], JOINTS)
    assert words.endswith(f"; {frame_force_words(force)}") and " 23 N at joint7 (up to " in words
    assert facts["at_frame"]["force_n"] == force.force_n and len(facts["at_frame"]["covariance"]) == 9
    assert "at_frame" not in place_facts(told[1], JOINTS) and " N at " not in place_words(told[1], JOINTS)


def test_words_say_size_doubt_and_the_nearest_axis():
    assert frame_force_words(DOWN) == "25 N at tool0 (up to 4 N wrong), 11° from -z"
    assert frame_force_words(replace(DOWN, force_n=(0.0, 20.0, 0.0))).endswith("0° from +y")
    blind = frame_force_words(replace(DOWN, blind=1))
    assert blind == "25 N at tool0 (and 1 direction that this pose cannot show), 11° from -z"
    assert frame_force_words(replace(DOWN, consistent=0.001)) == "no force at tool0 explains it"


def test_a_frame_that_there_is_none_is_refused_with_those_that_there_are(bundle):
    with pytest.raises(ConfigError, match=r"wrench = 'hand' must be one of joint1, .*joint7"):
        PlaceFinder(bundle, "hand")
    bare = type(bundle)()
    bare.links = bundle.links
    with pytest.raises(ConfigError, match="no force can be told, the bundle does not say how wrong"):
        PlaceFinder(bare, "joint7")
