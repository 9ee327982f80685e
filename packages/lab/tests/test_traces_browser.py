"""Interactive traces in a browser: they load from a file without network, show every peak, and do what is asked."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_results import make_estimates, make_recording
from tauext_lab.report.trace_packing import Buckets, Plan, Traced, pack, trace
from tauext_lab.report.traces import section

from tauext.bundle.estimates import FAULT

pytestmark = pytest.mark.slow
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not here; pip install playwright")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
if CHROMIUM is None:
    pytest.skip("there is no chromium or google-chrome on the path", allow_module_level=True)

METHODS = ("exact", "none")
COLOURS = {"exact": "#0072b2", "none": "#d55e00", "mass": "#e69f00", "com": "#009e73"}
PEAK_ROW, PEAK_NM = 21_234, 60.0
GAP_ROW, GAP_S = 30_000, 2.0
FAULT_ROWS = slice(35_000, 35_800)


def whole_page(traced: list[Traced], methods: tuple[str, ...], room: int) -> str:
    told = [{"name": m, "label": m, "colour": COLOURS[m], "on": m == methods[0]} for m in methods]
    joints = sorted({f"joint{joint + 1}" for one in traced for *_, joint in one.traces})
    return f"<!DOCTYPE html><meta charset='utf-8'><title>t</title>{section(traced, joints, told, room, '').html}"


@pytest.fixture(scope="module")
def traced() -> list[Traced]:
    """Two recordings of two joints; in the first a peak of one sample, a gap, and a fault of one method."""
    rng = np.random.default_rng(4)
    first, second = (make_recording(name, 2, 40.0, True, rng) for name in ("one", "two"))
    t_ns = first.t_ns.copy()
    t_ns[GAP_ROW:] += round(GAP_S * 1e9)
    first = replace(first, t_ns=t_ns)
    said = {method: make_estimates(first, method, np.full(2, 4.0), rng) for method in METHODS}
    tau_ext, health = said["exact"].tau_ext.copy(), said["exact"].health.copy()
    tau_ext[PEAK_ROW, 0] = PEAK_NM
    health[FAULT_ROWS] = FAULT
    said["exact"] = replace(said["exact"], tau_ext=tau_ext, health=health)
    other = {method: make_estimates(second, method, np.full(2, 4.0), rng) for method in METHODS}
    return [trace(first, said, 20, 4), trace(second, other, 20, 4)]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as running:
        started = running.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module")
def file(traced, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(whole_page(traced, METHODS, 2_000_000), encoding="utf-8")
    return path


def opened(browser, path, fragment: str = "", **context):
    """The page, ready, with everything that it asked for or complained about."""
    page = browser.new_context(viewport={"width": 1200, "height": 900}, **context).new_page()
    page.trouble = []
    page.on("console", lambda message: message.type == "error" and page.trouble.append(message.text))
    page.on("pageerror", lambda error: page.trouble.append(str(error)))
    page.on("request", lambda request: request.url.startswith("file:") or page.trouble.append(request.url))
    page.goto(path.as_uri() + fragment)
    page.wait_for_selector("#traces[data-ready=yes]")
    return page


@pytest.fixture
def page(browser, file):
    page = opened(browser, file)
    yield page
    assert page.trouble == []
    page.context.close()


def drawn(page, key: str) -> list[float] | None:
    page.wait_for_timeout(60)  # a frame or two
    return page.evaluate("key => tauextTraces.view.drawn[key] ?? null", key)


def window(page) -> list[float]:
    return page.evaluate("[tauextTraces.state.from, tauextTraces.state.to]")


def coloured(page, t: float, y_from: float, y_to: float, colour: str) -> bool:
    """Whether a pixel column has this colour somewhere between two heights of the first row (0 above, 1 below)."""
    return page.evaluate(
        """([t, from, to, colour]) => {
          const canvas = document.querySelector("#traces canvas"), row = tauextTraces.view.rows[0];
          const box = [tauextTraces.view.x(t) - 2, row.y + from * row.height, 4, (to - from) * row.height];
          const pixels = box.map((length) => Math.round(length * devicePixelRatio));
          const data = canvas.getContext("2d").getImageData(...pixels).data;
          const wanted = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
          for (let k = 0; k < data.length; k += 4)
            if (wanted.every((v, c) => Math.abs(v - data[k + c]) < 60)) return true;
          return false;
        }""",
        [t, y_from, y_to, colour],
    )


def test_a_peak_of_one_sample_is_on_the_screen_from_the_whole_recording_down_to_itself(page):
    at = PEAK_ROW / 1000
    assert window(page) == pytest.approx([0, 41.999])
    for half in (None, 10, 1, 0.1):
        if half:
            page.evaluate(f"tauextTraces.show({at - half}, {at + half})")
        assert drawn(page, "tau_ext joint1 exact")[1] == pytest.approx(PEAK_NM, abs=0.002)  # half a quantum
        assert coloured(page, at, 0.02, 0.2, COLOURS["exact"])
    page.evaluate(f"tauextTraces.show({at + 1}, {at + 2})")
    assert drawn(page, "tau_ext joint1 exact")[1] < PEAK_NM / 2
    assert not coloured(page, at + 1.5, 0.0, 0.05, COLOURS["exact"])


def test_no_curve_goes_over_a_gap_or_a_fault(page):
    gap, fault = GAP_ROW / 1000 + GAP_S / 2, FAULT_ROWS.start / 1000 + GAP_S + 0.4
    for zoom in ((0, 42), (gap - 3, gap + 3), (fault - 2, fault + 2)):
        page.evaluate(f"tauextTraces.show({zoom[0]}, {zoom[1]})")
        page.wait_for_timeout(60)
        for t in (gap, fault):
            if zoom[0] < t < zoom[1]:
                assert not coloured(page, t, 0, 1, COLOURS["exact"])
        free = zoom[0] + 0.8 * (zoom[1] - zoom[0])
        assert coloured(page, free, 0, 1, COLOURS["exact"])
    assert page.evaluate(f"tauextTraces.valuesAt(0, {gap}).lines") == ["no samples: a gap"]


def test_levels_made_in_the_browser_are_those_of_numpy(page, traced):
    """Level k of the page merges buckets in pairs k times, as merged(2) does."""
    for k in (0, 1, 4):
        level: Buckets = traced[0].whole
        told = page.evaluate("tauextTraces.content.recordings[0].tiers[0]")
        level = level.merged(told["size"] // level.size)
        for _ in range(k):
            level = level.merged(2)
        column = traced[0].traces.index(("r", "none", 1))
        low, high, first = page.evaluate(
            """([column, k]) => { const tier = tauextTraces.view.tiers[0], [low, high] = tier.trace(column, k);
            return [[...low], [...high], [...tier.level(k).first]]; }""",
            [column, k],
        )
        quantum = page.evaluate("tauextTraces.content.quanta.r[1]")
        np.testing.assert_allclose(low, level.low[:, column], atol=0.501 * quantum)
        np.testing.assert_allclose(high, level.high[:, column], atol=0.501 * quantum)
        np.testing.assert_allclose(first, (level.t_ns[:, 0] - level.t_ns[0, 0]) * 1e-9, atol=1e-9)


def test_around_an_event_every_sample_is_drawn_and_no_range(page, traced):
    begin, _ = page.evaluate("tauextTraces.content.recordings[0].windows[0]")
    page.evaluate(f"tauextTraces.show({begin - 0.1}, {begin + 0.4})")
    page.wait_for_timeout(60)
    curve = "tauextTraces.view.curves.filter((c) => c.signal === 'tau_ext' && c.joint === 0)[0]"
    drawn_nm = np.array(page.evaluate(f"{curve}.lines.flat()")).reshape(-1, 2)[:400, 1]
    column = traced[0].traces.index(("tau_ext", "exact", 0))
    np.testing.assert_allclose(drawn_nm, traced[0].close[0][1].low[:400, column], atol=0.003)  # half a quantum: 0.002
    ranges = np.array(page.evaluate(f"[...{curve}.soft]"))
    edge = len(ranges) // 5
    assert ranges[: edge - 3].any() and not ranges[edge + 1 :].any()


def test_boxes_choose_signals_methods_and_joints(page):
    box = "#traces [data-of={}] input[value='{}']"
    assert drawn(page, "r joint1 exact") is None and drawn(page, "tau_ext joint2 exact") is not None
    page.click(box.format("signals", "r"))
    page.click(box.format("methods", "none"))
    page.click(box.format("joints", "1"))
    assert drawn(page, "r joint1 none") is not None and drawn(page, "tau_ext joint2 exact") is None
    page.click(box.format("methods", "exact"))
    assert drawn(page, "tau_ext joint1 exact") is None and drawn(page, "tau_ext joint1 none") is not None


def test_drag_wheel_double_click_and_keys_zoom_and_move(page):
    place = page.locator("#traces canvas").bounding_box()
    x, y = place["x"] + 74, place["y"] + 150
    width = place["width"] - 82
    page.mouse.move(x + 0.25 * width, y)
    page.mouse.down()
    page.mouse.move(x + 0.5 * width, y)
    page.mouse.up()
    assert window(page) == pytest.approx([10.5, 21], abs=0.1)  # a pixel is 0.04 s
    page.mouse.wheel(0, -240)
    assert np.ptp(window(page)) < 6
    page.locator("#traces canvas").focus()
    before = window(page)
    page.keyboard.press("ArrowRight")
    assert window(page)[0] > before[0] and np.ptp(window(page)) == pytest.approx(np.ptp(before))
    page.keyboard.press("-")
    assert np.ptp(window(page)) == pytest.approx(2 * np.ptp(before))
    page.mouse.dblclick(x + 100, y)
    assert window(page) == pytest.approx([0, 41.999])


def test_keys_and_buttons_go_from_event_to_event(page, traced):
    contacts = [start for start, _ in traced[0].head["contacts"]]
    collisions = [one[0] for one in traced[0].head["alarms"]["exact"] if one[2] == 2]
    starts = sorted(contacts + collisions)
    page.locator("#traces canvas").focus()
    for start in starts[:4]:
        page.keyboard.press("n")
        assert sum(window(page)) / 2 == pytest.approx(max(start, 1.0), abs=0.002)
    said = page.locator("#traces .message")
    assert said.inner_text().startswith(f"Event 4 of {len(starts)}: ")
    page.click("#traces [data-do=previous]")
    assert said.inner_text().startswith(f"Event 3 of {len(starts)}: ")


def test_the_pointer_shows_values_with_their_unit(page):
    page.evaluate("tauextTraces.show(10, 12)")
    place = page.locator("#traces canvas").bounding_box()
    page.mouse.move(place["x"] + 500, place["y"] + 120)
    lines = page.locator("#traces .values").inner_text().splitlines()
    assert lines[0].startswith("joint1 at ") and lines[1].startswith("external torque") and lines[1].endswith(" Nm")
    assert lines[2].startswith("threshold ±")


def test_an_address_opens_what_it_names_and_says_what_is_not_there(browser, file):
    page = opened(browser, file, "#recording=two&t=5,9&joint=joint2&method=none&signal=tau_ext")
    assert page.locator("#traces-recording").input_value() == "1" and window(page) == pytest.approx([5, 9])
    page.wait_for_timeout(60)
    assert list(page.evaluate("tauextTraces.view.drawn")) == ["tau_ext joint2 none"]
    page.locator("#traces canvas").focus()
    page.keyboard.press("0")
    again = opened(browser, file, page.evaluate("location.hash"))
    assert window(again) == window(page) == pytest.approx([0, 39.999])
    wrong = opened(browser, file, "#recording=gone&joint=knee&t=a,b")
    assert wrong.locator("#traces .message").inner_text() == (
        "The address names recording 'gone', joint 'knee', not on this page."
    )
    assert not page.trouble and not again.trouble and not wrong.trouble


def test_print_has_the_picture_without_controls_and_a_narrow_screen_has_no_overflow(browser, file):
    page = opened(browser, file)
    page.emulate_media(media="print")
    assert page.locator("#traces canvas").is_visible() and not page.locator("#traces .bar").is_visible()
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 380, "height": 800})
    page.wait_for_timeout(100)
    assert page.evaluate("document.documentElement.scrollWidth") <= 380
    assert page.trouble == []


def test_an_hour_of_seven_joints_at_one_kilohertz_stays_under_ten_megabytes_and_opens(browser, tmp_path):
    """Four quarters of an hour, four methods whose errors are noise of their own, which deflates worst."""
    rng, methods = np.random.default_rng(6), tuple(COLOURS)
    room, kept = 7_000_000, []
    plan = Plan(3_600_000, 7 * (2 + 4 * len(methods)), room)
    recording = make_recording("quarter-0", 7, 900.0, True, rng)
    said = {method: make_estimates(recording, method, np.linspace(4.4, 2.6, 7), rng) for method in methods}
    for number in range(4):
        kept.append(trace(replace(recording, name=f"quarter-{number}"), said, plan.size, plan.windows(recording)))
    path = tmp_path / "hour.html"
    path.write_text(whole_page(kept, methods, room), encoding="utf-8")
    assert path.stat().st_size < 7_500_000  # figures and tables of such a report take 2 MB
    page = opened(browser, path)
    assert len(page.evaluate("tauextTraces.view.rows")) == 7 and page.trouble == []
    told, _ = pack(kept, [f"joint{j + 1}" for j in range(7)], room)
    assert all(one["windows"] for one in told["recordings"])
