"""Checks before training: share of the data, cache of findings, and faults that stop a training."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.check.checks import EXPLAINED
from tauext.check.examine import UNSEEN, examine, not_checked, quick_checks, unlabelled_contacts
from tauext.check.finding import Finding, Severity, added, by_code, codes, finding_lines
from tauext.check.motion import MOVING_RAD_S
from tauext.check.torque_changes import is_unlabelled_contact
from tauext.data.dataset import stretches
from tauext.data.free_motion import cut
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
REJECTED = "rejected"
"""Code that accepts a share above a fifth, an error: results would not represent the recorded motion."""
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
        self._causes: Counter[str] = Counter()
        self._shares: dict[str, float] = {}

    @classmethod
    def of(cls, bundle: _core.Bundle, recordings: Iterable[Recording], threads: int) -> Self:
        """Count the samples that a monitor with this bundle rejects in these recordings."""
        found = cls()
        for one in recordings:  # with as few torques as possible
            estimates = _core.estimate(bundle, one.t_ns, one.q, one.dq, one.tau, threads, torques=["tau_ext"])
            found.add(one.name, estimates["health"], estimates["causes"])
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
            self._causes.update(dict.fromkeys(_core.cause_names(int(cause)), int(samples)))
        self._shares[name] = float(bad.mean()) if len(bad) else 0.0
        self.rejected, self.samples = self.rejected + int(bad.sum()), self.samples + len(bad)

    @property
    def share(self) -> float:
        return self.rejected / self.samples if self.samples else 0.0

    def summary(self) -> RejectedTime:
        worst = max(self._shares, key=self._shares.__getitem__, default="")
        causes = {name: round(count / self.samples, 4) for name, count in self._causes.most_common()}
        return RejectedTime(round(self.share, 4), causes, WorstRecording(worst, round(self._shares.get(worst, 0.0), 4)))

    def warning(self, motion: str, accept: Collection[str] = (REJECTED,)) -> str:
        """Message with cause, recording and remedy, if more than a few samples of this motion are rejected; else empty.

        Raises:
            TrainingError: more than a fifth is rejected, and REJECTED is not accepted.
        """
        if self.share <= WORTH_A_WARNING:
            return ""
        causes, worst = self.summary().causes, self.summary().worst
        assert worst is not None
        named = ", ".join(f"{name} {share:.1%}" for name, share in causes.items()) or "warming up"
        remedy = next((REMEDIES[name] for name in causes if name in REMEDIES), "inspect the data with `tauext check`")
        words = (
            f"a monitor with this bundle rejects {self.share:.1%} of {motion} ({named}), {worst.share:.0%} of "
            f"'{worst.recording}'"
        )
        if self.share > 0.2 and REJECTED not in accept:
            raise TrainingError(f"{words}: {remedy}; --accept {REJECTED} continues with the rest")
        return f"{words}; the results follow from the rest only: {remedy}"


# --- Findings, cached by the content of the data, so that the same data are not checked twice.


def remembered(parts: Sequence[str], find: Callable[[], list[Finding]]) -> list[Finding]:
    """Return the cached faults and warnings for these parts, or find and cache them.

    A damaged cache file is ignored. A cache that cannot be written is no error: the next call checks again.

    Args:
        parts: digests or text of everything that determines the findings, except the code of the checks.
    """
    text = json.dumps([VERSION, checks_version(), *parts])
    path = folder() / f"{hashlib.sha256(text.encode()).hexdigest()}.json"
    try:
        return [Finding(**entry) for entry in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError, AssertionError):
        found = [finding for finding in find() if finding.severity != "note"]
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
    """Digest of the code of the checks, those of packages too, on which findings depend."""
    digest = hashlib.sha256()
    files = [__file__, *(inspect.getfile(check.find) for check in added().values())]
    for package in dict.fromkeys(Path(file).parent for file in files):
        for source in sorted(package.glob("*.py")):
            digest.update(source.name.encode() + b"\0" + source.read_bytes())
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
    """Digest of a file's bytes; an unreadable file has none."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


# --- Use of findings: faults are refused unless accepted; warnings are reported and stored.


