"""Time of the monitor at every sample beside ONNX Runtime and PyTorch on the same network and window.

    python benchmarks/monitor.py [--steps 1000000] [--paced-s 10] [--rounds 3] [--calls 20000] [--json FILE]
                                 [--arms rig seven --out OUT]

monitor_bench (make build) measures the monitor, its network alone, a window computed anew and a paced loop. ONNX
Runtime and PyTorch run the same weights on the same window, a batch of one, one thread, called from Python; that their
outputs equal the core's is checked first. Neither keeps a window's state from one sample to the next, and putting the
window together is not counted for them. Everything runs in turns on one core, in SCHED_FIFO where that is granted.
Of a number the median over the rounds is shown, of a maximum the largest and of missed deadlines the sum.
--arms: bundles as tauext train writes them (recipe prior, with error scale, coverage, settable load, forces, places) on
the simulated arms' own motion, also during a contact, while weighing and while a load is expected. OUT gets bundles and
motions, which a later run uses again.
What is not installed is left out: pip install onnx onnxruntime torch brings ONNX Runtime and PyTorch.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, about_run, arguments, compiler_flags, head, other_processes_s, save_json, table_row

TOLERANCE = 1e-5
"""Of outputs, scaled: each library has its own sigmoid, tanh and order of additions."""
OPSET, IR_VERSION = 17, 8
"""Old enough for every ONNX Runtime that the extra `bench` allows."""
PRIORITY = 80
WARM_UP_CALLS = 200
QUANTILES = ("p50_ns", "p99_ns", "p99_9_ns", "max_ns")
PARTS = {
    "monitor": ("monitor", "estimate"),
    "monitor, advance": ("monitor", "advance"),
    "monitor, both": ("monitor", "both"),
    "network alone": ("network", "answer"),
    "network alone, both": ("network", "both"),
    "monitor, paced": ("paced", "estimate"),
    "monitor, paced, advance": ("paced", "advance"),
}
"""Rows of what monitor_bench measures without optional parts."""
TRAINED_PARTS = {
    "monitor": "free motion",
    "contact": "contact",
    "weighing": "weighing",
    "expecting": "expecting a load",
    "paced": "paced",
}

Way = Callable[[], np.ndarray]


@dataclass
class Network:
    """The weights, one window and the core's answer, as monitor_bench writes them down."""

    inputs: int
    hidden: int
    outputs: int
    w_x: np.ndarray  # (4H, F); gates i, f, g, o
    w_h: np.ndarray  # (4H, H)
    b: np.ndarray  # (4H,)
    w_head: np.ndarray  # (outputs, H)
    b_head: np.ndarray  # (outputs,)
    window: np.ndarray  # (steps, F)
    answer: np.ndarray  # (outputs,)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--bench", type=Path, default=ROOT / "build/cpp/monitor_bench", help="default: %(default)s")
    parser.add_argument("--joints", type=int, nargs="+", default=[2, 7], help="default: 2 7")
    parser.add_argument("--steps", type=int, default=1_000_000, help="samples back to back in a round (%(default)s)")
    parser.add_argument("--paced-s", type=float, default=10.0, help="seconds of the paced loop; 0: none (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of everything (%(default)s)")
    parser.add_argument("--calls", type=int, default=20_000, help="of each library in a round (%(default)s)")
    parser.add_argument("--arms", nargs="+", choices=("rig", "seven"), default=[], help="trained bundles as well")
    parser.add_argument("--out", type=Path, help="folder of --arms' bundles")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every number")
    options = parser.parse_args()
    if min(options.rounds, options.steps, options.calls) < 1 or options.paced_s < 0:
        parser.error("--rounds, --steps and --calls must be at least 1, --paced-s at least 0")
    if options.arms and not options.out:
        parser.error("--arms needs --out, a folder for bundles")
    if not os.access(options.bench, os.X_OK):
        parser.error(f"there is no {options.bench}: make build")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # the core that monitor_bench takes, too
    found = {"ONNX Runtime": onnx_runtime(), "PyTorch": pytorch()}
    libraries = {name: one for name, one in found.items() if isinstance(one, Library)}
    print(f"{about_run()}; {compiler_flags()}")
    print("; ".join(f"{n} {x.version}" if isinstance(x, Library) else f"{n}: {x}" for n, x in found.items()))
    print(f"{options.rounds} rounds in turns of {options.steps} samples and {options.calls} calls of a library; us\n")
    before = other_processes_s()
    results = {joints: one_arm(joints, options, libraries) for joints in options.joints}
    trained = {arm: trained_arm(arm, options) for arm in options.arms}
    others_s, stolen_s = (after - b for after, b in zip(other_processes_s(), before, strict=True))
    print(f"\nmeanwhile other processes took {others_s:.1f} s of processor time, the host {stolen_s:.1f} s")
    if options.json:
        save_json({"about": about_run(), "joints": results, "arms": trained}, options.json)


