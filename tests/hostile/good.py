"""What hostile cases begin with: a small dataset, bundles, results, flights, and one recording in every format."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import h5py
import lerobot_arm
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from made_recordings import write_bag
from scipy.io import savemat
from tauext_fleet.fleet_prior import ArmType, FleetDays, FleetPrior, write_fleet_prior
from tauext_fleet.map_regression import WeightPrior

from tauext import _core
from tauext.cli import main
from tauext.data.dataset import Split, save_split
from tauext.data.free_motion import first_seconds
from tauext.data.recording_file import load_recording, save_recording

EVERY = 10
"""Of 1000 samples a second: files in other formats stay small."""
TOUCHED_S = 12.0
LITTLE = ("--minutes", "1", "--collision-recordings", "1")
ARM = """[robot]
model = "robot.xml"
joints = ["joint1", "joint2"]
[split]
gap_s = 0.0
[signals.q]
columns = "q_{joint}"
unit = "rad"
[signals.dq]
columns = "dq_{joint}"
unit = "rad/s"
[signals.tau]
columns = "tau_{joint}"
unit = "Nm"
[time]
column = "t"
unit = "s"
"""
ARRAYS = ARM.replace("_{joint}", "")
TOPICS = (
    ARRAYS.split("[time]")[0].replace('"q"', '"position"').replace('"dq"', '"velocity"').replace('"tau"', '"effort"')
)
FLEET = """stages = ["train"]
[train]
recipe = "observer"
max_steps = 5
[types.rig]
accept = ["payload"]
[[arms]]
name = "one"
type = "rig"
dataset = "data"
[[arms]]
name = "two"
type = "rig"
dataset = "data-2"
calibration = "hours"
calibrate = { false_alarms = 1.0, in_hours = 8.0 }
train.like = "arm.prior.json"
train.recipe = "prior"
"""
LOADS = """[[load]]
from_s = 0.5
mass = 1.0
com = [0.0, 0.0, 0.05]
[[load]]
from_s = 1.5
mass = 0.0
"""
URDF = """<robot name="two">
<link name="base"/><link name="a"><inertial><mass value="2"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="b"><inertial><mass value="1"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="joint1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit effort="50" velocity="3" lower="-3" upper="3"/></joint>
<joint name="joint2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
<limit effort="50" velocity="3" lower="-3" upper="3"/></joint>
</robot>
"""


REACTIONS = """[[reaction]]
name = "log"
on = ["collision", "contact", "fault", "cleared"]
min_interval_s = 0.1
command = ["true"]
"""
PROFILES = """[bounds]
lowest = 0.5
highest = 3.0
[start]
profile = "normal"
[profiles.normal]
contact = 1.0
[profiles.pressing]
contact = 3.0
collision = { others = 1.5 }
"""
BUS = """baud = 1000000
calibration = "calibration.json"
[joints.shoulder]
id = 7
zero = 2048
sign = -1
[joints.elbow]
id = 8
zero = 1000.5
multi_turn = true
type = "sts3215"
"""
CAN = """interface = "virtual"
[joints.joint1]
id = 1
answer_id = 17
[joints.joint2]
id = 2
answer_id = 18
sign = -1
zero_rad = 0.5
ranges = [12.5, 30.0, 10.0]
"""


def make_good(folder: Path, quick: bool = False) -> Path:
    """Everything, in a folder that is made; what stands there is used again.

    quick: one bundle and dataset stand for several that take seconds to make.
    """
    if (folder / "ready").is_file():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    data = folder / "data"
    done(["simulate", "--out", str(data), *LITTLE])
    names = sorted(path.name for path in data.glob("free-*.parquet"))
    split = Split(tuple(names[:4]), tuple(names[4:6]), tuple(names[6:8]), ("collisions-000.parquet",))
    save_split(split, data)
    for name in names[8:]:
        (data / name).unlink()
    if quick:
        (folder / "hours").mkdir()
        for path in data.iterdir():
            (folder / "hours" / path.name).symlink_to(path)
    else:
        done(["simulate", "--out", str(folder / "hours"), *LITTLE, "--calibration-hours", "0.1"])
    for recipe in ("observer", "prior", "tauext"):
        if quick and recipe != "observer":
            shutil.copyfile(folder / "observer.tauext", folder / f"{recipe}.tauext")
            continue
        sizes = ["--max-steps", "3", "--batch", "4"] if recipe == "tauext" else []
        done(["train", "--data", str(data), "--out", str(folder / f"{recipe}.tauext"), "--recipe", recipe, *sizes])
    bundle = str(folder / "observer.tauext")
    touched = data / "collisions-000.parquet"
    save_recording(first_seconds([load_recording(touched)], TOUCHED_S)[0], touched)
    done(["evaluate", "--data", str(data), "--bundles", bundle, "--out", str(folder / "results")])
    done(["run", bundle, str(touched), "--flights", str(folder / "flights")])
    (folder / "reactions.toml").write_text(REACTIONS)
    (folder / "profiles.toml").write_text(PROFILES)
    shapes = {"weight_ih_l0": (12, 6), "weight_hh_l0": (12, 3), "bias_ih_l0": 12, "bias_hh_l0": 12, "input_scale": 6}
    shapes |= {"head.weight": (2, 3), "head.bias": 2, "output_scale_nm": 2}
    np.savez(folder / "own.npz", **{name: np.full(shape, 0.1) for name, shape in shapes.items()})
    make_formats(folder, data)
    make_fleet(folder, data, quick)
    make_servos(folder)
    (folder / "ready").touch()
    return folder


def make_fleet(folder: Path, data: Path, quick: bool) -> None:
    """Two more arms, a fleet, what it knows, and what an arm carries.

    quick: the arms are the same, and the fleet prior is none of theirs.
    """
    for k in (2, 3):
        more = folder / f"data-{k}"
        if not quick:
            done(["simulate", "--out", str(more), *LITTLE, "--seed", str(k)])
            continue
        more.mkdir()
        for path in data.iterdir():
            (more / path.name).symlink_to(path)
    if quick:
        write_fleet_prior(small_prior(), folder / "arm.prior.json")
    else:
        arms = [str(folder / name) for name in ("data", "data-2", "data-3")]
        done(["fleet", "prior", *arms, "--out", str(folder / "arm.prior.json")])
    (folder / "fleet.toml").write_text(FLEET)
    (folder / "loads.toml").write_text(LOADS)


def small_prior() -> FleetPrior:
    """Of two joints with a term each."""
    joints = ("joint1", "joint2")
    kind = ArmType(joints, "exact", 1000.0, 10, "held", ("newton_metre",) * 2, "0" * 64)
    own = tuple((_core.Term(_core.TermKind.viscous, j),) for j in range(2))
    ones = np.ones(2)
    weights = WeightPrior(np.zeros(24), np.eye(24), ones, ones)
    arm = {"name": "a", "minutes": 1.0, "friction": {j: [1.0, 0.1] for j in joints}}
    facts = {
        "arms": [arm | {"trust": dict.fromkeys((*joints, "links"), 1.0)}],
        "spread": {joint: {"friction_nm": 1.0, "spread": 0.1} for joint in joints},
        "settings": {"data": {"a": "a"}},
        "left_out": {},
        "after_a_minute": {},
    }
    return FleetPrior(kind, 20.0, (), own, weights, days=FleetDays(0.01 * np.eye(2), 3, 6), facts=facts)


def done(arguments: list[str]) -> None:
    """Run a command that must work."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as told:
        status = main(arguments)
    if status:
        raise SystemExit(f"tauext {' '.join(arguments)} ended with {status}: {told.getvalue()}")


