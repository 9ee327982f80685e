"""One version everywhere, licences of all dependencies, and every cited work in the list of references."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import tauext
from tauext.files.provenance import VERSION

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CITATION = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text())
# Names that the table writes as their makers do.
WRITTEN = {"pyarrow": "Apache Arrow", "torch": "PyTorch", "pin": "Pinocchio"}


def test_package_core_and_installed_metadata_have_the_version_of_pyproject():
    assert {VERSION, tauext.__version__, version("tauext")} == {PROJECT["version"]}


def test_cmake_takes_its_version_from_pyproject_alone():
    cmake = (ROOT / "CMakeLists.txt").read_text()
    assert re.search(r"file\(STRINGS pyproject\.toml version_line", cmake)
    assert re.search(r"project\(tauext VERSION \$\{version\} ", cmake)


def test_citation_has_the_version_the_licence_and_the_paper():
    assert CITATION["version"] == PROJECT["version"]
    assert CITATION["license"] == PROJECT["license"]
    assert CITATION["type"] == "software" and "preferred-citation" not in CITATION  # the software itself is cited
    (paper,) = CITATION["references"]
    assert paper["year"] == 2021 and [author["family-names"] for author in paper["authors"]] == ["Lim", "Kim", "Park"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text().replace("*", "").split())


def test_licence_text_is_the_licence_that_pyproject_names():
    text = (ROOT / "LICENSE").read_text()
    assert PROJECT["license"] == "Apache-2.0" and "Apache License" in text and "Version 2.0, January 2004" in text
    assert all((ROOT / name).exists() for name in PROJECT["license-files"])


def dependencies() -> list[str]:
    extras = PROJECT["optional-dependencies"].values()
    lines = [*PROJECT["dependencies"], *(line for extra in extras for line in extra)]
    return sorted({re.match(r"[A-Za-z0-9_-]+", line)[0] for line in lines if "tauext" not in line})


@pytest.mark.parametrize("name", dependencies())
def test_every_dependency_has_its_row_of_licences(name):
    tables = (ROOT / "THIRD_PARTY.md").read_text()
    first_cells = "\n".join(row.split("|")[1] for row in tables.splitlines() if row.startswith("| "))
    assert re.search(rf"\b{re.escape(WRITTEN.get(name, name))}\b", first_cells, re.IGNORECASE)


KEY = re.compile(r"\[([A-Z][A-Za-z]+[12]\d{3}[a-z]?)\]")


def test_every_cited_work_is_listed_and_every_listed_work_is_cited():
    text = "".join(page.read_text() for page in sorted((ROOT / "docs" / "method").glob("*.md")))
    references = (ROOT / "docs" / "references.md").read_text()
    listed = re.findall(r"^- \*\*\[(\w+)\]\*\*", references, re.MULTILINE)
    files = [
        f
        for folder in ("src", "cpp", "packages")
        for f in (ROOT / folder).rglob("*")
        if f.suffix in (".py", ".hpp", ".cpp")
    ]
    cited = set(KEY.findall(text)).union(*(KEY.findall(file.read_text()) for file in files))
    assert listed == sorted(set(listed)) and len(files) > 200
    assert cited == set(listed)
