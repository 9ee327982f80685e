"""A network that was trained in PyTorch: weights in the core's layout, their file, a training that begins with them."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np

from tauext import _core
from tauext.config import MOST_HIDDEN, TrainConfig, require
from tauext.errors import ConfigError
from tauext.files.plain_file import LARGEST_TEXT, read_bytes
from tauext.fit.network_training import ScaledNetwork, TrainedNetwork
from tauext.fit.training_set import Scaling, Setup
from tauext.train.paper_limits import set_limits
from tauext.train.preparation import TRAINING_ONLY, Start, TrainingRun

# --- PyTorch's LSTM of one layer and a linear head, in the layout of LstmShape.


CORE_ORDER = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "weight", "bias")
"""W_x (4H, F), W_h (4H, H) and b (4H) of the LSTM, with H rows for each of the gates i, f, g, o, in PyTorch as in the
core; then W_head (n, H) and b_head (n) of the head."""
SECOND_BIAS = "bias_hh_l0"
"""PyTorch has two biases a gate, and only their sum matters."""


def core_parameters(weights: Mapping[str, np.ndarray]) -> np.ndarray:
    """float32 vector in the layout of LstmShape, from arrays under PyTorch's names; both biases are added."""
    both = {"bias_ih_l0": weights["bias_ih_l0"] + weights[SECOND_BIAS]}
    ordered = [both.get(name, weights[name]) for name in CORE_ORDER]
    return np.concatenate([np.ravel(part) for part in ordered]).astype(np.float32)


# --- The file of a network that was trained elsewhere: FILE.npz of numpy.savez.


INPUT_SCALE, OUTPUT_SCALE, LIMIT = "input_scale", "output_scale_nm", "limit_nm"
LARGEST = 1e9
"""Largest weight and scale; the smallest scale is its inverse."""
MOST_KEYS = 12
"""Number of keys that a message lists."""
UNREADABLE: tuple[type[Exception], ...] = (BadZipFile, zlib.error, ArithmeticError, EOFError, LookupError, MemoryError)
UNREADABLE += (OSError, RuntimeError, SyntaxError, TypeError, ValueError)
"""Errors of zipfile and numpy on damaged, encrypted or pickled content."""


@dataclass(frozen=True)
class OwnNetwork(Start):
    """A trained network of recipe paper's structure: q(k), dq(k), dq(k-1), one LSTM layer, a linear head."""

    learns = False
    file: str
    """Name of its file."""
    sha256: str
    shape: _core.LstmShape
    parameters: np.ndarray  # float32, layout of LstmShape; dq(k-1) has the input factors of dq(k)
    scaling: Scaling
    limit_nm: np.ndarray | None  # (n,) the user's limits of |tau_ext|

    def settings(self, config: TrainConfig) -> TrainConfig:
        """The settings with the network's hidden units.

        Raises:
            ConfigError: another recipe than paper, or a setting that has no effect without a training.
        """
        require(
            config.recipe == "paper", "recipe", config.recipe, "paper with a given network, which has its structure"
        )
        default, hidden = TrainConfig(), self.shape.hidden
        for name in TRAINING_ONLY:
            value = getattr(config, name)
            require(value == getattr(default, name), name, value, "left out with a given network: nothing is trained")
        own = config.hidden in (default.hidden, hidden)
        require(own, "hidden", config.hidden, f"left out with a given network, which has {hidden}")
        constant = config.limits == "auto" and self.limit_nm is not None
        off = not constant or config.error_scale != "on"
        require(off, "error_scale", config.error_scale, "left out with limit_nm of a given network, which is constant")
        return replace(config, hidden=hidden)

    def begin(self, run: TrainingRun, setup: Setup) -> None:
        """Add which file it is; ConfigError: the network does not have one output for each joint."""
        if self.shape.outputs != len(run.joints):
            raise ConfigError(
                f"{self.file}: a network of {self.shape.outputs} joints; the recordings have {len(run.joints)}: "
                f"{', '.join(run.joints)}"
            )
        run.facts["network"] = {"file": self.file, "sha256": self.sha256, "hidden": self.shape.hidden}

    def network(self) -> ScaledNetwork:
        """The network, as if it had been trained in no step."""
        return ScaledNetwork(self.scaling, TrainedNetwork(self.shape, self.parameters, [], steps=0, seconds=0.0))

    def put_limits(self, run: TrainingRun, bundle: _core.Bundle, kind: str) -> tuple[str, dict] | None:
        """Set the user's limits, if there are some and the settings ask for no kind."""
        if self.limit_nm is None or run.config.limits != "auto":
            return None
        set_limits(bundle, np.tile(self.limit_nm, (2, 1)), run.config.alarm)
        words = f"thresholds are {LIMIT} of {self.file}, with no target false alarm rate"
        return words, {"sentence": words}


