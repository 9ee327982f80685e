"""Messages that the DDS library cannot read: counted by topic, where it would print a line for each of them.

No status of a reader counts such a message; the library writes a line of it to its trace, which goes through a pipe and
is counted here, and the same line to stderr, always. A command line leaves it out there: `without_lines`.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

LINE = re.compile(r"deserialization rt(/.*)/[^/]*::dds_::\w+ failed")
END_S = 1.0
CONFIGURATION = "CYCLONEDDS_URI"
TRACING = (
    "<CycloneDDS><Domain><Tracing><Verbosity>warning</Verbosity><OutputFile>/dev/fd/{}</OutputFile>"
    "</Tracing></Domain></CycloneDDS>"
)


class Unreadable:
    """Counts for one domain, from its beginning in this process on."""

    _of_domain: dict[int, Unreadable] = {}
    _beginning = threading.Lock()

    def __init__(self, domain_id: int):
        self._counts: Counter[str] = Counter()
        self._domain: Domain | None = None
        if sys.platform == "linux":
            self._listen(domain_id)

    @classmethod
    def of(cls, domain_id: int) -> Unreadable:
        """To be called before the domain's first participant is made."""
        with cls._beginning:
            if domain_id not in cls._of_domain:
                cls._of_domain[domain_id] = cls(domain_id)
            return cls._of_domain[domain_id]

    def count(self, topic: str) -> int:
        """Messages of the topic, which begins with /, that could not be read so far."""
        return self._counts[topic]

    def _listen(self, domain_id: int) -> None:
        own = os.environ.get(CONFIGURATION, "")
        if "Tracing" in own:
            return  # somebody wants to see the library's words elsewhere
        reads, writes = os.pipe()
        try:
            self._domain = Domain(domain_id, ",".join(filter(None, (own, TRACING.format(writes)))))
        except (
            DDSException
        ):  # another part of this process began the domain, or CYCLONEDDS_URI is wrong: a node says so
            os.close(reads)
            return
        finally:
            os.close(writes)  # the library has opened it by its name
        threading.Thread(target=self._read, args=(reads,), name="dds words", daemon=True).start()

    def _read(self, reads: int) -> None:
        with open(reads, encoding="utf-8", errors="replace") as lines, suppress(OSError, ValueError):
            for line in lines:
                if found := LINE.search(line):
                    self._counts[found[1]] += 1


@contextmanager
def without_lines() -> Iterator[None]:
    """Leave the lines about such messages out of stderr, which passes through a pipe meanwhile; for a whole process.

    What Python itself prints goes straight to where stderr went before.
    """
    sys.stderr.flush()
    before, (reads, writes) = os.dup(2), os.pipe()
    os.dup2(writes, 2)
    os.close(writes)
    own, sys.stderr = sys.stderr, open(before, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    thread = threading.Thread(target=_pass_on, args=(reads, before), name="dds stderr", daemon=True)
    thread.start()
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stderr = own
        os.dup2(before, 2)  # the last end of the pipe, unless a process that was started still has it
        thread.join(END_S)


def _pass_on(reads: int, to: int) -> None:
    with open(reads, "rb") as lines, suppress(OSError, ValueError):
        for line in lines:
            if not LINE.search(line.decode("utf-8", "replace")):
                os.write(to, line)
