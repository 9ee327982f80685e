"""Checks before training: share of the data, cache of findings, and faults that stop a training."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Self

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.check.contacts import is_unlabelled_contact
from tauext.check.examine import Diagnosis, examine, quick_checks, unlabelled_contacts
from tauext.check.finding import CODES, Finding, Severity
from tauext.check.motion import MOVING_RAD_S
from tauext.data.dataset import stretches
from tauext.data.free_motion import cut
from tauext.data.importers.raw import short_list
from tauext.data.labels import labels_key
from tauext.data.recording import Recording
from tauext.errors import ConfigError, FaultyDataError, TrainingError
from tauext.files.atomic_write import atomic_write
from tauext.files.checkpoint import cache_folder
from tauext.files.provenance import VERSION
from tauext.progress import Reporter

# --- Share of motion that a bundle's monitor rejects, and causes.


WORTH_A_WARNING = 0.02
"""Share of rejected samples that causes a warning: results then follow from less motion than was recorded."""
TOO_MUCH = 0.2
"""Share that is an error: results would not represent the recorded motion."""
REJECTED = "rejected"
"""Code that accepts this error."""
REMEDIES = {
    "wrong rate": "import the recordings again, or state their mean rate (arm.toml, [time] rate_hz)",
    "torque saturated": "check the robot file's torque limits and the unit of tau",
    "encoder still": "check which column each joint's position comes from",
    "gap": "record without losing samples",
}
"""Remedies by cause; for others `tauext check` has details."""


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

    Samples after the first healthy one of each recording count; a recording without any counts whole. The warm-up after
    a fault counts for the fault.
    """

    def __init__(self) -> None:
        self.samples = self.rejected = 0
        self._causes: dict[str, int] = {}
        self._shares: dict[str, float] = {}

    @classmethod
    def of(cls, bundle: _core.Bundle, recordings: Iterable[Recording], threads: int) -> Self:
        """Count the samples that a monitor with this bundle rejects in these recordings."""
        found = cls()
        for recording in recordings:
            signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
            estimates = _core.estimate(bundle, *signals, threads, torques=["tau_ext"])  # as few as possible
            found.add(recording.name, estimates["health"], estimates["causes"])
        return found

    def add(self, name: str, health: np.ndarray, causes: np.ndarray | None) -> None:
        """Add a recording: health and bits of the causes, (samples,)."""
        healthy = health == OK
        first = int(healthy.argmax())  # 0 if none
        bad = ~healthy[first:]
        bits = np.zeros(len(bad), np.uint32) if causes is None else causes[first:]
        if bad.any() and not healthy.any():
            bad = bits != 0  # without the warm-up, which has no cause
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
        """Message with cause, recording and remedy; empty if few samples are rejected.

        Args:
            motion: name of the motion, such as `its own training motion`.
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
            raise TrainingError(f"{words}: {remedy}; --accept {REJECTED} continues with the rest")
        return f"{words}; the results follow from the rest only: {remedy}"


# --- Findings, cached by the content of the data, so that the same data are not checked twice.


def remembered(parts: Iterable[str], find: Callable[[], list[Finding]]) -> list[Finding]:
    """Return the cached findings for these parts, or find and cache them.

    A damaged cache file is ignored. A cache that cannot be written is no error: the next call checks again.

    Args:
        parts: digests or text of everything that determines the findings, except the code of the checks.
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
    """Digest of the code of the checks, on which findings depend."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def digest_of(recording: Recording) -> str:
    """Digest of everything in a recording that the checks read."""
    head = [recording.name, recording.joints, recording.rate_hz, recording.robot_sha256, recording.provenance]
    digest = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
    for signal in ("t_ns", "q", "dq", "tau", "temperature", "contact"):
        values = getattr(recording, signal)
        digest.update(signal.encode() if values is None else values.data)
    return digest.hexdigest()


def file_digest(path: Path) -> str:
    """Digest of a file's bytes; an unreadable file has the digest of no content."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError:
        pass
    return digest.hexdigest()


# --- Use of findings: faults are refused unless accepted; warnings are reported and stored.


