"""Everything beside the scene: the verdict in words, the choices, and the torque of every joint over time."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping

import numpy as np
import viser

from tauext.page.bundles import ERRORS
from tauext.page.snapshot import LEAST_KG, MOST_KG, Event, Held, Snapshot, Verdict, place_words
from tauext.sim.arms import ARMS, DemoArm

# --- HTML beside the scene.


class Html:
    """A piece of HTML that is sent only where it changed."""

    def __init__(self, gui: viser.GuiApi):
        self._handle, self._content = gui.add_html(""), ""

    def show(self, content: str) -> None:
        if content != self._content:
            self._handle.content = self._content = content


# --- The weight beside the scene: its mass, whether it is set in the monitor, and the mass that the arm's joints show.


TAKE, GIVE = "Take it out", "Put it into the hand"


class HandPanel:
    """Controls of the weight; what one browser chooses holds for all."""

    def __init__(self, gui: viser.GuiApi, send: Callable[..., None]):
        self._held = False
        with gui.add_folder("Weight in the hand"):
            self._mass = gui.add_slider("mass, kg", LEAST_KG, MOST_KG, 0.1, 2.0)
            self._set_load = gui.add_checkbox("set it in the monitor", False, hint="Monitor.set_load, also while held")
            self._button = gui.add_button(GIVE)
            self._words = Html(gui)
            self._move_on = gui.add_button("Move on 5 s", visible=False, hint="so that it shows at other poses too")
        self._button.on_click(lambda _: self._press(send))
        self._move_on.on_click(lambda _: send("move_on"))
        self._set_load.on_update(lambda _: send("set_load", self._set_load.value) if self._held else None)

    def _press(self, send: Callable[..., None]) -> None:
        if self._held:
            send("let_go")
        else:
            send("hold", self._mass.value, self._set_load.value)

    def show(self, snapshot: Snapshot, weighed: str) -> None:
        """Show what is in the hand, whether it is set in the monitor, and what was weighed."""
        held = snapshot.held
        if self._held != (held is not None):
            self._held = held is not None
            self._button.label = TAKE if self._held else GIVE
            self._mass.disabled = self._move_on.visible = self._held
        self._words.show("" if held is None else hand_text(held, weighed, snapshot.doing == "moving"))


def hand_text(held: Held, weighed: str, moves: bool) -> str:
    """The sentences about the weight in the hand."""
    if held.load_set:
        state = f"The load is set to {held.mass_kg:.1f} kg: it is no external torque."
    elif held.refused:
        state = f"The monitor refused the load: {held.refused}."
    else:
        state = "The load is not set in the monitor: the weight is an external torque."
    lines = [state, weighed + ("" if moves or not weighed else " The arm stands.")]
    body = "".join(f"<div style='padding-top:3px'>{html.escape(line)}</div>" for line in lines if line)
    return f"<div style='margin:0 12px 8px;font-size:12.5px;overflow-wrap:anywhere'>{body}</div>"


# --- The panel.


METHODS = {"tauext": "tauext", "paper": "the paper's network", "observer": "plain observer"}
REACTIONS = {"stop": "stop", "retreat": "retreat", "comply": "go compliant", "ignore": "go on"}
DOING = {"moving": "moves on", "stop": "has stopped", "retreat": "has backed off", "comply": "gives way to pushes"}
PLOT_EVERY_S = 0.2
PLOT_S = 6.0
PLOT_ROW_EVERY = 2
"""Of the trace's rows; 25 points a second are enough for the eye."""
COLORS = {"none": "#1f9d57", "contact": "#e09600", "collision": "#d62f2a", "off": "#7c8794"}
TRUTH, ESTIMATE, LIMIT = "#22a05a", "#206ee6", "#b3bac4"
SIGMA = "#206ee640"
"""The estimate's, see-through."""

