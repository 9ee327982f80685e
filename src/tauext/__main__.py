"""`python -m tauext` is the command `tauext`."""

import sys

from tauext.cli import main

sys.exit(main())
