"""External joint torque and collision detection for robot arms, from joint encoders and motor torque alone.

The public names, each loaded on first use:

    import tauext

    dataset = tauext.load_dataset("runs/data")
    bundle = tauext.train_bundle(dataset, "runs/arm.tauext", config=tauext.TrainConfig(recipe="prior"))
    recording = tauext.load_recording("runs/data/collisions-000.parquet")
    estimates = tauext.estimate_recording(bundle, recording)  # estimates.tau_ext: (samples, joints)
    estimates.why(0)  # "warming up": there is no estimate yet, and tau_ext is NaN

    monitor = tauext.Monitor(bundle)  # in a control loop: one sample in, one answer out
    estimate = monitor.step(t_ns, q, dq, tau)  # tau in bundle.torque_units, answers in bundle.estimate_units
    if not estimate.clear: ...

**Data** load_recording, save_recording, Recording · load_dataset, Dataset · load_bundle, Bundle
**Train** train_bundle, recalibrate; refit_bundle, refit_motion, refit_recordings; TrainConfig and the settings in it:
ObserverConfig, PriorConfig, DriftConfig, AlarmConfig, FilterConfig, FreeMotionConfig
**Estimate** estimate_recording, Estimates
**Monitor** expect_fit, Monitor, Estimate, Health, Alarm, cause_names, FlightRecorder; Touch; Load, LoadFound,
LoadPhase; DeclaredContact, Declared, ToolForce: contacts that the task means
**Forces** WrenchModel, Wrench, WrenchAxes: force and moment at a frame · PlaceModel, TouchPlaces, TouchPlace: which
link is touched, where and how hard
**Progress** Reporter: progress of train_bundle **Errors** TauextError and under it RobotError,
RecordingError, ConfigError, BundleError, TrainingError

The loop around a monitor: `tauext.monitor.loop`; sources of samples: `tauext.sources`; checks of recordings:
`tauext.check`; robot files: `tauext.robot`. Evaluation, pages and simulated arms: `tauext_lab`, a package of its own.
"""

from __future__ import annotations

import importlib

_WHERE = {
    "_core": (
        "Alarm Bundle Declared DeclaredContact Estimate FlightRecorder Health Load LoadFound LoadPhase Monitor "
        "PlaceModel ToolForce Touch TouchPlace TouchPlaces Wrench WrenchAxes WrenchModel __version__ cause_names"
    ),
    "bundle.bundle_file": "load_bundle",
    "bundle.estimates": "Estimates",
    "bundle.match": "expect_fit",
    "config": "AlarmConfig DriftConfig FilterConfig FreeMotionConfig ObserverConfig PriorConfig TrainConfig",
    "data.dataset": "Dataset load_dataset",
    "data.recording": "Recording",
    "data.recording_file": "load_recording save_recording",
    "errors": "BundleError ConfigError RecordingError RobotError TauextError TrainingError",
    "monitor.estimate": "estimate_recording",
    "progress": "Reporter",
    "train.calibrate": "recalibrate",
    "train.refit": "refit_bundle refit_motion refit_recordings",
    "train.stage": "train_bundle",
}
"""Names of each module. No name is that of a subpackage, which would take its place once it is imported. `__init__.pyi`
has the same imports for type checkers."""
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names.split()}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'tauext' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"tauext.{_MODULE_OF[name]}"), name)
    globals()[name] = value  # cached
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
