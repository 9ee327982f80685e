"""A network behind a prior ships only where it helps."""

from __future__ import annotations

from tauext._core import Bundle
from tauext.fit.gate import apply_gate
from tauext.fit.prior_fit import PriorFit
from tauext.fit.training_set import Setup
from tauext.train.fitting import fit_prior, with_fit
from tauext.train.network import assemble
from tauext.train.preparation import Job


def gate(job: Job, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> tuple[Bundle, PriorFit | None]:
    """Shut the network off for joints that it does not help; the bundle that ships, and its prior.

    Where no network is left of one that validated on motion cut off from the training, the prior is fitted to all of
    it in the end.

    Args:
        setup: without the prior.
    """
    if bundle.has_network:
        gate = apply_gate(bundle, job.motion.validation, job.config.gate_margin, job.threads)
        job.facts["gate"] = {name: gate.reason(j, job.config.gate_margin) for j, name in enumerate(job.joints)}
    if bundle.has_network or not job.motion.network or job.validation:
        return bundle, fit
    fit = fit_prior(job, setup, job.motion.uncut)
    job.notes.append("no joint has a network, so the prior was fitted to all of the motion in the end")
    return assemble(job, with_fit(setup, fit)), fit
