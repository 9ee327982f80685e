"""From recordings of free motion to a network that knows what the observer shows when nothing touches the arm."""

from tauext.learn.bundle_writing import build_chain, make_bundle, set_signal_ranges
from tauext.learn.train import Progress, TrainedNetwork, train
from tauext.learn.training_set import Chain, Scaling, WindowSet, build_windows, find_scaling

__all__ = [
    "Chain",
    "Progress",
    "Scaling",
    "TrainedNetwork",
    "WindowSet",
    "build_chain",
    "build_windows",
    "find_scaling",
    "make_bundle",
    "set_signal_ranges",
    "train",
]
