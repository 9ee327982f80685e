"""Reactions: each does what its file says, and none that fails, hangs, dies or is slow delays the monitor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from made_bundles import JOINTS, pushed, watching_bundle
from made_live import Keeper, Replayed

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.cell_file import Reaction, load_cell
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.reactions import (
    HELPER,
    ReactionFailed,
    ReactionProcess,
    Reactions,
    ReactionThread,
    content_of,
    start_reactions,
)
from tauext.monitor.sink import ReactionEvent
from tauext.sources.replay import ReplaySource

FACTS = {"joints": list(JOINTS), "tau_ext_nm": [1.5, None], "limit_nm": [2.0, 3.0], "health": "ok", "causes": []}
FACTS["contact_limit_nm"] = [1.0, 1.5]


def event(kind="collision", joint="shoulder", t_ns=7, received_ns=None) -> ReactionEvent:
    return ReactionEvent(kind, joint, t_ns, time.monotonic_ns() if received_ns is None else received_ns, FACTS)


def wait_for(what, seconds: float = 20.0) -> None:
    """Until it is true; a machine may be slow, but not for ever."""
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.005)


def gone(pid: int) -> bool:
    """Whether the process has ended; who waits for it may have gone, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z"
    except OSError:
        return True


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes the module that reactions call, in the folder that everything runs in."""
    monkeypatch.chdir(tmp_path)

    def write(text: str) -> Path:
        path = tmp_path / "called.py"
        path.write_text(text)
        return tmp_path

    return write


def reactions_of(tmp_path, text: str) -> tuple[Reaction, ...]:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return load_cell(path, JOINTS).reactions


# The queue.


def thread_of(act, **changes) -> ReactionThread:
    rule = {"name": "r", "on": ("collision", "contact", "fault", "cleared"), "command": ("true",)} | changes
    return ReactionThread(Reaction(**rule), act)


def test_events_that_wait_are_merged_by_kind_and_joint_and_come_in_the_order_of_the_newest():
    done, gate = [], threading.Event()

    def act(one):
        done.append((one.kind, one.joint, one.merged, one.t_ns))
        gate.wait(20)

    thread = thread_of(act)
    thread.put(event(t_ns=0))
    wait_for(lambda: done)
    for k in range(1000):
        thread.put(event("contact", "elbow", t_ns=k))
    thread.put(event("cleared", None, t_ns=1))
    thread.put(event("contact", "shoulder", t_ns=2))
    thread.put(event("cleared", None, t_ns=3))
    gate.set()
    thread.end(time.monotonic() + 20)
    assert done[1:] == [("contact", "elbow", 1000, 999), ("contact", "shoulder", 1, 2), ("cleared", None, 2, 3)]
    count = thread.count
    assert (count.done, count.merged, count.failed, count.left) == (4, 1000, 0, 0)
    assert count.start.count == 4 and [n.event.merged for n in thread.news()] == [1, 1000, 1, 2]


def test_a_reaction_is_for_its_events_and_joints_alone():
    done = []
    thread = thread_of(lambda one: done.append((one.kind, one.joint)), on=("collision", "fault"), joints=("elbow",))
    for one in (event(), event(joint="elbow"), event("contact", "elbow"), event("fault", None), event("fault")):
        thread.put(one)
    thread.end(time.monotonic() + 20)
    assert done == [("collision", "elbow"), ("fault", None)]


def test_events_within_the_least_interval_are_counted_and_left_alone():
    done = []
    thread = thread_of(lambda one: done.append(one.t_ns), min_interval_s=1.0)
    for t_ns, received_s in ((0, 5.0), (1, 5.9), (2, 6.0), (3, 6.5)):
        thread.put(event(t_ns=t_ns, received_ns=round(received_s * 1e9)))
        wait_for(lambda: not thread._waiting)
    thread.put(event("cleared", None, t_ns=4, received_ns=round(6.6e9)))
    thread.end(time.monotonic() + 20)
    assert done == [0, 2, 4] and thread.count.held_back == 2


@pytest.mark.parametrize("failure", [ValueError("no lamp"), SystemExit(1), KeyboardInterrupt()])
def test_one_that_raises_is_reported_and_goes_on_with_the_next_event(failure):
    def act(one):
        if one.kind == "collision":
            raise failure

    thread = thread_of(act)
    thread.put(event())
    wait_for(lambda: thread.count.failed)
    thread.put(event("cleared", None))
    thread.end(time.monotonic() + 20)
    assert (thread.count.done, thread.count.failed) == (1, 1)
    assert thread.news()[0].error == (str(failure) or type(failure).__name__)


def test_one_that_hangs_at_the_end_is_left_and_counted():
    began, never = threading.Event(), threading.Event()

    def act(one):
        began.set()
        never.wait()

    thread = thread_of(act)
    thread.put(event())
    assert began.wait(20)
    thread.put(event("cleared", None))
    thread.end(time.monotonic())
    assert thread.count.left == 2 and thread.count.done == 0
    never.set()


# Processes.


def test_a_command_gets_the_facts_in_its_environment_and_on_stdin(tmp_path):
    code = "import json, os, sys; json.dump([json.load(sys.stdin), dict(os.environ)], open(sys.argv[1], 'w'))"
    out = tmp_path / "out.json"
    process = ReactionProcess(Reaction("r", ("collision",), command=(sys.executable, "-c", code, str(out))))
    try:
        before = time.monotonic_ns()
        began_ns = process.act(event(t_ns=123))
        assert before <= began_ns <= time.monotonic_ns()
    finally:
        process.close()
    facts, environment = json.loads(out.read_text())
    assert facts == {"event": "collision", "joint": "shoulder", "t_ns": 123, "merged": 1, **FACTS}
    expected = {"EVENT": "collision", "JOINT": "shoulder", "TAU_EXT_NM": "1.5", "LIMIT_NM": "2", "HEALTH": "ok"}
    assert {k: environment[f"TAUEXT_{k}"] for k in expected} == expected
    assert environment["TAUEXT_CAUSES"] == "" and environment["TAUEXT_T_NS"] == "123"
    assert content_of(event(joint="elbow"))["environment"]["TAUEXT_TAU_EXT_NM"] == ""  # there is no number
    limits = [content_of(event(kind))["environment"]["TAUEXT_LIMIT_NM"] for kind in ("collision", "contact")]
    assert limits == ["2", "1"]


def test_functions_that_fail_hang_or_end_their_process_find_a_new_one(module):
    module(
        "import os, time\n"
        "def react(facts):\n"
        "    print('to stderr, not into the answers')\n"
        "    if facts['t_ns'] == 1: raise ValueError('no lamp')\n"
        "    if facts['t_ns'] == 2: os._exit(7)\n"
        "    if facts['t_ns'] == 3:\n"
        "        while True: pass\n"
        "    open(f'done{facts[\"t_ns\"]}', 'w').close()\n"
    )
    process = ReactionProcess(Reaction("r", ("collision",), python="called:react", timeout_s=1.0))
    try:
        for t_ns, message in (
            (0, None),
            (1, "ValueError: no lamp"),
            (0, None),
            (2, "its process ended with status 7"),
            (3, "took longer than 1 s and was killed"),
            (4, None),
        ):
            if message is None:
                process.act(event(t_ns=t_ns))
                assert Path(f"done{t_ns}").exists()
            else:
                with pytest.raises(ReactionFailed, match=message):
                    process.act(event(t_ns=t_ns))
    finally:
        process.close()


def test_a_command_that_hangs_is_killed_with_all_it_started(tmp_path):
    script = f"sleep 60 & echo $! > {tmp_path / 'pid'}; wait"
    process = ReactionProcess(Reaction("r", ("collision",), command=("sh", "-c", script), timeout_s=1.0))
    with pytest.raises(ReactionFailed, match="took longer than 1 s"):
        process.act(event())
    wait_for(lambda: gone(int((tmp_path / "pid").read_text())))


def test_a_monitor_that_is_killed_leaves_nothing_running(module, tmp_path):
    module("import os, time\ndef react(facts):\n    open('pid', 'w').write(str(os.getpid()))\n    time.sleep(600)\n")
    code = (
        "from test_live_reactions import *\n"
        "ReactionProcess(Reaction('r', ('collision',), python='called:react', timeout_s=600.0)).act(event())\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])}
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=environment) as killed:
        wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
        killed.kill()
    wait_for(lambda: gone(int((tmp_path / "pid").read_text())))


def test_a_command_s_exit_status_is_reported():
    process = ReactionProcess(Reaction("r", ("collision",), command=("sh", "-c", "exit 3")))
    try:
        with pytest.raises(ReactionFailed, match="exit status 3"):
            process.act(event())
    finally:
        process.close()


def test_the_helper_needs_the_standard_library_alone():
    import ast

    names = set()
    for node in ast.walk(ast.parse(HELPER.read_text())):
        names |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
        assert not isinstance(node, ast.ImportFrom)
    assert names <= sys.stdlib_module_names


def test_what_is_not_there_is_refused_before_the_loop_begins(module):
    module("not_a_function = 3")
    for changes, message in (
        ({"command": ("no-such-program",)}, "there is no program 'no-such-program'"),
        ({"python": "no_such_module:f"}, "No module named 'no_such_module'"),
        ({"python": "called:f"}, "has no attribute 'f'"),
        ({"python": "called:not_a_function"}, "cannot be called"),
        ({"publish": True}, "source replay pushed publishes nothing"),
    ):
        with pytest.raises(ConfigError, match=message):
            start_reactions([Reaction("r", ("collision",), **changes)], ReplaySource(pushed()), [])


# In the loop.


@pytest.mark.slow
def test_no_reaction_delays_or_changes_what_the_monitor_says(module, tmp_path, monkeypatch):
    monkeypatch.setattr("tauext.monitor.reactions.END_S", 0.5)
    module(
        "import os\n"
        "def hang(facts):\n"
        "    while True: pass\n"
        "def die(facts): os._exit(1)\n"
        "def fail(facts): raise ValueError\n"
        "def good(facts): open('good', 'a').write(facts['event'] + ' ')\n"
    )
    names = ("hang", "die", "fail", "good")
    text = "".join(f'[reactions.{n}]\non = ["contact", "collision", "cleared"]\npython = "called:{n}"\n' for n in names)
    rules = reactions_of(tmp_path, text)
    bundle, recording, keeper = watching_bundle(), pushed(), Keeper()
    source = ReplaySource(recording, None)
    reactions = start_reactions(rules, source, [keeper])
    tests = {thread.reaction.name: thread for thread in reactions.threads}
    before = time.monotonic()
    loop = Loop(bundle, source, [keeper], reactions, settings=LoopSettings(acknowledge_after_s=0.5))
    loop.run()
    assert time.monotonic() - before < 60  # it ended, though one hangs
    said = {key: np.concatenate([v.estimates[key] for v in keeper.verdicts]) for key in ("tau_ext", "health", "alarm")}
    monitor = _core.Monitor(bundle)
    plain = monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)
    np.testing.assert_array_equal(said["tau_ext"], plain["tau_ext"])
    # Two pushes, each a contact and a collision, and each cleared when it was acknowledged.
    good = Path("good").read_text().split()
    counts = {name: thread.count for name, thread in tests.items()}
    assert len(good) >= counts["good"].done
    for count in counts.values():
        assert count.done + count.failed + count.merged + count.left == 6
    assert counts["good"].failed == 0 and counts["hang"].done == counts["die"].done == counts["fail"].done == 0
    assert counts["hang"].left >= 1 and counts["fail"].failed >= 1


def test_publish_and_stop_reach_sinks_and_source():
    published = []

    class Publishing(Keeper):
        def publish_event(self, one):
            published.append(one)

    sink, source = Publishing(), Replayed(pushed(), None)
    rules = [Reaction("p", ("contact",), publish=True), Reaction("s", ("collision",), stop=True)]
    reactions = start_reactions(rules, source, [sink])
    slow = Keeper(lambda verdict: verdict.row > 2016 and wait_for(lambda: source.ended))
    Loop(watching_bundle(), source, [sink, slow], reactions).run()
    assert [(one.kind, one.joint) for one in published] == [("contact", "shoulder")]
    assert published[0].facts["bundle"] == "watching" and published[0].facts["alarm"] == "contact"
    assert len(sink.verdicts) in (2017, 2018)  # the stop comes before or after the sample behind the collision


def test_events_are_cleared_once_after_contact_collision_and_fault():
    found = []

    class Collected(Reactions):
        def put(self, one):
            if one.news:  # beside its kind of touch
                found.append((one.kind, one.joint, one.facts["row"]))

    recording = pushed(pushes=((2.0, 1, -1.7), (3.6, 0, 12.0)))
    Loop(watching_bundle(), ReplaySource(recording, None), [], Collected()).run()
    kinds = [kind for kind, _, _ in found]
    assert kinds == ["contact", "cleared", "contact", "collision"]  # the collision stands to the end
    assert [joint for _, joint, _ in found] == ["elbow", None, "shoulder", "shoulder"]


# The file.

GOOD = """
[reactions.lamp]
on = ["collision", "cleared"]
joints = ["elbow"]
min_interval_s = 1
command = ["true", "x"]
"""


def test_a_file_is_read(tmp_path):
    (found,) = reactions_of(tmp_path, GOOD)
    assert found == Reaction("lamp", ("collision", "cleared"), ("elbow",), 1.0, 5.0, ("true", "x"))


@pytest.mark.parametrize(
    "change, message",
    [
        (
            ("min_interval_s", "min_intervall_s"),
            r"\[reactions.lamp\] unknown key 'min_intervall_s'; the nearest known is 'min_i",
        ),
        (
            ('"collision", ', '"colision", '),
            "on = .'colision', .* must be one of collision, contact, fault, cleared, or a list of such",
        ),
        (('on = ["collision", "cleared"]', ""), "on is missing; it must be one of collision"),
        (('["elbow"]', '["wrist"]'), "joints = .'wrist'. must be one of shoulder, elbow, or a list of such"),
        (('["elbow"]', "[]"), "joints = .. must be one of shoulder, elbow, or a list of such, not empty"),
        (('["elbow"]', "[[1]]"), r"joints = .*1.* must be one of shoulder"),
        (("= 1\n", "= -1\n"), "min_interval_s = -1 must be a number from 0 to 86400"),
        (('["true", "x"]', '"true x"'), "must be a list, each text: ..program., .argument.."),
        (('["true", "x"]', "[]"), r"command = \[\] must be a list, each text: "),
        (('command = ["true", "x"]', ""), "no action is given; it must be one of command, python, publish, stop"),
        (('command = ["true", "x"]', 'command = ["a"]\nstop = true'), "command and stop are given"),
        (('command = ["true", "x"]', 'python = "lamp"'), 'python = .lamp. must be text: "module:function"'),
        (('command = ["true", "x"]', "python = 3"), 'python = 3 must be text: "module:function"'),
        (('command = ["true", "x"]', "publish = 1"), "publish = 1 must be true or false"),
        ((GOOD, GOOD + GOOD), "not readable as TOML"),
        ((GOOD, "reactions = 3"), "reactions = 3 must be a table"),
        ((GOOD, "reactions.lamp = 3"), r"\[reactions.lamp\] is 3, must be a table"),
        ((GOOD, "[[reaction]]"), "unknown key 'reaction'; the nearest known is 'reactions'"),
    ],
)
def test_a_file_that_breaks_a_rule_says_which(tmp_path, change, message):
    assert change[0] in GOOD
    with pytest.raises(ConfigError, match=message):
        reactions_of(tmp_path, GOOD.replace(*change))


def test_no_descriptor_is_left_open():
    there = set(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else set()
    for _ in range(3):
        process = ReactionProcess(Reaction("r", ("collision",), command=("true",)))
        process.act(event())
        process.close()
    assert set(os.listdir("/proc/self/fd") if there else ()) <= there
