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
        (f"{MONITOR} feetech:/dev/ttyACM0", "--source feetech:PORT needs --cell FILE with a table [bus]"),
        (f"{MONITOR} damiao:can0", "--source damiao:CAN needs --cell FILE with a table [bus]"),
        (f"{MONITOR} dynamixel:/dev/ttyUSB0 --cell none.toml", "none.toml: there is no such file; docs/running.md"),
        (f"{MONITOR} feetech", "--source 'feetech' must be one of replay:FILE, ur:HOST"),
        (f"{COMMISSION} feetech:/dev/null", "needs --cell FILE with a table [bus]"),
        (f"{COMMISSION} damiao:can0 --cell cell.toml", "has no way to stop its robot"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, error, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    watching_bundle().save("watching.tauext")
    save_recording(pushed(), tmp_path / "pushed.parquet")
    (tmp_path / "cell.toml").write_text('[bus.joints.a]\nid = 1\n[reactions.r]\non = ["collision"]\nstop = true\n')
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("tauext: error: ") and error in said and said.count("\n") == 1
    assert not (tmp_path / "cell").exists()