def one_arm(joints: int, options: argparse.Namespace, libraries: dict[str, Library]) -> dict:
    """Every way in turns; medians over the rounds, printed as a table."""
    network = dumped(options.bench, joints)
    ways: dict[str, Way] = {}
    for name, library in libraries.items():
        for how, way in library.ways(network).items():
            difference = float(np.abs(way().reshape(-1) - network.answer).max())
            if not difference <= TOLERANCE:
                sys.exit(f"{how}, {joints} joints: its output differs from the core's by {difference:.1e}")
            ways[how] = way
        if library.empty_call:
            ways[f"{name}, empty graph"] = library.empty_call
    rounds: list[dict] = []
    for _ in range(options.rounds):
        core = core_says(options.bench, joints, options.steps, options.paced_s)
        rounds.append({"core": core} | {name: measured(way, options.calls) for name, way in ways.items()})
    found = merged(rounds)
    core = found["core"]
    rows = {name: core[part][what] for name, (part, what) in PARTS.items() if core[part]}
    rows |= {"window computed anew": core["recomputed_window"]} | {name: found[name] for name in ways}
    ours = rows["network alone"]["p50_ns"]
    print("\n".join(head(f"{joints} joints | p50 | p99 | p99.9 | max | p50 over the network's answer")))
    for name, times in rows.items():
        print(table_row(name, *(f"{times[key] / 1e3:.2f}" for key in QUANTILES), f"{times['p50_ns'] / ours:.1f}"))
    if unhealthy := sum(part["samples_not_ok"] for part in (core["monitor"], core["paced"]) if part):
        print(f"health was not ok at {unhealthy} samples: these times are not those of the whole chain")
    return found


def trained_arm(arm: str, options: argparse.Namespace) -> dict:
    """Every part of monitor_bench on a trained bundle; medians over the rounds, printed as a table."""
    from contact_errors import CASES, practice_recording, train

    options.out.mkdir(parents=True, exist_ok=True)
    bundle, motion = train(arm, options.out), options.out / f"{arm}.f64"
    if not motion.exists():
        free = practice_recording(CASES[arm][0](), 60.0, 0, 50)  # not one of those that the bundle was trained on
        np.hstack([free.q, free.dq, free.tau]).astype("<f8").tofile(motion)
    words = (options.bench, 2, options.steps, options.paced_s, bundle, motion)
    core = merged([core_says(*words) for _ in range(options.rounds)])
    print("\n".join(["", *head(f"trained bundle of {arm} | estimate p50 | p99.9 | advance p50 | p99.9")]))
    for part, what in TRAINED_PARTS.items():
        if core[part]:
            times = (core[part][name][key] for name in ("estimate", "advance") for key in ("p50_ns", "p99_9_ns"))
            print(table_row(what, *(f"{ns / 1e3:.2f}" for ns in times)))
    return core


