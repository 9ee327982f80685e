"""When the place of a touch is told: by samples and not by chunks, again where the torque grows, and when it ends."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_places import bundle as bundle

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.cell_file import Reaction, load_cell
from tauext.monitor.changes import ChangeFinder
from tauext.monitor.episode import EpisodeFinder
from tauext.monitor.reactions import ReactionThread, content_of
from tauext.monitor.sink import EventFinder, ReactionEvent, Verdict
from tauext.monitor.touch_place import FrameForce, PlaceChange, PlaceFinder, links_words

SIGMA_NM, RATE_HZ, RISES, FALLS = 0.1, 1000, 200, 900
JOINTS = tuple(f"joint{k + 1}" for k in range(7))


def said_of(tau: np.ndarray, alarm: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "alarm": alarm,
        "alarm_joint": np.where(alarm > 0, 4, -1),
        "tau_ext": tau,
        "load_nm": np.zeros_like(tau),
        "sigma_nm": np.full_like(tau, SIGMA_NM),
        "contact_sigma_nm": np.full_like(tau, SIGMA_NM),
        "near_stiction": np.zeros(tau.shape, dtype=bool),
    }


@pytest.fixture
def signals():
    """A touch on the fifth link whose torque steps up 0.4 s after the alarm and ends 0.7 s after it."""
    rows = 1200
    tau = np.random.default_rng(4).normal(size=(rows, 7)) * 0.01
    tau[RISES - 20 : FALLS, :5] += [1.0, -2.0, 0.5, 1.5, 0.8]
    tau[RISES + 400 : FALLS] *= 3
    alarm = np.zeros(rows, dtype=np.uint8)
    alarm[RISES:FALLS] = 2
    t_ns = np.arange(rows, dtype=np.int64) * 1_000_000
    return t_ns, np.full((rows, 7), 0.3), said_of(tau, alarm)


def found(bundle, signals, step: int) -> list:
    t_ns, q, said = signals
    finder, told = PlaceFinder(bundle), []
    for k in range(0, len(t_ns), step):
        rows = slice(k, k + step)
        told += finder.find(k, t_ns[rows], q[rows], 0 * q[rows], {name: column[rows] for name, column in said.items()})
    return told


def test_a_load_that_is_expected_is_no_part_of_the_touch(bundle, signals):
    t_ns, q, said = signals
    load = np.tile([0.0, 6.0, 0.0, -3.0, 0.0, 0.5, 0.0], (len(t_ns), 1))
    loaded = said | {"tau_ext": said["tau_ext"] + load, "load_nm": load}
    with_load, without = (found(bundle, (t_ns, q, what), 100) for what in (loaded, said))
    assert [one.row for one in with_load] == [one.row for one in without]
    for one, other in zip(with_load, without, strict=True):
        assert [link for link, _ in one.links] == [link for link, _ in other.links]
        np.testing.assert_allclose(one.best.force, other.best.force, rtol=1e-9)


def test_reported_after_a_tenth_of_a_second_and_again_when_it_grows(bundle, signals):
    first, again = found(bundle, signals, 1200)
    assert first.row == RISES + 100 and first.since_s == pytest.approx(0.1) and first.joint == 4
    assert again.row == RISES + 400
    # The sample is that at which the torque stood out most: three times as much, three times the force.
    sizes = [np.linalg.norm(one.places[0].force) for one in (first, again)]
    assert sizes[1] / sizes[0] == pytest.approx(3, rel=0.2)
    assert sum(share for _, share in first.links) == pytest.approx(1)
    assert {link for link, share in first.links if share > 0.05} <= {4, 5, 6}


def test_what_the_joints_before_the_alarm_s_show_later_is_not_its_place(bundle, signals):
    """The touch on the fifth link ends, and while its alarm stands the first joint errs by more than the touch."""
    t_ns, q, said = signals
    said["tau_ext"][RISES + 50 : FALLS] = [6.0, 0, 0, 0, 0, 0, 0]
    for change in found(bundle, signals, 1200):
        assert sum(share for link, share in change.links if link >= 4) > 0.9


@pytest.mark.parametrize("step", [1, 7, 250])
def test_chunks_do_not_change_what_is_reported(bundle, signals, step):
    whole, parts = found(bundle, signals, 1200), found(bundle, signals, step)
    assert [(one.row, one.links, one.since_s) for one in whole] == [(one.row, one.links, one.since_s) for one in parts]


def test_a_short_touch_is_reported_when_its_alarm_falls(bundle, signals):
    t_ns, q, said = signals
    said["alarm"][RISES + 30 :] = 0
    (only,) = PlaceFinder(bundle).find(0, t_ns, q, 0 * q, said)
    assert only.row == RISES + 30 and only.alarm == 2


def test_the_place_of_an_alarm_that_stands_from_before_is_not_estimated_again(bundle, signals):
    t_ns, q, said = signals
    said["alarm"][:RISES] = 2
    fresh, standing = PlaceFinder(bundle), PlaceFinder(bundle)
    standing.stand(2)
    quiet = slice(0, RISES - 20)  # the errors of an arm that nothing touches
    rows = t_ns[quiet], q[quiet], 0 * q[quiet], {name: column[quiet] for name, column in said.items()}
    assert fresh.find(0, *rows) and standing.find(0, *rows) == []


def test_an_acknowledged_alarm_that_stands_again_is_another(bundle, signals):
    t_ns, q, said = signals
    finder, until = PlaceFinder(bundle), RISES + 300
    told = finder.find(
        0, t_ns[:until], q[:until], 0 * q[:until], {name: column[:until] for name, column in said.items()}
    )
    finder.acknowledged()
    rest = {name: column[until:] for name, column in said.items()}
    anew = finder.find(until, t_ns[until:], q[until:], 0 * q[until:], rest)
    assert len(told) == 1 and anew[0].row == until + 100


def test_words_and_facts(bundle, signals):
    change = found(bundle, signals, 1200)[0]
    words = replace(change, consistent=0.5).words(JOINTS)[0]
    assert "no single force" in replace(change, consistent=0.001).words(JOINTS)[0]
    best = JOINTS[change.links[0][0]]
    links = links_words(change.links, JOINTS)
    assert best in links and words.startswith(f"the touch is on {links}: ") and " N" in words
    facts = change.place_facts(JOINTS)
    assert facts["links"][0]["joint"] == best and len(facts["places"]) == len(change.places)
    assert len(facts["places"][0]["force_n"]) == 3
    event, content = change.event, change.facts(JOINTS)
    assert event == "place" and content["joint"] == "joint5" and content["links"] == facts["links"]
    assert content["shapes_guessed"] is False
    json.dumps(content, allow_nan=False)


def test_a_push_straight_through_a_wrist_is_named_beside_a_larger_one_nearer_to_the_base(bundle):
    """40 N at the fifth link, through the centre of its wrist, along the direction that loads two joints."""
    q, sigma = [0.55, -0.92, -1.84, -1.93, 1.25, 1.65, 0.43], [0.3, 0.4, 0.25, 0.3, 0.15, 0.1, 0.08]
    columns = _core.WrenchModel(bundle).columns(bundle.links[4].joint_name, q, axes=_core.WrenchAxes.base)[:3]
    straight = np.linalg.svd(columns[:, 2:].T)[2][-1]

    def told(force: np.ndarray) -> PlaceChange:
        sample = (q, (force @ columns).tolist(), sigma, sigma, [0.0] * 7)
        return PlaceChange.of(_core.PlaceModel(bundle), sample, 0, 0, 2, 0, 0.1)

    aimed, other = told(40 * straight), told(40 * np.cross(straight, [0.0, 0.0, 1.0]))
    assert {link for link, share in aimed.links if share > 0.1} <= {0, 1, 2} and aimed.straight == (3, 4, 5, 6)
    assert aimed.interval_n[0] < 40 < aimed.interval_n[1]
    (words,) = aimed.words(JOINTS)
    assert "joint2 or joint3" in words and ", or straight through the axes on " in words and " within " not in words
    assert aimed.facts(JOINTS)["straight_links"] == [JOINTS[link] for link in aimed.straight]
    assert other.straight == () and "straight" not in other.words(JOINTS)[0]


@pytest.mark.parametrize(
    ("interval_n", "within_m", "words"),
    [
        ((26.4, 41.8), 0.052, "26 to 42 N within 6 cm of (0.31, -0.20, 0.55) m"),
        ((37.7, 266.0), 0.56, "40 to 260 N"),
        ((31.2, 97.0), 0.21, "30 to 100 N within 25 cm of (0.3, -0.2, 0.6) m"),
        ((30.4, 33.3), 0.1, "30 to 33 N within 10 cm of (0.3, -0.2, 0.6) m"),
    ],
)
def test_force_and_point_have_the_digits_that_are_known(bundle, signals, interval_n, within_m, words):
    change = found(bundle, signals, 1200)[0]
    best = SimpleNamespace(point=(0.312, -0.204, 0.551))
    links = ((0, 0.95), *((link, 0.01) for link in range(1, 6)), (6, 0.0))
    made = replace(change, links=links, best=best, interval_n=interval_n, within_m=within_m, consistent=0.5)
    assert made.words(JOINTS)[0] == f"the touch is on the link of joint1: {words}"


def test_words_and_facts_say_that_shapes_are_guessed(bundle, signals, monkeypatch):
    monkeypatch.setattr(bundle, "capsules", [])
    change = found(bundle, signals, 1200)[0]
    assert "shapes guessed): " in change.words(JOINTS)[0]
    assert change.place_facts(JOINTS)["shapes_guessed"] is True


WRISTS = ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@pytest.mark.parametrize(
    ("shares", "guessed", "words"),
    [
        ({2: 0.93, 3: 0.04, 1: 0.03}, False, "the link of elbow"),
        ({2: 0.92, 3: 0.08}, True, "the link of elbow (shapes guessed)"),
        ({2: 0.83, 3: 0.12, 1: 0.05}, False, "the link of elbow or wrist_1 (most likely elbow)"),
        (
            {4: 0.5, 3: 0.25, 5: 0.2, 0: 0.05},
            True,
            "a link from wrist_1 to wrist_3 (most likely wrist_2; shapes guessed)",
        ),
        ({0: 0.5, 3: 0.45, 5: 0.05}, False, "a link from pan to wrist_1 (most likely pan)"),
        ({5: 0.72, 4: 0.2, 3: 0.08}, False, "the link of wrist_2 or wrist_3 (most likely wrist_3)"),
        ({1: 0.42, 2: 0.3, 3: 0.2, 4: 0.08}, False, "a link from lift to wrist_1"),
        ({0: 0.3, 1: 0.25, 2: 0.25, 3: 0.2}, False, "a link from pan to wrist_1"),
    ],
)
def test_the_shortest_run_of_links_that_is_probable_is_stated(shares, guessed, words):
    links = [(link, shares.get(link, 0.0)) for link in (*shares, *(k for k in range(6) if k not in shares))]
    assert links_words(links, WRISTS, guessed) == words


def test_nothing_is_reported_without_an_alarm_or_a_model(bundle, signals):
    t_ns, q, said = signals
    quiet = said | {"alarm": np.zeros_like(said["alarm"])}
    assert PlaceFinder(bundle).find(0, t_ns, q, 0 * q, quiet) == []
    bare = type(bundle)()
    bare.links = bundle.links
    finder = PlaceFinder(bare)
    assert "error scale" in finder.refused and finder.find(0, t_ns, q, 0 * q, said) == []


def of_alarm(what: str, touch: str = "unknown", links=(), newtons=None, number: int = 1) -> ReactionEvent:
    return ReactionEvent(
        "collision",
        "joint5",
        7,
        0,
        {},
        touch=touch,
        news=what == "alarm",
        links=links,
        newtons=newtons,
        number=number,
        of_place=what == "place",
    )


NEAR, SURE = (("joint5", 0.45), ("joint4", 0.4)), (("joint4", 0.8), ("joint5", 0.2))
STORY = [
    of_alarm("alarm"),
    of_alarm("place", "unknown", NEAR, 30.0),
    of_alarm("touch", "clamp", NEAR, 30.0),
    of_alarm("place", "clamp", SURE, 60.0),
    of_alarm("place", "clamp", SURE, 70.0),
    of_alarm("alarm", number=2),
    of_alarm("place", "push", SURE, 70.0, 2),
]


@pytest.mark.parametrize(
    ("bound", "at"),
    [
        ({}, [0, 5]),
        ({"touch": ("clamp",)}, [2]),
        ({"links": ("joint4",)}, [3, 6]),
        ({"links": ("joint4", "joint5")}, [1, 6]),  # one of both, more likely than not
        ({"links": ("joint1",)}, []),
        ({"newtons_over": 50.0}, [3, 6]),
        ({"newtons_over": 20.0, "touch": ("clamp",)}, [2]),
        ({"links": ("joint4",), "touch": ("push",)}, [6]),
    ],
)
def test_a_reaction_of_a_place_runs_once_an_alarm_when_all_it_names_is_true(bound, at):
    done = []
    thread = ReactionThread(Reaction("one", ("collision",), stop=True, **bound), done.append)
    for k, event in enumerate(STORY):
        thread.put(replace(event, joint=f"joint {k}"))  # none merged
    thread.end(time.monotonic() + 20)
    assert [int(event.joint.split()[1]) for event in done] == at


FILE = "[reactions.one]\non = {on}\n{rule}\nstop = true\n"


@pytest.mark.parametrize(
    ("on", "rule", "words"),
    [
        (
            '["collision"]',
            'links = ["joint9"]',
            "links = .'joint9'. must be one of joint1",
        ),
        ('["collision"]', "newtons_over = -1", "newtons_over = -1"),
        ('["fault"]', "newtons_over = 5", "newtons_over cannot apply to fault; on needs collision or contact"),
    ],
)
def test_a_file_binds_reactions_to_places_and_refuses_what_cannot_be(tmp_path, on, rule, words):
    path = tmp_path / "cell.toml"
    path.write_text(FILE.format(on='["contact"]', rule='links = ["joint4"]\nnewtons_over = 12.5'))
    (found,) = load_cell(path, JOINTS).reactions
    assert (found.links, found.newtons_over) == (("joint4",), 12.5)
    path.write_text(FILE.format(on=on, rule=rule))
    with pytest.raises(ConfigError, match=words):
        load_cell(path, JOINTS)


def test_commands_find_link_and_newtons_in_their_environment():
    environment = content_of(of_alarm("place", "push", SURE, 61.23456))["environment"]
    assert (environment["TAUEXT_LINK"], environment["TAUEXT_NEWTONS"]) == ("joint4", "61.23")
    environment = content_of(of_alarm("alarm"))["environment"]
    assert (environment["TAUEXT_LINK"], environment["TAUEXT_NEWTONS"]) == ("", "")


def test_an_alarms_place_is_in_its_events_until_the_next(bundle, signals):
    t_ns, q, said = signals
    rows = len(t_ns)
    said["alarm"][FALLS + 50 : FALLS + 60] = 1
    said["alarm_joint"][:] = 4
    for name in ("limit_nm", "contact_limit_nm", "margin_nm", "residual", "uncertainty", "declared_nm"):
        said[name] = np.ones((rows, 7))
    numbers = (("health", 1), ("causes", 0), ("cause_joint", -1), ("touch", 1), ("declared", 0))
    for name, value in (*numbers, ("declared_contact", -1), ("declared_size", 0.0)):
        said[name] = np.full(rows, value)
    for name in ("drift_saturated", "near_stiction"):
        said[name] = np.zeros((rows, 7), dtype=bool)
    for name in ("detection", "unfamiliar", "held_alarm", "touch_t_ns", "touch_over"):
        said[name] = np.zeros(rows)
    said["alarm_number"] = np.cumsum(np.diff(said["alarm"], prepend=0) > 0)
    finder, changes, places, events = EventFinder(JOINTS, {}), ChangeFinder(), PlaceFinder(bundle), []
    episodes = EpisodeFinder()
    for k in range(rows):
        row = {name: column[k : k + 1] for name, column in said.items()}
        news = changes.find(k, t_ns[k : k + 1], row) + places.find(
            k, t_ns[k : k + 1], q[k : k + 1], 0 * q[k : k + 1], row
        )
        of_alarm = episodes.find(k, t_ns[k : k + 1], row, news)
        events += finder.find(Verdict(k, t_ns[k : k + 1], None, row, tuple(news), episodes.standing, of_alarm))
    kinds = [(event.kind, event.of_place, event.newtons is not None) for event in events]
    assert kinds[:3] == [("collision", False, False), ("collision", True, True), ("collision", True, True)]
    assert kinds[3:5] == [("cleared", False, False), ("contact", False, False)]
    assert [event.number for event in events[:5]] == [1, 1, 1, 0, 2]
    assert events[1].facts["place"]["places"] and events[0].facts["place"] is None


POSE = [0.3, -0.6, 0.5, -1.7, 0.4, 1.3, 0.2]
FORCE = np.array([4.0, -3.0, -22.0])
DOWN = FrameForce("tool0", (3.0, 4.0, -25.0), tuple(np.diag([1.0, 4.0, 2.25]).ravel()), 0, 0.7)


def test_the_force_at_the_frame_comes_with_the_place(bundle):
    tau = _core.WrenchModel(bundle).columns("joint7", POSE)[:3].T @ FORCE
    rows = 400
    alarm = np.zeros(rows, dtype=np.uint8)
    alarm[100:300] = 2
    said = said_of(np.outer(alarm > 0, tau), alarm)
    t_ns, q = np.arange(rows, dtype=np.int64) * 1_000_000, np.tile(POSE, (rows, 1))
    told = [PlaceFinder(bundle, frame).find(0, t_ns, q, 0 * q, said)[0] for frame in ("joint7", None)]
    force = told[0].force
    assert force is not None and told[1].force is None and told[0].row == told[1].row
    np.testing.assert_allclose(force.force_n, FORCE, atol=0.3)
    assert force.consistent > 0.9 and 0 < force.off_n < 10
    words, facts = told[0].words(JOINTS)[0], told[0].place_facts(JOINTS)
    assert words.endswith(f"; {force.words()}") and " 23 N at joint7 (up to " in words
    assert facts["at_frame"]["force_n"] == force.force_n and len(facts["at_frame"]["covariance"]) == 9
    assert "at_frame" not in told[1].place_facts(JOINTS) and " N at " not in told[1].words(JOINTS)[0]


def test_words_say_size_doubt_and_the_nearest_axis():
    assert DOWN.words() == "25 N at tool0 (up to 4 N wrong), 11° from -z"
    assert replace(DOWN, force_n=(0.0, 20.0, 0.0)).words().endswith("0° from +y")
    blind = replace(DOWN, blind=1).words()
    assert blind == "25 N at tool0 (and 1 direction that this pose cannot show), 11° from -z"
    assert replace(DOWN, consistent=0.001).words() == "no force at tool0 explains it"


def test_a_frame_that_there_is_none_is_refused_with_those_that_there_are(bundle):
    with pytest.raises(ConfigError, match=r"wrench = 'hand' must be one of joint1, .*joint7"):
        PlaceFinder(bundle, "hand")
    bare = type(bundle)()
    bare.links = bundle.links
    with pytest.raises(ConfigError, match="no force can be estimated: the bundle has no error scale"):
        PlaceFinder(bare, "joint7")
