"""Looks through a built site: every link and anchor within it exists, and no page asks another host for anything.

    python docs/check_site.py build/docs

Links to other hosts that a reader may follow are counted, not fetched.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {
    "script": "src",
    "img": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
}
"""What a browser fetches by itself, by tag."""
NOT_FETCHED = {"canonical", "next", "prev", "index", "search", "author", "alternate"}
"""Relations of <link> that name a page and load nothing."""


class Page(HTMLParser):
    """The links, loaded files and anchors of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value for name, value in attrs if value is not None}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        address = found.get(LOADED.get(tag, ""))
        if address and not (tag == "link" and set(found.get("rel", "").split()) <= NOT_FETCHED):
            self.loaded.append(address)
        if "srcset" in found:
            self.loaded += [part.split()[0] for part in found["srcset"].split(",") if part.strip()]


def elsewhere(address: str) -> bool:
    return bool(urlsplit(address).netloc) or address.startswith("//")


def problems(site: Path) -> tuple[list[str], int]:
    """What is wrong, a line each, and how many links lead to other hosts."""
    pages = {path.resolve(): Page(path) for path in sorted(site.rglob("*.html")) if "_downloads" not in path.parts}
    found, outside = [], 0
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        found += [f"{name}: loads {address}" for address in page.loaded if elsewhere(address)]
        for address in dict.fromkeys(page.links + [a for a in page.loaded if not elsewhere(a)]):
            parts = urlsplit(address)
            if elsewhere(address) or parts.scheme:
                outside += parts.scheme in ("http", "https")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                found.append(f"{name}: {address} is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors | {"top"}:
                found.append(f"{name}: {address} has no such anchor")
    for sheet in site.rglob("*.css"):
        for address in re.findall(r"(?:url\(|@import\s+)['\"]?((?:https?:)?//[^'\")\s]+)", sheet.read_text()):
            found.append(f"{sheet.relative_to(site)}: loads {address}")
    if not pages:
        found.append(f"{site}: no pages")
    return found, outside


def main() -> int:
    site = Path(sys.argv[1])
    found, outside = problems(site)
    for line in found:
        print(line, file=sys.stderr)
    pages = sum(1 for _ in site.rglob("*.html"))
    print(f"{site}/index.html: {pages} pages, {len(found)} problems, {outside} links to other hosts (not followed)")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
