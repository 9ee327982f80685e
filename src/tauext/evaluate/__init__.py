"""Bundles on recordings: results.json and estimates."""

from tauext.evaluate.estimating import estimate
from tauext.evaluate.evaluate import evaluate

__all__ = ["estimate", "evaluate"]
