"""Bundles of every released format are read, or refused with the command that converts them."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from test_few_data import motion

from tauext import _core
from tauext.cli import main
from tauext.fit.torque_constants import converted

GOLDEN = Path(__file__).parent / "golden"
CONSTANTS = np.array([9.0, -0.7])
"""Of the motor currents that format-4-amperes.tauext was trained on, [N m/A]."""


def format_of(content: bytes) -> int:
    return struct.unpack_from("<I", content, 8)[0]


@pytest.mark.parametrize(
    "name", ["format-3", "format-4", "format-5", "format-5-amperes", "format-6", "format-7", "format-8"]
)
def test_a_bundle_of_every_released_format_is_read_and_written_as_today_s(name):
    content = (GOLDEN / f"{name}.tauext").read_bytes()
    assert format_of(content) == int(name[7])
    bundle = _core.Bundle.from_bytes(content)  # replays its reference
    new = bundle.to_bytes()
    assert format_of(new) == _core.BUNDLE_FORMAT == 12 and _core.Bundle.from_bytes(new).to_bytes() == new
    assert bundle.torque_units == (["A", "A"] if name == "format-5-amperes" else ["N m", "N m"])
    assert bundle.estimate_units == ["N m", "N m"]
    load = bundle.load_settings  # what an older bundle assumes
    moving_kg = sum(link.mass for link in bundle.links)
    assert load.settable and load.frame == f"link of {bundle.links[-1].joint_name}"
    assert load.largest_mass_kg == 0.5 * moving_kg


def test_old_torque_constants_are_refused_by_name_with_the_command_that_converts_them(tmp_path, capsys):
    old = GOLDEN / "format-4-amperes.tauext"
    with pytest.raises(_core.CoreError, match=r"torque constants.*`tauext convert OLD.tauext --out NEW.tauext`"):
        _core.Bundle.from_bytes(old.read_bytes())
    assert main(["show", str(old)]) == 2
    assert "tauext convert" in capsys.readouterr().err
    out = tmp_path / "new.tauext"
    assert main(["convert", str(old), "--out", str(out)]) == 0
    assert "shoulder A, elbow A" in capsys.readouterr().out
    bundle = _core.Bundle.load(str(out))
    np.testing.assert_allclose(bundle.observer.nm_per_unit, CONSTANTS, rtol=0.01)
    assert main(["show", str(out)]) == 0
    told = capsys.readouterr().out
    assert "takes tau in" in told and "shoulder A, elbow A" in told and "torque constants" in told


def test_a_converted_bundle_says_of_currents_what_the_old_one_said_of_torques():
    content = (GOLDEN / "format-4-amperes.tauext").read_bytes()
    old, new = _core.Bundle.from_old_bytes(content), converted(content)
    used = np.array(json.loads(old.provenance)["torque_constants"]["used"])
    made = motion(seconds=20.0, seed=3)
    current = made.tau / used
    arrays = (made.t_ns, made.q, made.dq)
    before = _core.estimate(old, *arrays, current * used, 1)
    after = _core.estimate(new, *arrays, current, 1)
    for name in before:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    assert (after["health"] == 1).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda facts: facts.pop("torque_constants"), "needs no conversion"),
        (lambda facts: facts["torque_constants"].pop("used"), "cannot be read"),
        (lambda facts: facts["torque_constants"].update(used=[1.0, "x"]), "cannot be read"),
        (lambda facts: facts["torque_constants"].update(used=[1.0, 0.0]), "cannot be read"),
        (lambda facts: facts["torque_constants"].update(used=[1.0]), "cannot be read"),
    ],
)
def test_constants_that_cannot_be_converted_are_one_line(change, message, tmp_path, capsys):
    content = (GOLDEN / "format-4-amperes.tauext").read_bytes()
    name_end = 28 + 8 + struct.unpack_from("<Q", content, 28)[0]
    length = struct.unpack_from("<Q", content, name_end)[0]
    begin, end = name_end + 8, name_end + 8 + length
    facts = json.loads(content[begin:end])
    change(facts)
    text = json.dumps(facts, sort_keys=True).encode()
    payload = content[28:name_end] + struct.pack("<Q", len(text)) + text + content[end:]
    head = content[:16] + struct.pack("<QI", len(payload), __import__("zlib").crc32(payload))
    (tmp_path / "bad.tauext").write_bytes(head + payload)
    assert main(["convert", str(tmp_path / "bad.tauext"), "--out", str(tmp_path / "new.tauext")]) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1 and "bad.tauext" in err
    assert not (tmp_path / "new.tauext").exists()


def test_what_is_no_old_bundle_is_refused(tmp_path, capsys):
    new = GOLDEN / "format-5.tauext"
    for source, out, message in (
        (new, tmp_path / "a.tauext", "needs no conversion"),
        (tmp_path / "none.tauext", tmp_path / "a.tauext", "there is no such bundle"),
        (new, tmp_path / "a.bundle", "ends in .tauext"),
    ):
        assert main(["convert", str(source), "--out", str(out)]) == 2
        assert message in capsys.readouterr().err
