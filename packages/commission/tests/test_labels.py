"""Labels beside recordings: every answer, margins across files, epochs, damaged lines, full disks, keys of caches."""

from __future__ import annotations

import errno
import os
from dataclasses import asdict, replace

import numpy as np
import pytest
from made_commission import forge
from tauext_commission import journal, synced_file
from tauext_commission.history_file import KIND, read_labels
from tauext_commission.synced_file import RESERVE, RESERVED, reserve, write_synced

from tauext.check.before_training import check_calibration
from tauext.data.free_motion import free_pieces, free_samples
from tauext.data.labels import Label, labels_key, overlay
from tauext.data.recording import Recording
from tauext.data.recording_file import describe, load_recording, save_recording
from tauext.progress import SILENT

SECOND = 1_000_000_000
RATE_HZ = 100


def label(id: int, from_s: float, to_s: float, answer: str, epoch: int = 1) -> Label:
    return Label(id, epoch, round(from_s * SECOND), round(to_s * SECOND), answer, "test", "today")


def append_label(folder, label: Label) -> None:
    journal.append(folder, KIND, asdict(label))


def times(from_s: float, to_s: float) -> np.ndarray:
    return np.arange(round(from_s * RATE_HZ), round(to_s * RATE_HZ), dtype=np.int64) * (SECOND // RATE_HZ)


def segment(folder, from_s: float, to_s: float, epoch: int | None = 1, name: str = "seg-000001"):
    t_ns = times(from_s, to_s)
    signal = np.sin(1e-9 * t_ns)[:, None]
    facts = {} if epoch is None else {"epoch": epoch}
    made = Recording(name, ("j",), t_ns, signal, signal, signal, float(RATE_HZ), "held", "test", "", provenance=facts)
    save_recording(made, folder / f"{name}.parquet")
    return folder / f"{name}.parquet"


def spans(contact: np.ndarray, value: int) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.r_[False, contact == value, False]))
    return [tuple(pair) for pair in edges.reshape(-1, 2).tolist()]


@pytest.mark.parametrize(
    ("answer", "touched", "unknown"),
    [
        ("touched", [(200, 301)], [(180, 200), (301, 401)]),
        ("unanswered", [], [(180, 401)]),
        ("suspect", [], [(180, 331)]),
        ("nothing", [], []),
    ],
)
def test_each_answer(answer, touched, unknown):
    contact = overlay([label(1, 2.0, 3.0, answer)], 1, times(0, 10))
    assert spans(contact, 1) == touched and spans(contact, -1) == unknown
    assert (overlay([label(1, 2.0, 3.0, answer, epoch=2)], 1, times(0, 10)) == 0).all()


def test_a_person_s_answer_counts_more_than_a_suspicion_but_silence_counts_more_than_nothing():
    t_ns = times(0, 10)
    assert (overlay([label(1, 2, 3, "nothing"), label(-2, 2, 3, "suspect")], 1, t_ns) == 0).all()
    assert (overlay([label(1, 2, 3, "nothing"), label(2, 2, 3, "unanswered")], 1, t_ns)[200:300] == -1).all()
    both = overlay([label(1, 2, 3, "touched"), label(2, 2.5, 4, "unanswered")], 1, t_ns)
    assert (both[200:301] == 1).all() and (both[301:501] == -1).all()


def test_a_recording_within_one_unanswered_alarm_is_not_free(tmp_path):
    made = overlay([label(1, -5, 50, "unanswered")], 1, times(0, 10))
    assert (made == -1).all()
    assert not free_samples(replace(load_recording(segment(tmp_path, 0, 10)), contact=made)).any()


def test_margins_reach_into_the_next_file(tmp_path):
    first, second = segment(tmp_path, 0, 10), segment(tmp_path, 10, 20, name="seg-000002")
    append_label(tmp_path, label(1, 9.0, 9.95, "touched"))
    free = [free_samples(load_recording(path)) for path in (first, second)]
    assert not free[0][880:].any() and not free[1][:96].any() and free[1][96:].all()
    assert all(np.all((piece.t_ns < 8.8e9) | (piece.t_ns > 10.9e9)) for piece in free_pieces(
        [load_recording(first), load_recording(second)]))  # fmt: skip


