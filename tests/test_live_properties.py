"""Properties of live streams by source: turns that wrap or are lost, clocks, single bad samples.

Each has the estimates of the clean stream, or one cause.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from made_bundles import JOINTS, damaged, pushed, watching_bundle
from made_live import Keeper, Replayed, ScriptedSource, samples_of

from tauext import _core
from tauext.bundle.estimates import FAULT, OK, WARMING_UP
from tauext.cli import main
from tauext.data.recording import TURN, unwrapped
from tauext.data.recording_file import save_recording
from tauext.fit.coverage import Motion, seen
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.source import Block, Sample, SourceSettings, settings_of
from tauext.monitor.turns import Turns, trained_positions
from tauext.sources.franka import FrankaSource
from tauext.sources.ur import UrSource

OFFSET = np.array([2.8, -0.5])
"""The shoulder crosses pi, the elbow 0."""


def swinging(seconds: float = 3.0):
    made = pushed(seconds=seconds)
    return replace(made, q=made.q + OFFSET)


def at_pi(q: np.ndarray) -> np.ndarray:
    return (q + math.pi) % TURN - math.pi


def at_each_end(q: np.ndarray) -> np.ndarray:
    """The first joint wraps at +-pi, the others at 0 and 2 pi."""
    return np.where(np.arange(q.shape[1]) == 0, at_pi(q), q % TURN)


def restarted(q: np.ndarray) -> np.ndarray:
    """The encoder of the last joint loses two turns, then one comes back."""
    lost = np.zeros(q.shape)
    lost[1500:, -1], lost[2200:, -1] = 2 * TURN, TURN
    return q - lost


def elsewhere(q: np.ndarray) -> np.ndarray:
    """Every position begins in another turn than training."""
    return at_each_end(q) - [2 * TURN, TURN]


HOW = [at_each_end, restarted, elsewhere]


def turning_bundle():
    """The network sees positions, so that its answer depends on their turn."""
    made = watching_bundle()
    clean = swinging()
    made.input_factors = [*(1 / np.abs(clean.q).max(axis=0)), 0.5, 0.5]
    made.coverage = seen(Motion.of([clean], 10), np.zeros(2, bool), np.array([2, 2]), 0)
    made.possible_speed_rad_s = [10.0, 10.0]
    first = slice(0, 1000)
    made.set_reference(*(np.ascontiguousarray(a[first]) for a in (clean.t_ns, clean.q, clean.dq, clean.tau)))
    return made


@pytest.fixture(scope="module")
def bundle():
    return turning_bundle()


def expect_clean(bundle, keeper, clean) -> None:
    """Every sample has the clean position and estimate, and is healthy once warm."""
    # A busy machine reads on behind the recording's end.
    verdicts = [one for one in keeper.verdicts if one.sample is not None and one.t_ns <= clean.t_ns[-1]]
    row = {t_ns: k for k, t_ns in enumerate(clean.t_ns.tolist())}
    rows = [row[one.t_ns] for one in verdicts]
    assert np.ptp(rows) > 0.6 * len(clean.t_ns)
    np.testing.assert_allclose([one.sample.q for one in verdicts], clean.q[rows], atol=1e-12)
    signals = (np.ascontiguousarray(signal[rows]) for signal in (clean.t_ns, clean.q, clean.dq, clean.tau))
    expected = _core.Monitor(bundle).run(*signals)
    for name in ("tau_ext", "residual", "network", "limit_nm"):
        said = np.concatenate([one.estimates[name] for one in verdicts])
        np.testing.assert_allclose(said, expected[name], rtol=0, atol=1e-9, err_msg=name)
    health = np.concatenate([one.estimates["health"] for one in verdicts])
    np.testing.assert_array_equal(health, expected["health"])
    assert set(health) <= {WARMING_UP, OK} and (health == OK).mean() > 0.8
    assert np.nanmax(np.abs(expected["network"])) > 0.1


def run_loop(bundle, source, last_ns: int | None = None, **more) -> tuple[Keeper, list[str]]:
    def each(verdict):
        if last_ns is not None and verdict.t_ns >= last_ns:
            keeper.control.stop("test")

    keeper, notes = Keeper(each), list[str]()
    loop = Loop(bundle, source, [keeper], settings=LoopSettings(missing_after_s=60.0), **more)
    loop.note = notes.append
    loop.run()
    return keeper, [note for note in notes if "position of" in note]


class Streamed:
    """Packets of a robot's library with the rows of a recording; the last one repeats."""

    def __init__(self, arm, made):
        arm.joints, arm.period_s = 2, 1e-3
        self._signals = (None, made.q, made.dq, made.tau, np.zeros_like(made.q))
        arm.signal = lambda which: self._signals[which][min(arm.number, len(made.q) - 1)].tolist()