NOTICES = """<style>
.mantine-Notifications-root { top: auto !important; bottom: 0.5em !important; }
.mantine-Notification-root {
  pointer-events: none !important; padding: 2px 12px 2px 20px; opacity: 0.8;
  animation: tauext-notice-leaves 0.5s 8s forwards;
}
.mantine-Notification-description, .mantine-Notification-closeButton { display: none; }
@keyframes tauext-notice-leaves { to { visibility: hidden; opacity: 0; } }
</style>"""
"""Moves viser's notice about the browser (no GPU, too old) to the lower edge, lets the mouse pass through it and hides
it after 8 s. At viser's own position it would cover the arm and block the mouse until the user closes it."""

SHEET = """<style>
@media (max-width: 576px) {
  .mantine-Paper-root[style*="position: fixed"][style*="max-height"] {
    width: 100% !important; max-height: 34% !important;
  }
  .mantine-Paper-root[style*="position: fixed"][style*="max-height"] .mantine-ScrollArea-content > div {
    width: 100% !important;
  }
}
</style>"""
"""On a narrow screen viser shows all panels in one sheet at the lower edge, 60 % of the screen high, which would cover
half of the arm. At 34 % the arm, the banner and Resume are visible; the rest of the sheet scrolls."""

Send = Callable[..., None]
"""Sends a command of the simulation: its name, its arguments."""


DELAY = "N ms: detected after N ms of contact force over the method's limit"
"""Caption of the table: the definition of `Event.after_limit_s`."""


