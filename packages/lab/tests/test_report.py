"""The report draws every figure for any number of joints and bundles, and says what is missing instead of failing."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_results import LONG_NAMES, SEVEN_BUNDLES, make_results, texts_of, words_of
from made_results import undrawn as no_pictures
from tauext_lab.evaluate.results import bundle_label, load_results
from tauext_lab.report import paper
from tauext_lab.report.collision_figures import (
    draw_after_contact,
    draw_collisions,
    draw_found_curve,
    draw_missed_curve,
    draw_strength,
)
from tauext_lab.report.error_figures import (
    FEWEST,
    draw_error_against_sigma,
    draw_error_over_speed,
    draw_free_motion,
    draw_learning_curves,
    draw_training_loss,
    sigma_table,
)
from tauext_lab.report.force_figures import MOST_N, draw_noticed_force, forces_table, joined
from tauext_lab.report.page import PageFigure, render_page, tile, write_report
from tauext_lab.report.signals import NotAvailable, Signals, expect_same_dataset
from tauext_lab.report.style import (
    CASE_COLOURS,
    LETTERS_A_LINE,
    OTHER_COLOURS,
    VARIANT_COLOURS,
    bundle_colours,
    bundle_strokes,
    name_lines,
)
from tauext_lab.report.tables import NOT_MEASURED, method_errors, methods
from tauext_lab.report.three_collisions import choose, draw_three_collisions

from tauext.data.recording_file import fingerprint, load_recording, save_recording
from tauext.errors import ConfigError, RecordingError, TauextError
from tauext.fit.tail import duration

FIGURES = ("figure-5-free-motion", "figure-6-error-over-speed", "figure-7-collisions", "figure-8-three-collisions")
OF_METHODS = ("missed-curve", "strength", "after-contact")
OF_RESULTS = ("found-curve", "training-loss", "noticed-force", *OF_METHODS)
ALL_FIGURES = (*FIGURES, *OF_RESULTS)
DRAWERS = (draw_free_motion, draw_error_over_speed, draw_collisions, draw_three_collisions)
NO_FIGURES = dict.fromkeys(
    (*ALL_FIGURES, "learning-curves", "error-against-sigma"), PageFigure(png=None, caption="none")
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results and dataset folder; tests that change them work on a copy."""
    return make_results(tmp_path_factory.mktemp("made"), seconds=30)


@pytest.fixture(scope="module")
def seven(tmp_path_factory):
    """Seven bundles, two of them of another recipe and evaluated first."""
    return make_results(tmp_path_factory.mktemp("seven"), seconds=20, bundles=SEVEN_BUNDLES)


@pytest.fixture(scope="module")
def noticing(made, tmp_path_factory):
    """The same with forces that are noticed: half as large by the limit of contacts."""
    folder = tmp_path_factory.mktemp("noticing")
    results = shutil.copytree(made[0], folder / "results")
    put_noticed(results, contact_times=0.5)
    return results, made[1]


@pytest.fixture(scope="module")
def written(noticing, tmp_path_factory):
    """The folder and the page of the whole report; no test changes them."""
    folder = tmp_path_factory.mktemp("written") / "report"
    return folder, write_report(*noticing, folder)


def own_copy(source: str, target: str) -> None:
    """Recordings and estimates are large, and replaced or removed, never written into: a second name is enough."""
    (shutil.copy if source.endswith(".json") else os.link)(source, target)


@pytest.fixture
def copied(made, tmp_path):
    return tuple(shutil.copytree(folder, tmp_path / folder.name, copy_function=own_copy) for folder in made)


def signals_of(folders) -> Signals:
    results, data = folders
    return Signals(data, results, load_results(results).joints)


def change(results, edit) -> None:
    path = results / "results.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def page_of(results) -> str:
    return render_page(load_results(results), NO_FIGURES)


# The whole report


def test_the_report_is_one_page_with_every_figure_inside_and_asks_no_host(made, written):
    folder, path = written
    page = path.read_text()
    assert path == folder / "report.html"
    assert sorted(p.name for p in (folder / "figures").iterdir()) == sorted(f"{n}.png" for n in ALL_FIGURES)
    assert page.count('src="data:image/png;base64,') == len(ALL_FIGURES)
    assert "not available" not in page
    words = re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.S)
    for outside in ("http:", "https:", "//cdn", "<script src", "<link", "@import", "url(", "fetch(", "XMLHttp"):
        assert outside not in words
    for source in re.findall(r'src="(.{5})', page):
        assert source == "data:"
    first = load_results(made[0]).collisions[0]
    link = f"#recording=collisions-000&amp;t={first.start_s - 1:.3f},{first.start_s + 1:.3f}"
    assert f'<a href="{link}">collisions-000</a>' in page


@pytest.mark.parametrize("units", [["Nm"], [], None, ["Nm"] * 3])
def test_results_with_too_few_units_are_refused_in_a_sentence(units, copied):
    change(copied[0], lambda content: content["bundles"][0].update(estimate_units=units))
    with pytest.raises(ConfigError, match=r"bundles\[0\]: 'estimate_units' must be a list of 2 texts, one a joint$"):
        load_results(copied[0])