def source_of(kind: str, made, request, tmp_path):
    """The live source of this kind with these samples, and what the loop calls their first stamp."""
    if kind == "script":
        return ScriptedSource(samples_of(made))
    if kind == "replay":
        return Replayed(made, None)
    arm = request.getfixturevalue(kind)
    Streamed(arm, made)
    if kind == "franka":
        source = FrankaSource("h")
    else:
        (tmp_path / "constants.toml").write_text("[nm_per_ampere]\nshoulder = 1.0\nelbow = 1.0\n")
        source = UrSource("h", tmp_path / "constants.toml")
    source.robot_joints = 2
    return source


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize(
    "kind", ["script", *(pytest.param(k, marks=pytest.mark.slow) for k in ("replay", "ur", "franka"))]
)
def test_estimates_are_those_of_continuous_positions(kind, how, bundle, request, tmp_path):
    clean = swinging()
    if kind in ("ur", "franka"):  # their clocks begin at 100 s
        clean = replace(clean, t_ns=100_000_000_000 + np.arange(clean.samples) * 1_000_000)
    wrapped = replace(clean, q=how(clean.q))
    source = source_of(kind, wrapped, request, tmp_path)
    keeper, notes = run_loop(bundle, source, int(clean.t_ns[-10]))
    expect_clean(bundle, keeper, clean)
    if how is at_each_end:
        expected = [f"position of {joint} jumped by a whole turn: unwrapped from here on" for joint in JOINTS]
        assert sorted(notes) == sorted(expected)[: len(notes)] and notes


SECOND = 10**9
CLOCKS = {
    "stands still": (lambda t, k: t - 1_000_000 * max(0, k - 1500), {"late sample"}),
    "stands still for a second": (lambda t, k: t - 1_000_000 * max(0, k - 1500) * (k < 2500), {"late sample", "gap"}),
    "set back by an hour": (lambda t, k: t - 3600 * SECOND * (k >= 1500), {"time backwards"}),
    "set back by 5 ms": (lambda t, k: t - 5_000_000 * (k >= 1500), {"late sample"}),
    "set ahead by an hour": (lambda t, k: t + 3600 * SECOND * (k >= 1500), {"gap"}),
    "half the rate": (lambda t, k: t + 1_000_000 * k, {"wrong rate"}),
}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("kind", ["script", pytest.param("franka", marks=pytest.mark.slow)])
def test_a_wrong_clock_is_reported_by_its_cause_and_what_is_right_again_is_healthy(
    kind, clock, bundle, request, tmp_path
):
    change, causes = CLOCKS[clock]
    made = swinging(8.0)  # twice what is run: on a busy machine packets are lost, and the last one repeats
    source, count = source_of(kind, made, request, tmp_path), [0]
    read = source.next_sample if kind == "script" else source.read

    def changed(*timeout):
        if (sample := read(*timeout)) is None:
            return None
        count[0] += 1
        return replace(sample, t_ns=change(sample.t_ns, count[0]))

    setattr(source, "next_sample" if kind == "script" else "read", changed)
    keeper = Keeper(lambda verdict: verdict.row >= 3990 and keeper.control.stop("test"))
    Loop(bundle, source, [keeper], settings=LoopSettings(missing_after_s=60.0)).run()
    said = [one.estimates for one in keeper.verdicts]
    assert {name for one in said for name in _core.cause_names(int(one["causes"][0]))} == causes
    lasting = clock in ("stands still", "half the rate")
    assert (said[-1]["health"][0] == OK) is not lasting
    assert said[1400]["health"][0] == OK or clock == "half the rate"


def test_a_run_of_a_recording_takes_turns_out_as_the_loop_does(bundle, tmp_path, capsys):
    clean = swinging()
    bundle.save(str(tmp_path / "arm.tauext"))
    said = []
    for how in (lambda q: q, at_each_end, elsewhere):
        save_recording(replace(clean, q=how(clean.q)), tmp_path / "log.parquet")
        assert main(["run", str(tmp_path / "arm.tauext"), str(tmp_path / "log.parquet")]) == 0
        lines = capsys.readouterr().out.splitlines()
        said.append([line for line in lines if "each" not in line and "position of" not in line])
    assert any("COLLISION" in line.upper() for line in said[0])
    assert said[1] == said[0] and said[2] == said[0]


