"""The import stage: converts recordings of an arm in any format to a dataset folder in rad, rad/s and N m."""

from __future__ import annotations

import difflib
import math
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path

from tauext.data.assemble import assemble, constant_unknown, logged_joints
from tauext.data.dataset import SETS, Split, save_split, split_recordings
from tauext.data.description import Arm, load_arm
from tauext.data.free_motion import free_stretches, has_contact, length_s, within
from tauext.data.importers.open_raw import exporting, open_raw
from tauext.data.importers.raw import RawRecording, whole
from tauext.data.joint_names import expect_all_placed
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.resample import to_one_rate
from tauext.errors import ConfigError
from tauext.files.atomic_write import expect_empty, new_folder
from tauext.files.plain_file import read_text
from tauext.files.preflight import expect_folder
from tauext.files.provenance import provenance, write_json
from tauext.robot.capsules import write_shapes
from tauext.robot.mesh_files import MeshFolders, expect_meshes
from tauext.robot.read import load_tree, movable_joints, robot_sha256
from tauext.robot.write import Payload, write_placeholder, write_robot

# --- Sets of the stretches of a raw recording: listed in the description, or by a reported rule.


LEAST_S = 2.0
"""Least length of a set, and of a stretch between contacts, [s]: a window and the observer's warm-up must fit in."""


@dataclass(frozen=True)
class RawFacts:
    """Facts of a raw recording for the plan."""

    duration_s: float
    touched: bool
    """Whether a sample is in contact."""


@dataclass(frozen=True)
class Claim:
    """A stretch of a raw recording for one set, in seconds from its first sample; the end is exclusive."""

    set_name: str
    raw: str
    from_s: float = 0.0
    to_s: float = math.inf

    def __str__(self) -> str:
        if self.from_s == 0 and self.to_s == math.inf:
            return self.raw
        return f"{self.raw}[{self.from_s:.4g}:{'' if self.to_s == math.inf else f'{self.to_s:.4g}'}]"


def plan(
    arm: Arm, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]], whole_from: int = 6
) -> tuple[list[Claim], list[str]]:
    """Assign the raw recordings to sets; also returns sentences that name the rule.

    With [split], the sets are as listed. Else sources with contacts go to collisions; others are split whole (some for
    validation) or, where they are few, each by time with a gap. If all have contacts, each is split by time and its end
    goes to collisions.

    Args:
        raws: raw recordings, by name.
        files: names of the raw recordings in each file, by file name.
        whole_from: fewest sources without labelled contacts that are split whole.

    Raises:
        ConfigError: a listed source is missing, or a stretch is in two sets.
    """
    if arm.split.named:
        return _listed(arm, raws, files)
    touched = [name for name, facts in raws.items() if facts.touched]
    free = [name for name in raws if name not in touched]
    notes: list[str] = []
    claims = [Claim("collisions", name) for name in touched] if free else []
    if len(free) >= whole_from:
        split = split_recordings(free, seed=0, minimum=whole_from)
        claims += [Claim(one, name) for one in ("train", "validation", "test") for name in getattr(split, one)]
        notes.append(f"{len(free)} sources without labelled contacts, split as whole recordings")
    else:
        # No validation: the end of a run repeats the motion of its beginning, and `tauext train` does better by
        # cross-validation on all of it.
        shares = {"train": 0.8, "test": 0.2} if free else {"train": 0.75, "collisions": 0.25}
        spans = [(name, 0.0, raws[name].duration_s) for name in free or touched]
        parts, short = _by_time(arm, spans, shares)
        claims += parts
        listed = ", ".join(f"{set_name} {share:.0%}" for set_name, share in shares.items())
        sources = f"{len(spans)} source{'s' * (len(spans) > 1)}"
        kind = "without labelled contacts" if free else "with contacts, as all are"
        notes.append(
            f"{sources} {kind}: each split by time ({listed}) with a gap of {arm.split.gap_s:g} s between the parts; "
            "test and training come from one run, so errors on the test set are optimistic"
        )
        notes += [f"too short to be split by time, whole in train: {', '.join(short)}"] * bool(short)
    if not free:  # free parts of the collisions' stretch are held-out free motion
        claims += [Claim("test", c.raw, c.from_s, c.to_s) for c in claims if c.set_name == "collisions"]
    if free and touched:
        notes.append(f"{len(touched)} source{'s' * (len(touched) > 1)} with contacts: whole in collisions")
    return claims, notes


