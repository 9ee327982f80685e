"""Options of live sources, which the commands `monitor` and `commission` share."""

from __future__ import annotations

from dataclasses import fields, make_dataclass
from typing import Annotated, Any

import tyro

from tauext.sources.open import kinds, options_of

KINDS = kinds()
OPTIONS = options_of(KINDS)
SOURCES = ", ".join(kind.typed(name) for name, kind in KINDS.items())
"""Every source that is installed, as it is typed."""
SourceOptions: Any = make_dataclass(
    "SourceOptions",
    [(one.name, Annotated[one.type, tyro.conf.arg(help=one.help)], one.default) for one in OPTIONS.values()],
    frozen=True,
)
"""Options of all installed kinds, one field each."""
SourceOptionsArg = Annotated[SourceOptions, tyro.conf.arg(name="")]


def given(options: Any) -> dict[str, Any]:
    """Values of the options that differ from their defaults, by name."""
    values = {field.name: getattr(options, field.name) for field in fields(options)}
    return {name: value for name, value in values.items() if value != OPTIONS[name].default}
