"""What the arm carries, weighed with its own joints; and its torque constants, from a weight that is known."""

from tauext.load.frame import NamedFrame, load_frame
from tauext.load.identify import LoadEstimate, identify
from tauext.load.known import KnownWeight, weigh_constants
from tauext.load.rows import SIGMA_SHARE, Seen, see, stand_worth
from tauext.load.scaled_bundle import scaled_bundle, with_provenance
from tauext.load.weighable import expect_weighable, weighing_joints
from tauext.load.windows import between, each_window, expect_different
from tauext.load.words import load_facts, load_sentences

__all__ = [
    "SIGMA_SHARE",
    "KnownWeight",
    "LoadEstimate",
    "NamedFrame",
    "Seen",
    "between",
    "each_window",
    "expect_different",
    "expect_weighable",
    "identify",
    "load_facts",
    "load_frame",
    "load_sentences",
    "scaled_bundle",
    "see",
    "stand_worth",
    "weigh_constants",
    "weighing_joints",
    "with_provenance",
]
