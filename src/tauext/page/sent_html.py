"""HTML beside the scene."""

from __future__ import annotations

import viser


class Html:
    """A piece of HTML that is sent only where it changed."""

    def __init__(self, gui: viser.GuiApi):
        self._handle, self._content = gui.add_html(""), ""

    def show(self, content: str) -> None:
        if content != self._content:
            self._handle.content = self._content = content
