"""Files that a stage writes beside its output: settings, versions and seed in run.json, wall times apart from it."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from tauext._core import __version__ as VERSION
from tauext.files.atomic_write import atomic_write


def write_json(content: Any, path: Path) -> None:
    """Write under a temporary name, then rename; the same content gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_text(json_text(content))


def json_text(content: Any) -> str:
    """JSON text in the format of all files of tauext."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def provenance(command: str, settings: Any, seed: int | None) -> dict:
    """Which command, version, settings and seed made an output."""
    from importlib.metadata import version  # imported by writers only

    plain = asdict(settings) if is_dataclass(settings) and not isinstance(settings, type) else settings
    return {
        "command": command,
        "version": VERSION,
        "seed": seed,
        "settings": json.loads(json.dumps(plain, default=str)),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in ("numpy", "mujoco", "pyarrow")},
        "machine": machine(),
    }


def machine() -> str:
    """Processor, cores and system, for readers of a benchmark."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    return f"{processor}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"
