"""The reference of `tauext`: every public field, property and function of its classes says what it is."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterator

import pytest

import tauext

CLASSES = [getattr(tauext, name) for name in tauext.__all__ if inspect.isclass(getattr(tauext, name))]


def undocumented_fields(cls: type) -> Iterator[str]:
    """Fields of a dataclass without a string below them."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(tree, ast.ClassDef)
    for node, following in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            text = following.value if isinstance(following, ast.Expr) else None
            if not (isinstance(text, ast.Constant) and isinstance(text.value, str)):
                yield node.target.id


def undocumented_members(cls: type) -> Iterator[str]:
    """Properties and functions without a docstring; the C++ module's begin with a line for the signature."""
    fields = {field.name for field in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set()
    for name, member in vars(cls).items():
        if name.startswith("_") or name in fields or not (callable(member) or isinstance(member, property)):
            continue
        told = (member.fget.__doc__ if isinstance(member, property) else member.__doc__) or ""
        of_core = type(member).__module__ == "nanobind" or told.startswith("(self) -> ")
        if not (told.partition("\n")[2].strip() if of_core else told.strip()):
            yield name


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_public_field_and_function_has_a_docstring(cls):
    missing = list(undocumented_members(cls))
    if dataclasses.is_dataclass(cls):
        missing += undocumented_fields(cls)
    assert not missing


def test_what_has_none_is_found():
    @dataclasses.dataclass
    class Made:
        told: int = 0
        """What it is."""
        silent: int = 1

        def spoken(self) -> None:
            """What it does."""

        def mute(self) -> None: ...

    assert list(undocumented_fields(Made)) == ["silent"] and list(undocumented_members(Made)) == ["mute"]

    def getter(self) -> int:
        return 1

    getter.__doc__ = "(self) -> int"  # all that the C++ module says by itself
    assert list(undocumented_members(type("Core", (), {"number": property(getter)}))) == ["number"]
    getter.__doc__ += "\n\nHow many."
    assert list(undocumented_members(type("Core", (), {"number": property(getter)}))) == []
