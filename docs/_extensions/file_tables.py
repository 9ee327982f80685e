"""Tables of the file formats, made from the code that writes the files: keys of results.json, columns of estimates."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from made_pages import prose, write_page
from tauext_lab.evaluate.results import Results

from tauext import _core
from tauext.bundle.estimates import STORED, Estimates


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


def results_keys() -> list[str]:
    """A row for every kind of object: its places, its docstring's first sentence, its keys."""
    lines = ["| object | keys |", "|---|---|"]
    for kind, named in places(Results).items():
        about = (kind.__doc__ or "").partition("\n")[0]
        made = about.startswith(f"{kind.__name__}(")  # a dataclass's own, where it has no docstring
        name = ", ".join(f"`{place}`" for place in named if place) or "the file"
        keys = ", ".join(f"`{one.name}`" for one in fields(kind))
        lines.append(f"| {name}{'' if made else f': {prose(about)}'} | {keys} |")
    return lines


def field_docstrings(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    return {
        one.target.id: below.value.value
        for one, below in zip(tree.body, tree.body[1:], strict=False)
        if isinstance(one, ast.AnnAssign)
        and isinstance(one.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    }


def estimates_columns() -> list[str]:
    """A row for every column of a file of estimates, and the bits of `causes`."""
    about = field_docstrings(Estimates)
    lines = ["| column | type | content |", "|---|---|---|"]
    for column in STORED:
        name = f"{column.name}_<joint>" if column.per_joint else column.name
        lines.append(f"| `{name}` | {np.dtype(column.kind)} | {prose(about[column.name])} |")
    bits = [f"{1 << bit} {name}" for bit in range(32) for name in _core.cause_names(1 << bit)]
    return [*lines, "", f"Bits of `causes`: {', '.join(bits)}."]


def write(app: Any) -> None:
    write_page("results-keys.inc", results_keys())
    write_page("estimates-columns.inc", estimates_columns())


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
