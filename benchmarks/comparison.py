"""The comparison of docs/results/comparison: every step is a tauext command, and what is finished is not repeated.

python benchmarks/comparison.py OUT            runs all steps, hours on two cores, some 40 GB
python benchmarks/comparison.py OUT --list     prints the commands
python benchmarks/comparison.py OUT --tables   prints the tables of what is there, as Markdown
"""

from __future__ import annotations

import argparse
import itertools
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from common import head, table_row

HOURS = "--minutes 90 --collision-recordings 50 --calibration-hours 24.2 --test-hours 10"
FEWER_HOURS = "--minutes 90 --collision-recordings 50 --calibration-hours 8.1 --test-hours 3.4"  # of other encoders
CASES = ("exact", "mass", "com", "mass+com", "none")
EVERY_METHOD = ("exact", "none")
MINUTES = (2, 5, 10, 20, 45)
GAINS = (20, 50, 100)
LIMITS = {
    "prior-constants": 'recipe = "prior"\nerror_scale = "off"\nobserver.gain_per_s = 20\n',
    "friction-scaled": 'recipe = "friction"\nerror_scale = "on"\n',
    "observer-scaled": 'recipe = "observer"\nerror_scale = "on"\n',
}
"""Settings: each kind of limits with the methods that usually have the other."""
ENCODER_BITS = (16, 12)
SHORT_TEST = 40  # recordings, for learning curves


def steps(out: Path) -> list[tuple[Path, str]]:
    """(what a command makes, the command), in order."""
    data = out / "data"
    found = [(data / "split.json", f"simulate --out {data} {HOURS}")]
    for case in CASES:
        methods = "" if case in EVERY_METHOD else " --methods prior"
        command = f"evaluate --data {data} --out {out / case} --baselines --case {case}{methods}"
        found.append((out / case / "results.json", command))
    for gain in GAINS:
        bundles = [out / f"gain-{gain}" / "bundles" / f"{case}.tauext" for case in EVERY_METHOD]
        for case, bundle in zip(EVERY_METHOD, bundles, strict=True):
            command = f"train --data {data} --case {case} --config {out}/gain-{gain}.toml --out {bundle}"
            found.append((bundle, command))
        found.append(evaluated(data, out / f"gain-{gain}", bundles))
    scaled = [out / "limits" / "bundles" / f"{name}-{case}.tauext" for case in EVERY_METHOD for name in LIMITS]
    for bundle, (case, name) in zip(scaled, itertools.product(EVERY_METHOD, LIMITS), strict=True):
        found.append((bundle, f"train --data {data} --case {case} --config {out}/{name}.toml --out {bundle}"))
    found.append(evaluated(data, out / "limits", scaled))
    little = [out / "ten-minutes" / "bundles" / f"{case}-10min.tauext" for case in EVERY_METHOD]
    for case, bundle in zip(EVERY_METHOD, little, strict=True):
        found.append((bundle, f"train --data {data} --case {case} --minutes 10 --out {bundle}"))
    found.append(evaluated(data, out / "ten-minutes", little))
    curves = []
    for recipe in ("tauext", "dense"):
        for minutes in MINUTES:
            bundle = out / "learning" / "bundles" / f"{recipe}-{minutes}.tauext"
            command = f"train --data {data} --recipe {recipe} --minutes {minutes} --limits paper --out {bundle}"
            found.append((bundle, command))
            curves.append(bundle)
    curves += [out / "exact" / "bundles" / f"{name}.tauext" for name in ("tauext", "paper-lstm")]
    found.append(evaluated(out / "short", out / "learning", curves))
    for bits in ENCODER_BITS:
        coarse = out / f"data-{bits}-bit"
        found.append((coarse / "split.json", f"simulate --out {coarse} {FEWER_HOURS} --encoder-bits {bits}"))
        command = f"evaluate --data {coarse} --out {out / f'encoder-{bits}'} --baselines --methods prior friction"
        found.append((out / f"encoder-{bits}" / "results.json", command))
    sticky, exact = out / "data-friction", out / "exact" / "bundles"
    hours = "--minutes 20 --collision-recordings 50 --test-hours 10 --friction 1.3"
    found.append((sticky / "split.json", f"simulate --out {sticky} {hours}"))
    found.append(evaluated(sticky, out / "friction", [exact / f"{name}.tauext" for name in ("prior", "friction")]))
    return found