LISTED = 8
"""Most findings of a code with evidence listed; further ones are counted."""
NARROW = 2
"""Most joints named in a suggested --accept; with more, the code is accepted for all joints."""


def entries(findings: Iterable[Finding]) -> list[dict]:
    """Entries by code and joint: number of recordings, and name and evidence of the first one."""
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
    """Raise ConfigError for an unknown code or joint.

    Args:
        accept: CODE or CODE:joint.
        joints: names of the joints; None: not known yet.
    """
    for text in accept:
        code, colon, joint = text.partition(":")
        if code not in CODES and text != REJECTED:
            known = ", ".join([*CODES, REJECTED])
            raise ConfigError(f"accept = {text}: '{code}' is no code of a finding; codes are {known}")
        if colon and joints is not None and joint not in joints:
            raise ConfigError(f"accept = {text}: there is no joint '{joint}'; the joints are {', '.join(joints)}")


def is_accepted(finding: Finding, accept: Collection[str]) -> bool:
    """Whether the finding's code is accepted, for all joints or for its joint."""
    return finding.code in accept or f"{finding.code}:{finding.joint}" in accept


def expect_accepted(findings: Iterable[Finding], accept: Collection[str], where: str, refused: str, how: str) -> None:
    """Raise FaultyDataError if a fault is not accepted; the message lists all of them.

    Args:
        where: name of what has the faults, for the message.
        refused: what is refused for them, in the plural.
        how: line of the message above the option that accepts them.
    """
    faults = [one for one in findings if one.severity == "fault" and not is_accepted(one, accept)]
    if not faults:
        return
    count = len(by_code(faults))
    lines = [
        f"{where}: {count} fault{'' if count == 1 else 's'}, so {refused} are refused",
        *finding_lines(faults),
        f"  {how}",
        f"      --accept {' '.join(accepting(faults))}",
    ]
    raise FaultyDataError("\n".join(lines), faults)


def refuse_faults(
    results: Mapping[str, Sequence[Finding]], where: str, accept: Sequence[str], report: Reporter
) -> dict:
    """Report warnings and accepted faults, each once; returns them for provenance, as plain JSON.

    Args:
        results: findings by the set of recordings.
        where: name of the data, for the message.

    Raises:
        FaultyDataError: a fault is not accepted; the message lists all of them.
    """
    findings = [finding for result in results.values() for finding in result]
    how = "`tauext check --out DIR` draws them. To use them unchanged, accept the faults; the bundle records it:"
    expect_accepted(findings, accept, where, "these data", how)
    for entry in _entries(findings, "fault"):
        report.say(f"accepted: {sentence(entry)}")
    for entry in _entries(findings, "warning"):
        report.say(f"warning: {sentence(entry)}")
    return {
        name: {"accepted": _entries(result, "fault"), "warnings": _entries(result, "warning")}
        for name, result in results.items()
    }


def _entries(findings: Iterable[Finding], severity: Severity) -> list[dict]:
    return entries(finding for finding in findings if finding.severity == severity)


def sentence(entry: dict) -> str:
    """Format an entry of facts on one line."""
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
    """Group findings by code, in order of first occurrence."""
    found: dict[str, list[Finding]] = {}
    for finding in findings:
        found.setdefault(finding.code, []).append(finding)
    return found


# --- All checks read a share of the training data; quick checks and the check for contacts read every sample.


MOST_MOVING_S = 180.0
"""Motion that all checks read, [s], the same share from the beginning of each recording. Order, axes, signs and scales
show within half a minute; the quick checks find rare faults."""
LEAST_MOVING_S = 20.0
"""Least time of each recording, [s]: less is too little for a comparison with the others."""
LEAST_ROWS = 200
"""Least samples of each recording: with stamps in a wrong unit an hour may last seconds."""
FITTED = ("effort-scale", "effort-motor-side")
"""Codes that are no fault if training finds the factor."""
TOO_FEW = ("too-short", "torque-changes")
"""Codes whose warnings cannot be decided on a share of the recordings: of the length, and of friction that changes."""
RARE = ("spike",)
"""Codes that a share of the recordings may miss."""
AT_A_TIME = 4
"""Most recordings checked in parallel."""


