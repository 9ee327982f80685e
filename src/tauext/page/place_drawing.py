"""Arrows where a touch is taken to be: the most probable place, and fainter ones at its rivals."""

from __future__ import annotations

import numpy as np
import viser

from tauext.page.arrow import NEWTON_M, Arrow
from tauext.page.places import SHOWN, Place, Placed

ESTIMATE = (10, 60, 200)
OPACITY: tuple[float | None, ...] = (None, 0.4, 0.2)
RADIUS_M = (0.009, 0.007, 0.007)
ABOVE_M = 0.05
"""Of the words over the arrow's end."""


class PlaceDrawing:
    """One arrow and one label a place; show() moves them."""

    def __init__(self, scene: viser.SceneApi, joints: tuple[str, ...], park: tuple[float, float, float]):
        self._joints = joints
        self._arrows = [
            Arrow(scene, f"/places/{k}", ESTIMATE, RADIUS_M[k], park, opacity=OPACITY[k]) for k in range(SHOWN)
        ]
        self._labels = [
            scene.add_label(f"/places/words{k}", " ", anchor="bottom-center", font_screen_scale=scale, visible=False)
            for k, scale in enumerate((1.1, 0.8, 0.8))
        ]
        self._words = [""] * SHOWN

    def show(self, placed: Placed | None) -> None:
        """Draw what explains the touch; None: nothing."""
        places = placed.places if placed is not None else ()
        for k, (arrow, label) in enumerate(zip(self._arrows, self._labels, strict=True)):
            words = ""
            if k < len(places):
                start, end = span(places[k])
                arrow.show(start, end)
                words = said(places[k], self._joints, first=k == 0)
                label.position = (start if places[k].pushes else end) + [0.0, 0.0, ABOVE_M]
            else:
                arrow.hide()
            if words != self._words[k]:
                label.text, label.visible, self._words[k] = words or " ", bool(words), words


def span(place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Where its arrow begins and ends: a push's head is at the point, a pull's tail; no arrow hides in the link."""
    way = NEWTON_M * place.force_n
    return (place.point_m - way, place.point_m) if place.pushes else (place.point_m, place.point_m + way)


def said(place: Place, joints: tuple[str, ...], first: bool) -> str:
    """`joint4: 34 N`, of a rival `joint5 12%`."""
    if not first:
        return f"{joints[place.joint]} {place.probability:.0%}"
    return f"{joints[place.joint]}: {float((place.force_n**2).sum()) ** 0.5:.0f} N"
