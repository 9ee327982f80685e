"""Bundles on recordings: results.json and estimates."""

from tauext.evaluate.estimating import estimate
from tauext.evaluate.evaluate import evaluate
from tauext.evaluate.loss_history import read_loss_history

__all__ = ["estimate", "evaluate", "read_loss_history"]
