"""The diagnosis as text for a terminal and as plain data for a script."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

from tauext.check.examine import Diagnosis
from tauext.check.finding import SEVERITIES, Finding

COLUMNS = (
    ("torque_is", "tau is", "", ""),
    ("range_rad", "range", "rad", ".2f"),
    ("speed_rad_s", "speed", "rad/s", ".2f"),
    ("torque_nm", "torque", "Nm", ".3g"),
    ("torque_noise_nm", "noise", "Nm", ".2g"),
    ("torque_step_nm", "tau step", "", ".3g"),
    ("position_step_rad", "q step", "rad", ".3g"),
    ("velocity_step_rad_s", "dq step", "rad/s", ".2g"),
    ("backlash_rad", "play", "rad", ".2g"),
    ("velocity_factor", "dq by dq/dt", "", ".3f"),
    ("velocity_delay_ms", "dq late", "ms", ".1f"),
    ("torque_delay_ms", "tau late", "ms", ".1f"),
    ("gravity_factor", "tau by g", "", ".3f"),
    ("error_nm", "unexplained", "Nm", ".2g"),
)
"""What was measured of a joint: name of the fact, its heading, unit and format."""


def as_text(diagnosis: Diagnosis) -> str:
    """Findings, those of one code, evidence and advice together; then a table of what was measured."""
    lines = []
    for finding, joints in grouped(diagnosis.findings):
        where = f" ({', '.join(joints)})" if joints else ""
        lines += [f"{finding.severity}: {finding.code}{where}"]
        for one in diagnosis.findings:
            if (one.code, one.severity) == (finding.code, finding.severity):
                lines.append(f"    {one.joint + ': ' if one.joint else ''}{one.evidence}")
        lines.append(f"    -> {finding.advice}")
    counts = [sum(f.severity == severity for f in diagnosis.findings) for severity in SEVERITIES]
    told = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in zip(counts, SEVERITIES, strict=True))
    return "\n".join([*lines, "" if lines else "nothing found", *_table(diagnosis), "", told])


def as_files(diagnosis: Diagnosis, recordings: Iterable[str], without_model: bool) -> tuple[str, dict]:
    """Contents of check.txt and check.json.

    Args:
        recordings: names of those that were examined.
        without_model: no robot file was there to hold them against.
    """
    text = as_text(diagnosis)
    if without_model:
        text = f"no robot model: order, scale, gravity and payload cannot be checked\n{text}"
    return text, as_data(diagnosis) | {"recordings": list(recordings)}


def grouped(findings: list[Finding]) -> list[tuple[Finding, list[str]]]:
    """The first finding of each code and severity, and the joints of all of them."""
    groups: dict[tuple[str, str], tuple[Finding, list[str]]] = {}
    for finding in findings:
        _, joints = groups.setdefault((finding.code, finding.severity), (finding, []))
        if finding.joint and finding.joint not in joints:
            joints.append(finding.joint)
    return list(groups.values())


def as_data(diagnosis: Diagnosis) -> dict:
    """JSON-ready: joints, findings, facts by joint, faulty."""
    return {
        "format": 1,
        "joints": list(diagnosis.joints),
        "faulty": diagnosis.faulty,
        "findings": [asdict(finding) for finding in diagnosis.findings],
        "facts": dict(zip(diagnosis.joints, diagnosis.facts, strict=True)),
    }


def _table(diagnosis: Diagnosis) -> list[str]:
    shown = [c for c in COLUMNS if any(c[0] in fact for fact in diagnosis.facts)]
    head = ["joint", *(f"{title} {unit}".strip() for _, title, unit, _ in shown)]
    rows = [
        [joint, *(format(fact[key], form) if key in fact else "-" for key, _, _, form in shown)]
        for joint, fact in zip(diagnosis.joints, diagnosis.facts, strict=True)
    ]
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]

    def line(row: list[str]) -> str:
        first, *others = zip(row, widths, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)])

    return [line(row) for row in [head, *rows]]
