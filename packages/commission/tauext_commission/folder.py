"""The folder of one commissioned arm: names, facts, journal, recordings, bundles, log."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext.bundle.bundle_file import load_bundle
from tauext.config import AlarmConfig
from tauext.data.dataset import FILE_NAME as SPLIT
from tauext.data.dataset import Split
from tauext.data.labels import EPOCH, Label
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, stretch_of
from tauext.errors import ConfigError, TauextError
from tauext.files.plain_file import FORMAT, json_of, read_text
from tauext.files.preflight import expect_folder
from tauext.files.provenance import write_json
from tauext.fit.tail import FalseAlarmBudget
from tauext_commission import journal
from tauext_commission.budget import BUDGET, chosen_alarm
from tauext_commission.history_file import (
    BUNDLES,
    COVERAGE,
    FACTS,
    FINDINGS,
    NOTED,
    RESULTS,
    active_bundle,
    lost_lines,
    lost_words,
    noted_in,
    read_coverage,
    read_facts,
    read_history,
    read_labels,
    received_s,
    unusable_words,
)
from tauext_commission.history_file import KIND as LABEL
from tauext_commission.journal_lines import is_bundle_name, is_whole, why_unusable
from tauext_commission.synced_file import lock, reserve, set_aside, write_synced

# --- The index of recordings, from which split.json follows.


JOIN_S = 0.1
"""Longest gap between two recordings that are one motion, [s]."""


@dataclass(frozen=True)
class Segment:
    """One recording of the folder."""

    name: str
    """Name of its file."""
    number: int
    set: str
    """train, test or calibration; it never changes."""
    epoch: int
    from_ns: int
    to_ns: int
    seconds: float
    bytes: int

    @property
    def stem(self) -> str:
        return self.name.removesuffix(".parquet")


def up_to(segments: Sequence[Segment], seconds: float) -> list[Segment]:
    """The first of these recordings, until they last so long."""
    lasts = np.cumsum([one.seconds for one in segments])
    return list(segments[: int(np.searchsorted(lasts, seconds)) + 1])


def split_of(segments: Iterable[Segment]) -> Split:
    """The split of these recordings."""
    sets: dict[str, list[str]] = {"train": [], "test": [], "calibration": []}
    for one in segments:
        sets[one.set].append(one.name)
    return Split(tuple(sets["train"]), (), tuple(sets["test"]), calibration=tuple(sets["calibration"]))


# --- What the journal can do without.


def superfluous(
    contents: journal.Contents, segments: Callable[[], Iterable[Segment]]
) -> tuple[set[int], dict[str, Any]] | None:
    """Numbers of the lines that compact() leaves out, and the content of the line that names them; None: too few.

    Left out are lines of an alarm, a label or a file that a newer one replaces, and all lines of old alarms and
    suspects without an answer whose recordings are gone. An answer stays.
    """
    newest, out, answered = set[tuple[str, Any]](), set[int](), set[Any]()
    last: dict[Any, list[journal.Line]] = {}
    for one in reversed(contents.lines):
        kind = str(one.get("kind"))
        if kind not in ("event", LABEL, "file", journal.COMPACTED):
            continue
        id = one.get("name" if kind == "file" else "id")
        is_answer = kind == LABEL and one.get("answer") in ("touched", "nothing")
        if (kind, id) in newest and not (is_answer and id not in answered):
            out.add(int(one["number"]))
        elif kind in ("event", LABEL):
            last.setdefault(id, []).append(one)
        newest.add((kind, id))
        answered |= {id} if is_answer else set()
    counts = Counter[str]((contents.kinds.get(journal.COMPACTED) or [{}])[-1].get("unanswered", {}))
    old = [id for id in last if id not in answered][MOST_ALARMS:]
    spans = spans_of(segments() if old else ())
    for lines in (last[id] for id in old):
        if not any(is_near(spans, one) for one in lines):
            out.update(int(one["number"]) for one in lines)
            counts.update(str(one.get("bundle")) for one in lines if one.get("level") == "collision")
    if len(out) < max(LEAST_WORTH, len(contents.lines) // 10):
        return None
    return out, {"wall": wall(), "unanswered": dict(counts)}


LEAST_WORTH = 1000
"""Fewest lines that are worth it."""


def spans_of(segments: Iterable[Segment]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """First stamps and last stamps of the recordings of each epoch, in order, [ns]."""
    found: dict[int, list[tuple[int, int]]] = {}
    for one in segments:
        found.setdefault(one.epoch, []).append((one.from_ns, one.to_ns))
    arrays = {epoch: np.array(sorted(spans)) for epoch, spans in found.items()}
    return {epoch: (spans[:, 0], spans[:, 1]) for epoch, spans in arrays.items()}


def is_near(spans: Mapping[int, tuple[np.ndarray, np.ndarray]], label: Mapping[str, Any]) -> bool:
    """Whether a recording lies near the label or the alarm of this line."""
    begins, ends = spans.get(label.get("epoch", 0), (np.zeros(0), np.zeros(0)))
    from_ns = label.get("from_ns", label.get("t_ns", 0))
    at = int(np.searchsorted(begins, label.get("to_ns", label.get("held_ns", from_ns)) + NEAR_NS, side="right")) - 1
    return at >= 0 and bool(ends[at] >= from_ns - NEAR_NS)


# --- The folder.


LEAST_DISK = 1 << 26
"""Free space that a new folder needs, [bytes]."""
MOST_ALARMS = 5000
"""Alarms and suspects without an answer that the journal keeps, beside those whose recordings are there."""
COMPACT_LINES = 20_000
"""Lines that the journal grows by until it is compacted while the command runs."""
LONGEST_NUMBER = 12
"""Digits of a recording's number."""
LARGEST_LOG = 10_000_000
"""Size of log.txt from which it becomes log.old.txt, [bytes]."""
NEAR_NS = 30_000_000_000
"""Distance of a label within which a recording is dropped last, and without which its label is."""
LASTING = ("created", "source", "epoch", "first", "arm", "learn_from", "running")
"""Entries of commission.json that are lines of the journal, too."""
WRITTEN = (
    "split.json", "coverage.json", "coverage.npz", "findings.json", "trainer.json", "pending.json", "learned.json",
    "peaks.state", "carried.bin", "log.txt", "lock", "trainer.lock", ".facts.lock", ".reserve", ".trial.sock",
)  # fmt: skip
"""Files that are written again when they are missing or damaged."""