def core_says(bench: Path, *arguments: object) -> dict:
    """What monitor_bench prints."""
    done = subprocess.run([str(bench), *map(str, arguments)], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{bench} ended with status {done.returncode}")
    return json.loads(done.stdout)


def dumped(bench: Path, joints: int) -> Network:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "network"
        size = core_says(bench, "--dump", file, joints)
        values = np.fromfile(file, np.dtype("<f4"))
    f, h, o, steps = size["inputs"], size["hidden"], size["outputs"], size["window_steps"]
    shapes = [(4 * h, f), (4 * h, h), (4 * h,), (o, h), (o,), (steps, f), (o,)]
    ends = np.cumsum([np.prod(shape) for shape in shapes])
    if ends[-1] != len(values):
        sys.exit(f"{bench} wrote {len(values)} values where {ends[-1]} belong")
    parts = [part.reshape(shape) for part, shape in zip(np.split(values, ends[:-1]), shapes, strict=True)]
    return Network(f, h, o, *parts)


@dataclass
class Library:
    """Another library that runs the network."""

    version: str
    ways: Callable[[Network], dict[str, Way]]
    """Each way to run one window, by name; names begin with the library's."""
    empty_call: Way | None = None
    """A call that computes nothing."""


def onnx_runtime() -> Library | str:
    try:
        onnx, ort = importlib.import_module("onnx"), importlib.import_module("onnxruntime")
    except ImportError:
        return "not installed, not measured (pip install onnx onnxruntime)"
    helper, numpy_helper = importlib.import_module("onnx.helper"), importlib.import_module("onnx.numpy_helper")

    def session_of(nodes: list, weights: dict[str, np.ndarray], x: tuple, y: tuple) -> object:
        kind = onnx.TensorProto.FLOAT
        inputs, outputs = ([helper.make_tensor_value_info(*named)] for named in (("x", kind, x), ("y", kind, y)))
        arrays = [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in weights.items()]
        graph = helper.make_graph(nodes, "network", inputs, outputs, arrays)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        settings = ort.SessionOptions()
        settings.intra_op_num_threads = settings.inter_op_num_threads = 1
        settings.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        settings.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
        return ort.InferenceSession(model.SerializeToString(), settings, providers=["CPUExecutionProvider"])

    def ways(network: Network) -> dict[str, Way]:
        (steps, f), h, o = network.window.shape, network.hidden, network.outputs
        b = to_onnx_gates(network.b)
        nodes = [
            helper.make_node("LSTM", ["x", "W", "R", "B"], ["", "last"], hidden_size=h),
            helper.make_node("Reshape", ["last", "flat"], ["row"]),
            helper.make_node("Gemm", ["row", "W_head", "b_head"], ["y"], transB=1),
        ]
        weights = {"W": to_onnx_gates(network.w_x)[None], "R": to_onnx_gates(network.w_h)[None]}
        weights |= {"B": np.concatenate([b, np.zeros_like(b)])[None]}  # of the input and of the recurrence
        weights |= {"flat": np.array([1, h], np.int64), "W_head": network.w_head, "b_head": network.b_head}
        session = session_of(nodes, weights, (steps, 1, f), (1, o))
        x, y = np.ascontiguousarray(network.window[:, None]), np.zeros((1, o), np.float32)
        binding = session.io_binding()
        binding.bind_input("x", "cpu", 0, np.float32, x.shape, x.ctypes.data)
        binding.bind_output("y", "cpu", 0, np.float32, y.shape, y.ctypes.data)

        def bound() -> np.ndarray:
            session.run_with_iobinding(binding)
            return y

        bound.keep = x  # the binding knows its address alone
        return {"ONNX Runtime, run": lambda: session.run(["y"], {"x": x})[0], "ONNX Runtime, bound": bound}

    empty, one = session_of([helper.make_node("Identity", ["x"], ["y"])], {}, (1,), (1,)), np.zeros(1, np.float32)
    return Library(ort.__version__, ways, lambda: empty.run(["y"], {"x": one})[0])


def to_onnx_gates(rows: np.ndarray) -> np.ndarray:
    """From i, f, g, o to ONNX's i, o, f, c."""
    i, f, g, o = np.split(rows, 4)
    return np.concatenate([i, o, f, g])


def pytorch() -> Library | str:
    try:
        torch = importlib.import_module("torch")
    except ImportError:
        return "not installed, not measured (pip install torch)"
    torch.set_num_threads(1)

    def ways(network: Network) -> dict[str, Way]:
        lstm = torch.nn.LSTM(network.inputs, network.hidden)
        head = torch.nn.Linear(network.hidden, network.outputs)
        values = (network.w_x, network.w_h, network.b, np.zeros_like(network.b), network.w_head, network.b_head)
        with torch.no_grad():
            for parameter, value in zip([*lstm.parameters(), *head.parameters()], values, strict=True):
                parameter.copy_(torch.from_numpy(np.array(value)))
        window = torch.from_numpy(np.array(network.window[:, None]))

        def eager() -> np.ndarray:
            with torch.inference_mode():
                return head(lstm(window)[1][0][0]).numpy()

        return {"PyTorch, eager": eager}

    return Library(torch.__version__, ways)


def measured(way: Way, calls: int) -> dict[str, float]:
    """Times of single calls, as monitor_bench takes and sums them up; without the garbage collector."""
    ns = np.zeros(WARM_UP_CALLS + calls, np.int64)
    clock = time.perf_counter_ns
    real_time(True)
    gc.disable()
    breath = clock()
    for k in range(len(ns)):
        start = clock()
        way()
        end = clock()
        ns[k] = end - start
        if end - breath > 50_000_000:  # the kernel stops a FIFO thread that never sleeps
            time.sleep(0.005)
            breath = clock()
    gc.enable()
    real_time(False)
    ns = np.sort(ns[WARM_UP_CALLS:])

    def quantile(p: float) -> int:
        return int(ns[max(1, int(np.ceil(p * calls))) - 1])

    return {"p50_ns": quantile(0.5), "p99_ns": quantile(0.99), "p99_9_ns": quantile(0.999), "max_ns": int(ns[-1])}


def real_time(wanted: bool) -> None:
    """Put this process into SCHED_FIFO, where that is granted, or back into the usual class."""
    try:
        policy, priority = (os.SCHED_FIFO, PRIORITY) if wanted else (os.SCHED_OTHER, 0)
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (AttributeError, OSError):
        pass


def merged(rounds: list) -> object:
    """One for several of the same form: the median of a number, the largest maximum, the sum of what was counted."""
    first = rounds[0]
    if isinstance(first, dict):
        out = {}
        for key in first:
            values = [one[key] for one in rounds]
            if key == "max_ns":
                out[key] = max(values)
            elif key in ("over_deadline", "missed_deadlines", "ticks_left_out", "samples_not_ok"):
                out[key] = sum(values)
            else:
                out[key] = merged(values)
        return out
    if isinstance(first, bool):
        return all(rounds)
    if isinstance(first, str) or all(one == first for one in rounds):
        return first
    return statistics.median(rounds)


if __name__ == "__main__":
    main()
