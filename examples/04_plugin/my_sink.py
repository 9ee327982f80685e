"""An output of your own for `tauext run` and `tauext monitor`: external torques as a table of text.

    tauext run ARM.tauext RECORDING.parquet --my-table torques.csv

pyproject.toml names KIND as an entry point, whose name is the option; tauext needs nothing else.
"""

from __future__ import annotations

from pathlib import Path

from tauext.errors import ConfigError
from tauext.monitor.sink import Control, LoopReport, Verdict
from tauext.monitor.sink_kind import SinkKind, Watched


class Table:
    """Writes a row a sample. Slow work belongs in a thread: tauext.monitor.background.BackgroundWorker."""

    def __init__(self, path: Path):
        if path.exists():
            raise ConfigError(f"{path}: exists already; choose another name, or remove it")
        self._path, self._rows = path, 0

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._file = self._path.open("w")
        print("t_ns", *joints, sep=",", file=self._file)

    def verdict(self, verdict: Verdict) -> None:
        for t_ns, torques in zip(verdict.t_ns, verdict.estimates["tau_ext"], strict=True):
            print(t_ns, *torques, sep=",", file=self._file)
        self._rows += len(verdict.t_ns)

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        self._file.close()

    def summary(self) -> str:
        return f"{self._path}: {self._rows} rows"

    def loss(self) -> str:
        return ""


def open_table(path: Path, watched: Watched) -> Table:
    return Table(path)


KIND = SinkKind(open_table, "table (*.csv) of the external torques. None: none is written.")
