"""Which findings name a mutation."""

from __future__ import annotations

VELOCITY = ("velocity-unit", "velocity-mismatch", "velocity-sign", "velocity-delay")
EFFORT = ("effort-scale", "effort-motor-side", "effort-limit", "effort-gravity-compensated", "effort-external")
LOAD = ("payload-missing", "payload-absent", "effort-scale")
ONE_OF_MANY = ("odd-recording",)

FITTING: dict[tuple[str, str], tuple[str, ...]] = {
    ("factor", "q"): ("degrees", "position-limit", "joint-axis", "velocity-sign", "velocity-unit", "velocity-mismatch"),
    ("factor", "q-dq"): ("degrees", "position-limit", "joint-axis"),
    ("factor", "dq"): ("degrees", *VELOCITY),
    ("factor", "tau"): ("effort-sign", *EFFORT),
    ("amperes", "tau"): EFFORT,
    ("exchange", "q-dq-tau"): ("joint-order", "joint-axis", "position-limit"),
    ("exchange", "q"): ("joint-order", *VELOCITY),
    ("exchange", "dq"): ("joint-order", *VELOCITY),
    ("exchange", "tau"): ("joint-order",),
    ("spike", "q"): ("spike", "position-limit", "velocity-mismatch"),
    ("spike", "dq"): ("spike", "velocity-mismatch"),
    ("spike", "tau"): ("spike", "effort-limit", "contact-in-free-motion"),
    ("stuck", "q"): ("stuck", "velocity-mismatch"),
    ("stuck", "dq"): ("stuck", "velocity-mismatch"),
    ("stuck", "tau"): ("stuck", "contact-in-free-motion"),
    ("delay", "tau"): ("torque-delay",),
    ("delay", "dq"): ("velocity-delay", "velocity-mismatch"),
    ("time-unit", ""): ("time-unit", "velocity-unit", "velocity-mismatch", "clock-irregular", "clock-gaps"),
    ("zero", "q"): ("position-offset", "position-limit"),
    ("thinned", ""): ("clock-irregular", "clock-gaps"),
    ("load", "tau"): LOAD,
    ("donor", ""): (*LOAD, "effort-limit", "position-limit", "position-offset"),
    ("label", ""): ("contact-in-free-motion",),
}
"""By what is done and to which signals; "": whichever. One that tells an odd recording fits every mutation of some."""


def fits(what: str, signals: tuple[str, ...], code: str) -> bool:
    """Whether a finding of this code names the mutation."""
    head = what.split("-")[0] if what.startswith(("label-", "donor-")) else what
    codes = FITTING.get((head, "-".join(signals))) or FITTING[head, ""]
    return code in codes or code in ONE_OF_MANY
