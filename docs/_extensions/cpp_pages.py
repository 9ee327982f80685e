"""A page for every public C++ header, made from its comments and declarations, without what is private."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path
from typing import Any

from made_pages import prose, write_page

HEADERS = Path(__file__).parents[2] / "cpp" / "include" / "tauext"
NAMED = re.compile(
    r"(?:class|struct|union|enum(?: class)?)\s+(\w+)|(?:constexpr|const|using)\s[^(=]*?(\w+)\s*[={]|(\w+)\("
)


def blocks(text: str) -> list[list[str]]:
    """Declarations of the namespace, each with the comment before it: what blank lines part outside of braces."""
    found: list[list[str]] = [[]]
    depth = 0
    for line in text.splitlines():
        if not line.strip() and depth == 0:
            found.append([])
            continue
        found[-1].append(line)
        code = line.split("//")[0]
        depth += code.count("{") - code.count("}")
        if depth == 0 and code.startswith("}"):  # a type or a body ends here
            found.append([])
    return [block for block in found if block]


def without_private(lines: list[str]) -> list[str]:
    """A class's lines without those from `private:` to its end."""
    kept, private = [], False
    for line in lines:
        if re.match(r"\s*private:", line):
            private = True
            while kept and not kept[-1].strip():
                kept.pop()
        elif re.match(r"\s*public:", line):
            private = False
        if not private or re.match(r"\};", line):
            kept.append(line)
            private = private and not re.match(r"\};", line)
    return kept


def comment_and_code(block: list[str]) -> tuple[list[str], list[str]]:
    """Lines of the comment that begins a block, without //, and the code after it."""
    count = next((k for k, line in enumerate(block) if not line.startswith("//")), len(block))
    return [line.removeprefix("//").removeprefix(" ") for line in block[:count]], block[count:]


def markdown(comment: list[str]) -> list[str]:
    """A comment as Markdown: indented lines are equations and stay as they are, the others are paragraphs."""
    lines: list[str] = []
    for equation, group in groupby((line for line in comment if line), lambda line: line.startswith("  ")):
        text = list(group)
        lines += ["```text", *text, "```", ""] if equation else [prose(" ".join(text)), ""]
    return lines


def page(header: Path) -> list[str]:
    """The Markdown of one header."""
    text = header.read_text()
    head, _, rest = text.partition("#pragma once")
    inside = rest.partition("namespace tauext {")[2].rpartition("}  // namespace tauext")[0]
    about = " ".join(line.removeprefix("//").strip() for line in head.splitlines())
    lines = [f"# {header.name}", "", prose(about), "", f"`#include <tauext/{header.name}>`, namespace `tauext`.", ""]
    for block in blocks(inside):
        comment, code = comment_and_code(block)
        code = without_private(code)
        name = NAMED.search("\n".join(line.split("//")[0] for line in code))
        if name:
            lines += [f"## {next(filter(None, name.groups()))}", ""]
        lines += markdown(comment)
        lines += ["```cpp", *code, "```", ""] if code else []
    return lines


def c_page(header: Path) -> list[str]:
    """The C header as it stands: its comments are written to be read there."""
    return ["# tauext.h, the C API", "", "```c", header.read_text().rstrip(), "```"]


def write(app: Any) -> None:
    index = ["## C++ headers", "", "| header | content |", "|---|---|"]
    for header in sorted(HEADERS.glob("*.hpp")):
        lines = page(header)
        write_page(f"cpp/{header.stem}.md", lines)
        index.append(f"| [{header.name}](made/cpp/{header.stem}.md) | {lines[2].partition('. ')[0].rstrip('.')} |")
    write_page("cpp/c.md", c_page(HEADERS / "tauext.h"))
    write_page("cpp.inc", index)


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