class Panel:
    """Controls at the right, plots at the left; what one browser chooses holds for all."""

    def __init__(
        self,
        server: viser.ViserServer,
        arm: DemoArm,
        error: str,
        send: Send,
        choose_arm: Callable[[str], None],
        choose_error: Callable[[str], None],
        simplify: Callable[[bool], None],
    ):
        self._gui, self._arm = server.gui, arm
        self._rows = np.zeros((0, 1 + 4 * len(arm.joints)))
        self._plotted_s = -np.inf
        self._last: dict[str, Event] = {}
        self._training = ""
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(32, 110, 230))
        gui.set_panel_label("tauext: push the arm")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        Html(gui).show(NOTICES + SHEET)
        self._banner = Html(gui)
        self._progress = gui.add_progress_bar(0.0, animated=True, visible=False)
        resume = gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY, hint="end the collision and move on")
        self._table = Html(gui)
        with gui.add_folder("Monitor"):
            choose(gui, "method", METHODS, "tauext", lambda key: send("set_method", key))
            choose(gui, "its model", ERRORS, error, choose_error)
            sensitivity = gui.add_slider("sensitivity", 0.25, 3.0, 0.05, 1.0, hint="trained limits are divided by it")
        with gui.add_folder("Arm"):
            choose(gui, "arm", {name: make().title for name, make in ARMS.items()}, arm.name, choose_arm)
            choose(gui, "on collision", REACTIONS, "stop", lambda key: send("set_reaction", key))
            friction = gui.add_slider("friction", 0.5, 2.0, 0.05, 1.0, hint="times what it was in training")
            still = gui.add_checkbox("hold still", False)
            simple = gui.add_checkbox("simple drawing", False, hint="no floor, no shadows: for browsers without a GPU")
        self._hand = HandPanel(gui, send) if arm.hand_m is not None else None
        self._pace = Html(gui)

        def go_on(event: object) -> None:
            send("resume")
            still.value = False

        resume.on_click(go_on)
        sensitivity.on_update(lambda _: send("set_sensitivity", sensitivity.value))
        friction.on_update(lambda _: send("set_friction", friction.value))
        still.on_update(lambda event: send("rest" if still.value else "resume") if event.client else None)
        simple.on_update(lambda _: simplify(simple.value))
        plots = gui.add_panel()
        with plots.add_tab("External torque"):
            Html(gui).show(legend())
            self._plots = [self._plot(joint) for joint in arm.joints]
        plots.dock_left()
        plots.set_width(340)

    def show(self, snapshot: Snapshot, clients: int, weighed: str = "") -> None:
        """Write and plot the present state; weighed: the sentence about the weight in the hand."""
        for event in snapshot.events:
            self._last[event.method] = event
        self._banner.show(self._banner_text(snapshot, weighed))
        self._table.show(self._table_text(snapshot))
        if self._hand is not None:
            self._hand.show(snapshot, weighed)
        self._pace.show(
            f"<div style='padding:2px 12px 8px;font-size:12px;color:#6b7683'>{snapshot.real_time_factor:.2f} × real "
            f"time · 1 kHz · {clients} browser{'s' if clients != 1 else ''}</div>"
        )
        self._draw(snapshot)

    def show_training(self, share: float, what: str) -> None:
        """A bar while bundles are trained; what = "" takes it away."""
        self._training = what
        self._progress.visible = bool(what)
        self._progress.value = 100.0 * share

    def _banner_text(self, snapshot: Snapshot, weighed: str) -> str:
        verdict = snapshot.verdicts.get(snapshot.method)
        small = "Drag any link with the mouse to push it; drag beside the arm to look around."
        if verdict is None:
            big, color = "No monitor yet", COLORS["off"]
            small = self._training or small
        elif verdict.health != "ok":
            big, color = verdict.health.replace("_", " "), COLORS["off"]
        elif verdict.alarm == "none":
            big, color = "Free motion", COLORS["none"]
        else:
            big, color = f"{verdict.alarm.capitalize()}: {self._arm.joints[verdict.joint]}", COLORS[verdict.alarm]
        if verdict is not None and verdict.alarm == "collision":
            small = f"The arm {DOING[snapshot.doing]}. Resume ends the alarm."
            if snapshot.held is not None and not snapshot.held.load_set:
                small = f"{small} {weighed}"
        if snapshot.placed is not None:
            faint = " Faint: places that explain it too." if len(snapshot.placed.places) > 1 else ""
            small = f"{place_words(snapshot.placed, self._arm.joints)}{faint}"
        elif snapshot.touch is not None and snapshot.places_refused:
            small = shown_force(snapshot.touch.directions)
        if verdict is not None and self._training:
            small = self._training
        return (
            f"<div style='margin:8px 12px 4px;padding:10px 12px;border-radius:6px;background:{color};color:#fff'>"
            f"<div style='font-size:19px;font-weight:600'>{html.escape(big)}</div>"
            f"<div style='font-size:12.5px;min-height:57px'>{html.escape(small)}</div></div>"
        )

    def _table_text(self, snapshot: Snapshot) -> str:
        rows = []
        for method, title in METHODS.items():
            verdict = snapshot.verdicts.get(method)
            level = "off" if verdict is None or verdict.health != "ok" else verdict.alarm
            words = "–" if level == "off" or verdict is None else seen(verdict)
            last = last_alarm(self._last.get(method), self._arm)
            weight = 600 if method == snapshot.method else 400
            rows.append(
                f"<tr style='font-weight:{weight}'><td>{html.escape(title)}</td>"
                f"<td style='color:{COLORS[level]}'>{words}</td><td style='color:#6b7683'>{last}</td></tr>"
            )
        return (
            "<table style='margin:4px 12px 8px;font-size:12.5px;width:calc(100% - 24px);border-spacing:0 3px'>"
            "<tr style='color:#6b7683;text-align:left'><th>method</th><th>reports</th><th>last alarm</th></tr>"
            f"{''.join(rows)}</table><div style='margin:0 12px 8px;font-size:11.5px;color:#6b7683'>{DELAY}</div>"
        )

    def _plot(self, joint: str) -> viser.GuiUplotHandle:
        small = len(self._arm.joints) > 3
        lines = (
            {"label": "true", "stroke": TRUTH, "width": 2},
            {"label": "estimate", "stroke": ESTIMATE, "width": 2},
            {"label": "limit", "stroke": LIMIT, "width": 1.5},
            {"label": "-limit", "stroke": LIMIT, "width": 1.5},
            {"label": "estimate + σ", "stroke": SIGMA, "width": 0.5},
            {"label": "estimate - σ", "stroke": SIGMA, "width": 0.5},
        )
        return self._gui.add_uplot(
            data=tuple(np.zeros(1) for _ in range(1 + len(lines))),
            series=({"label": "s"}, *lines),
            bands=({"series": (5, 6), "fill": SIGMA},),
            title=None if small else f"{joint}, Nm",
            scales={"x": {"time": False}, "y": {"auto": True}},
            axes=({"show": not small, "size": 28}, {"size": 40} | ({"label": joint, "labelSize": 18} if small else {})),
            legend={"show": False},
            padding=(10, 16, 0, 0),
            height=86 if small else 220,
        )

    def _draw(self, snapshot: Snapshot) -> None:
        if len(snapshot.trace):
            known = np.isfinite(snapshot.trace).all(axis=1)
            self._rows = np.vstack([self._rows, snapshot.trace[known]])
        if len(self._rows) < 2 or snapshot.time_s - self._plotted_s < PLOT_EVERY_S:
            return
        self._plotted_s = snapshot.time_s
        self._rows = self._rows[self._rows[:, 0] > snapshot.time_s - PLOT_S]
        rows, n = self._rows[::-PLOT_ROW_EVERY][::-1], len(self._arm.joints)
        if len(rows) < 2:
            return
        estimate, sigma, limit, true = (rows[:, 1 + k * n : 1 + (k + 1) * n] for k in range(4))
        for j, plot in enumerate(self._plots):
            band = estimate[:, j] + sigma[:, j], estimate[:, j] - sigma[:, j]
            columns = (rows[:, 0], true[:, j], estimate[:, j], limit[:, j], -limit[:, j], *band)
            plot.data = tuple(np.ascontiguousarray(column) for column in columns)


