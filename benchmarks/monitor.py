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
What is not installed is left out: pip install 'tauext[bench]' brings ONNX Runtime, 'tauext[torch]' PyTorch.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, compiler_flags, other_processes_s

from tauext import __version__
from tauext.files.provenance import machine

TOLERANCE = 1e-5
"""Of outputs, scaled: each library has its own sigmoid, tanh and order of additions."""
OPSET, IR_VERSION = 17, 8
"""Old enough for every ONNX Runtime that 'tauext[bench]' allows."""
PRIORITY = 80
WARM_UP_CALLS = 200
ESTIMATE_P50_US = {2: 1.0, 7: 1.5}
ESTIMATE_P99_9_US, BOTH_P50_US = 10.0, 12.0
ANSWER_RATIO, BOTH_RATIO = 100.0, 3.0

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=ROOT / "build/cpp/monitor_bench", help="default: %(default)s")
    parser.add_argument("--joints", type=int, nargs="+", default=[2, 7], help="default: 2 7")
    parser.add_argument("--steps", type=int, default=1_000_000, help="samples back to back in a round (%(default)s)")
    parser.add_argument("--paced-s", type=float, default=10.0, help="seconds of the paced loop; 0: none (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of everything (%(default)s)")
    parser.add_argument("--calls", type=int, default=20_000, help="of each library in a round (%(default)s)")
    parser.add_argument("--arms", nargs="+", choices=("rig", "seven"), default=[], help="trained bundles as well")
    parser.add_argument("--out", type=Path, help="folder of --arms' bundles")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every number of every round")
    options = parser.parse_args()
    if min(options.rounds, options.steps, options.calls) < 1 or options.paced_s < 0:
        parser.error("--rounds, --steps and --calls must be at least 1, --paced-s at least 0")
    if options.arms and not options.out:
        parser.error("--arms needs --out, a folder for bundles")
    if not os.access(options.bench, os.X_OK):
        parser.error(f"there is no {options.bench}: make build")

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # the core that monitor_bench takes, too
    libraries = {"ONNX Runtime": onnx_runtime(), "PyTorch": pytorch()}
    about = {
        "machine": machine(), "python": platform.python_version(), "numpy": np.__version__, "tauext": __version__,
        "flags": compiler_flags(),
    }  # fmt: skip
    print(f"{about['machine']}, Python {about['python']}, NumPy {about['numpy']}")
    print(f"tauext {__version__}: {about['flags']}, instruction set chosen at run time")
    for name, library in libraries.items():
        print(f"{name} {library.version}" if isinstance(library, Library) else f"{name}: {library}")
    print(f"{options.rounds} rounds in turns; a round: {options.steps} samples, {options.calls} calls of a library\n")

    results = {}
    before = other_processes_s()
    for joints in options.joints:
        results[joints] = one_arm(joints, options, {n: x for n, x in libraries.items() if isinstance(x, Library)})
        show(joints, results[joints])
    trained = {arm: trained_arm(arm, options) for arm in options.arms}
    show_trained(trained)
    after = other_processes_s()
    others_s, stolen_s = (after[k] - before[k] for k in range(2))
    print(f"meanwhile other processes took {others_s:.1f} s of processor time and the host kept {stolen_s:.1f} s for")
    print("itself: both lengthen the tails")

    if options.json:
        versions = {n: x.version if isinstance(x, Library) else x for n, x in libraries.items()}
        run = {"steps": options.steps, "rounds": options.rounds, "calls": options.calls, "paced_s": options.paced_s}
        everything = {"machine": about, "libraries": versions, "run": run, "joints": results, "arms": trained}
        everything["meanwhile"] = {"others_s": others_s, "stolen_s": stolen_s}
        options.json.write_text(json.dumps(everything, indent=1) + "\n")