def _listed(
    arm: Arm, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]]
) -> tuple[list[Claim], list[str]]:
    claims = [
        Claim(set_name, name, from_s, to_s)
        for set_name in SETS
        for text in getattr(arm.split, set_name)
        for name, from_s, to_s in _parsed(arm, text, raws, files)
    ]
    notes = ["split as listed in [split]"]
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
        notes.append(f"in no set: {', '.join(unused)}")
    return claims, notes


def _parsed(
    arm: Arm, text: str, raws: Mapping[str, RawFacts], files: Mapping[str, Sequence[str]]
) -> list[tuple[str, float, float]]:
    """Parse NAME or NAME[t0:t1], either end optional; NAME is a file's, or a source's where a file has several."""
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
    if span[0] >= (longest_s := max(raws[one].duration_s for one in names)):
        raise ConfigError(f"{arm.path}: [split] '{text}' must begin before the end of '{name}', at {longest_s:.4g} s")
    return [(one, *span) for one in names]


def _by_time(
    arm: Arm, spans: Sequence[tuple[str, float, float]], shares: Mapping[str, float]
) -> tuple[list[Claim], list[str]]:
    """Cut each span into successive claims of these shares, with gaps that belong to no set.

    A span that would give a set of less than 2 s goes whole to the first set; their names are returned too.
    """
    gap_s, first = arm.split.gap_s, next(iter(shares))
    claims, short = [], []
    for name, from_s, to_s in spans:
        of_span, begin = [], from_s
        for k, (set_name, share) in enumerate(shares.items()):
            end = begin + share * (to_s - from_s)
            span = begin + (gap_s / 2 if k else 0), to_s if k == len(shares) - 1 else end - gap_s / 2
            of_span.append(Claim(set_name, name, *(round(at, 6) for at in span)))
            begin = end
        if min(c.to_s - c.from_s for c in of_span) < LEAST_S:
            short.append(name)
            of_span = [Claim(first, name, from_s, to_s)]
        claims += of_span
    if len(short) == len(spans):
        longest = max(to_s - from_s for _, from_s, to_s in spans)
        raise ConfigError(
            f"{', '.join(short)}: {longest:.1f} s are too short to be split by time into parts of at least {LEAST_S:g} "
            f"s with gaps of {gap_s:g} s; record more, lower gap_s, or list whole files in [split]"
        )
    return claims, short


# --- From raw recordings to a dataset folder's recordings and split, with one piece in memory at a time.


