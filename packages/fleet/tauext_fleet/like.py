"""What a training and a refit do with a fleet prior: a minute of an arm's own motion is then enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import PriorConfig, TrainConfig
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.coverage import CoverageConfig, CoverageFit, Motion
from tauext.fit.prior import bound_loads, branches_of
from tauext.fit.prior_terms import PriorFit
from tauext.fit.ridge import Regressors, gather, solved
from tauext.fit.temperature import with_temperature
from tauext.fit.training_set import Setup, with_presliding
from tauext.recipes import FULL_PRIOR
from tauext.train.error_scale import FEATURES, ErrorRows, blind_sigma, freeze_floor_nm
from tauext.train.paper_limits import set_limits
from tauext.train.preparation import Start, TrainingRun
from tauext_fleet.expected_friction import expectations, settings_with
from tauext_fleet.fleet_prior import ArmType, FleetErrors, FleetPrior, links_digest, load_fleet_prior
from tauext_fleet.map_regression import MapRegression


@dataclass(frozen=True)
class Like(Start):
    """The start of a training, and of a refit, from the fleet prior of the arm's type."""

    prior: FleetPrior

    def settings(self, config: TrainConfig) -> TrainConfig:
        """The settings with the fleet's observer gain, unless they have a number.

        Raises:
            ConfigError: the recipe has no prior that a fleet prior could replace.
        """
        if config.row.fit != FULL_PRIOR["fit"]:
            raise ConfigError(
                f"like: recipe = {config.recipe} must be tauext or prior, whose weights a fleet prior has"
            )
        if isinstance(config.observer.gain_per_s, int | float):
            return config
        return replace(config, observer=replace(config.observer, gain_per_s=self.prior.gain_per_s))

    def begin(self, run: TrainingRun, setup: Setup) -> None:
        """Add which prior it is; ConfigError: its arms are of another type."""
        self.prior.type.expect(arm_type(run, setup), "the fleet prior", run.name)
        errors = self.prior.errors
        judged = {} if errors is None else {"judged_hours": errors.hours, "judged_minutes": errors.minutes}
        run.facts["like"] = self.identity() | {"trust": self.prior.weights.trust} | judged
        run.facts["gain"] = {"chosen_per_s": setup.observer.gain_per_s, "reason": "the fleet prior's"}

    def identity(self) -> dict:
        """Facts that identify the fleet prior by content."""
        return {"sha256": self.prior.sha256, "arms": [one["name"] for one in self.prior.facts.get("arms", [])]}

    def fit(self, setup: Setup, recordings: Sequence[Recording], config: PriorConfig) -> PriorFit:
        """The most likely prior given this motion and the fleet; terms and widths are the fleet's.

        Every left-out fold is predicted from the fleet and the other folds.

        Args:
            setup: without a prior, of the fleet's type.

        Raises:
            TrainingError: no recording is longer than the observer's warm-up.
        """
        bent = with_presliding(setup, self.prior.widths_rad)
        regressors = Regressors(self.prior.own, corrected=bent.tree)
        found = gather(bent, recordings, regressors)
        period_s = 1e-9 * setup.observer.sample_period_ns * setup.observer.network_stride
        regression = MapRegression([problem for problem, _ in found], self.prior.weights, period_s)
        fit = solved(bent, regression, found, regressors)
        for settings in (fit.settings, *(one.settings for one in fit.left_out)):
            settings.branches = branches_of(settings)
        bound_loads(bent, recordings, fit)
        return with_temperature(bent, recordings, fit) if config.follow_temperature else fit

    def covered(self, fit: CoverageFit, setup: Setup, recordings: Sequence[Recording]) -> CoverageFit:
        """Motion that any arm of the fleet showed is familiar, too."""
        return fit if self.prior.coverage is None else seen_too(fit, self.prior.coverage, setup, recordings)

    def put_scale(self, run: TrainingRun, bundle: _core.Bundle, rows: ErrorRows) -> dict | None:
        """Set the fleet's error scale, adjusted to the size of this arm's errors."""
        errors = self.errors_for(run, bundle)
        if errors is None:
            return None
        found = sizes(rows, scale_settings(errors, np.ones(bundle.joints)))
        bundle.error_scale = scale_settings(errors, np.clip(found, LEAST_SIZE, None))
        blind_sigma(bundle)
        drift = run.config.drift
        if bundle.drift.time_constant_s > 0:
            seen = freeze_floor_nm(rows.error_nm, drift, rows.period_s)
            bundle.drift.freeze_floor_nm = np.maximum(
                drift.freeze_floor_share * np.array(bundle.drift.size_nm), seen
            ).tolist()
        by_joint = dict(zip(run.joints, found.round(4).tolist(), strict=True))
        loud = [f"{name} {value:.1f}" for name, value in by_joint.items() if value > LARGEST_SIZE]
        if loud:
            run.notes.append(
                f"errors are larger than the fleet's by {', '.join(loud)}: this arm differs from the others there, and "
                "its thresholds are raised as much"
            )
        return {"hours": rows.hours, "like": by_joint}

    def put_limits(self, run: TrainingRun, bundle: _core.Bundle, kind: str) -> tuple[str, dict] | None:
        """Set the fleet's limits in place of supported ones; returns their basis as text, and facts."""
        own = kind == "supported" or kind == "asked" and not run.given.calibration
        errors = self.errors_for(run, bundle) if own else None
        if errors is None:
            return None
        limits = np.array([errors.sliding_limit_nm, errors.near_stiction_limit_nm])
        contact = np.array([errors.contact_sliding_limit_nm, errors.contact_near_stiction_limit_nm])
        set_limits(bundle, limits, run.config.alarm, contact, (errors.hold_s, errors.contact_hold_s))
        words = (
            f"thresholds are those of {errors.arms} arms of this type that had {errors.minutes:g} min of their own and "
            f"the prior of the others, on {60 * errors.hours:.0f} min of the rest of their motion, and as large as "
            f"this arm's own errors beside theirs. {errors.facts['sentence']} They are "
            f"{errors.facts['arms_factor']:.2f} times that, so that none of these arms exceeded the thresholds that "
            "the others ask for."
        )
        return words, dict(errors.facts) | {"sentence": words, "like": True}

    def errors_for(self, run: TrainingRun, bundle: _core.Bundle) -> FleetErrors | None:
        """The fleet's errors for this arm; None: none, or limits are constants or follow from the arm's own errors."""
        if bundle.has_network or run.config.resolved().error_scale != "on":
            return None
        same = self.prior.gain_per_s == bundle.observer.gain_per_s
        return self.prior.errors if same and total_s(run.motion.uncut) < ENOUGH_S else None

    def expect_bundle(self, bundle: _core.Bundle) -> None:
        """Raise ConfigError for a refit if the fleet's joints differ, or none of its arms had several recordings."""
        theirs, own = self.prior.type.joints, tuple(link.joint_name for link in bundle.links)
        if theirs != own:
            raise ConfigError(
                f"like: joints = ({', '.join(theirs)}) of the fleet prior must be ({', '.join(own)}) as of the bundle"
            )
        if self.prior.days is None:
            raise ConfigError(
                "like: this fleet prior has differences between arms, not between days; make it from arms "
                "with two recordings or more each, from different times of the day"
            )

    def expected(self, found: _core.Refit) -> tuple[_core.RefitSettings, np.ndarray] | None:
        """Settings of a second refit, in which joints that hardly moved follow the others, and which do; None: none."""
        assert self.prior.days is not None  # see expect_bundle
        factor, error = np.array([one.coulomb for one in found.joints]).T
        moved_s = np.array([one.moved_s for one in found.joints])
        told = expectations(factor, error, moved_s, self.prior.days.covariance)
        return None if told is None else (settings_with(*told), told[2])