@pytest.mark.slow
def test_no_text_of_any_figure_is_raw_mathtext(noticing, copied, tmp_path, monkeypatch):
    """With text.parse_math off, matplotlib's own labels of powers would be printed as their source."""
    figures = {}

    def keep(figure, path):
        figures[path.stem] = texts_of(figure)
        path.write_bytes(b"")

    def edit(content):
        for k, bundle in enumerate(content["bundles"]):
            bundle["training_minutes"], bundle["recipe"], bundle["case"] = 5.0 * (k + 1), "prior", "exact"

    monkeypatch.setattr("tauext_lab.report.page.save_png", keep)
    write_report(*noticing, tmp_path / "report", page_mb=1)
    change(copied[0], edit)
    write_report(*copied, tmp_path / "curves", page_mb=1)
    assert set(figures) >= {*ALL_FIGURES, "learning-curves"}
    assert not {name: one for name, texts in figures.items() for one in texts if "$" in one or "\\" in one}
    assert {"100", "10k"} <= set(figures["training-loss"])


def test_long_names_of_joints_stay_in_their_card_and_beside_their_row(copied):
    results = load_results(copied[0])
    long = replace(results, joints=LONG_NAMES[: len(results.joints)])
    assert "joint1" in render_page(results, NO_FIGURES).partition("push on a joint")[0]
    assert not any(name in render_page(long, NO_FIGURES).partition("push on a joint")[0] for name in LONG_NAMES)
    for name in (*LONG_NAMES, "a" * 50, "", "j1"):
        lines = name_lines(name).split("\n")
        assert "".join(lines) == name and max(map(len, lines)) <= LETTERS_A_LINE


