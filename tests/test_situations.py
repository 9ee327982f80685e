"""`tauext show` says how sure a bundle is in motions that everybody knows."""

from __future__ import annotations

import json
import re

import pytest
from made_bundles import (
    JOINTS,
    LARGEST,
    LIMIT_NM,
    SIGMA_NEAR_NM,
    SIGMA_NM,
    SIGMA_PER_SPEED,
    watching_bundle,
    with_error_scale,
)

from tauext import _core
from tauext.bundle.units import sentences, situations
from tauext.cli import main

SLIDING = "sliding steadily at 0.5 rad/s"


def test_limit_and_standard_error_follow_from_the_weights():
    found = situations(with_error_scale(watching_bundle(), per_speed=2.0))
    assert list(found) == [
        "standing",
        "just after it stopped",
        "creeping at 0.01 rad/s",
        SLIDING,
        "speeding up by 2 rad/s2",
    ]
    for joint in JOINTS:
        limit = {name: situation["limit"][joint] for name, situation in found.items()}
        sigma = {name: situation["standard error"][joint] for name, situation in found.items()}
        assert limit["standing"] == pytest.approx(1.5 * LIMIT_NM) and sigma["standing"] == pytest.approx(SIGMA_NEAR_NM)
        assert limit[SLIDING] == pytest.approx(2 * LIMIT_NM)
        assert sigma[SLIDING] == pytest.approx(SIGMA_NM + 0.5 * SIGMA_PER_SPEED)
        # The speed is filtered as r is, so a joint that has just stopped is not forgotten at once.
        assert 1.5 * LIMIT_NM < limit["just after it stopped"] < 3 * LIMIT_NM
        assert limit[SLIDING] < limit["speeding up by 2 rad/s2"] < 2.2 * LIMIT_NM
    assert situations(watching_bundle()) == {}


def test_no_limit_is_beyond_the_largest_scale():
    found = situations(with_error_scale(watching_bundle(), per_speed=100.0))
    assert found[SLIDING]["limit"]["elbow"] == pytest.approx(LARGEST * LIMIT_NM)


def test_a_sentence_names_where_a_joint_is_least_and_most_sure():
    found = {
        "standing": {"limit": {"elbow": 4.1}, "standard error": {"elbow": 0.9}},
        "sliding": {"limit": {"elbow": 0.3}, "standard error": {"elbow": 0.05}},
    }
    words = sentences(found, {"elbow": "A"})["elbow"]
    assert words == (
        "least sure standing: threshold 4.1 A, standard error 0.9 A; "
        "surest sliding: threshold 0.3 A, standard error 0.05 A"
    )


def test_show_tells_it_and_what_else_raises_limits(tmp_path, capsys):
    bundle = with_error_scale(watching_bundle())
    bundle.after_contact_factor = 2.0
    limits = {"minutes_factor": 1.4, "friction_reserve": 0.03}
    reason = "a push of 1.5 times the limit at 20 1/s is found after 40 ms at 20 1/s, 30 ms at 50 1/s"
    facts = {"limits": limits, "gain": {"reason": reason, "chosen_per_s": 50.0}, "error_scale": {"hours": 0.3}}
    bundle.provenance = json.dumps(facts)
    bundle.save(str(tmp_path / "moving.tauext"))
    assert main(["show", str(tmp_path / "moving.tauext")]) == 0
    out = capsys.readouterr().out
    assert (
        "thresholds sliding [Nm]" in out
        and "in usual motion" in out
        and "threshold 2 Nm, standard error" not in out.split("standing")[0]
    )
    assert reason in out and re.search("after contact factor +2$", out, re.MULTILINE)
    assert "least sure" in out and f"{SLIDING}  " in out
    assert main(["show", str(tmp_path / "moving.tauext"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["situations"] == situations(_core.Bundle.load(str(tmp_path / "moving.tauext")))
    assert told["provenance"]["limits"]["friction_reserve"] == 0.03
    watching_bundle().save(str(tmp_path / "constant.tauext"))
    assert main(["show", str(tmp_path / "constant.tauext")]) == 0
    out = capsys.readouterr().out
    assert "usual motion" not in out and "least sure" not in out
