"""Writes the results of fits into a bundle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.config import DriftConfig, FilterConfig, ObserverConfig
from tauext.data.free_motion import SignalBounds
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.network_training import TrainedNetwork
from tauext.fit.prior_facts import friction_nm
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import LEAST_TORQUE_NM, Scaling, Setup
from tauext.recipes import recipe_of


def build_setup(
    tree: _core.Tree,
    recording: Recording,
    config: ObserverConfig,
    recipe: str = "observer",
    filters: FilterConfig | None = None,
) -> Setup:
    """The estimated model and the settings that follow from the recording's rate and torque timing.

    Args:
        recipe: which observer, whether its r is filtered, and how much a network sees at once.
        filters: cut-offs of the filters, None: the default ones.

    Raises:
        TrainingError: the recording's joints are not the model's.
    """
    names = tuple(link.joint_name for link in tree.links)
    if recording.joints != names:
        raise TrainingError(
            f"{recording.name}: its joints {', '.join(recording.joints)} are not the model's {', '.join(names)}"
        )
    row, filters = recipe_of(recipe), filters or FilterConfig()
    settings = _core.ObserverSettings(
        gain_per_s=config.first_gain_per_s,
        timing=getattr(_core.TorqueTiming, recording.torque_timing),
        sample_period_ns=config.sample_period_ns(recording.rate_hz),
        network_stride=config.network_stride(recording.rate_hz),
        method=getattr(_core.ResidualMethod, row.method),
        high_pass_per_s=filters.high_pass_per_s if row.high_pass else 0.0,
        low_pass_per_s=filters.low_pass_per_s if row.low_pass else 0.0,
    )
    return Setup(tree, settings, config.window_steps(recording.rate_hz))


def make_bundle(
    name: str,
    setup: Setup,
    near_stiction_rad_s: float,
    reference: Recording,
    scaling: Scaling | None = None,
    network: TrainedNetwork | None = None,
) -> _core.Bundle:
    """A bundle without limits yet (all 1 Nm, no hold times; see train.paper_limits.set_limits), with a network or the
    plain observer. Its signal ranges are those of the reference until set_signal_ranges sees more.

    Args:
        reference: a recording of free motion; its first window is kept, and replayed whenever the bundle is loaded.

    Raises:
        TrainingError: the reference recording is shorter than a window.
    """
    n = setup.tree.size
    bundle = _core.Bundle()
    bundle.name = name
    bundle.links = setup.tree.links
    bundle.gravity = setup.tree.gravity
    bundle.observer = setup.observer
    bundle.window_steps = setup.window_steps
    bundle.prior = setup.prior
    if network is not None and scaling is not None:
        bundle.shape = network.shape
        bundle.inputs = setup.inputs
        bundle.input_factors = scaling.input_factors.tolist()
        bundle.parameters = network.parameters.tolist()
        bundle.output_scale_nm = scaling.output_scale_nm.tolist()
    bundle.near_stiction_rad_s = near_stiction_rad_s
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [1.0] * n
    bundle.contact_sliding_limit_nm = bundle.contact_near_stiction_limit_nm = [1.0] * n
    set_signal_ranges(bundle, [reference])
    bundle.assume_load()
    samples = setup.reach * setup.observer.network_stride + 1
    if reference.samples < samples:
        raise TrainingError(f"{reference.name}: {reference.samples} samples are fewer than a window's {samples}")
    first = [np.ascontiguousarray(a[:samples]) for a in (reference.t_ns, reference.q, reference.dq, reference.tau)]
    bundle.set_reference(*first)
    return bundle


def reference_recording(setup: Setup, recordings: Sequence[Recording]) -> Recording:
    """The first recording long enough to be a bundle's reference; else the first of all."""
    samples = setup.reach * setup.observer.network_stride + 1
    return next((recording for recording in recordings if recording.samples >= samples), recordings[0])


