"""LeRobot frames with what the monitor says of them: of datasets, and of a robot while it makes them."""

from tauext.label.frames import FrameLabeller
from tauext.label.labelling import LabelReport, label_dataset
from tauext.label.labels import UNKNOWN, Labels

__all__ = ["UNKNOWN", "FrameLabeller", "LabelReport", "Labels", "label_dataset"]
