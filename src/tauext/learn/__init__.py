"""From recordings of free motion to a network that knows what the observer shows when nothing touches the arm."""

from tauext.learn.bundle_writing import (
    build_setup,
    freeze_drift,
    make_bundle,
    reference_recording,
    set_drift,
    set_signal_ranges,
)
from tauext.learn.found_load import last_axis_shows, load_disagreement
from tauext.learn.friction import fit_friction
from tauext.learn.gate import Gate, apply_gate
from tauext.learn.network_training import Progress, TrainedNetwork, train_network
from tauext.learn.prior import fit_prior
from tauext.learn.prior_fit import PriorFit
from tauext.learn.signal_bounds import signal_bounds
from tauext.learn.torque_constants import TorqueConstants, fit_torque_constants
from tauext.learn.training_set import Scaling, Setup, WindowSet, build_windows, find_scaling, with_presliding

__all__ = [
    "Setup",
    "Gate",
    "PriorFit",
    "Progress",
    "Scaling",
    "TorqueConstants",
    "TrainedNetwork",
    "WindowSet",
    "apply_gate",
    "build_setup",
    "build_windows",
    "find_scaling",
    "fit_friction",
    "fit_prior",
    "fit_torque_constants",
    "freeze_drift",
    "last_axis_shows",
    "load_disagreement",
    "make_bundle",
    "reference_recording",
    "set_drift",
    "set_signal_ranges",
    "signal_bounds",
    "train_network",
    "with_presliding",
]
