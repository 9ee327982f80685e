"""README's plot: missed contacts over false alarms an hour, on three simulated arms together.

    python packages/lab/benchmarks/missed_plot.py [--paper BENCH] [--adaptive BENCH]

BENCH is OUT of `tauext bench --track lugre maxwell-slip belt`, with thresholds as each method has them, and with
thresholds that follow the error (docs/results/bench.md). Both are kept in docs/results/bench/curves.json, from which
docs/pictures/missed.svg is drawn, for light and dark pages. On each track and at each rate, a method has those of the
two kinds of thresholds by which it misses fewer contacts.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import ROOT, arguments, save_json

KEPT = ROOT / "docs/results/bench/curves.json"
PICTURE = ROOT / "docs/pictures/missed.svg"
TRACKS = ("lugre", "maxwell-slip", "belt")
METHODS = {
    "observer": "momentum observer",
    "friction": "friction model",
    "dense@3000": "the paper's LSTM, 3,000 steps",
    "prior": "tauext",
}
WIDTH, HEIGHT = 520, 300
PLOT = (48.0, 34.0, 452.0, 214.0)
"""Left, top, width and height."""
RATES = (1, 2, 5, 10, 20, 50)
"""Ticks, false alarms an hour; the axis ends at the last."""
TOP_SHARE = 0.75
STYLE = """
    text { fill: #1f2933; } .grey { fill: #66727f; } .grid { stroke: #d5dbe1; }
    .line { fill: none; stroke: currentColor; stroke-width: 2.5; } .name { fill: currentColor; }
    .observer { color: #66727f; } .friction { color: #2e7d4a; } .dense { color: #b4500a; } .prior { color: #2f6db3; }
    .observer .line { stroke-dasharray: 2 4; } .friction .line { stroke-dasharray: 8 4; }
    .prior .line { stroke-width: 4; } .prior { font-weight: 700; }
    @media (prefers-color-scheme: dark) {
      text { fill: #e6edf3; } .grey { fill: #9aa7b4; } .grid { stroke: #3a434d; }
      .observer { color: #9aa7b4; } .friction { color: #6fcf97; } .dense { color: #f5a05a; } .prior { color: #6cb0ff; }
    }"""


def curves(out: Path, thresholds: str) -> list[dict[str, Any]]:
    """Of each method on each track the contacts that it detects with 0, 1, 2, ... false alarms."""
    found = []
    for track in TRACKS:
        for path in sorted(path for path in (out / track).glob("*.json") if path.stem in METHODS):
            result = json.loads(path.read_text())
            facts = {"track": track, "method": result["name"], "thresholds": thresholds}
            facts |= {"hours": round(result["equal"]["hours"], 4), "contacts": result["equal"]["contacts"]}
            detected = dict((false, found) for false, found, _ in result["curve"])
            steps = range(max(detected) + 1)
            found.append(facts | {"detected": [detected[max(k for k in detected if k <= step)] for step in steps]})
    return found


def missed(kept: list[dict[str, Any]], method: str) -> list[tuple[float, float]]:
    """Rates of false alarms on each track, [1/h], and the share of all tracks' contacts that a method misses."""
    of_track = [[one for one in kept if (one["method"], one["track"]) == (method, track)] for track in TRACKS]
    contacts, hours = (sum(kinds[0][key] for kinds in of_track) for key in ("contacts", "hours"))
    steps = range(1, min(len(one["detected"]) for kinds in of_track for one in kinds))
    found = {k: sum(max(one["detected"][k] for one in kinds) for kinds in of_track) for k in steps}
    return [(k * len(TRACKS) / hours, 1 - found[k] / contacts) for k in steps]


def drawn(kept: list[dict[str, Any]]) -> str:
    """The SVG."""
    left, top, width, height = PLOT
    first = missed(kept, "prior")[0][0]

    def x(rate: float) -> float:
        return left + width * math.log(rate / first) / math.log(RATES[-1] / first)

    def y(share: float) -> float:
        return top + height * (1 - share / TOP_SHARE)

    parts = []
    for share in (0.0, 0.25, 0.5, 0.75):
        parts.append(f'<line class="grid" x1="{left}" x2="{left + width}" y1="{y(share):.1f}" y2="{y(share):.1f}"/>')
        parts.append(f'<text class="grey" x="{left - 6}" y="{y(share) + 5:.1f}" text-anchor="end">{share:.0%}</text>')
    parts += [
        f'<text class="grey" x="{x(rate):.1f}" y="{top + height + 20}" text-anchor="middle">{rate}</text>'
        for rate in RATES
    ]
    for method, label in METHODS.items():
        points = [(rate, share) for rate, share in missed(kept, method) if rate <= RATES[-1]]
        path = f"M{x(points[0][0]):.1f},{y(points[0][1]):.1f}"
        for rate, share in points[1:]:
            path += f" H{x(rate):.1f} V{y(share):.1f}"
        down = 18 if method == "friction" else -8
        parts += [
            f'<g class="{method.partition("@")[0]}"><path class="line" d="{path} H{left + width}"/>',
            f'<text class="name" x="{left + 6}" y="{y(points[0][1]) + down:.1f}">{label}</text></g>',
        ]
    contacts = sum(next(one["contacts"] for one in kept if one["track"] == track) for track in TRACKS)
    title = f'missed of {contacts} contacts, three <tspan font-weight="700">simulated</tspan> arms'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}"',
            '  font-family="system-ui, sans-serif" font-size="15">',
            "  <title>Missed contacts over false alarms an hour, on three simulated arms</title>",
            f"  <style>{STYLE}\n  </style>",
            *parts,
            f'<text x="8" y="18">{title}</text>',
            f'<text class="grey" x="{left + width}" y="{HEIGHT - 8}" text-anchor="end">false alarms an hour</text>',
            "</svg>\n",
        ]
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--paper", type=Path, help="OUT of the run with the thresholds of each method")
    parser.add_argument("--adaptive", type=Path, help="OUT of the run with thresholds that follow the error")
    options = parser.parse_args()
    if options.paper and options.adaptive:
        save_json(curves(options.paper, "own") + curves(options.adaptive, "adaptive"), KEPT)
    PICTURE.write_text(drawn(json.loads(KEPT.read_text())))
    print(PICTURE)


if __name__ == "__main__":
    main()