class CommissionFolder:
    """Paths and small files of one arm. Journal, facts and log may be written by each process; the recorder alone adds
    recordings, the trainer alone bundles."""

    def __init__(self, path: Path):
        self.path = path
        self.bundles, self.results, self.flights = path / BUNDLES, path / RESULTS, path / "flights"
        self.coverage_file, self.findings_file = path / COVERAGE, path / FINDINGS
        self.progress_file = path / "trainer.json"
        self.pending_file = path / "pending.json"
        """The bundle that waits to be judged, and what it was trained on."""
        self.shown = 0
        """Lines of the history when the folder was opened: later ones are news."""
        self.unwritable = ""
        """Why nothing can be written since the folder was opened; empty: it can."""
        self._compacted = 0
        """Lines of the journal when it was compacted."""
        self._known: dict[str, tuple[tuple[int, int], Segment | None]] = {}

    @classmethod
    def open(cls, path: Path, create: bool = False) -> CommissionFolder:
        """The folder of an arm.

        Args:
            create: make a new one where the path does not exist or is empty, and mend what is damaged. A folder with a
                whole bundle that cannot be written is opened as it is: see `unwritable`.

        Raises:
            ConfigError: it is no such folder, holds something else, is of another version, or cannot be written and has
                no whole bundle.
        """
        journal.read(path)  # refuses one of another version
        folder = cls(path)
        if not create:
            if not (path / FACTS).is_file():
                raise ConfigError(f"{path}: is no folder of `tauext commission`; it has no {FACTS}")
            read_facts(path)
            return folder
        is_lost = folder.is_lost()
        is_new = not is_lost and not os.path.lexists(path / FACTS) and not journal.is_journal(path)
        if is_new and path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ConfigError(f"{path}: is not empty and no folder of `tauext commission`; choose another --out")
        if not is_new and not is_lost and not journal.is_journal(path):
            read_facts(path)  # refuses a folder of an earlier version
        try:
            if is_lost:
                folder._begin_again()
            elif is_new:
                expect_folder(path, LEAST_DISK)
                path.mkdir(parents=True, exist_ok=True)
                folder.save(created=wall(), epoch=0)
            folder._mend()
        except OSError as error:
            folder.unwritable = f"{error.filename or path}: cannot be written ({error.strerror or error})"
            if is_new or is_lost or folder.fall_back() is None:
                raise ConfigError(folder.unwritable) from error
            folder.shown = len(folder.history())
        reserve(path)
        return folder

    def try_again(self) -> None:
        """Mend a folder that could not be written when it was opened; the folder is as usual on return.

        Raises:
            OSError: it still cannot be written.
        """
        self._mend()
        reserve(self.path)
        self.unwritable = ""

    def is_lost(self) -> bool:
        """Whether journal and commission.json are both gone or damaged, and a whole bundle is left."""
        with suppress(OSError, ValueError):
            content = json_of(read_text(self.path / FACTS))
            if isinstance(content, dict) and "format" in content:
                return False
        with suppress(OSError):
            if "facts" in journal.read(self.path).kinds:
                return False
        return any(is_bundle(path) for path in self.bundles.glob("b*.tauext"))

    def _begin_again(self) -> None:
        """Begin a journal that counts what it had as lost: a bundle monitors, and nothing is trained."""
        if os.path.lexists(self.path / FACTS):
            set_aside(self.path / FACTS)
        bundles, segments = list(self.bundles.glob("b*.tauext")), self.segments()
        epochs = {one.epoch for one in segments} | {one.epoch for one in self.labels()}
        lines = max(self.noted(), 2 * len(bundles) + len(epochs))  # a bundle had two lines, and an epoch one
        content = {"created": wall(), "epoch": max(epochs, default=0), "first": self.next_number()}
        journal.append(self.path, "facts", content, 0 if journal.read(self.path).lines else lines)
        self.save()
        self.report(f"{FACTS}, the journal and its backup were missing or damaged")

    def _mend(self) -> None:
        """Refill the journal, and set aside what lies in the place of the folder's other files."""
        words = journal.mend(self.path)
        self.shown = len(self.history())
        if words:
            self.report(words)
        files, folders = [self.path / name for name in WRITTEN], [self.bundles, self.results, self.flights]
        for path in (*files, *folders):
            if os.path.lexists(path) and not (path.is_dir() if path in folders else is_usable(path)):
                self.set_aside(path, "it is no folder" if path in folders else "it is no file, or cannot be written")
        for one in folders:
            one.mkdir(exist_ok=True)
        _ = self.facts  # written again where it is damaged
        self.compact()

    def set_aside(self, path: Path, why: str) -> None:
        """Rename a damaged file, and report it."""
        self.report(f"{path.name} is kept as {set_aside(path).name}: {self._inside(why)}")

    def _inside(self, words: str) -> str:
        """Words in one line, without the path of the folder."""
        return " ".join(words.replace(f"{self.bundles}{os.sep}", "").replace(f"{self.path}{os.sep}", "").split())

    def report(self, words: str) -> None:
        """Add a note about what was mended to the history, from which the command prints it."""
        with suppress(OSError):  # a full disk
            self.note("note", self.seconds(), words)

    def progress(self, doing: str) -> None:
        """Show what the training process does; empty: nothing."""
        with suppress(OSError):
            write_json({"doing": doing}, self.progress_file)

    @contextmanager
    def locked(self, name: str = "lock") -> Iterator[None]:
        """Hold the folder for one process; the system releases it when the process ends.

        Raises:
            ConfigError: another process holds it.
        """
        import fcntl

        with ExitStack() as stack:
            try:
                file = stack.enter_context((self.path / name).open("r" if self.unwritable else "a"))
            except OSError:
                if not self.unwritable:
                    raise
                file = None  # no process can write, so that there is nothing to hold
            try:
                if file is not None:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise ConfigError(f"{self.path}: another `tauext commission` uses this folder") from error
            yield

    # Facts.

    @property
    def facts(self) -> dict[str, Any]:
        """Content of commission.json; the journal counts where the two differ, and replaces a damaged file.

        Raises:
            ConfigError: both are damaged, or the file has another format.
        """
        content, damage = self._facts()
        if damage is not None and not self.unwritable:
            self.save()
            self.report(f"{FACTS} was missing or damaged, and is written again")
        return content

    def _facts(self) -> tuple[dict[str, Any], ConfigError | None]:
        lasting: dict[str, Any] = {}
        for one in journal.read(self.path).kinds.get("facts", ()):
            lasting |= {key: one[key] for key in LASTING if key in one}
        try:
            content = read_facts(self.path)
            odd = [key for key in LASTING if key in content and why_unusable({"kind": "facts", key: content[key]})]
            return {key: value for key, value in content.items() if key not in odd} | lasting, None
        except ConfigError as error:
            with suppress(OSError, ValueError, AttributeError):
                if json_of(read_text(self.path / FACTS)).get("format", FORMAT) != FORMAT:
                    raise
            if not lasting:
                raise
            return {"format": FORMAT} | lasting, error

    def save(self, **changes: Any) -> None:
        """Change entries of commission.json; the new content is on the disk on return."""
        before: dict[str, Any] = {"format": FORMAT}
        with suppress(ConfigError):
            before = self._facts()[0]
        if new := {key: value for key, value in changes.items() if key in LASTING and before.get(key) != value}:
            self._append("facts", new)
        with (self.path / ".facts.lock").open("a") as file:
            lock(file.fileno())
            with suppress(ConfigError):
                before = self._facts()[0]
            newest = {NOTED: max(journal.read(self.path).last, noted_in(before))}
            write_synced(self.path / FACTS, json.dumps(before | changes | newest, indent=1, allow_nan=False) + "\n")

    # The journal.

    def _append(self, kind: str, content: dict[str, Any]) -> None:
        """Add a line to the journal; it is on the disk on return."""
        if words := journal.append(self.path, kind, content, self.noted()):
            self.report(words)

    def append_event(self, event: dict[str, Any]) -> None:
        """Keep the facts of an alarm; its answer is its label's."""
        self._append("event", {key: value for key, value in event.items() if key not in ("answer", "by")})

    def append_label(self, label: Label) -> None:
        """Keep a label; it is on the disk on return, an answer in the backup, too."""
        self._append(LABEL, asdict(label))
        if label.is_answered:
            self._back_up()

    def append_reply(self, answer: str, by: str) -> None:
        """Keep the answer to the question about a change of the arm."""
        self._append("reply", {"answer": answer, "by": by, "wall": wall()})
        self._back_up()

    def choose(self, alarm: AlarmConfig, by: str) -> None:
        """Keep another budget of false alarms: the training process changes the limits of the bundle in charge."""
        if (now := chosen_alarm(self.path)) == alarm:
            return
        words = [str(FalseAlarmBudget(one.false_alarms, one.in_hours)) for one in (alarm, now)]
        budget = {"false_alarms": alarm.false_alarms, "in_hours": alarm.in_hours, "by": by}
        text = f"target false alarm rate {words[0]}, chosen by {by}; before: {words[1]}"
        self.note(BUDGET, self.seconds(), text, **budget)
        self._back_up()

    def _back_up(self) -> None:
        with suppress(OSError):  # sync() tries again
            journal.mend(self.path)

    def labels(self) -> tuple[Label, ...]:
        """The newest label of each id."""
        return read_labels(self.path)

    def lost(self) -> int:
        """Number of lines of the journal that are lost, until a person accepts it with `--repair`."""
        return lost_lines(self.path, self.noted())

    def noted(self) -> int:
        """Number of a recent line of the journal: it shows whether the journal's end is lost."""
        content: dict[str, Any] = {}
        with suppress(ConfigError):
            content = read_facts(self.path)
        return max(noted_in(content), noted_in(self.coverage()))

    def sync(self) -> None:
        """Note in commission.json how long the journal is, and mend it if another program has changed it."""
        if journal.read(self.path).last > noted_in(self.facts):
            self.save()
        if words := journal.mend(self.path):
            self.report(words)
        if len(journal.read(self.path).lines) > self._compacted + COMPACT_LINES:
            self.compact()

    def close(self) -> None:
        """Renew the journal's backup, and close the journal; a full disk leaves it as it is."""
        if not self.unwritable:
            self._back_up()
        journal.close(self.path)

    def compact(self) -> None:
        """Leave out lines of the journal that nothing needs, and begin a new log where it is large; a full disk waits.

        Nothing is left out while lines are lost: their numbers are still to be accepted.
        """
        before = len(journal.read(self.path).lines)
        with suppress(OSError):
            if not self.lost():
                journal.compact(self.path, lambda contents: superfluous(contents, self.segments))
        self._compacted = len(journal.read(self.path).lines)
        if self._compacted < before:
            self.log(
                f"journal: {before - self._compacted} lines that newer ones replace, or of old alarms, are left out"
            )
        with suppress(OSError):
            if (log := self.path / "log.txt").stat().st_size > LARGEST_LOG:
                log.replace(self.path / "log.old.txt")

    def repair(self) -> list[str]:
        """Accept the loss of lines of the journal: training begins again with the next recording; what was done."""
        gaps = journal.read(self.path).lost(self.noted())
        if gaps:
            lost = lost_words(sum(b - a + 1 for a, b in gaps), unusable_words(self.path))
            words = f"{lost}; a person accepts it, and training begins again"
            self.save(learn_from=self.next_number())
            self.note(journal.REPAIR, self.seconds(), f"{words} with the next recording", lost=gaps)
            self._append("facts", {key: value for key, value in self.facts.items() if key in LASTING})
        return [str(one["words"]) for one in self.history()[self.shown :]]

    def keep_files(self, *names: str) -> None:
        """Keep the text of small files in the journal, for restore()."""
        for name in names:
            with suppress(FileNotFoundError, ValueError):  # ValueError: no UTF-8
                self._append("file", {"name": name, "text": read_text(self.path / name)})

    def restore(self, check: dict[str, Callable[[Path], object]]) -> None:
        """Write files that are missing, or whose check raises TauextError, again as they were."""
        kept = {one["name"]: one["text"] for one in journal.read(self.path).kinds.get("file", ())}
        for name, text in kept.items():
            if name not in check:
                continue
            path, why = self.path / name, "it was missing"
            try:
                if path.is_file() and check[name](path) is not None:
                    continue
            except (OSError, TauextError) as error:
                why = str(error)
            try:
                if os.path.lexists(path):
                    set_aside(path)
                write_synced(path, text)
            except OSError:
                if not self.unwritable:
                    raise
                continue
            self.report(f"{name} is written again: {self._inside(why)}")

    # Recordings.

    def segments(self) -> list[Segment]:
        """Recordings that can be read, in order of their numbers; the footer of each file is read once."""
        known: dict[str, tuple[tuple[int, int], Segment | None]] = {}
        with os.scandir(self.path) as files:
            for one in files:
                if one.name.startswith("seg-") and one.name.endswith(".parquet"):
                    with suppress(FileNotFoundError):
                        status = one.stat()
                        stamp = (status.st_size, status.st_mtime_ns)
                        known[one.name] = self._known.get(one.name, ((0, 0), None))
                        if known[one.name][0] != stamp:
                            known[one.name] = (stamp, segment_of(self.path / one.name, status.st_size))
        self._known = known
        return sorted((one for _, one in known.values() if one is not None), key=lambda one: one.number)

    def put_split(self, segments: Iterable[Segment]) -> None:
        """Write split.json of the arm as it is, so that the folder is a dataset."""
        begin = int(self.facts.get("learn_from") or 0)
        content = {"format": FORMAT} | asdict(split_of(one for one in segments if one.number >= begin))
        write_synced(self.path / SPLIT, json.dumps(content, indent=1) + "\n")

    def next_number(self) -> int:
        """Number of the next recording, which no earlier one had."""
        named = (name.partition(".")[0][4:] for name in os.listdir(self.path) if name.startswith("seg-"))
        numbers = [int(number) for number in named if number.isdecimal() and len(number) <= LONGEST_NUMBER]
        with suppress(ConfigError):
            numbers.append(int(self._facts()[0].get("first") or 1) - 1)
        return 1 + max(numbers, default=0)

    def load(self, segments: Iterable[Segment]) -> list[Recording]:
        """Recordings with their labels, those that follow each other at once joined; one that was dropped meanwhile is
        left out, and a damaged one is set aside."""
        runs: list[list[Recording]] = []
        last: Segment | None = None
        for one in segments:
            try:
                recording = load_recording(self.path / one.name)
            except TauextError as error:
                if os.path.lexists(self.path / one.name):
                    self.set_aside(self.path / one.name, str(error))
                continue
            if last is not None and one.epoch == last.epoch and 0 < one.from_ns - last.to_ns < JOIN_S * 1e9:
                runs[-1].append(recording)
            else:
                runs.append([recording])
            last = one
        return [joined(run) for run in runs]

    # Bundles, history, log.

    def active(self) -> Path | None:
        """File of the bundle in charge; None: none yet, or it is missing."""
        found = active_bundle(self.path)
        return None if found is None else Path(str(found))

    def activate(self, bundle: str, why: str, seconds: float, **facts: Any) -> None:
        """Put a bundle in charge: the loop takes it over. A later line of the same name is another activation."""
        old = journal.read(self.path).kinds.get("activation")
        replaced = old[-1].get("bundle") if old else None
        words = f"{bundle} is chosen: {why}"
        self.note("activation", seconds, words, bundle=bundle, replaces=replaced, why=why, **facts)

    @property
    def activation(self) -> int:
        """Number of the newest activation; 0: there was none."""
        begun = journal.read(self.path).kinds.get("activation")
        return int(begun[-1]["number"]) if begun else 0

    def fall_back(self) -> Path | None:
        """The bundle in charge if it is whole; else the newest whole one of this arm, which is put in charge."""
        history, arm, why = self.history(), self.facts.get("arm") or {}, ""
        begun = [str(one["bundle"]) for one in reversed(history) if one["kind"] == "activation"]
        if not begun and not self.lost():
            return None
        unfit = {str(one.get("bundle")) for one in history if one.get("passed") is False}
        with suppress(OSError, ValueError, AttributeError):
            unfit.add(str(json_of(read_text(self.pending_file)).get("bundle")))
        others = {path.stem for path in self.bundles.glob("b*.tauext") if is_bundle_name(path.stem)} - unfit
        for name in dict.fromkeys((*begun, *sorted(others, reverse=True))):
            path = self.bundles / f"{name}.tauext"
            try:
                bundle = load_bundle(path)
                if [one.joint_name for one in bundle.links] != arm.get("joints") and arm:
                    raise ConfigError(f"{path}: it is of an arm with other joints")
                if bundle.observer.sample_period_ns != arm.get("period_ns") and arm:
                    raise ConfigError(f"{path}: it is of an arm with another rate")
            except TauextError as error:
                why = why or str(error)
                continue
            if [name] != begun[:1] and not self.unwritable:
                self.activate(name, self._inside(why or "it is the newest whole bundle"), self.seconds())
            return path
        return None

    def next_bundle(self) -> Path:
        """File of the next bundle."""
        numbers = [int(path.stem[1:]) for path in self.bundles.glob("b*.tauext") if is_bundle_name(path.stem)]
        numbers += [int(one["bundle"][1:]) for one in self.history() if is_bundle_name(one.get("bundle"))]
        return self.bundles / f"b{max(numbers, default=0) + 1:04d}.tauext"

    def history(self) -> list[dict[str, Any]]:
        """See read_history."""
        return read_history(self.path)

    def note(self, kind: str, seconds: float, words: str, **facts: Any) -> None:
        """Add a line to the history.

        Args:
            seconds: received samples up to then, [s].
            words: one sentence for a person.
        """
        self._append(kind, {"wall": wall(), "seconds": round(seconds, 3), "words": words} | facts)
        self.log(words)

    def log(self, text: str) -> None:
        """Add a line to log.txt; a full disk loses it."""
        with suppress(OSError), (self.path / "log.txt").open("a", encoding="utf-8") as file:
            file.write(f"{wall()} {text}\n")

    def seconds(self) -> float:
        """Samples received so far, [s]: the clock of all decisions."""
        return received_s(self.path)

    def coverage(self) -> dict[str, Any]:
        """Content of coverage.json; empty before the first recording."""
        return read_coverage(self.path)


