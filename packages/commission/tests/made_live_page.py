"""A stand-in for the loop behind a live page: its two sockets, and a folder as `tauext commission` leaves it.

python tests/made_live_page.py STATE PORT [ARM]   shows one; STATE is one of STATES, ARM rig, seven or none
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import math
import socket
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from made_bundles import watching_bundle
from tauext_commission import journal

from tauext.data.labels import Label

STATES = ("connecting", "learning", "monitoring", "alarm", "answered", "unanswered", "question", "silent", "lost",
          "partly", "blind")  # fmt: skip
JOINTS = {
    "rig": ("joint1", "joint2"),
    "seven": tuple(f"joint{i + 1}" for i in range(7)),
    "none": (
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ),
}
SENTENCE = "Touched at joint2, 28 to 42 N"
DETAILS = "COLLISION, a push on the link of joint2: 12.4 Nm at joint2, threshold 5.6 Nm"
SHARES = {"partly": (0.972, 1), "blind": (0.613, 2)}
"""Share of the last minute that was monitored, and its level."""


def now(ago_s: float = 0.0) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() - ago_s))


LOST = (
    "journal: at least 12 confirmed lines are lost; nothing is trained before `tauext commission --out cell7 --repair`"
)


def line(state: str, joints: tuple[str, ...], t_s: float) -> dict:
    """A line of the loop in this state."""
    n = len(joints)
    bundle = None if state in ("connecting", "learning") else "b0004"
    q = [(0.5 + 0.1 * j) * math.sin(0.6 * t_s + j) + (0.6 if j % 2 else 0.1) for j in range(n)]
    values = (lambda x: [round(one, 4) for one in x]) if bundle else (lambda x: [None] * n)
    sigma, limit = [0.25 + 0.05 * j for j in range(n)], [6.1 - 0.5 * j for j in range(n)]

    def point(age_s: float, wide: bool = False) -> list:
        """A point of the curves; a push 5 s before the start, and no estimate for a second before it."""
        at_s = t_s - age_s
        if not bundle or -8 < at_s < -7 or (state == "blind" and math.sin(3 * at_s) > 0.6):
            return [round(1000 * age_s), *[[]] * (4 if wide else 1)]
        tau = [0.4 * math.sin(1.7 * at_s + 2 * j) + 0.1 * math.sin(9 * at_s + j) for j in range(n)]
        if state in ("alarm", "answered", "unanswered") and n > 1:
            tau[1] += 12.4 * math.exp(-(((at_s + 5) / 0.3) ** 2))
            tau[0] += 45 * math.exp(-(((at_s + 5) / 0.2) ** 2))
        rest = [values(sigma), values(limit), values([one / 2 for one in limit])] if wide else []
        return [round(1000 * age_s), values(tau), *rest]

    share, level = SHARES.get(state, (0.9993, 0))
    words = f"only {100 * share:.1f} % of the last minute was monitored: samples came late or not at all; close other "
    words += "programs, or start with --core 1 --priority 50"
    alarm = {
        "id": 17,
        "level": "collision",
        "joint": joints[1],
        "touch": "push",
        "links": [[joints[1], 0.91]],
        "newtons": 34.0,
        "place": {"link": 1, "point": [0.05, 0.1, 0.2], "force": [30.0, 10.0, -12.0], "q": q},
        "sentence": SENTENCE,
        "details": DETAILS,
        "answer": "touched" if state == "answered" else None,
    }
    return {
        "format": 1,
        "t_ns": round(t_s * 1e9),
        "wall": now(),
        "state": "asking" if state in ("alarm", "question") else state if not bundle else "monitoring",
        "message": LOST
        if state == "journal"
        else ""
        if bundle
        else "learning: 40 s more motion until the first training",
        "lost": "no sample for 12 s; connecting again" if state == "lost" else "",
        "bundle": bundle,
        "joints": list(joints),
        "units": ["N m"] * n,
        "q": q,
        "tau_ext": point(0.0)[1] or [None] * n,
        "sigma": values(sigma),
        "limit": values(limit),
        "contact_limit": values([one / 2 for one in limit]),
        "trace": [point(0.025 * k) for k in (3, 2, 1, 0)],
        "past": [point(0.1 * k, wide=True) for k in range(199, -1, -1)],
        "monitored": {"minute": share, "hour": share, "level": level,
                      "words": (words.upper() if level == 2 else words) if level else ""},
        "near_stiction": [False] * n,
        "health": "ok" if bundle else "warming up",
        "causes": [],
        "alarm": alarm if state in ("alarm", "answered") else None,
        "rate_hz": 1000.0,
        "tick_p99_us": 61.0,
    }  # fmt: skip


LIMITS = {
    "promise": {"asked": {"rate_per_hour": 0.125}, "supported": False, "supported_budget": {"rate_per_hour": 60 / 2.25},
                "calibration_hours": 7 / 60},
    "extrapolated": {"per_hour": 0.125, "between_per_hour": [1 / 60, 1.2], "probability": 0.9, "hours": 7 / 60},
    "sentence": "Limits are set for 1 in 8 h.",
    "budgets": [
        {"text": "1 in 8 h", "per_hour": 0.125, "between_per_hour": [1 / 60, 1.2], "share_of_limits": 1.0,
         "push_n": {"end of the arm": 45.2, "forearm": 118.0}},
        {"text": "1 in 1 h", "per_hour": 1.0, "between_per_hour": [0.3, 4.0], "share_of_limits": 0.8,
         "push_n": {"end of the arm": 36.2, "forearm": 94.4}},
        {"text": "1 in 10 minutes", "per_hour": 6.0, "between_per_hour": [2.0, 12.0], "share_of_limits": 0.6,
         "push_n": {"end of the arm": 27.1, "forearm": 70.8}},
    ],
}  # fmt: skip
"""Facts of the limits of b0004."""


def write_limits(folder: Path, bundle: str = "b0004", limits: dict = LIMITS) -> None:
    """A bundle of the folder whose limits have these facts."""
    made = watching_bundle()
    made.name, made.provenance = bundle, json.dumps({"limits": limits})
    (folder / "bundles").mkdir(exist_ok=True)
    made.save(str(folder / "bundles" / f"{bundle}.tauext"))


def write_folder(folder: Path, state: str, arm: str = "rig") -> None:
    """Files of this state."""
    joints = JOINTS[arm]
    folder.mkdir(parents=True, exist_ok=True)
    if arm != "none":
        from tauext_lab.sim.arms import ARMS

        from tauext.robot.capsules import write_shapes

        (folder / "robot.xml").write_text(ARMS[arm]().xml)
        write_shapes(folder / "robot.xml", folder)
    source = "ur:192.168.0.7" if arm == "none" else f"sim:{arm}"
    facts = {"format": 1, "journal": 0, "source": source, "arm": {"joints": list(joints)}, "state": state}
    write(folder, "commission.json", facts if state != "connecting" else facts | {"arm": None})
    if state == "connecting":
        words = "the torque of elbow_joint has the wrong sign: gravity pulls the other way"
        found = [
            {"severity": "fault", "code": "sign", "joint": "elbow_joint", "words": words, "waits": False,
             "remedy": 'set direction = -1 for it in arm.toml, or correct the driver'},
            {"severity": "good", "code": "rate", "joint": None, "waits": False, "words": "500 samples a second",
             "remedy": ""},
            {"severity": "note", "code": "scale", "joint": None, "waits": True, "remedy": "run the arm's program",
             "words": "whether the torque is in N m cannot be judged until the arm moves"},
        ]  # fmt: skip
        write(folder, "findings.json", {"findings": found})
        return
    lacks = [["never moved faster than 0.3 rad/s; let it make a long fast move"], [], ["never reversed at low speed"]]
    cover = [
        {"joint": name, "speed": 0.3 + 0.1 * j, "reversals": [14 - j, 12 - j], "positions": 0.8 - 0.08 * j,
         "rest_s": 4.0 * j, "missing": lacks[j] if j < 3 else []}
        for j, name in enumerate(joints)
    ]  # fmt: skip
    early = state == "learning"
    write(folder, "coverage.json", {
        "seconds": 80.0, "kept_s": 80.0 if early else 3700.0, "dropped_s": 0.0 if early else 5200.0, "bytes": 1.2e8,
        "bytes_most": 5e9, "needs_s": 40.0, "joints": cover,
    })  # fmt: skip
    if early:
        write(folder, "trainer.json", {"doing": "training b0001 on 1 min of motion"})
        return
    lines = []
    for k in range(4):
        error = [round((0.5 - 0.08 * k) * (1 + 0.2 * j), 3) for j in range(len(joints))]
        lines.append({
            "kind": "training", "wall": now(4000 - 900 * k), "seconds": 60.0 * 2**k, "bundle": f"b000{k + 1}",
            "words": f"b000{k + 1} was trained on {2**k} min of motion", "minutes": 2.0**k, "passed": k != 1,
            "why": "" if k != 1 else "on unused motion it raised 3 collisions in 1.2 min", "joints": list(joints),
            "error": error, "units": ["N m"] * len(joints), "hits": 0.71 + 0.06 * k, "per_hour": 0.4 / (k + 1),
        })  # fmt: skip
    write_limits(folder)
    for k, (hours, spread, alarms) in enumerate([(0.3, 30, 0), (1, 20, 1), (3, 9, 1), (8, 4, 0), (24, 2.5, 9)]):
        sentence = f"Set for one false alarm in 8 h, extrapolated from {hours:g} h."
        counted = f"Counted: {alarms} false alarms in {hours:g} h."
        lines.append({
            "kind": "promise", "wall": now(3000 - 500 * k), "seconds": 3600.0 * hours, "bundle": "b0004",
            "words": f"{sentence} {counted}", "sentence": sentence, "promised_per_hour": 0.125,
            "between_per_hour": [0.125 / spread, 0.125 * spread], "proved_per_hour": 3 / hours,
            "hours": hours, "alarms": alarms, "kept": k != 4,
        })  # fmt: skip
    lines.append({
        "kind": "activation", "wall": now(1000), "seconds": 900.0, "bundle": "b0004", "words": "b0004 is chosen",
    })  # fmt: skip
    for one in lines:
        journal.append(folder, one["kind"], one)
    events = [
        {"id": 15, "wall": now(5000), "level": "contact", "joint": joints[0], "answer": "nothing", "by": "page",
         "sentence": "Touched at joint1, 5 to 8 N", "details": "Contact on the link of joint1", "t_ns": 0,
         "flight": None},
        {"id": 16, "wall": now(90), "level": "collision", "joint": joints[1], "t_ns": 3_000_000_000,
         "sentence": SENTENCE, "details": DETAILS, "answer": None if state == "unanswered" else "touched",
         "flight": "sim-3.000s-collision.parquet"},
    ]  # fmt: skip
    if state == "alarm":
        events.append(events[1] | {"id": 17, "wall": now(2), "answer": None})
    for one in events:
        journal.append(folder, "event", one)
        if one["answer"]:
            label = Label(one["id"], 1, one["t_ns"], one["t_ns"], one["answer"], "page", one["wall"])
            journal.append(folder, "label", asdict(label))
    write_trace(folder / "flights" / "sim-3.000s-collision.estimates.parquet", joints)
    if state == "question":
        words = "The tool of joint7 seems 0.8 kg heavier than yesterday. Shall the monitor learn this?"
        journal.append(folder, "step", {"words": words, "wall": now(30), "seconds": 900.0})


def write_trace(path: Path, joints: tuple[str, ...]) -> None:
    from tauext.bundle.estimates import Estimates, save_estimates

    t = np.arange(6000) * 1e-3
    ones = np.ones((len(t), len(joints)), dtype=np.float32)
    tau = (0.3 * np.sin(2 * t[:, None] + np.arange(len(joints)))).astype(np.float32)
    tau[:, 1] += 12 * np.exp(-(((t - 3.1) / 0.1) ** 2))
    flat = np.zeros(len(t), dtype=np.int8)
    path.parent.mkdir(exist_ok=True)
    save_estimates(
        Estimates(
            joints, (t * 1e9).astype(np.int64), tau, ones * 0, tau, ones * 6, ones < 0, flat + 1,
            flat.astype(np.uint32), flat > 0, flat, flat, sigma_nm=ones * 0.3, contact_sigma_nm=ones * 0.4,
            contact_limit_nm=ones * 3, alarm=flat,
        ),
        path,
    )  # fmt: skip


def write(folder: Path, name: str, content: dict) -> None:
    (folder / name).write_text(json.dumps(content))


class FakeLoop:
    """Both sockets in a folder: sends lines of the state, and keeps the control lines that it receives."""

    def __init__(self, folder: Path, state: str, arm: str = "rig", period_s: float = 0.1):
        self.state, self.arm, self.received = state, arm, []
        self.answer = "ok"
        self.live, self.control = folder / "live.sock", folder / "control.sock"
        self._period_s, self._closed = period_s, threading.Event()
        self._sockets = [self._listen(self.live, self._send), self._listen(self.control, self._obey)]

    def close(self) -> None:
        self._closed.set()
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts
            one.close()

    def _listen(self, path: Path, serve) -> socket.socket:
        path.unlink(missing_ok=True)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listening.bind(str(path))
        listening.listen()

        def work() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=serve, args=(listening.accept()[0],), daemon=True).start()

        threading.Thread(target=work, daemon=True).start()
        return listening

    def _send(self, wire: socket.socket) -> None:
        began = time.monotonic()
        with contextlib.suppress(OSError), wire:
            while not self._closed.is_set():
                if self.state != "silent" or time.monotonic() < began + 0.5:
                    shown = line(self.state, JOINTS[self.arm], time.monotonic() - began)
                    wire.sendall(json.dumps(shown).encode() + b"\n")
                self._closed.wait(self._period_s)

    def _obey(self, wire: socket.socket) -> None:
        with contextlib.suppress(OSError), wire, wire.makefile("r") as lines:
            for one in lines:
                self.received.append(one.strip())
                wire.sendall(self.answer.encode() + b"\n")


@contextlib.contextmanager
def serving(host, port, *arguments):
    """A page's server in a thread, see tauext_commission.page.live_server.Server; gives its port."""
    from tauext_commission.page.live_server import Server

    server, end = Server(host, socket.create_server((host, port)), *arguments), []

    async def run() -> None:
        serving = asyncio.create_task(server.run())
        end.append(functools.partial(asyncio.get_running_loop().call_soon_threadsafe, serving.cancel))
        with contextlib.suppress(asyncio.CancelledError):
            await serving

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    try:
        yield server.port
    finally:
        end[0]()
        thread.join()


def main() -> None:
    import tempfile

    state, port, arm = sys.argv[1], int(sys.argv[2]), (sys.argv[3:] or ["rig"])[0]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "cell7"
        write_folder(folder, state, arm)
        loop = FakeLoop(folder, state, arm)
        with serving("127.0.0.1", port, folder, loop.live, loop.control, ""):
            threading.Event().wait()


if __name__ == "__main__":
    main()
