"""The one rule for outputs that stand already: results are replaced, and a line says so before the work begins."""

from __future__ import annotations

import sys

from tauext.files.place import Place

RULE = (
    "What stands at --out already: bundles, results, reports and findings are replaced when the new ones are whole, "
    "and a line on stderr says so at the start; datasets and descriptions are refused; flights and recordings get "
    "another name."
)
"""As the help says it."""


def tell_replaced(*outputs: Place) -> None:
    """Name those of these files that are there, on stderr."""
    for path in outputs:
        if path.is_file():
            print(f"tauext: {path} is there already and will be replaced", file=sys.stderr)
