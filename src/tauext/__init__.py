"""External joint torque and collision detection for robot arms, from joint encoders and motor torque alone."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from tauext import _core

        return _core.__version__
    raise AttributeError(f"module 'tauext' has no attribute {name!r}")
