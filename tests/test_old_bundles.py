"""Stored bundles of the format of today stay readable; those of other formats are refused."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from tauext import _core
from tauext.cli import main

GOLDEN = Path(__file__).parent / "golden"


@pytest.mark.parametrize(
    ("name", "terms", "unit"),
    [("observer", 0, "N m"), ("prior", 32, "N m"), ("network", 10, "N m"), ("amperes", 16, "A")],
)
def test_a_stored_bundle_is_read_and_written_as_it_was(name, terms, unit):
    content = (GOLDEN / f"format-1-{name}.tauext").read_bytes()
    assert struct.unpack_from("<I", content, 8) == (_core.BUNDLE_FORMAT,) == (1,)
    bundle = _core.Bundle.from_bytes(content)  # replays its reference
    assert bundle.to_bytes() == content
    assert (bundle.name, bundle.joints, bundle.has_network, len(bundle.prior.terms)) == (
        name,
        2,
        name == "network",
        terms,
    )
    assert bundle.torque_units == [unit, unit] and bundle.estimate_units == ["N m", "N m"]


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (3, "made by a development version before 0.1.0; train it again"),
        (12, "made by a development version before 0.1.0; train it again"),
        (13, "its format is version 13, this program reads version 1; it was made by a newer tauext"),
    ],
)
def test_a_bundle_of_another_format_is_refused_in_one_line(version, message, tmp_path, capsys):
    content = (GOLDEN / "format-1-prior.tauext").read_bytes()
    path = tmp_path / "other.tauext"
    path.write_bytes(content[:8] + struct.pack("<I", version) + content[12:])
    assert main(["show", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and f"other.tauext: {message}" in err
