"""Reads what force on a link a bundle notices."""

from __future__ import annotations

from tauext.report.entry import Entry
from tauext.report.noticed import WAYS, Noticed, NoticedAt, OverPoses


def read_noticed(entry: Entry) -> Noticed | None:
    """Entry `noticed_force` of a bundle; None where the evaluation had none."""
    if not entry.content:
        return None
    if refused := entry.text("refused"):
        return Noticed(refused=refused)
    limits = entry.object("limits")
    return Noticed(
        poses=entry.get("poses", int, needed=True),
        limits={name: tuple(read_place(one) for one in limits.entries(name)) for name in limits.content},
        left_out=entry.texts("left_out"),
        **entry.each_number("gain_per_s", "error_share"),
    )


def read_place(entry: Entry) -> NoticedAt:
    every = entry.object("every_way")
    return NoticedAt(
        place=entry.text("place", needed=True),
        every_median_n=every.number("median_n"),
        nine_of_ten_n=every.number("nine_of_ten_n"),
        ways={way: read_over_poses(entry.object(way)) for way in WAYS},
    )


def read_over_poses(entry: Entry) -> OverPoses:
    return OverPoses(**entry.each_number("median_n", "worst_n"), blind_share=entry.number("blind_share", needed=True))
