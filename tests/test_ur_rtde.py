"""The source `ur:` with the real library, against a controller mocked packet by packet."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from made_ur_rtde import ADDRESSES, Controller, value
from tauext_commission.connect import connect
from tauext_commission.lasting import LastingSource

from tauext.errors import ConfigError
from tauext.sources import reader
from tauext.sources.ur import JOINTS, RTDE_PORT, VARIABLES, UrSource

pytest.importorskip("rtde_receive", reason="ur_rtde is not installed")
WAIT_S = 20.0


@pytest.fixture(params=[False, True], ids=["e-Series", "CB3"])
def controller(request):
    made = Controller(cb3=request.param)
    yield made
    made.close()


def taken(source, count: int) -> list:
    found, until = [], time.monotonic() + WAIT_S
    while len(found) < count:
        assert time.monotonic() < until, (source.notes(), source.counts)
        if (sample := source.next_sample(0.1)) is not None:
            found.append(sample)
    return found


def test_the_controllers_rate_is_found_and_its_packets_are_the_samples(controller):
    source = UrSource(controller.host)
    facts = source.describe(WAIT_S)
    assert facts.settings.joints == JOINTS and facts.settings.period_ns == round(1e9 / controller.fastest_hz)
    assert controller.do("") == [(controller.fastest_hz, VARIABLES)]
    source.open(facts.settings)
    try:
        for sample in taken(source, 50):
            number = round((sample.t_ns * 1e-9 - controller.begun_s) * controller.fastest_hz)
            for name, signal in (
                ("actual_q", sample.q), ("actual_qd", sample.dq), ("actual_current", sample.tau),
                ("joint_temperatures", sample.temperature),
            ):  # fmt: skip
                np.testing.assert_allclose(signal, value(name, number), rtol=1e-12)
    finally:
        source.close()


def test_a_controller_that_restarts_is_found_again_and_its_clock_begins_anew(monkeypatch):
    monkeypatch.setattr(reader, "RETRY_S", 0.1)
    controller = Controller()
    source = UrSource(controller.host)
    facts = source.describe(WAIT_S)
    lasting = LastingSource(source, lambda: UrSource(controller.host), facts)
    lasting.open(facts.settings)
    try:
        before = taken(lasting, 20)[-1]
        controller.do("restart")
        after = before
        until = time.monotonic() + WAIT_S
        while after.t_ns >= before.t_ns:
            assert time.monotonic() < until, lasting.notes()
            after = lasting.next_sample(0.1) or after
        assert after.t_ns < before.t_ns - 90e9 and not lasting.ended
        assert any("reconnect" in note for note in lasting.notes())
    finally:
        lasting.close()
        controller.close()


def test_a_controller_that_boots_does_not_hold_up_the_process(monkeypatch):
    """It accepts connections and answers nothing, for which the library would wait for ever."""
    monkeypatch.setattr("tauext.sources.ur.ANSWER_S", 0.2)
    host = f"127.0.0.{next(ADDRESSES)}"
    with (
        socket.create_server((host, RTDE_PORT)),
        pytest.raises(ConfigError, match="no controller answers on port 30004"),
    ):
        UrSource(host).describe(WAIT_S)
    with pytest.raises(ConfigError, match="no controller answers on port 30004: .*refused"):
        UrSource(host).describe(WAIT_S)


def test_nobody_there_and_a_controller_that_sends_nothing_are_distinguished():
    controller = Controller()
    try:
        controller.do("silence")
        with pytest.raises(ConfigError, match="samples came; 21 are needed"):
            connect(lambda: UrSource(controller.host), wait_s=1.0)
    finally:
        controller.close()
    with pytest.raises(ConfigError, match=f"ur {controller.host}: "):
        connect(lambda: UrSource(controller.host), wait_s=1.0)
