"""Results are drawn with the dataset that they were measured on, and with no other."""

from __future__ import annotations

from pathlib import Path

from tauext.data.recording_file import fingerprint
from tauext.data.split import FILE_NAME
from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.report.entry import Entry
from tauext.report.results import Results

NAMED = 3
"""So many of the recordings are named."""


def expect_same_dataset(results: Results, results_dir: Path, dataset_dir: Place) -> None:
    """Raise ConfigError where the dataset's recordings are not those that were evaluated.

    One that is missing is said on the page where it would stand; a dataset that has none of them is another one.
    Results of before fingerprints were kept say nothing.
    """
    judged = Entry(f"{results_dir / 'results.json'}, provenance", results.provenance).object("recordings")
    there = [name for name in judged.content if (dataset_dir / f"{name}.parquet").is_file()]
    other = [name for name in there if fingerprint(dataset_dir / f"{name}.parquet") != judged.text(name)]
    missing = bool(judged.content) and not there and (dataset_dir / FILE_NAME).is_file()
    if not other and not missing:
        return
    names = other or list(judged.content)
    told = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    what = "are not those that were evaluated" if other else "are not in it"
    raise ConfigError(
        f"{dataset_dir}: it is another dataset than that of {results_dir}, '{results.provenance.get('dataset')}': "
        f"{told} {what}; give the dataset that was evaluated, or evaluate this one"
    )