def recordings_of(
    raws: Sequence[RawRecording], arm: Arm, robot_sha256: str
) -> Iterator[tuple[RawRecording, Recording]]:
    """Convert all raw recordings, in order.

    Their nominal rate is the description's, else the first recording's where the stamps agree with it.

    Raises:
        ConfigError: two raw recordings share a name; a contact's recording is missing, or ends before the contact.
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
        with whole(raw.path, raw.format, ()):
            for recording in assemble(raw, arm, robot_sha256, rate_hz):
                rate_hz = recording.rate_hz
                end_s = recording.provenance["start_s"] + length_s(recording)
                yield raw, recording
        if [other.path for other in raws].count(raw.path) == 1:  # else it may belong to another one of the file
            expect_within(arm, raw, end_s)


def not_imported(arm: Arm, raws: Sequence[RawRecording]) -> list[str]:
    """Names in [contact.intervals] without a recording here."""
    known = {name for raw in raws for name in (raw.path.name, raw.name)}
    return [name for name in arm.contact.intervals if name not in known]


def expect_sources(arm: Arm, raws: Sequence[RawRecording]) -> None:
    """Raise ConfigError where contacts name a mistyped source: they would be trained on as free motion.

    A file of that name beside the sources or the description is another recording of the arm, not imported now.
    """
    folders = [arm.path.parent, *dict.fromkeys(raw.path.parent for raw in raws)]
    for name in not_imported(arm, raws):
        if not any((folder / name).exists() for folder in folders):
            files = dict.fromkeys(raw.path.name for raw in raws)
            near = difflib.get_close_matches(name, files, 1)
            meant = f"; did you mean '{near[0]}'?" if near else "; add the file to --source, or remove this entry"
            raise ConfigError(
                f"{arm.path}: [contact.intervals] '{name}' is none of the sources: {', '.join(files)}{meant}"
            )


def expect_within(arm: Arm, raw: RawRecording, end_s: float) -> None:
    """Raise ConfigError where a contact lies beyond the end of its recording."""
    for begin, end in arm.contact.intervals.get(raw.path.name, arm.contact.intervals.get(raw.name, ())):
        if begin < 0 or begin >= end_s or end > end_s + 1.0:  # it may be rounded up
            raise ConfigError(
                f"{arm.path}: [contact.intervals] '{raw.path.name}' = [{begin:g}, {end:g}] must lie within the "
                f"recording, 0 to {end_s:.6g} s after its first sample"
            )


def write_dataset(
    raws: Sequence[RawRecording], arm: Arm, robot_sha256: str, folder: Path, report: Callable[[Recording], object]
) -> list[str]:
    """Write recordings and split.json, and return sentences about the rule of the split and empty sets.

    Contacts are cut out of every set but collisions.

    Args:
        folder: exists.
        report: called with each imported recording before it is cut.

    Raises:
        ConfigError, RecordingError: see assemble() and plan().
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
    unit = "A" if constant_unknown(arm) else "Nm"
    resampled = to_one_rate([path for paths in pieces.values() for path in paths], unit)
    for raw in raws:
        files.setdefault(raw.path.name, []).append(raw.name)
    facts = {name: RawFacts(duration[name], touched[name]) for name in pieces}
    claims, notes = plan(arm, facts, files)
    notes[:0] = [resampled] * bool(resampled)
    written: dict[str, list[str]] = {set_name: [] for set_name in SETS}
    for name, paths in pieces.items():
        for path in paths:
            _cut(path, [c for c in claims if c.raw == name], arm, written)
    notes += [f"{set_name}: {', '.join(names)}" for set_name, names in written.items() if names]
    if written["train"] and not written["validation"]:
        notes.append("validation is empty: train finds thresholds by cross-validation on the training motion")
    for set_name in ("train", "test"):
        if not written[set_name]:
            claimed = any(c.set_name == set_name for c in claims)
            why = f"no stretch of {LEAST_S:g} s between contacts" if claimed else "no source"
            notes.append(f"{set_name} is empty ({why}): this dataset suits uses without a {set_name} set")
    save_split(Split(**{set_name: tuple(names) for set_name, names in written.items()}), folder)
    return notes


def _cut(path: Path, claims: list[Claim], arm: Arm, written: dict[str, list[str]]) -> None:
    """Write the claimed stretches of one piece; a piece claimed whole, or not at all, is kept."""
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
            whole = free_stretches(stretch, arm.contact.before_s, arm.contact.after_s, LEAST_S)
        for recording in whole:
            recording = _renamed(recording, {name for names in written.values() for name in names})
            used += recording.name == piece.name
            if recording.name != piece.name:
                save_recording(recording, path.with_name(f"{recording.name}.parquet"))
            written[claim.set_name].append(f"{recording.name}.parquet")
    if not used:
        path.unlink()


def _renamed(recording: Recording, taken: Collection[str]) -> Recording:
    """Rename to a free name: one raw recording may give a set several stretches."""
    numbered = (f"{recording.name}-{number}" for number in count(2))
    free = next(name for name in chain((recording.name,), numbered) if f"{name}.parquet" not in taken)
    return recording if free == recording.name else replace(recording, name=free)


# --- The import stage.


