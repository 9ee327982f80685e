"""Contacts that the task means: phases, control lines, recordings and the loop; the alarm stays on beside them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_arms import six_axis_tree
from made_bundles import constant_error_scale
from made_live import Keeper, ScriptedSource, replay, samples_of

from tauext import DeclaredContact, WrenchModel, _core
from tauext.bundle.estimates import COLLISION, DECLARED, unexplained
from tauext.cli import main
from tauext.config import ObserverConfig
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.cell_file import load_cell
from tauext.monitor.changes import AlarmChange, DeclaredChange
from tauext.monitor.control_lines import obey
from tauext.monitor.loop import Loop
from tauext.monitor.phases import Phases, announced_of_text
from tauext.sources.replay import ReplaySource

SAMPLES = 6000
LIMITS_NM = [6.0, 6.0, 5.0, 2.0, 2.0, 2.0]
UP = (0.0, 0.0, 1.0)
TOOL = "joint6"


def drive_torque(tree: _core.Tree, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Averages over the steps of what the drives exert."""
    p, beta = tree.momentum(q, dq)
    return np.vstack([beta[:1], 0.5 * (beta[1:] + beta[:-1])]) + np.vstack(
        [np.zeros((1, 6)), np.diff(p, axis=0) / 1e-3]
    )


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A bundle that knows the arm exactly, and its free motion."""
    tree = six_axis_tree(tmp_path_factory.mktemp("arm"))
    rng = np.random.default_rng(8)
    t = np.arange(SAMPLES)[:, None] * 1e-3
    size, speed, phase = rng.uniform(0.2, 0.5, (1, 6)), rng.uniform(0.8, 2.2, (1, 6)), rng.uniform(0, 6, (1, 6))
    q, dq = size * np.sin(speed * t + phase), size * speed * np.cos(speed * t + phase)
    joints = tuple(link.joint_name for link in tree.links)
    t_ns = np.arange(SAMPLES, dtype=np.int64) * 1_000_000
    free = Recording("press", joints, t_ns, q, dq, drive_torque(tree, q, dq), 1000.0, "averaged", "t", "5" * 64)
    bundle = make_bundle("six", build_setup(tree, free, ObserverConfig(window_s=0.1)), 0.02, free)
    for name in ("sliding_limit_nm", "near_stiction_limit_nm"):
        setattr(bundle, name, LIMITS_NM)
        setattr(bundle, f"contact_{name}", LIMITS_NM)
    bundle.error_scale = constant_error_scale([0.3] * 6)
    return bundle, free


def jacobian(bundle: _core.Bundle, q: np.ndarray) -> np.ndarray:
    """Of the tool frame's origin, by finite differences of its position: (samples, 3, joints)."""
    model, step = WrenchModel(bundle), 1e-6
    out = np.empty((len(q), 3, 6))
    for j in range(6):
        ahead, behind = q.copy(), q.copy()
        ahead[:, j] += step
        behind[:, j] -= step
        for k in range(len(q)):
            moved = model.pose(TOOL, ahead[k].tolist())[1] - model.pose(TOOL, behind[k].tolist())[1]
            out[k, :, j] = moved / (2 * step)
    return out


@pytest.fixture(scope="module")
def tool(arm):
    bundle, free = arm
    return jacobian(bundle, free.q)


def pressed(free: Recording, tool: np.ndarray, newtons: float, begin: int, end: int, hit_nm: float = 0.0) -> Recording:
    """The tool is pushed up by this force from row begin to end, and joint 2 is hit in the middle for 0.3 s."""
    push = np.zeros(len(free.t_ns))
    push[begin:end] = newtons
    push = np.convolve(push, np.ones(100) / 100, mode="same")
    external = push[:, None] * tool[:, 2, :]
    middle = (begin + end) // 2
    external[middle : middle + 300, 1] += hit_nm
    return replace(free, tau=free.tau - external)


def declared(**bounds) -> DeclaredContact:
    given = {"frame": TOOL, "axis": UP, "axes": _core.WrenchAxes.base, "half_angle_deg": 20, "at_most_n": 40.0}
    return DeclaredContact(**(given | bounds))


def run(bundle: _core.Bundle, recording: Recording, contact: DeclaredContact | None) -> dict[str, np.ndarray]:
    signals = recording.t_ns, recording.q, recording.dq, recording.tau
    contacts = [] if contact is None else [(contact, int(recording.t_ns[0]), np.inf)]
    return _core.estimate(bundle, *signals, 1, contacts=contacts)