def write_settings(out: Path) -> None:
    """Files for --config."""
    gains = {f"gain-{gain}": f'recipe = "prior"\nobserver.gain_per_s = {gain}\n' for gain in GAINS}
    out.mkdir(parents=True, exist_ok=True)
    for name, text in (LIMITS | gains).items():
        (out / f"{name}.toml").write_text(text)


def evaluated(data: Path, out: Path, bundles: list[Path]) -> tuple[Path, str]:
    return out / "results.json", f"evaluate --data {data} --out {out} --bundles {' '.join(map(str, bundles))}"


def make_short(out: Path) -> None:
    """The dataset without collisions and with some of its test recordings, for learning curves."""
    short, data = out / "short", out / "data"
    split = json.loads((data / "split.json").read_text())
    split |= {"test": split["test"][:SHORT_TEST], "collisions": [], "calibration": []}
    short.mkdir(exist_ok=True)
    for name in ("robot.xml", *split["test"], *split["train"], *split["validation"]):
        if not (short / name).exists():
            (short / name).symlink_to((data / name).resolve())
    (short / "split.json").write_text(json.dumps(split, indent=1))


# --- tables


def tables(out: Path) -> str:
    """Of every results.json that is there, one line a method."""
    parts = []
    for path in sorted(out.glob("*/results.json")):
        bundles = json.loads(path.read_text())["bundles"]
        parts += [f"\n**{path.parent.name}**\n", HEAD, *map(line, bundles)]
    return "\n".join(parts)


HEAD = "\n".join(
    head(
        "method | L1 | RMSE near stiction | RMSE sliding | limits sliding | near stiction | false collisions "
        "(allowed per hour; 95 % interval of the rate) | latched | strong latched | delay, median and 95 %, ms"
    )
)


def line(bundle: dict) -> str:
    free, limits, latched = bundle["free_motion"], bundle["limits"], bundle["latched"]
    low, high = free["false_collisions_interval_per_hour"]
    promised = "none" if free["promised_per_hour"] is None else f"{free['promised_per_hour']:.3f}"
    delays = (latched["delay_against_sensor_median_s"], latched["delay_against_sensor_p95_s"])
    cells = [
        bundle["name"],
        *(joints(free[key]) for key in ("l1_nm", "rmse_near_stiction_nm", "rmse_sliding_nm")),
        *(joints(limits[key], 1) for key in ("sliding_nm", "near_stiction_nm")),
        f"{free['false_collisions']} ({promised}; {low:.2f} to {high:.2f})",
        f"{latched['latched']} of {latched['collisions']}",
        f"{latched['strong_latched']} of {latched['strong']}",
        ", ".join("-" if delay is None else f"{1e3 * delay:.1f}" for delay in delays),
    ]
    return table_row(*cells)


def joints(values: list[float | None], digits: int = 3) -> str:
    return "/".join("-" if value is None else f"{value:.{digits}f}" for value in values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--list", action="store_true", help="print the commands")
    parser.add_argument("--tables", action="store_true", help="print the tables of what is there")
    parser.add_argument("--keep-estimates", action="store_true", help="keep the estimates behind the figures")
    options = parser.parse_args()
    if options.list:
        print("\n".join(f"tauext {command}" for _, command in steps(options.out)))
        return
    if options.tables:
        print(tables(options.out))
        return
    write_settings(options.out)
    for made, command in steps(options.out):
        if made.exists():
            continue
        if made.parent.name == "learning":
            make_short(options.out)
        print(f"tauext {command}", flush=True)
        subprocess.run([sys.executable, "-m", "tauext", *shlex.split(command)], check=True)
        if made.name == "results.json" and not options.keep_estimates and made.parent.name not in EVERY_METHOD:
            shutil.rmtree(made.parent / "estimates", ignore_errors=True)


if __name__ == "__main__":
    main()
