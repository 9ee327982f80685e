"""Ways to damage a file: its bytes, and what its format means."""

from __future__ import annotations

import binascii
import json
import re
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat

NESTED = 20_000
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2**70, 1e308, -1e308, float("nan"), float("inf"), "", "x", "x" * 9999, [], {},
)  # fmt: skip
VALUES += ([[]], [None], {"": 0}, "\ud800", [1e308] * 50, "../../etc/passwd", 0.5, "nan", ["joint1", 1], 3)
TOKENS = ("inf", "nan", "-1", "0", "1e308", '""', '"x"', "[]", "{}", "true", '["a", 1]', "[[]]", "9" * 30, "1979-05-27")
TOKENS += (
    '"\\uFFFF"', '"../.."', '"/dev/zero"', "'''", "[nan, inf]", '["joint1", "joint1"]', "[1, 2, 3]", "[-1, 0]", "",
)  # fmt: skip
XML = (
    "", "nan", "inf", "-1", "0", "1e308", "x", "0 0 0", "0 0", "1 2 3 4 5 6 7", "joint1", "-1e-300", "a" * 5000,
    "1e-320",
)  # fmt: skip


def damage(path: Path, rng: np.random.Generator) -> str:
    """Damage a file in one way, its own format's or that of any bytes; says which."""
    own = BY_ENDING.get(path.suffix)
    way = own if own is not None and rng.random() < 0.65 else damage_bytes
    try:
        return way(path, rng)
    except (ValueError, KeyError, TypeError, OverflowError, pa.ArrowException, RecursionError) as error:
        return f"{damage_bytes(path, rng)} (instead of {way.__name__}: {type(error).__name__})"


def damage_bytes(path: Path, rng: np.random.Generator) -> str:
    """Truncated, flipped, overwritten, doubled, emptied, made of noise."""
    raw = bytearray(path.read_bytes())
    size = len(raw)
    way = str(rng.choice(["cut", "flip", "zero", "noise", "empty", "random", "append", "double", "head", "ones"]))
    a, b = sorted(rng.integers(0, max(1, size), 2).tolist())
    b = min(b, a + int(rng.choice([1, 8, 64, 4096])))
    if way == "cut":
        raw = raw[:a]
    elif way == "flip":
        for k in rng.integers(0, max(1, size), int(rng.choice([1, 4, 64]))).tolist() if size else ():
            raw[k] ^= 1 << int(rng.integers(8))
    elif way in ("zero", "noise", "ones"):
        raw[a:b] = {"zero": bytes(b - a), "ones": b"\xff" * (b - a), "noise": rng.bytes(b - a)}[way]
    elif way == "head":
        raw[: min(size, 64)] = rng.bytes(min(size, 64))
    elif way == "double":
        raw[a:a] = raw[a:b]
    elif way == "append":
        raw += rng.bytes(int(rng.choice([1, 100, 10_000])))
    else:
        raw = bytearray(rng.bytes(1000)) if way == "random" else bytearray()
    path.write_bytes(raw)
    return f"{way} at {a} to {b} of {size} bytes"


def pick(choices: Any, rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(len(choices)))]


def damage_json(path: Path, rng: np.random.Generator) -> str:
    """A value, a key or the nesting."""
    if rng.random() < 0.04:
        path.write_text("[" * NESTED + "]" * NESTED)
        return "nested deeply"
    content = json.loads(path.read_text())
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in list(items):
            places.append((node, key))
            walk(value)

    walk(content)
    # Entries near the top as often as one of a long list.
    node, key = pick(places[:40] if rng.random() < 0.5 else places, rng)
    way = pick(("value", "value", "value", "remove", "rename", "nest"), rng)
    what = f"{way} of {key!r}"
    if way == "remove":
        del node[key]
    elif way == "rename" and isinstance(node, dict):
        node["x" * int(rng.integers(3))] = node.pop(key)
    elif way == "nest":
        node[key] = {"": [node[key]]}
    else:
        node[key] = pick(VALUES, rng)
        what += f": {str(node[key])[:40]!r}"
    path.write_text(json.dumps(content))
    return what


def damage_toml(path: Path, rng: np.random.Generator) -> str:
    """A value, a line or the nesting."""
    if rng.random() < 0.04:
        path.write_text("x = " + "[" * NESTED + "]" * NESTED)
        return "nested deeply"
    lines = path.read_text().splitlines()
    settings = [k for k, line in enumerate(lines) if re.match(r"\s*[\w.\"]+\s*=", line)]
    k, way = pick(settings, rng), pick(("value", "value", "value", "value", "remove", "twice", "key"), rng)
    if way == "value":
        lines[k] = lines[k].split("=")[0] + "= " + pick(TOKENS, rng)
    elif way == "key":
        lines[k] = "x" + lines[k]
    elif way == "twice":
        lines.insert(k, pick(lines, rng))
    else:
        del lines[k]
    path.write_text("\n".join(lines))
    return f"{way} of line {k + 1}: {lines[min(k, len(lines) - 1)][:60]!r}"