def test_a_declared_force_raises_no_alarm_and_a_hit_beside_it_does(arm, tool):
    bundle, free = arm
    presses = pressed(free, tool, 25.0, 2000, 5000)
    plain, meant = run(bundle, presses, None), run(bundle, presses, declared())
    assert plain["alarm"].max() == COLLISION and meant["alarm"].max() == 0
    middle = slice(2600, 4800)
    left = np.abs(unexplained(meant))[middle]
    # The unexplained rest is that of the observer: the force is constant, and the Jacobian passes its filter.
    assert left.max() < 0.05 and np.abs(plain["tau_ext"][middle]).max() > 5
    np.testing.assert_allclose(meant["declared_size"][middle], 25.0, rtol=0.02)
    assert {DECLARED[state] for state in np.unique(meant["declared"][middle])} == {"within"}
    hit = run(bundle, pressed(free, tool, 25.0, 2000, 5000, hit_nm=9.0), declared())
    assert hit["alarm"][:3500].max() == 0 and hit["alarm"][3500:3700].max() == COLLISION
    assert hit["held_alarm"][4000:5000].max() == 0  # the pressing goes on
    # Limits rise by the error of what is explained, and by no more.
    rise = meant["limit_nm"][middle] / np.array(LIMITS_NM)
    assert 1.0 < rise.max() < 1.6 and (meant["limit_nm"][500:1500] < 1.05 * np.array(LIMITS_NM)).all()


def test_a_larger_force_is_an_event_of_its_own_and_what_is_beyond_stays_in_the_alarm(arm, tool):
    bundle, free = arm
    found = run(bundle, pressed(free, tool, 60.0, 2000, 5000), declared(at_most_n=30.0))
    assert DECLARED[found["declared"][4000]] == "beyond"
    np.testing.assert_allclose(found["declared_size"][2600:4800], 60.0, rtol=0.02)
    forces = [np.linalg.lstsq(tool[k].T, found["declared_nm"][k], rcond=None)[0] for k in range(2600, 4800, 50)]
    sizes = np.linalg.norm(forces, axis=1)  # by the Jacobian of now, not of the filter: up to 2 % off
    assert 29.0 < sizes.min() and sizes.max() < 31.0
    tilts = np.degrees(np.arccos(np.array(forces)[:, 2] / sizes))
    assert tilts.max() < 21.5  # within the cone of 20 degrees
    # A pull is outside of the cone: nothing of it is explained.
    pulls = run(bundle, pressed(free, tool, -25.0, 2000, 5000), declared())
    assert np.abs(pulls["declared_nm"][2600:4800]).max() < 0.3 and pulls["alarm"].max() == COLLISION


def test_the_tool_force_has_the_true_force_within_its_errors(arm, tool):
    bundle, free = arm
    presses = pressed(free, tool, 25.0, 2000, 5000)
    monitor = _core.Monitor(bundle)
    monitor.expect_contact(declared())
    monitor.run(presses.t_ns[:4000], presses.q[:4000], presses.dq[:4000], presses.tau[:4000])
    found = monitor.tool_force()
    assert found.declared and found.wrench.known and found.wrench.frame == TOOL
    error = np.array(found.wrench.force) - [0, 0, 25.0]
    assert error @ np.linalg.inv(found.wrench.covariance) @ error < 2
    assert np.linalg.norm(error) < 1.0
    assert found.constants_n > 0.2  # 5 % of the torques


def phases_of(path) -> Phases:
    phases = load_cell(path).phases
    assert phases is not None
    return phases


