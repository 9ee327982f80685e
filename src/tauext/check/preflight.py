"""Checks before training: how much data they read, which findings are cached, and which stop a training."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Self

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.check.contacts import is_unlabelled_contact, spoils_contacts
from tauext.check.examine import Diagnosis, examine, quick_checks, unlabelled_contacts
from tauext.check.finding import CODES, Finding, Severity
from tauext.check.motion import MOVING_RAD_S
from tauext.data.dataset import stretches
from tauext.data.free_motion import cut
from tauext.data.importers.raw import short_list
from tauext.data.recording import Recording
from tauext.errors import ConfigError, FaultyDataError, TrainingError
from tauext.files.atomic_write import atomic_write
from tauext.files.copies import cache_folder, version_of
from tauext.files.places import Place, is_stored
from tauext.files.provenance import VERSION
from tauext.progress import Reporter

# --- How much of some motion a bundle's monitor rejects, and why.


WORTH_A_WARNING = 0.02
"""Of the samples; beyond it results follow from less motion than was recorded."""
TOO_MUCH = 0.2
"""Beyond it they follow from other motion than was recorded."""
REJECTED = "rejected"
"""Code that accepts it."""
REMEDIES = {
    "wrong rate": "import the recordings again, or state their mean rate (arm.toml, [time] rate_hz)",
    "torque saturated": "check the robot file's torque limits and the unit of tau",
    "encoder still": "check which column each joint's position comes from",
    "gap": "record without losing samples",
}
"""By cause; of any other one `tauext check` reports more."""


@dataclass(frozen=True)
class WorstRecording:
    recording: str
    share: float


@dataclass(frozen=True)
class RejectedTime:
    """Share of the time in which the monitor was not healthy."""

    share: float | None
    causes: dict[str, float]
    worst: WorstRecording | None


class Rejected:
    """Counts the samples that are not healthy, by cause and recording.

    Counted are the samples behind the first healthy one of each recording; a recording without any counts whole. The
    warm-up after a fault is rejected, too, and counts for the fault.
    """

    def __init__(self) -> None:
        self.samples = self.rejected = 0
        self._causes: dict[str, int] = {}
        self._shares: dict[str, float] = {}

    @classmethod
    def of(cls, bundle: _core.Bundle, recordings: Iterable[Recording], threads: int) -> Self:
        """What a monitor with this bundle rejects of these recordings."""
        found = cls()
        for recording in recordings:
            estimates = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads)
            found.add(recording.name, estimates["health"], estimates["causes"])
        return found

    def add(self, name: str, health: np.ndarray, causes: np.ndarray | None) -> None:
        """Take in a recording: health and bits of the causes, (samples,)."""
        healthy = health == OK
        first = int(healthy.argmax())  # 0 where none is
        bad = ~healthy[first:]
        bits = np.zeros(len(bad), np.uint32) if causes is None else causes[first:]
        if bad.any() and not healthy.any():
            bad = bits != 0  # all but the warm-up, which has no cause
        for cause, samples in zip(*np.unique(bits[bad], return_counts=True), strict=True):
            for text in _core.cause_names(int(cause)):
                self._causes[text] = self._causes.get(text, 0) + int(samples)
        self._shares[name] = float(bad.mean()) if len(bad) else 0.0
        self.rejected, self.samples = self.rejected + int(bad.sum()), self.samples + len(bad)

    @property
    def share(self) -> float:
        return self.rejected / self.samples if self.samples else 0.0

    def summary(self) -> RejectedTime:
        worst = max(self._shares, key=self._shares.__getitem__, default="")
        causes = sorted(self._causes.items(), key=lambda cause: -cause[1])
        return RejectedTime(
            share=round(self.share, 4),
            causes={name: round(count / self.samples, 4) for name, count in causes},
            worst=WorstRecording(worst, round(self._shares.get(worst, 0.0), 4)),
        )

    def warning(self, motion: str, accept: Collection[str] = (REJECTED,)) -> str:
        """A sentence with cause, recording and remedy; empty where hardly anything is rejected.

        Args:
            motion: what was rejected: `its own training motion`.
            accept: codes that are accepted.

        Raises:
            TrainingError: more than TOO_MUCH is rejected, and REJECTED is not accepted.
        """
        if self.share <= WORTH_A_WARNING:
            return ""
        found = self.summary()
        causes, worst = found.causes, found.worst
        assert worst is not None
        named = ", ".join(f"{name} {share:.1%}" for name, share in causes.items()) or "warming up"
        remedy = next((REMEDIES[name] for name in causes if name in REMEDIES), "inspect the data with `tauext check`")
        words = (
            f"a monitor with this bundle rejects {self.share:.1%} of {motion} ({named}), {worst.share:.0%} of "
            f"'{worst.recording}'"
        )
        if self.share > TOO_MUCH and REJECTED not in accept:
            raise TrainingError(f"{words}: {remedy}; --accept {REJECTED} goes on with the rest")
        return f"{words}; the results follow from the rest alone: {remedy}"


# --- Findings, cached by the content of the data, so that the same data are not checked twice.


def remembered(parts: Iterable[str], find: Callable[[], list[Finding]]) -> list[Finding]:
    """The cached findings for these parts, else those found now.

    A damaged cache file is ignored. A cache that cannot be written is no error: the next call checks again.

    Args:
        parts: all that the findings depend on but for the code of the checks, as digests or words.
    """
    text = json.dumps([VERSION, checks_version(), *parts])
    path = folder() / f"{hashlib.sha256(text.encode()).hexdigest()}.json"
    try:
        return [Finding(**entry) for entry in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError, AssertionError):
        pass
    found = find()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            part.write_text(json.dumps([asdict(finding) for finding in found]) + "\n")
    except OSError:
        pass
    return found


def folder() -> Path:
    """Where findings are cached: $XDG_CACHE_HOME/tauext/checks, or ~/.cache/tauext/checks."""
    return cache_folder() / "checks"


@cache
def checks_version() -> str:
    """Digest of the code of the checks: other code may find other things."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def digest_of(recording: Recording) -> str:
    """Digest of all that the checks read of a recording."""
    head = [recording.name, recording.joints, recording.rate_hz, recording.robot_sha256, recording.provenance]
    digest = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
    for signal in ("t_ns", "q", "dq", "tau", "temperature", "contact"):
        values = getattr(recording, signal)
        digest.update(signal.encode() if values is None else values.data)
    return digest.hexdigest()


