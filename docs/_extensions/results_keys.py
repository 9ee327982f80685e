"""The keys of results.json as a table, made from the dataclasses that read and write it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from made_pages import prose, write_page
from tauext_lab.evaluate.results import Results


def inside(kind: Any, place: str) -> Iterator[tuple[str, type]]:
    """The dataclass in a type, with its place: `name[]` in a list, `name{}` in an object by names."""
    if is_dataclass(kind):
        yield place, kind
    mark = {tuple: "[]", dict: "{}"}.get(get_origin(kind), "")
    for inner in get_args(kind):
        yield from inside(inner, place + mark)


def places(kind: type, place: str = "", found: dict[type, list[str]] | None = None) -> dict[type, list[str]]:
    """The dataclasses in one, in the order of the file, with all of their places; what is in a class counts once."""
    found = {} if found is None else found
    known = kind in found
    found.setdefault(kind, []).append(place)
    if not known:
        hints = get_type_hints(kind)
        for one in fields(kind):
            for inner_place, inner in inside(hints[one.name], f"{place}.{one.name}".lstrip(".")):
                places(inner, inner_place, found)
    return found


def table() -> list[str]:
    """A row for every kind of object: its places, its docstring's first sentence, its keys."""
    lines = ["| object | keys |", "|---|---|"]
    for kind, named in places(Results).items():
        about = (kind.__doc__ or "").partition("\n")[0]
        made = about.startswith(f"{kind.__name__}(")  # a dataclass's own, where it has no docstring
        name = ", ".join(f"`{place}`" for place in named if place) or "the file"
        keys = ", ".join(f"`{one.name}`" for one in fields(kind))
        lines.append(f"| {name}{'' if made else f': {prose(about)}'} | {keys} |")
    return lines


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", lambda _: write_page("results-keys.inc", table()))
    return {"parallel_read_safe": True}
