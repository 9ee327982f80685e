"""Rows of several origins: what alternates, joined stretches, arms on two topics, and recordings of two rates."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from made_files import JOINTS, arm_text, clean_log, write
from made_recordings import JOINTS as LEFT
from made_recordings import joint_rows, write_bag

from tauext.cli.recordings import write_template
from tauext.data.description import parse_arm
from tauext.data.importing import import_dataset
from tauext.data.mixed_rows import alternating, joined
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError

T_S = np.arange(2000) / 100.0
MOTION = 0.8 * np.sin(2 * np.pi * T_S[:, None] * (0.3, 0.4, 0.5) + (0, 1, 2))


def test_rows_of_one_arm_do_not_alternate():
    noise = np.random.default_rng(0).normal(0, 1e-3, MOTION.shape)
    at_the_seam = np.where(np.arange(2000)[:, None] % 2, 1, -1) * np.pi * np.ones(3)
    one_sensor = MOTION.copy()
    one_sensor[::2, 1] = 0.0
    for q in (MOTION, MOTION + noise, at_the_seam, one_sensor, MOTION[::10], np.zeros((2000, 3)), MOTION[:3]):
        assert not alternating(q)
        assert joined(q, np.arange(len(q))) is None


def test_rows_of_two_writers_at_other_rates_alternate():
    order = np.random.default_rng(1).random(2000) < 0.3
    q = MOTION.copy()
    q[order] = MOTION[order] + 1.5
    found = re.search(r"(\d+) and (\d+) of (\d+) rows alternate", alternating(q))
    assert found is not None and abs(min(map(int, found.groups()[:2])) / int(found[3]) - 0.3) < 0.05
    q[order] = 0.25
    assert "the constant position 0.25, 0.25, 0.25 rad" in alternating(q)
    q = MOTION + 1.5
    q[:60] *= np.linspace(0, 1, 60)[
        :, None
    ]  # where the arm passes its zero, its rows are nearer to those of the other writer
    q[1::2] = 0.0
    assert "one has zeros" in alternating(q)


def test_joined_stretches_are_found_where_a_seam_does_not_show_and_spikes_are_none():
    order = np.concatenate([np.arange(250) + 250 * k for k in (0, 2, 5, 1, 6, 3, 4, 7)])  # 3 is followed by 4
    found = joined(MOTION[order], np.arange(2000))
    assert found is not None and found.rows == 250 and found.begins.tolist() == list(range(250, 2000, 250))
    assert 4 <= found.jumps <= 6
    spiked = MOTION.copy()
    spiked[200::200] += 1.0
    assert joined(spiked, np.arange(2000)) is None


def test_joined_stretches_of_any_length_are_found_and_standing_logs_are_none():
    parts = [slice(0, 300), slice(900, 1217), slice(400, 811), slice(1500, 1999)]
    uneven = np.concatenate([MOTION[part] for part in parts])
    found = joined(uneven, np.arange(len(uneven)))
    assert found is not None and not found.rows and found.begins.tolist() == [300, 617, 1028]
    two = np.concatenate([MOTION[:700], MOTION[1300:]])
    found = joined(two, np.arange(len(two)))
    assert found is not None and found.begins.tolist() == [700]
    lost = np.r_[np.arange(700), np.arange(1300, 2000)]
    assert joined(two, lost) is None  # a gap of the clock explains the jump
    stood = np.concatenate([MOTION[:700], np.repeat(MOTION[699:700], 80, axis=0), MOTION[780:]])
    assert joined(stood, np.arange(len(stood))) is None
    not_ready = np.concatenate([np.zeros((80, 3)), MOTION[80:]])
    assert joined(not_ready, np.arange(2000)) is None
    noise = np.random.default_rng(2).normal(0, 1e-4, (2000, 3))
    slow_then_fast = np.where(np.arange(2000)[:, None] < 1000, 0.01, 1.0) * MOTION + noise
    slow_then_fast[1000:] -= slow_then_fast[1000] - slow_then_fast[999]
    assert joined(slow_then_fast, np.arange(2000)) is None
    assert joined(MOTION[::10] + noise[::10], np.arange(200)) is None


def test_two_topics_of_joint_states_are_a_question_and_one_file_serves_both_arms(tmp_path, capsys):
    rows = {"/left/joint_states": joint_rows(samples=2400), "/right/joint_states": joint_rows(JOINTS, samples=2400)}
    bag = write_bag(tmp_path / "run", "sqlite3", rows)
    arm = tmp_path / "arm.toml"
    write_template(arm, (bag,), None)
    text = arm.read_text()
    assert text.count('topic = "?/left/joint_states"') == 3 and "/right/joint_states" in (
        said := capsys.readouterr().err
    )
    assert "for another arm, import the same file again with a description of its own" in said
    with pytest.raises(ConfigError, match=r"\[signals.q\] topic has '\?/left/joint_states'"):
        parse_arm(text)
    for side in ("left", "right"):
        out, described = tmp_path / side, tmp_path / f"{side}.toml"
        names = json.dumps(JOINTS if side == "right" else LEFT)
        chosen = re.sub(r'"\?/left', f'"/{side}', text)
        described.write_text(re.sub(r"(?m)^joints = .*", f"joints = {names}", chosen))
        import_dataset([bag], described, out, "tauext", lambda line: None)
        assert any(out.glob("*.parquet"))
    unasked = arm_text("ros1", JOINTS)
    (tmp_path / "unasked.toml").write_text(unasked)
    with pytest.raises(ConfigError, match=r"topic must be named, since run has several: /left/joint_states, /right"):
        import_dataset([bag], tmp_path / "unasked.toml", tmp_path / "out", "tauext", lambda line: None)


def test_recordings_of_two_rates_become_those_of_the_slower_one_and_the_cost_is_stated(tmp_path, monkeypatch):
    monkeypatch.setattr("tauext.data.importing.exporting", lambda name: lambda recordings, part: len(list(recordings)))
    paths = []
    for name, rate_hz in (("sweep", 125.0), ("run", 89.0)):
        folder = tmp_path / name
        path = write("csv", folder, clean_log(1500, rate_hz))
        paths.append(path.rename(folder / f"{name}.csv"))
    (tmp_path / "arm.toml").write_text(arm_text("csv") + '[split]\ntrain = ["sweep.csv", "run.csv"]\n')
    lines: list[str] = []
    import_dataset(paths, tmp_path / "arm.toml", tmp_path / "out", "tauext", lines.append)
    both = [load_recording(tmp_path / "out" / f"{name}.parquet") for name in ("sweep", "run")]
    assert [one.rate_hz for one in both] == [89.0, 89.0]
    fast = clean_log(1500, 125.0)
    true = np.stack([np.interp(both[0].t_ns, fast.t_ns, column) for column in fast.q.T], axis=1)
    np.testing.assert_allclose(both[0].q, true, atol=1e-12)
    np.testing.assert_array_equal(both[1].q, clean_log(1500, 89.0).q)
    (said,) = [line for line in lines if "resampled to 89 Hz" in line]
    assert "recordings at 125 Hz (1 of 2)" in said and "Nm rms at" in said
    with pytest.raises(ConfigError, match="run has 89 Hz, sweep 125 Hz; a dataset of this format has one rate"):
        import_dataset(paths, tmp_path / "arm.toml", tmp_path / "other", "one-rate", lines.append)
