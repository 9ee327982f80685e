"""Arms that press their tool on a surface while they are hit: hits found, false alarms, forces at the tool.

    python packages/lab/benchmarks/pressing.py MODELS OUT [--arms rig seven_axis ur5] [--sessions 6] [--hours 24]

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. Each arm learns from twenty minutes of free motion. Its
limits promise one false alarm in 8 h, from CALIBRATION_H hours of the motion of its sessions in the air. Then it
presses with 5, 20 and 40 N, at rest and sliding. The force acts in the simulation, so that friction answers. Hits:
the same links, places and peaks in the same motion, in the air and while the tool presses.

OUT/ARM gets the bundle, hits.json and hours.json; what exists is used again. OUT/tables.md gets the tables.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import COLLISION, arguments, checkpoint, head, quantiles_ms, table_row, trained, write_tables
from tauext_commission.connect import provenance_of, write_arm
from unseen.arms import fresh_makers, makers
from unseen.presses import (
    AFTER_HIT_S,
    KINDS,
    SHAPES,
    STATES,
    Presser,
    Session,
    Signals,
    current_presser,
    draw_hits,
    draw_session,
    free_recording,
    rig_presser,
    signals_of,
)  # fmt: skip
from unseen.simulation import PRESLIDING

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import OK
from tauext.config import AlarmConfig
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording
from tauext.fit.tail import is_kept, rate_interval
from tauext.train.calibrate import write_calibrated
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion
from tauext.train.promised_limits import remove_checkpoint

ARMS = ("rig", "seven_axis", "ur5")
"""On which the method was developed."""
SESSION_MIN = 10.0
CALIBRATION_H = 24.0
STREAMS = {"train": 1, "calibration": 2, "hits": 3, "hours": 4}
"""Of the draws."""
STRENGTHS = {"impact": (1.0, 6.0), "slow push": (0.5, 3.0)}
"""Peak torque of a hit over the joint's Coulomb friction."""


def presser_of(name: str, models: Path, out: Path, presliding: str = PRESLIDING[0]) -> Presser:
    """The arm of this name; the rig has a model of its own of the friction at rest."""
    if name == "rig":
        return rig_presser(out / "rig")
    known = makers(models) | fresh_makers()
    if name not in known:
        sys.exit(f"--arms {name}: must be rig or of {', '.join(known)}")
    if not known[name].model.is_file():
        sys.exit(f"{known[name].model}: there is no such file; MODELS is the folder of the arms' URDFs")
    return current_presser(known[name], presliding)


# --- A bundle from free motion: twenty minutes to learn, hours for the limits.


def sessions_in_air(presser: Presser, label: str, count: int) -> list[Callable]:
    """Loaders of recordings: the motion of the sessions without presses."""

    def load(number: int) -> Any:
        rng = np.random.default_rng([STREAMS[label], number])
        session = draw_session(presser, SESSION_MIN, rng)
        return free_recording(presser, session, f"{label}-{number:04d}", [STREAMS[label], number, 1])

    return [lambda number=number: load(number) for number in range(count)]


def bundle_of(presser: Presser, folder: Path, hours: float = CALIBRATION_H) -> _core.Bundle:
    """Trained on free motion; limits of one false alarm in 8 h, or of as few as the hours support; 0: as trained."""
    promised, free = folder / "promised.tauext", folder / "trained.tauext"
    if not free.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_arm(presser.facts, presser.maker.model, folder)
        for load in sessions_in_air(presser, "train", 2):
            recording = replace(load(), provenance=provenance_of(presser.facts))
            save_recording(recording, folder / f"{recording.name}.parquet")
        save_split(Split(tuple(sorted(one.name for one in folder.glob("train-*.parquet"))), (), ()), folder)
    bundle = load_bundle(trained(folder, free))
    if not hours:
        return bundle
    if not promised.exists():
        started = time.monotonic()
        loaders = sessions_in_air(presser, "calibration", round(60 * hours / SESSION_MIN))
        motion = LimitMotion("promised", AlarmConfig(), 1, calibration=loaders, out=promised)
        limits = LIMITS["promised"](bundle, motion)
        print(presser.maker.name, limits["sentence"], flush=True)
        write_calibrated(bundle, promised, json.loads(bundle.provenance) | {"limits": limits}, started)
        remove_checkpoint(promised)
    return load_bundle(promised)


# --- A session as a monitor sees it.


BLOCK_S = 0.05
ACKNOWLEDGED_S = 1.0
PROMISED_PER_H = AlarmConfig().false_alarms / AlarmConfig().in_hours
GRACE_S = 0.2
"""An alarm so long after a hit still belongs to it."""
SETTLED_S = 0.6
"""After the ramp, from which on the force at the tool is judged: five times 1/K0 and more."""
EVERY_S = 0.5
"""Between judged forces."""
MODES = ("in the air", "declared", "limits times 3", "undeclared")
FACTOR = 3.0
MARGIN = 1.25
"""Declared force over the one that presses."""


