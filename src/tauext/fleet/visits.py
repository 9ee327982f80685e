"""Arms at their dates: bundles, results and robots of the fleet folders."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.history_file import BUNDLES, RESULTS, is_commissioned, read_history
from tauext.data.dataset import load_dataset
from tauext.data.recording_file import recording_date
from tauext.errors import ConfigError, TauextError
from tauext.evaluate.results import load_results
from tauext.files.places import Place, place_of
from tauext.files.plain_file import expect_format, json_of, read_text
from tauext.fleet.odds import NAMED

# --- Which arms and joints are named, in words: deviations that are more likely than not.


FRICTION = "friction × {factor} of {whose}"
CONSTANT = "a unit of its recorded torque is × {factor} of {whose}"
TOOL = "carries {kg} kg {way} than {when}"
WORDS = {
    ("own", "friction", "more"): ("wearing", FRICTION),
    ("own", "friction", "less"): ("less friction", f"{FRICTION}: new grease, a repaired gear, or a loose one"),
    ("own", "constant", "more"): ("constant changed", CONSTANT),
    ("own", "constant", "less"): ("constant changed", CONSTANT),
    ("own", "tool", "more"): ("tool changed", TOOL),
    ("own", "tool", "less"): ("tool changed", TOOL),
    ("fleet", "friction", "more"): ("more friction than the fleet", FRICTION),
    ("fleet", "friction", "less"): ("less friction than the fleet", FRICTION),
    ("fleet", "constant", "more"): ("constant unlike the fleet's", CONSTANT),
    ("fleet", "constant", "less"): ("constant unlike the fleet's", CONSTANT),
    ("fleet", "tool", "more"): ("tool unlike the fleet's", TOOL),
    ("fleet", "tool", "less"): ("tool unlike the fleet's", TOOL),
}


def named_of(serial: str, joints: Sequence[str], visit: Mapping[str, Any], centres: Mapping[str, Any]) -> list[dict]:
    """What is named of one arm at its last date.

    Args:
        visit: with "own" and "fleet".
        centres: of the tables of its group, (joints,) each, by names as "fleet friction".
    """
    found = []
    for against in ("own", "fleet"):
        tables = visit.get(against) or {}
        since = tables.get("since") or "its first date"
        whose, when = (since, f"on {since}") if against == "own" else ("the fleet's", "the fleet's middle")
        for what in ("friction", "constant", "tool"):
            table = tables.get(what)
            if table is None or "more" not in table:
                continue
            for j, pair in enumerate(zip(table["more"], table["less"], strict=True)):
                for way, probability in zip(("more", "less"), pair, strict=True):
                    if probability is None or probability < NAMED:
                        continue
                    value = table["value"][j] - (centres[f"{against} {what}"][j] if against == "fleet" else 0.0)
                    kind, words = WORDS[against, what, way]
                    factor, kg = f"{np.exp(min(value, 20)):.2f}", f"{abs(value):.2f}"
                    found.append(
                        {
                            "arm": serial,
                            "joint": joints[j] if what != "tool" else None,
                            "kind": kind,
                            "against": against,
                            "what": what,
                            "probability": probability,
                            "value": round(float(value if what == "tool" else np.exp(min(value, 20))), 4),
                            "words": words.format(factor=factor, kg=kg, whose=whose, way=way, when=when),
                        }
                    )
    return found


# --- Content of a bundle, joint by joint: friction, ripple, limits, constants, promise.


SPEED_RAD_S = 0.5
"""Friction is reported at this speed: most joints slide at it, and few slow moves are faster."""
MEMORY_S = 2.0
"""Errors of a fit so far apart are independent: the longest that a refit counts."""
MOVING = 0.5
"""Share of its recordings in which a joint is assumed to move."""
Kind = _core.TermKind
AT_SPEED: dict[_core.TermKind, Callable[[_core.Term], float]] = {
    Kind.coulomb: lambda term: float(np.tanh(SPEED_RAD_S / term.speed)),
    Kind.presliding: lambda term: 1.0,
    Kind.viscous: lambda term: SPEED_RAD_S,
}
"""Friction of a term of weight 1 at SPEED_RAD_S."""


@dataclass(frozen=True)
class BundleFacts:
    """Of one bundle; arrays over the joints."""

    joints: tuple[str, ...]
    units: tuple[str, ...]
    """Of torques."""
    recipe: str
    minutes: float | None
    error_nm: np.ndarray
    """Residual of the prior in training; NaN: unknown."""
    ripple_nm: np.ndarray
    """Amplitudes of all ripples of the joint together, as squares add; NaN without a prior."""
    limit_nm: np.ndarray
    stiction_limit_nm: np.ndarray
    false_per_hour: float | None
    """Largest promised false alarm rate of its limits."""
    promise: str
    constants: np.ndarray
    """Found, in N m a unit of the recordings' torque, or by the import's; NaN where motion did not determine it."""
    constants_error: np.ndarray
    bundle: _core.Bundle

    @property
    def nm_per_unit(self) -> np.ndarray:
        """Factor on the recorded torque."""
        used = self.bundle.observer.nm_per_unit
        return np.array(used) if len(used) else np.ones(len(self.joints))

    @property
    def has_prior(self) -> bool:
        """Whether the bundle has a friction model."""
        return any(term.kind in (Kind.coulomb, Kind.presliding) for term in self.bundle.prior.terms)

    def friction_error(self, friction_nm: np.ndarray) -> np.ndarray:
        """Relative standard error of the friction: the fit's residual over the root of the independent moments."""
        seconds = 60 * (self.minutes or 1.0) * MOVING
        return self.error_nm / np.maximum(friction_nm, 1e-9) / np.sqrt(max(seconds / MEMORY_S, 1.0))


