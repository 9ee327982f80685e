"""The figure of noticed forces as a file of its own."""

from __future__ import annotations

from typing import Any

import matplotlib

from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.whole_file import whole_files
from tauext.report.drawing import save_png
from tauext.report.entry import Entry
from tauext.report.noticed_file import read_noticed
from tauext.report.noticed_force import draw_noticed_force
from tauext.report.style import RC


def write_noticed_picture(noticed: dict[str, Any], picture: Place) -> None:
    """Draw what stands in an entry `noticed_force`, as a PNG.

    Raises:
        ConfigError: it cannot be written.
    """
    with matplotlib.rc_context(RC):
        drawing = draw_noticed_force(read_noticed(Entry(str(picture), noticed)))
        try:
            picture.parent.mkdir(parents=True, exist_ok=True)
            with whole_files(picture) as (part,):
                save_png(drawing.figure, part)
        except OSError as error:
            raise ConfigError(f"{picture}: cannot be written ({error.strerror or error})") from error
