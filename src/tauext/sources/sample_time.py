"""Time of samples from their stamps, where the stamps can be used; else from their reception."""

from __future__ import annotations

JUMP_NS = 1_000_000_000
"""A stamp that departs by more than this from the times of reception tells of a clock that was set."""


class SampleTime:
    """Adds up steps: each from one stamp to the next or, where these contradict reception, by reception.

    While stamps are good, time equals the stamp, and delays of the network do not enter. A clock that is set, forward
    or back, costs one step by reception, and time goes on from there; without stamps every step is one by reception.
    Where both samples came at once, that step is as long as the one before it.
    A sample that bears the stamp of the one before it gets the same time, for the caller to leave out.
    """

    def __init__(self) -> None:
        self._t_ns = self._stamp_ns = self._received_ns = self._step_ns = 0
        self._begun = False

    def next(self, stamp_ns: int, received_ns: int, wall_ns: int, follows: bool = True) -> tuple[int, str | None]:
        """Time of the next sample, [ns], and what was wrong with its stamp.

        Args:
            stamp_ns: of the message; 0 where it bears none.
            received_ns: by a clock that is never set.
            wall_ns: at reception, since 1970: where time begins without stamps.
            follows: False for the first sample of another publisher, whose stamps may be by another clock.
        """
        wrong, step_ns = None, stamp_ns - self._stamp_ns
        by_reception_ns = received_ns - self._received_ns
        if stamp_ns == 0:
            wrong = "there are no stamps: times of reception are used"
        elif self._begun and follows and self._stamp_ns:
            if step_ns == 0:
                return self._t_ns, "two messages bear the same stamp: the second is left out"
            if step_ns < 0:
                wrong = f"the stamp went back by {-step_ns / 1e9:.3g} s: the time of reception is used"
            elif step_ns - by_reception_ns > JUMP_NS:
                wrong = f"the stamp jumped ahead by {step_ns / 1e9:.3g} s: the time of reception is used"
        if not self._begun:
            self._t_ns = stamp_ns or wall_ns
        elif wrong or not follows or not self._stamp_ns:
            self._step_ns = by_reception_ns or self._step_ns
            self._t_ns += self._step_ns
        else:
            self._step_ns = step_ns
            self._t_ns += step_ns
        self._begun, self._stamp_ns, self._received_ns = True, stamp_ns, received_ns
        return self._t_ns, wrong
