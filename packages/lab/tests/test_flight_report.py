"""The report of a flight: one page, with the explanation and the numbers of the event, for any arm and any fault."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import matplotlib
import numpy as np
import pyarrow.parquet as pq
import pytest
from made_arms import no_model
from made_bundles import JOINTS, cut_flight, damaged, pushed, taking_amperes, watching_bundle, with_error_scale
from made_results import LONG_NAMES, make_recording, run_command, texts_of, words_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from tauext_lab.report.flight import broken, draw_close, draw_flight, event_rows, write_flight_report
from tauext_lab.report.flight_file import load_flight
from tauext_lab.report.style import RC

from tauext import _core
from tauext.bundle.estimates import COLUMNS, STORED, load_estimates, save_estimates
from tauext.config import ObserverConfig
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.servo import in_amperes
from tauext.errors import ConfigError, RecordingError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.flight_files import FlightSource, write_flight


@pytest.fixture(scope="module")
def bundle():
    return watching_bundle()


def first_row(bundle, samples, **wanted) -> int:
    """The first sample of which the monitor said this."""
    said = _core.Monitor(bundle).run(samples.t_ns, samples.q, samples.dq, samples.tau)
    return int(np.flatnonzero(np.all([said[key] == value for key, value in wanted.items()], axis=0))[0])


@pytest.fixture(scope="module")
def collision(bundle, tmp_path_factory):
    """The path of a collision's flight."""
    samples = pushed()
    flight = cut_flight(bundle, samples, first_row(bundle, samples, alarm=2))
    return write_flight(flight, tmp_path_factory.mktemp("collision"), FlightSource.of(bundle, samples))


@pytest.fixture(scope="module")
def fault(bundle, tmp_path_factory):
    """The path of the flight of a fault at which no torque of the monitor exists."""
    whole = pushed(pushes=())
    tau = whole.tau.copy()
    tau[200:204, 0] = np.nan
    samples = damaged(whole, tau=tau)
    flight = cut_flight(bundle, samples, 200, after=100)
    assert not np.isfinite(flight["tau_ext"]).any()
    return write_flight(flight, tmp_path_factory.mktemp("fault"), FlightSource.of(bundle, samples))


@pytest.fixture(scope="module")
def written(collision, tmp_path_factory):
    """Its page; no test changes it."""
    return write_flight_report(collision, tmp_path_factory.mktemp("written") / "out")


def test_the_page_holds_explanation_numbers_and_figures_and_asks_no_host(collision, written):
    page = written.read_text()
    assert written.name == f"{collision.stem}.html"
    assert sorted(p.name for p in (written.parent / "figures").iterdir()) == [
        f"{collision.stem}-close.png",
        f"{collision.stem}.png",
    ]
    assert page.count('src="data:image/png;base64,') == 2
    words = re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.S)
    for outside in ("http:", "https:", "//cdn", "<script src", "<link", "@import", "url(", "fetch(", "XMLHttp"):
        assert outside not in words
    words = words_of(page).replace("&#39;", "'").replace("&lt;", "<")
    for line in collision.with_suffix(".txt").read_text().splitlines():
        assert " ".join(line.split()) in words
    event = load_recording(collision).provenance["event"]
    row = [event[key][0] for key in ("limit_nm", "margin_nm", "residual_nm", "uncertainty_nm", "tau")]
    told = [f"{value:.3f}".replace("-", "−") for value in (event["tau_ext_nm"][0], *row)]
    assert " ".join(["shoulder", told[0], "–", *told[1:]]) in words  # no error scale, no standard error


def test_limits_that_move_and_the_standard_error_are_drawn_and_reported(tmp_path):
    bundle, samples = with_error_scale(watching_bundle()), pushed()
    flight = cut_flight(bundle, samples, first_row(bundle, samples, alarm=2))
    path = write_flight(flight, tmp_path, FlightSource.of(bundle, samples))
    loaded = load_flight(path)
    np.testing.assert_array_equal(loaded.estimates.sigma_nm, flight["sigma_nm"].astype(np.float32))
    np.testing.assert_array_equal(loaded.estimates.contact_sigma_nm, flight["contact_sigma_nm"].astype(np.float32))
    assert loaded.event["sigma_nm"] == list(flight["event"].sigma_nm)
    top = draw_flight(loaded).figure.axes[0]
    assert np.ptp(loaded.estimates.limit_nm[:, 0]) > 0.5
    np.testing.assert_array_equal(top.get_lines()[1].get_ydata(), loaded.estimates.limit_nm[:, 0])
    (band,) = (one for one in top.collections if one.get_alpha())
    sigma, row = flight["contact_sigma_nm"][1000, 0], flight["event"].tau_ext[0]
    heights = band.get_paths()[0].vertices[:, 1]
    assert np.abs(heights - (row + sigma)).min() < 1e-5 and np.abs(heights - (row - sigma)).min() < 1e-5
    rows = event_rows(loaded)
    assert rows[0][1][2] == f"{sigma:.3f}"


