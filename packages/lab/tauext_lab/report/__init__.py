"""Results to figures and pages.

In go results.json, estimates and flights. Out come figures and HTML pages. It imports the packages before it and
computes nothing that results.json could hold.
"""

import logging

# Without a handler, Python prints on stderr that HOME cannot be written or that a font cache is built.
logging.getLogger("matplotlib").addHandler(logging.NullHandler())