def test_phases_of_a_file_are_declared_at_their_times_and_reported(arm, tool, tmp_path):
    bundle, free = arm
    path = tmp_path / "cell.toml"
    path.write_text(
        f'[phases.pressing]\nframe = "{TOOL}"\naxis = [0, 0, 1]\naxes = "base"\nhalf_angle_deg = 20\nat_most_n = 20\n'
        "during = [[1.5, 5.2]]\n"
        '[phases.grip]\njoint = "joint5"\nat_most_nm = 0.5\nalways = true\n'
    )
    phases = phases_of(path)
    (hidden,) = phases.check(_core.Monitor(bundle))
    assert hidden == "phase grip: within its bound of 0.5 N m, nothing is monitored on joint 'joint5' meanwhile"
    presses = pressed(free, tool, 25.0, 2000, 5000)
    chunks = list(replay(_core.Monitor(bundle), presses, chunk_s=0.4, phases=phases))
    events = [change for chunk in chunks for change in chunk.changes if isinstance(change, DeclaredChange)]
    words = [line for event in events for line in event.words(free.joints, bundle.estimate_units)]
    assert words[0] == "grip: contact of joint joint5 of at most 0.5"
    assert f"pressing: contact at {TOOL} of at most 20 N" in words
    beyond = [event for event in events if DECLARED[event.state] == "beyond"]
    assert len(beyond) == 1 and beyond[0].phase == "pressing"
    assert f"N at {TOOL}, of at most 20 N" in words[events.index(beyond[0])]
    kind, facts = beyond[0].event, beyond[0].facts(free.joints)
    assert (kind, facts["phase"], facts["state"], facts["frame"], facts["at_most_n"]) == (
        "declared",
        "pressing",
        "beyond",
        TOOL,
        20.0,
    )
    # Whole chunks or others: the same estimates.
    once = list(replay(_core.Monitor(bundle), presses, chunk_s=10.0, phases=phases_of(path)))
    for name in ("declared_nm", "declared", "alarm"):
        np.testing.assert_array_equal(
            np.concatenate([chunk.estimates[name] for chunk in chunks]),
            np.concatenate([chunk.estimates[name] for chunk in once]),
        )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[phases.a]\n", "a frame or a joint"),
        ('[phases.a]\nframe = "t"\njoint = "j"\n', "not both"),
        ('[phases.a]\nframe = "t"\nat_most_n = nan\n', "at_most_n = nan must be a number"),
        ('[phases.a]\nframe = "t"\nhalf_angle_deg = 91\n', "half_angle_deg = 91 must be a number from 0 to 90"),
        ('[phases.a]\nframe = "t"\nbox = [[0, 0, 0]]\n', "a list of 2, each a list of 3"),
        ('[phases.a]\nframe = "t"\nduring = [[2, 1]]\n', "rising pairs"),
        ('[phases.a]\nframe = "t"\naxes = "tool"\n', "one of frame, base"),
        ("[phases.a]\nnewtons = 3\n", "unknown key 'newtons'"),
        ('[phases."a b"]\nframe = "t"\n', "must be one word"),
    ],
)
def test_a_file_that_breaks_a_rule_is_refused_in_one_sentence(tmp_path, content, message):
    path = tmp_path / "cell.toml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")) as error:
        load_cell(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_phase_that_the_bundle_cannot_have_is_refused_by_name(arm, tmp_path):
    bundle, _ = arm
    monitor = _core.Monitor(bundle)
    path = tmp_path / "cell.toml"
    for content, message in (
        ('frame = "flange"\nat_most_n = 5', "phase a: frame = 'flange' must be one of joint1"),
        (
            'joint = "gripper"\nat_most_nm = 5',
            "phase a: joint = 'gripper' of an expected contact must be one of",
        ),
        (
            f'frame = "{TOOL}"\nat_most_n = 5\nat_most_nm = 1',
            "phase a: the contact at 'joint6' would explain any torque",
        ),
        (f'frame = "{TOOL}"\nhalf_angle_deg = 10\nat_most_n = 5', "without an axis, any direction"),
        (f'frame = "{TOOL}"\naxis = [0, 0, 1]', "must admit a force or a torque above 0"),
    ):
        path.write_text(f"[phases.a]\n{content}\n")
        with pytest.raises(ConfigError, match=message):
            phases_of(path).check(monitor)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "cannot be read"),
        ("a b", "cannot be read"),
        ("a", "seconds is missing"),
        ("a seconds=0x", "seconds = '0x' must be a number"),
        ("frame=t axis=0,0,x seconds=1", "axis = '0,0,x' must be a list of 3"),
        ("frame=t at_most_n=5", "seconds is missing"),
        ("frame=t frame=u seconds=1", "given twice"),
        ("newtons=5", "unknown key 'newtons'"),
    ],
)
def test_a_control_line_that_cannot_be_read_is_answered(line, message):
    with pytest.raises(ConfigError, match=message):
        announced_of_text(line)


FAR = {
    "joint": {"joint": "joint2", "at_most_nm": 1e6},
    "force": {"frame": TOOL, "at_most_n": 1e6},
    "line": {"frame": TOOL, "axis": UP, "at_most_n": 1e6},
    "lever": {"frame": TOOL, "point": (1000.0, 0.0, 0.0), "at_most_n": 40.0},
}
"""Contacts that admit whatever the arm can exert."""


