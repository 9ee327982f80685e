"""Writes the page of a fleet, and beside it each arm's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.whole_file import whole_file
from tauext.fleet.fleet_page import render_fleet_page

PAGE = "fleet.html"


def write_fleet_page(content: Mapping[str, Any], out: Path) -> Path:
    """Write PAGE from the content of fleet-report.json; arms whose pages stand in `out` are linked. Returns its path.

    Raises:
        ConfigError: it cannot be written.
    """
    visits = [visit for arm in content["arms"] for visit in arm["visits"]]
    links = {}
    for visit in visits:
        place = arm_folder(visit["run"], visit["name"])
        if (out / place / "report.html").is_file():
            links[visit["run"], visit["name"]] = f"{place}/report.html"
    page = out / PAGE
    try:
        out.mkdir(parents=True, exist_ok=True)
        with whole_file(page) as part:
            part.write_text(render_fleet_page(content, links), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{page}: cannot be written ({error.strerror or error})") from error
    return page


def arm_folder(fleet: int, name: str) -> str:
    """Where an arm's own page stands in the folder of the fleet's."""
    return f"arms/{fleet + 1}/{name}"


def is_newer(page: Path, results: Place) -> bool:
    """Whether the page was made of these results, as far as times tell."""
    try:
        return page.stat().st_mtime >= (results / "results.json").stat().st_mtime
    except OSError:
        return False