@dataclass(frozen=True)
class Watched:
    """What a monitor reported of a session."""

    rises_s: np.ndarray
    """Begin of each collision alarm."""
    alarm: np.ndarray
    """Whether one was latched, (samples,)."""
    healthy_s: float
    forces: list[tuple[float, np.ndarray, np.ndarray]]
    """Time, force at the tool and its covariance, base axes, at the end of blocks."""


def watched(bundle: _core.Bundle, presser: Presser, session: Session, signals: Signals, mode: str) -> Watched:
    """Run a monitor over a session; collisions are acknowledged after ACKNOWLEDGED_S."""
    monitor = _core.Monitor(bundle)
    if mode == "limits times 3":
        monitor.set_limit_factors([FACTOR] * bundle.joints, [FACTOR] * bundle.joints)
    rows = round(BLOCK_S * presser.maker.rate_hz)
    waiting = list(session.presses) if mode == "declared" else []
    ends_s, alarms, healths, forces = np.inf, [], [], []
    for first in range(0, len(signals.t_ns), rows):
        part, now_s = slice(first, first + rows), 1e-9 * float(signals.t_ns[first])
        if alarms and alarms[-1][-1] == COLLISION:
            if now_s - 1e-9 * monitor.last.alarm_t_ns >= ACKNOWLEDGED_S:
                monitor.acknowledge()
        if waiting and now_s >= waiting[0].declared_s[0]:
            press = waiting.pop(0)
            ends_s = press.declared_s[1]
            contact = declare(monitor, presser, MARGIN * press.force_n, ends_s - now_s + 1.0)
        if now_s >= ends_s:
            monitor.end_contact(contact)
            ends_s = np.inf
        said = monitor.run(signals.t_ns[part], *(signals.measured[name][part] for name in ("q", "dq", "tau")))
        alarms.append(said["alarm"].copy())
        healths.append(said["health"] == OK)
        if ends_s < np.inf:
            force = monitor.tool_force().wrench
            if force.known:
                at_s = 1e-9 * float(signals.t_ns[part][-1])
                forces.append((at_s, np.array(force.force), np.array(force.covariance)[:3, :3]))
    alarm = np.concatenate(alarms) == COLLISION
    rises = np.flatnonzero(alarm & ~np.append(False, alarm[:-1]))
    healthy_s = float(np.concatenate(healths).sum()) / presser.maker.rate_hz
    return Watched(1e-9 * signals.t_ns[rises], alarm, healthy_s, forces)


def declare(monitor: _core.Monitor, presser: Presser, at_most_n: float, seconds: float) -> int:
    """What the integrator declares before a press; returns its number."""
    contact = _core.DeclaredContact(
        frame=presser.maker.joints[-1], point=presser.tip_m, axis=presser.axis, half_angle_deg=presser.half_angle_deg,
        at_most_n=at_most_n,
    )  # fmt: skip
    return monitor.expect_contact(contact, seconds)


def judged(presser: Presser, session: Session, signals: Signals, seen: Watched) -> dict[str, list[dict]]:
    """Hits, presses and forces of a session, a row each."""
    t_s = 1e-9 * signals.t_ns
    hits, near = [], np.zeros(len(t_s), dtype=bool)
    for hit in session.hits:
        press = next(one for one in session.presses if one.from_s <= hit.start_s < one.to_s)
        near |= (t_s >= hit.start_s) & (t_s <= hit.end_s + AFTER_HIT_S)
        blocked = bool(seen.alarm[max(0, int(np.searchsorted(t_s, hit.start_s)) - 1)])
        rises = seen.rises_s[(seen.rises_s >= hit.start_s) & (seen.rises_s <= hit.end_s + GRACE_S)]
        found = bool(not blocked and len(rises) > 0)
        kind = next(kind for kind, shape in SHAPES.items() if shape == hit.kind)
        delay_s = float(rises[0] - hit.start_s) if found else None
        row = {"force_n": press.force_n, "state": press.state, "link": hit.link, "kind": kind, "found": found}
        hits.append(row | {"delay_s": delay_s})
    false_s = [rise for rise in seen.rises_s if not near[int(np.searchsorted(t_s, rise))]]
    presses = []
    for press in session.presses:
        begin, end = press.declared_s
        rows = (t_s >= begin) & (t_s < end) & ~near
        seconds = float(rows.sum()) / presser.maker.rate_hz
        false = int(sum(begin <= rise < end for rise in false_s))
        presses.append({"force_n": press.force_n, "state": press.state, "seconds": seconds, "false": false})
    between = len(false_s) - sum(one["false"] for one in presses)
    between_s = seen.healthy_s - sum(end - begin for begin, end in (press.declared_s for press in session.presses))
    total = {"seconds": between_s, "between": between}
    return {"hits": hits, "presses": presses, "forces": forces_of(session, signals, seen), "session": [total]}


