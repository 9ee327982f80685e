"""Which signal of servos a training recommends: made signals with late goals, and the remedy applied."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tauext_lerobot.servo_signals import SignalLimits, comparison_sentence, made_from, other_sources, size_of_pushes

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.dataset import load_dataset
from tauext.data.servo_types import SERVO_TYPES

SERVO = SERVO_TYPES["sts3215-7.4v"]
RATE_HZ, SECONDS, RUNS = 50, 40.0, 10
LATE_S = 0.03
"""How much later than their stamps the goals of the last recording acted."""
ARM = """\
[robot]
joints = ["pan", "lift"]

[time]
column = "t"

[servo]
type = "sts3215-7.4v"
torque_from = "{source}"
goal_delay_s = 0

[signals]
q.columns = "q_{{joint}}"
q_des.columns = "goal_{{joint}}"
current.columns = "current_{{joint}}"

[split]
train = {files}
"""


def run_of(number: int, late_s: float) -> pa.Table:
    """A servo's registers in smooth motion against friction, inertia and gravity, of the motor's own equations."""
    rng, t = np.random.default_rng(number), np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    columns: dict[str, np.ndarray] = {"t": t}
    for joint, (inertia, gravity) in zip(("pan", "lift"), ((0.01, 0.0), (0.015, 0.3)), strict=True):
        w = 2 * np.pi * rng.uniform(0.1, 0.5, 4)
        size, phase = 0.8 * rng.uniform(0.5, 1.5) / w.sum() * np.ones(4), rng.uniform(0, 2 * np.pi, 4)

        def motion(times, w=w, size=size, phase=phase):
            x = np.outer(times, w) + phase
            return np.sin(x) @ size, np.cos(x) @ (size * w), -np.sin(x) @ (size * w**2)

        q, dq, ddq = motion(t)
        torque = (
            inertia * ddq + 0.08 * np.tanh(dq / 0.02) + 0.05 * dq + gravity * np.cos(q) + rng.normal(0, 0.01, len(t))
        )
        ampere = torque / SERVO.nm_per_ampere
        duty = (SERVO.ohm * ampere + SERVO.back_emf_v_s * dq) / SERVO.volts
        goal = q + duty / (SERVO.gain * SERVO.duty_per_rad)
        columns[f"q_{joint}"] = np.round(q / SERVO.count_rad) * SERVO.count_rad
        columns[f"goal_{joint}"] = goal + (motion(t + late_s)[0] - q)
        columns[f"current_{joint}"] = np.abs(duty * ampere)
    return pa.table(columns)


def training(folder: Path) -> tuple[str, ...]:
    """The motors have no ripple, and the search for one takes long."""
    (folder / "study.toml").write_text("[prior]\nmost_ripples = 0\n")
    return ("--recipe", "prior", "--limits", "supported", "--config", str(folder / "study.toml"))


def names() -> list[str]:
    return [f"run{k}.parquet" for k in range(RUNS)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings, the last with late goals, imported by both signals."""
    folder = tmp_path_factory.mktemp("servos")
    for number, name in enumerate(names()):
        pq.write_table(run_of(number, LATE_S * (number == RUNS - 1)), folder / name)
    for source in ("goal", "supply-current"):
        (folder / f"{source}.toml").write_text(ARM.format(source=source, files=json.dumps(names())))
        words = ["--arm", str(folder / f"{source}.toml"), "--out", str(folder / source)]
        assert main(["import", "--source", *(str(folder / name) for name in names()), *words]) == 0
    return folder


@pytest.mark.slow
def test_a_recording_made_again_equals_one_imported_with_that_signal(folder):
    """To the last bit, with the delay of goals that arm.toml states."""
    by_goal, by_current = (load_dataset(folder / name).training() for name in ("goal", "supply-current"))
    assert other_sources(by_goal) == ["supply_current"] and other_sources(by_current) == ["goal"]
    for one, other in zip(by_goal, by_current, strict=True):
        made = made_from(one, "supply_current")
        np.testing.assert_array_equal(made.tau, other.tau)
        np.testing.assert_array_equal(made.dq, other.dq)
        assert made.provenance["servo"] == other.provenance["servo"]