def check_training(
    recordings: Sequence[Recording],
    robot: Path | None,
    limits_nm: np.ndarray | None,
    finds_constants: bool,
    threads: int,
    report: Reporter,
) -> list[Finding]:
    """Faults and warnings in the data of a training, by all checks; they are cached by content.

    Labelled contacts are left out of training, so they are no fault.

    Args:
        recordings: for training and validation.
        robot: the robot file; None: no model, and checks that need one are skipped.
        limits_nm: largest torque of each drive, (joints,); None: unknown, or tau is in another unit.
        finds_constants: whether training finds the factor of tau.
        threads: number of threads, 0: one a core. The findings do not depend on it.
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
            general = [f for f in general if f.code not in TOO_FEW or f.severity == "fault"]
            if not diagnoses[0].spoiled and not any(f.severity == "fault" for f in general):
                general = [f for f in general if not is_unlabelled_contact(f)]
                general += unlabelled_contacts(recordings, diagnoses[0])
        return together([f for f in general if not (finds_constants and f.code in FITTED)], quick)

    return _without_notes(remembered(["training", *settings, *digests], find))


def check_calibration(
    files: Sequence[Path], limits_nm: np.ndarray | None, threads: int, report: Reporter
) -> list[Finding]:
    """Faults and warnings in calibration recordings, by the quick checks; they are cached by content.

    Args:
        files: the recordings.
        limits_nm: see check_training().
    """
    workers = _workers(threads)
    with ThreadPoolExecutor(workers) as pool:
        digests = [f"{file.name} {digest}" for file, digest in zip(files, pool.map(file_digest, files), strict=True)]
    digests += sorted({key for folder in {file.parent for file in files} if (key := labels_key(folder))})

    def find() -> list[Finding]:
        def checked(load: Callable[[], Recording]) -> list[Finding]:
            return quick_checks(load(), limits_nm)

        found = _in_parallel(
            [partial(checked, load) for load in stretches(files)], workers, "check the calibration recordings", report
        )
        return [finding for of_recording in found for finding in of_recording]

    return _without_notes(remembered(["calibration", _words(limits_nm), *digests], find))


def check_for_bundle(
    bundle: _core.Bundle,
    name: str,
    files: Sequence[Path],
    where: str,
    accept: Sequence[str],
    threads: int,
    report: Reporter,
) -> dict[str, dict]:
    """Run the quick checks on recordings that update a bundle; returns their facts under the name, for provenance.

    Raises:
        ConfigError: an unknown code or joint.
        FaultyDataError: a fault that is not accepted.
    """
    expect_codes(accept, [link.joint_name for link in bundle.links])
    limits_nm = np.array(bundle.torque_limit_nm) if all(unit == "N m" for unit in bundle.torque_units) else None
    return refuse_faults({name: check_calibration(files, limits_nm, threads, report)}, where, accept, report)


def shares(recordings: Sequence[Recording]) -> list[Recording]:
    """Cut each recording to its share of MOST_MOVING_S of motion, from the beginning; unchanged if they have less."""
    moving = [np.cumsum((np.abs(r.dq) > MOVING_RAD_S).any(axis=1)) / r.rate_hz for r in recordings]
    share = min(1.0, MOST_MOVING_S / max(1e-9, sum(float(m[-1]) for m in moving)))
    if share == 1.0:
        return list(recordings)
    ends = [max(LEAST_ROWS, int(np.searchsorted(m, max(LEAST_MOVING_S, share * m[-1]))) + 1) for m in moving]
    return [r if end >= r.samples else cut(r, slice(0, end)) for r, end in zip(recordings, ends, strict=True)]


def together(general: Sequence[Finding], quick: Iterable[Sequence[Finding]]) -> list[Finding]:
    """Combine the findings of all checks with the quick checks' further faults and rare warnings.

    Other warnings of a single recording are dropped.
    """
    reported = {(f.code, f.joint, f.recording) for f in general}
    found = list(general)
    for finding in (finding for of_recording in quick for finding in of_recording):
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
    """Run the tasks; results come in order, and the first error ends all tasks."""
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
