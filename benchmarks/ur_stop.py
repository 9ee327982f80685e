"""From a sample's reception to the stop of a UR arm, through a stand-in of its dashboard server in another process.

    python benchmarks/ur_stop.py [--seconds 60] [--core 1] [--priority 80]

The loop, its samples and its contacts are those of reaction.py: seven joints at 1 kHz, a contact about every second.
Each contact sends `stop` on a connection that was opened before. Reported: time until the stand-in has received the
command, and until the monitor has received the confirmation. Network, controller and the arm's braking come on top.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from common import ROOT, arguments
from reaction import Ticking, bundle_with_contacts

from tauext.monitor.latency import Latencies
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.reaction_file import Reaction
from tauext.monitor.reactions import Reactions, ReactionThread
from tauext.monitor.sink import Event
from tauext.sources.ur_dashboard import Dashboard

CONTROLLER = Path(ROOT) / "tests" / "made_ur.py"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--core", type=int, help="pin the loop and the thread that receives to this core")
    parser.add_argument("--priority", type=int, help="SCHED_FIFO for both")
    options = parser.parse_args()
    with subprocess.Popen([sys.executable, CONTROLLER], stdout=subprocess.PIPE, text=True) as controller:
        dashboard = Dashboard("127.0.0.1", int(controller.stdout.readline()))
        dashboard.check()
        received_ns, confirmed = [], Latencies()

        def stop(event: Event) -> None:
            dashboard.stop()
            received_ns.append(event.received_ns)
            confirmed.add(time.monotonic_ns() - event.received_ns)

        reactions = Reactions([ReactionThread(Reaction("stop", ("contact",), stop=True), stop)])
        settings = LoopSettings(core=options.core, priority=options.priority)
        loop = Loop(bundle_with_contacts(), Ticking(options.seconds), [], reactions, settings=settings)
        loop.note = print
        loop.run()
        reactions.end()
        controller.terminate()
        sent = Latencies()
        for at_ns, began_ns in zip(map(int, controller.stdout.read().split()), received_ns, strict=True):
            sent.add(at_ns - began_ns)
    print(f"{loop.samples:,} samples, {len(received_ns)} stops, {reactions.threads[0].count.failed} failed")
    print(f"sample to command at the controller  {sent.text()}")
    print(f"sample to confirmation               {confirmed.text()}")


if __name__ == "__main__":
    main()
