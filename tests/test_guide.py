"""docs/data.md and docs/training.md: their commands, on the recordings that they name; docs/troubleshooting.md: every
code; docs/results/real-arms: its descriptions."""

import os
import re
import shlex
import shutil
from pathlib import Path

import pytest
from doc_pages import Page

from tauext.check.finding import codes
from tauext.cli import main
from tauext.data.description import parse_arm

ROOT = Path(__file__).parent.parent
DATA = (ROOT / "docs" / "data.md").read_text()
TRAINING = (ROOT / "docs" / "training.md").read_text()
GUIDE = DATA + TRAINING[: TRAINING.index("\n## Thresholds\n")]
SHARED = Path(os.environ.get("TAUEXT_SHARED_DATA", ROOT.parent / "shared" / "data"))
FOUND_FAULTS = "check --data first"  # the one command that is to end with status 1


def test_the_guide_names_every_code_of_the_check_and_no_other():
    table = Page("troubleshooting.md", "Check codes").text
    assert set(re.findall(r"`([a-z]+(?:-[a-z]+)*)`", table)) == set(codes())


def commands() -> list[str]:
    return re.findall(r"^    tauext (\w+ -.*|\w+ \w+\.tauext.*)$", GUIDE, flags=re.MULTILINE)


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "ur3_aspectum").is_dir(), reason="the recordings of the UR3 are not here")
def test_every_command_of_the_guide_works_as_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("ur3_aspectum/id1.bag", "ur3_aspectum/id2.bag", "models/ur3_robot.urdf"):
        shutil.copy(SHARED / name, tmp_path)
    (description,) = re.findall(r"```toml\n(.*?)```", GUIDE, flags=re.DOTALL)
    for command in commands():
        if "id2.bag" in command:
            Path("arm.toml").write_text(description)
        assert main(shlex.split(command)) == (1 if FOUND_FAULTS in command else 0), command
        said = capsys.readouterr().out
        if FOUND_FAULTS in command:
            assert "fault: effort-sign" in said and "payload" in said
    assert Path("report/report.html").exists() and Path("flight-report").exists()


KEPT = ROOT / "docs" / "results" / "real-arms"


@pytest.fixture
def real_arms(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "packages/lab/benchmarks"))
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
