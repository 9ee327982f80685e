"""The page of a live arm in the browser, real or simulated.

In go the files of a commissioned folder and the lines of the loop. Out come one HTML page, JSON and control lines. It
imports the packages before it.
"""

from typing import Any


def serve(*arguments: Any) -> None:
    """The page's process, see tauext_commission.page.live_server.serve(); no other process loads the server library."""
    from tauext_commission.page.live_server import serve as run

    run(*arguments)
