"""All good data: the clean datasets, every shared recording, every unseen arm; nothing of it may be refused."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from mutation_trial.good_sets import tauext
from mutation_trial.judging import looked_at
from tauext.errors import TauextError


def look_at_good(out: Path, data: Path, unseen: Path | None, jobs: int) -> Iterator[dict]:
    """A row a dataset, as it is done: its name, faults, warnings and error.

    Args:
        out: with made/, the clean datasets.
        data: folder of the shared recordings.
        unseen: what benchmarks/unseen_arms.py made; None: its arms are left out.
    """
    folders = {path.parent.name: path for path in sorted((out / "made").glob("*/data"))}
    folders |= shared_datasets(out / "good", data)
    for split in sorted(unseen.glob("*/*/split.json")) if unseen else ():
        folders[f"unseen {split.parent.parent.name} {split.parent.name}"] = split.parent
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(_row, folders, folders.values())


def _row(name: str, folder: Path) -> dict:
    try:
        seen = looked_at(folder)
    except TauextError as error:
        return {"name": name, "faults": [], "warnings": [], "error": str(error)}
    told = {severity: [f"{s.code} ({s.joint}): {s.evidence}" for s in seen if s.severity == severity]
            for severity in ("fault", "warning")}  # fmt: skip
    return {"name": name, "faults": told["fault"], "warnings": told["warning"], "error": None}


def shared_datasets(out: Path, data: Path) -> dict[str, Path]:
    """The shared recordings as benchmarks/real_arms.py imports them, with the right descriptions, and the SO-101's."""
    import real_arms

    folders = {}
    for name, arm in real_arms.ARMS.items():
        real_arms.prepare(name, data, out / name)
        for command in real_arms.plain(arm.commands):
            match = re.fullmatch(r"import --source (.*) --arm (\S+) --out (\S+)", command)
            if match is None or match[3] == "first":  # the first try of a user, with units or signs yet wrong
                continue
            folder = out / name / match[3]
            folders[f"{name} {match[3]}"] = folder
            if not folder.exists():
                sources = [out / name / source for source in match[1].split()]
                tauext("import", "--source", *sources, "--arm", out / name / match[2], "--out", folder)
    return folders | servo_arm(out / "so101", data)


SERVO_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SERVO_NM_PER_RAD = 16.0
"""Of position error: the duty of a servo with a proportional gain alone is linear in the torque at rest."""
NOT_FREE = ("single_joint_wrist_roll", "prbs_excitation", "static_holding", "step_response", "large_amplitude",
            "single_joint_elbow")  # fmt: skip
"""Motions with large position errors or a stall, which are no free motion."""


def servo_arm(home: Path, data: Path) -> dict[str, Path]:
    """SO-101, whose current has no sign: its torque is the servo's own law, gain times position error."""
    import pyarrow.parquet as pq

    sources = [path for path in sorted((data / "so101_sage").rglob("*.parquet")) if path.stem not in NOT_FREE]
    if not sources:
        return {}
    home.mkdir(parents=True, exist_ok=True)
    if not (home / "data").exists():
        shutil.rmtree(home / "raw", ignore_errors=True)
        (home / "raw").mkdir()
        for path in sources:
            table = pq.read_table(path)
            for joint in SERVO_JOINTS:
                error = table.column(f"goal_{joint}").to_numpy() - table.column(f"q_{joint}").to_numpy()
                table = table.append_column(f"duty_{joint}", [SERVO_NM_PER_RAD * error])
            pq.write_table(table, home / "raw" / path.name)
        (home / "arm.toml").write_text(_servo_description(data, [path.name for path in sources]))
        files = [home / "raw" / path.name for path in sources]
        tauext("import", "--source", *files, "--arm", home / "arm.toml", "--out", home / "data")
    return {"so101 data": home / "data"}


def _servo_description(data: Path, files: list[str]) -> str:
    joints = ", ".join(f'"{joint}"' for joint in SERVO_JOINTS)
    listed = ", ".join(f'"{name}"' for name in files)
    return f"""\
[robot]
model = ""
joints = [{joints}]

[time]
column = "t"

[signals.q]
columns = "q_{{joint}}"

[signals.dq]
columns = "dq_{{joint}}"

[signals.tau]
columns = "duty_{{joint}}"

[split]
train = [{listed}]
"""
