"""Pages without pictures, for tests of what else is on them: rendering is most of the time that a report takes."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


@contextmanager
def undrawn() -> Iterator[None]:
    """Figures are made as ever; the PNG of each is one pixel."""

    def print_pixel(self: FigureCanvasAgg, file: Path | BytesIO, **options: object) -> None:
        if isinstance(file, BytesIO):
            file.write(PIXEL)
        else:
            Path(file).write_bytes(PIXEL)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "print_png", print_pixel)
        yield
