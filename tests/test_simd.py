"""TAUEXT_SIMD: narrower kernels give the same answers, and what this processor cannot run is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tauext import _core

GOLDEN = Path(__file__).parent / "golden"
CPUINFO = Path("/proc/cpuinfo")
needs_x86 = pytest.mark.skipif(
    not CPUINFO.exists() or "sse2" not in CPUINFO.read_text(), reason="not an x86-64 processor under Linux"
)

FORWARD = """
import sys
import numpy as np
from tauext import _core
golden = np.load(sys.argv[1])
count, length, inputs = golden["windows"].shape
rows, ends = golden["windows"].reshape(-1, inputs).copy(), np.arange(1, count + 1, dtype=np.int64) * length - 1
shape, step = _core.LstmShape(6, 20, 2), [(f, 0) for f in range(6)]
np.save(sys.argv[2], _core.lstm_forward(shape, golden["parameters"], rows, 1, length, step, ends, 1))
print(_core.simd_in_use())
"""


def python(code: str, simd: str, *arguments: object) -> subprocess.CompletedProcess:
    """A process of its own, since the variable is read once."""
    words = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(words, env=os.environ | {"TAUEXT_SIMD": simd}, capture_output=True, text=True, check=False)


def usable() -> list[str]:
    """Instruction sets of this processor, by what the system says of it."""
    flags = set(CPUINFO.read_text().split())
    sets = ["sse2"]
    if {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"} <= flags:
        sets.append("avx2")
        if {"avx512f", "avx512vl", "avx512bw", "avx512dq", "avx512cd"} <= flags:
            sets.append("avx512")
    return sets


@needs_x86
@pytest.mark.parametrize("simd", ["sse2", "avx2", "avx512"])
def test_each_instruction_set_of_this_processor_gives_pytorchs_answer_and_others_are_refused(simd, tmp_path):
    ended = python(FORWARD, simd, GOLDEN / "lstm.npz", tmp_path / "out.npy")
    if simd not in usable():
        assert ended.returncode == 1 and f"TAUEXT_SIMD = {simd} must be one of" in ended.stderr.splitlines()[-1]
        return
    assert ended.returncode == 0 and ended.stdout.strip() == simd
    # 1e-6: about ten float roundings of values near 1, as in test_lstm.py.
    expected = np.load(GOLDEN / "lstm.npz")["output"]
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), expected, atol=1e-6, rtol=0)


@needs_x86
def test_unset_or_empty_it_is_the_widest_of_this_processor():
    ended = python("from tauext import _core; print(_core.simd_in_use())", "")
    assert ended.stdout.strip() == usable()[-1]


BUNDLE = f"_core.Bundle.load({str(GOLDEN / 'format-1-prior.tauext')!r})"
BYTES = f"_core.Bundle.from_bytes(open({str(GOLDEN / 'format-1-prior.tauext')!r}, 'rb').read())"
NETWORK = "_core.lstm_activations(np.zeros(4, np.float32))"
COMMAND = "import sys; from tauext.cli import main; sys.exit(main(['train', '--data', '.', '--out', 'b.tauext']))"


@pytest.mark.parametrize("code", [BUNDLE, BYTES, NETWORK, COMMAND], ids=["load", "from bytes", "network", "command"])
def test_an_unknown_one_is_refused_wherever_a_bundle_or_a_network_begins(code):
    ended = python(code if code is COMMAND else f"import numpy as np; from tauext import _core; {code}", "AVX2")
    assert ended.returncode == (2 if code is COMMAND else 1) and not ended.stdout
    *before, last = ended.stderr.splitlines()
    assert last.startswith("tauext: error: " if code is COMMAND else "tauext._core.CoreError: ")
    assert "TAUEXT_SIMD = AVX2 must be one of the instruction sets of this processor" in last
    assert _core.simd_in_use() in last and not (code is COMMAND and before)  # the choices
