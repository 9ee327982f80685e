"""`import tauext`: what programs use, light to import, documented, and nothing of it hidden by a subpackage."""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import itertools
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle

import tauext
from tauext.data.recording import REQUIRED_SIGNALS

ROOT = Path(__file__).parent.parent


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("name", tauext.__all__)
def test_every_name_is_there_and_documented(name):
    value = getattr(tauext, name)
    if name == "__version__":
        assert re.fullmatch(r"\d+\.\d+\.\d+", value)
        return
    assert inspect.getdoc(value), f"{name} has no docstring"
    assert name in tauext.__doc__, f"help(tauext) does not name {name}"
    assert name in dir(tauext)


ODD = {
    "None": None,
    "dict": {},
    "no text": "",
    "text": "x",
    "bytes": b"x",
    "list": [],
    "tuple": (1,),
    "number": 3,
    "negative": -1,
    "true": True,
    "large": 10**400,
    "NaN": float("nan"),
    "object": object(),
}
NO_CALLS = {"Reporter", "__version__", *(name for name in tauext.__all__ if name.endswith("Error"))}
"""A protocol, a text, and exceptions, which Python makes of anything."""


def parameters(call) -> list[inspect.Parameter]:
    """Empty for functions of the C++ module, whose parameters Python does not list; an enumeration takes a number."""
    if inspect.isclass(call) and issubclass(call, enum.Enum):
        return [inspect.Parameter("value", inspect.Parameter.POSITIONAL_OR_KEYWORD)]
    try:
        return list(inspect.signature(call).parameters.values())
    except ValueError:
        return []


def expect_sentence(call, *values, **named) -> None:
    """The call succeeds, or raises an error of tauext's own in one line."""
    try:
        call(*values, **named)
    except tauext.TauextError as error:
        assert str(error).strip() and "\n" not in str(error) and len(str(error)) < 1000, str(error)


@pytest.mark.parametrize("name", sorted(set(tauext.__all__) - NO_CALLS))
def test_values_that_no_argument_takes_are_refused_in_a_sentence(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call = getattr(tauext, name)
    takes = parameters(call)
    required = [one for one in takes if one.default is one.empty and one.kind is one.POSITIONAL_OR_KEYWORD]
    for value in ODD.values():
        expect_sentence(call, *[value] * len(required))
        for one in takes:
            if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD, one.POSITIONAL_ONLY):
                expect_sentence(call, **{other.name: value for other in required} | {one.name: value})
        if not takes:
            for given in ((value,), (value, value)):
                expect_sentence(call, *given)
            expect_sentence(call, x=value)
    assert not list(tmp_path.iterdir())


def usual_calls(folder: Path) -> dict:
    """Functions with arguments that they take."""
    bundle, recording = watching_bundle(), pushed(seconds=3.0)
    bundle.save(str(folder / "b.tauext"))
    tauext.save_recording(recording, folder / "r.parquet")
    return {
        tauext.load_bundle: {"path": folder / "b.tauext"},
        tauext.load_recording: {"path": folder / "r.parquet", "signals": ("contact",), "rows": (0, 10)},
        tauext.save_recording: {"recording": recording, "path": folder / "again.parquet"},
        tauext.expect_fit: {"bundle": bundle, "recording": recording},
        tauext.estimate_recording: {"bundle": bundle, "recording": recording, "threads": 1, "contacts": ()},
        tauext.refit_motion: {
            "bundle": bundle,
            "motion": {name: getattr(recording, name) for name in ("t_ns", *REQUIRED_SIGNALS)},
        },
        tauext.refit_recordings: {"bundle": bundle, "recordings": [recording], "threads": 1},
        tauext.Monitor: {"bundle": bundle},
        tauext.DeclaredContact: {"joint": "elbow", "at_most_nm": 1.0, "axis": [1, 0, 0], "box": None, "at_most_n": 0},
        tauext.Load: {"mass": 1.0, "com": [0, 0, 0]},
        bundle.save: {"path": str(folder / "c.tauext")},
        tauext.Bundle.load: {"path": str(folder / "b.tauext")},
        tauext.Monitor(bundle).expect_load: {"seconds": 1.0, "at_most_kg": 1.0},
        tauext.Monitor(bundle).set_limit_factors: {"collision": [1, 1], "contact": [1, 1]},
    }


def test_one_odd_value_among_usual_ones_is_refused_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for call, usual in usual_calls(tmp_path).items():
        for name, value in itertools.product(usual, ODD.values()):
            expect_sentence(call, **usual | {name: value})
    with pytest.raises(tauext.TauextError, match="at_most_n is beyond 1.8e308, the largest number"):
        tauext.DeclaredContact(frame="tool", at_most_n=10**400)
    with pytest.raises(tauext.ConfigError, match="load_bundle: path = None must be a path or text"):
        tauext.load_bundle(None)
    with pytest.raises(tauext.ConfigError, match="refit_motion: bundle = {} must be Bundle"):
        tauext.refit_motion({}, {})
    with pytest.raises(tauext.TauextError, match="Alarm.7. must be the number of one of none, contact, collision"):
        tauext.Alarm(7)


def test_numbers_of_numpy_are_numbers(tmp_path):
    assert tauext.TrainConfig(seed=np.int64(3), minutes=np.float32(2.0)).seed == 3
    assert tauext.Load(np.float64(1.0), np.zeros(3), np.zeros(6)).mass == 1.0


def test_names_for_type_checkers_are_those_that_are_loaded():
    tree = ast.parse(Path(tauext.__file__).with_suffix(".pyi").read_text())
    found = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    shown = {alias.asname: (node.module, alias.name) for node in found for alias in node.names}
    assert shown == {name: (f"tauext.{module}", name) for name, module in tauext._MODULE_OF.items()}


def test_no_name_is_a_module_which_would_replace_it_on_second_access():
    folder = Path(tauext.__file__).parent
    modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert not modules & set(tauext.__all__)
    for name in tauext.__all__:
        first = getattr(tauext, name)
        for module in modules - {"__init__", "__main__", "__pycache__", "cli"}:
            if (folder / module / "__init__.py").is_file() or (folder / f"{module}.py").is_file():
                importlib.import_module(f"tauext.{module}")
        assert getattr(tauext, name) is first


def test_the_import_loads_neither_the_core_nor_numpy():
    code = "import sys, tauext; print(sorted(m for m in sys.modules if m.startswith(('tauext', 'numpy', 'mujoco'))))"
    assert run_python(code) == "['tauext']"


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'tauext' has no attribute 'lod_bundle'"):
        _ = tauext.lod_bundle
    with pytest.raises(tauext.BundleError, match="there is no such bundle"):
        tauext.load_bundle("gone.tauext")


def test_readme_examples_and_docs_use_nothing_private():
    written = [page for page in (ROOT / "docs").rglob("*.md") if "made" not in page.parts]  # not what a build makes
    examples = [file for file in (ROOT / "examples").rglob("*") if file.is_file() and file.suffix != ".pyc"]
    pages = [ROOT / "README.md", *written, *examples]
    for page in pages:
        found = re.search(r"\b_core\b", page.read_text())
        assert not found, f"{page.name} uses {found[0]}"


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
