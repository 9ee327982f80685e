"""Interactive traces: peaks and holes kept in every bucket, bytes that say what they were made of, and their room."""

from __future__ import annotations

import base64
import json
import re
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_results import SEVEN_BUNDLES, make_estimates, make_recording, make_results
from tauext_lab.commands import report
from tauext_lab.evaluate.results import load_results
from tauext_lab.report.signals import NotAvailable, Signals
from tauext_lab.report.trace_packing import (
    CLOSE_SHARE,
    QUANTA_A_LIMIT,
    Buckets,
    Plan,
    alarms,
    around,
    encode,
    gaps,
    in_buckets,
    pack,
    quanta,
    run_begins,
    stretches,
    trace,
)
from tauext_lab.report.traces import chosen_bundles, or_reason, recordings_of, results_traces

from tauext.bundle.estimates import COLLISION, CONTACT, FAULT, OK
from tauext.cli import main
from tauext.errors import ConfigError

MS = 1_000_000
GAP_NS = 2.5 * MS


def made_traces(samples: int = 3000, traces: int = 4, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Uneven stamps with three gaps; noise with peaks of one sample and longer holes: (samples,), (samples, traces)."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(700_000, 1_300_000, samples)
    steps[rng.choice(samples, 3, replace=False)] = [7 * MS, 90 * MS, 3_000_000 * MS]
    values = rng.normal(0, 1, (samples, traces)).astype(np.float32)
    values[rng.choice(samples, 20), rng.integers(0, traces, 20)] += 50
    for _ in range(6):
        start = rng.integers(0, samples)
        values[start : start + rng.integers(1, 60), rng.integers(0, traces)] = np.nan
    return np.cumsum(steps) + 17, values


def buckets_of(t_ns: np.ndarray, values: np.ndarray, size: int, cuts: tuple[int, ...] = ()) -> Buckets:
    blocks = [values[:, :1], values[:, 1:]]
    return in_buckets(t_ns, blocks, run_begins(t_ns, blocks, GAP_NS, cuts), size)


def decoded(content: bytes, where: list[int], count: int, quantum: np.ndarray) -> tuple[np.ndarray, ...]:
    """What the bytes say, read as their description has it: begins, times [ns] from the first, low, high."""
    raw = np.frombuffer(zlib.decompress(content), np.uint8).reshape(-1, 4, count).astype(np.int64)
    rows = raw[:, 0] + 256 * raw[:, 1] + 65536 * raw[:, 2] + 16777216 * raw[:, 3]
    first = np.cumsum(rows[1] * MS + rows[2])
    low, high = np.full((2, count, len(where)), np.nan)
    for trace_number, pair in enumerate(where):
        at = 0
        for k in range(count):
            code = int(rows[5 + 2 * pair, k])
            at += -(code + 1) // 2 if code % 2 else code // 2
            width = rows[6 + 2 * pair, k]
            if width:
                low[k, trace_number] = at * quantum[trace_number]
                high[k, trace_number] = (at + width - 1) * quantum[trace_number]
    return rows[0], first, first + rows[3] * MS + rows[4], low, high


# Buckets


@pytest.mark.parametrize("size", [1, 2, 7, 64, 5000])
def test_minimum_and_maximum_of_every_bucket_are_those_of_its_samples_and_none_straddles_a_hole(size):
    t_ns, values = made_traces()
    made = buckets_of(t_ns, values, size, cuts=(1234,))
    counted = 0
    for k, (first, last) in enumerate(made.t_ns):
        inside = (t_ns >= first) & (t_ns <= last)
        counted += inside.sum()
        np.testing.assert_array_equal(made.low[k], values[inside].min(axis=0))
        np.testing.assert_array_equal(made.high[k], values[inside].max(axis=0))
        assert inside.sum() <= size and (np.diff(t_ns[inside]) <= GAP_NS).all()
        absent = np.isnan(values[inside])
        assert (absent.all(axis=0) | ~absent.any(axis=0)).all()
        assert not (inside[1233] and inside[1234])
    assert counted == len(t_ns)


@pytest.mark.parametrize("count", [2, 3, 10])
def test_merged_buckets_are_those_of_the_samples(count):
    t_ns, values = made_traces()
    merged, at_once = buckets_of(t_ns, values, 4).merged(count), buckets_of(t_ns, values, 4 * count)
    assert merged.size == at_once.size
    for name in ("t_ns", "begins", "low", "high"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(at_once, name))


# Bytes


@pytest.mark.parametrize("size", [1, 16])
def test_bytes_give_back_times_exactly_and_values_to_half_a_quantum(size):
    t_ns, values = made_traces()
    values[:, 3] = values[:, 1]
    made, quantum = buckets_of(t_ns, values, size), np.array([0.01, 0.5, 0.002, 0.5])
    content, where = encode(made, quantum)
    assert where == [0, 1, 2, 1]
    begins, first, last, low, high = decoded(content, where, len(made), quantum)
    np.testing.assert_array_equal(begins, made.begins)
    np.testing.assert_array_equal(np.stack([first, last], axis=1), made.t_ns - made.t_ns[0, 0])
    for told, kept in ((low, made.low), (high, made.high)):
        np.testing.assert_array_equal(np.isnan(told), np.isnan(kept))
        assert np.nanmax(np.abs(told - kept) / quantum) <= 0.5 + 1e-6  # float32 of 50 has steps of 4e-6


def test_what_is_not_finite_is_a_hole():
    values = np.array([[1.0], [np.inf], [2.0], [-np.inf], [1e30], [3.0]], np.float32)
    made = buckets_of(np.arange(6) * MS, np.hstack([values, values]), 1)
    low = decoded(*encode(made, np.full(2, 0.1)), 6, np.full(2, 0.1))[3]
    np.testing.assert_allclose(low[:, 0], [1, np.nan, 2, np.nan, np.nan, 3], rtol=1e-12)


# Stretches of time


def test_stretches_alarms_and_gaps_have_their_first_and_last_times():
    time_s = np.arange(10) * 0.05
    holds = np.array([1, 1, 0, 0, 1, 0, 1, 0, 0, 1], bool)
    assert np.allclose(stretches(holds, time_s), [(0, 0.05), (0.2, 0.2), (0.3, 0.3), (0.45, 0.45)])
    assert np.allclose(stretches(holds, time_s, 0.12), [(0, 0.05), (0.2, 0.3), (0.45, 0.45)])
    assert stretches(holds & False, time_s) == []
    assert gaps(np.array([5, 6, 20, 21]) * MS, GAP_NS) == [pytest.approx((0.001, 0.015))]


def test_alarms_have_their_level_and_are_detections_where_no_alarm_is_known():
    rng = np.random.default_rng(0)
    recording = make_recording("r", 2, 2.0, False, rng)
    said = make_estimates(recording, "exact", np.full(2, 4.0), rng)
    flags = np.zeros(2000, np.int8)
    flags[100:300], flags[200:250] = CONTACT, COLLISION
    levels = replace(said, held_alarm=flags)
    np.testing.assert_allclose(alarms(levels, recording.time_s), [(0.2, 0.249, COLLISION), (0.1, 0.299, CONTACT)])


def test_windows_are_of_the_first_events_and_do_not_touch():
    time_s = np.arange(0, 20, 0.001)
    found = around([(5, 5.2), (12, 19), (5.1, 5.15), (6.0, 6.1), (1, 1)], time_s, 3)
    assert [rank for rank, _ in found] == [0, 1]
    spans = [(time_s[part.start], time_s[part.stop - 1]) for _, part in found]
    np.testing.assert_allclose(spans, [(4.5, 6.6), (11.5, 13.5)], atol=0.0021)
    assert around([(1, 1)], time_s, 0) == [] == around([], time_s, 9)
    assert around([(0, 0), (19.9, 25)], time_s, 2)[1][1].stop == len(time_s)


# One recording, and the room of several


@pytest.fixture(scope="module")
def recorded():
    rng = np.random.default_rng(1)
    recording = make_recording("touched", 3, 60.0, True, rng)
    return recording, {bundle: make_estimates(recording, bundle, np.full(3, 4.0), rng) for bundle in ("exact", "none")}


def test_a_peak_of_one_sample_is_in_the_buckets_and_unhealthy_samples_are_holes(recorded):
    recording, said = recorded
    tau_ext, health = said["none"].tau_ext.copy(), said["none"].health.copy()
    tau_ext[41_234, 1] = 33.0
    health[50_000:50_100] = FAULT
    changed = said | {"none": replace(said["none"], tau_ext=tau_ext, health=health)}
    traced = trace(recording, changed, 500, 2)
    column = traced.traces.index(("tau_ext", "none", 1))
    first, last = (traced.whole.t_ns // MS).T
    (at,) = np.flatnonzero((first <= 41_234) & (last >= 41_234))
    assert traced.whole.high[at, column] == np.float32(33)
    warm = np.flatnonzero(said["none"].health == OK)[0]
    holes = (last < warm) | ((first >= 50_000) & (last < 50_100))
    np.testing.assert_array_equal(np.isnan(traced.whole.low[:, column]), holes)
    assert traced.head["unhealthy"]["none"][1] == pytest.approx((50, 50.099))
    exact = traced.traces.index(("learned", "exact", 0))
    np.testing.assert_allclose(  # r − tau_ext in float32, of torques up to 60 Nm
        traced.close[0][1].low[:, exact],
        said["exact"].network[np.isin(recording.t_ns, traced.close[0][1].t_ns[:, 0]), 0],
        atol=2e-5,
    )


def test_the_standard_error_is_a_trace_of_methods_that_say_one(recorded):
    recording, said = recorded
    sigma = np.abs(said["exact"].tau_ext) + np.float32(0.1)
    traced = trace(recording, said | {"exact": replace(said["exact"], sigma_nm=sigma)}, 500, 2)
    assert {method for signal, method, _ in traced.traces if signal == "sigma"} == {"exact"}
    column = traced.traces.index(("sigma", "exact", 1))
    assert np.nanmax(traced.whole.high[:, column]) == np.nanmax(sigma[:, 1])
    told, _ = pack([traced], recording.joints, 300_000)
    assert told["quanta"]["sigma"] == told["quanta"]["tau_ext"]


@pytest.mark.parametrize("room", [60_000, 300_000, pytest.param(3_000_000, marks=pytest.mark.slow)])
def test_traces_take_no_more_than_their_room_and_keep_the_more_important_windows(recorded, room):
    recording, said = recorded
    plan = Plan(recording.samples, 3 * 10, room)
    traced = trace(recording, said, plan.size, plan.windows(recording), [(30.0, 30.2)])
    told, texts = pack([traced], recording.joints, room)
    assert len(json.dumps(told["recordings"])) + sum(map(len, texts)) < 1.02 * room  # rows and counts are not counted
    (head,) = told["recordings"]
    assert len(texts) == len(head["tiers"]) and (len(texts) == 2) == bool(head["windows"])
    if head["tiers"][0]["size"] == 1:
        assert room == 3_000_000 and not head["windows"]
    else:
        assert any(a <= 30.0 <= b for a, b in head["windows"])
        assert len(texts[1]) <= CLOSE_SHARE * room
    unit = np.array([told["quanta"][signal][joint] for signal, _, joint in head["traces"]])
    tier = head["tiers"][0]
    low = decoded(base64.b64decode(texts[0]), tier["rows"], tier["count"], unit)[3]
    column = head["traces"].index(("tau_ext", "exact", 0))
    assert abs(np.nanmin(low[:, column]) - np.nanmin(said["exact"].tau_ext[:, 0])) <= unit[column] / 2 + 1e-6


def test_steps_follow_the_smallest_limit_or_the_range_and_a_wild_value_changes_neither(recorded):
    recording, said = recorded
    r = said["exact"].residual.copy()
    r[1000] = 1e9
    wild = trace(recording, said | {"exact": replace(said["exact"], residual=r)}, 4, 0)
    steps, calm = (quanta([one], 3) for one in (wild, trace(recording, said, 4, 0)))
    assert steps["tau_ext"] == pytest.approx([4.0 / QUANTA_A_LIMIT] * 3)
    assert steps["tau"][0] == pytest.approx(np.ptp(recording.tau[:, 0]) / 8000, rel=0.05)
    assert steps["r"] == pytest.approx(calm["r"], rel=0.05)
    free = {"exact": replace(said["exact"], limit_nm=np.full((recording.samples, 3), np.inf, np.float32))}
    assert 0 < quanta([trace(recording, free, 4, 0)], 3)["tau_ext"][0] < 0.01


# The page


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_results(tmp_path_factory.mktemp("made"), seconds=20, bundles=SEVEN_BUNDLES)


def told_of(page: str) -> dict:
    return json.loads(re.search(r'id="traces-content">(.*?)</script>', page, re.S).group(1))


def section_of(results_dir: Path, data: Path, room: float = 2e6, methods: tuple[str, ...] = ()) -> str:
    results = load_results(results_dir)
    return results_traces(results, Signals(data, results_dir, results.joints), room, methods).html


def test_the_page_holds_the_traces_of_five_methods_or_of_those_chosen(made):
    results = load_results(made[0])
    assert len(chosen_bundles(results, ())) == 5 and chosen_bundles(results, ())[0].model == "exact"
    page = section_of(*made, methods=("none", "exact"))
    told = told_of(page)
    assert [method["name"] for method in told["methods"]] == ["exact", "none"]
    assert [method["on"] for method in told["methods"]] == [True, False]
    assert "Methods left out: exact, paper recipe, mass" in page
    assert [one["name"] for one in told["recordings"]] == recordings_of(results)
    assert recordings_of(results) == ["collisions-000", "collisions-001", "free-000", "free-001"]
    assert len(told["recordings"][0]["contacts"]) == 3 and not told["recordings"][2]["contacts"]
    assert page.count('class="traces-data"') == sum(len(one["tiers"]) for one in told["recordings"])


def test_the_traces_stay_under_their_size_and_it_is_reported_where_there_is_no_room(made):
    results, data = made
    sizes = {room: len(section_of(results, data, room, ("exact",)).encode()) for room in (4e5, 8e5)}
    assert sizes[4e5] <= 4e5 < sizes[8e5] <= 8e5
    page = or_reason(lambda: section_of(results, data, room=-5.0)).html
    assert "Interactive traces are not available: the page has 0.00 MB left for them" in page and "<script" not in page


def test_recordings_without_estimates_are_left_out_and_without_any_that_is_reported(made, tmp_path):
    results, data = (shutil.copytree(folder, tmp_path / folder.name) for folder in made)
    (data / "collisions-000.parquet").unlink()
    for bundle in SEVEN_BUNDLES:
        (results / "estimates" / bundle / "free-000.parquet").unlink()
    (results / "estimates" / "exact" / "free-001.parquet").unlink()
    told = told_of(section_of(results, data, methods=("exact", "none")))
    assert [one["name"] for one in told["recordings"]] == ["collisions-001", "free-001"]
    assert "exact" in told["recordings"][0]["alarms"] and "exact" not in told["recordings"][1]["alarms"]
    shutil.rmtree(data)
    with pytest.raises(NotAvailable, match="no recording is there with its estimates"):
        section_of(results, data)


def test_names_are_text_and_never_markup_or_script(made, tmp_path):
    results, data = (shutil.copytree(folder, tmp_path / folder.name) for folder in made)
    content = json.loads((results / "results.json").read_text())
    name = "<b>bold"
    for bundle in content["bundles"]:
        if bundle["name"] == "mass":
            bundle["name"] = name
    (results / "results.json").write_text(json.dumps(content))
    shutil.move(results / "estimates" / "mass", results / "estimates" / name)
    page = section_of(results, data, methods=(name,))
    assert name not in page and told_of(page)["methods"][0]["name"] == name


@pytest.mark.parametrize(
    "arguments, says",
    [
        (("--page-mb", "-1"), "--page-mb = -1 must be a number of megabytes, 0 to 1000"),
        (("--page-mb", "nan"), "--page-mb = nan must be a number of megabytes, 0 to 1000"),
        (("--trace-methods", "exact", "mine"), "there is no method 'mine'; choose among exact, exact-paper, mass"),
    ],
)
def test_wrong_sizes_and_methods_get_one_line_before_anything_is_drawn(made, tmp_path, capsys, arguments, says):
    results, data = made
    arguments = ["report", "--results", results, "--data", data, "--out", tmp_path / "page", *arguments]
    assert main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr().err
    assert says in said and len(said.splitlines()) == 1 and not (tmp_path / "page").exists()


def test_a_flight_has_one_method():
    with pytest.raises(ConfigError, match="chooses among the methods of --results; an event log has one"):
        report(out=Path("out"), flight=Path("f.parquet"), trace_methods=("exact",))
