"""From raw recordings to the recordings and the split of a dataset folder, a piece in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from tauext.data.assemble import assemble
from tauext.data.cut import within
from tauext.data.dataset_plan import Claim, RawFacts, plan
from tauext.data.description import Arm
from tauext.data.first_seconds import length_s
from tauext.data.free_motion import free_stretches, has_contact
from tauext.data.importers.raw import RawRecording
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.split import SETS, Split, save_split
from tauext.errors import ConfigError

LEAST_FREE_S = 2.0
"""A shorter stretch between contacts is left out, [s]: a window and the observer's warm-up would not fit."""

ROUNDED_S = 1.0
"""An interval may end so much after its recording, [s]: whoever marks its end rounds up."""


@dataclass
class Imported:
    """What an import found and wrote."""

    split: Split
    said: list[str] = field(default_factory=list)
    """How the split came about, and what it lacks."""


def recordings_of(
    raws: Sequence[RawRecording], arm: Arm, robot_sha256: str
) -> Iterator[tuple[RawRecording, Recording]]:
    """Recordings of all raw ones, in their order and at one nominal rate: the description's, or the first one's.

    Raises:
        ConfigError: two raw recordings of one name; a contact in a recording that is not there, or beyond its end.
    """
    names = [raw.name for raw in raws]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"{names.count(name)} sources are named '{name}'; rename their files so that names differ"
            )
    expect_sources(arm, raws)
    rate_hz = arm.time.rate_hz
    for raw in raws:
        end_s = 0.0
        for recording in assemble(raw, arm, robot_sha256, rate_hz):
            rate_hz = recording.rate_hz
            end_s = recording.provenance["start_s"] + length_s(recording)
            yield raw, recording
        if [other.path for other in raws].count(raw.path) == 1:  # else an interval may be another one's of the file
            expect_within(arm, raw, end_s)


def expect_sources(arm: Arm, raws: Sequence[RawRecording]) -> None:
    """Raise ConfigError where contacts are given of what is no source: they would be trained on as free motion."""
    known = dict.fromkeys(name for raw in raws for name in (raw.path.name, raw.name))
    for name in arm.contact.intervals:
        if name not in known:
            files = dict.fromkeys(raw.path.name for raw in raws)
            raise ConfigError(f"{arm.path}: [contact.intervals] '{name}' is none of the sources: {', '.join(files)}")


def expect_within(arm: Arm, raw: RawRecording, end_s: float) -> None:
    """Raise ConfigError where a contact lies beyond the end of its recording: it was meant elsewhere."""
    for begin, end in arm.contact.intervals.get(raw.path.name, arm.contact.intervals.get(raw.name, ())):
        if begin < 0 or begin >= end_s or end > end_s + ROUNDED_S:
            raise ConfigError(
                f"{arm.path}: [contact.intervals] '{raw.path.name}' = [{begin:g}, {end:g}] must lie within the "
                f"recording, 0 to {end_s:.6g} s after its first sample"
            )


def write_dataset(
    raws: Sequence[RawRecording], arm: Arm, robot_sha256: str, folder: Path, report: Callable[[Recording], object]
) -> Imported:
    """Write recordings and split.json; contacts are cut out of every set but collisions.

    Args:
        folder: exists.
        report: called with each recording as it was imported, before it is cut.

    Raises:
        ConfigError, RecordingError: as assemble and plan.
    """
    pieces: dict[str, list[Path]] = {raw.name: [] for raw in raws}
    files: dict[str, list[str]] = {}
    duration, touched = dict.fromkeys(pieces, 0.0), dict.fromkeys(pieces, False)
    for raw, recording in recordings_of(raws, arm, robot_sha256):
        path = folder / f"{recording.name}.parquet"
        save_recording(recording, path)
        report(recording)
        pieces[raw.name].append(path)
        duration[raw.name] = recording.provenance["start_s"] + length_s(recording)
        touched[raw.name] |= has_contact(recording)
    for raw in raws:
        files.setdefault(raw.path.name, []).append(raw.name)
    facts = {name: RawFacts(duration[name], touched[name]) for name in pieces}
    claims, said = plan(arm, facts, files)
    written: dict[str, list[str]] = {set_name: [] for set_name in SETS}
    for name, paths in pieces.items():
        for path in paths:
            _cut(path, [c for c in claims if c.raw == name], arm, written)
    said += [f"{set_name}: {', '.join(names)}" for set_name, names in written.items() if names]
    if written["train"] and not written["validation"]:
        said.append("validation is empty: train finds limits on training motion that it leaves out of the fit in turn")
    for set_name in ("train", "test"):
        if not written[set_name]:
            why = (
                f"no stretch of {LEAST_FREE_S:g} s between contacts"
                if any(c.set_name == set_name for c in claims)
                else "no source"
            )
            said.append(f"{set_name} is empty ({why}): this dataset serves where no {set_name} set is needed")
    split = Split(**{set_name: tuple(names) for set_name, names in written.items()})
    save_split(split, folder)
    return Imported(split, said)


def _cut(path: Path, claims: list[Claim], arm: Arm, written: dict[str, list[str]]) -> None:
    """Write the claimed stretches of one piece; the piece itself stays where it is claimed whole, or by nobody."""
    if not claims:
        return
    piece = load_recording(path)
    used = 0
    for claim in claims:
        suffix = "" if sum(c.raw == claim.raw for c in claims) == 1 else f"-{claim.set_name}"
        stretch = within(piece, claim.from_s, claim.to_s, f"{piece.name}{suffix or '-set_name'}")
        if stretch is None:
            continue
        whole = [stretch]
        if claim.set_name != "collisions" and arm.contact.cut:
            whole = free_stretches(stretch, arm.contact.before_s, arm.contact.after_s, LEAST_FREE_S)
        for recording in whole:
            if f"{recording.name}.parquet" in (name for names in written.values() for name in names):
                recording = _renamed(recording, written)
            used += recording.name == piece.name
            if recording.name != piece.name:
                save_recording(recording, path.with_name(f"{recording.name}.parquet"))
            written[claim.set_name].append(f"{recording.name}.parquet")
    if not used:
        path.unlink()


def _renamed(recording: Recording, written: dict[str, list[str]]) -> Recording:
    """Under a name that is not taken: one raw recording may give a set several stretches."""
    taken = {name for names in written.values() for name in names}
    number = 2
    while f"{recording.name}-{number}.parquet" in taken:
        number += 1
    return replace(recording, name=f"{recording.name}-{number}")
