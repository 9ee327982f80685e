"""Another bundle in a running loop: no sample is lost, health stays, and its answers are those of a plain replay."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import six_axis_tree
from made_bundles import JOINTS, pushed, watching_bundle
from made_live import Keeper, ScriptedSource, samples_of
from tauext_commission import exchange
from tauext_commission.exchange import BundleExchange, Exchanged, RecentSamples, WarmUp, why_not_exchange
from test_expected_load import MASS, PICKED, knowing_bundle

from tauext import _core
from tauext.bundle.estimates import COLLISION, NONE, OK, STALE, WARMING_UP
from tauext.errors import ConfigError
from tauext.monitor.cell_file import load_cell
from tauext.monitor.changes import AlarmChange, DriftChange, HealthChange
from tauext.monitor.control_lines import obey
from tauext.monitor.event_stream import EventStream
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.no_monitor import NO_BUNDLE, NoMonitor
from tauext.monitor.source import Block, Sample, settings_of

QUIET_S = 0.5
ARM = settings_of(watching_bundle())


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """A new monitor is quiet after half a second, not fifty or ten."""
    monkeypatch.setattr(exchange, "QUIET_S", QUIET_S)
    monkeypatch.setattr(exchange, "FIRST_QUIET_S", QUIET_S)


def bundle_of(name: str, seed: int = 3, limit_nm: float = 2.0, **drift: float) -> _core.Bundle:
    """Like watching_bundle(), with a tracker that learns within seconds; another seed is another model."""
    made = watching_bundle(hold_s=0.005, contact_nm=limit_nm / 2)
    made.name = name
    if seed != 3:
        rng = np.random.default_rng(seed)
        made.parameters = rng.normal(0, 0.4, made.shape.parameter_count).astype(np.float32).tolist()
        made.answer_reference()
    made.sliding_limit_nm, made.near_stiction_limit_nm = [limit_nm] * 2, [1.5 * limit_nm] * 2
    settings = made.drift
    settings.time_constant_s, settings.size_nm, settings.rate_share_per_s = 2.0, [2.0] * 2, 0.5
    settings.freeze_share, settings.freeze_s = 0.9, 0.1
    made.drift = settings
    return made


@dataclass
class Swap:
    """Stands in a script: no sample comes until this bundle is in the loop, or stays out."""

    path: Path
    loop: Loop | None = None
    answer: str | None = None
    old: object = None
    wait_s: float = 8.0
    until: float = field(default=0.0, init=False)

    def __call__(self) -> bool:
        if self.old is None:
            self.old, self.until = self.loop.monitor, time.monotonic() + self.wait_s
            self.loop.supply.bring(self.path, self.done)
        return self.answer is not None or time.monotonic() > self.until

    def done(self, answer: str) -> None:
        self.answer = answer


def saved(bundle: _core.Bundle, folder: Path) -> Path:
    path = folder / f"{bundle.name}.tauext"
    bundle.save(str(path))
    return path


def loop_of(bundle: _core.Bundle | None, source, sinks: Sequence = (), profiles=None, arm=ARM, **settings) -> Loop:
    """A loop whose bundle can be exchanged; `exchanges` holds every exchange."""
    given = LoopSettings(**({"missing_after_s": 60.0} | settings))
    loop = Loop(bundle, source, sinks, None, profiles, settings=given, arm=arm)
    loop.exchanges = []
    BundleExchange(loop, arm, loop.exchanges.append)
    return loop


def looped(
    bundle: _core.Bundle | None,
    script: Sequence[Sample | Callable[[], bool]],
    sinks: Sequence = (),
    each: Callable = lambda verdict: None,
    profiles=None,
    **settings,
) -> tuple[Loop, Keeper, list[Exchanged]]:
    keeper = Keeper(each)
    loop = loop_of(bundle, Warm(script), [keeper, *sinks], profiles, **settings)
    for one in script:
        if isinstance(one, Swap):
            one.loop = loop
    loop.run()
    return loop, keeper, loop.exchanges


def columns_of(samples: Sequence[Sample]) -> list[np.ndarray]:
    return [np.array([getattr(one, name) for one in samples]) for name in ("t_ns", "q", "dq", "tau")]


class Warm(ScriptedSource):
    """Gives the script's samples as they are, with their temperatures."""

    def next_sample(self, timeout_s: float) -> Sample | None:
        first = self.script[0] if self.script else None
        if isinstance(first, Sample) and first.temperature is not None:
            return replace(self.script.pop(0), received_ns=time.monotonic_ns())
        return super().next_sample(min(timeout_s, 0.005))


