"""Real recordings: held-out torque and rollouts of the robot file as it came, of mujoco.sysid, and of the twin.

    python packages/twin/benchmarks/recordings.py OUT [--data DIR] [--only ARM ...]

DIR holds the shared recordings. Three splits of each of four arms; what is finished is not repeated. mujoco.sysid
(sysid_fit.py) fits the training recordings that the twin is made of, twice: so that rollouts of half a second, from
recorded states with the recorded torques as controls, come closest to the recorded positions and velocities, and so
that MuJoCo's inverse dynamics come closest to the recorded torques. Both find damping, frictionloss and armature of
each joint, mass and centre of mass of its heaviest body. A rollout of constant velocity needs no model at all. Of a
Staubli TX40 friction, rotor inertia and offsets stand beside those that others published. OUT gets tables.md and
tables.json.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[2] / "lerobot/benchmarks"))

from common import ROOT, arguments, checkpoint, head, joined, short, table_row, tauext, trained, write_tables
from mocca import write_dataset
from sysid_fit import CAP_S, WINDOW_S, fitted, toolbox
from tauext_lab.bench.mocca_recording import read_segments
from tauext_twin.arm import Arm, read_arm
from tauext_twin.held_out import MOST_WINDOWS, WINDOWS_S, rollout_errors, torque_errors, windows
from tauext_twin.model_file import Inertial, JointChange
from tauext_twin.posterior import Kind, find_posterior
from tauext_twin.twin import changed_model, drives_of, finite, make_twin

from tauext.data.dataset import Split, save_split
from tauext.progress import Silent

KEPT = ROOT / "docs/results/real-arms"
UR3 = {"first20": "_2019-11-27-21-25-26.bag", "second10": "_2019-11-27-23-05-36.bag"}
SPLITS: dict[str, list[tuple[list[str], list[str]]]] = {
    "ur3": [
        (["id1.bag"], ["id2.bag[0:40]"]),
        (["id2.bag[0:40]"], ["id1.bag"]),
        ([UR3["first20"], UR3["second10"]], ["id1.bag[25:45]", "id2.bag[15:40]"]),
    ],
    "panda": [
        (["panda_exciting[0:16]"], ["panda_exciting[16:25]"]),
        (["panda_exciting[8:25]"], ["panda_exciting[0:8]"]),
        (["panda_exciting[0:8]", "panda_exciting[16:25]"], ["panda_exciting[8:16]"]),
    ],
    "mocca": [([f"segment-{k}.parquet" for k in range(9) if k % 3 != of],
               [f"segment-{k}.parquet" for k in range(9) if k % 3 == of]) for of in range(3)],
}  # fmt: skip
"""Training and test recordings of each split."""
SO101_MINUTES = 10

# --- Datasets.


def described(robot: Path, folder: Path, sources: Sequence[Path], text: str, split: tuple) -> None:
    """Import sources by a description, whose robot file and split are put in."""
    text = re.sub(r'model = ".*"', f'model = "{robot.resolve()}"', re.sub(r"(?s)\[split\].*", "", text))
    text += f"\n[split]\ntrain = {list(split[0])}\ntest = {list(split[1])}\n".replace("'", '"')
    (folder / "arm.toml").write_text(text)
    tauext("import", "--source", *sources, "--arm", folder / "arm.toml", "--out", folder / "data",
           printed=folder / "import.txt")  # fmt: skip


def ur3(data: Path, folder: Path, k: int) -> None:
    """Without the tool that the arm carries: neither file nor description has it."""
    text = re.sub(r"(?s)# What check.*?\n\n(?=\[signals.q\])", "", (KEPT / "ur3/arm.toml").read_text())
    split = SPLITS["ur3"][k]
    sources = [data / "ur3_aspectum" / name for name in sorted({re.sub(r"\[.*", "", n) for n in sum(split, [])})]
    described(data / "models/ur3_robot.urdf", folder, sources, text, split)


def panda(data: Path, folder: Path, k: int) -> None:
    source, text = data / "unisa_bags/panda_exciting", (KEPT / "panda_unisa/arm.toml").read_text()
    described(data / "models/panda.urdf", folder, [source], text, SPLITS["panda"][k])


def mocca(data: Path, folder: Path, k: int) -> None:
    dataset = write_dataset(read_segments(data / "mocca"), folder / "data")
    there, (train, test) = set(dataset.split.train), SPLITS["mocca"][k]
    save_split(Split(*(tuple(n for n in names if n in there) for names in (train, [], test))), folder / "data")


def so101(data: Path, folder: Path, k: int) -> None:
    """Torque from goal minus position, as `torque_from = "goal"` has it; motions drawn as in servo_stalls.py."""
    from servo_stalls import JOINTS, Trial, drawn

    split = [[f"{n}.parquet" for n in names] for names in drawn(data / "so101_sage", Trial(k, "goal", SO101_MINUTES))]
    text = f"""\
