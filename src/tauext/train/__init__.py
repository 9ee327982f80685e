"""The training stage: from recordings of free motion to one bundle."""

from tauext.train.baselines import train_baselines
from tauext.train.settings import finished, training_settings, why_impossible
from tauext.train.stage import train_bundle, train_on_recordings

__all__ = ["finished", "train_baselines", "train_bundle", "train_on_recordings", "training_settings", "why_impossible"]