def test_the_same_flight_gives_the_same_bytes_and_leaves_nothing_over(collision, written, tmp_path):
    again = write_flight_report(collision, tmp_path / "again")
    assert again.read_bytes() == written.read_bytes()
    assert not list(tmp_path.rglob("*.part"))


def test_the_figure_shows_the_files_rows_and_marks_the_event(collision):
    flight = load_flight(collision)
    estimates = load_estimates(collision.with_name(f"{collision.stem}.estimates.parquet"))
    drawing = draw_flight(flight)
    assert len(drawing.figure.axes) == 2 * 4
    top = drawing.figure.axes[0]
    above, below, tau_ext, event = top.get_lines()
    np.testing.assert_array_equal(tau_ext.get_ydata(), estimates.tau_ext[:, 0])
    np.testing.assert_array_equal(below.get_ydata(), estimates.limit_nm[:, 0])
    np.testing.assert_array_equal(above.get_ydata(), -estimates.limit_nm[:, 0])
    assert list(event.get_xdata()) == [0, 0]
    assert flight.since_s[1000] == 0 and flight.joint == 0
    close = draw_close(flight)
    assert len(close.figure.axes) == 4 and "shoulder, the event's joint" in close.caption
    assert close.figure.axes[0].get_xlim() == (-150, 350)


def test_a_fault_without_any_estimate_has_its_page_and_its_numbers_are_dashes(fault, tmp_path, undrawn):
    page = write_flight_report(fault, tmp_path).read_text()
    words = words_of(page)
    assert "Fault (not finite), first on joint shoulder" in words and "4 more could not be kept" in words
    assert "There is no estimate of tau_ext up to the fault" in words
    (joint, *cells), other = (cells for _, cells in event_rows(load_flight(fault)))
    assert joint == "shoulder" and cells[:7] == ["–"] * 7
    assert other[7] == f"{pushed(pushes=()).tau[200, 1]:.3f}"
    assert [t.get_text() for t in draw_flight(load_flight(fault)).figure.axes[0].texts] == ["none"]


def test_a_fault_of_no_joint_shows_the_one_nearest_to_its_limit(bundle, tmp_path, undrawn):
    whole = pushed(pushes=((2.0, 1, 1.5),))
    t_ns = whole.t_ns.copy()
    t_ns[2900:] -= 2_000_000_000
    samples = damaged(whole, t_ns=t_ns)
    path = write_flight(cut_flight(bundle, samples, 2900), tmp_path, FlightSource.of(bundle, samples))
    flight = load_flight(path)
    assert flight.event["joint"] is None and flight.recording.joints[flight.joint] == "elbow"
    assert "nearest to its threshold" in draw_close(flight).caption
    assert "Fault (time backwards)" in words_of(write_flight_report(path, tmp_path / "out").read_text())


def flight_of(folder, made):
    """The flight of a collision of an arm with the joints of the recording."""
    links = []
    for k, name in enumerate(made.joints):
        link = _core.Link()
        link.joint_name, link.parent, link.rotation, link.mass = name, k - 1, [1.0, 0, 0, 0, 1, 0, 0, 0, 1], 1.0
        links.append(link)
    tree = no_model(_core.Tree(links, [0, 0, -9.81]))
    setup = build_setup(tree, made, ObserverConfig())
    bundle = make_bundle("seven", setup, 0.02, made)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [30.0] * len(links)
    return write_flight(
        cut_flight(bundle, made, first_row(bundle, made, alarm=2)), folder, FlightSource.of(bundle, made)
    )


def test_an_arm_of_seven_joints_has_its_page(tmp_path, undrawn):
    path = flight_of(tmp_path, make_recording("seven", 7, 6.0, True, np.random.default_rng(5)))
    page = write_flight_report(path, tmp_path / "out").read_text()
    assert all(f"joint{j + 1}" in page for j in range(7)) and page.count("<tr") == 8
    assert len(draw_flight(load_flight(path)).figure.axes) == 28


