"""Time and accuracy of a training step and of an evaluation beside PyTorch's on the same threads.

    python benchmarks/train.py [--rounds 9] [--quick]

Step: gradient and Adam for 1000 windows of 100 steps. The core gathers its windows from the rows within the measured
time, and so does tauext's own PyTorch backend; plain torch.nn.LSTM and torch.optim.Adam have them ready. Evaluation:
every window of ten minutes at 100 Hz, read from rows. Everything runs in turns in one process. A turn begins with a
pause, since PyTorch's threads spin for a while after their work, and with a run that is not counted. Without PyTorch
only tauext is measured.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from common import about_run, arguments, compiler_flags, head, table_row

from tauext import _core
from tauext.errors import ConfigError
from tauext.fit.core_backend import Adam, CoreBackend
from tauext.fit.training_set import Setup, WindowSet

try:
    from tauext_lab import torch_backend

    torch, why_not = torch_backend.torch, ""
except ConfigError as error:
    torch, why_not = None, str(error)

STEPS, HIDDEN, BATCH = 100, 20, 1000
CORE, BACKEND = "tauext", "tauext, backend torch"

Way = Callable[[], object]


@dataclass
class Comparison:
    """What is measured in turns."""

    name: str
    threads: int
    ways: dict[str, Way]
    accuracy: dict[str, tuple[float | None, float | None]]  # of outputs (absolute) and gradient (relative)
    runs: int  # in a turn


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="two rounds and one minute of recording")
    options = parser.parse_args()
    rounds, windows = (2, 6_000) if options.quick else (options.rounds, 60_000)
    print(f"{about_run()}; {compiler_flags()}, instruction set chosen at run time")
    print(f"PyTorch {torch.__version__} on the CPU" if torch else f"PyTorch is not measured: {why_not}")
    print(f"H = {HIDDEN}, {rounds} rounds in turns; largest difference of outputs to double precision\n")
    print("\n".join(head("task | threads | way | ms, median | min | max | ratio | outputs, gradient")))
    for threads in (1, 2):
        for joints in (2, 7):
            show(step_comparison(joints, threads), rounds)
        show(evaluation_comparison(windows, threads), rounds)


def step_comparison(joints: int, threads: int) -> Comparison:
    """Gradient and Adam, from rows and window ends to new parameters."""
    setup, windows = made_windows(joints, 30_000)
    ends = np.random.default_rng(1).choice(windows.ends, BATCH, replace=False)
    core = CoreBackend(setup, windows, HIDDEN, STEPS, targets=1, threads=threads)
    start = core.initial_parameters(0).astype(np.float32)
    ways: dict[str, Way] = {CORE: in_the_loop(core, ends)}
    accuracy = {}
    if torch:
        x, y = written_out(setup, windows, ends), windows.target_rows[ends]
        exact = double_precision(core.shape, start, x, y)
        own = torch_backend.TorchBackend(torch_backend.lstm_module(setup, HIDDEN, 0), setup, windows, STEPS, targets=1)
        ways["PyTorch"], result = pytorch_step(core.shape, start, x, y)
        accuracy["PyTorch"] = differences(result, exact)
        ways[BACKEND] = in_the_loop(own, ends)
        for name, backend in ((CORE, core), (BACKEND, own)):
            result = backend.predict(start, windows, ends), backend.gradient(start, ends)[1]
            accuracy[name] = differences(result, exact)
    name = f"step: {BATCH} x {STEPS}, F {len(setup.inputs)}, {joints} outputs"
    return Comparison(name, threads, ways, accuracy, runs=10)


def evaluation_comparison(count: int, threads: int) -> Comparison:
    """Output of windows that end at every row of a recording."""
    setup, windows = made_windows(2, count)
    core = CoreBackend(setup, windows, HIDDEN, STEPS, targets=1, threads=threads)
    start = core.initial_parameters(0).astype(np.float32)
    ways: dict[str, Way] = {CORE: lambda: core.predict(start, windows, windows.ends)}
    accuracy = {}
    if torch:
        some = windows.ends[:: max(1, count // BATCH)]
        exact = double_precision(core.shape, start, written_out(setup, windows, some), windows.target_rows[some])[0]
        own = torch_backend.TorchBackend(torch_backend.lstm_module(setup, HIDDEN, 0), setup, windows, STEPS, targets=1)
        ways["PyTorch"] = pytorch_evaluation(core.shape, start, setup, windows)
        ways[BACKEND] = lambda: own.predict(start, windows, windows.ends)
        for name, way in ways.items():
            accuracy[name] = differences((way()[:: max(1, count // BATCH)], None), (exact, None))
    return Comparison(f"evaluation: {count} windows x {STEPS}, F 6", threads, ways, accuracy, runs=1)


def made_windows(joints: int, count: int) -> tuple[Setup, WindowSet]:
    """Random rows at the network period and every window that ends in them; the setup lends its inputs alone."""
    links = []
    for k in range(joints):
        link = _core.Link()
        link.joint_name, link.parent, link.rotation = f"joint{k + 1}", k - 1, [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
        links.append(link)
    observer = _core.ObserverSettings(
        gain_per_s=20.0, timing=_core.TorqueTiming.held, sample_period_ns=10_000_000, network_stride=1
    )
    setup = Setup(_core.Tree(links, [0, 0, -9.81]), observer, STEPS)
    rng = np.random.default_rng(joints)
    rows = rng.uniform(-1, 1, (count + setup.reach, 2 * joints)).astype(np.float32)
    targets = rng.uniform(-1, 1, (len(rows), joints)).astype(np.float32)
    ends = np.arange(setup.reach, len(rows), dtype=np.int64)
    return setup, WindowSet(rows, targets, ends, np.zeros_like(ends))


def written_out(setup: Setup, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
    """The windows that end at these rows: (N, T, F)."""
    steps = ends[:, None] + np.arange(1 - STEPS, 1)
    return np.stack([windows.rows[steps - lag, column] for column, lag in setup.inputs], axis=-1)


def in_the_loop(backend: CoreBackend | torch_backend.TorchBackend, ends: np.ndarray) -> Way:
    """A step as tauext's training loop makes it."""
    parameters = backend.initial_parameters(0)
    at = [(parameters, Adam.start(len(parameters)))]

    def step() -> None:
        parameters, adam = at[0]
        _, gradient = backend.gradient(parameters.astype(np.float32), ends)
        at[0] = adam.step(parameters, gradient, 0.001)

    return step


