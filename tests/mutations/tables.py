"""Results of the mutations by dataset and kind, and the missed ones."""

from __future__ import annotations

from collections.abc import Sequence

VERDICTS = ("refused", "named", "harmless", "missed", "traceback")


def markdown(rows: Sequence[dict], good: Sequence[dict], command: str) -> str:
    """The text of README.md."""
    datasets = list(dict.fromkeys(row["dataset"].removesuffix("-labels") for row in rows))
    kinds = list(dict.fromkeys(row["kind"] for row in sorted(rows, key=lambda row: row["kind"])))
    lines = [
        "# Mistakes in training data",
        "",
        f"Written by `{command}`.",
        "",
        "Refused: `check` reports a fault or an error that the clean dataset does not have. Named: it reports a",
        "warning with a fitting code. Harmless: the data are trained on; limits and contacts found are within 5 % of",
        "the clean bundle's. Missed: all others.",
        "",
        f"| dataset | kind | cases | {' | '.join(VERDICTS)} |",
        f"|---|---|---|{'---|' * len(VERDICTS)}",
    ]
    for dataset in datasets:
        of = [row for row in rows if row["dataset"].removesuffix("-labels") == dataset]
        lines += [_line(dataset, kind, [row for row in of if row["kind"] == kind]) for kind in kinds]
        lines.append(_line(f"**{dataset}**", "", of))
    lines += [_line("**all**", kind, [row for row in rows if row["kind"] == kind]) for kind in kinds]
    lines.append(_line("**all**", "**all**", rows))
    lines += ["", f"Missed: {_share(rows, 'missed')}.", *_others(rows), "", *_good(good), "", *_missed(rows)]
    return "\n".join([*lines, ""])


def _line(dataset: str, kind: str, rows: Sequence[dict]) -> str:
    counts = [str(sum(row["verdict"] == verdict for row in rows)) for verdict in VERDICTS]
    return f"| {dataset} | {kind} | {len(rows)} | {' | '.join(counts)} |"


def _share(rows: Sequence[dict], verdict: str) -> str:
    count = sum(row["verdict"] == verdict for row in rows)
    return f"{count} of {len(rows)}, {count / max(1, len(rows)):.1%}"


def _others(rows: Sequence[dict]) -> list[str]:
    """Refusals for another reason than the mutation's own."""
    other = [row for row in rows if row["verdict"] == "refused" and not row["fits"]]
    return [f"Refused with a code that does not fit: {len(other)}."] if other else []


def _good(good: Sequence[dict]) -> list[str]:
    false = [one for one in good if one["faults"] or one["error"]]
    lines = [f"False refusals on good data: {len(false)} of {len(good)} datasets."]
    return lines + [f"- {one['name']}: {one['error'] or '; '.join(one['faults'])}" for one in false]


def _missed(rows: Sequence[dict]) -> list[str]:
    lines = [
        "## Missed",
        "",
        "| case | largest change of a limit | contacts found | other findings |",
        "|---|---|---|---|",
    ]
    for row in sorted((row for row in rows if row["verdict"] in ("missed", "traceback")), key=lambda row: row["id"]):
        off = "" if row["limit_off"] is None else f"{row['limit_off']:.0%}"
        found = "" if row["found"] is None else f"{row['found']} of {row['events']} (clean {row['found_clean']})"
        seen = (
            ", ".join(f"{one['code']} ({one['joint']})" for one in row["findings"])
            or (row["error"] or "").strip().rpartition("\n")[2]
        )
        lines.append(f"| {row['id']} | {off} | {found} | {seen} |")
    return lines