@pytest.mark.slow
def test_the_same_results_give_the_same_bytes_and_no_file_is_left_over(noticing, written, tmp_path):
    """But for the pictures, of which test_flight_report draws some twice."""
    with no_pictures():
        first, second = (write_report(*noticing, tmp_path / name, page_mb=1) for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()
    assert not list(written[0].rglob("*.part")) and not list(tmp_path.rglob("*.part"))


def test_another_dataset_than_the_one_that_was_evaluated_is_refused(copied, tmp_path):
    """As `tauext simulate` with another seed makes it: the same names, other recordings."""
    results, data = copied
    names = ("collisions-000", "free-000")

    def keep_fingerprints(content):
        content["provenance"] |= {"recordings": {name: fingerprint(data / f"{name}.parquet") for name in names}}

    change(results, keep_fingerprints)
    expect_same_dataset(load_results(results), results, data)
    other = shutil.copytree(data, tmp_path / "other")
    recording = load_recording(other / "free-000.parquet")
    save_recording(replace(recording, tau=1.001 * recording.tau), other / "free-000.parquet")
    with pytest.raises(ConfigError, match="other: it is another dataset .* free-000 are not those that were evaluated"):
        write_report(results, other, tmp_path / "none")
    for name in names:
        (other / f"{name}.parquet").unlink()
    with pytest.raises(ConfigError, match="collisions-000, free-000 are not in it"):
        write_report(results, other, tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_report_of_seven_joints_and_bundles_of_other_names_has_every_figure(tmp_path, undrawn):
    folders = make_results(tmp_path, joints=7, bundles=("mine", "exact"), seconds=20, scale=None)
    page = write_report(*folders, tmp_path / "report", page_mb=0).read_text()
    assert "is not available" not in page  # traces alone are not, for want of room
    assert "joint7" in page and "mine" in page
    assert ">paper</th>" not in page and "ICRA" not in page


def test_a_report_without_dataset_and_estimates_still_has_its_tables_and_no_older_figures(copied, tmp_path, undrawn):
    results, data = copied
    shutil.rmtree(data)
    shutil.rmtree(results / "estimates")
    (tmp_path / "report" / "figures").mkdir(parents=True)
    (tmp_path / "report" / "figures" / "figure-5-free-motion.png").write_bytes(b"of when they were there")
    page = write_report(results, data, tmp_path / "report").read_text()
    assert page.count("is not available: the dataset has no recording") == 3
    assert "Figure 6 error over speed is not available: no test recording is there with its estimates" in page
    assert "0.402" in page
    drawn = {p.stem for p in (tmp_path / "report" / "figures").iterdir()}
    assert drawn == {*OF_RESULTS} - {"noticed-force"}


# Numbers on the page


def test_ours_stand_beside_the_papers(made):
    page = words_of(page_of(made[0]))
    ours = load_results(made[0]).bundle("exact")
    for case in paper.L1_NM:
        for published in (paper.L1_NM[case], paper.L2_NM[case], paper.MSE_NM2[case]):
            assert f"{published[0]:.3f}" in page and f"{published[1]:.3f}" in page
    free = ours.free_motion
    assert f"joint1 {free.l1_nm[0]:.3f} 0.402 {free.l2_nm[0]:.3f} 0.661 {free.mse_nm2[0]:.3f} 0.435 189,000" in page
    assert f"{ours.limits.sliding_nm[0]:.2f} 4.62" in page
    assert "0.418" in page and "1.344" in page
    false, latched = ours.free_motion.false_collisions, ours.latched
    time = duration(ours.free_motion.hours)
    assert f"{false:,} false collision{'' if false == 1 else 's'} in {time} of free motion" in page
    strong = f"{latched.strong_latched} of {latched.strong} strong ones"
    assert f"exact {latched.latched} of {latched.collisions} collisions latched, {strong}" in page


def test_cards_count_as_the_table_of_methods_does(made):
    results = load_results(made[0])
    rows = {row.bundle: row.cells for row in methods(results).rows if row.bundle}
    for bundle in results.bundles:
        card, cells = tile(bundle, results, "#000000"), rows[bundle.name]
        assert card.latched == cells[-4] and f"latched, {cells[-3]} strong ones" in card.of_what
        assert card.false_collisions.startswith(f"{cells[1]} false collision")


def test_the_papers_numbers_agree_among_themselves():
    """MSE is the square of L2, to the rounding of the printed digits."""
    for case, l2_nm in paper.L2_NM.items():
        for l2, mse in zip(l2_nm, paper.MSE_NM2[case], strict=True):
            assert mse == pytest.approx(l2**2, abs=0.005)


@pytest.mark.parametrize(
    "scale, words", [("smoke", "The numbers mean nothing"), ("full", "as much data"), (None, None)]
)
def test_the_scale_is_reported_plainly(scale, words, copied):
    change(copied[0], lambda content: content["provenance"].update(scale=scale))
    page = page_of(copied[0])
    assert ('class="notice"' in page) == (words is not None)
    assert words is None or words in page
    assert ('class="glance"' in page) == ('class="tile"' in page) == (scale != "smoke")


def test_figure_8_shows_the_strongest_collision_although_it_was_missed(copied):
    def miss_all(content):
        for bundle in content["bundles"]:
            bundle["latched"] |= {"latched": 0}

    change(copied[0], miss_all)
    results = load_results(copied[0])
    missed = [
        replace(bundle, collisions=tuple(replace(one, joint=None) for one in bundle.collisions))
        for bundle in results.bundles
    ]
    results = replace(results, bundles=tuple(missed))
    joint, (only,) = choose(results)
    assert only.sensor_peak_nm[joint] == max(peak for one in results.ten for peak in one.sensor_peak_nm)
    assert "No bundle shown found a collision here" in draw_three_collisions(results, signals_of(copied)).caption
    assert "misses the fewest" not in page_of(copied[0])


def test_names_are_text_and_never_markup(copied):
    def edit(content):
        content["provenance"]["machine"] = "<b>fast</b> & loud"
        content["bundles"][0]["name"] = "<i>exact"

    change(copied[0], edit)
    page = page_of(copied[0])
    assert "&lt;b&gt;fast&lt;/b&gt; &amp; loud" in page and "<i>exact" not in page


def test_what_was_done_to_a_bundle_after_its_training_is_reported(copied):
    words = "is not as training left it"
    assert words not in page_of(copied[0])
    first = load_results(copied[0]).bundles[0]

    def edit(content):
        (bundle,) = (one for one in content["bundles"] if one["name"] == first.name)
        bundle["changed_since_training"] = {"since training, joint1": "friction times 1.31 ± 0.02"}

    change(copied[0], edit)
    told = words_of(page_of(copied[0]))
    assert f"{first.label} {words}" in told and "joint1 friction times 1.31 ± 0.02" in told


def test_numbers_that_do_not_exist_are_dashes(copied):
    def edit(content):
        bundle = content["bundles"][0]
        for key in ("l1_nm", "rmse_near_stiction_nm"):
            bundle["free_motion"][key] = [None, 0.5]
        for key in ("hours", "false_alarms", "false_alarms_per_hour", "l2_nm", "observer_peak_nm"):
            bundle["free_motion"][key] = None
        for key in ("steps", "epochs", "limits", "ten_found", "latched"):
            del bundle[key]
        del bundle["free_motion"]["false_collisions"]
        bundle["collisions"] = []
        content["provenance"] = {}

    change(copied[0], edit)
    page = words_of(page_of(copied[0]))
    assert "exact joint1 – 0.402 – 0.661" in page
    assert "false collisions: not measured, no free motion tested" in page
    assert "exact – no collisions tested" in page


def test_a_dataset_without_free_motion_is_reported_as_not_measured(copied):
    def edit(content):
        for bundle in content["bundles"]:
            free = bundle["free_motion"]
            n = len(free["l1_nm"])
            free |= {name: [None] * n if isinstance(value, list) else None for name, value in free.items()}
            free |= {"recordings": [], "hours": 0.0, "samples": 0, "false_collisions_interval_per_hour": None}

    change(copied[0], edit)
    page = page_of(copied[0])
    plain = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page))
    assert "L1 not measured" in plain and "false collisions: not measured, no free motion tested" in plain
    assert "0.00 to 0.00" not in plain and "0 false collisions" not in plain
    results = load_results(copied[0])
    assert set(methods(results).rows[0].cells[1:2]) == {NOT_MEASURED}
    assert set(method_errors(results).rows[0].cells[1:7]) == {NOT_MEASURED}
    assert all(cell != NOT_MEASURED for cell in method_errors(results).rows[0].cells[7:])  # limits are known


