"""Which stretch of which raw recording serves for what: as the description lists it, or by rule and said so."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tauext.data.description import Arm
from tauext.data.split import SETS, split_recordings
from tauext.errors import ConfigError

WHOLE_FROM = 6
"""So many sources without contact or more are split as whole recordings; fewer are cut by time."""
WHOLE_SETS = ("train", "validation", "test")
FREE_SHARES = {"train": 0.8, "test": 0.2}
TOUCHED_SHARES = {"train": 0.75, "collisions": 0.25}
"""Of each source that is cut by time. None is for validation: the end of a run shows the same motion as its beginning,
and `tauext train` does better with all of it, which it leaves out in turn."""
LEAST_SET_S = 2.0
"""A window and the observer's warm-up must fit into a set, [s]."""


@dataclass(frozen=True)
class RawFacts:
    """What a plan needs to know of a raw recording."""

    duration_s: float
    touched: bool
    """Whether a sample is in contact."""


@dataclass(frozen=True)
class Claim:
    """A stretch of a raw recording for one set, seconds from its first sample; its end is left out."""

    set_name: str
    raw: str
    from_s: float = 0.0
    to_s: float = math.inf

    def __str__(self) -> str:
        if self.from_s == 0 and self.to_s == math.inf:
            return self.raw
        return f"{self.raw}[{self.from_s:.4g}:{'' if self.to_s == math.inf else f'{self.to_s:.4g}'}]"


def plan(arm: Arm, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]]) -> tuple[list[Claim], list[str]]:
    """Claims on the raw recordings, and sentences that say by which rule.

    Listed in [split]: as listed. Not listed: those with contacts are for collisions, others are split whole
    (from 6 on, some for validation) or each by time with a gap; where every one has contacts, each is split by time
    and its end kept whole for collisions.

    Args:
        raws: raw recordings, by name.
        files: file name: names of the raw recordings in it.

    Raises:
        ConfigError: a listed one that is not there, or one stretch in two sets.
    """
    if arm.split.named:
        return _listed(arm, raws, files)
    touched = [name for name, facts in raws.items() if facts.touched]
    free = [name for name in raws if name not in touched]
    gap_s = arm.split.gap_s
    said: list[str] = []
    short: list[str] = []
    claims = [Claim("collisions", name) for name in touched] if free else []
    if len(free) >= WHOLE_FROM:
        split = split_recordings(free, seed=0, minimum=WHOLE_FROM)
        claims += [Claim(set_name, name) for set_name in WHOLE_SETS for name in getattr(split, set_name)]
        said.append(f"{len(free)} sources without contact, split as whole recordings")
    else:
        shares = FREE_SHARES if free else TOUCHED_SHARES
        spans = [(name, 0.0, raws[name].duration_s) for name in free or touched]
        claims += _by_time(arm, spans, shares, short)
        listed = ", ".join(f"{set_name} {share:.0%}" for set_name, share in shares.items())
        count = f"{len(spans)} source{'s' * (len(spans) > 1)}"
        kind = "without contact" if free else "with contacts, as all are"
        said.append(
            f"{count} {kind}: each split by time ({listed}) with a gap of {gap_s:g} s between the parts; test and "
            "training come from one run, so errors on the test set flatter"
        )
        said += short
    if not free:  # what is free in the collisions' stretch is free motion that nobody trained on
        claims += [Claim("test", c.raw, c.from_s, c.to_s) for c in claims if c.set_name == "collisions"]
    if free and touched:
        said.append(f"{len(touched)} source{'s' * (len(touched) > 1)} with contacts: whole in collisions")
    return claims, said


def _listed(
    arm: Arm, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]]
) -> tuple[list[Claim], list[str]]:
    claims = [
        Claim(set_name, name, from_s, to_s)
        for set_name in SETS
        for text in getattr(arm.split, set_name)
        for name, from_s, to_s in _parsed(arm, text, raws, files)
    ]
    said = ["split as listed in [split]"]
    for k, one in enumerate(claims):
        for other in claims[k + 1 :]:
            apart = {one.set_name, other.set_name} == {"test", "collisions"} or one.raw != other.raw
            if not apart and one.from_s < other.to_s and other.from_s < one.to_s:
                raise ConfigError(
                    f"{arm.path}: [split] {one.set_name}, {other.set_name} share a stretch of {one.raw} "
                    f"({one}, {other}); a stretch belongs to one set (test and collisions may share one)"
                )
    unused = [name for name in raws if name not in {c.raw for c in claims}]
    if unused:
        said.append(f"in no set: {', '.join(unused)}")
    return claims, said


def _parsed(
    arm: Arm, text: str, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]]
) -> list[tuple[str, float, float]]:
    """NAME or NAME[t0:t1], either end left out; NAME is a file's, or a source's where a file holds several."""
    match = re.fullmatch(r"(.*?)(?:\[([0-9.]*):([0-9.]*)\])?", text)
    assert match
    name, first, last = match.groups()
    names = files.get(name, [name] if name in raws else [])
    if not names:
        raise ConfigError(f"{arm.path}: [split] '{name}' is none of the sources: {', '.join(files)}")
    try:
        span = float(first or 0), float(last or math.inf)
    except ValueError as error:
        raise ConfigError(f"{arm.path}: [split] '{text}' must be NAME or NAME[t0:t1], in seconds") from error
    if not span[0] < span[1]:
        raise ConfigError(f"{arm.path}: [split] '{text}': its end must come after its beginning")
    return [(one, *span) for one in names]


def _by_time(
    arm: Arm, spans: Sequence[tuple[str, float, float]], shares: Mapping[str, float], said: list[str]
) -> list[Claim]:
    """Successive claims of these shares on each span, with gaps that lie in no set.

    A span that would leave a set of less than 2 s serves whole for the first set, and that is said.

    Raises:
        ConfigError: all spans are so short.
    """
    gap_s = arm.split.gap_s
    claims, short = [], []
    for name, from_s, to_s in spans:
        of_span, begin = [], from_s
        for k, (set_name, share) in enumerate(shares.items()):
            end = begin + share * (to_s - from_s)
            last = k == len(shares) - 1
            span = begin + (gap_s / 2 if k else 0), to_s if last else end - gap_s / 2
            of_span.append(Claim(set_name, name, *(round(at, 6) for at in span)))
            begin = end
        if min(c.to_s - c.from_s for c in of_span) < LEAST_SET_S:
            short.append(name)
            of_span = [Claim(next(iter(shares)), name, from_s, to_s)]
        claims += of_span
    if len(short) == len(spans):
        longest = max(to_s - from_s for _, from_s, to_s in spans)
        raise ConfigError(
            f"{', '.join(short)}: {longest:.1f} s are too short to be split by time into parts of at least "
            f"{LEAST_SET_S:g} s with gaps of {gap_s:g} s; record more, lower gap_s, or list whole files in [split]"
        )
    if short:
        said.append(f"too short to be split by time, whole in {next(iter(shares))}: {', '.join(short)}")
    return claims