def import_dataset(
    paths: Sequence[Path],
    arm_file: Path,
    out: Path,
    format: str,
    say: Callable[[str], object],
    meshes: MeshFolders = MeshFolders(),
) -> None:
    """Import all sources into a folder, written atomically.

    Args:
        paths: files or folders of one arm.
        arm_file: their description, arm.toml.
        out: folder to write, which must be empty or missing.
        format: tauext, or the name of an importer that also writes, such as lerobot.
        say: called with a line for each change of the numbers.
        meshes: folders of the robot file's meshes, which are searched first.

    Raises:
        ConfigError: the description or a folder cannot be used.
        RecordingError: a source is damaged or of an unsupported format.
        RobotError: the robot file cannot be used.
    """
    started = time.monotonic()
    export = None if format == "tauext" else exporting(format)
    arm = load_arm(arm_file)
    expect_empty(out)
    expect_folder(out)
    sources = [source for path in paths for source in open_raw(path, arm.topics)]
    expect_sources(arm, sources)
    for name in not_imported(arm, sources):
        say(f"contacts of {name} are not used: it is not among the sources")
    movable: list[str] = []
    if arm.model is None and meshes:
        raise ConfigError(f"--meshes: {arm.path} names no robot file (model), so no mesh is read; leave --meshes out")
    if arm.model is not None:
        movable = movable_joints(arm.model)
        expect_meshes(arm.model, meshes)
        load_tree(arm.model, joints=arm.robot.joints)  # fails before a long import
    left_out: dict[str, None] = {}
    for source in {source.path: source for source in reversed(sources)}.values():
        placed = dict(zip(arm.robot.joints, arm.names, strict=True))
        logged = logged_joints(arm, source)
        line = expect_all_placed(arm.path, movable, logged, placed, arm.robot.locked, arm.robot.ignored)
        left_out[line] = None
    for line in filter(None, left_out):
        say(line)
    with new_folder(out) as part:
        if export is not None:
            if arm.split.named:
                say(f"[split] is not used: a dataset of format {format} has no sets")
            recordings = (_reported(recording, say) for recording in _of_one_rate(recordings_of(sources, arm, "")))
            say(f"{export(recordings, part)} episodes")
        else:
            robot = _robot_file(arm, part, say, meshes)
            for line in write_dataset(sources, arm, robot_sha256(robot), part, lambda one: _reported(one, say)):
                say(line)
        settings = {"arm": read_text(arm_file), "sources": [path.name for path in paths], "format": format}
        write_json(provenance("tauext import", settings, None), part / "run.json")
        write_json({"import_s": round(time.monotonic() - started, 3)}, part / "wall_time_s.json")


def _of_one_rate(recordings: Iterable[tuple[RawRecording, Recording]]) -> Iterator[Recording]:
    """The recordings; ConfigError where their rates differ."""
    first: Recording | None = None
    for _, recording in recordings:
        first = first or recording
        if recording.rate_hz != first.rate_hz:
            raise ConfigError(
                f"{recording.name} has {recording.rate_hz:g} Hz, {first.name} {first.rate_hz:g} Hz; a dataset of this "
                "format has one rate: import each rate alone"
            )
        yield recording


def _robot_file(arm: Arm, out: Path, say: Callable[[str], object], meshes: MeshFolders) -> Path:
    """Write and report the dataset's robot file: the arm's with the description's additions, or a placeholder."""
    if arm.model is None:
        say("robot: no model; robot.urdf is a placeholder without masses, and train uses the case none")
        return write_placeholder(arm.robot.joints, out)
    inertia = arm.robot.rotor_inertia_kg_m2
    rotors = dict(zip(arm.robot.joints, zip(inertia, arm.gear_ratio, strict=True), strict=True)) if inertia else {}
    carried = arm.payload
    payload = Payload(carried.link, carried.mass_kg, carried.com_m, carried.inertia_kg_m2) if carried.mass_kg else None
    path = write_robot(arm.model, out, rotors, payload, arm.robot.gravity_m_s2 or None)
    tree = load_tree(path, joints=arm.robot.joints)
    say(f"robot: {arm.model.name} with {tree.size} joints: {', '.join(arm.robot.joints)}")
    shapes = write_shapes(arm.model, out, meshes)
    for package, folder in shapes.packages.items():
        say(f"  meshes of {package} from {folder}")
    for line in shapes.notes:
        say(f"  {line}; places of touches there follow from guessed shapes")
    if payload:
        say(f"  payload of {payload.mass_kg:g} kg at {payload.link}")
    if rotors:
        say(f"  rotor inertia at the joint, kg m^2: {', '.join(f'{link.rotor_inertia:.4g}' for link in tree.links)}")
    if arm.robot.gravity_m_s2:
        say(f"  gravity {', '.join(f'{g:g}' for g in tree.gravity)} m/s^2")
    return path


def _reported(recording: Recording, say: Callable[[str], object]) -> Recording:
    """Report the recording and its changes, a line each, and return it."""
    joints = len(recording.joints)
    head = f"{recording.name}: {recording.duration_s:.2f} s, {recording.rate_hz:g} Hz, {joints} joints, "
    head += f"{recording.samples} samples from {recording.source}"
    say("\n".join([head, *(f"  {line}" for line in recording.provenance["done"])]))
    return recording
