"""The compiled steps of the simulations, built with MuJoCo's headers where they are older than their source."""

from __future__ import annotations

import ctypes
import os
import subprocess
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

POINTER, WHOLE, NUMBER = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
BUILT = Path(__file__).parents[2] / "build" / "steps"


@cache
def compiled(name: str, arguments: tuple[type, ...], result: type | None) -> ctypes._CFuncPtr:  # type: ignore[name-defined]
    """The function NAME of NAME.cpp."""
    source, built = Path(__file__).with_name(f"{name}.cpp"), BUILT / f"{name}.so"
    if not built.exists() or built.stat().st_mtime < source.stat().st_mtime:
        BUILT.mkdir(parents=True, exist_ok=True)
        library = Path(mujoco.__file__).parent
        engine = next(library.glob("libmujoco.so*"))
        made = built.with_suffix(f".{os.getpid()}")
        command = [os.environ.get("CXX", "g++"), *"-std=c++20 -O2 -shared -fPIC -Wall".split(), f"-I{library}/include"]
        subprocess.run([*command, str(source), str(engine), f"-Wl,-rpath,{library}", "-o", str(made)], check=True)
        made.replace(built)
    function = ctypes.CDLL(str(built))[name]
    function.restype, function.argtypes = result, list(arguments)
    return function


def address(values: np.ndarray) -> ctypes.c_void_p:
    """Of a contiguous array's first value."""
    assert values.flags.c_contiguous
    return ctypes.c_void_p(values.ctypes.data)