@pytest.mark.parametrize("name", FAR)
def test_a_contact_that_admits_whatever_the_arm_can_exert_is_refused_by_every_entry(arm, tmp_path, name):
    bundle, free = arm
    far = FAR[name]
    for bounds in (far, {key: 1e300 if key.startswith("at_most") else value for key, value in far.items()}):
        with pytest.raises(_core.CoreError, match=r"at_most_nm? = \S+ .*must be below .* would be monitored"):
            _core.Monitor(bundle).expect_contact(DeclaredContact(**bounds), 1.0)
        with pytest.raises(_core.CoreError, match="must be below"):
            run(bundle, free, DeclaredContact(**bounds))
    # By a control line, and by a phases file.
    words = [f"{key}={','.join(map(str, value)) if isinstance(value, tuple) else value}" for key, value in far.items()]
    loop = Loop(bundle, ScriptedSource([]))
    assert "must be below" in obey(f"contact {' '.join(words)} seconds=5", loop, "test")
    values = {key: list(value) if isinstance(value, tuple) else value for key, value in far.items()}
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
    (tmp_path / "cell.toml").write_text("\n".join(["[phases.a]", *lines]))
    with pytest.raises(ConfigError, match="phase a: .*must be below"):
        phases_of(tmp_path / "cell.toml").check(_core.Monitor(bundle))


def test_what_an_arm_needed_in_training_can_be_declared(arm):
    """Drive limits are unknown here: the bound is well above every torque of the recording."""
    bundle, free = arm
    monitor, largest = _core.Monitor(bundle), np.abs(free.tau).max(axis=0)
    for j, link in enumerate(bundle.links):
        assert not monitor.why_no_contact(DeclaredContact(joint=link.joint_name, at_most_nm=2 * largest[j]))


def test_the_loop_declares_what_lines_announce_and_reports_it(arm, tool):
    bundle, free = arm
    presses = pressed(free, tool, 25.0, 2000, 5000)
    phases = Phases()
    notes: list[str] = []
    answers: list[str] = []
    lines = {
        1500: "contact frame=joint6 axis=0,0,1 axes=base half_angle_deg=20 at_most_n=40 seconds=60",
        1501: "contact sanding seconds=3",
        1502: "contact frame=nope at_most_n=4 seconds=3",
        1503: "contact frame=joint6 at_most_n=-4 seconds=3",
        4000: "contact none",
    }

    def each(verdict) -> None:
        if verdict.row in lines:
            answers.append(obey(lines[verdict.row], loop, "test"))

    keeper = Keeper(each)
    loop = Loop(bundle, ScriptedSource(samples_of(presses)), [keeper], phases=phases)
    loop.note = notes.append
    loop.run()
    assert answers[0] == "ok" and answers[4] == "ok"
    assert "phase 'sanding' needs a table" in answers[1]
    assert "frame = 'nope' must be one of" in answers[2]
    assert answers[3].startswith("error: contact") and "at_most_n = -4.0 must be" in answers[3]
    assert any("a contact at joint6 of at most 40 N for 60 s is expected, by test" in note for note in notes)
    assert "1 expected contact ended, by test" in notes
    alarms = [change for one in keeper.verdicts for change in one.changes if isinstance(change, AlarmChange)]
    assert alarms and alarms[0].row > 4000  # the force was no longer declared
    states = [c.state for one in keeper.verdicts for c in one.changes if isinstance(c, DeclaredChange)]
    assert [DECLARED[state] for state in states] == ["within", "none"]


def during(tmp_path, pairs: str) -> Phases:
    path = tmp_path / "cell.toml"
    path.write_text(
        f'[phases.pressing]\nframe = "{TOOL}"\naxis = [0, 0, 1]\naxes = "base"\nhalf_angle_deg = 20\nat_most_n = 40\n'
        f'during = {pairs}\n[phases.grip]\njoint = "joint5"\nat_most_nm = 0.5\nalways = true\n'
    )
    return phases_of(path)