@pytest.mark.parametrize("joints", [pytest.param(7, marks=pytest.mark.slow), 12])
def test_long_names_of_joints_stay_beside_their_rows(joints, tmp_path):
    made = make_recording("long", joints, 6.0, True, np.random.default_rng(5))
    path = flight_of(tmp_path, replace(made, joints=LONG_NAMES[:joints]))
    with matplotlib.rc_context(RC):
        figure = draw_flight(load_flight(path)).figure
        FigureCanvasAgg(figure).draw()
    rows = figure.axes[::4]
    spans = [row.yaxis.label.get_window_extent() for row in rows]
    assert [row.get_ylabel().replace("\n", "") for row in rows] == list(LONG_NAMES[:joints])
    assert all(above.y0 > below.y1 for above, below in itertools.pairwise(spans))
    assert not any("$" in text for text in texts_of(figure))


def test_nothing_of_matplotlib_reaches_the_terminal_without_a_home(tmp_path):
    """Neither its line about a folder that cannot be written, nor its warning about letters that its font lacks."""
    made = make_recording("strange", 2, 6.0, True, np.random.default_rng(5))
    path = flight_of(tmp_path, replace(made, joints=("关节", "elbow")))
    nowhere = {"HOME": "/dev/null", "XDG_CONFIG_HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null"}
    environment = {key: value for key, value in os.environ.items() if key != "MPLCONFIGDIR"} | nowhere
    words = [sys.executable, "-m", "tauext", "report", "--flight", path, "--out", tmp_path / "out"]
    done = subprocess.run([str(word) for word in words], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stderr == ""


def test_no_line_is_drawn_over_missing_samples():
    since, values = broken(np.array([0.0, 1, 2, 7, 8]), np.arange(5), period=1.0)
    assert np.isnan(since[3]) and np.isnan(values[3]) and since[[2, 4]].tolist() == [2.0, 7.0]
    assert broken(np.array([0.0, 1, 3]), np.arange(3), 1.0)[0].tolist() == [0, 1, 3]
    assert len(broken(np.array([]), np.array([]), 1.0)[0]) == 0


def test_names_are_text_and_never_markup(bundle, tmp_path, undrawn):
    samples = pushed("<b>bold<", joints=("<i>one", "two"))
    source = FlightSource.of(bundle, samples)
    path = write_flight(cut_flight(bundle, samples, first_row(bundle, samples, alarm=2)), tmp_path, source)
    page = write_flight_report(path, tmp_path / "out").read_text()
    assert "<b>bold" not in page and "<i>one" not in page and "&lt;i&gt;one" in page


# The command


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    return run_command(capsys, "report", *arguments)


def test_the_command_prints_the_page_and_draws_every_flight_of_a_folder(bundle, collision, tmp_path, capsys, undrawn):
    code, out, _ = run(capsys, "--flight", collision, "--out", tmp_path / "a")
    assert code == 0 and out.strip() == str(tmp_path / "a" / f"{collision.stem}.html")
    samples = pushed()
    flight = cut_flight(bundle, samples, first_row(bundle, samples, alarm=2))
    newer = write_flight(flight, collision.parent, FlightSource.of(bundle, samples))
    code, out, _ = run(capsys, "--flight", collision.parent, "--out", tmp_path / "b")
    assert code == 0 and out.strip() == str(tmp_path / "b" / "index.html") and newer.stem.endswith("-2")
    index = (tmp_path / "b" / "index.html").read_text()
    for stem in (collision.stem, newer.stem):
        page = (tmp_path / "b" / f"{stem}.html").read_text()
        assert f'href="{stem}.html"' in index
        assert page.index("<figure>") < page.index("<dl>") and stem not in re.findall("<title>.*</title>", page)[0]


def test_a_damaged_flight_is_in_the_index_with_its_reason(bundle, tmp_path, capsys, undrawn):
    samples, folder = pushed(), tmp_path / "<b>flights"
    flight = cut_flight(bundle, samples, first_row(bundle, samples, alarm=2))
    folder.mkdir()
    paths = [write_flight(flight, folder, FlightSource.of(bundle, samples)) for _ in range(2)]
    paths[0].write_bytes(paths[0].read_bytes()[:-40])
    assert run(capsys, "--flight", folder, "--out", tmp_path / "out", "--page-mb", 0)[0] == 0
    index = (tmp_path / "out" / "index.html").read_text()
    assert "2 event logs of &lt;b&gt;flights" in index and "<b>" not in index
    assert index.count("<a href") == 1 and f"{paths[0].name}: " in index
    paths[1].write_bytes(b"")
    code, out, err = run(capsys, "--flight", folder, "--out", tmp_path / "none")
    assert (
        (code, out) == (2, "")
        and err.splitlines()[-1].startswith("tauext: error: ")
        and not (tmp_path / "none").exists()
    )


@pytest.mark.parametrize(
    "arguments, says",
    [
        ((), "--results is missing"),
        (("--results", "r"), "--data is missing"),
        (("--flight", "f", "--results", "r"), "not both"),
        (("--flight", "f", "--data", "d"), "not both"),
        (("--flight", "gone.parquet"), "there is no such recording"),
        (("--flight", "."), "there are no event logs in this folder"),
    ],
)
def test_neither_both_or_no_flight_gets_one_line(tmp_path, capsys, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *arguments, "--out", "report")
    assert (code, out) == (2, "") and len(err.splitlines()) == 1 and says in err
    assert not (tmp_path / "report").exists()


def test_what_is_no_flight_or_whose_files_do_not_belong_together_is_refused(collision, tmp_path):
    save_recording(pushed(), tmp_path / "plain.parquet")
    with pytest.raises(RecordingError, match="a recording, but no event log"):
        write_flight_report(tmp_path / "plain.parquet", tmp_path / "out")
    flight = load_recording(collision)
    save_recording(flight, tmp_path / "alone.parquet")
    with pytest.raises(RecordingError, match="alone.estimates.parquet: there are no such estimates"):
        write_flight_report(tmp_path / "alone.parquet", tmp_path / "out")
    estimates = load_estimates(collision.with_name(f"{collision.stem}.estimates.parquet"))
    save_estimates(replace(estimates, t_ns=estimates.t_ns + 1), tmp_path / "alone.estimates.parquet")
    with pytest.raises(RecordingError, match="it is of another event log"):
        write_flight_report(tmp_path / "alone.parquet", tmp_path / "out")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="is no folder; choose another place"):
        write_flight_report(collision, tmp_path / "file")