def file_digest(path: Place) -> str:
    """Of a file's bytes, or what a store marks its content by; a file that cannot be read has the digest of none."""
    if is_stored(path):
        return version_of(path)
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError:
        pass
    return digest.hexdigest()


# --- Use of findings: faults refuse the data, unless accepted; warnings are reported and kept.


LISTED = 8
"""Findings of one code whose evidence is listed; more are counted."""
NARROW = 2
"""Joints that are named one by one in what would accept a code; of more, all are meant."""


@dataclass(frozen=True)
class CheckResult:
    """Faults and warnings of one set of recordings, notes left out."""

    findings: list[Finding] = field(default_factory=list)

    def faults(self) -> list[Finding]:
        """Those that refuse the data unless accepted."""
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
        if finding.recording and len(entry["recordings"]) < LISTED:
            entry["recordings"].append(finding.recording)
    return list(found.values())


def expect_codes(accept: Sequence[str], joints: Collection[str] | None = None) -> None:
    """Raise ConfigError where a code is not one of a finding, or a joint not one of the arm.

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
    """Whether the finding's code is accepted, for all joints or for its joint."""
    return finding.code in accept or f"{finding.code}:{finding.joint}" in accept


def refuse_faults(results: Mapping[str, CheckResult], where: str, accept: Sequence[str], report: Reporter) -> dict:
    """Report warnings and accepted faults, each once; the facts of each result, for provenance.

    Args:
        where: the data, for the message.

    Raises:
        FaultyDataError: a fault that is not accepted; the message is a block with all of them.
    """
    findings = [finding for result in results.values() for finding in result.findings]
    refused = [f for f in findings if f.severity == "fault" and not is_accepted(f, accept)]
    if refused:
        count = len(by_code(refused))
        lines = [
            f"{where}: {count} fault{'' if count == 1 else 's'}, so these data are refused",
            *finding_lines(refused),
            "  `tauext check --out DIR` draws them. To use them as they are, accept the faults; the bundle records it:",
            f"      --accept {' '.join(accepting(refused))}",
        ]
        raise FaultyDataError("\n".join(lines), refused)
    for entry in entries(f for f in findings if f.severity == "fault"):
        report.say(f"accepted: {sentence(entry)}")
    for entry in entries(f for f in findings if f.severity == "warning"):
        report.say(f"warning: {sentence(entry)}")
    return {name: result.facts(accept) for name, result in results.items()}