def one_arm(joints: int, options: argparse.Namespace, libraries: dict[str, Library]) -> dict:
    """Every way in turns; medians over the rounds, and what each round gave."""
    network = dumped(options.bench, joints)
    ways: dict[str, Way] = {}
    differences = {}
    for name, library in libraries.items():
        for how, way in library.ways(network).items():
            differences[how] = float(np.abs(way().reshape(-1) - network.answer).max())
            if not differences[how] <= TOLERANCE:
                sys.exit(f"{how}, {joints} joints: its output differs from the core's by {differences[how]:.1e}")
            ways[how] = way
        if library.empty_call:
            ways[f"{name}, empty graph"] = library.empty_call

    rounds: list[dict] = []
    for _ in range(options.rounds):
        core = core_says(options.bench, joints, options.steps, options.paced_s)
        rounds.append({"core": core, "libraries": {name: measured(way, options.calls) for name, way in ways.items()}})

    core = merged([one["core"] for one in rounds])
    times = {name: merged([one["libraries"][name] for one in rounds]) for name in ways}
    fastest = {}
    for name in libraries:
        of_library = [how for how in differences if how.startswith(name)]
        fastest[name] = min(of_library, key=lambda how: times[how]["p50_ns"])
    result = {"core": core, "libraries": times, "fastest": fastest, "differences": differences, "rounds": rounds}
    result["ratios"] = ratios(result)
    result["bounds"] = bounds(joints, result)
    return result


PARTS = {
    "monitor": "free motion",
    "contact": "contact",
    "weighing": "weighing",
    "expecting": "expecting a load",
    "paced": "paced",
}


def trained_arm(arm: str, options: argparse.Namespace) -> dict:
    """Every part of monitor_bench on a trained bundle; medians over the rounds."""
    from contact_errors import CASES, train
    from pushed_arms import practice_recording

    options.out.mkdir(parents=True, exist_ok=True)
    bundle, motion = train(arm, options.out), options.out / f"{arm}.f64"
    if not motion.exists():
        free = practice_recording(CASES[arm][0](), 60.0, 0, 50)  # not one of those that the bundle was trained on
        np.hstack([free.q, free.dq, free.tau]).astype("<f8").tofile(motion)
    words = (options.bench, 2, options.steps, options.paced_s, bundle, motion)
    return merged([core_says(*words) for _ in range(options.rounds)])


def show_trained(trained: dict[str, dict]) -> None:
    for arm, core in trained.items():
        print(f"trained bundle of {arm}, us{'':{max(0, 20 - len(arm))}}estimate p50     p99.9   advance p50     p99.9")
        for part, what in PARTS.items():
            if core[part]:
                times = (core[part][name][key] for name in ("estimate", "advance") for key in ("p50_ns", "p99_9_ns"))
                print(f"  {what:38}" + "".join(f"{ns / 1e3:12.2f}" for ns in times))
        print(flush=True)


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
        return "not installed, not measured (pip install 'tauext[bench]')"
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
        return "not installed, not measured (pip install 'tauext[torch]')"
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
    fifo = real_time(True)
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

    return {
        "count": calls,
        "mean_ns": float(ns.mean()),
        "p50_ns": quantile(0.5),
        "p99_ns": quantile(0.99),
        "p99_9_ns": quantile(0.999),
        "max_ns": int(ns[-1]),
        "over_deadline": int((ns > 1_000_000).sum()),
        "fifo": fifo,
    }


def real_time(wanted: bool) -> bool:
    """Whether this process now stands where it was wanted: in SCHED_FIFO or in the usual class."""
    try:
        policy, priority = (os.SCHED_FIFO, PRIORITY) if wanted else (os.SCHED_OTHER, 0)
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (AttributeError, OSError):
        return False
    return True


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


def ratios(result: dict) -> dict[str, dict[str, float]]:
    """Median time of each other way over ours: the network alone, like with like, and the whole monitor."""
    core = result["core"]
    ours = {
        "network answer": core["network"]["answer"],
        "network both": core["network"]["both"],
        "monitor estimate": core["monitor"]["estimate"],
        "monitor both": core["monitor"]["both"],
    }
    others = {name: result["libraries"][way]["p50_ns"] for name, way in result["fastest"].items()}
    empty = result["libraries"].get("ONNX Runtime, empty graph")
    if empty:
        others["ONNX Runtime less an empty graph"] = others["ONNX Runtime"] - empty["p50_ns"]
    others["recomputed window"] = core["recomputed_window"]["p50_ns"]
    return {name: {what: ns / times["p50_ns"] for what, times in ours.items()} for name, ns in others.items()}


