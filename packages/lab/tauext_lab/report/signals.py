"""Recordings and estimates for figures; missing ones are named."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tauext.bundle.estimates import Estimates, load_estimates
from tauext.data.dataset import FILE_NAME
from tauext.data.recording import Recording
from tauext.data.recording_file import fingerprint, load_recording
from tauext.errors import ConfigError, RecordingError
from tauext_lab.evaluate.results import Results


class NotAvailable(Exception):
    """Data for a figure are missing; the message is for the reader of the page."""


@dataclass(frozen=True)
class Signals:
    """Where recordings and estimates lie, and the joints that the results are about."""

    dataset_dir: Path
    results_dir: Path
    joints: tuple[str, ...]

    def recording(self, name: str) -> Recording:
        """A recording of the dataset.

        Raises:
            NotAvailable: its file is missing.
            RecordingError: it is damaged, or has other joints than the results.
        """
        path = self.dataset_dir / f"{expect_plain(name)}.parquet"
        if not path.is_file():
            raise NotAvailable(f"the dataset has no recording {name}")
        recording = load_recording(path)
        if recording.joints != self.joints:
            raise RecordingError(
                f"{path}: its joints are {', '.join(recording.joints)}, the results' {', '.join(self.joints)}; "
                "the results are of another dataset"
            )
        return recording

    def estimates(self, bundle: str, recording: Recording) -> Estimates:
        """A bundle's estimates of a recording.

        Raises:
            NotAvailable: the file is missing.
            RecordingError: it is damaged, or of another recording.
        """
        path = self.results_dir / "estimates" / expect_plain(bundle) / f"{recording.name}.parquet"
        if not path.is_file():
            raise NotAvailable(f"there are no estimates of bundle {bundle} for {recording.name}")
        estimates = load_estimates(path)
        for what, found, recorded in (
            ("samples", len(estimates.t_ns), recording.samples),
            ("joints", ", ".join(estimates.joints), ", ".join(recording.joints)),
        ):
            if found != recorded:
                raise RecordingError(
                    f"{path}: it has {what} {found}, its recording {recorded}; evaluate this dataset again"
                )
        return estimates

    def by_bundle(self, bundles: Iterable[str], recording: Recording) -> tuple[dict[str, Estimates], list[str]]:
        """Estimates of every bundle that has them, and the names of those that have none.

        Raises:
            NotAvailable: no bundle has them.
        """
        found, missing = {}, []
        for bundle in bundles:
            try:
                found[bundle] = self.estimates(bundle, recording)
            except NotAvailable:
                missing.append(bundle)
        if not found:
            raise NotAvailable(f"there are no estimates of {recording.name}")
        return found, missing


def expect_plain(name: str) -> str:
    """This name, which is one of a file or folder; ConfigError where it leads elsewhere (`../x`, `/x`)."""
    if name in ("", "..") or Path(name).name != name or "\0" in name:
        raise ConfigError(f"results.json: the name {name!r} must be that of a file, without a folder; evaluate again")
    return name


# --- Results are drawn only with the dataset that they were measured on.


NAMED = 3
"""So many of the recordings are named."""


def expect_same_dataset(results: Results, results_dir: Path, dataset_dir: Path) -> None:
    """Raise ConfigError where the dataset's recordings are not those that were evaluated.

    A missing recording is named on the page in its place; a dataset with none of them is a different dataset.
    Results from before fingerprints were kept are not checked.
    """
    judged = results.provenance.get("recordings") or {}
    for name in judged:
        expect_plain(name)
    there = [name for name in judged if (dataset_dir / f"{name}.parquet").is_file()]
    other = [name for name in there if fingerprint(dataset_dir / f"{name}.parquet") != judged[name]]
    missing = bool(judged) and not there and (dataset_dir / FILE_NAME).is_file()
    if not other and not missing:
        return
    names = other or list(judged)
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    what = "are not those that were evaluated" if other else "are not in it"
    raise ConfigError(
        f"{dataset_dir}: it is another dataset than that of {results_dir}, '{results.provenance.get('dataset')}': "
        f"{listed} {what}; give the dataset that was evaluated, or evaluate this one"
    )