def test_a_replay_in_the_live_monitor_obeys_the_times_of_a_phase_as_run_does(arm, tool, tmp_path):
    bundle, free = arm
    presses = pressed(free, tool, 25.0, 2000, 5000)
    chunks = list(replay(_core.Monitor(bundle), presses, phases=during(tmp_path, "[[1.5, 3.2], [3.3, 5.4]]")))
    keeper, notes = Keeper(), list[str]()
    loop = Loop(
        bundle, ReplaySource(presses, None), [keeper], phases=during(tmp_path, "[[1.5, 3.2], [3.3, 5.4], [6, 7]]")
    )
    loop.note = notes.append
    loop.run()
    for name in ("declared", "declared_contact", "declared_nm", "held_alarm"):
        live = np.concatenate([verdict.estimates[name] for verdict in keeper.verdicts])
        expected = np.concatenate([chunk.estimates[name] for chunk in chunks])
        np.testing.assert_array_equal(live, expected, err_msg=name)
    assert COLLISION not in expected[:3200]
    found = [c for one in keeper.verdicts for c in one.changes if isinstance(c, DeclaredChange)]
    assert {change.phase for change in found} == {"pressing", "grip"}
    assert notes == ["phase pressing: during = [[6, 7]] declares nothing: press ends at 5.999 s"]


def test_times_of_a_recording_are_reported_where_a_source_is_live(arm, tmp_path):
    bundle, free = arm
    notes: list[str] = []
    loop = Loop(bundle, ScriptedSource(samples_of(free, slice(0, 3))), phases=during(tmp_path, "[[1, 2]]"))
    loop.note = notes.append
    loop.run()
    assert len(notes) == 1 and "phase pressing: during gives times of a recording" in notes[0]
    assert "`contact pressing seconds=S`" in notes[0]


def test_run_and_calibrate_report_times_beyond_the_end(arm, tmp_path, capsys):
    bundle, free = arm
    bundle.save(str(tmp_path / "six.tauext"))
    save_recording(free, tmp_path / "press.parquet")
    save_split(Split((), (), (), calibration=("press.parquet",)), tmp_path)
    during(tmp_path, "[[5.9, 5.95], [6.0, 9.0]]")
    common = ["--cell", str(tmp_path / "cell.toml")]
    assert main(["run", str(tmp_path / "six.tauext"), str(tmp_path / "press.parquet"), *common]) == 0
    said = capsys.readouterr()
    assert (said.out + said.err).count("phase pressing: during = [[6, 9]] declares nothing: press ends at 5.999 s") == 1
    assert (said.out + said.err).count("declares nothing") == 1
    data = ["--bundle", str(tmp_path / "six.tauext"), "--data", str(tmp_path), "--out", str(tmp_path / "o.tauext")]
    main(["calibrate", *data, *common])
    said = capsys.readouterr().err
    words = "phase pressing: during = [[6, 9]] declares nothing: the longest calibration recording ends at 6 s"
    assert said.count(words) == 1


def test_the_spread_is_the_least_without_a_false_collision(arm, tool):
    from tauext.train.declared_spread import SpreadConfig, needed, put_spread, with_tool_forces

    bundle, free = arm
    presses = pressed(free, tool, 25.0, 2000, 5000)
    contacts = [(declared(), 0, np.inf)]
    assert needed(bundle, presses, contacts)[0] == SpreadConfig.tried[0]
    # Torque constants that are wrong by more than one standard error need more.
    off = replace(presses, tau=free.tau + (presses.tau - free.tau) * [1.6, 0.5, 1.6, 0.5, 1.6, 1])
    more, hours = needed(bundle, off, contacts)
    assert more > SpreadConfig.tried[0] and 0.5 < hours * 3600 / 3.0 < 1.1
    own = _core.Bundle.from_bytes(bundle.to_bytes())
    found = put_spread(own, [(off, contacts)], injected=False)
    assert own.declared_spread == found.spread == more >= 3.0 and "no false collision" in found.sentence()
    assert own.declared_spread != bundle.declared_spread
    few = put_spread(own, [(presses, contacts)], injected=False)  # three seconds lower nothing
    assert (few.needed, few.spread) == (SpreadConfig.tried[0], 3.0)
    # A hit that no spread excuses is refused.
    hit = pressed(free, tool, 25.0, 2000, 5000, hit_nm=60.0)
    with pytest.raises(ConfigError, match="press: the expected contact leaves torques over the thresholds"):
        put_spread(own, [(hit, contacts)], injected=False)
    # Forces that are added to free motion never lower it.
    added = put_spread(own, with_tool_forces(own, [lambda: free]), injected=True)
    assert added.spread >= 3.0 and added.injected