def forces_of(session: Session, signals: Signals, seen: Watched) -> list[dict]:
    """Force at the tool against the truth, while the tool presses steadily and nothing hits the arm."""
    rows, last_s = [], -np.inf
    for at_s, force, covariance in seen.forces:
        press = next((one for one in session.presses if one.from_s <= at_s < one.to_s), None)
        if press is None or at_s - last_s < EVERY_S:
            continue
        steady = press.from_s + press.rise_s + SETTLED_S <= at_s <= press.to_s - press.rise_s
        if not steady or any(hit.start_s <= at_s <= hit.end_s + AFTER_HIT_S for hit in session.hits):
            continue
        last_s = at_s
        truth = signals.tool_n[int(np.searchsorted(signals.t_ns, round(1e9 * at_s)))]
        along = truth / np.linalg.norm(truth)
        off, sigma = float((force - truth) @ along), float(np.sqrt(along @ covariance @ along))
        row = {"force_n": press.force_n, "state": press.state, "off_n": off, "sigma_n": sigma}
        rows.append(row | {"whole_n": float(np.linalg.norm(force - truth))})
    return rows


def sessions(presser: Presser, label: str, seed: int, hits: bool) -> Iterator[tuple[Session, list[int]]]:
    """Endless sessions, and the seed of each one's noise."""
    number = 0
    while True:
        rng = np.random.default_rng([STREAMS[label], seed, number])
        session = draw_session(presser, SESSION_MIN, rng)
        if hits:
            session = replace(session, hits=draw_hits(presser, session, STRENGTHS, rng))
        yield session, [STREAMS[label], seed, number, 1]
        number += 1


def hits_of(presser: Presser, bundle: _core.Bundle, folder: Path, count: int, seed: int) -> dict[str, list[dict]]:
    """Rows of each session by mode; one file a session and mode."""
    done: dict[str, list[dict]] = {mode: [] for mode in MODES}
    for number, (session, noise) in zip(range(count), sessions(presser, "hits", seed, True), strict=False):
        signals = {presses: cache(partial(signals_of, presser, session, presses, noise)) for presses in (False, True)}
        for mode in MODES:

            def make(mode: str = mode, session: Session = session, signals: dict = signals) -> dict:
                seen = signals[mode != "in the air"]()
                return judged(presser, session, seen, watched(bundle, presser, session, seen, mode))

            done[mode].append(checkpoint(folder / f"hits-{mode.replace(' ', '-')}-{number:03d}.json", make))
        print(presser.maker.name, "hits", number, flush=True)
    return done


def hours_of(presser: Presser, bundle: _core.Bundle, folder: Path, hours: float, seed: int) -> list[dict]:
    """Presses without hits, declared: rows of each session; one file an hour."""
    each = round(60 / SESSION_MIN)
    stream, done = sessions(presser, "hours", seed, False), []
    for hour in range(round(hours)):
        drawn = [next(stream) for _ in range(each)]

        def make(drawn: list = drawn) -> list[dict]:
            rows = []
            for session, noise in drawn:
                try:
                    signals = signals_of(presser, session, True, noise)
                except RuntimeError as error:
                    print(presser.maker.name, "session left out:", error, flush=True)
                    continue
                rows.append(judged(presser, session, signals, watched(bundle, presser, session, signals, "declared")))
            return rows

        done += checkpoint(folder / f"hours-{hour:03d}.json", make)
        print(presser.maker.name, "hour", hour, sum(alarms_in(rows) for rows in done), flush=True)
    return done


def alarms_in(rows: dict) -> int:
    """Alarms of a session that no hit caused."""
    return sum(one["false"] for one in rows["presses"]) + rows["session"][0]["between"]


