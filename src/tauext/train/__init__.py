"""The training stage: from recordings of free motion to one bundle."""

from tauext.train.baselines import train_baselines
from tauext.train.look import look_first
from tauext.train.look import view as view_dataset
from tauext.train.settings import finished, training_settings, why_impossible
from tauext.train.stage import train_bundle, train_on_recordings

__all__ = [
    "finished",
    "look_first",
    "train_baselines",
    "train_bundle",
    "train_on_recordings",
    "training_settings",
    "view_dataset",
    "why_impossible",
]