[robot]
model = ""
joints = {list(JOINTS)}

[time]
column = "t"

[servo]
type = "sts3215-7.4v"
torque_from = "goal"

[signals]
q.columns = "q_{{joint}}"
q_des.columns = "goal_{{joint}}"
current.columns = "current_{{joint}}"

[split]""".replace("'", '"')
    sources = [data / "so101_sage" / name for name in sum(split, [])]
    described(data / "models/so101.urdf", folder, sources, text, tuple(split))


DATASETS: dict[str, Callable[[Path, Path, int], None]] = {"mocca": mocca, "panda": panda, "ur3": ur3, "so101": so101}

# --- One split.


def measured(folder: Path) -> dict[str, Any]:
    """Held-out torque and rollouts of the file, of mujoco.sysid and of the twin, and the time that each takes."""
    bundle = trained(folder / "data", folder / "prior.tauext", "--accept", "limit-wide")
    train_s = sum(json.loads(bundle.with_suffix(".wall_time_s.json").read_text()).values())
    begun = time.monotonic()
    arm = read_arm(bundle, None, folder / "data", {})
    content = make_twin(arm, folder / "twin.xml", 0, 0, Silent())
    twin_s = time.monotonic() - begun
    drives = drives_of(arm) if content["rollout"]["replayed"] == "goals" else []
    of, ends = content["torque"].values(), content["rollout"]["rms_end_rad"]
    found: dict[str, Any] = {
        "joints": list(arm.names),
        "training_s": sum(one.duration_s for one in arm.training),
        "test_s": sum(one.duration_s for one in arm.test),
        "units": [one["unit"] for one in of],
        "replayed": content["rollout"]["replayed"],
        "rms": [one["rms"] for one in of],
        "rmse": {name: [one[f"rmse_{name}"] for one in of] for name in ("file", "twin")},
        "rollout": {name: {w: one[name] for w, one in ends.items()} for name in ("file", "twin")},
        "time_s": {"train": train_s, "twin": twin_s},
        "twin": {
            name: {what: [one[what]["value"], one[what]["standard_error"], one[what]["file"]] for what in SHOWN}
            for name, one in content["joints"].items()
        },
    }
    found["sysid"] = {}
    found["rollout"]["still"] = {f"{w:g}": one for w, one in unchanged(arm).items()}
    for by in FITS:
        fit = checkpoint(folder / f"sysid-{by}.json", lambda by=by: asdict(fitted(arm, by)))
        changes = [JointChange(**one | {"inertial": Inertial(**one["inertial"])}) for one in fit["changes"]]
        model, beside = changed_model(arm, changes)
        found["rmse"][by] = torque_errors(arm, [beside])[0][0].tolist()
        rolled = rollout_errors(arm, model, drives)
        found["rollout"][by] = {f"{w:g}": finite(one) for w, one in rolled.items()}
        found["time_s"][by] = fit["time_s"]
        found["sysid"][by] = {name: fit[name] for name in ("capped", "windows", "error")} | {
            "joints": {one.joint: [one.damping, one.frictionloss, one.armature] for one in changes},
            "masses": [one["inertial"]["mass"] for one in fit["changes"]],
        }
    return found


FITS = ("rollout", "torque")
"""What mujoco.sysid makes come closest."""
MODELS = {
    "file": "file as it came",
    "rollout": "mujoco.sysid, rollouts",
    "torque": "mujoco.sysid, torques",
    "twin": "twin",
}


def unchanged(arm: Arm) -> dict[float, list[float]]:
    """Errors of a rollout whose velocity never changes, which needs no model."""
    out = {}
    for w in WINDOWS_S:
        ends = [one.q[b] - one.q[a] - one.dq[a] * (b - a) / one.rate_hz for one, a, b in windows(arm.test, w)]
        if ends:
            out[w] = np.sqrt(np.mean(np.square(ends), axis=0)).tolist()
    return out


SHOWN = ("damping", "frictionloss", "armature", "mass")


# --- TX40.

TX40_PUBLISHED = {
    "damping": (8.05, 5.53, 1.97, 1.11, 1.86, 0.65),
    "frictionloss": (7.14, 8.26, 6.34, 2.48, 3.03, 0.282),
    "armature": (0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105),
    "offset": (0.392, 1.37, 0.326, -0.102, -0.0288, 0.127),
}
"""What the source of the recording identified: [N m s/rad], [N m], [kg m^2], [N m]."""
TX40_RATE_HZ = 500
TX40_SPLIT = (["tx40.csv[0:5.5]"], ["tx40.csv[5.5:9.1]"])


def tx40_dataset(data: Path, folder: Path) -> None:
    """Motor side to joint side by the coupled gears, and 5 kHz to TX40_RATE_HZ."""
    from scipy.signal import decimate

    p, c = (np.genfromtxt(data / f"tx40/{name}.csv.gz", delimiter=",", skip_header=1)
            for name in ("motor_positions_rad", "motor_torque"))  # fmt: skip
    gear = np.diag([32.0, 32, 45, -48, 45, 32])
    gear[5, 4] = 32
    q = np.linalg.solve(gear, p.T).T + np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    tau = c @ gear  # T = M^T
    rows = [decimate(one, 5000 // TX40_RATE_HZ, ftype="fir", axis=0) for one in (q, tau)]
    t = np.arange(len(rows[0])) / TX40_RATE_HZ
    names = [f"{what}{j}" for what in ("q", "tau") for j in range(6)]
    table = np.column_stack([t, *rows])
    np.savetxt(folder / "tx40.csv", table, delimiter=",", header=",".join(["t", *names]), comments="")
    text = """\
