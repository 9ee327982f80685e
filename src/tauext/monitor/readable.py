"""Numbers in sentences: as many decimals as asked for, but never a line of digits."""

from __future__ import annotations

LONGEST = 1e6
"""From here on decimals tell nothing."""


def readable(value: float, spec: str) -> str:
    """The value by a format like .3f or +.2f; of four digits and a power of ten from LONGEST on."""
    if abs(value) < LONGEST or value != value:
        return format(value, spec)
    return format(value, ("+" if spec.startswith("+") else "") + ".4g")
