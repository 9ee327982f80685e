"""Healthy time, errors and detected collisions of logs with uneven clocks, compared with an even one.

    python packages/lab/benchmarks/uneven_clocks.py OUT [--rates 100 125 500] [--collision-recordings 40]

The virtual rig's free motion and pulses are sampled on uneven clocks, written as CSV, imported, trained on (recipe
prior) and evaluated. OUT/uneven_clocks.md gets the table. Existing rows are used again.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, estimates, head, quantiles_ms, table_row, tauext, trained, write_tables

from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import OK
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording

SEED = 1
FREE_MINUTES = 6.0
ARM = """[robot]
model = "robot.xml"
joints = ["joint1", "joint2"]
[signals]
q = {columns = "q_{number}", unit = "rad"}
dq = {columns = "dq_{number}", unit = "rad/s"}
tau = {columns = "tau_{number}", unit = "Nm", timing = "instant"}
[time]
column = "t"
unit = "s"
[contact]
column = "contact"
contact_values = [1]
free_values = [0]
cut = false
"""


@dataclass(frozen=True)
class Clock:
    """Steps of one period, but every so often one that is longer; frames that are lost or repeat the one before."""

    name: str
    longer: float = 1.0
    every: int = 2
    lost: float = 0.0
    repeated: float = 0.0

    def stamps_s(self, period_s: float, length_s: float, rng: np.random.Generator) -> np.ndarray:
        """Times of the samples, from 0 on."""
        steps = np.where(np.arange(int(length_s / period_s)) % self.every == self.every - 1, self.longer, 1.0)
        t = np.concatenate([[0.0], np.cumsum(steps) * period_s])
        t = t[t < length_s]
        return t[rng.random(len(t)) >= self.lost]


CLOCKS = (
    Clock("even"),
    Clock("every 3rd step 1.3 periods: 10 %", 1.3, 3),
    Clock("6 % of the frames lost", lost=0.06),
    Clock("10 % of the frames lost", lost=0.1),
    Clock("every 3rd step 1.2 periods, 6 % lost", 1.2, 3, lost=0.06),
    Clock("6 % of the frames repeated", repeated=0.06),
)


def write_csv(recording: Recording, clock: Clock, rate_hz: float, path: Path, rng: np.random.Generator) -> None:
    """The recording as a log with this clock, its signals linear between samples."""
    t = clock.stamps_s(1 / rate_hz, recording.duration_s, rng)
    seconds = recording.time_s
    signals = (recording.q, recording.dq, recording.tau)
    columns = [np.interp(t, seconds, signal[:, j]) for signal in signals for j in (0, 1)]
    contact = np.zeros(len(seconds)) if recording.contact is None else recording.contact
    again = np.r_[False, rng.random(len(t) - 1) < clock.repeated]
    held = np.maximum.accumulate(np.where(again, 0, np.arange(len(t))))
    at = np.minimum(np.searchsorted(seconds, t), len(seconds) - 1)
    table = np.column_stack([t, *[column[held] for column in columns], contact[at]])
    header = "t,q_1,q_2,dq_1,dq_2,tau_1,tau_2,contact"
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")


def row(folder: Path, base: Path, clock: Clock, rate_hz: float) -> dict:
    """What became of one clock at one rate."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(base / "robot.xml", folder)
    (folder / "arm.toml").write_text(ARM)
    dataset, rng = load_dataset(base), np.random.default_rng(SEED)
    sets = ("train", "test", "collisions")
    for kind in sets:
        for k, loader in enumerate(dataset.loaders(kind)[: len(getattr(dataset.split, kind))]):
            write_csv(loader(), clock, rate_hz, folder / f"{kind}{k:03d}.csv", rng)
    data, bundle = folder / "data", folder / "arm.tauext"
    tauext("import", "--source", *sorted(folder.glob("*.csv")), "--arm", folder / "arm.toml", "--out", data)
    split = {kind: sorted(path.name for path in data.glob(f"{kind}*.parquet")) for kind in sets}
    (data / "split.json").write_text(json.dumps({"format": 1} | split))
    trained(data, bundle)
    tauext("evaluate", "--data", data, "--bundles", bundle, "--out", folder / "results")
    results = json.loads((folder / "results" / "results.json").read_text())["bundles"][0]
    free, latched = results["free_motion"], results["latched"]
    found = {name: latched[name] for name in ("latched", "collisions", "delay_median_s")}
    found |= {name: free[name] for name in ("l1_nm", "false_collisions")}
    return found | {"clock": clock.name, "rate_hz": rate_hz, "healthy": healthy(bundle, data)}


def healthy(path: Path, data: Path) -> float:
    """Share of the samples after the first healthy one of each recording that are healthy."""
    bundle, found = load_bundle(path), []
    for recording in (load_recording(one) for one in sorted(data.glob("*.parquet"))):
        ok = estimates(bundle, recording)["health"] == OK
        found.append(ok[int(ok.argmax()) :])
    return float(np.concatenate(found).mean())


def line(found: dict) -> str:
    l1 = " / ".join("-" if value is None else f"{value:.2f}" for value in found["l1_nm"])
    delay = quantiles_ms([found["delay_median_s"]] if found["latched"] else [], (0.5,))
    latched = f"{found['latched']} of {found['collisions']}"
    rate, share = f"{found['rate_hz']:g}", f"{found['healthy']:.1%}"
    return table_row(rate, found["clock"], share, l1, latched, delay, found["false_collisions"])


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 125.0, 500.0])
    parser.add_argument("--collision-recordings", type=int, default=40)
    options = parser.parse_args()
    base = options.out / "rig"
    if not (base / "split.json").exists():
        words = ("--minutes", FREE_MINUTES, "--collision-recordings", options.collision_recordings, "--seed", SEED)
        tauext("simulate", "--out", base, *words)
    lines = head("Hz | clock | healthy | L1 in N m | collisions | delay in ms | false")
    for rate in options.rates:
        for number, clock in enumerate(CLOCKS):
            folder = options.out / f"{rate:g}-{number}"
            lines.append(line(checkpoint(folder / "row.json", partial(row, folder, base, clock, rate))))
            print(lines[-1], flush=True)
    write_tables(options.out, lines, name="uneven_clocks")


if __name__ == "__main__":
    main()