def load_like(path: Path) -> Like:
    """Read the file of `tauext train --like` and `refit --like`; see load_fleet_prior."""
    return Like(load_fleet_prior(path))


# --- Arms of one type.


def arm_type(run: TrainingRun, setup: Setup) -> ArmType:
    """Properties that a fleet's arms must share with this one."""
    training = run.training[0]
    return ArmType(
        joints=run.joints,
        case=run.given.case.name,
        rate_hz=round(float(training.rate_hz), 3),
        network_stride=setup.observer.network_stride,
        torque_timing=training.torque_timing,
        units=units_of(run),
        links=links_digest(run.tree),
    )


def units_of(run: TrainingRun) -> tuple[str, ...]:
    """Unit of each joint's torque in the prior: newton metres, or this arm's own unit."""
    if run.constants is None:
        return (run.units.given.name,) * len(run.joints)
    relative = run.units.relative_to >= 0
    return tuple("its own unit" if one or relative else "newton_metre" for one in run.constants.unknown)


def seen_too(
    fit: CoverageFit, others: _core.CoverageSettings, setup: Setup, recordings: Sequence[Recording]
) -> CoverageFit:
    """The fit with the motion of other arms of the type, whose cells and reaches it takes over.

    A fleet prior's pose holds for one more arm of the type, though this one never was there.
    """
    motion = Motion.of(recordings, setup.observer.network_stride)
    both = _core.CoverageSettings()
    for name in ("turns", "centre_rad", "span_rad", "seen", "reach", "seen_together", "reach_together"):
        setattr(both, name, getattr(others, name))
    own = np.maximum(motion.lasting.max(axis=0), CoverageConfig.least_speed_rad_s)
    both.fastest_rad_s = np.maximum(own, others.fastest_rad_s).tolist()
    both.see(motion.q)
    return CoverageFit(both, fit.left_out_share)


