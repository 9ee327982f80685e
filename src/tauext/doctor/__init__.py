"""The signal doctor: what recordings and robot file have wrong, before anyone trains."""

from tauext.doctor.examine import Diagnosis, examine
from tauext.doctor.finding import CODES, Finding

__all__ = ["CODES", "Diagnosis", "Finding", "examine"]