def test_results_without_collisions_say_so(copied):
    def edit(content):
        content["ten_collisions"], content["collisions"] = [], []
        for bundle in content["bundles"]:
            bundle["collisions"], bundle["found_curve"], bundle["ten_found"] = [], [], 0

    change(copied[0], edit)
    results = load_results(copied[0])
    assert "the results hold no collisions" in page_of(copied[0])
    for draw in (draw_collisions, draw_three_collisions):
        with pytest.raises(NotAvailable):
            draw(results, signals_of(copied))
    with pytest.raises(NotAvailable):
        draw_found_curve(results)


# Figures


def test_figure_five_has_a_column_a_bundle_and_a_row_a_joint(made):
    drawing = draw_free_motion(load_results(made[0]), signals_of(made))
    titles = [axes.get_title() for axes in drawing.figure.axes]
    assert [title for title in titles if title] == ["exact", "mass", "CoM", "mass + CoM", "no model"]
    assert len(titles) == 10


def test_figure_six_shades_the_region_of_the_results(copied):
    change(copied[0], lambda content: content.update(near_stiction_rad_s=0.05))
    drawing = draw_error_over_speed(load_results(copied[0]), signals_of(copied))
    assert drawing.figure.axes[1].get_xlim() == pytest.approx((-0.25, 0.25))


def test_figure_seven_shows_the_chosen_collisions_without_a_model(made):
    results = load_results(made[0])
    drawing = draw_collisions(results, signals_of(made))
    top, bottom = drawing.figure.axes
    assert [text.get_text() for text in top.texts] == [str(k + 1) for k in range(len(results.ten_collisions))]
    onsets = [f"{one.start_s:.2f} s" for one in results.ten]
    assert [tick.get_text() for tick in bottom.get_xticklabels()] == onsets
    assert drawing.caption.startswith("Figure 7. No model:")


def test_figure_eight_is_of_the_first_joint_where_three_were_found_there(made):
    results = load_results(made[0])
    joint, collisions = choose(results)
    assert joint == 0 and len(collisions) == 3
    assert all(results.bundles[0].verdicts[c.id].joint == "joint1" for c in collisions)
    drawing = draw_three_collisions(results, signals_of(made))
    lanes = [text.get_text() for axes in drawing.figure.axes[6:] for text in axes.texts]
    expected = [bundle.verdicts[c.id].delay_against_sensor_s * 1e3 for c in collisions for bundle in results.bundles]
    assert [int(lane.split()[0].replace("−", "-")) for lane in lanes] == [round(ms) for ms in expected]


def test_a_bundle_without_estimates_is_left_out_and_named(copied):
    results, _ = copied
    shutil.rmtree(results / "estimates" / "mass")
    for draw in (draw_free_motion, draw_three_collisions):
        drawing = draw(load_results(results), signals_of(copied))
        assert "since their estimates are missing: mass." in drawing.caption
    shutil.rmtree(results / "estimates" / "exact")
    with pytest.raises(NotAvailable, match="no test recording is there with its estimates of bundle exact"):
        draw_error_over_speed(load_results(results), signals_of(copied))
    shutil.rmtree(results / "estimates" / "none")
    with pytest.raises(NotAvailable, match="no estimates of bundle none for collisions-000"):
        draw_collisions(load_results(results), signals_of(copied))


def test_figures_need_no_other_bundle_than_the_one_there_is(copied):
    change(copied[0], lambda content: content.update(bundles=content["bundles"][2:3]))
    for draw in DRAWERS:
        assert draw(load_results(copied[0]), signals_of(copied)).figure.axes
    assert draw_found_curve(load_results(copied[0])).figure.axes


def test_a_bundle_keeps_its_colour_whatever_stands_beside_it():
    assert bundle_colours(["none", "mine"])["none"] == bundle_colours(list(CASE_COLOURS))["none"]
    assert bundle_colours(["none", "mine"])["mine"] == OTHER_COLOURS[0]
    many = [f"bundle-{k}" for k in range(17)]
    assert len({*bundle_colours(many).values()}) == 17 == len({*bundle_colours(["exact", *many[1:]]).values()})
    assert bundle_colours(many)["bundle-0"] == CASE_COLOURS["exact"]  # free where no bundle is the paper's
    strokes = bundle_strokes(many[:12]).values()
    assert len({(stroke["marker"], str(stroke["linestyle"])) for stroke in strokes}) == 12
    assert bundle_colours(["none-paper", "none"]) == {
        "none-paper": VARIANT_COLOURS["none"],
        "none": CASE_COLOURS["none"],
    }
    assert bundle_colours(["none-paper", "none-long"])["none-long"] == OTHER_COLOURS[0]
    palettes = [*CASE_COLOURS.values(), *VARIANT_COLOURS.values(), *OTHER_COLOURS]
    assert len({*palettes}) == len(palettes)