def choose(
    gui: viser.GuiApi, label: str, titles: Mapping[str, str], first: str, chosen: Callable[[str], None]
) -> viser.GuiDropdownHandle[str]:
    """A dropdown of titles that returns the key of the chosen one."""
    keys = {title: key for key, title in titles.items()}
    dropdown = gui.add_dropdown(label, list(keys), initial_value=titles[first])
    dropdown.on_update(lambda _: chosen(keys[dropdown.value]))
    return dropdown


def shown_force(directions: int) -> str:
    """What the estimated arrow shows of a force, from how many of its directions the joints feel."""
    if directions == 3:
        return "Arrows: green the true force, blue the estimate from the joints' torques."
    if directions == 0:
        return "This push turns no joint: no torque shows it."
    return (
        f"Arrows: green true, blue estimated. Pushes here turn joints in {directions} of 3 directions; "
        "the rest of the force cannot be seen."
    )


def seen(verdict: Verdict) -> str:
    """`nothing`, `collision`, or once known the kind of touch and its newtons: `push, 34 N`."""
    if verdict.alarm == "none":
        return "nothing"
    what = verdict.alarm if verdict.kind in ("none", "unknown") else verdict.kind
    return what if np.isnan(verdict.force_n) else f"{what}, {verdict.force_n:.0f} N"


def last_alarm(event: Event | None, arm: DemoArm) -> str:
    """`joint2, 22 ms`: joint and delay; DELAY defines the delay. `false`: neither push nor weight."""
    if event is None:
        return "none yet"
    if event.after_push_s is None:
        return f"{arm.joints[event.joint]}, {'weight' if event.by_weight else 'false'}"
    if event.after_limit_s is None:
        return f"{arm.joints[event.joint]}, below its limit"
    return f"{arm.joints[event.joint]}, {1e3 * event.after_limit_s:.0f} ms"


def legend() -> str:
    entries = ((TRUTH, "true"), (ESTIMATE, "estimated"), (SIGMA, "± standard error"), (LIMIT, "± collision limit"))
    bar = "display:inline-block;width:14px;height:3px;margin:0 5px 3px 10px;"
    marks = "".join(
        f"<span style='white-space:nowrap'><span style='{bar}background:{color}'></span>{text}</span> "
        for color, text in entries
    )
    return f"<div style='font-size:12.5px;padding:6px 4px 2px'>{marks}</div>"
