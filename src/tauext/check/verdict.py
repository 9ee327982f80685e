"""What is made of findings: faults refuse, unless a person accepted them; warnings are told and kept."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from tauext.check.finding import CODES, Finding
from tauext.check.rejected import REJECTED
from tauext.errors import ConfigError, FaultyDataError
from tauext.progress import Reporter

TOLD = 8
"""Findings of one code of which the evidence is told; more are counted."""
NARROW = 2
"""Joints that are named one by one in what would accept a code; of more, all are meant."""


@dataclass(frozen=True)
class Look:
    """Faults and warnings of one set of recordings, notes left out."""

    findings: list[Finding] = field(default_factory=list)

    def faults(self) -> list[Finding]:
        """Those that refuse unless somebody accepted them."""
        return [finding for finding in self.findings if finding.severity == "fault"]

    def facts(self, accept: Collection[str]) -> dict:
        """For provenance, as plain JSON: what was accepted, and what was warned of."""
        accepted = [finding for finding in self.faults() if is_accepted(finding, accept)]
        warnings = [finding for finding in self.findings if finding.severity == "warning"]
        return {"accepted": entries(accepted), "warnings": entries(warnings)}


def entries(findings: Iterable[Finding]) -> list[dict]:
    """One a code and joint: how many recordings it was found in, by name the first, and the first one's evidence."""
    found: dict[tuple[str, str | None], dict] = {}
    for finding in findings:
        entry = found.setdefault(
            (finding.code, finding.joint),
            {"code": finding.code, "joint": finding.joint, "recordings": [], "count": 0, "evidence": finding.evidence},
        )
        entry["count"] += 1
        if finding.recording and len(entry["recordings"]) < TOLD:
            entry["recordings"].append(finding.recording)
    return list(found.values())


def expect_codes(accept: Sequence[str], joints: Collection[str] | None = None) -> None:
    """Raise ConfigError where a code is none of the doctor's, or a joint none of the arm's.

    Args:
        accept: CODE or CODE:joint.
        joints: None: not known yet.
    """
    for text in accept:
        code, colon, joint = text.partition(":")
        if code not in CODES and text != REJECTED:
            known = ", ".join([*CODES, REJECTED])
            raise ConfigError(f"accept = {text}: '{code}' is no code of a finding; they are {known}")
        if colon and joints is not None and joint not in joints:
            raise ConfigError(f"accept = {text}: there is no joint '{joint}'; the joints are {', '.join(joints)}")


def is_accepted(finding: Finding, accept: Collection[str]) -> bool:
    """By its code, or by its code at its joint."""
    return finding.code in accept or f"{finding.code}:{finding.joint}" in accept


def judge(looks: Sequence[Look], where: str, accept: Sequence[str], report: Reporter) -> None:
    """Tell warnings and accepted faults, each once.

    Args:
        where: what was looked at, for the message.

    Raises:
        FaultyDataError: a fault that nobody accepted; the message is a block with all of them.
    """
    findings = [finding for look in looks for finding in look.findings]
    refused = [f for f in findings if f.severity == "fault" and not is_accepted(f, accept)]
    if refused:
        plural = "" if len(refused) == 1 else "s"
        lines = [
            f"{where}: {len(refused)} fault{plural}, so nothing is learned from it",
            *told(refused),
            "  `tauext check` draws it. To learn from it as it is, on your word, which the bundle keeps:",
            f"      --accept {' '.join(accepting(refused))}",
        ]
        raise FaultyDataError("\n".join(lines), refused)
    for entry in entries(f for f in findings if f.severity == "fault"):
        report.say(f"accepted: {sentence(entry)}")
    for entry in entries(f for f in findings if f.severity == "warning"):
        report.say(f"warning: {sentence(entry)}")


def sentence(entry: dict) -> str:
    """An entry of facts on one line."""
    at = f" ({entry['joint']})" if entry["joint"] else ""
    more = f" (and {entry['count'] - 1} more)" if entry["count"] > 1 else ""
    return f"{entry['code']}{at}: {entry['evidence']}{more}"


def told(findings: Sequence[Finding]) -> list[str]:
    """Lines for a person: code, joints, recordings, evidence of each, and the mend, once a code."""
    lines = []
    for code, same in by_code(findings).items():
        joints = list(dict.fromkeys(f.joint for f in same if f.joint))
        recordings = list(dict.fromkeys(f.recording for f in same if f.recording))
        named = [f"joint{'s' * (len(joints) > 1)} {', '.join(joints)}"] if joints else []
        named += [f"recording{'s' * (len(recordings) > 1)} {_few(recordings)}"] if recordings else []
        about = f" ({'; '.join(named)})" if named else ""
        lines.append(f"  {code}{about}: {CODES[code]}")
        for finding in same[:TOLD]:
            lines.append(f"      {f'{finding.joint}: ' if finding.joint else ''}{finding.evidence}")
        if len(same) > TOLD:
            lines.append(f"      and {len(same) - TOLD} more")
        lines += [f"      -> {advice}" for advice in dict.fromkeys(f.advice for f in same)]
    return lines


def accepting(faults: Sequence[Finding]) -> list[str]:
    """What --accept would take for these, and for no other joint where a few are meant."""
    words = []
    for code, same in by_code(faults).items():
        joints = list(dict.fromkeys(finding.joint for finding in same))
        words += [f"{code}:{joint}" for joint in joints] if all(joints) and len(joints) <= NARROW else [code]
    return words


def by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    """In the order of the first of each code."""
    found: dict[str, list[Finding]] = {}
    for finding in findings:
        found.setdefault(finding.code, []).append(finding)
    return found


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:TOLD]) + (f" and {len(names) - TOLD} more" if len(names) > TOLD else "")
