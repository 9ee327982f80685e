"""The plot of missed contacts over false alarms: of the kept curves, and as docs/results/bench.md has them."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.fixture
def plot(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "packages/lab/benchmarks"))
    return __import__("missed_plot")


def test_the_picture_is_that_of_the_kept_curves(plot):
    assert plot.PICTURE.read_text() == plot.drawn(json.loads(plot.KEPT.read_text()))


def test_one_false_alarm_finds_what_the_page_says(plot):
    kept = json.loads(plot.KEPT.read_text())
    page = (ROOT / "docs/results/bench.md").read_text().partition("## Friction of three families")[2]
    for method in plot.METHODS:
        name = rf"^\| (?:the paper's network, )?`?{method}`? \|(.*)\|(.*)\|(.*)\|$"
        rows = re.findall(name, page.partition("\n## ")[0].replace("*", ""), re.MULTILINE)
        of_track = [
            max(int(found[0]) for cell in cells if (found := re.search(r"\d+", cell)))
            for cells in zip(*rows, strict=True)
        ]
        rate, share = plot.missed(kept, method)[0]
        assert rate == pytest.approx(1 / 1.14, rel=1e-3) and share == pytest.approx(1 - sum(of_track) / 180)


def test_the_better_thresholds_count_on_each_track(plot):
    def curve(track, detected):
        return {"track": track, "method": "m", "hours": 2.0, "contacts": 10, "detected": detected}

    kept = [curve(track, [0, 5, 6]) for track in plot.TRACKS] + [curve("belt", [0, 4, 9])]
    assert plot.missed(kept, "m") == [(0.5, 0.5), (1.0, pytest.approx(0.3))]