def test_other_signals_are_those_that_all_recordings_hold(folder):
    one, two = load_dataset(folder / "goal").training()[:2]
    assert other_sources([one, replace(two, current=None)]) == []
    signed = replace(one, current=one.current * np.sign(one.dq))
    assert other_sources([signed]) == ["phase_current"]
    assert other_sources([replace(one, duty=one.current)]) == ["supply_current", "duty"]
    assert other_sources([replace(one, provenance={})]) == []


@pytest.mark.slow
def test_training_names_the_better_signal_and_the_remedy_holds(folder, capsys):
    facts = {}
    for source in ("goal", "supply-current"):
        bundle = folder / f"{source}.tauext"
        words = ["train", "--data", str(folder / source), *training(folder), "--out", str(bundle)]
        assert main(words) == 0
        facts[source] = json.loads(load_bundle(bundle).provenance)["limits"]
        said = capsys.readouterr().err
        if source == "goal":
            sentence = facts[source]["signals"]["sentence"]
            assert sentence in " ".join(said.split()) and 'torque_from = "supply-current" in [servo]' in sentence
            assert (
                "The target false alarm rate is exceeded in motion unlike any recording: expect"
                in facts[source]["sentence"]
            )
            assert main(["show", str(bundle)]) == 0 and sentence[:60] in " ".join(capsys.readouterr().out.split())
    compared = facts["goal"]["signals"]["compared"]
    assert [one["torque_from"] for one in compared] == ["goal", "supply_current"]
    assert compared[0]["false"] > compared[0]["promised"]
    # What is predicted for the current is what a training with it gives.
    other = facts["supply-current"]["other_motion"]
    assert compared[1]["false"] == sum(other["false"].values()) and compared[1]["promised"] == other["promised"]
    assert compared[1]["false"] < compared[0]["false"]


def test_few_recordings_are_not_compared(folder, capsys, tmp_path):
    few = tmp_path / "few"
    shutil.copytree(folder / "goal", few)
    split = json.loads((few / "split.json").read_text())
    (few / "split.json").write_text(json.dumps(split | {"train": split["train"][-5:]}))
    assert main(["train", "--data", str(few), *training(folder), "--out", str(tmp_path / "few.tauext")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "not compared: 5 recordings show little of other motion; 10 or more do" in said and "By the goal" not in said


def limits(source: str, false: int, share: float, kept_by: float = 1.0) -> SignalLimits:
    return SignalLimits(source, false, 3.0, kept_by, (share, 2 * share, 3 * share))


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ([], "No other signal of the servos is recorded: record their current or duty too"),
        (
            [limits("supply_current", 2, 0.5)],
            "By the current of the supply they raise 2 (target 3), and thresholds that keep the target there detect "
            'pushes 0.62 times as large. For that, set torque_from = "supply-current" in [servo] of arm.toml, and '
            "import again.",
        ),
        ([limits("duty", 2, 0.7), limits("phase_current", 9, 0.75)], 'set torque_from = "duty" in [servo]'),
        ([limits("duty", 8, 0.8), limits("phase_current", 9, 0.2)], 'set torque_from = "phase-current" in [servo]'),
        ([limits("duty", 20, 0.1)], "No other recorded signal is better."),
        ([limits("duty", 2, 0.9)], "No other recorded signal is better."),
    ],
)
def test_the_sentence_names_what_each_signal_raises_and_detects(others, words):
    own = limits("goal", 12, 0.4, kept_by=2.0)
    said = comparison_sentence(own, others)
    assert said.startswith(
        "By the goal and the position, thresholds from the other recordings raise 12 false alarms (target 3)."
    )
    assert words in said
    assert size_of_pushes(limits("duty", 2, 0.5, 1.6), own) == pytest.approx(0.5 * 1.6 / (0.4 * 2.0))
