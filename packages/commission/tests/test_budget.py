"""What limits are set for and what the data prove, and the budget of false alarms that a person chooses."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from made_bundles import watching_bundle
from made_live_page import LIMITS
from tauext_commission import budget
from tauext_commission.budget import Promise, alarm_in, alarm_to_train, can_take, chosen_alarm, put_budget, row_at
from tauext_commission.folder import CommissionFolder
from tauext_commission.history import Kept, curve, ticks

from tauext.cli import main
from tauext.config import AlarmConfig
from tauext.errors import ConfigError

PROVED = {
    "promise": {"asked": {"rate_per_hour": 0.125}, "supported": True, "supported_budget": {"rate_per_hour": 0.12},
                "calibration_hours": 25.0},
    "budgets": LIMITS["budgets"],
    "sentence": "At most 1 false alarm in 8 h.",
}  # fmt: skip
SHORT = {key: value for key, value in LIMITS.items() if key != "promise"}
SUPPORTED = {"promise": LIMITS["promise"]}
"""Limits that are not extrapolated, as of an earlier version."""
EXTRAPOLATED = (
    "Set for one false alarm in 8 h, extrapolated from 7 minutes: between 1 in 50 minutes and 1 in 60 h (90 %)."
)
RARE = LIMITS | {"extrapolated": LIMITS["extrapolated"] | {"between_per_hour": [1e-5, 1.2]}}


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({}, "The thresholds have no target false alarm rate."),
        (PROVED, "Set for one false alarm in 8 h, as 25 h of free motion prove."),
        (
            LIMITS,
            f"{EXTRAPOLATED} The data alone prove 1 in 2.25 minutes.",
        ),
        (
            SHORT,
            f"{EXTRAPOLATED} So short a time alone proves nothing.",
        ),
        (SUPPORTED, "Set for one false alarm in 2.25 minutes, as 7 minutes of free motion prove."),
        (
            RARE,
            "Set for one false alarm in 8 h, extrapolated from 7 minutes: 1 in 50 minutes or rarer (90 %). "
            "The data alone prove 1 in 2.25 minutes.",
        ),
    ],
)
def test_what_limits_are_set_for_and_what_is_proved_are_two_sentences(limits, words):
    assert Promise.of_limits(limits).words() == words


def kept(limits: dict, false: int, hours: float = 1.0) -> Kept:
    return Kept("b0001", Promise.of_limits(limits), hours, [{}] * false, 0)


def test_extrapolated_limits_are_judged_by_their_interval_and_proved_ones_by_their_budget():
    """1.2 false alarms an hour are within the interval: four of them in an hour have a probability of 3 %."""
    assert [kept(LIMITS, false).kept for false in (0, 1, 3, 4)] == [True, True, True, False]
    assert [kept(PROVED, false).kept for false in (0, 1, 2)] == [True, True, False]
    assert kept({}, 99).kept and kept(LIMITS, 99, hours=0.0).kept
    assert kept(LIMITS, 5).words().endswith("1 in 2.25 minutes. Counted: 5 false alarms in 1 h: BROKEN.")
    assert kept(PROVED, 1).words().endswith("Counted: 1 false alarm in 1 h: kept.")


def test_a_budget_takes_its_share_of_the_limits_and_can_be_taken_back():
    bundle = watching_bundle(contact_nm=1.5)  # collision limits of 2 and 3 N m
    bundle.provenance = json.dumps(
        {"limits": LIMITS | {"other_motion": {"sentence": "x"}, budget.RAISED: {"elbow": 2.0}}}
    )
    limits = put_budget(bundle, budget.limits_of(bundle), 6.0)
    assert bundle.sliding_limit_nm == [1.2, 1.2]
    np.testing.assert_allclose(bundle.near_stiction_limit_nm, 1.8)
    np.testing.assert_allclose(bundle.contact_sliding_limit_nm, 1.2)  # never above the collision limit
    now = Promise.of_limits(limits)
    assert (now.per_hour, now.at_most_per_hour, now.hours) == (6.0, 12.0, 7 / 60)
    assert "Set for one false alarm in 10 minutes, extrapolated from 7 minutes" in limits["sentence"]
    assert "other_motion" not in limits and limits[budget.RAISED] == {"elbow": 2.0}
    assert [round(one["share_of_limits"], 3) for one in limits["budgets"]] == [1.667, 1.333, 1.0]
    again = put_budget(bundle, limits, 1.0)
    np.testing.assert_allclose(bundle.sliding_limit_nm, 1.6)
    np.testing.assert_allclose(bundle.contact_sliding_limit_nm, 1.5)
    back = put_budget(bundle, again, 0.125)
    np.testing.assert_allclose(bundle.sliding_limit_nm, 2.0)
    np.testing.assert_allclose(bundle.contact_sliding_limit_nm, 1.5)
    assert back["extrapolated"] == LIMITS["extrapolated"] and "other_motion" in back


def test_a_budget_between_two_rows_is_interpolated_and_one_beyond_the_table_waits():
    promise = Promise.of_limits(LIMITS)
    middle = row_at(promise.budgets, 1 / 8**0.5)
    assert middle["share_of_limits"] == pytest.approx(0.9) and middle["push_n"]["forearm"] == pytest.approx(0.9 * 118)
    assert can_take(promise, 0.5) and not can_take(promise, 0.125)
    assert not can_take(promise, 1 / 24) and not can_take(promise, 60.0) and not can_take(Promise(), 1.0)
    with pytest.raises(ConfigError, match=r"an hour = 3 must be one of 0.125 \(1 in 8 h\), 1 \(1 in 1 h\), 6 \(1 in"):
        alarm_in(promise.budgets, 3.0)


def test_the_newest_choice_counts_and_trainings_begin_at_the_rarest_budget(tmp_path):
    folder = CommissionFolder.open(tmp_path / "cell", create=True)
    assert chosen_alarm(folder.path) == alarm_to_train(folder.path) == AlarmConfig()
    folder.choose(AlarmConfig(), "page")
    assert not folder.history()
    folder.choose(AlarmConfig(in_hours=1.0), "page")
    assert folder.history()[-1]["words"] == "target false alarm rate 1 in 1 h, chosen by page; before: 1 in 8 h"
    assert chosen_alarm(folder.path).in_hours == 1.0 and alarm_to_train(folder.path) == AlarmConfig()
    folder.choose(AlarmConfig(in_hours=24.0), "command")
    assert alarm_to_train(CommissionFolder.open(folder.path).path).in_hours == 24.0


@pytest.mark.parametrize(("option", "value"), [("--in-hours", "0"), ("--false-alarms", "nan"), ("--in-hours", "x")])
def test_an_impossible_budget_is_refused_before_a_folder_is_made(tmp_path, capsys, option, value):
    words = ["commission", "--source", "sim:rig", "--out", str(tmp_path / "cell"), option, value]
    try:
        assert main(words) == 2
    except SystemExit as ended:  # of the parser
        assert ended.code == 2
    assert option.strip("-").replace("-", "_") in capsys.readouterr().err.replace("-", "_")
    assert not (tmp_path / "cell").exists()


def test_a_curve_of_the_history_lies_between_the_numbers_of_its_axes():
    drawn = curve([(0.5, 10.0), (7.0, 30.0)], 100.0)
    words = re.findall(r'<text x="([\d.]+)" y="([\d.]+)" text-anchor="(\w+)">([\d.]+)<', drawn)
    across = {float(text): float(x) for x, _, anchor, text in words if anchor == "middle"}
    up = {float(text): float(y) - 4 for _, y, anchor, text in words if anchor == "end"}
    assert list(across) == [0, 2, 4, 6, 8] and list(up) == [0, 20, 40, 60, 80, 100]
    (x, y), (later, above) = (map(float, one) for one in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', drawn))
    assert across[0] < x < across[2] and across[6] < later < across[8]
    assert up[20] < y < up[0] and up[40] < above < up[20]
    assert ticks(0.0) == [0, 1] and ticks(24.0)[-1] == 25 and ticks(0.03)[-1] == pytest.approx(0.03)