# Bundles of one model, trained by different recipes


@pytest.mark.parametrize(
    "name, recipe, label",
    [
        ("none", "dense", "no model"),
        ("exact-paper", "paper", "exact, paper recipe"),
        ("exact-paper", None, "exact, paper"),
        ("mass+com-2h", "dense", "mass + CoM, 2h"),
        ("exactly", "paper", "exactly"),
        ("my-paper", "paper", "my-paper"),
    ],
)
def test_a_bundle_is_called_by_its_model_and_what_sets_it_apart(name, recipe, label):
    assert bundle_label(name, recipe) == label


def test_bundles_stand_in_the_papers_order_with_other_recipes_behind_their_models_own(seven):
    results = load_results(seven[0])
    assert [bundle.name for bundle in results.bundles] == [
        "exact",
        "exact-paper",
        "mass",
        "com",
        "mass+com",
        "none",
        "none-paper",
    ]
    without = replace(
        results, bundles=tuple(bundle for bundle in results.bundles if bundle.name not in ("none", "exact"))
    )
    assert (without.bundle("none").name, without.bundle("exact").name) == ("none-paper", "exact-paper")


def test_the_papers_numbers_stand_beside_both_recipes_and_the_recipe_is_named(seven):
    page = words_of(page_of(seven[0]))
    by_the_paper, by_dense = page.index("By the paper&#39;s own recipe"), page.index("By recipe dense")
    assert by_the_paper < page.index("exact, paper recipe joint1") < by_dense
    for label, name, trained in (("exact", "exact", "20,000"), ("exact, paper recipe", "exact-paper", "189,000")):
        ours = load_results(seven[0]).bundle(name)
        free = ours.free_motion
        measures = f"{free.l1_nm[0]:.3f} 0.402 {free.l2_nm[0]:.3f} 0.661 {free.mse_nm2[0]:.3f} 0.435"
        assert f"{label} joint1 {measures} {trained}" in page
    assert "exact 20,000 steps; exact, paper recipe 189,000 steps; mass 20,000 steps" in page


@pytest.mark.slow
def test_seven_bundles_are_drawn_in_every_figure(seven, tmp_path):
    page = write_report(*seven, tmp_path / "report", page_mb=0).read_text()
    assert "is not available" not in page  # traces alone are not, for want of room
    assert page.count('class="tile"') == 7 and "/ 4)" in page  # rows of four and three
    drawing = draw_free_motion(load_results(seven[0]), signals_of(seven))
    titles = [axes.get_title() for axes in drawing.figure.axes if axes.get_title()]
    assert titles[:2] == ["exact", "exact,\npaper recipe"] and len(titles) == 7


# Methods compared


def rename(count):
    """A change to so many bundles of other names, the first ones' copies."""

    def edit(content):
        content["bundles"] = [content["bundles"][k % 5] | {"name": f"method {k}"} for k in range(count)]

    return edit


def test_a_method_has_one_row_and_detectors_that_know_nothing_stand_under_it(made):
    results = load_results(made[0])
    table = methods(results)
    assert [row.cells[0] for row in table.rows] == [*results.labels.values(), "always", "never", "random"]
    assert {len(row.cells) for row in table.rows} == {len(table.columns)} == {sum(span for _, span in table.groups)}
    latched = results.bundles[0].latched
    assert f"{latched.strong_latched} of {latched.strong}" in table.rows[0].cells
    assert f"0 of {len(results.collisions)} (in alarm at {len(results.collisions)})" in table.rows[5].cells


@pytest.mark.parametrize(
    "kept, consistent, word", [(None, None, "–"), (False, False, "no"), (True, True, "yes"), (True, False, "far below")]
)
def test_a_promise_is_reported_as_kept_or_not(kept, consistent, word, copied):
    entries = {"promise_kept": kept, "promise_consistent": consistent}
    change(copied[0], lambda content: content["bundles"][0]["free_motion"].update(entries))
    assert word in methods(load_results(copied[0])).rows[0].cells[-5]


@pytest.mark.parametrize(("most", "cell"), [(None, "0.125"), (0.125, "0.125"), (1.2, "0.125, at most 1.2")])
def test_the_rate_of_extrapolated_limits_has_its_upper_end(most, cell, copied):
    entries = {"promised_per_hour": 0.125, "at_most_per_hour": most}
    change(copied[0], lambda content: content["bundles"][0]["free_motion"].update(entries))
    assert methods(load_results(copied[0])).rows[0].cells[-6] == cell


