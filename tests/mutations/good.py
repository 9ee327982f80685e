"""The clean datasets, each with a hundred labelled contacts; and all good data, none of which may be refused."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from tauext_lab.sim.collect import simulate_dataset
from tauext_lab.sim.config import RigConfig
from unseen.arms import makers
from unseen.recordings import Take, description, write_take

from mutations.changes import as_if_of, other_rig, pushed
from mutations.judging import looked_at
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import within
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import TauextError

LONG_S = 5.0
"""A training recording of less is not chosen to be broken."""
RIG_MINUTES, RIG_JUDGED, RIG_TOUCHED = 4.0, 10, 2
RIG_NM_PER_AMPERE = (10.0, 8.0)
"""Of drives of its size; the rig's own measure torque."""
TAKES = (
    Take("train-1", "train", 1), Take("train-2", "train", 1, 4, 180), Take("train-3", "train", 1, 0, 360),
    Take("train-4", "train", 1, 4, 540), Take("contacts-1", "collisions", 3.6, 34, 60),
    Take("contacts-2", "collisions", 3.6, 34, 300), Take("contacts-3", "collisions", 3.6, 34, 600),
    Take("donor", "none", 1),
)  # fmt: skip
UR3_NM_PER_AMPERE = (12.925, 13.088, 9.358, 4.572, 4.572, 4.548)
UR3_TRAIN = ("id1", "first10", "first10b", "first20")
UR3_PUSHED = {"id2-test": (4.3, 36.3), "second10": (3.7, 11.5), "slow": (4.6, 14.4)}
"""Runs that nothing was trained on, and when they move and nothing happens to them, [s]."""
UR3_TIMES = 4
ALL_KINDS = (
    "units", "signs", "order", "spikes", "stuck", "delays", "time unit", "zeros", "mixed files", "labels"
)  # fmt: skip


@dataclass(frozen=True)
class GoodSet:
    """A clean dataset, and what is needed to break and to judge it."""

    name: str
    folder: Path
    judged: tuple[Path, ...]
    """Recordings with contacts, of which no training knows."""
    nm_per_ampere: tuple[float, ...]
    kinds: tuple[str, ...]
    arm_toml: Path | None = None
    """With [contact.intervals] and its sources beside it, where labels come from an import."""
    donors: tuple[str, ...] = ()
    """Names of recordings of something else, NAME.parquet in `donor_folder`."""

    @property
    def donor_folder(self) -> Path:
        return self.folder.parent / "donors"

    @cached_property
    def training(self) -> list[Recording]:
        return load_dataset(self.folder).training()

    @property
    def joints(self) -> int:
        return len(self.training[0].joints)

    @property
    def long_files(self) -> list[str]:
        """Names of the training recordings that are chosen from; where labels are broken, of those that have some."""
        if self.arm_toml is not None:
            content = tomllib.loads(self.arm_toml.read_text())
            return [Path(name).stem for name in content["split"]["train"] if name in content["contact"]["intervals"]]
        if self.kinds == ("labels",):
            return [r.name for r in self.training if r.contact is not None and (r.contact == 1).any()]
        return [r.name for r in self.training if r.duration_s >= LONG_S]


def make_good_sets(out: Path, data: Path, names: Sequence[str]) -> dict[str, GoodSet]:
    """Make the datasets of these names that are not there yet.

    Args:
        data: folder of the shared recordings and of the arms' URDFs, `models`.
    """
    known: dict[str, Callable[[], GoodSet]] = {
        "rig": lambda: rig(out),
        "rig-labels": lambda: rig_labels(out),
        "ur5": lambda: unseen(out, "ur5", "kinova", data / "models"),
        "kinova": lambda: unseen(out, "kinova", "ur5", data / "models"),
        "ur5-labels": lambda: unseen_labels(unseen(out, "ur5", "kinova", data / "models")),
        "kinova-labels": lambda: unseen_labels(unseen(out, "kinova", "ur5", data / "models")),
        "ur3": lambda: ur3(out, data),
        "ur3-labels": lambda: ur3_labels(out, data),
    }
    return {name: known[name]() for name in names}


NAMES = ("rig", "rig-labels", "ur5", "ur5-labels", "kinova", "kinova-labels", "ur3", "ur3-labels")


