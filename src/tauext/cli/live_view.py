"""The live view on a terminal: events scroll above, one panel shows the arm as it is now."""

from __future__ import annotations

import math
import time
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tauext._core import cause_names
from tauext.bundle.estimates import ALARMS, HEALTHS
from tauext.bundle.units import SEVERAL, of_all, short
from tauext.cli.text_lines import TextLines
from tauext.monitor.event_stream import Chunk, Tally
from tauext.monitor.explanation import readable
from tauext.monitor.monitored_time import percent
from tauext.progress import in_plain_letters

REFRESH_S = 0.1
BAR_CELLS = 40
HEALTH_STYLES = {"ok": "green", "warming up": "yellow", "stale": "yellow", "fault": "bold red"}
ALARM_STYLES = {"none": "green", "contact": "bold yellow", "collision": "bold white on red"}


class LiveView(TextLines):
    """Text lines, with a panel below them that is redrawn ten times a second."""

    def __init__(self, flights: Path | None = None, acknowledges: bool = False, console: Console | None = None):
        super().__init__(flights, acknowledges)
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._drawn = 0.0

    def print_line(self, line: str) -> None:
        self._console.print(in_plain_letters(line), markup=False, highlight=False, soft_wrap=True)

    def chunk(self, chunk: Chunk, tally: Tally) -> None:
        super().chunk(chunk, tally)
        now = time.monotonic()
        if now - self._drawn >= REFRESH_S:
            self._drawn = now
            self._live.update(self.panel(chunk, now - self._began), refresh=True)

    def _print_rest(self) -> None:
        self._live.update("", refresh=True)
        super()._print_rest()

    def panel(self, chunk: Chunk, wall_s: float) -> Group:
        """The monitor's estimates at the chunk's last sample; bars show the chunk's largest |tau_ext| of each joint."""
        estimates = chunk.estimates
        time_s = self._time_s(int(chunk.t_ns[-1]))
        health, alarm = HEALTHS[estimates["health"][-1]], ALARMS[estimates["alarm"][-1]]
        causes = ", ".join(cause_names(int(estimates["causes"][-1])))
        status = Text.assemble(
            "health ",
            (health, HEALTH_STYLES[health]),
            f" ({causes})" if causes else "",
            "   alarm ",
            (alarm, ALARM_STYLES[alarm]),
        )
        if estimates["alarm_joint"][-1] >= 0:
            status.append(f" {self._joints[estimates['alarm_joint'][-1]]}")
        if alarm == "collision" and self._behind:
            status.append(f", hides {self._behind} more; --acknowledge-after-s 1 shows them")
        return Group(Text(self.heading(time_s, wall_s)), status, self.joints(chunk))

    def heading(self, time_s: float, wall_s: float) -> str:
        """The panel's first line."""
        if math.isinf(self._duration_s):
            share = self._monitored.minute
            watched = "" if math.isnan(share) else f", monitored {percent(share)} of the last minute"
            return f"{self._title}  {time_s:.1f} s{watched}"
        speed = f", {time_s / wall_s:.1f} times as fast as recorded" if wall_s > 0.5 else ""
        return f"{self._title}  {time_s:.2f} of {self._duration_s:.2f} s{speed}"

    def joints(self, chunk: Chunk) -> Table:
        """A row a joint: bar from -limit to +limit, tau_ext, its standard error, limit, margin, speed, region."""
        table = Table(box=None, pad_edge=False)
        for title in ("joint", "tau_ext from −threshold to +threshold"):
            table.add_column(title)
        unit = of_all(self._units)
        for title in (f"tau_ext, {unit}", f"threshold, {unit}", f"margin, {unit}", "speed, rad/s"):
            table.add_column(title, justify="right")
        table.add_column("")
        estimates = chunk.estimates
        for j, joint in enumerate(self._joints):
            tau_ext, limit = estimates["tau_ext"][:, j], estimates["limit_nm"][:, j]
            k = chunk.peak_row(j)
            sigma = estimates["contact_sigma_nm"][-1, j]
            near = "near stiction" if estimates["near_stiction"][-1, j] else ""
            table.add_row(
                f"{joint} [{short(self._units[j])}]" if unit == SEVERAL else joint,
                bar(tau_ext[k] / limit[k]),
                text_number(tau_ext[-1], "+") + (f" ± {sigma:.2f}" if math.isfinite(sigma) else ""),
                text_number(limit[-1]),
                text_number(estimates["margin_nm"][-1, j], "+"),
                readable(chunk.dq[-1, j], "+.3f"),
                near,
            )
        return table


def bar(share: float) -> Text:
    """tau_ext over limit, -1 to +1, as a bar from the middle; red and full where it is over, empty where unknown."""
    half = BAR_CELLS // 2
    cells = min(half, round(abs(share) * half)) if math.isfinite(share) else 0
    style = "red" if abs(share) > 1 else "yellow" if abs(share) > 0.7 else "green"
    left = " " * (half - cells) + "█" * cells if share < 0 else " " * half
    right = "█" * cells + " " * (half - cells) if share >= 0 else " " * half
    return Text.assemble("▏", (left, style), "│", (right, style), "▕")


def text_number(value: float, sign: str = "") -> str:
    return readable(value, f"{sign}.2f") if math.isfinite(value) else "–"
