"""docs/results/real-arms: the descriptions kept there are ones, and so is every variant that the benchmark makes."""

import re
import shlex
from pathlib import Path

import pytest

from tauext.data.description import parse_arm

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "docs" / "results" / "real-arms"


@pytest.fixture
def real_arms(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return __import__("real_arms")


def test_descriptions_and_their_variants_are_valid_and_commands_name_what_is_there(real_arms):
    for name, arm in real_arms.ARMS.items():
        text = (KEPT / name / "arm.toml").read_text()
        there = {*arm.files, "arm.toml", "new.toml", *(f"{variant}.toml" for variant in arm.variants)}
        for changes in ([], *arm.variants.values()):
            changed = text
            for pattern, by in changes:
                changed, times = re.subn(pattern, by, changed)
                assert times, f"{name}: {pattern}"
            described = parse_arm(changed)
            assert not described.robot.model or described.robot.model in there
        for command in real_arms.plain(arm.commands):
            words = shlex.split(command)
            assert words[0] in ("import", "check", "train", "evaluate", "run", "show")
            if words[0] == "import" and "--source" in words:
                sources = words[words.index("--source") + 1 :]
                sources = sources[: next((k for k, w in enumerate(sources) if w.startswith("--")), None)]
                assert set(sources) <= there and ("--new" in words or words[words.index("--arm") + 1] in there)


def test_every_page_and_figure_that_the_index_names_is_there():
    index = (KEPT / "README.md").read_text()
    for target in re.findall(r"\]\(([^)]+)\)", index):
        assert (KEPT / target).is_file(), target
