"""Which link is touched and where: touches on every link of simulated arms, with bundles as users have them.

    python benchmarks/links.py MODELS UNSEEN OUT [--arms panda kinova seven_axis] [--meshes panda=ROBOT ...]
      [--touches 200] [--seed 0]

MODELS: folder of the robot files. UNSEEN: what `benchmarks/unseen_arms.py` wrote; a bundle is trained on each arm's
datasets where OUT has none. ROBOT: the arm's robot file with its meshes in the folders above: touches on the meshes
instead of cylinders, too. OUT gets the bundles, links.json and links.md.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import ROOT, arguments, head, table_row, trained, write_tables
from scipy.optimize import minimize
from unseen.arms import Maker, arm_of, makers
from unseen.simulation import RATE_HZ, Contact, draw_motion, simulate
from unseen.surfaces import SURFACES, Part, capsules_of, draw_touch, triangles_of
from wrench import WARM_S, logged, short, told

sys.path.insert(0, str(ROOT / "tests"))

from made_live import replay

from tauext import _core
from tauext.monitor.touch_place import STATED, PlaceChange, PlaceFinder, run_of
from tauext.robot.capsules import link_capsules
from tauext.robot.read import load_tree


def main() -> None:
    parser = arguments(__doc__, "models", "unseen", "out", arms=("panda", "kinova", "seven_axis"), seed=0)
    parser.add_argument("--meshes", nargs="+", default=[], help="robot files with meshes, each as ARM=FILE")
    parser.add_argument("--touches", type=int, default=200, help="an arm")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    for name in options.arms:
        rows += judged(ready(options.models, options.unseen, options.out, name), options)
    for name, _, model in (one.partition("=") for one in options.meshes):
        rows += judged(meshed(ready(options.models, options.unseen, options.out, name), Path(model)), options)
    write_tables(options.out, tables(rows), short(rows), "links")


def judged(arm: Arm, options: argparse.Namespace) -> list[dict]:
    """One row a touch and kind of shapes, with what is said of it."""
    rng = np.random.default_rng([options.seed, 61, len(arm.names)])
    touches, samples = touched(arm, options.touches, rng)
    said = _core.estimate(arm.bundle, samples.t_ns, samples.q, samples.dq, samples.tau, 1)
    rows = []
    for shapes, capsules in arm.shapes.items():
        arm.bundle.capsules = capsules
        looks = [look | {"shapes": shapes} for look in look_at(arm, touches, samples, said)]
        if shapes == GIVEN:
            bayes = Bayes(arm, errors_of(looks), rng)
            for look in looks:
                if look["seen"]:
                    look["bayes"] = bayes.probability(look).tolist()
        rows += looks
    return [kept(row) for row in rows]


KEPT = ("arm", "shapes", "link", "force_n", "angle_deg", "flange", "seen", "off_m", "spread_m")
"""Columns of all rows; those of the given shapes keep all columns."""


def kept(row: dict) -> dict:
    """The row as it is written."""
    if row["shapes"] == GIVEN:
        return {key: value for key, value in row.items() if key[0] != "_"}
    rounded = {"probability": [round(one, 4) for one in row["probability"]]} if row["seen"] else {}
    return {key: row[key] for key in KEPT if key in row} | rounded


GIVEN, GUESSED, THIN, MESHES = "given", "guessed", "5 cm capsules", "meshes"


def thin_capsules(bundle: _core.Bundle) -> list[_core.Capsule]:
    """A guess without a spread, to compare with: capsules of 5 cm from each joint to the joints that it carries, else
    to the load frame, else to the farthest frame that the robot file fixes to the link."""
    found, origin = [], [0.0, 0.0, 0.0]
    for number in range(bundle.joints):
        ends = [link.translation for link in bundle.links if link.parent == number]
        if not ends and bundle.load_settings.link == number:
            ends = [bundle.load_settings.translation]
        if not ends:
            fixed = [frame.translation for frame in bundle.wrench_settings.frames if frame.link == number]
            ends = [max([origin, *fixed], key=np.linalg.norm)]
        found += [_core.Capsule(number, origin, end, 0.05) for end in ends]
    return found


# --- Touches on every link of a simulated arm, and what the monitor reports of them.


SLOT_S, FIRST_S, HELD_S = 3.0, 8.0, 1.2
ACKNOWLEDGED_S = 1.4
"""After the alarm: a touch's own has ended by then, and the next finds none."""
RATIOS = (1.5, 10.0)
"""Of the limit that a touch exceeds most, even in its logarithm."""
FORCES_N = (8.0, 120.0)
"""Less is no touch that matters; more takes a small arm's drives to their limits."""
CONE_RAD = np.radians(45)
"""From the surface's normal: friction of 1."""
REJECTED = 0.05
FLANGE_EVERY = 8
DATASETS_SEED = 0
"""Of the arms that the datasets were made with."""
SAID_AT_S = 0.5
"""After the alarm: what the monitor has said by then is what it says."""


