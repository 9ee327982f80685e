"""Recordings of real arms: every step is a tauext command; finished steps are not repeated.

    python packages/lab/benchmarks/real_arms.py OUT [--data DIR] [--only ARM ...]     runs the steps in OUT/ARM
    python packages/lab/benchmarks/real_arms.py OUT --keep      also writes the figures of docs/results/real-arms

DIR holds the recordings (--data). Each arm's description is docs/results/real-arms/ARM/arm.toml; other descriptions of
it are made from that one. OUT/ARM/tables.md gets the tables, OUT/ARM/output/ each step's output.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import ROOT, arguments, head, runs, table_row, tauext, write_tables

from tauext.bundle.estimates import load_estimates
from tauext.data.recording_file import load_recording

# --- Tables and figures.


HEALTHY_FROM_S = 0.5
"""From here on the observer has warmed up."""
UR3_SETS = {
    "no-tool": "URDF without the tool",
    "tool": "URDF with the tool",
    "tool-four-runs": "URDF with the tool, four runs of trajectory 1",
    "no-model": "no model",
}
"""Datasets of the UR3, and the model that each is made with."""
EVENTS = {"id2": ((12.15, 12.24), (36.55, 36.68), (40.78, 40.9)), "second10": ((11.62, 11.67),)}
"""What happened in runs of the UR3, [s]; only the last, the impact, is labelled in the dataset."""
NEAR_S = 0.2
"""An alarm within this time of an event belongs to the event."""


def ur3_tables(folder: Path) -> str:
    errors, alarms = [], []
    for data, label in UR3_SETS.items():
        for bundle in results(folder / f"{data}-results")["bundles"]:
            errors.append([label, bundle["name"], *error_cells(bundle, folder / data, "id2-test")])
            found = bundle["collisions"][0]
            hit = f"after {1e3 * found['delay_s']:.0f} ms ({found['joint']})" if found["found"] else "missed"
            rose = rises(folder, f"run {data}-bundles/{bundle['name']}.tauext ")
            near, others = [], []
            for recording, time_s, joint, level in rose:
                spans = EVENTS.get(recording, ())
                inside = any(a - NEAR_S <= time_s <= b + NEAR_S for a, b in spans)
                if inside and not time_s >= 40.7:
                    near.append(f"{recording} {time_s:.2f} s ({joint}, {level})")
                elif not inside:
                    others.append(f"{time_s:.2f}" if recording == "id2" else f"{recording} {time_s:.2f}")
            counted = f"{len(others)}" + (f": {', '.join(others[:6])}{' ...' * (len(others) > 6)} s" if others else "")
            alarms.append([label, bundle["name"], hit, "; ".join(near) or "none", counted])
    columns = ["model, trained on id1 except where noted", "method"]
    errors_of = table([*columns, "error, Nm", "of the torque"], errors)
    return f"""RMS of the error on `id2.bag` before 40 s, Nm, joints 1 to 6, and the same in percent of the torque's RMS

{errors_of}

Alarms (contact or collision) on all of `id2.bag`, the run `second10` and the run `slow`

{table([*columns, "impact at 40.78 s", "unlabelled disturbances", "other alarms"], alarms)}"""


def panda_tables(folder: Path) -> str:
    with_model, without = results(folder / "results"), results(folder / "no-model-results")
    rows = [event_cells(bundle["name"], bundle["events"]["all"]) for bundle in with_model["bundles"]]
    rows += [event_cells(f"{c['name']}, no model", c["events"]["all"]) for c in without["bundles"]]
    rows.append(
        event_cells("the robot's own tau_ext, limit: its largest at rest", with_model["own_torque"]["events"]["all"])
    )
    by_file = []
    verdicts = with_model["bundles"][0]["events"]["verdicts"]
    for name in sorted({v["recording"] for v in verdicts}):
        of = [v for v in verdicts if v["recording"] == name]
        delays = [1e3 * v["delay_s"] for v in of if v["found"]]
        joints = {joint: sum(v["joint"] == joint for v in of) for joint in {v["joint"] for v in of if v["found"]}}
        counts = ", ".join(f"{joint} {n}" for joint, n in sorted(joints.items()))
        by_file.append([name, f"{len(delays)} of {len(of)}", f"{np.median(delays):.0f}", f"{max(delays):.0f}", counts])
    columns = ["", "found", "missed", "false", "delay from the label, ms, median (95 %)", "from the re-timed onset"]
    return f"""Touches of the five recordings that were not used for the limits

{table(columns, rows)}

The observer by recording. Touched links: a 7, b 6, c 5, d 4, f 2

