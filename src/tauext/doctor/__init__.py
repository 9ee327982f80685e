"""The signal doctor: what recordings and robot file have wrong, before anyone trains."""

from tauext.doctor.examine import Diagnosis, examine
from tauext.doctor.finding import CODES, Finding
from tauext.doctor.gather import gather
from tauext.doctor.quick import quick_look, unlabelled_contacts

__all__ = ["CODES", "Diagnosis", "Finding", "examine", "gather", "quick_look", "unlabelled_contacts"]