def damage_xml(path: Path, rng: np.random.Generator) -> str:
    """An attribute, an element, the nesting or what is included."""
    text = path.read_text()
    way = pick(("attribute", "attribute", "attribute", "attribute", "remove", "twice", "chain", "include", "tag"), rng)
    attributes = list(re.finditer(r'(\w+)="([^"]*)"', text))
    elements = list(re.finditer(r"<(\w+)[^<>]*/>", text))
    told = ""
    if way == "attribute":
        for one in [pick(attributes, rng) for _ in range(int(rng.integers(1, 3)))][:1]:
            told = f"{one[1]}={pick(XML, rng)[:30]}"
            name, value = told.split("=")
            text = f'{text[: one.start()]}{name}="{value}"{text[one.end() :]}'
    elif way in ("remove", "twice"):
        one = pick(elements, rng)
        text = text[: one.start()] + (one[0] * 2 if way == "twice" else "") + text[one.end() :]
        told = one[0][:40]
    elif way == "chain":
        links = int(rng.choice([33, 200, 10_000]))
        text, told = chain(links, text.startswith("<robot")), f"{links} links"
    elif way == "include":
        told = pick((path.name, "/dev/zero", "missing.xml", "pipe", "data"), rng)
        text = re.sub(r"(<mujoco[^>]*>|<robot[^>]*>)", rf'\1<include file="{told}"/>', text, count=1)
    else:
        one = pick(elements, rng)
        text, told = text.replace(one[1], pick(("x", "body", "joint", "mesh", "freejoint"), rng)), one[1]
    path.write_text(text)
    return f"{way} {told}"


def chain(links: int, urdf: bool) -> str:
    """An arm of so many links, one behind the other."""
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    if not urdf:
        opened = "".join(f'<body name="b{k}"><joint name="j{k}"/>{inertia}' for k in range(links))
        return f"<mujoco><worldbody>{opened}{'</body>' * links}</worldbody></mujoco>"
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    bodies = "".join(f'<link name="l{k}">{mass}</link>' for k in range(links + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/><axis xyz="0 0 1"/></joint>'
        for k in range(links)
    )
    return f'<robot name="chain">{bodies}{joints}</robot>'


def damage_parquet(path: Path, rng: np.random.Generator) -> str:
    """A column, its type, its values, or the metadata."""
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata or {})
    name = pick(table.column_names, rng)
    k = table.column_names.index(name)
    way = pick(
        ("drop", "type", "null", "value", "value", "metadata", "metadata", "twice", "rows", "stamps", "many"), rng
    )
    told = name
    if way == "drop":
        table = table.drop_columns([name])
    elif way == "type":
        kind = pick((pa.string(), pa.int32(), pa.float32(), pa.list_(pa.float64()), pa.binary(), pa.bool_()), rng)
        nothing = pa.nulls(len(table), kind)
        table = table.set_column(
            k, name, table.column(k).cast(kind) if kind in (pa.string(), pa.float32()) else nothing
        )
    elif way in ("null", "value"):
        values = table.column(k).to_pylist()
        bad = None if way == "null" else pick((0, 1e308, -1e308, float("nan"), float("inf"), 1e6, 2**63 - 1), rng)
        told += f" {bad}"
        for row in rng.integers(0, len(values), int(rng.choice([1, 50]))).tolist():
            values[row] = bad
        table = table.set_column(
            k, name, pa.array(values, None if isinstance(bad, float) else table.schema.field(k).type)
        )
    elif way == "metadata" and metadata:
        key = pick(sorted(metadata), rng)
        bad = pick((*VALUES, *TOKENS), rng)
        metadata[key] = str(bad if rng.random() < 0.5 else json.dumps(bad)).encode(errors="replace")
        told = f"{key!r}: {metadata[key][:40]!r}"
    elif way == "twice":
        table = table.append_column(pick((name, "q_", "x", "tau_jts_joint1", "contact"), rng), table.column(k))
    elif way == "rows":
        table = table.slice(0, int(rng.choice([0, 1, 2, 10])))
    elif way == "stamps" and "t_ns" in table.column_names:
        stamps = table.column("t_ns").to_numpy() * int(rng.choice([-1, 0, 1000, 10**9])) + int(rng.choice([0, 2**62]))
        table = table.set_column(table.column_names.index("t_ns"), "t_ns", pa.array(stamps))
    else:
        for extra in range(40):
            table = table.append_column(f"q_more{extra}", table.column(k))
    pq.write_table(table.replace_schema_metadata(metadata), path)
    return f"{way} {told}"


