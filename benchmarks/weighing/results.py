"""Tables of the weighing trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from common import head, joined, table_row

from tauext.monitor.weighing import LoadEstimate
from weighing.takes import Carried

MASS_SHARE, MASS_KG = 0.05, 0.1
COM_M, COM_LIGHT_M, LIGHT_KG = 0.02, 0.04, 1.0
TITLES = {
    "true": "true constants",
    "off": "off by up to 10 %, as trained",
    "off, common": "then `--known-kg`, one factor",
    "off, joints": "then trained anew, `--torque-constants`",
}


@dataclass(frozen=True)
class Weighed:
    """One window."""

    arm: str
    kind: str
    recording: str
    truth: Carried
    verdict: str
    mass_kg: float = np.nan
    mass_error_kg: float = np.nan
    off_m: float = np.nan
    com_error_m: float = np.nan

    @classmethod
    def of(
        cls, arm: str, kind: str, recording: str, truth: Carried, found: LoadEstimate, axes: Sequence[int] = (0, 1, 2)
    ) -> Weighed:
        """Axes: of the load frame, those along which the arm's motion can tell a centre of mass at all."""
        off = float(np.linalg.norm((found.com_m - truth.com_m)[list(axes)]))
        error = float(np.sqrt(np.diag(found.com_covariance)[list(axes)].sum()))
        return cls(arm, kind, recording, truth, found.verdict, found.mass_kg, found.mass_error_kg, off, error)

    @classmethod
    def refused(cls, arm: str, kind: str, recording: str, truth: Carried) -> Weighed:
        return cls(arm, kind, recording, truth, "refused")

    @property
    def mass_right(self) -> bool:
        true = self.truth.mass_kg
        return self.verdict == "load" and abs(self.mass_kg - true) <= max(MASS_SHARE * true, MASS_KG)

    @property
    def mass_told(self) -> bool:
        """The estimate itself says that twice its error is within."""
        return self.verdict == "load" and 2 * self.mass_error_kg <= max(MASS_SHARE * self.truth.mass_kg, MASS_KG)

    @property
    def within_m(self) -> float:
        return COM_M if self.truth.mass_kg >= LIGHT_KG else COM_LIGHT_M

    @property
    def com_right(self) -> bool:
        return self.verdict == "load" and self.off_m <= self.within_m

    @property
    def com_told(self) -> bool:
        """The estimate itself says that it is within."""
        return self.verdict == "load" and self.com_error_m <= self.within_m


def row(of: Sequence[Weighed]) -> dict:
    """Figures of the loads among these."""
    loads = [w for w in of if w.truth.mass_kg > 0]
    seen = [w for w in loads if w.verdict == "load"]
    off = np.array([w.mass_kg - w.truth.mass_kg for w in seen])
    told = [w for w in loads if w.com_told]
    share = off / [w.truth.mass_kg for w in seen]
    return {
        "windows": len(loads),
        "mass": float(np.mean([w.mass_right for w in loads])),
        "com": float(np.mean([w.com_right for w in loads])),
        "both": float(np.mean([w.mass_right and w.com_right for w in loads])),
        "mass_told": float(np.mean([w.mass_told for w in loads])),
        "mass_where_told": mean_of([w.mass_right for w in loads if w.mass_told]),
        "com_told": len(told) / len(loads),
        "com_where_told": mean_of([w.com_right for w in told]),
        "mass_bias": float(np.median(share)),
        "mass_spread": float(np.quantile(np.abs(share - np.median(share)), 0.68)),
        "within_2_errors": float(np.mean(np.abs(off) <= 2 * np.array([w.mass_error_kg for w in seen]))),
        "verdicts": dict(Counter(w.verdict for w in loads)),
        "pushes": dict(Counter(w.verdict for w in of if w.truth.push_n > 0)),
    }


def mean_of(values: Sequence[bool]) -> float | None:
    """None of none."""
    return float(np.mean(values)) if values else None


def summary(outcomes: Sequence[Weighed]) -> dict:
    """By constants and arm, `all` over arms."""
    facts: dict = {}
    for kind in dict.fromkeys(w.kind for w in outcomes):
        of = [w for w in outcomes if w.kind == kind]
        facts[kind] = {arm: row([w for w in of if w.arm == arm]) for arm in dict.fromkeys(w.arm for w in of)}
        facts[kind]["all"] = row(of)
    return {"weighed": facts}


def markdown(outcomes: Sequence[Weighed], factors: dict[str, dict], command: str) -> str:
    """The page."""
    facts = summary(outcomes)["weighed"]
    lines = [
        "# What an arm carries",
        "",
        f"Written by `{command}`.",
        "",
        "Simulated arms of the trial on [unseen arms](../unseen-arms/README.md): a model that is wrong, friction with",
        "memory, load and warmth, motor currents. Nine minutes to train on, without a load. Then loads of 0.5 to 3 kg",
        "within 10 cm of the last joint's origin, 25 an arm, two windows of 4 s of each, whatever the arm does:",
        "some hold little but pauses and creep. Mass: within 5 % or 0.1 kg. Centre: within 2 cm from 1 kg on, 4 cm",
        "below. Told: twice the mass's own standard error, or the centre's own, is within that.",
        "",
        "The rig is the [virtual one](../../rig.md): two joints, a model that is right, measured torques that wrong",
        "constants scale. Its loads are within 10 cm of its tip, in the plane in which it moves: nothing tells where",
        "they are across it, and their centres are judged in the plane.",
        "",
        *head(
            "constants | arm | windows | mass | centre | both | mass told | mass where told | centre told "
            "| centre where told | mass off by, median (68 %) | mass within two of its errors"
        ),
    ]
    for kind, arms in facts.items():
        for arm, f in arms.items():
            mass, where = ("–" if f[key] is None else f"{f[key]:.0%}" for key in ("mass_where_told", "com_where_told"))
            name = f"**{arm}**" if arm == "all" else arm
            shares = [f"{f[key]:.1%}" for key in ("mass", "com", "both")]
            told = [f"{f['mass_told']:.0%}", mass, f"{f['com_told']:.0%}", where]
            off = [f"{f['mass_bias']:+.1%} (± {f['mass_spread']:.1%})", f"{f['within_2_errors']:.0%}"]
            lines.append(table_row(TITLES[kind], name, f["windows"], *shares, *told, *off))
    lines += ["", "What each window was taken for, loads and then constant forces of 10 to 40 N across gravity:", ""]
    lines += head("constants | arm | loads | forces")
    for kind, arms in facts.items():
        for arm, f in arms.items():
            counts = (", ".join(f"{n} {v}" for v, n in sorted(f[key].items())) for key in ("verdicts", "pushes"))
            lines.append(table_row(TITLES[kind], arm, *counts))
    lines += ["", *factor_lines(factors)]
    return "\n".join(lines) + "\n"


def factor_lines(factors: dict[str, dict]) -> list[str]:
    """What the known weight said beside what was true."""
    lines = [
        "Factors by which the torques of the arm as trained are off, and what 2.805 kg in 40 s of motion said of them:",
        "",
        *head("arm | true | one factor | joint by joint (in brackets: taken from all)"),
    ]
    for arm, f in factors.items():
        true = joined(f["left"], ".3f")
        if "refused" in f:
            lines.append(f"| {arm} | {true} | refused: {f['refused']} | |")
            continue
        own = " · ".join(f"{x:.3f}" if s else f"({x:.3f})" for x, s in zip(f["joints"], f["shows"], strict=True))
        lines.append(table_row(arm, true, f"{f['common']:.3f} ± {f['common_error']:.3f}", own))
    return lines