def rig(out: Path) -> GoodSet:
    """The virtual rig, a file of 12 s at 1 kHz each, and of its collision recordings those that judge."""
    folder = out / "rig" / "data"
    config = RigConfig(collision_recording_s=60.0, gap_s=2.0)
    if not (folder.parent / "made").exists():
        simulate_dataset(folder, config, 0, RIG_MINUTES, RIG_JUDGED + RIG_TOUCHED)
        split = json.loads((folder / "split.json").read_text())
        split["collisions"] = []
        (folder / "split.json").write_text(json.dumps(split))
        donors = folder.parent / "donors"
        donors.mkdir(exist_ok=True)
        sha = load_dataset(folder).training()[0].robot_sha256
        for name, recording in other_rig(sha).items():
            save_recording(recording, donors / f"{name}.parquet")
        (folder.parent / "made").touch()
    judged = tuple(folder / f"collisions-{k:03d}.parquet" for k in range(RIG_JUDGED))
    kinds = tuple(kind for kind in ALL_KINDS if kind != "labels")
    return GoodSet("rig", folder, judged, RIG_NM_PER_AMPERE, kinds, None, ("arm", "friction"))


def rig_labels(out: Path) -> GoodSet:
    """The same with two recordings with labelled contacts to train on."""
    whole = rig(out)
    folder = out / "rig-labels" / "data"
    if not folder.exists():
        part = folder.with_name("part")
        shutil.copytree(whole.folder, part, copy_function=os.link)
        split = json.loads((part / "split.json").read_text())
        split["train"] += [f"collisions-{k:03d}.parquet" for k in range(RIG_JUDGED, RIG_JUDGED + RIG_TOUCHED)]
        (part / "split.json").unlink()
        (part / "split.json").write_text(json.dumps(split))
        part.rename(folder)
    return replace(whole, name="rig-labels", folder=folder, kinds=("labels",), donors=())


def unseen(out: Path, name: str, other: str, models: Path) -> GoodSet:
    """An unseen arm with its URDF, four minutes to train on, and another arm's minute as a donor."""
    home, folder = make_unseen(out / name, models), out / name / "data"
    donor = home / "donors" / "arm.parquet"
    if not donor.exists():
        foreign = make_unseen(out / other, models) / "data" / "train-1.parquet"
        save_recording(as_if_of(load_recording(foreign), load_dataset(folder).training()[0]), donor)
    judged = tuple(folder / f"{t.name}.parquet" for t in TAKES if t.part == "collisions")
    kinds = tuple(kind for kind in ALL_KINDS if kind != "labels")
    return GoodSet(name, folder, judged, makers(models)[name].nm_per_ampere, kinds, None, ("seed", "arm"))


def make_unseen(home: Path, models: Path) -> Path:
    """The folder of an unseen arm: raw/, data/, and another specimen of it in donors/; not what is there."""
    raw, folder, maker = home / "raw", home / "data", makers(models)[home.name]
    if (home / "made").exists():
        return home
    raw.mkdir(parents=True, exist_ok=True)
    for number, take in enumerate(TAKES):
        if not (raw / f"{take.name}.truth.npz").exists():
            write_take(maker, 1 if take.name == "donor" else 0, number, raw, TAKES)
    (raw / "arm.toml").write_text(with_intervals(description(maker, 0, TAKES), raw))
    shutil.rmtree(folder, ignore_errors=True)
    tauext("import", "--source", *(raw / f"{t.name}.csv" for t in TAKES), "--arm", raw / "arm.toml", "--out", folder)
    (home / "donors").mkdir(exist_ok=True)
    shutil.move(folder / "donor.parquet", home / "donors" / "seed.parquet")
    (home / "made").touch()
    return home


def unseen_labels(good: GoodSet) -> GoodSet:
    """The same, its labels to be broken before the import."""
    toml = good.folder.parent / "raw" / "arm.toml"
    return replace(good, name=f"{good.name}-labels", kinds=("labels",), arm_toml=toml, donors=())


def with_intervals(text: str, raw: Path) -> str:
    """The description with the labels of its takes as [contact.intervals] instead of a column."""
    from pyarrow import csv

    lines = ["[contact.intervals]"]
    for take in TAKES:
        table = csv.read_csv(raw / f"{take.name}.csv")
        time_s, touched = (table.column(name).to_numpy() for name in ("time", "touched"))
        edges = np.flatnonzero(np.diff(touched, prepend=0, append=0))
        spans = [[round(float(time_s[a] - time_s[0]), 3), round(float(time_s[b - 1] - time_s[0]), 3)]
                 for a, b in zip(edges[::2], edges[1::2], strict=True)]  # fmt: skip
        lines += [f'"{take.name}.csv" = {json.dumps(spans)}'] if spans else []
    return text.replace('[contact]\ncolumn = "touched"', "\n".join(lines))


