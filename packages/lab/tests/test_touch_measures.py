"""Links, newtons and kinds of collisions in results.json and in the report: against pushes whose place is known."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import seven_axis_bundle
from made_results import make_results
from tauext_lab.evaluate.collisions import TouchMeasures, find_collisions
from tauext_lab.evaluate.results import (
    JsonReader,
    LinkProbability,
    LinkTable,
    Touches,
    TouchEstimate,
    load_results,
    to_json,
)
from tauext_lab.report.page import write_report
from tauext_lab.report.tables import (
    kinds_table,
    links_table,
    links_worth,
    touch_estimate_words,
    touch_estimates_table,
    touched,
)

from tauext import _core
from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.errors import ConfigError

SIGMA_NM, RATE_HZ, APART_S, HELD_S = 0.15, 100, 3.0, 1.4
PUSHES = (
    (3, (0.009, 0.2, 0.0), (-0.979, -0.206, 0)),
    (6, (0.0, 0.04, 0.1), (0, -1, 0)),
    (1, (0.05, -0.16, 0.0), (-1, 0, 0)),
    (3, (-0.04, 0.19, -0.05), (0, 0, 1)),
)
"""Link, point on the surface of its capsule and way into it, in the link's axes."""
MOST_N = 40.0
ALARM_S = 0.05
"""After the touch begins."""


@pytest.fixture(scope="module")
def bundle() -> _core.Bundle:
    """A seven-axis arm with a capsule from each joint to the next."""
    return seven_axis_bundle([SIGMA_NM] * 7, _core.Capsule(6, [0, 0, 0.02], [0, 0, 0.14], 0.04))


def pushed(bundle) -> tuple[Recording, Estimates]:
    """A standing arm that is pushed at PUSHES, each harder and harder, the last one too weakly for an alarm."""
    joints = tuple(link.joint_name for link in bundle.links)
    n, samples = len(joints), round((len(PUSHES) + 1) * APART_S * RATE_HZ)
    q = np.tile(np.linspace(0.2, 0.9, n), (samples, 1))
    tau, contact, link = np.zeros((samples, n)), np.zeros(samples, np.int8), np.full(samples, -1, np.int8)
    held, touch, wrenches = np.zeros(samples, np.int8), np.zeros(samples, np.int8), _core.WrenchModel(bundle)
    kinds = [_core.Touch.push, _core.Touch.impact, _core.Touch.clamp, _core.Touch.none]
    for k, (at, point, way) in enumerate(PUSHES):
        first = round((k + 1) * APART_S * RATE_HZ)
        part = slice(first, first + round(HELD_S * RATE_HZ))
        columns = wrenches.columns(joints[at], q[0].tolist(), list(point), _core.WrenchAxes.frame)[:3]
        tau[part] = np.linspace(0.0, MOST_N, part.stop - first)[:, None] * (np.array(way) @ columns)
        contact[part], link[part] = 1, at
        if k < len(PUSHES) - 1:
            held[first + round(ALARM_S * RATE_HZ) : part.stop] = 1 + k % 2
            touch[first + 40 :] = kinds[k].value
    recording = Recording(
        name="pushed",
        joints=joints,
        t_ns=np.arange(samples) * round(1e9 / RATE_HZ),
        q=q,
        dq=np.zeros_like(q),
        tau=np.zeros_like(q),
        rate_hz=RATE_HZ,
        torque_timing="held",
        source="made up",
        robot_sha256="0" * 64,
        contact=contact,
        contact_link=link,
        provenance={"contacts": "hands"},
    )
    single = tau.astype(np.float32)
    said = Estimates(
        joints, recording.t_ns, single, 0 * single, single, 1 + 0 * single, np.zeros(q.shape, bool),
        np.ones(samples, np.int8), np.zeros(samples, np.uint32), held > 0, held, touch,
        sigma_nm=np.full_like(single, SIGMA_NM), contact_sigma_nm=np.full_like(single, SIGMA_NM),
    )  # fmt: skip
    return recording, said


def measured(bundle) -> Touches:
    recording, said = pushed(bundle)
    measures = TouchMeasures(bundle)
    measures.add(find_collisions(recording), recording, said)
    json.dumps(to_json(measures.summary()), allow_nan=False)
    return measures.summary()


