"""The weight beside the scene: how heavy, whether the monitor is told, and what the arm's own joints say of it."""

from __future__ import annotations

import html
from collections.abc import Callable

import viser

from tauext.page.hand import LEAST_KG, MOST_KG, Held
from tauext.page.sent_html import Html
from tauext.page.snapshot import Snapshot

TAKE, GIVE = "Take it out", "Put it into the hand"


class HandPanel:
    """Controls of the weight; what one browser chooses holds for all."""

    def __init__(self, gui: viser.GuiApi, send: Callable[..., None]):
        self._held = False
        with gui.add_folder("Weight in the hand"):
            self._mass = gui.add_slider("mass, kg", LEAST_KG, MOST_KG, 0.1, 2.0)
            self._tell = gui.add_checkbox("tell the monitor", False, hint="Monitor.set_load, also of one that is held")
            self._button = gui.add_button(GIVE)
            self._words = Html(gui)
            self._move_on = gui.add_button("Move on 5 s", visible=False, hint="so that it shows at other poses too")
        self._button.on_click(lambda _: self._press(send))
        self._move_on.on_click(lambda _: send("move_on"))
        self._tell.on_update(lambda _: send("tell", self._tell.value) if self._held else None)

    def _press(self, send: Callable[..., None]) -> None:
        if self._held:
            send("let_go")
        else:
            send("hold", self._mass.value, self._tell.value)

    def show(self, snapshot: Snapshot, weighed: str) -> None:
        """Say what is in the hand, who knows, and what was weighed."""
        held = snapshot.held
        if self._held != (held is not None):
            self._held = held is not None
            self._button.label = TAKE if self._held else GIVE
            self._mass.disabled = self._move_on.visible = self._held
        self._words.show("" if held is None else hand_text(held, weighed, snapshot.doing == "moving"))


def hand_text(held: Held, weighed: str, moves: bool) -> str:
    """What is said of the weight in the hand."""
    if held.knows:
        told = f"The monitor knows of {held.mass_kg:.1f} kg: they are no external torque."
    elif held.refused:
        told = f"The monitor could not be told: {held.refused}."
    else:
        told = "The monitor was not told: the weight is an external torque to it."
    lines = [told, weighed + ("" if moves or not weighed else " The arm stands.")]
    body = "".join(f"<div style='padding-top:3px'>{html.escape(line)}</div>" for line in lines if line)
    return f"<div style='margin:0 12px 8px;font-size:12.5px;overflow-wrap:anywhere'>{body}</div>"
