"""Bundles on recordings: results.json and estimates."""

from tauext.data.loss_history import read_loss_history
from tauext.evaluate.comparison import evaluate
from tauext.evaluate.estimating import estimate_recording
from tauext.evaluate.results_folder import evaluate_bundles

__all__ = ["estimate_recording", "evaluate", "evaluate_bundles", "read_loss_history"]