@dataclass(frozen=True)
class Arm:
    maker: Maker
    bundle: _core.Bundle
    title: str
    surface: tuple[Part, ...]
    shapes: dict[str, list[_core.Capsule]]
    """What a bundle may know of the surface; GUESSED: nothing, THIN: thin_capsules()."""

    @property
    def names(self) -> list[str]:
        return [link.joint_name for link in self.bundle.links]


def ready(models: Path, unseen: Path, out: Path, name: str) -> Arm:
    """With a bundle of recipe prior, trained where there is none."""
    maker = makers(models)[name]
    bundle = _core.Bundle.load(str(trained(unseen / name / "urdf", out / f"{name}.tauext")))
    shapes = {GIVEN: capsules_of(SURFACES[name]), GUESSED: [], THIN: thin_capsules(bundle)}
    return Arm(maker, bundle, name, SURFACES[name], shapes)


def meshed(arm: Arm, model: Path) -> Arm:
    """The arm with the meshes of this robot file for surfaces, and the capsules that an import fits to them."""
    capsules, lost = link_capsules(model, load_tree(model, list(arm.maker.joints)))
    assert not lost, lost
    shapes = {MESHES: capsules, GUESSED: [], THIN: arm.shapes[THIN]}
    surface = triangles_of(model, arm.maker.joints)
    return replace(arm, title=f"{arm.title}, meshes", surface=surface, shapes=shapes)


@dataclass(frozen=True)
class Touch:
    """In the link's axes."""

    link: int
    point_m: np.ndarray
    direction: np.ndarray
    angle_rad: float
    force_n: float
    start_s: float
    flange: bool = False
    """Held at the origin of the last link's frame, in any direction, and no touch of the surface."""

    def contact(self) -> Contact:
        when, along, at = (self.start_s, self.start_s + HELD_S), self.direction.tolist(), self.point_m.tolist()
        return Contact("push", *when, self.link, 0.5, tuple(along), self.force_n, when, tuple(at), in_link=True)