def load_network(path: Path) -> OwnNetwork:
    """Read the weights and scales of a network that was trained elsewhere.

    Args:
        path: FILE.npz with PyTorch's names, each behind any prefix: `weight_ih_l0` (4H, 3n), `weight_hh_l0` (4H, H),
            `bias_ih_l0` and `bias_hh_l0` (4H), and of the linear head `weight` (n, H) and `bias` (n). Without a prefix:
            `input_scale` (3n), divisors of q, dq and dq(k-1); `output_scale_nm` (n), factors of the output; optional
            `limit_nm` (n).

    Raises:
        ConfigError: the file is missing or no such file, or an array is missing, unknown, of a wrong shape or out of
            range.
    """
    try:
        raw = read_bytes(path)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file; network is the FILE.npz of a trained network") from error
    except OSError as error:
        raise ConfigError(f"{path}: not readable ({error})") from error
    arrays = named_arrays(path, read_arrays(path, raw))
    expect_shapes(path, arrays)
    for name, array in arrays.items():
        if name.endswith(("scale", "_nm")):
            expect_range(path, name, array, lambda x: (x >= 1 / LARGEST) & (x <= LARGEST), f"1e-9 to {LARGEST:.0e}")
        else:
            expect_range(path, name, array, lambda x: np.abs(x) <= LARGEST, f"a number within +-{LARGEST:.0e}")
    hidden, joints = arrays["weight_hh_l0"].shape[1], len(arrays["bias"])
    q, speed, speed_before = np.split(arrays[INPUT_SCALE], 3)
    # A bundle scales dq(k) and dq(k-1) alike, so the weights of dq(k-1) take the difference.
    weights = arrays | {"weight_ih_l0": arrays["weight_ih_l0"] * np.r_[np.ones(2 * joints), speed / speed_before]}
    return OwnNetwork(
        file=path.name,
        sha256=hashlib.sha256(raw).hexdigest(),
        shape=_core.LstmShape(3 * joints, hidden, joints),
        parameters=core_parameters(weights),
        scaling=Scaling((1 / np.r_[q, speed]).astype(np.float32), arrays[OUTPUT_SCALE]),
        limit_nm=arrays.get(LIMIT),
    )


def read_arrays(path: Path, raw: bytes) -> dict[str, np.ndarray]:
    """Arrays of an npz by key, without pickled objects; ConfigError where it is none."""
    try:
        with ZipFile(BytesIO(raw)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > LARGEST_TEXT:
            raise ValueError(f"its arrays have {size} bytes, more than {LARGEST_TEXT}")
        with np.load(BytesIO(raw), allow_pickle=False) as stored:
            return {name: np.asarray(stored[name]) for name in stored.files}
    except UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{path}: no file of numpy.savez with plain arrays ({reason})") from error


def named_arrays(path: Path, stored: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """float64 arrays under PyTorch's names without their prefix.

    Raises:
        ConfigError: a key is missing, unknown or there twice, or an array holds no numbers.
    """
    own = (INPUT_SCALE, OUTPUT_SCALE, LIMIT)
    there = ", ".join([*stored][:MOST_KEYS]) + (", ..." if len(stored) > MOST_KEYS else "")
    arrays: dict[str, np.ndarray] = {}
    known: set[str] = set()
    for name in (*CORE_ORDER, SECOND_BIAS, *own):
        keys = [key for key in stored if (key == name if name in own else key.endswith(name))]
        if not keys and name != LIMIT:
            what = f"'{name}'" if name in own else f"a key that ends in '{name}'"
            raise ConfigError(f"{path}: {what} is missing; the file has {there or 'no keys'}")
        if len(keys) > 1:
            raise ConfigError(f"{path}: {' and '.join(keys)} end in '{name}', must be one: one LSTM layer, one head")
        for key in keys:
            if stored[key].dtype.kind not in "fiu":
                raise ConfigError(f"{path}: {key} is of type {stored[key].dtype}, must be float32 or float64")
            arrays[name] = stored[key].astype(np.float64)
        known.update(keys)
    if unknown := [key for key in stored if key not in known]:
        raise ConfigError(
            f"{path}: {unknown[0]} is unknown; the network has one LSTM layer of one direction and a linear head: "
            f"{', '.join((*CORE_ORDER, SECOND_BIAS, *own))}"
        )
    return arrays


def expect_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ConfigError unless all arrays fit H of weight_hh_l0 and n of the head's bias."""
    W_h, bias = arrays["weight_hh_l0"], arrays["bias"]
    H, n = W_h.shape[-1] if W_h.ndim else 0, bias.size
    if not 1 <= H <= MOST_HIDDEN or n < 1:
        raise ConfigError(f"{path}: {H} hidden units and {n} joints, must be 1 to {MOST_HIDDEN} and at least 1")
    expected = {
        "weight_hh_l0": ("4H x H", (4 * H, H)),
        "bias": ("n", (n,)),
        "weight": ("n x H", (n, H)),
        "weight_ih_l0": ("4H x 3n", (4 * H, 3 * n)),
        "bias_ih_l0": ("4H", (4 * H,)),
        SECOND_BIAS: ("4H", (4 * H,)),
        INPUT_SCALE: ("3n", (3 * n,)),
        OUTPUT_SCALE: ("n", (n,)),
        LIMIT: ("n", (n,)),
    }
    for name, (rule, shape) in expected.items():
        if name in arrays and arrays[name].shape != shape:
            raise ConfigError(
                f"{path}: {name} has the shape {arrays[name].shape}, must be {shape}: {rule} with H = {H} hidden units "
                f"and n = {n} joints"
            )


def expect_range(
    path: Path, name: str, array: np.ndarray, holds: Callable[[np.ndarray], np.ndarray], rule: str
) -> None:
    """Raise ConfigError unless the rule holds for all elements; it does not hold for NaN."""
    wrong = np.argwhere(~holds(array))
    if len(wrong):
        at = tuple(wrong[0].tolist())
        raise ConfigError(f"{path}: {name}[{', '.join(map(str, at))}] = {array[at]:g} must be {rule}")