def read_bundle(path: Place) -> BundleFacts:
    """Facts of a bundle file.

    Raises:
        TauextError: it cannot be read.
    """
    bundle = load_bundle(path)
    facts = json.loads(bundle.provenance or "{}")
    joints = tuple(link.joint_name for link in bundle.links)
    prior = of(facts, "prior")
    found = of(of(facts, "torque_constants"), "found")
    fits = [of(found, name) for name in joints]
    known = [bool(one.get("determined")) for one in fits]
    promise = of(of(facts, "limits"), "promise")
    budget = of(promise, "asked") if promise.get("supported", True) else of(promise, "supported_budget")
    return BundleFacts(
        joints=joints,
        units=tuple(bundle.estimate_units),
        recipe=str(facts.get("recipe") or ""),
        minutes=facts.get("training_minutes"),
        error_nm=numbers(of(prior, "error_nm").get(name) for name in joints),
        ripple_nm=ripples_nm(bundle),
        limit_nm=np.array(bundle.sliding_limit_nm, dtype=float),
        stiction_limit_nm=np.array(bundle.near_stiction_limit_nm, dtype=float),
        false_per_hour=budget.get("rate_per_hour"),
        promise=str(of(facts, "limits").get("sentence") or promise.get("sentence") or ""),
        constants=numbers(
            one.get("nm_per_unit") if is_known else None for one, is_known in zip(fits, known, strict=True)
        ),
        constants_error=numbers(one.get("standard_error") for one in fits),
        bundle=bundle,
    )


def of(facts: Any, key: str) -> dict[str, Any]:
    """The table under the key; empty without such a key."""
    value = facts.get(key) if isinstance(facts, dict) else None
    return value if isinstance(value, dict) else {}


def numbers(values: Any) -> np.ndarray:
    """The number; NaN if it is missing."""
    return np.array([np.nan if value is None else float(value) for value in values])


def friction_nm(facts: BundleFacts, weight_nm: np.ndarray) -> np.ndarray:
    """Friction of each joint at SPEED_RAD_S, (n,); NaN without a prior.

    Args:
        weight_nm: (n,) what weighs on the joint on the average: friction that grows with it belongs to it.
    """
    prior, n = facts.bundle.prior, len(facts.joints)
    if not facts.has_prior:
        return np.full(n, np.nan)
    at_speed = AT_SPEED | {
        Kind.load: lambda term: weight_nm[term.a] * float(np.tanh(SPEED_RAD_S / term.speed)),
        Kind.load_presliding: lambda term: weight_nm[term.a],
    }
    weights = np.array(prior.weights).reshape(n, -1)
    out = np.zeros(n)
    for m, term in enumerate(prior.terms):
        if term.kind in at_speed:
            out[term.a] -= weights[term.a, m] * at_speed[term.kind](term)
    return out