def test_rows_are_what_samples_are():
    """Any mixture of faults: both ways agree to the last bit."""
    rng = np.random.default_rng(0)
    arm = SourceSettings(("a", "b", "c"), 10_000_000, ("N m", "N m", "N"))
    for _ in range(20):
        t_ns = np.cumsum(
            rng.choice([10_000_000, 10_000_000, 30_000_000, 3_000_000_000], 400, p=[0.9, 0.05, 0.04, 0.01])
        )
        q = np.cumsum(rng.normal(0, 0.05, (400, 3)), axis=0) + rng.choice([0, TURN, 5.0], (400, 3), p=[0.9, 0.05, 0.05])
        q = np.where(rng.random((400, 3)) < 0.01, np.nan, at_each_end(q))
        goals = q + rng.normal(0, 0.1, q.shape)
        one, other = Turns(arm), Turns(arm)
        samples = samples_of(damaged(pushed(seconds=0.4), t_ns=t_ns, q=q, dq=q, tau=q))
        blocks = [Block.of([replace(sample, q_des=goal)]) for sample, goal in zip(samples, goals, strict=True)]
        made = [one.made(block) for block in blocks]
        rows, to = zip(
            *(other.rows(t_ns[part], q[part], goals[part]) for part in (slice(150), slice(150, 400))), strict=True
        )
        np.testing.assert_array_equal(np.concatenate(rows), [block.q[0] for block in made])
        np.testing.assert_array_equal(np.concatenate(to), [block.q_des[0] for block in made])
        assert one.notes() == other.notes()
        np.testing.assert_array_equal(np.concatenate(rows)[:, 2], q[:, 2])  # slides


@pytest.mark.parametrize("rate_hz", [10, 20, 50, 125, 500, 1000])
def test_a_wrapped_motion_is_unwrapped_at_any_rate_as_import_does(rate_hz):
    """Three joints turn over several turns at up to 3 rad/s; samples are lost, the encoder has noise."""
    rng = np.random.default_rng(rate_hz)
    t = np.arange(0, 40, 1 / rate_hz)
    t = t[rng.random(len(t)) > 0.05]
    clean = np.stack([3 * t, 7 * np.sin(0.4 * t), 2 + 1.5 * np.sin(2 * t)], axis=1) + rng.normal(0, 1e-3, (len(t), 3))
    turns = Turns(SourceSettings(("a", "b", "c"), round(1e9 / rate_hz)))
    q, _ = turns.rows(np.round(t * 1e9).astype(np.int64), at_pi(clean))
    np.testing.assert_allclose(q - q[0], clean - clean[0], atol=1e-9)
    if rate_hz >= 50:
        np.testing.assert_array_equal(q, unwrapped(at_pi(clean))[0])
    assert len(turns.notes()) == 3


def test_jumps_that_are_no_turns_stay_and_are_reported(bundle):
    """A glitch of 5 rad, a NaN, and a huge number are faults as before, and spoil no later sample."""
    clean = swinging()
    wrapped = at_each_end(clean.q)
    for row, value in ((1000, 5.0), (1400, math.nan), (1800, 1e300)):
        wrapped[row, 0] += value
    made = damaged(clean, q=wrapped)
    keeper, _ = run_loop(bundle, ScriptedSource(samples_of(made)))
    q = np.array([one.sample.q for one in keeper.verdicts])
    bad = np.zeros(len(q), bool)
    bad[[1000, 1400, 1800]] = True
    np.testing.assert_allclose(q[~bad], clean.q[~bad], atol=1e-12)
    assert abs(q[1000, 0] - clean.q[1000, 0]) == pytest.approx(5.0)
    health = np.concatenate([one.estimates["health"] for one in keeper.verdicts])
    assert (health[[1000, 1400, 1800]] == FAULT).all() and (health[2700:] == OK).all()


