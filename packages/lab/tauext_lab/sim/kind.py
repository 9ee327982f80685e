"""The kind of source `sim`: simulated arms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tauext.sources.open import SourceKind

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.source import Source


def open_sim(target: str, bundle: Bundle | None) -> Source:
    from tauext_lab.sim.source import SimSource

    return SimSource(target)


def robot_file(target: str, folder: Path) -> Path:
    from tauext_lab.sim.source import write_robot_file

    return write_robot_file(target, folder)


KIND = SourceKind(open_sim, "rig|seven|so101", robot=robot_file)
