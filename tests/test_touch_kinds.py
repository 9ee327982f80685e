"""Kinds of touch from the monitor's answers to lines, JSON and reactions; the rule itself is tested in C++."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from made_bundles import JOINTS, pushed, watching_bundle
from made_live import replay

from tauext import Touch, _core
from tauext.bundle.estimates import COLUMNS, TOUCHES
from tauext.errors import ConfigError
from tauext.monitor.cell_file import Reaction, load_cell
from tauext.monitor.changes import ChangeFinder, TouchChange
from tauext.monitor.episode import EpisodeFinder
from tauext.monitor.reactions import ReactionThread, content_of
from tauext.monitor.sink import EventFinder, ReactionEvent, Verdict

FACTS = {"joints": list(JOINTS), "tau_ext_nm": [1.5, None], "limit_nm": [2.0, 3.0], "contact_limit_nm": [1.0, 1.5]}
UNKNOWN, IMPACT, PUSH, CLAMP = (Touch[name].value for name in ("unknown", "impact", "push", "clamp"))


def said(touch: list[int], alarm: list[int]) -> dict[str, np.ndarray]:
    """What a monitor says of samples 10 ms apart whose torques nobody asks for here."""
    rows = len(touch)
    torques = {column.name: np.ones((rows, 2)) for column in COLUMNS if column.in_messages}
    flags = {name: np.zeros((rows, 2), bool) for name in ("near_stiction", "drift_saturated")}
    names = ("causes", "cause_joint", "detection", "unfamiliar", "touch_t_ns", "touch_over")
    names += ("declared", "declared_size", "declared_contact")
    numbers = {name: np.zeros(rows, int) for name in names}
    return {
        **torques,
        **flags,
        **numbers,
        "health": np.ones(rows, int),
        "touch": np.array(touch),
        "alarm": np.array(alarm),
        "alarm_joint": np.where(np.array(alarm) > 0, 1, -1),
    }


def touches(of: dict[str, np.ndarray], chunks: list[int]) -> list[TouchChange]:
    finder, found, first = ChangeFinder(), [], 0
    for rows in chunks:
        part = {name: values[first : first + rows] for name, values in of.items()}
        t_ns = np.arange(first, first + rows) * 10_000_000
        found += [c for c in finder.find(first, t_ns, part) if isinstance(c, TouchChange)]
        first += rows
    return found


TOUCH = [0, UNKNOWN, UNKNOWN, IMPACT, IMPACT, UNKNOWN, CLAMP, CLAMP, 0, UNKNOWN, PUSH]
ALARM = [0, 1, 2, 2, 2, 2, 2, 2, 0, 1, 1]


@pytest.mark.parametrize("chunks", [[11], [1] * 11, [3, 4, 4]])
def test_a_kind_is_reported_when_it_becomes_known_or_another_whatever_the_chunks(chunks):
    found = touches(said(TOUCH, ALARM), chunks)
    assert [(c.row, TOUCHES[c.touch], TOUCHES[c.was], c.alarm, c.joint) for c in found] == [
        (3, "impact", "unknown", 2, 1),
        (6, "clamp", "unknown", 2, 1),
        (10, "push", "unknown", 1, 1),
    ]
    assert [round(c.since_s, 9) for c in found] == [0.01, 0.04, 0.01]  # since the alarm rose to its level


def test_words_name_the_kind_and_what_it_was_taken_for():
    assert (
        TouchChange(3, 0, CLAMP, UNKNOWN, 2, 1, 0.164).words(JOINTS)[0]
        == "the collision is a clamp, 164 ms after the alarm"
    )
    (words,) = TouchChange(3, 0, IMPACT, PUSH, 1, 1, 0.03).words(JOINTS)
    assert words == "the contact is an impact, 30 ms after the alarm (was taken for push)"


def events_of(of: dict[str, np.ndarray]) -> list[ReactionEvent]:
    finder, episodes, changes, found = EventFinder(JOINTS, {}), EpisodeFinder(), ChangeFinder(), []
    for k in range(len(of["touch"])):
        row = {name: values[k : k + 1] for name, values in of.items()}
        t_ns = np.array([k * 10_000_000])
        news = changes.find(k, t_ns, row)
        of_alarm = episodes.find(k, t_ns, row | {"held_alarm": np.zeros(1)}, news)
        found += finder.find(Verdict(k, t_ns, None, row, tuple(news), episodes.standing, of_alarm))
    return found


def test_an_alarm_is_an_event_and_so_is_its_kind():
    found = events_of(said(TOUCH, ALARM))
    assert [(e.kind, e.touch, e.news) for e in found] == [
        ("contact", "unknown", True),
        ("collision", "unknown", True),
        ("collision", "impact", False),
        ("collision", "clamp", False),
        ("cleared", None, True),
        ("contact", "unknown", True),
        ("contact", "push", False),
    ]
    assert found[3].facts["touch"] == "clamp" and found[3].facts["alarm"] == "collision"


@pytest.mark.parametrize(
    ("on", "touch", "expected"),
    [
        (("collision",), None, ["unknown"]),
        (("collision", "contact", "cleared"), None, ["unknown", "unknown", None, "unknown"]),
        (("collision", "contact"), ("clamp",), ["clamp"]),
        (("contact",), ("push", "unknown"), ["unknown", "unknown", "push"]),
        (("collision", "cleared"), ("impact",), ["impact", None]),
    ],
)
def test_a_reaction_bound_to_kinds_waits_until_they_are_known(on, touch, expected):
    done = []
    thread = ReactionThread(Reaction("one", on, touch=touch, stop=True), lambda event: done.append(event.touch))
    for k, event in enumerate(events_of(said(TOUCH, ALARM))):
        thread.put(
            ReactionEvent(event.kind, f"joint {k}", event.t_ns, 0, FACTS, 1, event.touch, event.news)
        )  # none merged
    thread.end(time.monotonic() + 20)
    assert done == expected


def test_commands_find_the_kind_in_their_environment():
    content = content_of(ReactionEvent("collision", JOINTS[0], 7, 0, FACTS, touch="clamp", news=False))
    assert content["environment"]["TAUEXT_TOUCH"] == "clamp"


FILE = "[reactions.open]\non = {on}\ntouch = {touch}\nstop = true\n"


def test_a_file_binds_a_reaction_to_kinds(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(FILE.format(on='["collision"]', touch='["clamp", "unknown"]'))
    assert load_cell(path, JOINTS).reactions[0].touch == ("clamp", "unknown")
    for on, touch, words in (
        ('["collision"]', '["squeeze"]', "must be one of unknown, impact, push, clamp, load"),
        ('["fault"]', '["clamp"]', "touch cannot apply to fault; on needs collision or contact"),
        ('["collision"]', "[]", "must be one of unknown"),
    ):
        path.write_text(FILE.format(on=on, touch=touch))
        with pytest.raises(ConfigError, match="touch") as error:
            load_cell(path, JOINTS)
        assert words in str(error.value) and "\n" not in str(error.value)


def test_run_says_what_the_monitor_says():
    bundle, samples = watching_bundle(), pushed()
    offline = _core.estimate(bundle, samples.t_ns, samples.q, samples.dq, samples.tau, 1)["touch"]
    online = _core.Monitor(bundle).run(samples.t_ns, samples.q, samples.dq, samples.tau)
    np.testing.assert_array_equal(offline, online["touch"])
    np.testing.assert_array_equal(online["touch"] > 0, online["alarm"] > 0)
    changes = [c for chunk in replay(_core.Monitor(bundle), samples) for c in chunk.changes]
    rows = [c.row for c in changes if isinstance(c, TouchChange)]
    known = online["touch"] >= IMPACT
    assert rows == np.flatnonzero(known & (online["touch"] != np.append(0, online["touch"][:-1]))).tolist()


def test_touches_are_those_of_the_core():
    assert json.loads(json.dumps(TOUCHES)) == ["none", "unknown", "impact", "push", "clamp", "load"]
