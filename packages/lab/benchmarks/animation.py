"""README's animation: a link of a simulated arm is pushed, its torque exceeds the threshold, and it turns red.

    python packages/lab/benchmarks/animation.py MODELS UNSEEN OUT [--arm ur5] [--seed 17]

MODELS: folder of the robot files. UNSEEN: what unseen_arms.py wrote; OUT gets a bundle of the arm's dataset where it
has none, and push.svg: eight seconds, for light and dark pages.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, estimates
from links import SEED, WARM_S, Arm, ready
from unseen.arms import arm_of
from unseen.recordings import logged, nm_per_given
from unseen.simulation import RATE_HZ, Contact, draw_motion, simulate

from tauext.bundle.estimates import COLLISION
from tauext.robot.read import load_tree, placed_bodies, read_robot

SHOWN_S, BEFORE_S, HELD_S = 8.0, 3.2, 0.9
"""The animation, the part of it before the push, and the push."""
FIRST_S = 8.0
"""Before the animation: the observer warms up."""
FRAMES_HZ = 20
FORCE_N, LINK = 45.0, 2
WIDTH, HEIGHT = 860, 320
VIEW = np.array([[0.86, -0.5, 0.0], [-0.17, -0.29, 0.94]])
"""Right and up on the page, in base axes: a view from the front right, slightly from above."""
PLOT = (430.0, 50.0, 400.0, 210.0)
"""Left, top, width and height of the plot."""
STYLE = """
    .link { stroke: #8a9bb0; stroke-linecap: round; } .ink { fill: #1f2933; } .grey { fill: #66727f; }
    .axis { stroke: #9aa5b1; fill: none; } .band { fill: #2f6db3; opacity: 0.14; }
    .torque { stroke: #1f2933; fill: none; stroke-width: 2; } .alarm { fill: #c62828; }
    .hand { stroke: #d97706; fill: #d97706; } .over { stroke: #c62828; }
    @media (prefers-color-scheme: dark) {
      .link { stroke: #708196; } .ink { fill: #e6edf3; } .grey { fill: #9aa7b4; } .torque { stroke: #e6edf3; }
      .band { fill: #6cb0ff; opacity: 0.18; } .alarm { fill: #ff6b6b; } .over { stroke: #ff6b6b; }
    }"""


def main() -> None:
    parser = arguments(__doc__, "models", "unseen", "out", seed=17)
    parser.add_argument("--arm", default="ur5", help="of unseen_arms.py, default: %(default)s")
    options = parser.parse_args()
    arm = ready(options.models, options.unseen, options.out, options.arm)
    (options.out / "push.svg").write_text(drawn(arm, *pushed(arm, options.seed)))
    print(options.out / "push.svg")


def pushed(arm: Arm, seed: int) -> tuple[argparse.Namespace, dict[str, np.ndarray], Contact]:
    """The recording of a motion with one push, its estimates, and the push."""
    rng = np.random.default_rng([seed, 97])
    maker, real = arm.maker, arm_of(arm.maker, SEED)
    setpoints = draw_motion(maker, round((FIRST_S + SHOWN_S) * RATE_HZ), RATE_HZ, rng)
    start_s = FIRST_S + BEFORE_S
    when = (start_s, start_s + HELD_S)
    push = Contact("push", *when, LINK, 0.8, (-0.35, 0.94, 0.0), FORCE_N, when)
    run = simulate(real, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, [push], WARM_S)
    constants = real.nm_per_ampere / nm_per_given(maker, SEED)
    made = argparse.Namespace(**logged(maker, real, run, constants, rng), temperature=None)
    return made, estimates(arm.bundle, made), push


def axes_ends(arm: Arm, q: np.ndarray) -> tuple[np.ndarray, list[int], list[float]]:
    """Ends of the links' cylinders in the base, (frames, cylinders, 2, 3), their links and radii [m]."""
    spec, _ = read_robot(arm.maker.model)
    model, placed = spec.compile(), {}
    for body in placed_bodies(arm.maker.model, load_tree(arm.maker.model, arm.maker.joints))[2]:
        placed.setdefault(body.link, body)
    data, ends = mujoco.MjData(model), []
    at = [int(model.joint(name).qposadr[0]) for name in arm.maker.joints]
    parts = [part for part in arm.surface if part.link in placed]
    for pose in q:
        data.qpos[at] = pose
        mujoco.mj_kinematics(model, data)
        row = []
        for part in parts:
            body = placed[part.link]
            number = model.body(body.name).id
            turn = data.xmat[number].reshape(3, 3) @ body.rotation.T
            row.append(
                [data.xpos[number] + turn @ (np.array(end) - body.translation) for end in (part.start_m, part.end_m)]
            )
        ends.append(row)
    return np.array(ends), [part.link for part in parts], [part.radius_m for part in parts]


def animated(name: str, values: np.ndarray, digits: int = 1) -> str:
    """An attribute that takes these values one after another, over and over."""
    text = ";".join(f"{value:.{digits}f}" for value in values)
    return f'<animate attributeName="{name}" dur="{SHOWN_S:g}s" repeatCount="indefinite" values="{text}"/>'


def switched(name: str, off: str, on: str, from_s: float, to_s: float = SHOWN_S) -> str:
    """An attribute that has another value between two times."""
    times = f"0;{from_s / SHOWN_S:.4f};{to_s / SHOWN_S:.4f}"
    return (
        f'<animate attributeName="{name}" dur="{SHOWN_S:g}s" repeatCount="indefinite" calcMode="discrete" '
        f'values="{off};{on};{off}" keyTimes="{times}"/>'
    )


def drawn(arm: Arm, made: argparse.Namespace, said: dict[str, np.ndarray], push: Contact) -> str:
    """The SVG."""
    t_s = 1e-9 * (made.t_ns - made.t_ns[0]) - FIRST_S
    rows = np.searchsorted(t_s, np.arange(0, SHOWN_S, 1 / FRAMES_HZ)).clip(max=len(t_s) - 1)
    alarms = np.flatnonzero((said["held_alarm"] == COLLISION) & (t_s >= 0))
    assert len(alarms) and BEFORE_S <= t_s[alarms[0]] < BEFORE_S + HELD_S, (
        "the push alone raises an alarm; another --seed"
    )
    alarm_s = float(t_s[alarms[0]])
    ratios = np.abs(said["tau_ext"][alarms[0]]) / said["limit_nm"][alarms[0]]
    joint = int(np.argmax(ratios))
    ends, links, radii = axes_ends(arm, made.q[rows])
    page = ends @ VIEW.T
    low, high = np.minimum(page.min(axis=(0, 1, 2)), 0) - 0.1, page.max(axis=(0, 1, 2)) + 0.1
    scale = min(390 / (high[0] - low[0]), 280 / (high[1] - low[1]))
    x, y = 210 + scale * (page[..., 0] - (low[0] + high[0]) / 2), HEIGHT - 20 - scale * (page[..., 1] - low[1])
    floor = HEIGHT - 20 + scale * low[1]
    parts = [f'<path class="axis" d="M{x[0, 0, 0] - 70:.1f},{floor:.1f} h140"/>']
    for k in np.argsort(-(ends.mean(axis=(0, 2)) @ np.cross(*VIEW))):  # far ones first
        red = switched("class", "link", "link over", alarm_s) if links[k] == push.link else ""
        moves = "".join(
            animated(f"{name}{end + 1}", at[:, k, end]) for name, at in (("x", x), ("y", y)) for end in (0, 1)
        )
        parts.append(f'<line class="link" style="stroke-width:{2 * scale * radii[k]:.1f}">{moves}{red}</line>')
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}"',
            '  font-family="system-ui, sans-serif" font-size="24">',  # 11 px on a phone
            "  <title>A push on a link of a simulated arm and the estimate of its external torque</title>",
            f"  <style>{STYLE}\n  </style>",
            *parts,
            hand(x, y, links, push),
            *plot(t_s, said, joint, alarm_s),
            "</svg>\n",
        ]
    )


def hand(x: np.ndarray, y: np.ndarray, links: list[int], push: Contact) -> str:
    """An arrow to the pushed link, while it is pushed."""
    k = links.index(push.link)
    way = VIEW @ np.array(push.direction) * [1, -1]
    way = 70 * way / max(float(np.linalg.norm(way)), 1e-9)
    at = [one[:, k, 0] + push.share * (one[:, k, 1] - one[:, k, 0]) for one in (x, y)]
    places = ";".join(f"{right:.1f},{down:.1f}" for right, down in zip(*at, strict=True))
    turns = f'attributeName="transform" type="translate" dur="{SHOWN_S:g}s" repeatCount="indefinite"'
    (from_x, from_y), (tip_x, tip_y), (text_x, text_y) = -way, -0.25 * way, -1.15 * way
    return (
        f'<g class="hand" opacity="0">{switched("opacity", "0", "1", BEFORE_S, BEFORE_S + HELD_S)}'
        f'<animateTransform {turns} values="{places}"/>'
        f'<path stroke-width="5" d="M{from_x:.0f},{from_y:.0f} L{tip_x:.0f},{tip_y:.0f}"/>'
        f'<circle cx="{tip_x:.0f}" cy="{tip_y:.0f}" r="8"/>'
        f'<text x="{text_x:.0f}" y="{text_y:.0f}" stroke="none" text-anchor="middle">{push.peak_n:.0f} N</text></g>'
    )


def plot(t_s: np.ndarray, said: dict[str, np.ndarray], joint: int, alarm_s: float) -> list[str]:
    """External torque of a joint within its threshold, which appears as time passes."""
    left, top, width, height = PLOT
    shown = np.flatnonzero((t_s >= 0) & (t_s < SHOWN_S))[:: max(1, int((t_s >= 0).sum() / 400))]
    tau, limit = said["tau_ext"][shown, joint], said["limit_nm"][shown, joint]
    size = 1.1 * max(float(np.abs(tau).max()), float(limit.max()))
    at_x, middle = left + width * t_s[shown] / SHOWN_S, top + height / 2

    def path(values: np.ndarray) -> str:
        return " ".join(
            f"{one:.1f},{two:.1f}" for one, two in zip(at_x, middle - height / 2 * values / size, strict=True)
        )

    band = path(limit) + " " + " ".join(reversed(path(-limit).split(" ")))
    now, right = animated("width", width * np.linspace(0, 1, 41)), f'x="{left + width}" text-anchor="end"'
    late = f"collision after {1e3 * (alarm_s - BEFORE_S):.0f} ms"
    return [
        f'<clipPath id="past"><rect x="{left}" y="{top}" height="{height}" width="{width}">{now}</rect></clipPath>',
        f'<polygon class="band" points="{band}"/>',
        f'<path class="axis" d="M{left},{top} v{height} M{left},{middle} h{width}"/>',
        f'<g clip-path="url(#past)"><polyline class="torque" points="{path(tau)}"/></g>',
        f'<text class="ink" x="{left}" y="{top - 28}">external torque and threshold</text>',
        f'<text class="grey" x="{left + 4}" y="{top + 22}">{size:.0f} N m</text>',
        f'<text class="grey" x="{left}" y="{top + height + 28}">0 s</text>',
        f'<text class="grey" {right} y="{top + height + 28}">{SHOWN_S:.0f} s, simulated arm</text>',
        f'<text class="alarm" {right} y="{top - 4}" font-weight="600" opacity="0">{late}',
        f"{switched('opacity', '0', '1', alarm_s)}</text>",
    ]


if __name__ == "__main__":
    main()
