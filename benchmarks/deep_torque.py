"""The deep-torque network of the field on the recordings of so101_sim.py: an LSTM predicts the motor's signal.

    python benchmarks/deep_torque.py OUT [--rate 50] [--signal load current] [--inputs goal motion] [--steps 1000]

It has two layers. It sees position, speed and goal minus position (`goal`), or the first two alone (`motion`), and is
trained on the takes of ten minutes, of which the last fifth is held out; what the signal is beyond its prediction
counts as contact. Writes OUT/RATEhz/deep-SIGNAL-INPUTS/TAKE.npz: signal and prediction, (samples, joints), of every
take beside the training, and what is held out. Needs PyTorch, which tauext itself does not.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from torch import nn

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SIGNALS = {"load": "load", "current": "current"}
HELD_OUT = 0.2
"""Of the training, at the end of each take: limits come from here."""
SEQUENCE_S, BATCH, HIDDEN, RATE = 2.5, 16, 32, 5e-3
FORGOTTEN_S = 0.7
"""At the start of a sequence, where the loss does not count."""


class Deep(nn.Module):
    """Two layers of an LSTM and a linear one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(inputs, HIDDEN, num_layers=2, batch_first=True)
        self.out = nn.Linear(HIDDEN, outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:  # (B, T, F)
        return self.out(self.lstm(x)[0])


def read(path: Path, signal: str, inputs: str) -> tuple[np.ndarray, np.ndarray]:
    """What the network sees and what it is to say, (samples, ...), of one take."""
    table = pq.read_table(path)

    def of(name: str) -> np.ndarray:
        return np.column_stack([table[f"{name}_{joint}"].to_numpy() for joint in JOINTS])

    seen = [of("position"), of("speed")] + ([of("goal") - of("position")] if inputs == "goal" else [])
    return np.hstack(seen), of(SIGNALS[signal])


def train(takes: list[tuple[np.ndarray, np.ndarray]], rate_hz: int, steps: int) -> tuple[Deep, np.ndarray, np.ndarray]:
    """The network, and the scales of its inputs and outputs: rows of means and standard deviations."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    x_all, y_all = (np.concatenate(part) for part in zip(*takes, strict=True))
    of_x, of_y = (np.array([part.mean(axis=0), part.std(axis=0) + 1e-9]) for part in (x_all, y_all))
    scaled = [(_scaled(x, of_x), _scaled(y, of_y)) for x, y in takes]
    length, skip = round(SEQUENCE_S * rate_hz), round(FORGOTTEN_S * rate_hz)
    network = Deep(x_all.shape[1], y_all.shape[1])
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        picked = []
        for _ in range(BATCH):
            x, y = scaled[rng.integers(len(scaled))]
            at = rng.integers(len(x) - length)
            picked.append((x[at : at + length], y[at : at + length]))
        x, y = (torch.stack(part) for part in zip(*picked, strict=True))
        loss = nn.functional.mse_loss(network(x)[:, skip:], y[:, skip:])
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            print(f"step {step}: {loss.item():.4f} of the signal's variance", flush=True)
    return network, of_x, of_y


def _scaled(values: np.ndarray, by: np.ndarray) -> torch.Tensor:
    return torch.tensor((values - by[0]) / by[1], dtype=torch.float32)


def predict(network: Deep, of_x: np.ndarray, of_y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Sample by sample from the first on, as in a loop."""
    with torch.no_grad():
        said = network(_scaled(x, of_x)[None])[0].numpy()
    return said * of_y[1] + of_y[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rate", type=int, default=50)
    parser.add_argument("--signal", nargs="+", choices=tuple(SIGNALS), default=["load", "current"])
    parser.add_argument("--inputs", nargs="+", choices=["goal", "motion"], default=["goal", "motion"])
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = options.out / f"{options.rate}hz"
    for signal in options.signal:
        for inputs in options.inputs:
            kept = folder / f"deep-{signal}-{inputs}"
            training = [read(folder / f"train-{k}.parquet", signal, inputs) for k in (1, 2)]
            whole = [round((1 - HELD_OUT) * len(x)) for x, _ in training]
            network, *scales = train(
                [(x[:n], y[:n]) for (x, y), n in zip(training, whole, strict=True)], options.rate, options.steps
            )
            kept.mkdir(parents=True, exist_ok=True)
            said = [predict(network, *scales, x) for x, _ in training]
            parts = [(y[n:], p[n:]) for (_, y), p, n in zip(training, said, whole, strict=True)]
            y, p = (np.concatenate(part) for part in zip(*parts, strict=True))
            np.savez_compressed(kept / "held-out.npz", signal=y, prediction=p)
            print(f"{kept.name}: {np.sqrt(np.mean((y - p) ** 2, axis=0)).round(4)} held out", flush=True)
            for path in sorted(folder.glob("*.parquet")):
                if not path.stem.startswith("train"):
                    x, y = read(path, signal, inputs)
                    np.savez_compressed(kept / f"{path.stem}.npz", signal=y, prediction=predict(network, *scales, x))


if __name__ == "__main__":
    main()