[robot]
model = ""
joints = ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"]

[time]
column = "t"

[signals.q]
columns = "q{index}"

[signals.tau]
columns = "tau{index}"

[split]"""
    described(data / "tx40/tx40.urdf", folder, [folder / "tx40.csv"], text, TX40_SPLIT)


def tx40(folder: Path) -> dict[str, Any]:
    """Friction, rotor inertia and offsets with standard errors, beside what the measured torque leaves."""
    arm = read_arm(
        trained(folder / "data", folder / "prior.tauext", "--accept", "limit-wide"), None, folder / "data", {}
    )
    content = make_twin(arm, folder / "twin.xml", 0, 0, Silent())
    posterior = find_posterior(arm)
    x, error = posterior.off_the_file(), np.sqrt(np.diag(posterior.covariance))
    kinds = [(term.kind, term.a) for of in arm.terms for term in of]
    at = [kinds.index((Kind.constant, j)) for j in range(len(arm.names))]
    found = {what: [[one[what]["value"], one[what]["standard_error"]] for one in content["joints"].values()]
             for what in ("damping", "frictionloss", "armature")}  # fmt: skip
    found["offset"] = [[-float(x[k]), float(error[k])] for k in at]
    torque = {name: [one["rms"], one["rmse_file"], one["rmse_twin"]] for name, one in content["torque"].items()}
    return {"found": found, "published": TX40_PUBLISHED, "torque": torque}


# --- Tables.


def lines_of(found: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Means over splits; of the rollouts the root of the mean square over joints, in the median split."""
    lines = head("arm | model | held-out torque, RMSE by joint, N m | as share of the torque | "
                 f"rollout {', '.join(f'{w:g}' for w in WINDOWS_S)} s, rad | time, s")  # fmt: skip
    for name, splits in found.items():
        rms = np.mean([one["rms"] for one in splits], axis=0)
        for model, words in MODELS.items():
            errors = np.array([one["rmse"][model] for one in splits])
            share = [float(np.mean(np.divide(one["rmse"][model], one["rms"]))) for one in splits]
            parts = {"file": (), "twin": ("train", "twin")}.get(model, (model,))
            spent = [sum(one["time_s"][part] for part in parts) for one in splits]
            capped = sum(one["sysid"][model]["capped"] for one in splits) if model in FITS else 0
            time_s = f"{np.mean(spent):.0f}" + (f" ({capped} capped)" if capped else "") if parts else ""
            cells = [joined(errors.mean(axis=0), ".3g"), f"{joined([100 * one for one in share], '.0f', ', ')} %"]
            rolled = joined(rollouts(splits, model), ".2g", ", ")
            lines.append(
                table_row(f"{name}, {len(splits)} splits" if model == "file" else "", words, *cells, rolled, time_s)
            )
        rolled = joined(rollouts(splits, "still"), ".2g", ", ")
        lines.append(table_row("", "torque's RMS; constant velocity", joined(rms, ".3g"), "", rolled, ""))
    return lines


