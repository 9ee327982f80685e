"""docs/your-robot.md: its commands as they stand there, on the recordings that it speaks of, where they are present."""

import os
import re
import shlex
import shutil
from pathlib import Path

import pytest

from tauext.check.finding import CODES
from tauext.cli import main, understood

ROOT = Path(__file__).parent.parent
GUIDE = (ROOT / "docs" / "your-robot.md").read_text()
SHARED = Path(os.environ.get("TAUEXT_SHARED_DATA", ROOT.parent / "shared" / "data"))
FOUND_FAULTS = "check --data first"  # the one command that is to end with status 1


def test_the_guide_names_every_code_of_the_doctor_and_no_other():
    table = GUIDE[GUIDE.index("| code |") :]
    assert set(re.findall(r"`([a-z]+(?:-[a-z]+)*)`", table)) == set(CODES)


def commands() -> list[str]:
    return re.findall(r"^    tauext (\w+ -.*|\w+ \w+\.tauext.*)$", GUIDE, flags=re.MULTILINE)


def test_every_command_of_the_guide_is_understood(monkeypatch):
    """With its options; what it does there, a slow test sees."""
    asked = []

    def only_understood(*arguments):
        asked.append(understood(*arguments))
        return lambda: 0

    monkeypatch.setattr("tauext.cli.understood", only_understood)
    assert len(commands()) >= 10
    assert all(main(shlex.split(command)) == 0 for command in commands()) and len(asked) == len(commands())


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
            assert "fault: effort-sign" in said and "payload-missing" in said
    assert Path("report/report.html").exists() and Path("flight-report").exists()