def entries(findings: Iterable[Finding], severity: Severity) -> list[dict]:
    """Entries by code and joint of this severity: number of recordings, names of the first eight, evidence of the
    first."""
    found: dict[tuple[str, str | None], dict] = {}
    for one in findings:
        if one.severity == severity:
            new: dict = {"code": one.code, "joint": one.joint, "recordings": [], "count": 0, "evidence": one.evidence}
            entry = found.setdefault((one.code, one.joint), new)
            entry["count"] += 1
            if one.recording and len(entry["recordings"]) < 8:
                entry["recordings"].append(one.recording)
    return list(found.values())


def sentence(entry: dict) -> str:
    """Format an entry on one line."""
    at = f" ({entry['joint']})" if entry["joint"] else ""
    more = f" (and {entry['count'] - 1} more)" if entry["count"] > 1 else ""
    return f"{entry['code']}{at}: {entry['evidence']}{more}"


def expect_codes(accept: Sequence[str], joints: Collection[str] | None = None) -> None:
    """Raise ConfigError for an unknown code or joint in CODE or CODE:joint; `joints` is None while it is not known."""
    for text in accept:
        code, colon, joint = text.partition(":")
        if code not in codes() and text != REJECTED:
            known = ", ".join([*codes(), REJECTED])
            raise ConfigError(f"accept = {text}: '{code}' is no code of a finding; codes are {known}")
        if colon and joints is not None and joint not in joints:
            raise ConfigError(f"accept = {text}: there is no joint '{joint}'; the joints are {', '.join(joints)}")


def is_accepted(finding: Finding, accept: Collection[str]) -> bool:
    """Whether the finding's code is accepted, for all joints or for its joint."""
    return finding.code in accept or f"{finding.code}:{finding.joint}" in accept


def expect_accepted(findings: Iterable[Finding], accept: Collection[str], where: str, refused: str, how: str) -> None:
    """Raise FaultyDataError if a fault of `where` is not accepted; the message lists all of them, says what is refused,
    and how to accept them."""
    faults = [one for one in findings if one.severity == "fault" and not is_accepted(one, accept)]
    if not faults:
        return
    count = len(by_code(faults))
    options = []  # limited to their joints where these are few
    for code, same in by_code(faults).items():
        joints = list(dict.fromkeys(finding.joint for finding in same))
        options += [f"{code}:{joint}" for joint in joints] if all(joints) and len(joints) <= 2 else [code]
    lines = [
        f"{where}: {count} fault{'' if count == 1 else 's'}, so {refused} are refused",
        *finding_lines(faults),
        f"  {how}",
        f"      --accept {' '.join(options)}",
    ]
    raise FaultyDataError("\n".join(lines), faults)


def refuse_faults(
    results: Mapping[str, Sequence[Finding]], where: str, accept: Sequence[str], report: Reporter
) -> dict:
    """Report warnings and accepted faults of each set of recordings; returns them for provenance, as plain JSON.

    Raises:
        FaultyDataError: a fault is not accepted; the message lists all of them, and where they are.
    """
    findings = [finding for result in results.values() for finding in result]
    how = "`tauext check --out DIR` draws them. To use them unchanged, accept the faults; the bundle records it:"
    expect_accepted(findings, accept, where, "these data", how)
    severities: dict[str, Severity] = {"accepted": "fault", "warning": "warning"}
    for word, severity in severities.items():
        for entry in entries(findings, severity):
            report.say(f"{word}: {sentence(entry)}")
    for code in dict.fromkeys(one.code for one in findings if one.severity == "fault"):
        left = [*EXPLAINED.get(code, ()), "contacts without a label"]
        report.say(f"not judged beside the accepted {code}: {', '.join(left)}")
    return {
        name: {"accepted": entries(result, "fault"), "warnings": entries(result, "warning")}
        for name, result in results.items()
    }


# --- All checks read a share of the training data; quick checks and the check for contacts read every sample.


@dataclass(frozen=True)
class ShareRules:
    """The share of the recordings that all checks read: order, axes, signs and scales show within half a minute."""

    moving_s: float = 180.0  # of all, the same share from the beginning of each recording
    recording_s: float = 20.0  # least of each recording: less is too little for a comparison with the others
    rows: int = 200  # least of each recording: with stamps in a wrong unit an hour may last seconds
    workers: int = 4  # recordings checked in parallel


