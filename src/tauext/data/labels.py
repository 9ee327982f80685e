"""Labels of touches beside recordings, and how they become `contact` of recordings."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tauext import plugins
from tauext.config import FreeMotionConfig

if TYPE_CHECKING:
    import numpy as np

LabelAnswer = Literal["touched", "nothing", "unanswered", "suspect", "withdrawn"]
MARGINS = FreeMotionConfig()
SUSPECT_MARGINS = FreeMotionConfig(after_s=0.3)
"""Margins of a suspect: its end follows from the errors themselves, so filters alone need time."""
EPOCH = "epoch"
"""Key of a recording's provenance: number of its clock, which changes whenever the source's stamps go back."""


@dataclass(frozen=True)
class Label:
    """One interval of motion and what a person, or nobody, answered about it."""

    id: int
    """Number of the alarm; negative: the interval belongs to no alarm. A later label of one id replaces the earlier."""
    epoch: int
    from_ns: int
    """First stamp, by the source's clock in this epoch, [ns]."""
    to_ns: int
    """Last stamp, [ns]."""
    answer: LabelAnswer
    """touched, nothing: a person's answer. unanswered: an alarm without an answer. suspect: a touch that nobody
    reported, found by a bundle. withdrawn: no label any more; a person's answer stays."""
    by: str
    """Origin of the answer: page, stdin, trainer."""
    wall: str
    """Date and time, for people."""
    bundle: str = ""
    """Bundle that raised the alarm or found the touch."""

    @property
    def is_answered(self) -> bool:
        """Whether a person has answered."""
        return self.answer in ("touched", "nothing")

    def answered(self, by: Label) -> Label:
        """This alarm's label with the answer of another one."""
        return replace(self, answer=by.answer, by=by.by, wall=by.wall)


def has_labels(folder: Path) -> bool:
    """Whether labels lie beside the folder's recordings."""
    return any((folder / name).is_file() for name in plugins.LABELLED)


def read_labels(folder: Path, to_train: bool = False) -> tuple[Label, ...]:
    """The newest label of each id beside the folder's recordings, from the package that keeps them.

    Args:
        to_train: whether a model is trained on the recordings: labels must be complete.

    Raises:
        ConfigError: the package is not installed, or labels are lost.
    """
    is_kept = has_labels(folder) or (to_train and any((folder / mark).is_file() for mark in plugins.MARKS))
    return _reader()(folder, to_train) if is_kept else ()


@cache
def _reader() -> Callable[[Path, bool], tuple[Label, ...]]:
    return plugins.part("touch-labels")


def labels_key(folder: Path) -> str:
    """Digest of the labels that count, for keys of cached results; empty in a folder without labels."""
    labels = read_labels(folder)
    return hashlib.sha256(repr(sorted(labels, key=lambda one: one.id)).encode()).hexdigest() if labels else ""


def overlay(labels: Iterable[Label], epoch: int, t_ns: np.ndarray, contact: np.ndarray | None = None) -> np.ndarray:
    """`contact` of these samples, (samples,) int8: 1 touched, 0 free, -1 unknown.

    A touch has the margins of training around it, as unknown: it may lie in the next recording. Alarms without an
    answer are unknown with the same margins, suspects with SUSPECT_MARGINS. Where labels overlap, `touched` counts
    first, then `unanswered`, `nothing`, `suspect`.

    Args:
        contact: of the recording itself; None: free throughout.
    """
    import numpy as np  # here alone: `show` reads labels without it

    out = np.zeros(len(t_ns), dtype=np.int8) if contact is None else np.array(contact, dtype=np.int8)
    order = ("suspect", "nothing", "unanswered", "touched")
    for label in sorted((one for one in labels if one.epoch == epoch), key=lambda one: order.index(one.answer)):
        margins = SUSPECT_MARGINS if label.answer == "suspect" else MARGINS
        before, after = round(margins.before_s * 1e9), round(margins.after_s * 1e9)
        around = slice(*np.searchsorted(t_ns, [label.from_ns - before, label.to_ns + after + 1]))
        if label.answer == "nothing":
            out[around] = 0
            continue
        out[around] = np.where(out[around] == 1, 1, -1)
        if label.answer == "touched":
            out[slice(*np.searchsorted(t_ns, [label.from_ns, label.to_ns + 1]))] = 1
    out.flags.writeable = False
    return out


def epoch_of(provenance: Mapping[str, Any]) -> int | None:
    """Epoch of a recording of `tauext commission`; None: another recording, which labels do not concern."""
    epoch = provenance.get(EPOCH)
    return epoch if isinstance(epoch, int) else None
