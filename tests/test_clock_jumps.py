"""Whatever lasts for a time ends where the stamps jump: no state outlives its time by a clock that was set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from made_arms import six_axis_tree
from made_bundles import constant_error_scale
from made_live import Keeper, ScriptedSource, samples_of
from test_expected_load import LIMITS, PICKED, knowing_bundle

from tauext import _core
from tauext._core import LoadPhase
from tauext.bundle.estimates import COLLISION, DECLARED, OK
from tauext.data.recording import Recording
from tauext.monitor.cell_file import Profile, Profiles
from tauext.monitor.changes import ChangeFinder, DeclaredChange, HiddenCollision
from tauext.monitor.control_lines import obey
from tauext.monitor.loads import Expected
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.source import CountedTime, Sample
from tauext.monitor.touch_place import PlaceChange

HOUR_NS = 3_600_000_000_000
ASKED, JUMP, HIT, END = 1000, 1100, 1900, 2300
"""Rows: a state is requested; the stamps jump; joint 2 is hit for 0.2 s, long after the warm-up."""
STANDS = 150


def back(samples: list[Sample], row: int = JUMP) -> list[Sample]:
    return [*samples[:row], *(replace(one, t_ns=one.t_ns - HOUR_NS) for one in samples[row:])]


def ahead(samples: list[Sample], row: int = JUMP) -> list[Sample]:
    return [*samples[:row], *(replace(one, t_ns=one.t_ns + HOUR_NS) for one in samples[row:])]


def stop(samples: list[Sample], row: int = JUMP) -> list[Sample]:
    """The stamps stand still for STANDS samples, and go on from there."""
    stands = [replace(one, t_ns=samples[row - 1].t_ns) for one in samples[row : row + STANDS]]
    lost_ns = samples[row + STANDS].t_ns - samples[row].t_ns
    return [*samples[:row], *stands, *(replace(one, t_ns=one.t_ns - lost_ns) for one in samples[row + STANDS :])]


JUMPS = {"an hour back": back, "an hour ahead": ahead, "standing still": stop}
EACH = [pytest.param(jump, marks=[pytest.mark.slow] * (jump != "an hour back")) for jump in JUMPS]
"""A clock that was set back is tested at once, the others with the slow tests."""


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> tuple[_core.Bundle, Recording]:
    """A bundle that knows the arm, and its motion as it picks up a load at row PICKED."""
    bundle, picks = knowing_bundle(six_axis_tree(tmp_path_factory.mktemp("arm")))
    bundle.error_scale = constant_error_scale([0.3] * 6)
    prior = _core.PriorSettings()  # friction, or there is no refit; so little that it explains nothing
    prior.terms = [_core.Term(_core.TermKind.coulomb, j, speed=0.1) for j in range(6)]
    prior.weights = (-1e-3 * np.eye(6)).ravel().tolist()
    bundle.prior = prior
    bundle.answer_reference()
    return bundle, picks


def hit(recording: Recording) -> Recording:
    tau = recording.tau.copy()
    tau[HIT : HIT + 200, 1] -= 3 * LIMITS[1]
    return replace(recording, tau=tau)


def line(text: str) -> Callable[[Loop], None]:
    def ask(loop: Loop) -> None:
        assert obey(text, loop, "test") == "ok"

    return ask


STATES: dict[str, Callable[[Loop], None]] = {
    "a declared torque of a joint": line(f"contact joint=joint2 at_most_nm={5 * LIMITS[1]} seconds=60"),
    "a declared force": line("contact frame=joint6 at_most_n=100 seconds=60"),
    "an expected load": line("expect seconds=60 at_most=3"),
    "the load that a profile expects": line("profile grasp"),
    "weighing": line("weigh"),
    "motion for a refit": lambda loop: loop.monitor.start_refit(2.0),
}


KEPT = "alarm held_alarm limit_nm contact_limit_nm declared declared_nm load_nm load_phase touch_over".split()
"""Columns of the estimates that a state changes while it lasts."""


def run(
    bundle: _core.Bundle, samples: list[Sample], asks: dict[int, Callable[[Loop], None]], **settings
) -> tuple[Loop, dict[str, np.ndarray], list[str]]:
    """The loop, its estimates and notes; asks: by row."""

    def each(verdict) -> None:
        if verdict.row in asks:
            asks[verdict.row](loop)

    ones, keeper, notes = np.ones(6), Keeper(each), list[str]()
    profiles = {"usual": Profile("usual", ones, ones), "grasp": Profile("grasp", ones, ones, None, Expected(60.0, 3.0))}
    own = LoopSettings(missing_after_s=60.0, **settings)
    loop = Loop(bundle, ScriptedSource(samples), [keeper], None, Profiles(profiles, "usual"), settings=own)
    loop.note = notes.append
    loop.monitor.reserve_refit(60.0)
    loop.run()
    rows = [verdict.estimates for verdict in keeper.verdicts]
    return loop, {key: np.concatenate([one[key] for one in rows]) for key in rows[0]}, notes


@pytest.fixture(scope="module")
def unasked(arm) -> Callable[[str], dict[str, np.ndarray]]:
    """Estimates of a loop in which nothing was requested, by jump."""
    bundle, recording = arm
    samples = samples_of(hit(recording), slice(0, END))
    return {name: run(bundle, jump(samples), {})[1] for name, jump in JUMPS.items()}.__getitem__


@pytest.mark.parametrize("jump", EACH)
@pytest.mark.parametrize("state", STATES)
def test_after_a_jump_everything_is_as_if_it_had_never_been_requested(arm, unasked, state, jump):
    bundle, recording = arm
    samples = JUMPS[jump](samples_of(hit(recording), slice(0, END)))
    loop, found, notes = run(bundle, samples, {ASKED: STATES[state]})
    plain, settled = unasked(jump), slice(HIT - 100, END)
    assert (found["health"][settled] == OK).all()
    for name in KEPT:
        np.testing.assert_array_equal(found[name][settled], plain[name][settled], err_msg=name)
    assert found["alarm"][:HIT].max() == 0 and found["alarm"][HIT + 100] == COLLISION
    monitor = loop.monitor
    assert (monitor.clock_jumps, monitor.weighing, monitor.refit_full) == (1, False, False)
    assert not any(monitor.end_contact(k) for k in range(8))
    asked = [note for note in notes if note.startswith("the time stamps jumped") and "ask for it again" in note]
    assert len(asked) == (state != "motion for a refit")  # nobody asked the loop for that


@pytest.mark.parametrize("state", STATES)
def test_what_is_requested_after_the_last_sample_begins_in_the_new_clock(arm, unasked, state):
    bundle, recording = arm
    samples = back(samples_of(hit(recording), slice(0, END)))
    loop, found, _ = run(bundle, samples, {JUMP - 1: STATES[state]})
    plain = unasked("an hour back")
    differ = any((found[name][HIT - 100 :] != plain[name][HIT - 100 :]).any() for name in KEPT)
    assert loop.monitor.weighing if state == "weighing" else differ


@pytest.mark.parametrize("jump", EACH)
def test_an_alarm_that_is_held_back_for_a_load_is_raised_by_a_jump(arm, jump):
    bundle, recording = arm
    begin = PICKED + 60  # held back, and not decided yet
    samples = JUMPS[jump](samples_of(recording, slice(0, begin + 400)), begin)
    _, found, _ = run(bundle, samples, {PICKED - 200: STATES["an expected load"]})
    assert found["load_phase"][begin - 1] == LoadPhase.deciding.value and found["alarm"][:begin].max() == 0
    assert found["alarm"][begin + 300] == COLLISION and found["load_phase"][begin + 300] == LoadPhase.none.value


@pytest.mark.parametrize("jump", EACH)
def test_an_alarm_is_acknowledged_after_so_many_samples(arm, jump):
    bundle, recording = arm
    tau = recording.tau.copy()
    tau[JUMP - 100 : JUMP - 50, 1] -= 3 * LIMITS[1]
    samples = JUMPS[jump](samples_of(replace(recording, tau=tau), slice(0, END)))
    _, found, _ = run(bundle, samples, {}, acknowledge_after_s=0.8)
    stands = np.flatnonzero(found["alarm"] == COLLISION)
    assert JUMP - 100 <= stands[0] < JUMP - 50 and abs(stands[-1] - stands[0] - 800) <= 1


@pytest.mark.parametrize("jump", EACH)
def test_what_lasts_without_a_time_outlives_a_jump(arm, jump):
    """A contact that is always on, the limits of a profile and the load have no end that a stamp could miss."""
    bundle, recording = arm

    def ask(loop: Loop) -> None:
        loop.monitor.expect_contact(_core.DeclaredContact(joint="joint2", at_most_nm=5 * LIMITS[1]))
        loop.monitor.set_limit_factors(np.full(6, 2.0), np.full(6, 2.0))

    samples = JUMPS[jump](samples_of(hit(recording), slice(0, END)))
    loop, found, _ = run(bundle, samples, {ASKED: ask})
    assert found["alarm"].max() == 0 and DECLARED[found["declared"][HIT + 100]] == "within"
    assert list(loop.monitor.limit_factors[0]) == [2.0] * 6


@pytest.mark.parametrize("jump", EACH)
def test_the_place_of_a_touch_is_found_although_the_stamps_jump_before_it_is_due(arm, jump):
    bundle, recording = arm
    tau = recording.tau.copy()
    tau[JUMP - 100 : JUMP + 300, 1] -= 3 * LIMITS[1]
    samples, keeper = JUMPS[jump](samples_of(replace(recording, tau=tau), slice(0, END))), Keeper()
    Loop(bundle, ScriptedSource(samples), [keeper], settings=LoopSettings(missing_after_s=60.0)).run()
    (first, *_) = [change.row for change in keeper.changes if isinstance(change, PlaceChange)]
    assert JUMP <= first <= JUMP + STANDS + 100


def test_events_after_a_clock_that_was_set_back_are_reported():
    """A hidden collision, and a force beyond its bounds, are reported once in APART_S: not once an hour."""
    finder = ChangeFinder()
    t_ns = np.array([HOUR_NS, HOUR_NS + 1_000_000, 5_000_000, 6_000_000])
    names = (
        "health causes cause_joint alarm alarm_joint touch declared declared_contact load_found_ns load_phase".split()
    )
    columns = {name: np.zeros(4, dtype=np.int64) for name in names}
    columns |= {name: np.zeros(4) for name in ("load_kg", "load_error_kg", *"declared_size declared_sigma".split())}
    columns |= {"declared_moment_nm": np.zeros(4), "declared_travel_m": np.zeros(4)}
    columns |= {"drift_saturated": np.zeros((4, 2), dtype=np.uint8), "near_stiction": np.zeros((4, 2), dtype=np.uint8)}
    columns |= {name: np.full((4, 2), 5.0) for name in ("tau_ext", "limit_nm", "contact_limit_nm", "sigma_nm")}
    columns |= {name: np.zeros((4, 2)) for name in ("load_nm", "declared_nm")}
    columns["health"][:] = OK
    columns["alarm"][:] = columns["held_alarm"] = np.full(4, COLLISION)
    columns["held_alarm"][1] = 0
    columns["declared"] = np.array([2, 1, 2, 1])
    found = finder.find(0, t_ns, columns)
    assert [one.row for one in found if isinstance(one, HiddenCollision)] == [2]
    beyond = DECLARED.index("beyond")
    assert [one.row for one in found if isinstance(one, DeclaredChange) and one.state == beyond] == [0, 2]


def test_time_is_counted_in_samples_where_stamps_are_no_clock():
    second = 1_000_000_000
    time = CountedTime(second // 100)
    stamps = [7 * second, 7 * second + 10_000_000, 8 * second, 8 * second - HOUR_NS, 8 * second - HOUR_NS, 9 * second]
    assert [time.step(stamp) for stamp in stamps] == [0, *(10_000_000 * k for k in (1, 100, 101, 102, 103))]
