"""Pages of the files for people in the project's root: the changelog, and how to contribute where that stands there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from made_pages import write_page

ROOT = Path(__file__).parents[2]
NAMES = ("CHANGELOG", "CONTRIBUTING", "SECURITY", "THIRD_PARTY")
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")


def page(text: str, present: tuple[str, ...]) -> str:
    """The text with links as they are from reference/made/project; what the site does not have keeps its words."""

    def moved(link: re.Match[str]) -> str:
        target = link[2]
        if "://" in target or target.startswith("#"):
            return link[0]
        if target.startswith("docs/"):
            return f"[{link[1]}](../../../{target.removeprefix('docs/')})"
        name = target.partition(".")[0]
        return f"[{link[1]}]({name.lower()}.md)" if name in present and target.endswith(".md") else link[1]

    return LINK.sub(moved, text)


def write(app: Any) -> None:
    present = tuple(name for name in NAMES if (ROOT / f"{name}.md").exists())
    for name in present:
        write_page(f"project/{name.lower()}.md", [page((ROOT / f"{name}.md").read_text(), present).rstrip()])


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