{table(["recording", "found", "delay, ms, median", "largest", "first joint over its limit"], by_file)}"""


def event_cells(name: str, counts: dict) -> list[str]:
    def delays(kind: str) -> str:
        median, most = (counts[f"{kind}_{which}_s"] for which in ("median", "p95"))
        return "-" if median is None else f"{1e3 * median:.0f} ({1e3 * most:.0f})"

    found, events = counts["found"], counts["events"]
    false = f"{counts['false_alarms']} in {3600 * counts['free_hours']:.0f} s"
    return [name, f"{found} of {events}", str(events - found), false, delays("delay"), delays("delay_from_onset")]


def short_tables(recording: str) -> Callable[[Path], str]:
    def tables(folder: Path) -> str:
        bundles = results(folder / "results")["bundles"]
        rows = [[bundle["name"], *error_cells(bundle, folder / "data", recording)] for bundle in bundles]
        words = f"RMS of the error on the held-out `{recording}`, Nm, and in percent of the torque's RMS"
        return words + "\n\n" + table(["method", "error, Nm", "of the torque"], rows)

    return tables


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def error_cells(bundle: dict, data: Path, recording: str) -> list[str]:
    """RMS of the error of each joint, and its share of the torque's RMS over the same samples."""
    signals = load_recording(data / f"{recording}.parquet")
    torque = np.sqrt((signals.tau[signals.time_s >= HEALTHY_FROM_S] ** 2).mean(axis=0))
    error = np.array(bundle["free_motion"]["l2_nm"])
    return [" ".join(f"{e:.2f}" for e in error), " ".join(f"{100 * share:.0f}" for share in error / torque) + " %"]


def rises(folder: Path, command: str) -> list[tuple[str, float, str, str]]:
    """(recording, time, joint, level) of every alarm that began in a `tauext run --json`; a contact that becomes a
    collision within half a second is one."""
    found: list[tuple[str, float, str, str]] = []
    for line in output_of(folder, command).splitlines():
        if not line.startswith("{"):
            continue
        event = json.loads(line)
        if event["event"] != "alarm" or event["alarm"] == "none" or event["was"] == "collision":
            continue
        one = (event["recording"], event["time_s"], event["joint"], event["alarm"])
        if found and found[-1][0] == one[0] and event["was"] == "contact" and one[1] - found[-1][1] < 0.5:
            found[-1] = (*found[-1][:3], one[3])
        else:
            found.append(one)
    return found


def table(columns: list[str], rows: list[list[str]]) -> str:
    return "\n".join([*head(" | ".join(columns)), *(table_row(*row) for row in rows)])