def test_the_mark_of_a_method_stands_at_its_own_false_collisions_and_misses(made):
    results = load_results(made[0])
    axes = draw_missed_curve(results).figure.axes[0]
    marks = {tuple(line.get_xydata()[0]) for line in axes.get_lines() if len(line.get_xydata()) == 1}
    for bundle in results.bundles:
        free, latched = bundle.free_motion, bundle.latched
        at = [mark for mark in marks if mark[0] == pytest.approx(free.false_collisions / free.hours)]
        at = at or [mark for mark in marks if free.false_collisions == 0 and mark[0] < 0.4 / free.hours]  # in the strip
        missed = 100 * (1 - latched.latched / latched.collisions)
        assert any(mark[1] <= missed + 1e-9 for mark in at)  # one that was on before the onset is not latched anew


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 12])
def test_figures_of_any_number_of_methods_are_drawn_and_crowded_ones_show_the_first_five(count, copied):
    change(copied[0], rename(count))
    results, signals = load_results(copied[0]), signals_of(copied)
    for draw in (draw_missed_curve, draw_strength, draw_after_contact):
        drawing = draw(results)
        drawing.figure.draw_without_rendering()
        labels = [text.get_text() for text in drawing.figure.legends[0].get_texts()]
        assert [label for label in labels if label != "random alarms"] == [f"method {k}" for k in range(count)]
    for k, bundle in enumerate(results.bundles):
        shutil.copytree(copied[0] / "estimates" / list(CASE_COLOURS)[k % 5], copied[0] / "estimates" / bundle.name)
    for draw in (draw_free_motion, draw_three_collisions):
        assert ("Only the first 5 of 12 bundles are drawn." in draw(results, signals).caption) == (count == 12)


def test_figures_of_methods_say_what_is_missing(copied):
    def strip(content):
        for bundle in content["bundles"]:
            for key in ("latched", "missed_curve", "by_strength", "after_contact"):
                del bundle[key]

    change(copied[0], strip)
    results = load_results(copied[0])
    for draw in (draw_missed_curve, draw_strength, draw_after_contact, draw_learning_curves):
        with pytest.raises(NotAvailable):
            draw(results)
    assert methods(results).rows[0].cells[-4:] == ("–",) * 4


def test_learning_curves_have_a_line_a_recipe_and_a_panel_a_joint(copied):
    def edit(content):
        for k, bundle in enumerate(content["bundles"]):
            bundle |= {"name": f"m{k}", "case": "exact", "recipe": ("dense", "prior")[k % 2]}
            bundle["training_minutes"] = (1, 2, 30, 40, 50)[k]

    change(copied[0], edit)
    results = load_results(copied[0])
    panels = draw_learning_curves(results).figure.axes
    assert [axes.get_title() for axes in panels] == ["joint1", "joint2"]
    dense, prior = (line.get_xydata().tolist() for line in panels[1].get_lines())
    assert dense == [[m, results.bundle(f"m{k}").free_motion.l1_nm[1]] for k, m in ((0, 1), (2, 30), (4, 50))]
    assert len(prior) == 2


def test_test_recordings_whose_estimates_were_not_kept_are_counted_and_not_listed(copied):
    names = [f"free-{k:03d}" for k in range(2, 400)]
    change(copied[0], lambda content: content["bundles"][0]["free_motion"]["recordings"].extend(names))
    drawing = draw_error_over_speed(load_results(copied[0]), signals_of(copied))
    assert drawing.caption.endswith(" 398 more test recordings have no estimates kept.")


# Training loss


def test_recipes_of_one_model_share_a_panel_of_the_training_loss(seven):
    drawing = draw_training_loss(load_results(seven[0]))
    panels = drawing.figure.axes
    assert [axes.get_title() for axes in panels] == ["exact", "mass", "CoM", "mass + CoM", "no model"]
    assert [text.get_text() for text in panels[0].get_legend().get_texts()] == ["dense recipe", "paper recipe"]
    assert panels[1].get_legend() is None
    history = load_results(seven[0]).bundle("mass").loss_history
    training, validation, lowest = (line.get_xydata().tolist() for line in panels[1].get_lines())
    assert training == [[step, loss] for step, loss, _ in history]
    assert validation == [[step, loss] for step, _, loss in history]
    assert lowest == [min(validation, key=lambda point: point[1])]
    assert "No history" not in drawing.caption


@pytest.mark.parametrize(
    "count",
    [1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, 7)), 7],
)
def test_as_many_panels_as_bundles_of_other_names_have_a_history(count, copied):
    def edit(content):
        content["bundles"] = [content["bundles"][0] | {"name": f"bundle {k}"} for k in range(count)]

    change(copied[0], edit)
    drawing = draw_training_loss(load_results(copied[0]))
    assert [axes.get_title() for axes in drawing.figure.axes] == [f"bundle {k}" for k in range(count)]
    drawing.figure.draw_without_rendering()


def test_bundles_without_a_loss_history_are_named_and_without_any_there_is_no_figure(copied):
    change(copied[0], lambda content: content["bundles"][1].update(loss_history=None))
    assert draw_training_loss(load_results(copied[0])).caption.endswith("No history: mass.")
    change(copied[0], lambda content: [bundle.pop("loss_history") for bundle in content["bundles"]])
    with pytest.raises(NotAvailable, match="the results hold no loss history"):
        draw_training_loss(load_results(copied[0]))


# Faults