def make_formats(folder: Path, data: Path) -> None:
    """The beginning of one recording in every format that is imported, with a description for each kind."""
    recording = load_recording(data / "collisions-000.parquet")
    t_s = (recording.t_ns[::EVERY] - recording.t_ns[0]) * 1e-9
    table = {"t": t_s}
    arrays = {"t": t_s}
    for name in ("q", "dq", "tau"):
        values = getattr(recording, name)[::EVERY]
        arrays[name] = values
        table |= {f"{name}_{joint}": values[:, j] for j, joint in enumerate(recording.joints)}
    rows = np.column_stack(list(table.values()))
    np.savetxt(folder / "arm.csv", rows, delimiter=",", header=",".join(table), comments="")
    pq.write_table(pa.table(table), folder / "arm.parquet")
    with h5py.File(folder / "arm.h5", "w") as file:
        for name, values in arrays.items():
            file[name] = values
    savemat(folder / "arm.mat", arrays)
    stamps_ns = (10**18 + recording.t_ns[::EVERY]).tolist()
    messages = [
        (stamp_ns, stamp_ns, recording.joints, *values)
        for stamp_ns, *values in zip(stamps_ns, arrays["q"], arrays["dq"], arrays["tau"], strict=True)
    ]
    for name, kind in (("arm", "sqlite3"), ("arm-mcap", "mcap"), ("arm.bag", "ros1")):
        write_bag(folder / name, kind, {"/joint_states": messages})
    (folder / "robot.xml").write_bytes((data / "robot.xml").read_bytes())
    (folder / "robot.urdf").write_text(URDF)
    for name, text in (("table.toml", ARM), ("arrays.toml", ARRAYS), ("topics.toml", TOPICS)):
        (folder / name).write_text(text)
    source, arm, out = (str(folder / name) for name in ("arm.csv", "table.toml", "lerobot"))
    done(["import", "--source", source, "--arm", arm, "--format", "lerobot", "--out", out])
    (folder / "constants.toml").write_text("[nm_per_ampere]\njoint1 = 1.0\njoint2 = 2.0\n")


def make_servos(folder: Path) -> None:
    """LeRobot datasets of a servo arm with what its calibration says, a bundle of it, and files of buses."""
    episodes = lerobot_arm.episodes(range(6), 300)
    for version in ("v2.1", "v3.0"):
        lerobot_arm.write_dataset(folder / f"servos-{version}", episodes, version)
    (folder / "calibration.json").write_text(json.dumps(lerobot_arm.calibration()))
    described = lerobot_arm.ARM.replace("UNIT", "deg").replace("[robot]", '[robot]\ncalibration = "calibration.json"')
    (folder / "servos.toml").write_text(described)
    dataset, arm, data = (str(folder / name) for name in ("servos-v3.0", "servos.toml", "servos"))
    done(["import", "--source", dataset, "--arm", arm, "--out", data])
    done(["train", "--data", data, "--out", str(folder / "servos.tauext"), "--recipe", "observer"])
    (folder / "bus.toml").write_text(BUS)
    (folder / "can.toml").write_text(CAN)
