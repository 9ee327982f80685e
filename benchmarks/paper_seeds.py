"""The paper's recipe with several seeds: how much its errors depend on the network's first weights and batches.

    python benchmarks/paper_seeds.py OUT [--cases exact none] [--seeds 1 2]

OUT/data is the dataset of `tauext reproduce --scale full`. A bundle that OUT holds already is not trained again. Rows
of seed 0 come from docs/results/full.
"""

from pathlib import Path

from common import ROOT, arguments, head, joined, table_row, tauext, write_page

from tauext.evaluate.results import EvaluatedBundle, load_results

FULL = ROOT / "docs/results/full"
PAPER_NM = {"exact": ((0.402, 0.262), (0.661, 0.369)), "none": ((0.409, 0.259), (0.683, 0.376))}
"""L1 and L2 of joints 1 and 2 in Table I of the paper, [N m]."""


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--cases", nargs="+", default=["exact", "none"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    options = parser.parse_args()
    out: Path = options.out
    data, bundles = out / "data", {}
    if not (data / "split.json").exists():
        tauext("simulate", "--minutes", 90, "--collision-recordings", 20, "--seed", 0, "--out", data)
    for seed in options.seeds:
        for case in options.cases:
            bundle = bundles[case, seed] = out / f"{case}-{seed}.tauext"
            if not bundle.exists():
                words = ("--recipe", "paper", "--case", case, "--seed", seed)
                tauext("train", "--data", data, *words, "--out", bundle, printed=out / f"{case}-{seed}.log")
    tauext("evaluate", "--data", data, "--out", out / "results", "--bundles", *bundles.values())
    kept = load_results(FULL).bundles
    rows = [(case, 0, one) for case in options.cases for one in kept if one.name == f"{case}-paper"]
    found = {one.name: one for one in load_results(out / "results").bundles}
    rows += [(case, seed, found[f"{case}-{seed}"]) for case, seed in bundles]
    write_page(FULL / "seeds.md", page(sorted(rows, key=lambda row: row[:2])))


def page(rows: list[tuple[str, int, EvaluatedBundle]]) -> list[str]:
    lines = head(
        "model | seed | L1, N m (paper) | L2, N m (paper) | MSE, N m² | near stiction, N m | sliding, N m"
        " | samples over a limit | collisions latched, of 200"
    )
    for case, seed, one in rows:
        free, paper = one.free_motion, PAPER_NM[case]
        lines.append(
            table_row(
                case,
                seed,
                f"{joined(free.l1_nm, '.3f', '/')} ({joined(paper[0], '.3f', '/')})",
                f"{joined(free.l2_nm, '.3f', '/')} ({joined(paper[1], '.3f', '/')})",
                joined(free.mse_nm2, ".3f", "/"),
                joined(free.rmse_near_stiction_nm, ".2f", "/"),
                joined(free.rmse_sliding_nm, ".2f", "/"),
                free.false_alarms,
                one.latched.latched,
            )
        )
    return lines


if __name__ == "__main__":
    main()
