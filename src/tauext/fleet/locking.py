"""One driver a folder: a second one would clear away what the first one's workers are writing.

A store has no locks: there it is one driver of this machine.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.staging import at_home

LOCK = "fleet.lock"


@contextmanager
def locked(out: Place) -> Iterator[None]:
    """The folder is ours; the lock ends with the process, whatever ends it.

    Raises:
        ConfigError: another driver is at work here.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    home = at_home(out)
    home.mkdir(parents=True, exist_ok=True)
    with (home / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ConfigError(f"{out}: another `tauext fleet run` is at work here ({file.read().strip()})") from error
        except OSError:
            pass  # a file system without locks
        file.truncate(0)
        file.write(f"process {os.getpid()} of {socket.gethostname()}")
        file.flush()
        yield
