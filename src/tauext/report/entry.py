"""One JSON object of results.json: its values, checked as they are read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal, overload

from tauext.errors import ConfigError
from tauext.report.results import Numbers


@dataclass(frozen=True)
class Entry:
    """One JSON object of results.json and its place, for messages."""

    place: str
    content: dict[str, Any]

    def get(self, key: str, kinds: type | tuple[type, ...], needed: bool = False) -> Any:
        """The value under this key, None where it is null or absent."""
        value = self.content.get(key)
        if value is None and not needed:
            return None
        right = isinstance(value, kinds) and (kinds is bool or not isinstance(value, bool))
        if not right:
            names = [kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))]
            raise ConfigError(f"{self.place}: '{key}' is {json.dumps(value)[:60]}, must be {' or '.join(names)}")
        return value

    @overload
    def number(self, key: str, needed: Literal[True]) -> float: ...
    @overload
    def number(self, key: str, needed: bool = False) -> float | None: ...
    def number(self, key: str, needed: bool = False) -> float | None:
        return self.get(key, (int, float), needed)

    @overload
    def text(self, key: str, needed: Literal[True]) -> str: ...
    @overload
    def text(self, key: str, needed: bool = False) -> str | None: ...
    def text(self, key: str, needed: bool = False) -> str | None:
        return self.get(key, str, needed)

    def entries(self, key: str, needed: bool = False) -> list[Entry]:
        """The objects of a list; none where it is absent."""
        items = [Entry(f"{self.place}, {key}[{k}]", e) for k, e in enumerate(self.get(key, list, needed) or [])]
        for item in items:
            if not isinstance(item.content, dict):
                raise ConfigError(f"{item.place}: is {json.dumps(item.content)[:60]}, must be an object")
        return items

    def object(self, key: str) -> Entry:
        return Entry(f"{self.place}, {key}", self.get(key, dict) or {})

    def texts(self, key: str, needed: bool = False) -> tuple[str, ...]:
        items = self.get(key, list, needed) or []
        if not all(isinstance(item, str) for item in items):
            raise ConfigError(f"{self.place}: '{key}' must be a list of names")
        return tuple(items)

    def numbers(self, key: str, joints: int) -> Numbers:
        """One number or null a joint."""
        items = self.get(key, list)
        if items is None:
            return (None,) * joints
        if len(items) != joints or not all(type(item) in (int, float, type(None)) for item in items):
            raise ConfigError(f"{self.place}: '{key}' must be a list of {joints} numbers or null, one a joint")
        return tuple(items)

    def each_number(self, *keys: str) -> dict[str, Any]:
        """The numbers under these keys, as keyword arguments."""
        return {key: self.number(key) for key in keys}

    def loss_history(self, key: str) -> tuple[tuple[int, float, float], ...]:
        """Triples of a step and its two losses."""
        items = self.get(key, list) or []
        for item in items:
            kinds = [type(number) for number in item] if isinstance(item, list) else []
            if len(kinds) != 3 or kinds[0] is not int or not {*kinds} <= {int, float}:
                raise ConfigError(
                    f"{self.place}: '{key}' holds {json.dumps(item)[:60]}, must be [step, training, validation loss]"
                )
        return tuple(map(tuple, items))