SHARE = ShareRules()


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
    if missing := not_checked(recordings):
        report.say(missing)
    if robot is None:
        report.say(f"no robot model: {UNSEEN}")

    def find() -> list[Finding]:
        few = shares(recordings)
        tasks: list[Callable] = [partial(examine, few, robot)]
        tasks += [partial(quick_checks, one, limits_nm) for one in recordings]
        diagnosis, *quick = _in_parallel(tasks, threads, "check the data", report)
        general = diagnosis.findings
        if any(a is not b for a, b in zip(few, recordings, strict=True)):
            # a share cannot decide on a length, and on friction that changes
            general = [f for f in general if f.code not in ("too-short", "torque-changes") or f.severity == "fault"]
            if diagnosis.tree is not None and not diagnosis.spoiled and not any(f.severity == "fault" for f in general):
                general = [f for f in general if not is_unlabelled_contact(f)]
                general += unlabelled_contacts(recordings, diagnosis)
        fitted = ("effort-scale", "effort-motor-side") if finds_constants else ()
        return together([f for f in general if f.code not in fitted], quick)

    settings = [str(finds_constants), "none" if robot is None else file_digest(robot), _words(limits_nm)]
    return remembered(["training", *settings, *_mapped(digest_of, recordings, threads)], find)


def check_calibration(
    files: Sequence[Path], limits_nm: np.ndarray | None, threads: int, report: Reporter
) -> list[Finding]:
    """Faults and warnings in calibration recordings, by the quick checks; they are cached by content."""

    def checked(load: Callable[[], Recording]) -> list[Finding]:
        return quick_checks(load(), limits_nm)

    def find() -> list[Finding]:
        tasks = [partial(checked, load) for load in stretches(files)]
        return [f for found in _in_parallel(tasks, threads, "check the calibration recordings", report) for f in found]

    digests = _mapped(lambda file: f"{file.name} {file_digest(file)}", files, threads)
    digests += sorted({key for folder in {file.parent for file in files} if (key := labels_key(folder))})
    return remembered(["calibration", _words(limits_nm), *digests], find)


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
    """Cut each recording to its share of the motion that is checked; unchanged if they have less."""
    moving = [np.cumsum((np.abs(r.dq) > MOVING_RAD_S).any(axis=1)) / r.rate_hz for r in recordings]
    share = min(1.0, SHARE.moving_s / max(1e-9, sum(float(m[-1]) for m in moving)))
    if share == 1.0:
        return list(recordings)
    ends = [max(SHARE.rows, int(np.searchsorted(m, max(SHARE.recording_s, share * m[-1]))) + 1) for m in moving]
    return [r if end >= r.samples else cut(r, slice(0, end)) for r, end in zip(recordings, ends, strict=True)]


def together(general: Sequence[Finding], quick: Iterable[Sequence[Finding]]) -> list[Finding]:
    """Combine the findings of all checks with the quick checks' further faults, and their spikes, which a share of the
    recordings may miss. Other warnings of a single recording are dropped."""
    reported = {(f.code, f.joint, f.recording) for f in general}
    found = list(general)
    for one in (one for of_recording in quick for one in of_recording):
        same = {(one.code, joint, name) for joint in (one.joint, None) for name in (one.recording, None)}
        if (one.severity == "fault" or one.code == "spike") and not reported & same:
            found.append(one)
    return found


def _words(limits_nm: np.ndarray | None) -> str:
    return "unknown" if limits_nm is None else ", ".join(f"{limit:g}" for limit in limits_nm)


def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(threads or os.cpu_count() or 1, SHARE.workers))


def _mapped(change: Callable[[Any], str], of: Sequence[Any], threads: int) -> list[str]:
    with _pool(threads) as pool:
        return list(pool.map(change, of))


def _in_parallel(tasks: Sequence[Callable], threads: int, title: str, report: Reporter) -> list:
    """Run the tasks; results come in order, and the first error ends all tasks."""
    with report.progress(title) as show, _pool(threads) as pool:
        futures = [pool.submit(task) for task in tasks]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                show(done, len(futures), "checks")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]
