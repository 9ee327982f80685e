"""Which columns of a raw recording each signal takes, joint by joint."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tauext.data.description import Arm
from tauext.data.importers.raw import RawRecording, short_list
from tauext.errors import ConfigError


@dataclass(frozen=True)
class Columns:
    """Names of the columns to read of every stream, and the place of each signal among them."""

    streams: dict[str, tuple[str, ...]]
    signals: dict[str, tuple[str, list[int]]]
    """Signal, `contact` or `time`: its stream, and its columns' places in that stream's list."""


def find_columns(arm: Arm, raw: RawRecording) -> Columns:
    """Resolve every column that the description names; joints come in its order, by name where the file names them.

    A signal's one name may be a column pattern with {joint} (name in the recording), {index} (from 0) or {number} (from
    1), or an array, whose elements are taken by joint name, or by index where it has as many as there are joints.

    Raises:
        ConfigError: a column or topic that is not there; the message names what is near.
    """
    there = raw.streams()
    wanted: dict[str, dict[str, None]] = {}
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    for name, signal in arm.signals.items():
        if signal.columns:
            stream = _stream(arm, raw, there, signal.topic, f"signals.{name}")
            found[name] = (stream, _resolved(arm, raw, f"signals.{name}", signal.columns, there[stream]))
    if arm.contact.column:
        stream = _stream(arm, raw, there, arm.contact.topic, "contact")
        found["contact"] = (stream, _exact(arm, raw, "contact", (arm.contact.column,), there[stream]))
    if arm.time.column:
        for stream in dict.fromkeys(stream for stream, _ in found.values()):
            found["time"] = (stream, _exact(arm, raw, "time", (arm.time.column,), there[stream]))
    for stream, names in found.values():
        wanted.setdefault(stream, {}).update(dict.fromkeys(names))
    streams = {stream: tuple(names) for stream, names in wanted.items()}
    places = {name: (stream, [streams[stream].index(n) for n in names]) for name, (stream, names) in found.items()}
    return Columns(streams, places)


def _stream(arm: Arm, raw: RawRecording, there: Mapping[str, Sequence[str]], topic: str, table: str) -> str:
    if topic in there:
        return topic
    if topic:
        raise ConfigError(f"{arm.path}: [{table}] topic = '{topic}' has no messages in {raw.path.name}")
    if not there:
        raise ConfigError(f"{raw.path.name}: it holds no messages to read [{table}] from")
    if len(there) > 1:
        listed = ", ".join(sorted(there))
        raise ConfigError(f"{arm.path}: [{table}] topic must be named, since several are read: {listed}")
    return next(iter(there))


def _resolved(
    arm: Arm, raw: RawRecording, table: str, columns: tuple[str, ...], there: Sequence[str]
) -> tuple[str, ...]:
    if len(columns) > 1:
        return _exact(arm, raw, table, columns, there)
    (one,) = columns
    if any(f"{{{key}}}" in one for key in ("joint", "index", "number")):
        spelled = [
            one.replace("{joint}", name).replace("{index}", str(k)).replace("{number}", str(k + 1))
            for k, name in enumerate(arm.names)
        ]
        return _exact(arm, raw, table, tuple(spelled), there)
    by_name = tuple(f"{one}[{name}]" for name in arm.names)
    if all(name in there for name in by_name):
        return by_name
    elements = [name for name in there if name.startswith(f"{one}[")]
    by_index = tuple(f"{one}[{k}]" for k in range(len(arm.names)))
    if elements and set(elements) == set(by_index):
        return by_index
    if elements:
        held = [name.removeprefix(f"{one}[").removesuffix("]") for name in elements]
        raise ConfigError(
            f"{arm.path}: [{table}] columns = '{one}': in {raw.path.name} its elements are {short_list(held, 16)}; "
            f'[robot] names (or joints) are {", ".join(arm.names)}: name them as the recording does, or by "{one}'
            '[{index}]"'
        )
    if len(arm.names) == 1 and one in there:
        return (one,)
    raise _missing(arm, raw, table, one, there)


def _exact(arm: Arm, raw: RawRecording, table: str, names: tuple[str, ...], there: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in there:
            raise _missing(arm, raw, table, name, there)
    return names


def _missing(arm: Arm, raw: RawRecording, table: str, name: str, there: Sequence[str]) -> ConfigError:
    bases = list(dict.fromkeys(column.split("[")[0] for column in there))
    near = difflib.get_close_matches(name, dict.fromkeys([*there, *bases]), 3, 0.3)
    hint = f"near to it: {', '.join(near)}; " if near else ""
    left_out = "".join(f"; {note}" for note in raw.notes)  # an array of another length is not in it
    derive = '; columns = "" derives the velocity from the position' if table == "signals.dq" else ""
    held = f"it holds {short_list(bases, 20)}{left_out}{derive}"
    return ConfigError(f"{arm.path}: [{table}] '{name}' is not in {raw.path.name}; {hint}{held}")
