"""Forces added to free motion: closed forms of a planar arm, of the chain's low-pass, and of the curve."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import LIMIT_NM, TOOL_M, planar_tool_bundle, pushed, watching_bundle
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.injected import SHAPES, Injection, curve, profile
from tauext_lab.evaluate.results import DetectedForces, results_of, to_json
from tauext_lab.report.force_figures import draw_injected, forces_table, injected_words

from tauext.cli import main
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording

SECONDS = 40.0
UPPER_M = 0.3


def lever(q: np.ndarray) -> np.ndarray:
    """d(x, y) of the tool by the joints, (samples, 2, joints)."""
    shoulder, both = q[:, 0], q[:, 0] + q[:, 1]
    x = np.stack([-UPPER_M * np.sin(shoulder) - TOOL_M * np.sin(both), -TOOL_M * np.sin(both)], axis=1)
    y = np.stack([UPPER_M * np.cos(shoulder) + TOOL_M * np.cos(both), TOOL_M * np.cos(both)], axis=1)
    return np.stack([x, y], axis=1)


def test_a_force_is_one_vector_of_the_base_while_the_arm_moves():
    recording = pushed(seconds=SECONDS, pushes=())
    injection = Injection({"planar": planar_tool_bundle()}, 0, 30)
    tool = len(injection.places) - 1
    events = [event for copy in injection.draw(0, recording) for event in copy if event.place == tool]
    assert len(events) > 5
    for event in events:
        steps = len(event.tau_ext)
        size = event.peak * profile(event.shape, recording.rate_hz)
        of_joints = lever(recording.q[event.begin : event.begin + steps])
        way, *_ = np.linalg.lstsq(
            (size[:, None, None] * of_joints.transpose(0, 2, 1)).reshape(-1, 2), event.tau_ext.ravel(), rcond=None
        )
        assert np.linalg.norm(way) <= 1 + 1e-9  # the rest of the unit vector points out of the plane
        expected = size[:, None] * np.einsum("skj,k->sj", of_joints, way)
        np.testing.assert_allclose(event.tau_ext, expected, atol=1e-9 * event.peak)


def test_events_are_drawn_by_seed_and_recording_and_leave_room_between_them():
    recording = pushed(seconds=SECONDS, pushes=())
    draws = [
        Injection({"a": planar_tool_bundle()}, seed, 30).draw(number, recording)
        for seed, number in ((0, 0), (0, 0), (1, 0), (0, 1))
    ]
    begins = [[event.begin for copy in draw for event in copy] for draw in draws]
    assert begins[0] == begins[1] != begins[2] and begins[0] != begins[3]
    for copy in draws[0]:
        ends = [event.begin + len(event.tau_ext) for event in copy]
        assert all(later.begin - end >= 1000 for end, later in zip(ends, copy[1:], strict=False))  # 1 s at 1 kHz


def test_torques_on_single_joints_are_detected_from_the_limit_on(tmp_path):
    """The bundle has no model: its observer shows 1 - exp(-K0 t) of a press, against a limit of 2 (at rest 3) N m."""
    recording = replace(pushed(seconds=SECONDS, pushes=()), name="free")
    bundle = watching_bundle(network=False)
    found = evaluate({"watching": bundle}, [lambda: recording], [], tmp_path, 0, 1, inject=True)
    written = json.loads(json.dumps(to_json(found)))
    assert to_json(results_of(written, "results.json")) == written  # every key has its field, every field its key
    injected = found.bundles[0].forces.added
    assert injected.without_forces and injected.unit == "Nm" and injected.unhealthy == 0
    shown = 1 - math.exp(-0.9 * bundle.observer.gain_per_s)
    curves = {(one.place, one.shape): one for one in injected.curves}
    assert {shape for _, shape in curves} == {*SHAPES}
    for (_, shape), one in curves.items():
        assert one.bins[0].latched == 0  # a quarter of the limit
        if shape == "press":
            assert LIMIT_NM / shown <= one.nine_of_ten <= 2.2 * LIMIT_NM
            assert one.bins[-1].latched == one.bins[-1].events
    assert "press" in injected_words(injected)
    shown_one = SimpleNamespace(name="a", label="watching", forces=DetectedForces(None, injected))
    panels = draw_injected([shown_one], shown_one).figure.axes
    assert [axes.get_title() for axes in panels[: len(SHAPES)]] == [*SHAPES]
    press = injected.at(injected.place)[list(SHAPES).index("press")]
    np.testing.assert_allclose(
        panels[list(SHAPES).index("press")].lines[0].get_ydata(),
        [100 * one.latched / one.events for one in press.bins if one.events],
    )
    table = forces_table([shown_one], shown_one)
    assert table is not None and [row.cells[1] for row in table.rows] == ["joint shoulder", "joint elbow"]


def test_a_short_hit_needs_more_than_a_long_one_by_the_observers_share_of_it(tmp_path):
    recording = pushed(seconds=120.0, pushes=())
    bundle = watching_bundle(network=False)
    bundle.hold_s = 0.0
    found = evaluate({"a": bundle}, [lambda: recording], [], tmp_path, 0, 1, inject=True)
    curves = found.bundles[0].forces.added.curves
    needed = {(one.place, one.shape): one.nine_of_ten or math.inf for one in curves}
    for place in {place for place, _ in needed}:
        assert needed[place, "hit of 20 ms"] > needed[place, "hit of 60 ms"] > needed[place, "hit of 200 ms"]


def test_profiles_have_their_mean_and_peak():
    assert profile("hit of 200 ms", 1000).mean() == pytest.approx(2 / math.pi, rel=1e-3)
    assert profile("ramp of 1 s", 1000).mean() == pytest.approx(0.5)
    assert profile("press", 1000).mean() == pytest.approx(0.95, abs=1e-3)
    assert all(0.9 < profile(shape, 1000).max() <= 1 for shape in SHAPES)
    # Shorter than a period: the mean of the force over the period that shows it.
    assert profile("hit of 20 ms", 10) == pytest.approx([0.2])


def test_the_curve_counts_what_is_detected_and_finds_where_it_is_sure():
    rows = [(float(peak), peak >= 40, False, 0.03 if peak >= 40 else None) for peak in range(1, 101)]
    one = curve("tool", "press", rows)
    assert (one.events, one.latched, one.nine_of_ten) == (100, 61, 40.0)
    assert one.delay_median_s == one.delay_p95_s == 0.03
    assert sum(b.events for b in one.bins) == 100 and sum(b.latched for b in one.bins) == 61
    assert curve("tool", "press", [(peak, False, False, None) for peak, *_ in rows]).nine_of_ten is None


@pytest.mark.parametrize(
    ("test", "words"),
    [((), ", and the dataset has no test recording; record some"), (("short.parquet",), "test recording; record some")],
)
def test_forces_that_cannot_be_added_are_refused_in_one_sentence(tmp_path, capsys, test, words):
    """No test recording, or one that is too short: nothing was added, and nothing was printed about it."""
    watching_bundle().save(str(tmp_path / "o.tauext"))
    save_recording(pushed(), tmp_path / "hit.parquet")
    save_recording(pushed(seconds=3.0, pushes=()), tmp_path / "short.parquet")
    save_split(Split((), (), test, ("hit.parquet",)), tmp_path)
    given = ["evaluate", "--data", str(tmp_path), "--bundles", str(tmp_path / "o.tauext"), "--out", str(tmp_path / "r")]
    assert main([*given, "--inject"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "inject added no force: it needs free motion of 5 s or more without a contact in a test recording" in line
    assert words in line and not (tmp_path / "r" / "results.json").exists()
    assert main(given) == 0


def test_what_was_touched_gets_no_further_touch():
    recording = pushed(seconds=SECONDS, pushes=())
    contact = np.zeros(recording.samples, dtype=np.int8)
    contact[10_000:30_000] = 1
    for copy in Injection({"planar": planar_tool_bundle()}, 0, 30).draw(0, replace(recording, contact=contact)):
        assert all(event.begin + len(event.tau_ext) <= 10_000 or event.begin >= 30_000 for event in copy)