def ur3(out: Path, data: Path) -> GoodSet:
    """Runs of a real UR3; its unseen runs get pushes of known times, since nothing touches it."""
    home = out / "ur3"
    folder, pushes = home / "data", home / "pushed"
    if not (home / "made").exists():
        import_ur3(home, data)
        shutil.rmtree(pushes, ignore_errors=True)
        pushes.mkdir()
        training = load_dataset(folder).training()
        usual_nm = np.quantile(np.abs(np.concatenate([r.tau for r in training])), 0.95, axis=0)
        for number in range(UR3_TIMES):
            for name, (from_s, to_s) in UR3_PUSHED.items():
                whole = load_recording(folder / f"{name}.parquet")
                quiet = within(whole, from_s, to_s, f"{name}-{number}")
                assert quiet is not None
                save_recording(pushed(quiet, usual_nm, [number, *name.encode()]), pushes / f"{quiet.name}.parquet")
        donor = load_recording(import_ur10(home, data))
        save_recording(as_if_of(donor, training[0]), home / "donors" / "arm.parquet")
        (home / "made").touch()
    kinds = tuple(kind for kind in ALL_KINDS if kind != "labels")
    return GoodSet("ur3", folder, tuple(sorted(pushes.glob("*.parquet"))), UR3_NM_PER_AMPERE, kinds, None, ("arm",))


def ur3_labels(out: Path, data: Path) -> GoodSet:
    """The same with the run that ends in an impact to train on."""
    good = ur3(out, data)
    raw = out / "ur3-labels" / "raw"
    if not raw.exists():
        shutil.copytree(good.folder.parent / "raw", raw, copy_function=os.link)
        text = (raw / "arm.toml").read_text()
        (raw / "arm.toml").unlink()
        split = '[split]\ntrain = ["id1.bag", "first20.bag", "id2.bag"]\n'
        (raw / "arm.toml").write_text(re.sub(r"(?s)\[split\].*", split, text))
    folder = raw.parent / "data"
    if not folder.exists():
        tauext("import", "--source", *(raw / f"{n}.bag" for n in ("id1", "first20", "id2")),
               "--arm", raw / "arm.toml", "--out", folder)  # fmt: skip
    return replace(good, name="ur3-labels", folder=folder, kinds=("labels",), arm_toml=raw / "arm.toml", donors=())


def import_ur3(home: Path, data: Path) -> None:
    import real_arms

    real_arms.prepare("ur3", data, home / "raw")
    text = (home / "raw" / "arm.toml").read_text()
    train = ", ".join(f'"{name}.bag"' for name in UR3_TRAIN)
    (home / "raw" / "arm.toml").write_text(text.replace('train = ["id1.bag"]', f"train = [{train}]"))
    shutil.rmtree(home / "data", ignore_errors=True)
    bags = [home / "raw" / f"{name}.bag" for name in (*UR3_TRAIN, "id2", "slow", "second10")]
    tauext("import", "--source", *bags, "--arm", home / "raw" / "arm.toml", "--out", home / "data")


def import_ur10(home: Path, data: Path) -> Path:
    import real_arms

    real_arms.prepare("ur10", data, home / "ur10")
    shutil.rmtree(home / "ur10" / "data", ignore_errors=True)
    tauext("import", "--source", home / "ur10" / "ur10_exciting", "--arm", home / "ur10" / "arm.toml",
           "--out", home / "ur10" / "data")  # fmt: skip
    (home / "donors").mkdir(exist_ok=True)
    return home / "ur10" / "data" / load_dataset(home / "ur10" / "data").split.train[0]


def tauext(*words: str | Path) -> None:
    """Run a command of tauext; RuntimeError where it fails."""
    ended = subprocess.run(
        [sys.executable, "-m", "tauext", *map(str, words)], capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise RuntimeError(f"tauext {' '.join(map(str, words))}:\n{ended.stdout}{ended.stderr}")


def look_at_good(out: Path, data: Path, unseen: Path | None, jobs: int) -> Iterator[dict]:
    """A row a dataset, as it is done: its name, faults, warnings and error.

    Args:
        out: with made/, the clean datasets.
        data: folder of the shared recordings.
        unseen: what packages/lab/benchmarks/unseen_arms.py made; None: its arms are left out.
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
    """The shared recordings as real_arms.py imports them, with the right descriptions, and the SO-101's."""
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
