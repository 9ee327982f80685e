"""Findings that are remembered by the content of what was looked at, so that nobody looks at the same data twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import cache
from pathlib import Path

from tauext.check.finding import Finding
from tauext.data.recording import Recording
from tauext.files.caching import cache_folder
from tauext.files.place import Place, is_stored
from tauext.files.provenance import VERSION
from tauext.files.reading import version_of
from tauext.files.whole_file import whole_file

FORMAT = 1


def remembered(parts: Iterable[str], find: Callable[[], list[Finding]]) -> list[Finding]:
    """What was found when something with these parts was last looked at, else what is found now.

    A file that is damaged is none. A cache that cannot be written is no error: next time somebody looks again.

    Args:
        parts: all that the findings depend on but for the doctor, as digests or words.
    """
    text = json.dumps([FORMAT, VERSION, looking_version(), *parts])
    path = folder() / f"{hashlib.sha256(text.encode()).hexdigest()}.json"
    try:
        return [Finding(**entry) for entry in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError, AssertionError):
        pass
    found = find()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            part.write_text(json.dumps([asdict(finding) for finding in found]) + "\n")
    except OSError:
        pass
    return found


def folder() -> Path:
    """Where findings are remembered: $XDG_CACHE_HOME/tauext/looks, or ~/.cache/tauext/looks."""
    return cache_folder() / "looks"


@cache
def looking_version() -> str:
    """Digest of the code that looks: another doctor may find other things."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def digest_of(recording: Recording) -> str:
    """Of all that the doctor reads of a recording."""
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