def set_signal_ranges(
    bundle: _core.Bundle,
    recordings: Sequence[Recording],
    torque_limit_nm: Sequence[float] | np.ndarray | None = None,
    bounds: SignalBounds | None = None,
) -> None:
    """The ranges of the arm's signals, beyond which the monitor reports a fault.

    Args:
        recordings: free motion; the largest |tau| of each joint is kept, in the unit of the bundle's answers, or what
            the torque moved by while the encoder stood still, if that is larger: joints that were locked. An encoder
            that stands still while the torque moves by more is a fault.
        torque_limit_nm: what each drive can give at most, infinite where unknown; None: unknown throughout. A drive at
            its limit is a fault, since the drive no longer follows its command.
        bounds: physical bounds, None: none; samples beyond them are refused.
    """
    largest = np.max([np.abs(recording.tau).max(axis=0) for recording in recordings], axis=0)
    largest = np.maximum(largest, np.max([torque_at_rest(recording) for recording in recordings], axis=0))
    largest *= np.abs(bundle.observer.nm_per_unit or 1.0)
    bundle.largest_torque_nm = np.maximum(largest, LEAST_TORQUE_NM).tolist()
    bundle.torque_limit_nm = list(torque_limit_nm) if torque_limit_nm is not None else [float("inf")] * bundle.joints
    bounds = bounds or SignalBounds(*np.full((2, bundle.joints), np.inf))
    bundle.possible_torque_nm = np.maximum(bounds.torque_nm, bundle.largest_torque_nm).tolist()
    bundle.possible_speed_rad_s = bounds.speed_rad_s.tolist()
    bundle.rate_tolerance = rate_tolerance(recordings, bundle.observer)


def rate_tolerance(recordings: Sequence[Recording], observer: _core.ObserverSettings, refused: float = 0.02) -> float:
    """Share of the sample period by which a monitor lets the mean step of a second differ from it, 0.05 to 0.15.

    It is the largest difference in these recordings, so that a monitor takes motion like theirs.

    Raises:
        TrainingError: more than the share `refused` of a recording differs by more than the largest tolerance.
    """
    largest, most = _core.RATE_TOLERANCE_RANGE
    for recording in recordings:
        means = _core.mean_steps(observer.sample_period_ns, observer.network_stride, recording.t_ns)
        off = np.abs(means - 1)
        if (beyond := float((off > most).mean())) > refused:
            raise TrainingError(
                f"recording {recording.name}: over {beyond:.0%} of it the mean time between samples differs by more "
                f"than {most:.0%} from the sample period, {observer.sample_period_ns * 1e-6:.4g} ms; a monitor would "
                "reject that as a wrong rate: leave the recording out of split.json, or record it at one rate"
            )
        largest = max(largest, float(off.max()))
    return min(largest, most)


def torque_at_rest(recording: Recording) -> np.ndarray:
    """Largest change of each joint's torque while its encoder did not change, (n,)."""
    moved = np.zeros(len(recording.joints))
    for j, (q, tau) in enumerate(zip(recording.q.T, recording.tau.T, strict=True)):
        begins = np.flatnonzero(np.r_[True, q[1:] != q[:-1]])
        moved[j] = np.max(np.maximum.reduceat(tau, begins) - np.minimum.reduceat(tau, begins))
    return moved


def set_drift(bundle: _core.Bundle, fit: PriorFit, config: DriftConfig) -> None:
    """Let the bundle follow slow changes of friction and offset, within a share of the friction that the prior found at
    0.5 rad/s.

    No torque freezes it yet, because the limits are still unknown; see freeze_drift.
    """
    drift = _core.DriftSettings()
    drift.time_constant_s = config.time_constant_s
    size_nm = np.maximum(config.size_share * friction_nm(fit, 0.5), config.least_size_nm)
    drift.size_nm = size_nm.tolist()
    drift.rate_share_per_s = config.rate_share_per_s
    drift.freeze_s = config.freeze_s
    drift.friction_share = config.friction_share
    bundle.drift = drift


def freeze_drift(bundle: _core.Bundle, config: DriftConfig) -> None:
    """Stop the drift tracker during contacts; needs the bundle's limits."""
    bundle.drift.freeze_share = config.freeze_share