def bounds(joints: int, result: dict) -> list[dict]:
    """What tauext promises of its time, and whether it held."""
    monitor, onnx = result["core"]["monitor"], result["ratios"].get("ONNX Runtime")
    found = []

    def expect(what: str, value: float | None, bound: float, at_least: bool = False) -> None:
        held = None if value is None else bool(value >= bound if at_least else value <= bound)
        found.append({"what": what, "value": value, "bound": bound, "at_least": at_least, "held": held})

    if joints in ESTIMATE_P50_US:
        expect("estimate() p50 [us]", monitor["estimate"]["p50_ns"] / 1e3, ESTIMATE_P50_US[joints])
    expect("estimate() p99.9 [us]", monitor["estimate"]["p99_9_ns"] / 1e3, ESTIMATE_P99_9_US)
    expect("estimate() and advance() p50 [us]", monitor["both"]["p50_ns"] / 1e3, BOTH_P50_US)
    expect("ONNX Runtime / network's answer", onnx and onnx["network answer"], ANSWER_RATIO, True)
    expect("ONNX Runtime / its answer and advance", onnx and onnx["network both"], BOTH_RATIO, True)
    return found


def show(joints: int, result: dict) -> None:
    core = result["core"]
    granted = [
        f"{what} {'yes' if core[key] else 'no'}"
        for what, key in (("SCHED_FIFO", "fifo"), ("memory locked", "memory_locked"))
    ]
    print(
        f"{joints} joints: F {core['inputs']}, H {core['hidden']}, {core['window_steps']} steps of {core['stride']} "
        f"samples of {core['sample_period_ns'] / 1e6:g} ms, {core['lanes']} lanes, compiler {core['compiler']}"
    )
    print(f"core {core['core']}, {', '.join(granted)}; reading the clock adds {core['clock']['p50_ns']:.0f} ns to each")
    print(f"{'us':42}{'p50':>9}{'p99':>9}{'p99.9':>9}{'max':>10}{'missed':>8}")

    def line(name: str, times: dict, note: str = "") -> None:
        numbers = "".join(f"{times[key] / 1e3:9.2f}" for key in ("p50_ns", "p99_ns", "p99_9_ns"))
        print(f"{name:42}{numbers}{times['max_ns'] / 1e3:10.1f}{times['over_deadline']:8}{note}")

    for name, part, first in (
        ("monitor", core["monitor"], "estimate"),
        ("network alone", core["network"], "answer"),
        ("monitor, network period", core["monitor_network_period"], "estimate"),
        ("monitor, paced", core["paced"], "estimate"),
    ):
        if part:
            line(f"{name}: {first}", part[first])
            line("  advance", part["advance"])
            line("  both", part["both"])
    if core["paced"]:
        line("  late wake-up", core["paced"]["wake_up_lateness"])
        late, left_out = core["paced"]["missed_deadlines"], core["paced"]["ticks_left_out"]
        print(f"  steps that ended after the next was due: {late}; ticks left out: {left_out}")
    line("window computed anew", core["recomputed_window"])
    for name, times in result["libraries"].items():
        difference = result["differences"].get(name)
        line(name, times, "" if difference is None else f"   differs by {difference:.0e}")
    unhealthy = [
        part["samples_not_ok"] for part in (core["monitor"], core["monitor_network_period"], core["paced"]) if part
    ]
    if any(unhealthy):
        print(f"health was not ok at {sum(unhealthy)} samples: these times are not those of the whole chain")

    columns = list(next(iter(result["ratios"].values())))
    print(f"\n{'p50 over our p50 of':42}" + "".join(f"{name:>18}" for name in columns))
    for name, values in result["ratios"].items():
        print(f"{name:42}" + "".join(f"{values[column]:18.1f}" for column in columns))
    print()
    for bound in result["bounds"]:
        sign = ">=" if bound["at_least"] else "<="
        value = "not measured" if bound["value"] is None else f"{bound['value']:.2f}"
        verdict = {True: "held", False: "MISSED", None: ""}[bound["held"]]
        print(f"{bound['what']:42}{value:>12} {sign} {bound['bound']:g}  {verdict}")
    print(flush=True)


if __name__ == "__main__":
    main()