def test_only_recordings_with_an_epoch_beside_labels_change(tmp_path):
    path, other = segment(tmp_path, 0, 10), segment(tmp_path, 0, 10, epoch=None, name="other")
    assert load_recording(path).contact is None and "contact" not in describe(path).signals
    append_label(tmp_path, label(1, 2, 3, "touched"))
    before = path.read_bytes()
    assert load_recording(path).contact.sum() == 101 - 120 and "contact" in describe(path).signals
    assert load_recording(path, ("temperature",)).contact is None
    assert load_recording(path, ("contact",), (250, 260)).contact.tolist() == [1] * 10
    assert load_recording(other).contact is None and path.read_bytes() == before


def test_the_last_label_of_an_id_counts_and_damaged_lines_do_not(tmp_path):
    append_label(tmp_path, label(1, 2, 3, "unanswered"))
    append_label(tmp_path, label(2, 4, 5, "suspect"))
    append_label(tmp_path, label(1, 2, 3, "touched"))
    append_label(tmp_path, label(2, 4, 5, "withdrawn"))
    append_label(tmp_path, label(1, 2, 3, "withdrawn"))  # an answer that came meanwhile stays
    assert [one.answer for one in read_labels(tmp_path)] == ["touched"]
    append_label(tmp_path, label(4, 6, 7, "nothing"))
    for damaged in ({"id": "x"}, asdict(label(1, 2, 3, "touched")) | {"answer": "maybe"}):
        with pytest.raises(OSError, match="the journal takes no such line: 'label': its "):
            journal.append(tmp_path, KIND, damaged)
        forge(tmp_path, KIND, damaged)
    assert [one.id for one in read_labels(tmp_path)] == [1, 4]


def test_a_full_disk_releases_the_reserve(tmp_path, monkeypatch):
    journal.append(tmp_path, "a", {"id": 1})
    reserve(tmp_path)
    assert (tmp_path / RESERVE).stat().st_size >= 1 << 20

    def full(one, rows, removed=(), real=journal._insert) -> None:
        pages = one.database.execute("PRAGMA page_count").fetchone()[0]
        one.database.execute(f"PRAGMA max_page_count = {pages if (tmp_path / RESERVE).exists() else 1 << 30}")
        real(one, rows, removed)

    monkeypatch.setattr(journal, "_insert", full)
    journal.append(tmp_path, "a", {"id": 2, "words": "x" * 9000})
    assert [one["id"] for one in journal.read(tmp_path).lines] == [1, 2]
    assert (tmp_path / RESERVE).stat().st_size == RESERVED  # what is left of it is reserved again


def test_a_full_disk_releases_the_reserve_for_a_small_file_and_a_partial_reserve_grows(tmp_path, monkeypatch):
    reserve(tmp_path)
    real = os.fsync

    def full(file: int) -> None:
        if (tmp_path / RESERVE).exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        real(file)

    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr(synced_file, "sync_folder", lambda path: None)
    write_synced(tmp_path / "facts.json", "{}")
    assert (tmp_path / "facts.json").read_text() == "{}"
    os.truncate(tmp_path / RESERVE, 5)
    reserve(tmp_path)
    assert (tmp_path / RESERVE).stat().st_size == RESERVED


def test_a_new_label_changes_the_keys_of_cached_results(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    append_label(tmp_path, label(9, 2, 3, "withdrawn"))
    path, seen = segment(tmp_path, 0, 30), []
    monkeypatch.setattr(
        "tauext.check.before_training.quick_checks", lambda one, limits: seen.append(one.contact.max()) or []
    )
    keys = [labels_key(tmp_path)]
    for _ in range(2):
        check_calibration([path], None, 1, SILENT)
    append_label(tmp_path, label(1, 2, 3, "touched"))
    check_calibration([path], None, 1, SILENT)
    keys.append(labels_key(tmp_path))
    append_label(tmp_path, replace(label(1, 2, 3, "withdrawn")))
    assert seen == [0, 1] and len(set(keys)) == 2 and labels_key(tmp_path / "cache") == ""
