"""Names of bundles: which of the paper's models one is of, and how it is called in figures and tables."""

from __future__ import annotations

from tauext.report.paper import CASE_LABELS


def model_of(name: str) -> str | None:
    """The paper's model that a bundle is of: `exact` and `exact-anything` are of `exact`; None for other names."""
    model = name.partition("-")[0]
    return model if model in CASE_LABELS else None


def bundle_label(name: str, recipe: str | None = None) -> str:
    """`exact-paper` is "exact, paper recipe" if it was trained so; names that are no model's stay as they are."""
    model = model_of(name)
    if model is None:
        return name
    variant = name.removeprefix(model).removeprefix("-")
    words = [CASE_LABELS[model], f"{variant} recipe" if variant == recipe else variant]
    return ", ".join(word for word in words if word)


def place(name: str) -> tuple[int, bool]:
    """Sorts bundles as the paper does, one with another recipe behind its model's own, other names last."""
    model = model_of(name)
    return (len(CASE_LABELS) if model is None else list(CASE_LABELS).index(model)), name != model