def sentence(entry: dict) -> str:
    """An entry of facts on one line."""
    at = f" ({entry['joint']})" if entry["joint"] else ""
    more = f" (and {entry['count'] - 1} more)" if entry["count"] > 1 else ""
    return f"{entry['code']}{at}: {entry['evidence']}{more}"


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Lines for the terminal: code, joints, recordings and evidence, and the remedy once a code."""
    lines = []
    for code, same in by_code(findings).items():
        joints = list(dict.fromkeys(f.joint for f in same if f.joint))
        recordings = list(dict.fromkeys(f.recording for f in same if f.recording))
        named = [f"joint{'s' * (len(joints) > 1)} {', '.join(joints)}"] if joints else []
        named += [f"recording{'s' * (len(recordings) > 1)} {short_list(recordings, LISTED)}"] if recordings else []
        about = f" ({'; '.join(named)})" if named else ""
        lines.append(f"  {code}{about}: {CODES[code]}")
        for finding in same[:LISTED]:
            lines.append(f"      {f'{finding.joint}: ' if finding.joint else ''}{finding.evidence}")
        if len(same) > LISTED:
            lines.append(f"      and {len(same) - LISTED} more")
        lines += [f"      -> {advice}" for advice in dict.fromkeys(f.advice for f in same)]
    return lines


def accepting(faults: Sequence[Finding]) -> list[str]:
    """Values of --accept for these faults, limited to their joints where these are few."""
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


# --- All checks read a share of the training data; the cheap ones, and that for contacts, read every sample.


MOST_MOVING_S = 180.0
"""Of motion that all checks read, [s], the same share of each recording from its beginning on: order, axes, signs
and scales show within half a minute, the cheap checks find what is rare."""
LEAST_MOVING_S = 20.0
"""Of each recording, [s]: a shorter one shows too little to be compared with the others."""
LEAST_ROWS = 200
"""Of each recording: stamps of another unit make seconds of an hour, or hours of a second."""
FITTED = ("effort-scale", "effort-motor-side")
"""Codes that are no fault where training finds the factor."""
LESSER: Mapping[str, Severity] = {
    "contact-in-free-motion": "note",  # is labelled: training and limits leave it out, and report it
    "smoothed": "warning",  # model and friction are right, limits too low for the raw signal
}
"""Severity in training of faults of these codes."""
TOO_FEW = ("too-short", "temperature-drift")
"""Codes that a share of the recordings cannot decide."""
RARE = ("spike",)
"""Codes that a share of the recordings may miss."""
AT_A_TIME = 4
"""Most recordings that are checked at a time."""


def check_training(
    recordings: Sequence[Recording],
    robot: Path | None,
    limits_nm: np.ndarray | None,
    finds_constants: bool,
    threads: int,
    report: Reporter,
) -> CheckResult:
    """Run all checks on the data of a training; findings are cached by content.

    Contacts that are labelled are left out of it, hence no fault.

    Args:
        recordings: for training and validation, as they will be used.
        robot: the robot file; None: there is no model, and checks that need one are left out.
        limits_nm: largest torque of each drive, (joints,); None: tau is in another unit, or nothing is known.
        finds_constants: whether training finds the factor of tau, which is unknown before.
        threads: 0: one a core. What is found does not depend on it.
    """
    settings = [str(finds_constants), "none" if robot is None else file_digest(robot), _words(limits_nm)]
    workers = _workers(threads)
    with ThreadPoolExecutor(workers) as pool:
        digests = list(pool.map(digest_of, recordings))

    def find() -> list[Finding]:
        few = shares(recordings)
        diagnoses: list[Diagnosis] = []

        def examined() -> list[Finding]:
            diagnoses.append(examine(few, robot))
            return diagnoses[0].findings

        tasks: list[Callable[[], list[Finding]]] = [examined]
        tasks += [partial(quick_checks, one, limits_nm) for one in recordings]
        general, *quick = _in_parallel(tasks, workers, "check the data", report)
        if any(a is not b for a, b in zip(few, recordings, strict=True)):
            general = [f for f in general if f.code not in TOO_FEW]
            refused = any(forgiven(f).severity == "fault" for f in general)
            if not refused and not spoils_contacts(general):
                general = [f for f in general if not is_unlabelled_contact(f)]
                general += unlabelled_contacts(recordings, diagnoses[0])
        return together([f for f in map(forgiven, general) if not (finds_constants and f.code in FITTED)], quick)

    return CheckResult(_without_notes(remembered(["training", *settings, *digests], find)))


def check_calibration(
    files: Sequence[Place], limits_nm: np.ndarray | None, threads: int, report: Reporter
) -> CheckResult:
    """Run the cheap checks on every calibration recording; findings are cached by content.

    Args:
        files: the recordings.
        limits_nm: as of check_training.
    """
    workers = _workers(threads)
    with ThreadPoolExecutor(workers) as pool:
        digests = [f"{file.name} {digest}" for file, digest in zip(files, pool.map(file_digest, files), strict=True)]

    def find() -> list[Finding]:
        def checked(load: Callable[[], Recording]) -> list[Finding]:
            return quick_checks(load(), limits_nm)

        found = _in_parallel(
            [partial(checked, load) for load in stretches(files)], workers, "check the calibration recordings", report
        )
        return [forgiven(finding) for of_recording in found for finding in of_recording]

    return CheckResult(_without_notes(remembered(["calibration", _words(limits_nm), *digests], find)))


def check_for_bundle(
    bundle: _core.Bundle,
    name: str,
    files: Sequence[Place],
    where: str,
    accept: Sequence[str],
    threads: int,
    report: Reporter,
) -> dict[str, dict]:
    """The cheap checks of recordings from which a bundle learns again; their facts under the name, for provenance.

    Raises:
        ConfigError: a code that does not exist, or a joint.
        FaultyDataError: a fault that is not accepted.
    """
    expect_codes(accept, [link.joint_name for link in bundle.links])
    limits_nm = np.array(bundle.torque_limit_nm) if all(unit == "N m" for unit in bundle.torque_units) else None
    return refuse_faults({name: check_calibration(files, limits_nm, threads, report)}, where, accept, report)


def shares(recordings: Sequence[Recording]) -> list[Recording]:
    """The beginning of each, as long as its share of MOST_MOVING_S of motion takes; all where there is no more."""
    moving = [np.cumsum((np.abs(r.dq) > MOVING_RAD_S).any(axis=1)) / r.rate_hz for r in recordings]
    share = min(1.0, MOST_MOVING_S / max(1e-9, sum(float(m[-1]) for m in moving)))
    if share == 1.0:
        return list(recordings)
    ends = [max(LEAST_ROWS, int(np.searchsorted(m, max(LEAST_MOVING_S, share * m[-1]))) + 1) for m in moving]
    return [r if end >= r.samples else cut(r, slice(0, end)) for r, end in zip(recordings, ends, strict=True)]


def forgiven(finding: Finding) -> Finding:
    """Lower the severity of faults that do not affect training."""
    return replace(finding, severity=LESSER.get(finding.code, "fault")) if finding.severity == "fault" else finding


def together(general: Sequence[Finding], quick: Iterable[Sequence[Finding]]) -> list[Finding]:
    """The findings of all checks, and of the cheap ones the faults that the others did not report, and what is rare.

    Other warnings that hold for one recording, and not for all of them together, are none.
    """
    reported = {(f.code, f.joint, f.recording) for f in general}
    found = list(general)
    for finding in (forgiven(finding) for of_recording in quick for finding in of_recording):
        if finding.severity != "fault" and finding.code not in RARE:
            continue
        same = {(finding.code, joint, name) for joint in (finding.joint, None) for name in (finding.recording, None)}
        if not reported & same:
            found.append(finding)
    return found


def _without_notes(findings: Iterable[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.severity != "note"]


def _in_parallel(
    tasks: Sequence[Callable[[], list[Finding]]], workers: int, title: str, report: Reporter
) -> list[list[Finding]]:
    """Results in order; the first error ends all tasks."""
    with report.progress(title) as show, ThreadPoolExecutor(workers) as pool:
        futures: list[Future[list[Finding]]] = [pool.submit(task) for task in tasks]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                show(done, len(futures), "checks")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


def _words(limits_nm: np.ndarray | None) -> str:
    return "unknown" if limits_nm is None else ", ".join(f"{limit:g}" for limit in limits_nm)


def _workers(threads: int) -> int:
    return min(threads or os.cpu_count() or 1, AT_A_TIME)