def ripples_nm(bundle: _core.Bundle) -> np.ndarray:
    """Root of the sum of squares of each joint's ripple weights, (n,)."""
    n = bundle.joints
    if not bundle.prior.terms:
        return np.full(n, np.nan)
    weights = np.array(bundle.prior.weights).reshape(n, -1)
    squares = np.zeros(n)
    for m, term in enumerate(bundle.prior.terms):
        if term.kind == Kind.ripple:
            squares[term.a] += weights[term.a, m] ** 2
    return np.sqrt(squares)


# --- Arms at their dates, from the folders of `tauext fleet run`.


FLEET = "fleet.json"


@dataclass(frozen=True)
class Visit:
    """One arm at one date."""

    serial: str
    """Identity of the arm."""
    name: str
    """Its name in the fleet."""
    type: str
    run: int
    """Index of its fleet folder, from 0."""
    date: str
    """YYYY-MM-DD; empty: unknown."""
    state: str
    reason: str
    """Reason why it is not done; empty if it is."""
    stage: str
    """The stage that failed."""
    folder: Place
    """Of the arm in its fleet's."""
    dataset: Place | None
    bundle: Place | None
    results: Place | None


def visits_of(fleets: Sequence[Place]) -> list[Visit]:
    """All arms of these fleet folders, each arm's dates in their order.

    A date is that of FLEET.toml, or else the day of the first recording if its clock has one. Where an arm has
    entries without a date, all of its entries are in the order of the folders.

    Raises:
        ConfigError: no fleet.json, not readable, or one folder twice.
    """
    places = [place.resolve() for place in fleets]
    twice = [str(fleets[k]) for k, place in enumerate(places) if place in places[:k]]
    if twice:
        raise ConfigError(f"{twice[0]}: the same fleet folder twice; give each date once")
    visits = [one for run, fleet in enumerate(fleets) for one in visits_in(fleet, run)]
    if not visits:
        raise ConfigError(f"{fleets[0] / FLEET}: it lists no arm")
    dated = {one.serial for one in visits} - {one.serial for one in visits if not one.date}
    return sorted(visits, key=lambda one: (one.date if one.serial in dated else "", one.run))


def visits_in(fleet: Place, run: int) -> list[Visit]:
    """Of one fleet folder, or of a folder of arms that `tauext commission` made, or of one such arm."""
    path = fleet / FLEET
    if not path.is_file() and (arms := commissioned(fleet)):
        return [visit for arm in arms for visit in days_of(arm, run)]
    try:
        content = json_of(read_text(path))
        expect_format(content, path, "run `tauext fleet run` again")
        return [visit_of(entry, fleet, run) for entry in content["arms"]]
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: there is no such fleet; `tauext fleet run FLEET.toml --out {fleet}` makes one, "
            "`tauext commission` one arm"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: cannot be read as a fleet of `tauext fleet run` ({error})") from error


def commissioned(folder: Place) -> list[Place]:
    """Folders of `tauext commission`: this one, or those in it."""
    if is_commissioned(folder):
        return [folder]
    if not folder.is_dir():
        return []
    return sorted((one for one in folder.iterdir() if is_commissioned(one)), key=lambda one: one.name)


def days_of(arm: Place, run: int) -> list[Visit]:
    """A commissioned arm at each day on which a bundle was put in charge; the last bundle of each day counts."""
    newest: dict[str, str] = {}
    for one in read_history(arm):
        if one["kind"] == "activation" and (arm / BUNDLES / f"{one.get('bundle')}.tauext").is_file():
            newest[str(one.get("wall"))[:10]] = str(one["bundle"])
    waits = Visit(
        serial=arm.name,
        name=arm.name,
        type="",
        run=run,
        date="",
        state="waiting",
        reason="no bundle monitors it yet; let it move under `tauext commission`",
        stage="",
        folder=arm,
        dataset=arm,
        bundle=None,
        results=None,
    )
    if not newest:
        return [waits]

    def done(date: str, bundle: str) -> Visit:
        results = arm / RESULTS / bundle
        there = results if results.is_dir() else None
        path = arm / BUNDLES / f"{bundle}.tauext"
        return replace(waits, date=date, state="done", reason="", bundle=path, results=there)

    return [done(date, bundle) for date, bundle in sorted(newest.items())]


