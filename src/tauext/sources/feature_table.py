"""Labels in the features of a LeRobot dataset: elements of its state, or features of their own."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from tauext.data.lerobot_folder import STATE, LerobotFolder
from tauext.errors import ConfigError
from tauext.sources.labels import bare_name, element_names

Into = Literal["state", "features"]
OWN = ("observation.tau_ext", "observation.contact", "observation.collision")
HUGGINGFACE = b"huggingface"


@dataclass(frozen=True)
class FeaturePlan:
    """Which elements of which feature the labels' columns become."""

    places: dict[str, tuple[list[int], list[int]]]
    """By feature: columns of the labels, and their places among the feature's elements."""
    features: dict[str, dict]
    """All features of the dataset with the labels."""
    added: dict[str, int]
    """By feature: how many elements are new, after those that there are."""


def plan_features(folder: LerobotFolder, joints: Sequence[str], into: Into) -> FeaturePlan:
    """Where labels go; elements that bear their names already are replaced.

    Raises:
        ConfigError: the dataset has no state whose elements have names.
    """
    names: list[Any]
    features, wanted = copy.deepcopy(folder.features), element_names(joints)
    if into == "features":
        of_joints = list(range(len(joints)))
        names = [[bare_name(joint) for joint in joints], None, None]
        columns = [of_joints, [len(joints)], [len(joints) + 1]]
        places = {}
        for feature, columns_of_it, named in zip(OWN, columns, names, strict=True):
            features[feature] = {"dtype": "float32", "shape": [len(columns_of_it)], "names": named}
            places[feature] = (columns_of_it, list(range(len(columns_of_it))))
        return FeaturePlan(places, features, {feature: len(own[0]) for feature, own in places.items()})
    state = features.get(STATE, {})
    shape = state.get("shape") or [0]
    names = folder.names(STATE, int(shape[0])) if STATE in features else []
    if not names or not isinstance(state.get("names"), list | dict):
        raise ConfigError(
            f"{folder.path}: its {STATE} has no names for its elements, so the labels cannot be told among them: "
            "--into features gives them features of their own"
        )
    new = [name for name in wanted if name not in names]
    listed = [*names, *new]
    state["names"], state["shape"] = listed, [len(listed)]
    places = {STATE: (list(range(len(wanted))), [listed.index(name) for name in wanted])}
    return FeaturePlan(places, features, {STATE: len(new)})


def with_labels(table: pa.Table, labels: np.ndarray, plan: FeaturePlan) -> pa.Table:
    """The frames of a data file with their labels (rows, columns), all else untouched."""
    for feature, (columns, places) in plan.places.items():
        values = _elements(table, feature, len(table))
        wide = np.zeros((len(table), max(values.shape[1], max(places) + 1)), dtype=values.dtype)
        wide[:, : values.shape[1]] = values
        wide[:, places] = labels[:, columns]
        table = _set(table, feature, wide)
    return table.replace_schema_metadata(_metadata(table.schema, plan))


def recorded(table: pa.Table, plan: FeaturePlan) -> np.ndarray | None:
    """Labels that the frames hold already, (rows, columns) as with_labels() takes them; None: they hold not all."""
    total = sum(len(columns) for columns, _ in plan.places.values())
    held = np.zeros((len(table), total), dtype=np.float32)
    for feature, (columns, places) in plan.places.items():
        values = _elements(table, feature, len(table))
        if values.shape[1] <= max(places):
            return None
        held[:, columns] = values[:, places]
    return held


def _elements(table: pa.Table, feature: str, rows: int) -> np.ndarray:
    if feature not in table.column_names:
        return np.zeros((rows, 0), dtype=np.float32)
    column = table.column(feature).combine_chunks()
    if not hasattr(column.type, "value_type"):
        return column.to_numpy(zero_copy_only=False).reshape(rows, 1)
    values = column.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(rows, len(values) // max(rows, 1))


def _set(table: pa.Table, feature: str, values: np.ndarray) -> pa.Table:
    """The column in the type of list that it has; fixed where it is new, a plain number where that is one."""
    there = table.schema.get_field_index(feature)
    flat = pa.array(np.ascontiguousarray(values).ravel())
    if there < 0 and values.shape[1] == 1:
        return table.append_column(feature, flat)
    kind = table.schema.field(there).type if there >= 0 else None
    if kind is not None and pa.types.is_list(kind):
        offsets = pa.array(np.arange(0, values.size + 1, values.shape[1], dtype=np.int32))
        column = pa.ListArray.from_arrays(offsets, flat)
    elif kind is not None and pa.types.is_large_list(kind):
        offsets = pa.array(np.arange(0, values.size + 1, values.shape[1], dtype=np.int64))
        column = pa.LargeListArray.from_arrays(offsets, flat)
    else:
        column = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return table.append_column(feature, column) if there < 0 else table.set_column(there, feature, column)


def _metadata(schema: pa.Schema, plan: FeaturePlan) -> dict[bytes, bytes] | None:
    """What the datasets library keeps of the columns' types, brought up to date where it is there."""
    metadata = dict(schema.metadata or {})
    if HUGGINGFACE not in metadata:
        return metadata or None
    told: dict[str, Any] = json.loads(metadata[HUGGINGFACE])
    features = told.get("info", {}).get("features", {})
    template = next((f for f in features.values() if f.get("length", -1) > 0), {"_type": "Sequence"})
    for feature in plan.places:
        length = plan.features[feature]["shape"][0]
        value = {"dtype": plan.features[feature]["dtype"], "_type": "Value"}
        kept = features.get(feature)
        if kept is not None and "length" in kept:
            features[feature] = kept | ({"length": length} if kept["length"] > 0 else {})
        elif kept is None:
            features[feature] = (
                value if length == 1 else {"feature": value, "length": length, "_type": template["_type"]}
            )
    return metadata | {HUGGINGFACE: json.dumps(told).encode()}
