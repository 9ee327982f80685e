"""Whether limits hold just after an exchange of bundles, on an arm whose friction differs from that of training.

    python benchmarks/exchange_friction.py [--seconds 210]

The virtual rig. Two bundles of recipe prior are trained on 2 and on 4 minutes of motion. The first monitors a rig whose
friction is off from the start. After 2.5 minutes the second is asked for. Printed: when it took over with this quiet
time; false collisions within `seconds` after the request of the first one if it goes on, of the second one from when it
took over, and of the second one if it is started cold at the request. Sample time, no real time; takes minutes.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import COLLISION, arguments, head, table_row

from tauext import _core
from tauext.config import PAPER_CASES, TrainConfig
from tauext.data.recording import Recording
from tauext.files.places import place_of
from tauext.monitor.exchange import Ring, Successor
from tauext.sim.collect import simulate_recording
from tauext.sim.config import RigConfig
from tauext.sim.rig import arm_xml
from tauext.train.preparation import Given
from tauext.train.stage import train_on_recordings

PIECE_S, ASKED_S, ROWS = 30.0, 150.0, 500
SHARES = (1.0, 1.1, 1.2, 0.75, 0.6)
QUIET_S = (10.0, 50.0)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=210.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        old, new = (trained(Path(folder), pieces) for pieces in (4, 8))
    print("\n".join(head("friction | quiet time | took over after | own alarms until then | old goes on | new | cold")))
    for share in SHARES:
        for quiet_s in QUIET_S:
            cells = one(old, new, share, quiet_s, options.seconds)
            print(table_row(f"{share:.0%}", f"{quiet_s:g} s", *cells), flush=True)


def rig(share: float) -> RigConfig:
    """The rig with this share of its friction."""
    names = ("coulomb_nm", "static_nm", "viscous_nm_s_rad")
    joints = [replace(f, **{name: share * getattr(f, name) for name in names}) for f in RigConfig().friction]
    return replace(RigConfig(), friction=tuple(joints))


def trained(folder: Path, pieces: int) -> _core.Bundle:
    robot = folder / "robot.xml"
    robot.write_text(arm_xml(RigConfig()))
    recordings: list[Recording] = [simulate_recording(rig(1.0), "free", PIECE_S, 7, k) for k in range(pieces)]
    path = folder / f"of{pieces}.tauext"
    given = Given(place_of(robot), PAPER_CASES["exact"], recordings)
    train_on_recordings(given, TrainConfig(recipe="prior"), place_of(path))
    return _core.Bundle.load(str(path))


def one(old_bundle: _core.Bundle, new_bundle: _core.Bundle, share: float, quiet_s: float, seconds: float) -> list[str]:
    """The cells of one row, without its first two."""
    ring, old, cold = Ring(2, 1_000_000), _core.Monitor(old_bundle), _core.Monitor(new_bundle)
    successor: Successor | None = None
    took_s: float | None = None
    begun = {"old": 0, "new": 0, "cold": 0}
    over = dict.fromkeys(begun, False)
    t_s, model = 0.0, old_bundle.model_digest
    for number in range(round((ASKED_S + seconds) / PIECE_S)):
        recording = simulate_recording(rig(share), "free", PIECE_S, 9, number)
        stamps = recording.t_ns - recording.t_ns[0] + round(number * (PIECE_S + 1) * 1e9)
        for first in range(0, len(stamps), ROWS):
            t_s = number * PIECE_S + first * 1e-3
            if t_s == ASKED_S:
                successor = Successor(new_bundle, ring, False, None, quiet_s)
            if first % (2 * ROWS) == 0:
                ring.mark(old.carried(), model)
            rows = slice(first, first + ROWS)
            signals = [np.ascontiguousarray(x[rows]) for x in (stamps, recording.q, recording.dq, recording.tau)]
            monitors = {"old": old} | ({"cold": cold} if successor else {})
            if successor and took_s is not None:
                monitors["new"] = successor.monitor
            held = {name: monitor.run(*signals)["held_alarm"] for name, monitor in monitors.items()}
            for k, t_ns in enumerate(signals[0].tolist()):
                ring.add(t_ns, signals[1][k], signals[2][k], signals[3][k], None, int(held["old"][k]))
            for name, levels in held.items() if successor else ():
                above = np.concatenate([[over[name]], levels >= COLLISION])
                begun[name] += int(np.count_nonzero(above[1:] & ~above[:-1]))
                over[name] = bool(above[-1])
            if successor and took_s is None:
                while successor.follow(10 * ROWS):
                    pass
                took_s = None if successor.why_not_yet() else t_s - ASKED_S
    assert successor is not None
    took = ["not", str(successor.alarms)] if took_s is None else [f"{took_s:g} s", str(successor.alarms)]
    return [*took, str(begun["old"]), "–" if took_s is None else str(begun["new"]), str(begun["cold"])]


if __name__ == "__main__":
    main()