def test_after_a_silence_the_turn_is_kept_for_a_joint_that_wraps_and_searched_for_one_that_has_not(bundle):
    arm, second = settings_of(bundle), 10**9
    wide = watching_bundle()  # trained on -6 to 6, as a joint with more than a turn
    wide.input_factors = [1 / 6, 1 / 6, 0.5, 0.5]
    wide.answer_reference()
    for trained, rows, expected in (
        (bundle, [3.1, -3.1], [3.1, TURN - 3.1]),  # a silence on the way across pi
        (wide, [3.13, -3.13, -3.1, 3.0], [3.13, TURN - 3.13, TURN - 3.1, 3.0]),  # has wrapped: the nearest
        (wide, [-3.5, 3.0], [-3.5, 3.0]),  # has not: moved by hand, within the trained positions
        (wide, [2.0, 2.0 - TURN + 1e-3], [2.0, 2.0 + 1e-3]),  # at rest while its encoder restarts
    ):
        turns = Turns(arm, trained)
        t_ns, made = 0, []
        for k, q in enumerate(rows):
            t_ns += 2_000_000 if len(rows) > 2 and k < 3 else 10 * second
            made.append(turns.rows(np.array([t_ns]), np.array([[q, 0.1]]))[0][0, 0])
        np.testing.assert_allclose(made, expected, atol=1e-12)


@pytest.mark.parametrize("low, high", [(2.1, 4.2), (-4.2, -2.1), (-1.0, 3.6), (8.0, 11.0), (-2.5, 2.5), (-3.1, 3.1)])
def test_the_trained_positions_of_a_bundle_are_found_and_a_first_one_is_put_among_them(low, high):
    clean = swinging()
    share = (clean.q - clean.q.min(axis=0)) / np.ptp(clean.q, axis=0)
    clean = replace(clean, q=low + share * (high - low))
    made = watching_bundle()
    made.input_factors = [1 / max(abs(low), abs(high))] * 2 + [0.5, 0.5]
    made.coverage = seen(Motion.of([clean], 10), np.zeros(2, bool), np.array([2, 2]), 0)
    made.set_reference(*(np.ascontiguousarray(a[:1000]) for a in (clean.t_ns, clean.q, clean.dq, clean.tau)))
    again = _core.Bundle.from_bytes(made.to_bytes())
    cell = TURN / 64
    assert np.abs(np.array(trained_positions(again)) - [[low] * 2, [high] * 2]).max() <= cell + 1e-6
    for k in range(0, clean.samples, 97):
        turns = Turns(settings_of(again), again)
        first = at_pi(clean.q[k : k + 1])
        q, _ = turns.rows(clean.t_ns[k : k + 1], first)
        np.testing.assert_allclose(q, clean.q[k : k + 1] if high - low < 6 else first, atol=1e-9)
        assert len(turns.notes()) == np.count_nonzero(np.abs(q - first) > 1)
    assert np.isnan(trained_positions(watching_bundle(network=False))).all()


def test_the_velocity_and_torque_of_servos_are_made_of_unwrapped_counts():
    """Positions counted from 0 to 4095, the goal ahead of them, which wraps before they do."""
    one = _core.ServoConstants(
        volts=7.4, ohm=2.75, back_emf_v_s=1.2, nm_per_ampere=1.2, duty_per_rad=2.6, count_rad=TURN / 4096
    )
    servo = _core.ServoSettings(_core.TorqueFrom.goal, [one], 5, 20_000_000)
    arm = SourceSettings(("pan",), 20_000_000, ("N m",), "held", servo)
    none = np.full(1, np.nan)
    counts = 3000 + 20 * np.arange(400)
    seen_by = []
    for wraps in (False, True):
        q = (counts % 4096 if wraps else counts) * TURN / 4096
        goals = ((counts + 30) % 4096 if wraps else counts + 30) * TURN / 4096
        samples = [Sample(k * 20_000_000, q[k : k + 1], none, none, 0, q_des=goals[k : k + 1]) for k in range(400)]

        class Servos(ScriptedSource):
            def next_sample(self, timeout_s):
                return self.script.pop(0) if self.script else None

        keeper, _ = run_loop(None, Servos(samples), arm=arm)
        seen_by.append([np.concatenate([one.sample.dq, one.sample.tau]) for one in keeper.verdicts])
    clean, wrapped = np.array(seen_by)
    assert np.ptp(clean[10:, 0]) < 1e-9 and clean[10, 0] == pytest.approx(20 * TURN / 4096 * 50)
    after = 60  # the first wrap of the position
    np.testing.assert_allclose(wrapped[after:], clean[after:], atol=1e-9)
    np.testing.assert_allclose(wrapped[:, 0], clean[:, 0], atol=1e-9)
