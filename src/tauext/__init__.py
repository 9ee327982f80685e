"""External joint torque and collision detection for robot arms, from joint encoders and motor torque alone."""

from tauext._core import __version__

__all__ = ["__version__"]