# The estimates beside a flight


def test_alarm_and_causes_come_back_from_the_file_and_none_where_it_has_none(collision, tmp_path):
    path = collision.with_name(f"{collision.stem}.estimates.parquet")
    estimates = load_estimates(path)
    assert (estimates.alarm.dtype, estimates.causes.dtype) == (np.int8, np.uint32)
    assert set(estimates.alarm.tolist()) == {0, 1, 2}
    save_estimates(replace(estimates, alarm=None), tmp_path / "evaluated.parquet")
    evaluated = load_estimates(tmp_path / "evaluated.parquet")
    assert evaluated.alarm is None
    np.testing.assert_array_equal(evaluated.tau_ext, estimates.tau_ext)
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="cannot be written"):
        save_estimates(estimates, tmp_path / "file" / "e.parquet")


def test_estimates_of_another_format_are_refused(collision, tmp_path):
    table = pq.read_table(collision.with_name(f"{collision.stem}.estimates.parquet"))
    older = table.schema.metadata | {b"tauext_estimates_format": b"3"}
    pq.write_table(table.replace_schema_metadata(older), tmp_path / "older.parquet")
    with pytest.raises(RecordingError, match="format 3 instead of 1: made by a development version before 0.1.0"):
        load_estimates(tmp_path / "older.parquet")


def test_every_column_of_the_table_is_in_the_file_or_in_messages(collision):
    names = set(pq.read_schema(collision.with_name(f"{collision.stem}.estimates.parquet")).names)
    stored = {f"{c.name}_{JOINTS[0]}" if c.per_joint else c.name for c in STORED}
    lacking = ("prior", "drift", "sigma_nm", "contact_sigma_nm")  # as its bundle has none of them
    assert stored - names == {f"{name}_{JOINTS[0]}" for name in lacking}
    assert all(column in STORED or column.in_messages for column in COLUMNS)


def test_a_flight_of_currents_says_so(tmp_path, undrawn):
    bundle, made = taking_amperes(watching_bundle(), np.array([2.0, -0.5])), pushed()
    current = replace(made, tau=made.tau / [2.0, -0.5])
    flight = cut_flight(bundle, current, first_row(bundle, current, alarm=2))
    path = write_flight(flight, tmp_path, FlightSource.of(bundle, current))
    recording = load_recording(path)
    np.testing.assert_array_equal(recording.tau, flight["tau"])
    event = recording.provenance["event"]
    assert in_amperes([recording]) and event["torque_units"] == ["A", "A"]
    assert event["tau"] == recording.tau[recording.t_ns == event["t_ns"]][0].tolist()
    page = write_flight_report(path, tmp_path / "report", page_mb=0).read_text()
    assert "motor torque, A" in page and "motor torque, Nm" not in page


def test_the_provenance_of_a_flight_is_plain_json(fault):
    provenance = load_recording(fault).provenance
    text = json.dumps(provenance, allow_nan=False)
    assert json.loads(text)["event"]["tau_ext_nm"] == [None, None]
    assert provenance["event"]["causes"] == ["not finite"] and provenance["event"]["joint"] == JOINTS[0]