def draw(recording: Path, estimates: Path, joints: list[int], spans: list[tuple[float, float]], path: Path) -> None:
    """The estimate of some joints over time, their thresholds, and where something happened."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from tauext_lab.report.style import CASE_COLOURS, CONTACT, GREY, RC, SENSOR

    signals, estimated = load_recording(recording), load_estimates(estimates)
    with rc_context(RC):
        figure = Figure(figsize=(10, 0.6 + 1.15 * len(joints)), layout="constrained")
        for axes, j in zip(figure.subplots(len(joints), 1, sharex=True, squeeze=False)[:, 0], joints, strict=True):
            for span in spans:
                axes.axvspan(*span, color=CONTACT)
            if signals.tau_ext is not None:
                axes.plot(signals.time_s, signals.tau_ext[:, j], color=SENSOR, lw=0.8, label="the robot's own tau_ext")
            axes.plot(signals.time_s, estimated.tau_ext[:, j], color=CASE_COLOURS["exact"], lw=0.9, label="tauext")
            for sign in (-1, 1):
                label = "threshold" if sign > 0 else None
                limit = sign * estimated.limit_nm[:, j]
                axes.plot(signals.time_s, limit, color=GREY, lw=0.5, ls="--", zorder=1, label=label)
            top = 3 * float(np.median(estimated.limit_nm[:, j])) if signals.tau_ext is None else None
            axes.set_ylim(*((-top, top) if top else (None, None)))
            axes.set_ylabel(f"{signals.joints[j].removesuffix('_joint')}\nNm")
            axes.margins(x=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        axes.set_xlabel("time, s")
        figure.savefig(path, dpi=110)


def ur3_figure(folder: Path, path: Path) -> None:
    estimates = folder / "tool-results/estimates/prior/id2.parquet"
    draw(folder / "tool/id2.parquet", estimates, list(range(6)), list(EVENTS["id2"]), path)


def panda_figure(folder: Path, path: Path) -> None:
    recording = folder / "data/c3.parquet"
    signals = load_recording(recording)
    spans = [(signals.time_s[begin], signals.time_s[end - 1]) for begin, end in runs(signals.contact == 1)]
    draw(recording, folder / "results/estimates/observer/c3.parquet", [0, 1, 2, 3], spans, path)


def file_of(folder: Path, command: str) -> Path:
    return folder / "output" / f"{re.sub(r'[^A-Za-z0-9.-]+', '_', command)[:120]}.txt"


def output_of(folder: Path, begins: str) -> str:
    """Output of the one command that begins like this."""
    (path,) = (folder / "output").glob(file_of(folder, begins).stem + "*")
    return path.read_text()


# --- The arms.


KEPT = ROOT / "docs" / "results" / "real-arms"


@dataclass(frozen=True)
class Arm:
    files: dict[str, str]
    """Name in OUT/ARM: path in the data folder."""
    commands: list[str]
    """Those that shall fail begin with their exit status."""
    tables: Callable[[Path], str] = lambda folder: ""
    figures: dict[str, Callable[[Path, Path], None]] = field(default_factory=dict)
    variants: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    """Other descriptions, NAME.toml: what is replaced in arm.toml (regular expressions)."""


# --- UR3

RUNS = {"slow": "2019-11-27-11-55-35", "first10": "_2019-11-27-20-59-11", "first10b": "_2019-11-27-21-04-09"}
RUNS |= {"first20": "_2019-11-27-21-25-26", "second10": "_2019-11-27-23-05-36"}
NO_TOOL = (r"(?s)# What check.*?\n\n(?=\[signals.q\])", "")
UNSEEN = ("id2", "second10", "slow")  # trajectory 2 whole, its first 10 s on another day, and a slow motion


def ur3_commands() -> list[str]:
    bags = " ".join(f"{name}.bag" for name in ("id1", "id2", *RUNS))
    commands = [
        "import --new new.toml --source id1.bag --robot ur3_robot.urdf",
        "import --source id1.bag --arm new.toml --out first",
        "1 check --data first",
    ]
    for data in UR3_SETS:
        commands += [f"import --source {bags} --arm {'arm' if data == 'tool' else data}.toml --out {data}"]
        commands += [f"check --data {data}"] if data != "tool-four-runs" else []
        bundles = [f"{data}-bundles/{recipe}.tauext" for recipe in ("prior", "friction")]
        for bundle in bundles:
            accepted = " --accept limit-wide" if bundle == "no-model-bundles/friction.tauext" else ""
            commands.append(f"train --data {data} --recipe {Path(bundle).stem} --out {bundle}{accepted}")
        commands.append(f"evaluate --data {data} --bundles {' '.join(bundles)} --out {data}-results")
        recordings = " ".join(f"{data}/{name}.parquet" for name in UNSEEN)
        commands += [f"run {b} {recordings} --acknowledge-after-s 0.5 --json" for b in bundles]
    return commands


# --- Panda, touched at rest

TOUCHED = ("a4", "a6", "b8", "b9", "c3", "d3", "f2", "f4")
MARGINS = "--config margins.toml"
SETTINGS = ("margins.toml", "sines.toml")
"""Files for --config that are kept beside an arm's arm.toml."""
AT_REST = ("observer", "highpass", "bandpass")


def panda_commands() -> list[str]:
    bundles = [f"bundles/{recipe}.tauext" for recipe in AT_REST]
    return [
        "import --new new.toml --source a4.csv.gz --robot panda.urdf",
        f"import --source {' '.join(f'{name}.csv.gz' for name in TOUCHED)} --arm arm.toml --out data",
        "check --data data",
        "2 train --data data --recipe prior --out prior.tauext",
        *(f"train --data data --recipe {Path(b).stem} {MARGINS} --out {b}" for b in bundles),
        f"evaluate --data data --bundles {' '.join(bundles)} --out results",
        f"import --source {' '.join(f'{name}.csv.gz' for name in TOUCHED)} --arm no-model.toml --out no-model",
        f"train --data no-model --recipe bandpass {MARGINS} --out no-model-bundles/bandpass.tauext",
        "evaluate --data no-model --bundles no-model-bundles/bandpass.tauext --out no-model-results",
    ]


# --- UR10, moving Panda, KUKA: no contact, and little motion


def short_commands(source: str, refused: list[str]) -> list[str]:
    bundles = [f"bundles/{recipe}.tauext" for recipe in ("prior", "friction", "no-model")]
    return [
        f"import --source {source} --arm arm.toml --out data",
        *refused,
        *(f"train --data data --recipe {Path(b).stem} --out {b}" for b in bundles[:2]),
        f"train --data data --recipe prior --case none --out {bundles[2]}",
        f"evaluate --data data --bundles {' '.join(bundles)} --out results",
    ]


REFUSED = [
    "2 train --data data --minutes 10 --out ten-minutes.tauext",
    "2 train --data data --limits promised --out promised.tauext",
    "train --data data --out tauext.tauext",
]
KUKA = ("prior", "sines", "friction")
WRONG_UNITS = [(r"unit = .*\n", ""), (r"offset = .*\n", ""), (r"side = .*\n", "")]
UR10_BAG, PANDA_BAG = (f"unisa_bags/{name}_exciting" for name in ("ur10", "panda"))


