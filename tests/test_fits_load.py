"""An alarm that is a load says so, and one that is a push does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_load_found import QUIET, arm, bundle_of, carrying, free_motion, made_motion, phi_of, pushed  # noqa: F401

from tauext import _core
from tauext.data.recording import Recording
from tauext.monitor.explanation import explain
from tauext.monitor.flight_content import Flight, rows_kept
from tauext.monitor.flight_files import FlightSource
from tauext.monitor.replay import replay
from tauext.monitor.weighing import load_frame

COM = np.array([0.03, -0.02, 0.06])
ON = 600
"""The sample, of 1200 in 12 s, from which on something is added."""


def from_then_on(before: Recording, after: Recording) -> Recording:
    """The motion of both, which is the same, with what the second adds."""
    tau = before.tau.copy()
    tau[ON:] = after.tau[ON:]
    return replace(before, tau=tau)


def with_load(arm: _core.Tree, free: Recording, mass: float) -> Recording:  # noqa: F811
    """What the motors give for a ball at the last joint too, at rest: its inertia is left out."""
    p, beta = _core.load_columns(arm, _core.LoadFrame(5), free.q, 0 * free.dq)
    return from_then_on(free, replace(free, tau=free.tau + beta @ phi_of(mass, COM)))


def flight_of(bundle: _core.Bundle, recording: Recording) -> Flight:
    recorder = _core.FlightRecorder(bundle.joints, bundle.observer.sample_period_ns, 2.0, 1.0)
    monitor = _core.Monitor(bundle)
    for _ in replay(monitor, recording, recorder=recorder, chunk_s=0.5):
        flight = recorder.take()
        if flight:
            return flight
    raise AssertionError("no alarm")


def said(bundle: _core.Bundle, flight: Flight, recording: Recording) -> list[str]:
    text = explain(flight, rows_kept(flight), FlightSource.of(bundle, recording))
    return [line for line in text.splitlines() if "fit a load" in line]


def test_what_came_on_as_a_load_is_weighed_from_the_second_behind_the_alarm(arm, free_motion):  # noqa: F811
    bundle, motion = bundle_of(arm, free_motion), with_load(arm, free_motion, 2.2)
    (line,) = said(bundle, flight_of(bundle, motion), motion)
    words = line.split()
    mass, error = (float(words[words.index("±") + k]) for k in (-1, 1))
    assert abs(mass - 2.2) < 3 * error and error < 0.5
    assert line.endswith(f"kg at {load_frame(bundle).name}: if the arm picked something up, tell the monitor.")
    assert float(words[1]) >= 5 / bundle.observer.gain_per_s - 0.011  # r has settled by then


@pytest.mark.parametrize("force", [(60.0, 15.0, 0.0), (0.0, -50.0, 0.0), (0.0, 0.0, 60.0)])
def test_a_force_to_the_side_or_upwards_is_called_no_load(arm, free_motion, force):  # noqa: F811
    bundle = bundle_of(arm, free_motion)
    motion = from_then_on(free_motion, pushed(arm, free_motion, np.array(force)))
    assert said(bundle, flight_of(bundle, motion), motion) == []


def test_a_push_that_has_ended_is_no_load(arm, free_motion):  # noqa: F811
    bundle, tau = bundle_of(arm, free_motion), with_load(arm, free_motion, 5.0).tau.copy()
    tau[ON + 12 :] = free_motion.tau[ON + 12 :]
    motion = replace(free_motion, tau=tau)
    assert said(bundle, flight_of(bundle, motion), motion) == []


def test_nobody_weighs_in_another_unit_or_without_the_bundle(arm, free_motion):  # noqa: F811
    bundle, motion = bundle_of(arm, free_motion), with_load(arm, free_motion, 2.2)
    flight, source = flight_of(bundle, motion), FlightSource.of(bundle, motion)
    kept = rows_kept(flight)
    assert "fit a load" in explain(flight, kept, source)
    assert "fit a load" not in explain(flight, kept, replace(source, chain=None))
    assert "fit a load" not in explain(flight, kept, replace(source, estimate_units=("A",) * 6))
