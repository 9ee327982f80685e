"""The monitor's state in diagnostic_msgs: what stands, in words, and the numbers behind it."""

from __future__ import annotations

import math

from tauext import _core
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.causes import MEANING, in_words
from tauext.monitor.changes import ALARMS, COLLISION, FAULT, NONE
from tauext.monitor.changes import OK as HEALTHY
from tauext.monitor.changes import STALE as HEALTH_STALE
from tauext.monitor.sink import LoopReport, Verdict
from tauext.monitor.unfamiliar import WORTH_TELLING, unseen_words
from tauext.sources.messages import ERROR, OK, STALE, WARN, DiagnosticStatus, KeyValue

TORQUES = (
    ("tau_ext_nm", "tau_ext"),
    ("sigma_nm", "sigma_nm"),
    ("contact_sigma_nm", "contact_sigma_nm"),
    ("limit_nm", "limit_nm"),
    ("contact_limit_nm", "contact_limit_nm"),
    ("margin_nm", "margin_nm"),
)
"""Of `tauext: arm`, a joint, and what of the verdict holds them."""


def arm_status(verdict: Verdict | None, joints: tuple[str, ...], hardware_id: str) -> DiagnosticStatus:
    """Alarm, health and its causes, and per joint the torque, its standard error, its limits and the margin
    (to a collision), [N m] or what the bundle answers in.

    Level: ERROR for a collision or a fault, STALE while no sample comes, WARN for a contact, while warming up, where a
    joint's drift stands at its bound and while the motion is none that training saw, else OK. A collision outranks
    everything.
    """
    status = DiagnosticStatus(STALE, "tauext: arm", "no sample yet", hardware_id)
    if verdict is None:
        return status
    said = verdict.said
    health, alarm = int(said["health"][0]), int(said["alarm"][0])
    causes = _core.cause_names(int(said["causes"][0]))
    drifted = [name for name, at_bound in zip(joints, said["drift_saturated"][0], strict=True) if at_bound]
    texts = []
    if alarm != NONE:
        joint = int(said["alarm_joint"][0])
        texts.append(ALARMS[alarm] + (f" on {joints[joint]}" if joint >= 0 else ""))
    if health != HEALTHY:
        texts.append(f"{HEALTHS[health]}: {in_words(causes)}" if causes else HEALTHS[health])
    if drifted:
        texts.append(f"drift at its bound on {', '.join(drifted)}: record and train anew")
    unfamiliar = float(said["unfamiliar"][0])
    if unfamiliar >= WORTH_TELLING:
        what, joint, other = (int(said[key][0]) for key in ("unseen", "unseen_joint", "unseen_other"))
        texts.append(f"training never saw such motion: {unseen_words((what, joint, other), joints)}")
    status.message = "; ".join(texts) or "ok"
    if alarm == COLLISION:
        status.level = ERROR
    elif verdict.sample is None or health == HEALTH_STALE:
        status.level = STALE
    elif health == FAULT:
        status.level = ERROR
    else:
        status.level = WARN if texts else OK
    status.values = [
        KeyValue("alarm", ALARMS[alarm]),
        KeyValue("health", HEALTHS[health]),
        KeyValue("unfamiliar", number(unfamiliar)),
        *(KeyValue(f"cause: {cause}", MEANING[cause]) for cause in causes),
        *(
            KeyValue(f"{name} {joint}", number(value))
            for name, key in TORQUES
            for joint, value in zip(joints, said[key][0].tolist(), strict=True)
        ),
    ]
    return status


def input_status(
    report: LoopReport | None, before: LoopReport | None, standing: list[str], hardware_id: str
) -> DiagnosticStatus:
    """Rate, samples that were lost, late or refused, time of a tick, and what stands wrong with the input, in words.

    Level: STALE while no sample comes, WARN where something stands wrong or samples were lost since the report before,
    else OK.
    """
    status = DiagnosticStatus(STALE, "tauext: input", "; ".join(standing) or "no report yet", hardware_id)
    if report is None:
        return status
    counts = report.counts
    lost = counts.lost + counts.overrun - (before.counts.lost + before.counts.overrun if before else 0)
    texts = ([f"{lost} samples lost in the last second"] if lost else []) + standing
    if report.rate_hz > 0:
        status.level = WARN if texts else OK
    elif not texts:
        texts.append("no sample in the last second")
    status.message = "; ".join(texts) or "ok"
    status.values = [
        KeyValue("rate_hz", number(report.rate_hz)),
        KeyValue("samples", str(report.samples)),
        KeyValue("received", str(counts.received)),
        KeyValue("lost", str(counts.lost + counts.overrun)),
        KeyValue("late", str(report.missing)),
        KeyValue("refused", str(counts.refused)),
        KeyValue("tick_p50_us", number(report.tick_p50_us)),
        KeyValue("tick_p99_us", number(report.tick_p99_us)),
        KeyValue("tick_max_us", number(report.tick_max_us)),
        KeyValue("profile", report.profile),
    ]
    return status


def number(value: float) -> str:
    """Four digits; - where there is none."""
    return f"{value:.4g}" if math.isfinite(value) else "-"