def rubbing(bundle: _core.Bundle, friction_nm: np.ndarray) -> _core.Bundle:
    """The bundle with Coulomb friction of these joints, which counts in motion alone."""
    own, prior = _core.Bundle.from_bytes(bundle.to_bytes()), _core.PriorSettings()
    prior.terms = [_core.Term(_core.TermKind.coulomb, j, speed=1e-3) for j in range(6)]
    prior.weights = np.diag(friction_nm).ravel().tolist()
    own.prior = prior
    return own


def test_the_rest_of_an_arm_that_stands_equals_a_slow_twin(arm, tool):
    """A pull on the tool, which the declared push does not explain: the joints may hide it within their friction."""
    bundle, free = arm
    friction_nm = np.array([3.0, 4.0, 2.0, 1.0, 0.5, 0.0])
    still = replace(free, q=np.repeat(free.q[:1], SAMPLES, axis=0), dq=np.zeros_like(free.dq))
    still = replace(still, tau=drive_torque(_core.Tree(bundle.links, bundle.gravity), still.q, still.dq))
    found = run(
        rubbing(bundle, friction_nm), pressed(still, np.repeat(tool[:1], SAMPLES, 0), -12.0, 1500, 4500), declared()
    )
    rest, expected = np.zeros(6), np.zeros((SAMPLES, 6))
    follows, judged = 1 - np.exp(-1e-3 / 0.7), np.isfinite(found["tau_ext"]).all(axis=1)
    for k in np.flatnonzero(judged)[1:]:
        torque = found["tau_ext"][k]
        left = torque - np.clip(torque, np.minimum(rest, 0), np.maximum(rest, 0))
        step = follows * (torque - rest)
        if (np.abs(left) > 0.5 * found["limit_nm"][k - 1]).any():  # of the sample before
            step = np.clip(step, -0.2e-3 * friction_nm, 0.2e-3 * friction_nm)
        rest = np.clip(rest + step, -friction_nm, friction_nm) if k >= 500 else rest
        expected[k] = np.clip(torque, np.minimum(rest, 0), np.maximum(rest, 0))
    assert (np.abs(found["tau_ext"][3000]) > 0.5 * found["limit_nm"][3000]).any() and np.abs(expected).max() > 0.5
    np.testing.assert_allclose(found["declared_nm"][judged], expected[judged], atol=1e-6)


def test_pushes_that_are_noticed_at_rest_pass_limit_and_friction(arm):
    from tauext.train.declared_spread import STANDS_S, noticed_standing
    from tauext.train.hits import even_ways

    bundle, free = arm
    hidden_nm = np.array([3.0, 4.0, 2.0, 1.0, 0.5, 0.0])
    own = rubbing(bundle, hidden_nm)
    q = free.q[::500]
    found = noticed_standing(own, q.tolist())
    felt = np.abs(np.einsum("pij,wi->pwj", jacobian(own, q), even_ways()))
    k0, leaves = own.observer.gain_per_s, 1 / STANDS_S
    t = np.linspace(0, 1, 100_001)
    shown = (k0 / (k0 - leaves) * (np.exp(-leaves * t) - np.exp(-k0 * t))).max()  # of a step through observer and rest
    for name, nm in (("slow_n", LIMITS_NM + hidden_nm), ("sudden_n", np.array(LIMITS_NM) / shown)):
        assert found["places"][0][name] == pytest.approx(np.median(1 / (felt / nm).max(axis=2)), rel=1e-4)
    lengths = [np.linalg.norm(link.translation) for link in own.links[1:]]  # of link k, to the joint that it carries
    forearm = max(np.argsort(lengths)[-2:])  # of the two longest, the farther from the base
    place = f"link of joint{forearm + 1}, at joint{forearm + 2}"
    assert "joint6" in found["places"][0]["at"] and found["places"][1]["at"] == place
    assert f"from {found['places'][1]['slow_n']:.0f} N at the {place}" in found["sentence"]
    assert noticed_standing(own) == {}  # the bundle keeps no poses


def test_hits_are_injected_while_the_tool_presses_too(arm):
    from tauext_lab.evaluate.injected import Injection

    bundle, free = arm
    injection = Injection({"six": bundle}, 4, 20)
    for number in range(12):
        injection.add("six", free, injection.draw(number, free), 1)
    found = injection.summary("six").pressed
    assert found is not None and found.events == 12  # one in each of these short recordings
    assert 0 < found.latched <= found.events and found.latched_free > 0 and found.false_collisions == 0
    assert 5 <= found.least_n < found.most_n <= 60