ARMS = {
    "ur3": Arm(
        {f"{new}.bag": f"ur3_aspectum/{old}.bag" for new, old in ({"id1": "id1", "id2": "id2"} | RUNS).items()}
        | {"ur3_robot.urdf": "models/ur3_robot.urdf"},
        ur3_commands(),
        ur3_tables,
        {"id2.png": ur3_figure},
        {
            "no-tool": [NO_TOOL],
            "no-model": [NO_TOOL, (r'model = ".*"\n', "")],
            "tool-four-runs": [(r'"id1.bag"\]', '"id1.bag", "first10.bag", "first10b.bag", "first20.bag"]')],
        },
    ),
    "panda": Arm(
        {f"{name}.csv.gz": f"panda_mindlab/{name}.csv.gz" for name in TOUCHED} | {"panda.urdf": "models/panda.urdf"},
        panda_commands(),
        panda_tables,
        {"c3.png": panda_figure},
        {"no-model": [(r'model = ".*"\n', "")]},
    ),
    "ur10": Arm(
        {"ur10_exciting": UR10_BAG, "ur10_robot.urdf": "models/ur10_robot.urdf"},
        short_commands("ur10_exciting", ["check --data data", *REFUSED]),
        short_tables("ur10_exciting-test"),
    ),
    "kuka": Arm(
        {f"{run}.mat": f"kr_weigand/2020-10-21_10s_FF_{run}_08ms.mat" for run in "ABC"},
        [
            "import --source A.mat B.mat C.mat --arm as-it-stands.toml --out first",
            "1 check --data first",
            "import --source A.mat B.mat C.mat --arm arm.toml --out data",
            "check --data data",
            "2 train --data data --case exact --out exact.tauext",
            "2 train --data data --recipe paper --out paper.tauext",
            "train --data data --recipe prior --out bundles/prior.tauext",
            "train --data data --recipe prior --config sines.toml --out bundles/sines.tauext",
            "train --data data --recipe friction --out bundles/friction.tauext",
            "show bundles/prior.tauext",
            f"evaluate --data data --bundles {' '.join(f'bundles/{b}.tauext' for b in KUKA)} --out results",
        ],
        short_tables("C"),
        variants={"as-it-stands": WRONG_UNITS},
    ),
    "panda_unisa": Arm(
        {"panda_exciting": PANDA_BAG, "panda.urdf": "models/panda.urdf"},
        short_commands("panda_exciting", ["check --data data", *REFUSED]),
        short_tables("panda_exciting-test"),
    ),
}


def prepare(name: str, data: Path, folder: Path) -> None:
    """The recordings and descriptions of an arm, in a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for new, old in ARMS[name].files.items():
        if not (data / old).exists():
            sys.exit(f"{data / old}: it is not there; --data names the folder of the recordings")
        copy = shutil.copytree if (data / old).is_dir() else shutil.copy
        if not (folder / new).exists():
            copy(data / old, folder / new)
    text = (KEPT / name / "arm.toml").read_text()
    for variant, changes in ({"arm": []} | ARMS[name].variants).items():
        changed = text
        for pattern, by in changes:
            changed, times = re.subn(pattern, by, changed)
            assert times, f"{name}/arm.toml: nothing to replace: {pattern}"
        (folder / f"{variant}.toml").write_text(changed)
    for settings in SETTINGS:
        if (KEPT / name / settings).is_file():
            shutil.copy(KEPT / name / settings, folder)


def plain(commands: list[str]) -> list[str]:
    return [re.sub(r"^\d ", "", command) for command in commands]


def carry_out(name: str, folder: Path) -> None:
    (folder / "output").mkdir(exist_ok=True)
    for command, bare in zip(ARMS[name].commands, plain(ARMS[name].commands), strict=True):
        path = file_of(folder, bare)
        if path.exists():
            continue
        print(f"{name}: tauext {bare}", flush=True)
        expected = int(command[0]) if command != bare else 0
        path.write_text(tauext(*shlex.split(bare), folder=folder, accept=(expected,)))


def main() -> None:
    parser = arguments(__doc__, "out", data="")
    parser.add_argument("--only", nargs="+", choices=tuple(ARMS), default=tuple(ARMS))
    parser.add_argument("--keep", action="store_true", help=f"put figures into {KEPT.relative_to(ROOT)}")
    options = parser.parse_args()
    for name in options.only:
        folder = options.out.resolve() / name
        prepare(name, options.data, folder)
        carry_out(name, folder)
        write_tables(folder, [ARMS[name].tables(folder)])
        for figure, make in ARMS[name].figures.items():
            make(folder, (KEPT / name if options.keep else folder) / figure)


if __name__ == "__main__":
    main()
