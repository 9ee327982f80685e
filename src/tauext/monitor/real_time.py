"""One core and real-time priority for the thread that asks, where the system grants them."""

from __future__ import annotations

import os


def ask_for_real_time(core: int | None, priority: int | None) -> list[str]:
    """Pin this thread, and all that it starts from now on, to a core, and put them into SCHED_FIFO; None: as they are.

    Returns what was granted or refused, a sentence each. Nothing here fails: a loop runs without it, less evenly.
    """
    said = []
    if core is not None:
        try:
            os.sched_setaffinity(0, {core})
            said.append(f"pinned to core {core}")
        except AttributeError:
            said.append("not pinned to a core: this system has no such call")
        except OSError as error:
            there = sorted(os.sched_getaffinity(0))
            said.append(f"not pinned to core {core}: {error.strerror}; there are {', '.join(map(str, there))}")
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            said.append(f"SCHED_FIFO, priority {priority}")
        except AttributeError:
            said.append("no SCHED_FIFO: this system has no such call")
        except OSError as error:
            said.append(f"no SCHED_FIFO, priority {priority}: {error.strerror}; `ulimit -r` or root allow it")
    return said
