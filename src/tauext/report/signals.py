"""Recordings and estimates that figures draw; what is missing is named, not guessed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tauext.bundle.estimates import Estimates, load_estimates
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import RecordingError
from tauext.files.places import Place


class NotAvailable(Exception):
    """A figure cannot be drawn from what is there; the message is for the reader of the page."""


@dataclass(frozen=True)
class Signals:
    """Where recordings and estimates lie, and the joints that the results are about."""

    dataset_dir: Place
    results_dir: Path
    joints: tuple[str, ...]

    def recording(self, name: str) -> Recording:
        """A recording of the dataset.

        Raises:
            NotAvailable: its file is missing.
            RecordingError: it is damaged, or has other joints than the results.
        """
        path = self.dataset_dir / f"{name}.parquet"
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
        """What a bundle said of a recording.

        Raises:
            NotAvailable: the file is missing.
            RecordingError: it is damaged, or of another recording.
        """
        path = self.results_dir / "estimates" / bundle / f"{recording.name}.parquet"
        if not path.is_file():
            raise NotAvailable(f"there are no estimates of bundle {bundle} for {recording.name}")
        estimates = load_estimates(path)
        for what, said, recorded in (
            ("samples", len(estimates.t_ns), recording.samples),
            ("joints", ", ".join(estimates.joints), ", ".join(recording.joints)),
        ):
            if said != recorded:
                raise RecordingError(
                    f"{path}: it has {what} {said}, its recording {recorded}; evaluate this dataset again"
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
