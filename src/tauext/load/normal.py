"""The sums that everything about a load follows from: of fixed size, and a row at a time may be added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.load.rows import COLUMNS

BLOCK_ROWS = 100
"""A second: sums over so much show how long errors of tau_ext go on in one direction."""


@dataclass
class Normal:
    """Per joint: sum of z z^T / sigma^2, and the same of its sums over blocks, which tell the errors' correlation."""

    gram: np.ndarray  # (n, COLUMNS, COLUMNS)
    blocks: np.ndarray  # (n, COLUMNS, COLUMNS)
    worth: np.ndarray  # (n,): rows, each by what it is worth

    @classmethod
    def empty(cls, joints: int) -> Normal:
        return cls(np.zeros((joints, COLUMNS, COLUMNS)), np.zeros((joints, COLUMNS, COLUMNS)), np.zeros(joints))

    def add(self, z: np.ndarray, sigma: np.ndarray, worth: np.ndarray) -> None:
        """Rows that follow one another: z (rows, n, COLUMNS); sigma and worth (rows, n)."""
        for first in range(0, len(z), BLOCK_ROWS):
            rows = slice(first, first + BLOCK_ROWS)
            scaled = z[rows] / sigma[rows, :, None]
            self.gram += np.einsum("kja,kj,kjb->jab", scaled, worth[rows], scaled)
            block = np.einsum("kja,kj->ja", scaled, worth[rows])
            self.blocks += np.einsum("ja,jb->jab", block, block)
            self.worth += worth[rows].sum(axis=0)

    def __add__(self, other: Normal) -> Normal:
        return Normal(self.gram + other.gram, self.blocks + other.blocks, self.worth + other.worth)
