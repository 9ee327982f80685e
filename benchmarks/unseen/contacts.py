"""What touches the arm: impacts, pushes and holds at places drawn by chance, and labels as a person or a skin sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LABEL_ERROR_S = 0.03
SHARES = {"impact": 0.45, "push": 0.35, "hold": 0.2}
RANGES = {"impact": ((20, 150), (0.02, 0.1)), "push": ((10, 60), (0.5, 1.0)), "hold": ((10, 40), (2.0, 4.0))}
"""Peak force [N] and duration [s]."""


@dataclass(frozen=True)
class Contact:
    """One force on one link."""

    kind: str
    start_s: float
    end_s: float
    link: int
    share: float
    """Of the way from the link's joint to the next."""
    direction: tuple[float, float, float]
    """In the world; an impact on a moving link acts against its motion instead."""
    peak_n: float
    label_s: tuple[float, float]
    at_m: tuple[float, float, float] | None = None
    """Where on its link, in the link's axes; None: beside the line to the next joint, by `share`."""
    in_link: bool = False
    """The direction is along the link's axes as the touch begins, and then stays in the world."""

    def force_n(self, t_s: float) -> float:
        """A half sine of an impact; a push rises and falls over 0.15 s, a hold over 0.3 s."""
        if not self.start_s <= t_s < self.end_s:
            return 0.0
        if self.kind == "impact":
            return self.peak_n * float(np.sin(np.pi * (t_s - self.start_s) / (self.end_s - self.start_s)))
        rise = 0.15 if self.kind == "push" else 0.3
        return self.peak_n * min(1.0, (t_s - self.start_s) / rise, (self.end_s - t_s) / rise)


def draw_contacts(count: int, length_s: float, links: int, rng: np.random.Generator) -> list[Contact]:
    """So many contacts in order of time, about evenly over the recording, never two at once; the first after 8 s.

    The first link is spared: its joint alone would feel it, and most forces on it turn nothing.
    """
    slot = (length_s - 8.0) / max(1, count)
    contacts = []
    for k in range(count):
        kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        (least_n, most_n), (least_s, most_s) = RANGES[kind]
        seconds = rng.uniform(least_s, most_s)
        start = 8.0 + k * slot + rng.uniform(0.05, max(0.1, slot - seconds - 1.5))
        direction = rng.standard_normal(3)
        contacts.append(
            Contact(
                kind=kind,
                start_s=start,
                end_s=start + seconds,
                link=int(rng.integers(1, links)),
                share=rng.uniform(0.2, 1.0),
                direction=tuple(direction / np.linalg.norm(direction)),
                peak_n=float(rng.uniform(least_n, most_n)),
                label_s=(
                    start + rng.uniform(-LABEL_ERROR_S, LABEL_ERROR_S),
                    start + seconds + rng.uniform(-LABEL_ERROR_S, LABEL_ERROR_S),
                ),
            )
        )
    return contacts


def label(contacts: Sequence[Contact], time_s: np.ndarray) -> np.ndarray:
    """1 where a label stands, else 0, (samples,); a short impact whose labels cross is labelled for 30 ms."""
    marked = np.zeros(len(time_s), dtype=np.int8)
    for contact in contacts:
        begin, end = contact.label_s
        marked[(time_s >= begin) & (time_s <= max(end, begin + LABEL_ERROR_S))] = 1
    return marked