def test_pushes_on_known_links_are_reported_on_them_with_their_newtons(bundle):
    summary = measured(bundle)
    assert [one.id for one in summary.reported] == ["pushed:0", "pushed:1", "pushed:2"]  # the fourth raised no alarm
    links = summary.links
    assert (links.collisions, links.first_two) == (3, 3)
    assert sum(map(sum, links.table)) == 3 and sum(links.table[3]) == 1 and sum(links.table[5]) == 0
    assert links.first == sum(links.table[k][k] for k in range(7)) >= 2
    assert summary.reported[0].links[0].joint == links.joints[3]
    # The report covers the second after the alarm; the push grows on for longer. A smaller force farther out fits, too.
    assert summary.reported[0].force_n == pytest.approx(MOST_N * (ALARM_S + 1.0) / HELD_S, rel=0.25)


def test_kinds_are_those_known_when_the_collision_is_over(bundle):
    assert measured(bundle).kinds == {"hands": {"push": 1, "impact": 1, "clamp": 1}}


def test_a_bundle_that_tells_no_place_still_tells_kinds(bundle):
    recording, said = pushed(bundle)
    blind = _core.Bundle()
    blind.links, blind.gravity = bundle.links, bundle.gravity
    measures = TouchMeasures(blind)
    measures.add(find_collisions(recording), recording, said)
    summary = measures.summary()
    assert summary.links is None and summary.kinds["hands"]["clamp"] == 1
    assert not any(one.links for one in summary.reported)


def test_a_stated_link_counts_as_right_or_wrong():
    def on(joint, probability):
        return TouchEstimate("x", None, (LinkProbability(joint, probability),))

    measures = TouchMeasures(SimpleNamespace(links=[SimpleNamespace(joint_name=name) for name in "ab"]))
    measures._reported = [on("a", 0.95), on("b", 0.9), on("b", 0.6), on("a", 0.99)]
    measures._labels = [(0, "w"), (0, "w"), (1, "w"), (-1, "w")]  # where the last one was, nobody knows
    links = measures.summary().links
    assert links.table == ((1, 1), (0, 1))
    assert (links.collisions, links.first, links.stated, links.stated_right) == (3, 2, 2, 1)


def test_the_report_has_the_tables_and_older_results_none(tmp_path, undrawn):
    results, data = make_results(tmp_path / "new", seconds=25, bundles=["exact"], error_scale=True)
    read = load_results(results)
    ((bundle, one),) = touched(read)
    table = links_table(read)
    assert [row.cells[1] for row in table.rows] == ["joint2"]  # where all of them are
    assert [int(cell or 0) for cell in table.rows[0].cells[2:4]] == list(one.links.table[1])
    assert f"the right link first in {one.links.first} of {one.links.collisions}" in links_worth(bundle.label, one)
    assert [row.cells[1] for row in kinds_table(read).rows] == ["pulses"]
    rows = touch_estimates_table(read).rows
    assert len(rows) == len(read.collisions) and rows[1].cells[-1] == "joint2 95%, 21 N, impact"
    write_report(results, data, tmp_path / "report")
    assert "Where, how hard, and what kind" in (tmp_path / "report" / "report.html").read_text()
    content = json.loads((results / "results.json").read_text())
    for bundle in content["bundles"]:
        del bundle["touches"]
    (results / "results.json").write_text(json.dumps(content))
    assert touched(load_results(results)) == []


def test_what_was_reported_in_words():
    assert touch_estimate_words(None) == "–" and touch_estimate_words(TouchEstimate("x", None)) == "–"
    assert touch_estimate_words(TouchEstimate("x", "unknown")) == "unknown"
    assert (
        touch_estimate_words(TouchEstimate("x", "clamp", (LinkProbability("elbow", 0.831),), 33.6))
        == "elbow 83%, 34 N, clamp"
    )


def test_a_table_that_is_not_square_is_refused():
    content = {
        "joints": ["a", "b"],
        "table": [[1, 2]],
        "collisions": 3,
        "first": 1,
        "first_two": 1,
        "stated": 0,
        "stated_right": 0,
    }
    with pytest.raises(ConfigError, match="'table' must be 2 lists of 2 counts"):
        JsonReader(2).object(LinkTable, content, "results.json")