def test_estimates_of_another_recording_are_refused(copied):
    results, data = copied
    folder = results / "estimates" / "exact"
    shorter = make_results(data.parent / "short", seconds=20, bundles=("exact",))[1]
    (shorter / "free-000.parquet").replace(data / "free-000.parquet")
    with pytest.raises(RecordingError, match="samples 30000, its recording 20000; evaluate this dataset again"):
        draw_free_motion(load_results(results), signals_of(copied))
    (folder / "free-000.parquet").unlink()
    (folder / "free-000.parquet").write_bytes(b"PAR1")
    with pytest.raises(RecordingError, match="not a readable estimates file"):
        draw_error_over_speed(load_results(results), signals_of(copied))


def test_a_dataset_of_another_robot_is_refused(copied, tmp_path):
    results, _ = copied
    other = make_results(tmp_path / "other", joints=3, bundles=("exact",), seconds=20)[1]
    with pytest.raises(RecordingError, match="its joints are joint1, joint2, joint3, the results' joint1, joint2"):
        write_report(results, other, tmp_path / "report")


def cut(content):
    content["bundles"][0]["free_motion"]["l1_nm"] = [0.1]


FAULTS = {
    "older": (lambda c: c.update(format=3), "format 3 instead of 1: made by a development version before 0.1.0"),
    "no joints": (lambda c: c.update(joints=[]), "it holds no joints"),
    "no bundles": (lambda c: c.update(bundles=[]), "it holds no bundles; evaluate at least one bundle"),
    "bundles null": (lambda c: c.update(bundles=None), "it holds no bundle"),
    "a bundle that is text": (lambda c: c.update(bundles=["exact"]), 'bundles[0]: is "exact", must be an object'),
    "nameless bundle": (lambda c: c["bundles"][1].pop("name"), "bundles[1]: 'name' is null, must be str"),
    "one number for two joints": (cut, "bundles[0], free_motion: 'l1_nm' must be a list of 2 numbers or null"),
    "text for a number": (
        lambda c: c["bundles"][0]["free_motion"].update(hours="1"),
        "'hours' is \"1\", must be int or float",
    ),
    "verdict without found": (
        lambda c: c["bundles"][0]["collisions"][0].pop("found"),
        "bundles[0], collisions[0]: 'found' is null, must be bool",
    ),
    "collision without start": (
        lambda c: c["collisions"][0].pop("start_s"),
        "collisions[0]: 'start_s' is null, must be int or float",
    ),
    "loss without step": (
        lambda c: c["bundles"][0].update(loss_history=[[0.5, 0.1, 0.1]]),
        "bundles[0]: 'loss_history[0][0]' is 0.5, must be int",
    ),
    "true for a count": (lambda c: c["bundles"][0].update(ten_found=True), "'ten_found' is true, must be int"),
    "not a number": (lambda c: c["bundles"][0]["free_motion"].update(hours=float("nan")), "NaN is no JSON number"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_results_are_refused_with_their_place(fault, copied):
    edit, message = FAULTS[fault]
    change(copied[0], edit)
    with pytest.raises(ConfigError) as caught:
        load_results(copied[0])
    assert str(caught.value).startswith(f"{copied[0] / 'results.json'}")
    assert message in str(caught.value)


def test_missing_results_and_an_unwritable_folder_are_refused(made, tmp_path):
    with pytest.raises(ConfigError, match="there are no such results; `tauext evaluate` writes them"):
        write_report(tmp_path, tmp_path, tmp_path / "report")
    (tmp_path / "file").touch()
    with pytest.raises(TauextError, match="is no folder; choose another place"):
        write_report(*made, tmp_path / "file")


def test_a_figure_of_one_bundle_is_not_of_the_plain_observer_where_there_is_another(copied):
    def edit(content):
        for k, bundle in enumerate(content["bundles"]):
            bundle |= {"name": f"method {k}", "recipe": "prior" if k else "observer"}

    change(copied[0], edit)
    assert load_results(copied[0]).bundle("none").name == "method 1"


# Bundles with an error scale


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Results of two bundles whose limits follow the motion, and the dataset."""
    folder = tmp_path_factory.mktemp("moving")
    return make_results(folder, seconds=30, bundles=("exact", "none"), error_scale=True)


def test_limits_that_move_are_drawn_as_they_held(moving):
    results, signals = load_results(moving[0]), signals_of(moving)
    assert results.some_limits_move
    _, collisions = choose(results)
    said = signals.estimates("exact", signals.recording(collisions[0].recording))
    limit = draw_three_collisions(results, signals).figure.axes[0].get_lines()[-1].get_ydata()
    assert len(np.unique(np.abs(limit))) > 100 and np.isin(np.abs(limit), said.limit_nm[:, 0]).all()
    drawing = draw_collisions(results, signals)
    r, uncertainty, below, above = drawing.figure.axes[0].get_lines()[:4]
    np.testing.assert_allclose(
        above.get_ydata() - uncertainty.get_ydata(), uncertainty.get_ydata() - below.get_ydata(), atol=1e-4
    )
    assert np.ptp(above.get_ydata() - uncertainty.get_ydata()) > 0.1
    assert "follows the motion" in drawing.caption and len(r.get_ydata()) == len(above.get_ydata())
    speeds = draw_error_over_speed(results, signals)
    assert [text.get_text() for text in speeds.figure.legends[0].get_texts()][-1] == "threshold, median at a speed"
    assert "Bands are one standard error" in draw_three_collisions(results, signals).caption


def test_errors_against_sigma_have_a_panel_a_joint_and_a_table(moving, made):
    results = load_results(moving[0])
    drawing = draw_error_against_sigma(results)
    assert not any("$" in text for text in texts_of(drawing.figure))
    assert [axes.get_title() for axes in drawing.figure.axes] == list(results.joints)
    region = results.bundles[0].error_against_sigma["sliding"][0]
    offsets = drawing.figure.axes[0].collections[0].get_offsets()
    np.testing.assert_allclose(offsets, [(b.sigma_rms_nm, b.error_rms_nm) for b in region.bins if b.samples >= FEWEST])
    table = sigma_table(results)
    assert table.rows[0].cells[:3] == ("exact", "joint1", f"{region.samples:,}")
    words = words_of(page_of(moving[0]))
    assert "threshold in usual motion" in words and f"{100 * region.within_one_sigma:.1f}" in words
    with pytest.raises(NotAvailable, match="no bundle in the results has an error scale"):
        draw_error_against_sigma(load_results(made[0]))
    assert "threshold in usual motion" not in words_of(page_of(made[0])) and sigma_table(load_results(made[0])) is None


def test_regions_of_another_number_of_joints_are_refused(moving, tmp_path):
    results = shutil.copytree(moving[0], tmp_path / "results")
    change(results, lambda content: content["bundles"][0]["error_against_sigma"]["sliding"].pop())
    with pytest.raises(ConfigError, match="error_against_sigma: each region must hold 2 entries"):
        load_results(results)


def way(median: float | None, worst: float | None, blind: float = 0.0) -> dict:
    return {"median_n": median, "worst_n": worst, "blind_share": blind}


def noticed_entry(times: float = 1.0) -> dict:
    """Of one point, as an evaluation writes it."""
    forces = {"x": way(12.0 * times, 40.0), "y": way(9.0, 17.0), "z": way(31.0, None, 0.25)}
    every = {"median_n": 14.0, "nine_of_ten_n": 55.0}
    return {"place": "link of joint1, at joint2", "every_way": every, **forces, "worst_way": way(None, None, 1.0)}


def put_noticed(results, contact_times: float = 1.0) -> None:
    """Into every bundle of results that are there."""
    limits = {"collision": [noticed_entry()], "contact": [noticed_entry(contact_times)]}
    noticed = {"poses": 256, "limits": limits, "gain_per_s": 20.0, "error_share": 0.2}
    change(results, lambda content: [one.update(forces={"lasting": noticed}) for one in content["bundles"]])


def test_the_page_has_the_forces_that_are_detected_as_a_table_and_a_figure(made, noticing, written):
    assert "What force is detected" not in words_of(page_of(made[0]))
    words = words_of(written[1].read_text())
    assert "What force is detected" in words
    assert "1.3 times these on" in words and "K0 = 20 1/s" in words and "ISO/TS 15066" in words
    results = load_results(noticing[0])
    table = forces_table(results.bundles, results.bundles[0])
    assert table.rows[0].cells == ("collision", "link of joint1", "14", "55", ">1000", ">1000", "100")
    assert [one.cells[0] for one in table.rows] == ["collision", "contact"]
    lines = draw_noticed_force(results.bundles[0].forces.lasting).figure.axes[0].get_lines()
    assert [line.get_xdata().tolist() for line in lines[:2]] == [[14, 55], [14]]
    assert lines[2].get_xdata()[0] > MOST_N  # blind stands beyond every number


def test_limits_that_notice_the_same_stand_once(copied):
    put_noticed(copied[0])
    results = load_results(copied[0])
    assert [row.cells[0] for row in forces_table(results.bundles, results.bundles[0]).rows] == ["collision and contact"]
    alike = {"collision while sliding": 1, "collision near stiction": 2, "contact while sliding": 1}
    assert joined(alike) == {"collision and contact while sliding": 1, "collision near stiction": 2}


def test_a_bundle_without_forces_has_the_reason(copied):
    why = "the bundle has no error scale"
    refused = {"lasting": {"refused": why}}
    change(copied[0], lambda content: [one.update(forces=refused) for one in content["bundles"]])
    assert why in words_of(page_of(copied[0]))
    with pytest.raises(NotAvailable, match=why):
        draw_noticed_force(load_results(copied[0]).bundles[0].forces.lasting)


def test_forces_that_are_no_numbers_are_refused_with_their_place(copied):
    put_noticed(copied[0])

    def spoil(content: dict) -> None:
        content["bundles"][0]["forces"]["lasting"]["limits"]["contact"][0]["x"].pop("blind_share")

    change(copied[0], spoil)
    with pytest.raises(ConfigError, match=r"contact\[0\], x: 'blind_share'"):
        load_results(copied[0])