def segment_of(path: Path, size: int) -> Segment | None:
    """The facts in the footer of a recording; None: it cannot be read, or is none of the recorder."""
    try:
        head, from_ns, to_ns = stretch_of(path)
        about, seconds = head.provenance, head.samples / head.rate_hz
        if not is_whole(about[EPOCH], least=0) or about["set"] not in ("train", "test", "calibration"):
            return None
        return Segment(path.name, int(about["seq"]), about["set"], about[EPOCH], from_ns, to_ns, seconds, size)
    except (TauextError, KeyError, TypeError, ValueError):
        return None


def is_bundle(path: Path) -> bool:
    """Whether it is a whole bundle."""
    try:
        load_bundle(path)
    except TauextError:
        return False
    return True


def is_usable(path: Path) -> bool:
    """Whether it is a file that this process can read and write."""
    return path.is_file() and os.access(path, os.R_OK | os.W_OK)


def joined(recordings: list[Recording]) -> Recording:
    """Recordings that follow each other at once as one, under the first one's name."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    arrays: dict[str, Any] = {}
    for name in ("t_ns", "q", "dq", "tau", "temperature", "q_des", "current", "duty", "voltage", "contact"):
        parts = [getattr(one, name) for one in recordings]
        if all(part is not None for part in parts):
            arrays[name] = np.concatenate(parts)
    facts = {name: getattr(first, name) for name in ("joints", "rate_hz", "torque_timing", "source", "robot_sha256")}
    return Recording(name=first.name, provenance=first.provenance, **facts, **arrays)


def wall() -> str:
    """Date and time as every file of the folder states them, UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