@dataclass(frozen=True)
class Samples:
    """As the monitor gets them, with what the simulation knows."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    true_nm: np.ndarray


def touched(arm: Arm, count: int, rng: np.random.Generator) -> tuple[list[Touch], Samples]:
    """A simulation with a touch a slot, in motion and in pauses; every FLANGE_EVERY-th holds the flange."""
    maker, real = arm.maker, arm_of(arm.maker, DATASETS_SEED)
    setpoints = draw_motion(maker, round((FIRST_S + count * SLOT_S) * RATE_HZ), RATE_HZ, rng)
    touches = [
        drawn(arm, setpoints[0], FIRST_S + k * SLOT_S + rng.uniform(0, 0.8), rng, k % FLANGE_EVERY == 0)
        for k in range(count)
    ]
    contacts = [one.contact() for one in touches]
    run = simulate(real, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, contacts, WARM_S)
    signals = logged(maker, real, run, told(maker, DATASETS_SEED), rng)
    return touches, Samples(*signals, run.tau_ext[:: RATE_HZ // maker.rate_hz])


def drawn(arm: Arm, q: np.ndarray, start_s: float, rng: np.random.Generator, flange: bool) -> Touch:
    """A touch on any link, at a point of its surface, that exceeds a limit by a ratio drawn from RATIOS."""
    model, limits = _core.WrenchModel(arm.bundle), np.array(arm.bundle.sliding_limit_nm)
    pose = q[round((start_s + 0.5) * RATE_HZ)]
    while True:
        link = len(arm.names) - 1 if flange else int(rng.integers(len(arm.names)))
        for _ in range(20):  # a link that no joint feels there is left for another one
            point, direction, angle = draw_touch(arm.surface, link, CONE_RAD, rng)
            if flange:
                point, direction = np.zeros(3), rng.standard_normal(3)
                direction /= np.linalg.norm(direction)
            columns = model.columns(arm.names[link], pose.tolist(), point.tolist(), _core.WrenchAxes.frame)[:3]
            ratio = np.exp(rng.uniform(*np.log(RATIOS)))
            force = ratio / max(np.abs(direction @ columns / limits).max(), 1e-9)
            if FORCES_N[0] <= force <= FORCES_N[1]:
                return Touch(link, point, direction, angle, float(force), start_s, flange)


def look_at(arm: Arm, touches: list[Touch], samples: Samples, said: dict) -> list[dict]:
    """What is said of each touch by SAID_AT_S after its alarm."""
    finder, changes = PlaceFinder(arm.bundle), []
    assert not finder.refused, finder.refused
    monitor = _core.Monitor(arm.bundle)
    for chunk in replay(monitor, samples, acknowledge_after_s=ACKNOWLEDGED_S, places=finder):
        changes += [change for change in chunk.changes if isinstance(change, PlaceChange)]
    return [told_of(arm, touch, samples, said, changes) for touch in touches]


def told_of(arm: Arm, touch: Touch, samples: Samples, said: dict, changes: list[PlaceChange]) -> dict:
    """One row."""
    start_ns = round(touch.start_s * 1e9) + int(samples.t_ns[0])
    own = [
        one
        for one in changes
        if start_ns <= one.t_ns - one.since_s * 1e9 < start_ns + HELD_S * 1e9 and one.since_s <= SAID_AT_S
    ]
    row = {
        "arm": arm.title,
        "link": touch.link,
        "point_m": touch.point_m.tolist(),
        "force_n": touch.force_n,
        "angle_deg": float(np.degrees(touch.angle_rad)),
        "flange": touch.flange,
        "seen": bool(own),
    }
    if not own:
        return row
    last = own[-1]
    strength = np.square(said["tau_ext"] / said["sigma_nm"]).sum(axis=1)
    first = int(np.searchsorted(samples.t_ns, last.t_ns - round(last.since_s * 1e9)))
    at = first + int(np.nanargmax(strength[first : last.row + 1]))
    sample = (samples.q[at].tolist(), said["tau_ext"][at].tolist(), said["sigma_nm"][at].tolist())
    contact_sigma = said["contact_sigma_nm"][at].tolist()
    found = _core.PlaceModel(arm.bundle).find(
        *sample, contact_sigma, link=touch.link, frame=arm.names[-1], dq=samples.dq[at].tolist()
    )
    given = found.places
    probability = [0.0] * len(arm.names)
    for link, share in last.links:
        probability[link] = share
    wrenches = _core.WrenchModel(arm.bundle)
    flange = wrenches.wrenches(
        arm.names[-1],
        *(np.array([one]) for one in sample),
        [0.0, 0.0, 0.0],
        contact_sigma_nm=said["contact_sigma_nm"][at : at + 1],
        dq=samples.dq[at : at + 1],
    )
    return row | {
        "probability": probability,
        "since_s": last.since_s,
        "moving": bool(np.abs(samples.dq[at]).max() > 0.01),
        "off_m": float(np.linalg.norm(np.subtract(given[0].on_link, touch.point_m))),
        "spread_m": given[0].spread_m,
        "said_n": float(np.linalg.norm(given[0].force)),
        "consistent": last.consistent,
        "ratio": float(np.abs(samples.true_nm[at] / said["limit_nm"][at]).max()),
        "flange_rejected": bool(flange["consistent"][0] < REJECTED),
        "at_flange": found.at_frame,
        "_q": samples.q[at],
        "_tau_ext": said["tau_ext"][at],
        "_true_nm": samples.true_nm[at],
    }


# --- The Bayes rule that knows the shape of the arm, how touches are drawn, and how large the errors of this arm are.


DRAWS, SIZES = 6000, 60
"""Touches drawn a link, and sizes of each, that its integrals are sums over."""


def errors_of(looks: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Of each joint: standard deviation of its error without a touch, and what a touch adds as a share of its torque.

    Found by likelihood on the very errors of the touches that are judged: nobody could know them better.
    """
    seen = [look for look in looks if look["seen"]]
    true = np.array([look["_true_nm"] for look in seen])
    error = np.array([look["_tau_ext"] for look in seen]) - true

    def cost(log: np.ndarray, joint: int) -> float:
        variance = np.exp(2 * log[0]) + np.exp(2 * log[1]) * true[:, joint] ** 2
        return float(np.sum(np.log(variance) + error[:, joint] ** 2 / variance))

    found = []
    for joint in range(true.shape[1]):
        start = [np.log(np.std(error[:, joint])), np.log(0.05)]
        found.append(np.exp(minimize(cost, start, args=(joint,), method="Nelder-Mead").x))
    floor, share = np.array(found).T
    return floor, share


