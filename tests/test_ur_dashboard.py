"""The stop of a UR arm through the dashboard server: checked before the loop begins, confirmed by the controller."""

from __future__ import annotations

import socket
import threading

import pytest
from made_ur import NOT_ALLOWED, Controller

from tauext.errors import ConfigError
from tauext.monitor.cell_file import Reaction
from tauext.monitor.reactions import start_reactions
from tauext.monitor.source import StopChecked, Stoppable
from tauext.sources import ur_dashboard
from tauext.sources.ur import UrSource
from tauext.sources.ur_dashboard import Dashboard, DashboardError

STOP = Reaction("stop the arm", ("collision", "fault"), stop=True)


@pytest.fixture
def controllers():
    """Makes controllers, which are closed at the end."""
    made = []

    def make(**settings) -> Controller:
        made.append(Controller(**settings))
        return made[-1]

    yield make
    for one in made:
        one.close()


def source_of(port: int, monkeypatch) -> UrSource:
    monkeypatch.setattr(UrSource, "dashboard_port", port)
    return UrSource("127.0.0.1")


@pytest.mark.parametrize("cb3", [False, True])
def test_a_stop_is_checked_at_the_start_and_uses_the_same_connection(controllers, monkeypatch, cb3):
    controller = controllers(cb3=cb3)
    source = source_of(controller.port, monkeypatch)
    assert isinstance(source, Stoppable) and isinstance(source, StopChecked)
    reactions = start_reactions([STOP], source, [])
    asked = ["is in remote control", *(["PolyscopeVersion"] if cb3 else [])]
    assert controller.commands == asked
    source.stop()
    assert controller.commands == [*asked, "stop"] and controller.connections == 1
    source.close()
    reactions.end()


def test_no_dashboard_is_needed_where_no_reaction_stops(monkeypatch):
    source = source_of(1, monkeypatch)
    start_reactions([Reaction("note", ("collision",), command=("true",))], source, []).end()


def test_a_refused_connection_is_one_line_before_the_loop(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(ConfigError) as raised:
        start_reactions([STOP], source_of(port, monkeypatch), [])
    assert str(raised.value) == (
        f"ur 127.0.0.1: `stop = true` would fail: dashboard server 127.0.0.1:{port}: Connection refused"
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"remote": False}, "the arm is in local control: switch it to remote control on the teach pendant"),
        ({"greeting": "220 files.example FTP"}, "no dashboard server: it begins with '220 files.example FTP'"),
        ({"greeting": "x" * 5000}, "no dashboard server: it begins with 'xxx|no line ends within 4096 bytes"),
        ({"answers": {"is in remote control": None}}, "the connection was closed"),
        (
            {"answers": {"is in remote control": "could not understand: 'is in remote control'"}},
            "PolyScope 3, or PolyScope 5.6 and later",
        ),
        (
            {"cb3": True, "answers": {"PolyscopeVersion": "could not understand: 'PolyscopeVersion'"}},
            "the version \"could not understand: 'PolyscopeVersion'\"",
        ),
        ({"answers": {"is in remote control": "\xff\x00"}}, "the answer to 'is in remote control' is "),
    ],
)
def test_wrong_answers_are_refused_before_the_loop(controllers, monkeypatch, settings, message):
    controller = controllers()
    for name, value in settings.items():
        setattr(controller, name, value)
    with pytest.raises(ConfigError, match=message) as raised:
        source_of(controller.port, monkeypatch).check_stop()
    assert "\n" not in str(raised.value)


def test_a_server_without_a_word_is_given_up(monkeypatch):
    monkeypatch.setattr(ur_dashboard, "TIMEOUT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(DashboardError, match=f"dashboard server 127.0.0.1:{port}: timed out"):
            Dashboard("127.0.0.1", port).check()


@pytest.mark.parametrize("answer", ["Failed to execute: stop", NOT_ALLOWED, "Stopped?", ""])
def test_a_stop_that_is_not_confirmed_fails_with_the_answer(controllers, answer):
    controller = controllers()
    controller.answers["stop"] = answer
    dashboard = Dashboard("127.0.0.1", controller.port)
    with pytest.raises(DashboardError, match="the answer to 'stop' is ") as raised:
        dashboard.stop()
    assert repr(answer) in str(raised.value)


def test_a_dead_connection_is_replaced_when_the_stop_is_needed(controllers):
    stopped = threading.Event()
    controller = controllers(stopped=stopped.set)
    dashboard = Dashboard("127.0.0.1", controller.port)
    dashboard.check()
    controller.drop()
    dashboard.stop()
    assert stopped.is_set() and controller.connections == 2


def test_a_connection_from_before_remote_control_is_replaced(controllers):
    stopped = threading.Event()
    controller = controllers(remote=False, stopped=stopped.set)
    dashboard = Dashboard("127.0.0.1", controller.port)
    assert dashboard._ask("is in remote control") == "false"
    controller.remote = True  # the controller refuses the old connection all the same
    dashboard.stop()
    assert stopped.is_set() and controller.commands == ["is in remote control", "stop", "stop"]
