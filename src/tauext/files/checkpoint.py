"""Long work that a killed process does not lose: its state in a file of its own, written every so often.

The state is pickled. Reading it makes nothing but plain containers, arrays of NumPy and the classes of a few folders of
tauext, so that a file from elsewhere can do no harm; one that is damaged or of other work counts as none.
"""

from __future__ import annotations

import io
import os
import pickle
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tauext.config import fits
from tauext.files.atomic_write import atomic_write


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/tauext, or ~/.cache/tauext: what can be made again. It may not exist."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base and Path(base).is_absolute() else Path.home() / ".cache") / "tauext"


EVERY_S = 20.0
"""Between two writings: with one step of the work and the writing itself, less than 30 s are lost."""
ARRAYS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pcg64", "PCG64"),
    ("numpy.random.bit_generator", "SeedSequence"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    ("collections", "Counter"),
    ("collections", "defaultdict"),
    ("collections", "deque"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "slice"),
    ("builtins", "list"),
    ("builtins", "dict"),
    ("builtins", "int"),
    ("builtins", "float"),
}


class Checkpoint:
    """The state of one piece of work: load() at its start, offer() after each step, end() when all is written."""

    def __init__(self, path: Path, key: str, outside: Mapping[str, object] | None = None, package: str = ""):
        """Args:
        path: of the file.
        key: what the work depends on, in full.
        outside: by names, what is not stored with it.
        package: a package beside tauext whose classes the state may contain, too.
        """
        self._path, self._key, self._outside = path, key, dict(outside or {})
        own = tuple(f"tauext.{name}." for name in ("config", "data", "bundle", "check", "train"))
        self._folders = (*own, f"{package}.") if package else own
        self._written = time.monotonic()

    def load(self, of: Any) -> Any | None:
        """The state that was offered last for this key; None: no usable state.

        Args:
            of: type of the state, such as tuple[Comparison, int].
        """
        try:
            with self._path.open("rb") as file:
                key, state = _Reader(file, self._outside, self._folders).load()
        except (OSError, EOFError, AttributeError, ImportError, IndexError, KeyError, TypeError, ValueError):
            return None
        except (pickle.UnpicklingError, MemoryError):
            return None
        return state if key == self._key and fits(state, of) else None

    def offer(self, state: Any) -> None:
        """Write the state where the last writing is EVERY_S ago; the folder is there."""
        if time.monotonic() - self._written >= EVERY_S:
            self.put(state)

    def put(self, state: Any) -> None:
        """Write the state now; the folder is there."""
        content = io.BytesIO()
        _Writer(content, self._outside).dump((self._key, state))
        with atomic_write(self._path) as part, part.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        self._written = time.monotonic()

    def end(self) -> None:
        """The work is done: nothing is left to go on with."""
        self._path.unlink(missing_ok=True)


class _Writer(pickle.Pickler):
    def __init__(self, file: io.BytesIO, outside: Mapping[str, object]):
        super().__init__(file, protocol=5)
        self._names = {id(thing): name for name, thing in outside.items()}

    def persistent_id(self, obj: Any) -> Any:
        return self._names.get(id(obj))


class _Reader(pickle.Unpickler):
    def __init__(self, file: io.BufferedReader, outside: Mapping[str, object], folders: tuple[str, ...]):
        super().__init__(file)
        self._outside, self._folders = outside, folders

    def persistent_load(self, pid: Any) -> Any:
        return self._outside[pid]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in ARRAYS:
            return super().find_class(module, name)
        found = super().find_class(module, name) if f"{module}.".startswith(self._folders) and "." not in name else None
        if not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name} belongs into no state")
        return found
