"""Recordings one after the other, however long: in stretches that fit into memory, the next one read meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

from tauext.data.recording import Recording
from tauext.data.recording_file import ROW_GROUP, describe, load_recording
from tauext.files.place import Place

HEADS_AT_A_TIME = 8
"""Heads of files that are read at a time: what a store takes is waiting."""
FOR_LIMITS = ("temperature", "contact")
"""All that limits and the cheap checks need beside t, q, dq and tau."""


def stretches(files: Sequence[Place], signals: Collection[str] | None = FOR_LIMITS) -> list[Callable[[], Recording]]:
    """Load the recordings in these files one by one; one of more than ROW_GROUP samples comes in equal parts.

    Each part is a recording of its own, NAME-00, NAME-01, ..., as an import cuts what is too long: the chain warms up
    in each. So the memory that is needed does not grow with the length of a recording.

    Args:
        signals: optional ones to read; None: all.

    Raises:
        RecordingError: a file cannot be read, or is none.
    """
    with ThreadPoolExecutor(HEADS_AT_A_TIME) as pool:
        samples = [head.samples for head in pool.map(describe, files)]
    loaders: list[Callable[[], Recording]] = []
    for file, count in zip(files, samples, strict=True):
        parts = max(1, -(-count // ROW_GROUP))
        if parts == 1:
            loaders.append(partial(load_recording, file, signals))
        else:
            ends = [count * k // parts for k in range(parts + 1)]
            rows = zip(ends, ends[1:], strict=False)
            loaders += [partial(load_stretch, file, signals, first, end, k) for k, (first, end) in enumerate(rows)]
    return loaders


def load_stretch(file: Place, signals: Collection[str] | None, first: int, end: int, number: int) -> Recording:
    """Samples first to end, end left out, as a recording NAME-number; its provenance says of what it is a part."""
    whole = load_recording(file, signals, (first, end))
    start_s = first / whole.rate_hz
    part = {"of": whole.name, "from_s": round(start_s, 6), "to_s": round(start_s + whole.duration_s, 6)}
    return replace(whole, name=f"{whole.name}-{number:02d}", provenance=whole.provenance | {"part": part})


def ahead(loaders: Sequence[Callable[[], Recording]]) -> Iterator[Recording]:
    """What they load, in their order; while one is used the next is read, and no more than that one."""
    if not loaders:
        return
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(loaders[0])
        for load in loaders[1:]:
            ready = coming.result()
            coming = pool.submit(load)
            yield ready
        yield coming.result()
