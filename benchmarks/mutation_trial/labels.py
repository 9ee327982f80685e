"""Wrong labels of contact: as the import takes them, by the interval, and as they stand in a recording."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext.data.importing import import_dataset
from tauext.data.recording import Recording

Spans = dict[str, list[list[float]]]
BEYOND_S = 1000.0


def broken_intervals(spans: Spans, file: str, what: str, size: float, rng: np.random.Generator) -> Spans:
    """[contact.intervals] with one thing wrong about this file's.

    Args:
        what: label-dropped, label-all-dropped, label-shifted by `size` s, label-other-file, label-beyond the end,
            label-milliseconds, label-misspelt.
    """
    new = {name: [list(span) for span in of] for name, of in spans.items()}
    others = [name for name in spans if name != file]
    if what == "label-dropped":
        del new[file][int(rng.integers(len(new[file])))]
    elif what == "label-all-dropped":
        del new[file]
    elif what == "label-shifted":
        new[file] = [[max(0.0, start + size), max(0.1, end + size)] for start, end in new[file]]
    elif what == "label-other-file":
        new[file] = new[others[0]] if others else []
    elif what == "label-beyond":
        new[file] = [[start + BEYOND_S, end + BEYOND_S] for start, end in new[file]]
    elif what == "label-milliseconds":
        new[file] = [[1e3 * start, 1e3 * end] for start, end in new[file]]
    else:
        assert what == "label-misspelt"
        new[file.replace("-", "_") if "-" in file else f"{file}s"] = new.pop(file)
    return {name: of for name, of in new.items() if of}


def broken_flags(recording: Recording, other: Recording, what: str, size: float, rng: np.random.Generator) -> Recording:
    """The same in a recording's own column; `other` is the recording whose labels it gets by mistake."""
    assert recording.contact is not None
    contact = recording.contact.copy()
    if what == "label-dropped":
        edges = np.flatnonzero(np.diff((contact == 1).astype(int), prepend=0, append=0))
        pick = 2 * int(rng.integers(len(edges) // 2))
        contact[edges[pick] : edges[pick + 1]] = 0
    elif what == "label-all-dropped":
        contact[:] = 0
    elif what == "label-shifted":
        rows = round(size * recording.rate_hz)
        contact = np.roll(contact, rows)
        contact[slice(rows) if rows >= 0 else slice(rows, None)] = 0
    else:
        assert what == "label-other-file" and other.contact is not None
        contact[:] = np.resize(other.contact, len(contact))
    return replace(recording, contact=contact, contact_link=None)


def imported(toml: Path, change: Callable[[Spans, list[str]], Spans], folder: Path) -> None:
    """Import the training sources of a description, its intervals changed, into this folder.

    Args:
        change: takes the intervals of all files, and the training sources.

    Raises:
        TauextError: the import refuses.
    """
    text = toml.read_text()
    content = tomllib.loads(text)
    sources = list(content["split"]["train"])
    spans = {name: of for name, of in content["contact"]["intervals"].items() if name in sources}
    lines = [f"{json.dumps(name)} = {json.dumps(of)}" for name, of in change(spans, sources).items()]
    text = re.sub(r"(?s)\[contact\.intervals\].*?(?=\n\[)", "\n".join(["[contact.intervals]", *lines, ""]), text)
    text = re.sub(r"(?s)\[split\].*", f"[split]\ntrain = {json.dumps(sources)}\n", text)
    arm = toml.with_name(f"{folder.parent.name}-{folder.name}.toml")  # the description's paths are relative to it
    arm.write_text(text)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        import_dataset([toml.with_name(name) for name in sources], arm, folder, "tauext", lambda line: None)
    finally:
        arm.unlink()