def visit_of(entry: dict[str, Any], fleet: Place, run: int) -> Visit:
    """One entry of fleet.json."""

    def place(key: str) -> Place | None:
        return place_of(str(entry[key]), fleet) if entry.get(key) else None

    name, state = str(entry["name"]), str(entry["state"])
    stage, reason = "", ""
    for word, outcome in entry["stages"].items():
        if outcome["state"] in ("failed", "refused"):
            stage, reason = word, str(outcome.get("reason") or outcome["state"])
            break
    if not reason and state != "done":
        stage, reason = "", "not run to the end; the same `tauext fleet run` goes on"
    visit = Visit(
        serial=str(entry.get("serial") or name),
        name=name,
        type=str(entry.get("type") or ""),
        run=run,
        date=str(entry.get("date") or ""),
        state=state,
        reason=reason,
        stage=stage,
        folder=fleet / "arms" / name,
        dataset=place("dataset"),
        bundle=place("bundle"),
        results=place("results"),
    )
    return visit if visit.date else replace(visit, date=date_in(visit.dataset))


def date_in(dataset: Place | None) -> str:
    """Day of the first training recording; empty: its clock has none, or there is no recording."""
    if dataset is None:
        return ""
    try:
        files = load_dataset(dataset).files("train")
    except TauextError:
        return ""
    found = recording_date(files[0]) if files else None
    return found.isoformat() if found is not None else ""


# --- Content of the files of one arm at one date, as plain JSON: bundle, results, findings of the check.


def visit_facts(visit: Visit, facts: BundleFacts | None, friction_nm: np.ndarray | None, broken: str) -> dict[str, Any]:
    """Everything of one visit except its comparisons.

    Args:
        facts: None: it has no bundle.
        friction_nm: of each joint.
        broken: why its bundle cannot be read; empty where it can.
    """
    content: dict[str, Any] = {
        "name": visit.name,
        "run": visit.run,
        "date": visit.date or None,
        "state": "failed" if broken else visit.state,
        "stage": ("train" if broken else visit.stage) or None,
        "reason": broken or visit.reason or None,
        "findings": findings_of(visit.folder / "check" / "check.json"),
    }
    if visit.results is not None and visit.dataset is not None:
        content["places"] = {"results": str(visit.results), "dataset": str(visit.dataset)}
    if facts is None:
        return content
    content |= {
        "recipe": facts.recipe or None,
        "minutes": rounded(facts.minutes),
        "friction_nm": rounded(friction_nm),
        "ripple_nm": rounded(facts.ripple_nm),
        "limit_nm": rounded(facts.limit_nm),
        "near_stiction_limit_nm": rounded(facts.stiction_limit_nm),
        "promised_per_hour": rounded(facts.false_per_hour),
        "promise": facts.promise or None,
    }
    return content | results_of(visit.results)


def results_of(folder: Place | None) -> dict[str, Any]:
    """Results on free motion outside training: errors and false collisions."""
    try:
        free = load_results(folder).bundles[0].free_motion if folder is not None else None
    except ConfigError:  # one bad arm does not end a report of a hundred
        free = None
    if free is None:
        return {"error_nm": None, "hours": None, "false_collisions": None}
    return {"error_nm": rounded(free.l2_nm), "hours": rounded(free.hours), "false_collisions": free.false_collisions}


def findings_of(path: Place) -> list[dict[str, Any]]:
    """Findings of the check, without notes."""
    try:
        content = json_of(read_text(path))
    except (OSError, ValueError):  # missing or damaged
        content = None
    listed = content.get("findings") if isinstance(content, dict) else None
    kept = ("code", "severity", "joint", "evidence", "advice")
    return [
        {key: one.get(key) for key in kept}
        for one in (listed if isinstance(listed, list) else [])
        if isinstance(one, dict) and one.get("severity") in ("fault", "warning")
    ]


def rounded(value: Any) -> Any:
    """A number or a list of them with five digits; None for what is no number."""
    if value is None:
        return None
    if isinstance(value, list | tuple | np.ndarray):
        return [rounded(one) for one in value]
    return float(f"{value:.5g}") if np.isfinite(value) else None