# --- Limits of an arm with a minute of its own motion, from the errors of a fleet's arms.
#
# Each arm of the fleet was fitted to a minute of its own with the prior of the others and evaluated on the rest of its
# motion. Errors, limits and their growth with the motion apply to another arm of the type up to a factor, its size: a
# joint's held-out errors on its own minute, divided by the prediction of the fleet's scale.


ENOUGH_S = 540.0
"""Time of motion from which an arm's own errors determine limits better than the fleet's, [s]. From this time on, short
recordings need no friction reserve either."""
LEAST_SIZE, LARGEST_SIZE = 0.5, 2.0
"""Bounds of an arm's errors relative to the fleet's: a minute cannot prove smaller ones; larger ones are reported."""


def sizes(rows: ErrorRows, scale: _core.ErrorScaleSettings) -> np.ndarray:
    """Ratio of each joint's errors to the scale's prediction for the same motion, (n,)."""
    used = [FEATURES.index(kind) for kind in scale.features]
    F, n = rows.features[:, :, used], rows.error_nm.shape[1]
    sliding, near = (
        np.einsum("rjf,jf->rj", F, np.array(w).reshape(n, -1)) for w in (scale.sigma_weights, scale.sigma_near_weights)
    )
    sigma = np.where(rows.near_stiction, near, sliding)
    return np.sqrt(np.mean(rows.error_nm**2, axis=0) / np.maximum(np.mean(sigma**2, axis=0), 1e-300))


def scale_settings(errors: FleetErrors, size: np.ndarray) -> _core.ErrorScaleSettings:
    """The fleet's error scale for an arm with this size of errors relative to the fleet's, (n,)."""
    scale = _core.ErrorScaleSettings()
    scale.features = [getattr(_core.MotionFeature, name) for name in errors.features]
    by_joint = size[:, None]
    scale.limit_weights = (by_joint * errors.limit_weights).ravel().tolist()
    scale.sigma_weights = (by_joint * errors.sigma_weights).ravel().tolist()
    scale.sigma_near_weights = (by_joint * errors.sigma_near_weights).ravel().tolist()
    scale.largest = (size * errors.largest).tolist()
    scale.largest_sigma = (size * errors.largest_sigma).tolist()
    return scale