def rollouts(splits: list[dict[str, Any]], model: str) -> list[float]:
    """Root of the mean square over joints by length, in the median split; infinite where half diverge."""
    out = []
    for window in WINDOWS_S:
        ends = [one["rollout"][model].get(f"{window:g}") for one in splits]
        of = [np.inf if None in one else float(np.sqrt(np.mean(np.square(one)))) for one in ends if one]
        out.append(float(np.median(of)) if of else float("nan"))
    return out


def tx40_lines(found: dict[str, Any]) -> list[str]:
    lines = head("TX40 | " + " | ".join(f"joint {j}" for j in range(1, 7)))
    for what, values in found["found"].items():
        lines.append(table_row(f"{what}, published", *found["published"][what]))
        lines.append(table_row(f"{what}, twin", *(f"{value:.3g} ± {error:.2g}" for value, error in values)))
    for row, what in enumerate(("torque, RMS", "held-out RMSE, file", "held-out RMSE, twin")):
        lines.append(table_row(f"{what}, N m", *(f"{one[row]:.3g}" for one in found["torque"].values())))
    return lines


def main() -> None:
    parser = arguments(__doc__, "out", data="")
    parser.add_argument("--only", nargs="+", choices=(*DATASETS, "tx40"), default=(*DATASETS, "tx40"))
    options = parser.parse_args()
    toolbox()
    out = options.out.resolve()
    found: dict[str, list[dict[str, Any]]] = {}
    lines: list[str] = []
    for k in range(3):
        for name in (name for name in DATASETS if name in options.only):
            folder = out / f"{name}-{k}"
            prepared(folder, lambda folder=folder, name=name, k=k: DATASETS[name](options.data, folder, k))
            found.setdefault(name, []).append(checkpoint(folder / "measured.json", lambda f=folder: short(measured(f))))
            print(f"{name}, split {k + 1}", flush=True)
    content: dict[str, Any] = {
        "sysid": {"window_s": WINDOW_S, "most_windows": MOST_WINDOWS, "cap_s": CAP_S},
        "arms": found,
    }
    if found:
        lines = lines_of(found)
    if "tx40" in options.only:
        prepared(out / "tx40", lambda: tx40_dataset(options.data, out / "tx40"))
        content["tx40"] = checkpoint(out / "tx40/measured.json", lambda: short(tx40(out / "tx40")))
        lines += ["", *tx40_lines(content["tx40"])]
    write_tables(out, lines, content)


def prepared(folder: Path, make: Callable[[], None]) -> None:
    """A split's folder with its dataset."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "data/split.json").exists():
        make()


if __name__ == "__main__":
    main()