def assert_same(verdicts: Sequence, estimates: dict[str, np.ndarray]) -> None:
    for name, values in estimates.items():
        found = np.concatenate([one.estimates[name] for one in verdicts])
        np.testing.assert_array_equal(found, values, err_msg=name)


def still(samples: list[Sample], begin: int, end: int) -> list[Sample]:
    """These samples, the arm at rest between two rows."""
    rest = samples[begin].q
    count = end - begin
    q = [rest + 1e-6 * np.sin([k, k + 1.0]) for k in range(count)]
    moved = [replace(one, q=q[k], dq=np.zeros(2)) for k, one in enumerate(samples[begin:end])]
    return samples[:begin] + moved + samples[end:]


def with_temperature(samples: list[Sample]) -> list[Sample]:
    return [replace(one, temperature=np.array([30 + 1e-3 * k, np.nan])) for k, one in enumerate(samples)]


PHASES: dict[str, tuple[dict, Callable[[list[Sample]], list[Sample]], dict]] = {
    "motion": ({}, lambda samples: samples, {}),
    "rest": ({}, lambda samples: still(samples, 2000, 3500), {}),
    "a latched alarm": ({"pushes": ((2.0, 0, 12.0),)}, lambda samples: samples, {}),
    "a contact": ({"pushes": ((2.95, 0, 1.6),)}, lambda samples: samples, {}),
    "lost samples": ({}, lambda samples: samples[:1200] + samples[1204:1500] + samples[1600:], {}),
    "temperatures": ({}, with_temperature, {}),
    "the network's own rate": ({}, lambda samples: samples, {"own_rate": True}),
}


QUICK = ("motion", "a latched alarm", "lost samples")


