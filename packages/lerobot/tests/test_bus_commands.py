"""Servo buses as sources of `tauext monitor` and `tauext commission`: what is refused, in one line."""

from __future__ import annotations

import pytest
from made_bundles import pushed, watching_bundle

from tauext.cli import main
from tauext.data.recording_file import save_recording

MONITOR = "monitor watching.tauext --source"
COMMISSION = "commission --out cell --no-page --source"


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (f"{MONITOR} feetech:/dev/ttyACM0", "--source feetech:PORT needs --bus FILE"),
        (f"{MONITOR} damiao:can0", "--source damiao:CAN needs --bus FILE"),
        (f"{MONITOR} replay:pushed.parquet --bus bus.toml", "--bus is for source damiao, dynamixel, feetech, not for"),
        (f"{MONITOR} dynamixel:/dev/ttyUSB0 --bus none.toml", "none.toml: there is no such file; docs/servo-arms.md"),
        (f"{MONITOR} feetech", "--source 'feetech' must be one of replay:FILE, ur:HOST"),
        (f"{COMMISSION} feetech:/dev/null", "needs --bus FILE"),
        (f"{COMMISSION} sim:rig --bus bus.toml", "--bus"),
        (f"{COMMISSION} damiao:can0 --bus bus.toml --reactions reactions.toml", "has no way to stop its robot"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, error, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    watching_bundle().save("watching.tauext")
    save_recording(pushed(), tmp_path / "pushed.parquet")
    (tmp_path / "bus.toml").write_text("[joints.a]\nid = 1\n")
    (tmp_path / "reactions.toml").write_text('[[reaction]]\nname = "r"\non = ["collision"]\nstop = true\n')
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("tauext: error: ") and error in said and said.count("\n") == 1
    assert not (tmp_path / "cell").exists()