def damage_hdf5(path: Path, rng: np.random.Generator) -> str:
    """Lengths, types, links."""
    way = pick(("short", "empty", "scalar", "text", "huge", "loop", "external", "nan", "three", "wide", "group"), rng)
    with h5py.File(path, "r+") as file:
        name = pick(sorted(file), rng)
        values = file[name][:]
        del file[name]
        if way == "short":
            file[name] = values[: int(rng.integers(0, len(values)))]
        elif way == "huge":
            file.create_dataset(name, (10**12, 2), dtype="f8", chunks=(1000, 2))
        elif way == "loop":
            file[name] = h5py.SoftLink(f"/{name}")
        elif way == "external":
            file[name] = h5py.ExternalLink("/dev/zero", "x")
        elif way == "group":
            file[f"{name}/{name}/x"] = values
        else:
            others = {"empty": [], "scalar": 1.0, "text": "x", "nan": values * np.nan, "three": [[[1.0]]]}
            file[name] = others.get(way, np.ones((len(values), 200)))
    return f"{way} {name}"


def damage_mat(path: Path, rng: np.random.Generator) -> str:
    """Other arrays under the names."""
    length = int(rng.choice([0, 1, 2, 50]))
    kinds = {"t": np.arange(length), "q": np.ones((length, 2)), "dq": np.ones((length + 1, 2)), "tau": "text"}
    kinds |= {"q": pick((1.0, "x", np.ones((2, 2, 2)), {"a": [1, 2]}, np.array([], dtype=object), kinds["q"]), rng)}
    savemat(path, kinds)
    return f"arrays of {length}"


def damage_npz(path: Path, rng: np.random.Generator) -> str:
    """Another array under a name, or another name."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = pick(sorted(arrays), rng)
    bad = pick((np.nan, np.inf, 0.0, -1.0, 1e308, "x", {"a": 1}, True, 1j), rng)
    values = arrays.pop(name)
    way = pick(("fill", "shape", "name", "missing", "wide"), rng)
    if way == "fill":
        arrays[name] = np.full_like(values, bad, dtype=None if isinstance(bad, float) else object)
    elif way == "shape":
        arrays[name] = pick((values[:-1], values[None], values.ravel()[0], np.zeros((0, 0)), values.T), rng)
    elif way == "wide":
        arrays[name] = np.ones((4000, 1000))
    elif way == "name":
        arrays[pick(("x", "", "weight", "../x", "a" * 5000, "line\nbreak"), rng)] = values
    np.savez(path, **arrays)
    return f"{way} {name} {bad}"


def damage_csv(path: Path, rng: np.random.Generator) -> str:
    """A cell, a line, the head, the separator."""
    lines = path.read_text().splitlines()
    way = pick(("cell", "cell", "line", "head", "separator", "short", "quote", "wide", "nul", "stamps"), rng)
    k = int(rng.integers(1, len(lines)))
    if way in ("cell", "stamps"):
        cells = lines[k].split(",")
        place = 0 if way == "stamps" else int(rng.integers(len(cells)))
        cells[place] = pick(
            ("nan", "inf", "x", "", "1e999", "1e308", "-1e308", '"', "1,5", " ", "9" * 400, "0x10"), rng
        )
        lines[k] = ",".join(cells)
    elif way == "line":
        lines[k] = pick(("", ",", "," * 10_000, "x" * 100_000, "#", "\ufeff"), rng)
    elif way == "head":
        lines[0] = pick(("", "a,a,a", ",,,,,,", lines[0].upper(), lines[0] + ",", "t", lines[0].replace(",", ";")), rng)
    elif way == "separator":
        lines = [line.replace(",", pick((";", "\t", "|", " "), rng)) for line in lines]
    elif way == "short":
        lines = lines[: int(rng.choice([0, 1, 2, 3, 20]))]
    elif way == "wide":
        lines = [line + ",1" * 3000 for line in lines[:50]]
    else:
        lines[k] += '"' if way == "quote" else "\0"
    path.write_text("\n".join(lines), encoding="utf-8")
    return f"{way} at line {k + 1}"


def damage_bundle(path: Path, rng: np.random.Generator) -> str:
    """Bytes of the payload, with the checksum made right again, so that the checks behind it are met."""
    raw = bytearray(path.read_bytes())
    way = pick(("flip", "number", "zero", "length"), rng)
    at = int(rng.integers(28, len(raw) - 8)) if rng.random() < 0.5 else int(rng.integers(28, min(len(raw) - 8, 600)))
    if way == "flip":
        raw[at] ^= 1 << int(rng.integers(8))
    elif way == "number":
        raw[at : at + 8] = struct.pack("<d", pick((float("nan"), float("inf"), -1.0, 0.0, 1e308, 1e-308), rng))
    elif way == "length":
        raw[at : at + 4] = struct.pack("<I", pick((0, 1, 2**31, 2**32 - 1, 33), rng))
    else:
        raw[at : at + 8] = bytes(8)
    raw[24:28] = struct.pack("<I", binascii.crc32(bytes(raw[28:])))
    path.write_bytes(raw)
    return f"{way} at {at}, checksum right"


BY_ENDING = {
    ".json": damage_json, ".toml": damage_toml, ".xml": damage_xml, ".urdf": damage_xml, ".parquet": damage_parquet,
    ".h5": damage_hdf5, ".mat": damage_mat, ".npz": damage_npz, ".csv": damage_csv, ".tauext": damage_bundle,
}  # fmt: skip