class Bayes:
    def __init__(self, arm: Arm, errors: tuple[np.ndarray, np.ndarray], rng: np.random.Generator):
        self._names, self._model = arm.names, _core.WrenchModel(arm.bundle)
        self._floor, self._share = errors
        self._wrenches = []
        for link in range(len(arm.names)):
            drawn = [draw_touch(arm.surface, link, CONE_RAD, rng) for _ in range(DRAWS)]
            point, way = np.array([one[0] for one in drawn]), np.array([one[1] for one in drawn])
            self._wrenches.append(np.concatenate([way, np.cross(point, way)], axis=1))
        self._forces = np.exp(np.linspace(*np.log(FORCES_N), SIZES))

    def probability(self, look: dict) -> np.ndarray:
        """Of each link."""
        tau = look["_tau_ext"]
        variance = self._floor**2 + (self._share * tau) ** 2
        logs = np.empty(len(self._names))
        for link, name in enumerate(self._names):
            columns = self._model.columns(name, look["_q"].tolist(), axes=_core.WrenchAxes.frame)
            torque = self._wrenches[link] @ columns
            along, size = torque @ (tau / variance), (torque**2) @ (1 / variance)
            log = self._forces * along[:, None] - 0.5 * self._forces**2 * size[:, None]
            logs[link] = log.max() + np.log(np.exp(log - log.max()).mean())
        told = np.exp(logs - logs.max())
        return told / told.sum()


# --- Tables.


AT_FLANGE = 0.5
WITHIN_DEG, FROM_N, LAST_LINKS = 30.0, 20.0, 3


def tables(rows: list[dict]) -> list[str]:
    """Links, links by strength, confusions, forces at the flange, places, shapes."""
    every = [row for row in rows if not row["flange"]]
    held, rows = (
        [row for row in rows if row["flange"] == flange and row["shapes"] == GIVEN] for flange in (True, False)
    )
    arms = [*dict.fromkeys(row["arm"] for row in rows), "**all**"]

    def of(arm: str, some: list[dict]) -> list[dict]:
        return [row for row in some if arm in ("**all**", row["arm"])]

    lines = head(
        "arm | touches | alarms | right | Bayes | among two | Bayes | stated | of those right | Bayes stated | right"
    )
    lines += [links_line(arm, of(arm, rows)) for arm in arms]
    lines += ["", *head("ratio | touches with an alarm | right | Bayes right | stated | of those right")]
    for low, high in ((0, 2), (2, 4), (4, 7), (7, 99)):
        if some := [row for row in rows if row["seen"] and low <= row["ratio"] < high]:
            ours, bayes = (Told(padded(some), by) for by in ("probability", "bayes"))
            shares = (f"{share:.0%}" for share in (ours.first, bayes.first, ours.stated, ours.sure))
            lines.append(table_row(f"{low} to {high}", len(some), *shares))
    for arm in arms[:-1]:
        lines += confusion(arm, [row for row in of(arm, rows) if row["seen"]])
    columns = "on other links | by consistency | by probability | at the point | by consistency | by probability"
    lines += ["", *head(f"arm | {columns}"), *(flange_line(arm, of(arm, rows), of(arm, held)) for arm in arms)]
    lines += ["", *head("arm | touches | distance, cm: median | 90 % | spread, cm | force error, N")]
    lines += [place_line(arm, [row for row in of(arm, rows) if row["seen"]]) for arm in arms]
    columns = "stated | of these right | link or run | of these right | distance, cm | spread, cm"
    lines += ["", *head(f"arm | shapes | alarms | right | among two | {columns}")]
    for arm in [*dict.fromkeys(row["arm"] for row in every), "**all**"]:
        for shapes in (GIVEN, MESHES, GUESSED, THIN):
            some = [row for row in of(arm, every) if row["shapes"] == shapes and row["seen"]]
            lines += [shapes_line(arm, shapes, some)] if some else []
    return lines