def among(rows: Sequence[dict], **wanted: Any) -> list[dict]:
    """Rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def share(hits: Sequence[dict]) -> str:
    return f"{sum(hit['found'] for hit in hits)}/{len(hits)}"


def kept(hits: dict[str, list[dict]], mode: str) -> str:
    """Found in a mode, over those found in the air."""
    air = sum(hit["found"] for hit in hits["in the air"])
    return f"{sum(hit['found'] for hit in hits[mode]) / air:.0%}" if air else "–"


def flat(done: dict[str, list[dict]], what: str) -> dict[str, list[dict]]:
    """All rows of one kind by mode."""
    return {mode: [row for session in rows for row in session[what]] for mode, rows in done.items()}


def hit_tables(name: str, done: dict[str, list[dict]]) -> list[str]:
    """Hits by state, force, link and kind; each also found in the air."""
    hits = flat(done, "hits")
    lines = head(
        f"arm | hits | {' | '.join(MODES)} | declared, of those in the air | delay in the air, ms: median, 95 % "
        "| declared, ms"
    )
    groups: list[tuple[str, dict]] = [(state, {"state": state}) for state in STATES]
    groups += [(f"{n:g} N", {"force_n": n}) for n in sorted({row["force_n"] for row in hits["in the air"]})]
    groups += [(f"on link {k + 1}", {"link": k}) for k in sorted({row["link"] for row in hits["in the air"]})]
    for what, wanted in [*groups, *((kind, {"kind": kind}) for kind in KINDS), ("**all**", {})]:
        of = {mode: among(rows, **wanted) for mode, rows in hits.items()}
        delays = [quantiles_ms([row["delay_s"] for row in of[mode] if row["found"]]) for mode in MODES[:2]]
        lines.append(table_row(name, what, *(share(of[mode]) for mode in MODES), kept(of, MODES[1]), *delays))
    return lines


def false_rows(name: str, done: dict[str, list[dict]], hours: list[dict]) -> list[str]:
    """False alarms while pressing and between, by mode; of the hours with a promise."""
    lines = []
    for mode, sessions in [*done.items(), ("declared, without hits", hours)]:
        if not sessions:
            continue
        presses = [press for session in sessions for press in session["presses"]]
        pressed_h = sum(one["seconds"] for one in presses) / 3600
        between_h = sum(session["session"][0]["seconds"] for session in sessions) / 3600
        false, between = sum(one["false"] for one in presses), sum(one["session"][0]["between"] for one in sessions)
        alarming = sum(one["false"] > 0 for one in presses)
        low, high = rate_interval(false, pressed_h)
        by = " · ".join(str(sum(one["false"] for one in among(presses, state=state))) for state in STATES)
        verdict = "–" if mode in done else "yes" if is_kept(false, pressed_h, PROMISED_PER_H) else "no"
        lines.append(table_row(
            name, mode, f"{pressed_h:.1f}", false, by, f"{low:.2f} to {high:.2f}", f"{alarming}/{len(presses)}",
            f"{between} in {between_h:.1f} h", verdict,
        ))  # fmt: skip
    return lines


FALSE_COLUMNS = (
    "arm | mode | h pressed | false alarms | still · sliding · still, uneven | an hour, 95 % | presses with one "
    "| between presses | 1 in 8 h kept"
)
FORCE_COLUMNS = (
    "arm | state | force, N | samples | error along the force, N: mean | RMS | of the vector, N: median | "
    "standard error, N: median | within two standard errors"
)


def force_rows(name: str, forces: Sequence[dict]) -> list[str]:
    """Errors of the force at the tool, and how often two standard errors cover them."""
    lines = []
    for state in STATES:
        for force_n in sorted({row["force_n"] for row in forces}):
            of = among(forces, state=state, force_n=force_n)
            if not of:
                continue
            off, sigma = (np.array([row[key] for row in of]) for key in ("off_n", "sigma_n"))
            whole = np.median([row["whole_n"] for row in of])
            cells = (f"{off.mean():+.1f}", f"{np.sqrt(np.mean(off**2)):.1f}", f"{whole:.1f}", f"{np.median(sigma):.1f}")
            inside = np.mean(np.abs(off) <= 2 * sigma)
            lines.append(table_row(name, state, f"{force_n:g}", len(of), *cells, f"{inside:.0%}"))
    return lines


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=ARMS, seed=0)
    parser.add_argument("--sessions", type=int, default=6, help="of ten minutes with hits, default: %(default)s")
    parser.add_argument(
        "--calibration",
        type=float,
        default=CALIBRATION_H,
        help="hours for the limits, 0: those of training, default: %(default)s",
    )
    parser.add_argument("--hours", type=float, default=24, help="of presses without hits, default: %(default)s")
    parser.add_argument(
        "--presliding", choices=PRESLIDING, default=PRESLIDING[0], help="friction at rest, default: %(default)s"
    )
    options = parser.parse_args()
    lines, false, forces = [], head(FALSE_COLUMNS), head(FORCE_COLUMNS)
    content = {}
    for name in options.arms:
        presser, folder = presser_of(name, options.models, options.out, options.presliding), options.out / name
        bundle = bundle_of(presser, folder, options.calibration)
        done = hits_of(presser, bundle, folder, options.sessions, options.seed)
        hours = hours_of(presser, bundle, folder, options.hours, options.seed)
        tool = [row for session in [*done["declared"], *hours] for row in session["forces"]]
        lines += [*hit_tables(name, done), ""]
        false += false_rows(name, done, hours)
        forces += force_rows(name, tool)
        content[name] = {"hits": flat(done, "hits"), "presses": flat(done, "presses")}
    write_tables(options.out, [*lines, *false, "", *forces], content)


if __name__ == "__main__":
    main()
