"""Files as the field has them: the arrays of the clean file, or one message that names the cause.

The table below lists, for each property of a file, how the log is changed and what import makes of it, format by format.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from made_arms import write_arm
from made_files import ARRAYS, BAGS, FORMATS, JOINTS, LEROBOT, NAMED, TABLES, Log, arm_text, clean_log, write

from tauext.data.description import load_arm
from tauext.data.importing import Imported, import_dataset
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