def pytorch_step(
    shape: _core.LstmShape, parameters: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[Way, tuple[np.ndarray, np.ndarray]]:
    """A step as one writes it with PyTorch, its windows and targets ready; and its first output and gradient."""
    lstm, head = torch_backend.lstm_from_parameters(shape, parameters)
    lstm.batch_first = False  # faster
    windows, targets = torch.from_numpy(x).transpose(0, 1).contiguous(), torch.from_numpy(y)
    trained = torch_backend.in_core_order(lstm, head)
    optimiser = torch.optim.Adam(trained, lr=0.001, fused=True)

    def backward() -> torch.Tensor:
        optimiser.zero_grad()
        output = head(lstm(windows)[0][-1])
        torch.nn.functional.mse_loss(output, targets).backward()
        return output

    def step() -> None:
        backward()
        optimiser.step()

    first = backward().detach().numpy()
    return step, (first, torch_backend.flat([p.grad for p in trained]).numpy())


def pytorch_evaluation(shape: _core.LstmShape, parameters: np.ndarray, setup: Setup, windows: WindowSet) -> Way:
    """All windows of the rows, 4000 at once, time first, as a view into the rows."""
    lstm, head = torch_backend.lstm_from_parameters(shape, parameters)
    lstm.batch_first = False
    inputs = np.stack([np.roll(windows.rows[:, column], lag) for column, lag in setup.inputs], axis=-1)
    rows = torch.from_numpy(inputs)

    def evaluate() -> np.ndarray:
        view = rows[setup.reach - STEPS + 1 :].unfold(0, STEPS, 1).permute(2, 0, 1)  # (T, N, F)
        with torch.no_grad():
            return torch.cat([head(lstm(x)[0][-1]) for x in view.split(4000, dim=1)]).numpy()

    return evaluate


def double_precision(
    shape: _core.LstmShape, parameters: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Output and gradient of PyTorch in double precision."""
    lstm, head = (part.double() for part in torch_backend.lstm_from_parameters(shape, parameters))
    output = head(lstm(torch.from_numpy(x).double())[0][:, -1])
    torch.nn.functional.mse_loss(output, torch.from_numpy(y).double()).backward()
    gradient = torch_backend.flat([p.grad for p in torch_backend.in_core_order(lstm, head)])
    return output.detach().numpy(), gradient.numpy()


def differences(result: tuple, exact: tuple) -> tuple[float | None, float | None]:
    gradient = None if exact[1] is None else np.linalg.norm(result[1] - exact[1]) / np.linalg.norm(exact[1])
    return np.abs(result[0] - exact[0]).max(), gradient


def show(comparison: Comparison, rounds: int) -> None:
    """Measure the ways in turns and print a line for each."""
    times: dict[str, list[float]] = {name: [] for name in comparison.ways}
    if torch:
        torch.set_num_threads(comparison.threads)
    for _ in range(rounds):
        for name, way in comparison.ways.items():
            time.sleep(0.1)
            way()
            for _ in range(comparison.runs):
                start = time.perf_counter()
                way()
                times[name].append(1e3 * (time.perf_counter() - start))
    medians = {name: statistics.median(ms) for name, ms in times.items()}
    for name in times:
        numbers = (f"{ms:.2f}" for ms in (medians[name], min(times[name]), max(times[name])))
        accuracy = ", ".join("-" if a is None else f"{a:.0e}" for a in comparison.accuracy.get(name, (None, None)))
        ratio = f"{medians[name] / medians[CORE]:.1f}"
        print(table_row(comparison.name, comparison.threads, name, *numbers, ratio, accuracy), flush=True)


if __name__ == "__main__":
    main()