@pytest.mark.parametrize("model", [3, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize("phase", [pytest.param(one, marks=[pytest.mark.slow] * (one not in QUICK)) for one in PHASES])
def test_the_new_bundle_answers_as_one_that_replayed_the_same_seconds(phase, model, tmp_path, monkeypatch):
    monkeypatch.setattr(exchange, "RECENT_S", 2.0)  # what was learned before comes by the mark alone
    pushes, changed, settings = PHASES[phase]
    samples = changed(samples_of(pushed(seconds=5, **({"pushes": ()} | pushes))))
    swap = Swap(saved(bundle_of("new", model, 2.5), tmp_path))
    script = [*samples[:3000], swap, *samples[3000:]]
    loop, keeper, (one,) = looped(bundle_of("old"), script, **settings)
    assert swap.answer == "" and (one.bundle, one.replaced, one.row, one.alarms) == ("new", "old", 3000, 0)
    assert loop.monitor is not swap.old and len(keeper.verdicts) == len(samples) == loop.samples
    assert [change for change in keeper.changes if isinstance(change, HealthChange)][0].health == OK
    healths = [one.estimates["health"][0] for one in keeper.verdicts]
    swapped = healths[one.row - 1 : one.row + 1]
    assert swapped == [OK, OK]
    # from the same carried state over the same seconds, to the last bit
    fresh = _core.Monitor(_core.Bundle.load(str(swap.path)), settings.get("own_rate", False))
    fresh.carry(one.carried)
    first = one.row - one.replayed

    def repeat(begin: int, end: int) -> dict[str, np.ndarray]:
        rows = samples[begin:end]
        warm = np.array([s.temperature for s in rows]) if rows[0].temperature is not None else None
        return fresh.run(*columns_of(rows), None, warm)

    repeat(first, one.row)
    fresh.carry_alarm(one.left)
    assert_same(keeper.verdicts[one.row :], repeat(one.row, len(samples)))
    drift = keeper.verdicts[one.row].estimates["drift"]
    learned = _core.Monitor(_core.Bundle.load(str(swap.path)), settings.get("own_rate", False))
    fresh, carried_on = learned, np.abs(drift).max()
    repeat(first, one.row)
    if model == 3 and phase == "motion":
        assert np.abs(drift - repeat(one.row, one.row + 1)["drift"]).max() > 0.1 * carried_on > 0
    # the alarm goes on, and is told of once
    alarms = [change for change in keeper.changes if isinstance(change, AlarmChange) and change.was == NONE]
    assert len(alarms) == len(pushes) and loop.alarms == len(pushes)
    if phase == "a latched alarm":
        assert all(v.estimates["alarm"][0] == COLLISION and v.alarm_number == 1 for v in keeper.verdicts[one.row :])
        assert loop.monitor.last.alarm_t_ns == swap.old.last.alarm_t_ns


def test_a_successor_repeats_missing_samples_and_what_was_done_at_their_row():
    recording, later = pushed(seconds=3, pushes=()), pushed(seconds=4, pushes=())
    ring, plain = RecentSamples(2, 1_000_000), _core.Monitor(bundle_of("b"))
    rows = list(zip(*signals_of(recording), strict=True))
    for k, (t_ns, q, dq, tau) in enumerate(rows):
        if k in (1000, 2500):
            ring.act(lambda monitor: monitor.resume())
            plain.resume()
        if 1500 <= k < 1503 or 2000 <= k < 2040:
            ring.miss(int(t_ns))
            if k < 2000 + exchange.SILENT_ROWS:
                plain.run_missing(int(t_ns))
            continue
        ring.add(Block.of([Sample(int(t_ns), q, dq, tau, 0)]), np.zeros(1))
        plain.run(np.array([t_ns]), q[None], dq[None], tau[None])
    successor = WarmUp(bundle_of("b"), ring, False, None, QUIET_S)
    while successor.follow(64):
        pass
    after = [signal[3000:] for signal in signals_of(later)]
    one, other = successor.monitor.run(*after), plain.run(*after)
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    assert successor.monitor.restarts == plain.restarts == 1


def test_the_same_bundle_changes_next_to_nothing(tmp_path):
    old = bundle_of("old")
    samples = samples_of(pushed(seconds=5, pushes=((2.0, 0, 12.0),)))
    swap = Swap(saved(old, tmp_path))
    _, keeper, _ = looped(old, [*samples[:4000], swap, *samples[4000:]])
    plain = _core.Monitor(old).run(*columns_of(samples))
    assert swap.answer == ""
    for name in ("health", "causes", "alarm", "alarm_joint", "touch", "limit_nm"):
        np.testing.assert_array_equal(np.concatenate([v.estimates[name] for v in keeper.verdicts]), plain[name])
    tau_ext = np.concatenate([v.estimates["tau_ext"] for v in keeper.verdicts])
    assert np.nanmax(np.abs(tau_ext - plain["tau_ext"])) < 0.02


@pytest.mark.slow
def test_a_loop_that_never_stops_is_exchanged_again_and_again(tmp_path):
    """Samples come as fast as they are taken; each bundle asks for the next."""
    paths = [saved(bundle_of(name, seed), tmp_path) for name, seed in (("even", 3), ("odd", 5))]
    answers: list[str] = []

    def again(answer: str | None = None) -> None:
        if answer is not None:
            answers.append(answer)
        if len(answers) < 8:
            loop.supply.bring(paths[len(answers) % 2], again)
        else:
            loop.stop("the test")

    samples = samples_of(pushed(seconds=120, pushes=()))
    keeper = Keeper(lambda verdict: verdict.row == 2000 and again())
    loop = loop_of(bundle_of("old"), ScriptedSource(samples), [keeper])
    loop.run()
    assert answers == [""] * 8, answers
    assert [verdict.row for verdict in keeper.verdicts] == list(range(loop.samples))
    assert len([change for change in keeper.changes if isinstance(change, HealthChange)]) == 1  # warm at the start


def test_a_bundle_that_is_not_quiet_stays_out(tmp_path, monkeypatch):
    monkeypatch.setattr(exchange, "GIVE_UP_S", 3.0)
    low = bundle_of("low", limit_nm=0.05)
    samples = samples_of(pushed(seconds=6, pushes=()))
    swap = Swap(saved(low, tmp_path))
    loop, keeper, exchanged = looped(bundle_of("old"), [*samples[:4000], swap, *samples[4000:]])
    assert "stays out" in swap.answer and "alarms that the active bundle did not raise in 3 s" in swap.answer
    assert not exchanged and loop.monitor is swap.old and not loop.alarms


def test_a_newer_bundle_replaces_one_that_waits_and_one_that_fails_stops_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(exchange, "GIVE_UP_S", 1e9)
    low, good = saved(bundle_of("low", limit_nm=0.05), tmp_path), saved(bundle_of("good"), tmp_path)
    told: list[str] = []

    def fails(answer: str) -> None:
        told.append(answer)
        raise ValueError("of the caller")

    followed: list[tuple[str, _core.Monitor]] = []

    class Failing(Keeper):
        def follow(self, bundle, monitor):
            followed.append((bundle.name, monitor))
            if len(followed) > 1:
                raise RuntimeError("a sink's")

    samples = samples_of(pushed(seconds=6, pushes=()))
    swap = Swap(good)
    asked = [low, Path("\udcff"), Path("."), low]
    script = [*samples[:4000], lambda: all(not loop.supply.bring(path, fails) for path in asked), swap, *samples[4000:]]
    failing = Failing()
    keeper = Keeper()
    loop = swap.loop = loop_of(bundle_of("old"), ScriptedSource(script), [keeper, failing])
    notes: list[str] = []
    loop.note = notes.append
    loop.run()
    assert swap.answer == "" and loop.monitor is not swap.old and len(keeper.verdicts) == 6000
    assert len(told) == 4 and told[0] == told[3] == "a newer bundle, or the end of the loop, came first"
    assert "is a folder" in told[2]
    assert sum("ValueError: of the caller" in note for note in notes) == 4
    assert failing not in loop.sinks and any("Failing is left out" in note for note in notes)
    assert followed == [("old", swap.old), ("good", loop.monitor)]


def test_reactions_and_profiles_that_the_bundle_cannot_serve_keep_it_out(tmp_path):
    other = saved(bundle_of("other"), tmp_path)
    rule = SimpleNamespace(name="near the hand", links=("elbow",), newtons_over=None)
    for settings, why in (({"wrench": "tool0"}, "wrench = 'tool0'"), ({}, "reaction 'near the hand': the place")):
        samples = samples_of(pushed(seconds=2, pushes=()))
        swap = Swap(other)
        loop = swap.loop = loop_of(None, ScriptedSource([*samples, swap]), **settings)
        loop._reactions = SimpleNamespace(threads=[SimpleNamespace(reaction=rule)], end=lambda: None)
        loop.run()
        assert why in swap.answer and isinstance(loop.monitor, NoMonitor)
    (tmp_path / "cell.toml").write_text(
        "[profiles]\nlowest = 0.5\nhighest = 3.0\n[profiles.usual]\nload = { mass = 1.0, com = [0, 0, 0] }\n"
    )
    with pytest.raises(ConfigError, match="profile usual: nothing is monitored yet"):
        Loop(None, ScriptedSource([]), profiles=load_cell(tmp_path / "cell.toml", JOINTS).profiles, arm=ARM)


def test_an_alarm_keeps_its_places_and_drift_is_reported_anew():
    recording = pushed()
    monitor = _core.Monitor(bundle_of("old"))
    row = monitor.run(*(signal[:1] for signal in signals_of(recording)))
    used: list[str] = []

    def places(name: str) -> SimpleNamespace:
        return SimpleNamespace(find=lambda *signals: used.append(name) or [])

    events = EventStream(monitor, places("old"))
    saturated = row | {"drift_saturated": np.ones((1, 2), dtype=np.uint8)}

    def find(estimates: dict, alarm: int) -> int:
        now = estimates | {"alarm": np.full(1, alarm, dtype=np.uint8)}
        found = events.find(0, recording.t_ns[:1], now, recording.q[:1], recording.dq[:1])
        return sum(isinstance(change, DriftChange) for change in found)

    assert [find(saturated, COLLISION), find(saturated, COLLISION)] == [2, 0]
    events.exchange(_core.Monitor(bundle_of("new")), places("new"))
    assert [find(saturated, COLLISION), find(saturated, NONE), find(row, NONE)] == [2, 0, 0]
    assert used == ["old", "old", "old", "new", "new"]


def test_before_any_bundle_nothing_is_monitored_and_the_first_one_takes_over(tmp_path):
    class Following(Keeper):
        followed = ()

        def open(self, joints, control):
            super().open(joints, control)
            lines = ("load mass=1 com=0,0,0", "weigh", "expect seconds=1 at_most=1")
            self.refused = [obey(line, control, "x") for line in lines]

        def follow(self, bundle, monitor):
            self.followed = [*self.followed, (bundle.name, monitor)]

    sink = Following()
    (tmp_path / "cell.toml").write_text("[profiles]\nlowest = 0.5\nhighest = 3.0\n[profiles.usual]\ncollision = 2.0\n")
    profiles = load_cell(tmp_path / "cell.toml", JOINTS).profiles
    samples = samples_of(pushed(seconds=4, pushes=((1.0, 0, 12.0), (3.0, 0, 12.0))))
    swap = Swap(saved(bundle_of("first"), tmp_path))
    script = [*samples[:2800], swap, *samples[2800:]]
    loop, keeper, (one,) = looped(None, script, [sink], profiles=profiles)
    assert all(answer == f"error: {NO_BUNDLE}" for answer in sink.refused) and len(sink.refused) == 3
    assert swap.answer == "" and one.replaced == "" and one.carried == one.left == b""
    assert one.replayed == 2800 and one.alarms > 0
    assert sink.followed == [("first", loop.monitor)]
    assert loop.monitor.limit_factors == ([2.0, 2.0], [1.0, 1.0])
    assert loop._changes.monitor is loop.monitor and loop._changes._places is not None
    before, after = keeper.verdicts[:2800], keeper.verdicts[2800:]
    assert all(v.estimates["health"][0] == WARMING_UP and np.isnan(v.estimates["tau_ext"]).all() for v in before)
    assert all(v.estimates["health"][0] == OK for v in after)
    assert before[-1].alarm_number == after[0].alarm_number == 0 and after[-1].alarm_number == loop.alarms == 1


def test_no_monitor_answers_with_the_same_columns():
    recording, none = pushed(), NoMonitor(ARM)
    real = _core.Monitor(watching_bundle()).run(*(signal[:1] for signal in signals_of(recording)))
    for row in (none.run(np.zeros(1)), none.run_missing(0)):
        assert {k: (v.dtype, v.shape) for k, v in row.items()} == {k: (v.dtype, v.shape) for k, v in real.items()}
    assert none.run_missing(0)["health"][0] == STALE
    assert {name for name in dir(none) if not name.startswith("_")} <= set(dir(_core.Monitor))


def signals_of(recording) -> tuple[np.ndarray, ...]:
    return recording.t_ns, recording.q, recording.dq, recording.tau


def test_a_bundle_of_another_arm_is_refused(tmp_path):
    other = bundle_of("other")
    links = other.links
    links[0].joint_name = "hip"
    other.links = links
    foreign = saved(other, tmp_path)
    damaged = tmp_path / "damaged.tauext"
    damaged.write_bytes(foreign.read_bytes()[:-9])
    swaps = [Swap(foreign), Swap(damaged), Swap(tmp_path / "missing.tauext")]
    samples = samples_of(pushed(seconds=2, pushes=()))
    _, keeper, exchanged = looped(bundle_of("old"), [*samples[:1500], *swaps, *samples[1500:]])
    assert not exchanged and len(keeper.verdicts) == 2000
    assert swaps[0].answer.startswith("bundle other is for another arm: its joints ('hip', 'elbow') must be")
    assert "truncated" in swaps[1].answer and "cannot be opened" in swaps[2].answer
    with pytest.raises(ConfigError, match="for another arm"):
        loop_of(other, ScriptedSource([]))
    with pytest.raises(ConfigError, match="needs a bundle, or an arm"):
        Loop(None, ScriptedSource([]))
    for change, why in (
        ({"period_ns": 2_000_000}, "sample period in ns 1000000 must be 2000000"),
        ({"torque_units": ("A", "A")}, "units of the torque"),
        ({"torque_timing": "instant"}, "timing of the torque held must be instant"),
        ({"servo": _core.ServoSettings(_core.TorqueFrom.duty, [_core.ServoConstants()] * 2)}, "settings of the servos"),
    ):
        assert why in why_not_exchange(bundle_of("old"), replace(ARM, **change))


@pytest.mark.slow
def test_a_load_is_carried_and_an_expected_one_delays_the_exchange(tmp_path):
    bundle, picks = knowing_bundle(six_axis_tree(tmp_path))
    new = _core.Bundle.from_bytes(bundle.to_bytes())
    new.name = "new"
    samples = samples_of(picks)
    early, swap = Swap(saved(new, tmp_path), wait_s=0.5), Swap(saved(new, tmp_path))
    lines = {
        PICKED - 200: "expect seconds=2 at_most=3",
        5700: "weigh",
        5750: "weigh stop",
        5800: "load mass=0.4 com=0,0,0.05",
    }
    keeper = Keeper(lambda verdict: verdict.row in lines and obey(lines[verdict.row], keeper.control, "a line"))
    expired = time.monotonic() + 30.0

    def arrived() -> bool:  # the loop takes samples far faster than in real time
        return early.answer is not None or time.monotonic() > expired

    script = [*samples[:PICKED], early, *samples[PICKED:5400], arrived, *samples[5400:5500], swap, *samples[5500:]]
    loop = loop_of(bundle, ScriptedSource(script), [keeper], arm=settings_of(bundle))
    exchanged = loop.exchanges
    early.loop = swap.loop = loop
    loop.run()
    assert early.until and 2900 < exchanged[0].row <= 5500 and early.answer == swap.answer == ""
    assert exchanged[1].row == 5500
    assert swap.old.load.mass == pytest.approx(MASS, rel=0.05) and loop.monitor.load.mass == 0.4
    assert all(v.estimates["alarm"][0] == NONE for v in keeper.verdicts[:5800])
    assert np.abs(keeper.verdicts[5799].estimates["tau_ext"]).max() < 1.0
    # as long as it is weighed, the loop says no
    loop.monitor.start_weighing()
    successor = WarmUp(new, loop.supply.recent, False, None, QUIET_S)
    successor.row = loop.supply.recent.count
    assert successor.finish(loop.monitor) == "a payload is expected or being identified"


@pytest.fixture(scope="module")
def left() -> tuple[list[Sample], bytes]:
    """Samples, and what a loop carries over that they end in a latched alarm."""
    samples = samples_of(pushed(seconds=5, pushes=((3.0, 0, 12.0),)))
    first, _, _ = looped(bundle_of("old"), samples)
    carried = first.monitor.carried()
    assert len(first.supply.carried) == len(carried) and first.monitor.last.alarm == _core.Alarm.collision
    return samples, carried


def test_a_new_loop_goes_on_from_what_was_carried(left):
    (samples, carried), keeper = left, Keeper()
    loop = loop_of(bundle_of("old"), ScriptedSource(samples[:2000]), [keeper])
    assert loop.start_from(carried, 17) == ""
    loop.run()
    assert loop.alarms == 17 and all(v.alarm_number == 17 for v in keeper.verdicts)
    assert not [c for c in keeper.changes if isinstance(c, AlarmChange)]
    drift = _core.Monitor(bundle_of("old")).run(*columns_of(samples[:600]))["drift"]
    there = np.concatenate([v.estimates["drift"] for v in keeper.verdicts[:600]])
    assert np.abs(there[599]).max() > 5 * np.abs(drift[599]).max() > 0  # what had been learned
    assert "damaged" in loop.start_from(b"x" * len(carried), 0)
    assert loop_of(None, ScriptedSource([])).start_from(carried, 3) == NO_BUNDLE


def test_an_answered_alarm_that_is_carried_over_ends_once_nothing_touches_the_arm(left):
    (samples, carried), keeper = left, Keeper()
    loop = loop_of(bundle_of("old"), ScriptedSource(samples[:2000]), [keeper])
    assert loop.start_from(carried, 17, True) == ""
    loop.run()
    healthy = next(v.row for v in keeper.verdicts if v.estimates["health"][0] == OK)
    ended = [c.row for c in keeper.changes if isinstance(c, AlarmChange) and c.acknowledged]
    assert ended == [healthy + 50] and loop.alarms == 17


def test_a_ring_keeps_the_last_minute_and_no_long_silence():
    ring = RecentSamples(1, 100_000_000)  # 10 Hz: 600 rows and a second
    one = np.ones(1)
    for k in range(700):
        if k % 10 == 0:
            ring.mark(b"%d" % k, k // 400)
        warm = one if k == 695 else None
        ring.add(Block.of([Sample(k, k * one, one, one, 0, warm)]), np.array([k % 2]))
    assert ring.start(0) == ring.start(7) == (100, b"100") and ring.carried == b"690"
    assert ring.start(1) == (400, b"400")  # of the same model
    assert ring.since(5, 10) is None
    piece = ring.since(690, 100)
    assert piece.t_ns.tolist() == list(range(690, 700)) and piece.q[:, 0].tolist() == piece.t_ns.tolist()
    assert np.isfinite(piece.temperature[:, 0]).tolist() == [k == 695 for k in range(690, 700)]
    assert piece.held.tolist() == [k % 2 for k in range(690, 700)]
    for k in range(1000):
        ring.miss(700 + k)
    assert ring.count == 700 + exchange.SILENT_ROWS and not ring.since(700, 100).came.any()
    assert RecentSamples(1, 1_000_000).start(0) == (0, b"")


def test_only_the_answered_alarm_is_settled_if_it_stands():
    said: dict[str, str] = {}
    answered = {100: [1], 2700: [2, 0], 3000: [1], 4700: [1, 2]}

    def settle(verdict):
        for number in answered.get(verdict.row, ()):
            keeper.control.settle(number, "touched, by a test")
        if verdict.row == 2700:
            for line in ("touched", "touched 0", "touched x", "learn yes", "learn maybe"):
                said[line] = obey(line, keeper.control, "a line")

    keeper = Keeper(settle)
    samples = samples_of(pushed(seconds=5, pushes=((2.0, 0, 12.0), (4.0, 1, 12.0))))
    loop = Loop(bundle_of("b"), ScriptedSource(samples), [keeper], settings=LoopSettings(missing_after_s=60.0))
    loop.run()
    ended = [c.row for c in keeper.changes if isinstance(c, AlarmChange) and c.acknowledged]
    assert ended == [3001, 4701] and loop.alarms == 2
    assert said["touched"] == "error: touched: answers are kept by `tauext commission` only"
    assert said["learn yes"] == "error: learn: answers are kept by `tauext commission` only"
    assert "must be the number of an alarm" in said["touched x"] == said["touched 0"].replace("'0'", "'x'")
    assert said["learn maybe"].startswith("error: 'learn maybe' must be")
    plain = Loop(bundle_of("b"), ScriptedSource([]), [Keeper()])
    assert obey("touched", plain, "x") == "error: touched: answers are kept by `tauext commission` only"
    assert obey("sim push j1", plain, "x") == "error: 'push j1': source script takes no commands; sim:ARM does"