def shapes_line(arm: str, shapes: str, rows: list[dict]) -> str:
    told = Told(padded(rows), "probability")
    runs = [run_of([(k, row["probability"][k]) for k in np.argsort(row["probability"])[::-1].tolist()]) for row in rows]
    held = [
        first <= row["link"] <= last for row, (first, last, share) in zip(rows, runs, strict=True) if share >= STATED
    ]
    placed = [row for row in rows if row["force_n"] >= FROM_N and row["angle_deg"] <= WITHIN_DEG]
    off, spread = (100 * np.median([row[key] for row in placed]) for key in ("off_m", "spread_m"))
    shares = (told.first, told.two, told.stated, told.sure, len(held) / len(rows), np.mean(held))
    return table_row(arm, shapes, len(rows), *(f"{share:.0%}" for share in shares), f"{off:.1f}", f"{spread:.1f}")


class Told:
    """Shares of touches whose link was told right."""

    def __init__(self, rows: list[dict], by: str):
        told, link = np.array([row[by] for row in rows]), np.array([row["link"] for row in rows])
        ranked = np.argsort(-told, axis=1)
        sure = told.max(axis=1) >= STATED
        right = ranked[:, 0] == link
        self.first, self.two = right.mean(), (right | (ranked[:, 1] == link)).mean()
        self.stated, self.sure = sure.mean(), right[sure].mean() if sure.any() else np.nan


def padded(rows: list[dict]) -> list[dict]:
    """Of arms with different numbers of links, so that they fit one table."""
    most = max(len(row["probability"]) for row in rows)
    return [
        row | {by: [*row[by], *[0.0] * (most - len(row[by]))] for by in ("probability", "bayes") if by in row}
        for row in rows
    ]


def links_line(name: str, rows: list[dict]) -> str:
    seen = padded([row for row in rows if row["seen"]])
    ours, bayes = Told(seen, "probability"), Told(seen, "bayes")
    told = (ours.first, bayes.first, ours.two, bayes.two, ours.stated, ours.sure, bayes.stated, bayes.sure)
    return table_row(name, len(rows), len(seen), *(f"{share:.0%}" for share in told))


def confusion(arm: str, rows: list[dict]) -> list[str]:
    links = len(rows[0]["probability"])
    table = np.zeros((links, links), dtype=int)
    for one in rows:
        table[one["link"], int(np.argmax(one["probability"]))] += 1
    lines = ["", *head(" | ".join([arm, *(str(k + 1) for k in range(links))]))]
    lines += [table_row(k + 1, *(one or "" for one in counts)) for k, counts in enumerate(table)]
    return lines


def flange_line(name: str, rows: list[dict], held: list[dict]) -> str:
    other = [row for row in rows if row["seen"] and row["link"] < len(row["probability"]) - 1]
    text = f"| {name}"
    for some in (other, [row for row in held if row["seen"]]):
        rejected = np.mean([row["flange_rejected"] for row in some])
        improbable = np.mean([row["at_flange"] < AT_FLANGE for row in some])
        text += f" | {len(some)} | {rejected:.0%} | {improbable:.0%}"
    return text + " |"


def place_line(name: str, rows: list[dict]) -> str:
    placed = [
        row
        for row in rows
        if row["link"] >= len(row["probability"]) - LAST_LINKS
        and row["force_n"] >= FROM_N
        and row["angle_deg"] <= WITHIN_DEG
    ]
    off = np.array([row["off_m"] for row in placed]) * 100
    spread = np.median([row["spread_m"] for row in placed]) * 100
    force = np.median([abs(row["said_n"] - row["force_n"]) for row in placed])
    median, most = np.quantile(off, (0.5, 0.9))
    return table_row(name, len(placed), *(f"{one:.1f}" for one in (median, most, spread, force)))


if __name__ == "__main__":
    main()
