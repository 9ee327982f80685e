"""A made-up dataset and results folder in the real formats, true of no robot; and the command as tests run it."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.signal import lfilter
from tauext_lab.evaluate.collisions import TouchMeasures, choose_ten, find_collisions
from tauext_lab.evaluate.comparison import BundleMeasures
from tauext_lab.evaluate.errors import sensor_reference
from tauext_lab.evaluate.free_motion import sanity_detectors
from tauext_lab.evaluate.results import LinkProbability, Results, TouchEstimate, to_json

from tauext.bundle.estimates import COLLISION, OK, WARMING_UP, Estimates, save_estimates
from tauext.cli import main
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.files.provenance import write_json

RATE_HZ = 1000
WARM_S = 1.5
NEAR_STICTION_RAD_S = 0.02
MODEL_ERROR_NM = {"exact": 0.0, "mass": 28.0, "com": 18.0, "mass+com": 38.0, "none": 55.0}
BUNDLES = tuple(MODEL_ERROR_NM)
SEVEN_BUNDLES = ("none-paper", "exact-paper", *BUNDLES)
STEPS = {"paper": 189_000, "dense": 20_000}


def make_results(
    folder: Path,
    joints: int = 2,
    bundles: Sequence[str] = BUNDLES,
    seconds: float = 40.0,
    test_recordings: int = 2,
    collision_recordings: int = 2,
    scale: str | None = "quick",
    seed: int = 0,
    error_scale: bool = False,
) -> tuple[Path, Path]:
    """Write `folder/data` and `folder/results`; returns (results, data). Twelve collisions or so in each 60 s."""
    rng = np.random.default_rng(seed)
    data, results = folder / "data", folder / "results"
    data.mkdir(parents=True)
    free = [make_recording(f"free-{k:03d}", joints, seconds, False, rng) for k in range(test_recordings)]
    touched = [make_recording(f"collisions-{k:03d}", joints, seconds, True, rng) for k in range(collision_recordings)]
    for recording in free + touched:
        save_recording(recording, data / f"{recording.name}.parquet")
    others = [f"free-{k:03d}.parquet" for k in range(len(free), len(free) + 2)]
    for name in others:
        save_recording(free[0], data / name)
    names = [[f"{r.name}.parquet" for r in part] for part in (free, touched)]
    save_split(Split((others[0],), (others[1],), names[0], names[1]), data)

    limits = {name: np.linspace(4.4, 2.6, joints) * (1 + 0.04 * k) for k, name in enumerate(bundles)}
    touches = [touch for recording in touched for touch in find_collisions(recording)]
    ten = choose_ten(touches, np.max(list(limits.values()), axis=0), seed)
    entries = []
    variants = any(name.endswith("-paper") for name in bundles)
    for name in bundles:
        recipe = "dense" if variants and not name.endswith("-paper") else "paper"
        (results / "estimates" / name).mkdir(parents=True)
        promise = {"asked": {"rate_per_hour": 0.125}, "supported": True}
        trained = {"recipe": recipe, "case": name, "steps": STEPS[recipe], "epochs": 500, "batch": 1000}
        bundle = SimpleNamespace(  # what is measured of a bundle beside its estimates
            name=name,
            joints=joints,
            near_stiction_rad_s=NEAR_STICTION_RAD_S,
            hold_s=0.0,
            observer=SimpleNamespace(gain_per_s=20.0),
            estimate_units=["N m"] * joints,
            error_scale=SimpleNamespace(on=error_scale, follows=error_scale),
            sliding_limit_nm=limits[name].tolist(),
            near_stiction_limit_nm=(2 * limits[name]).tolist(),
            provenance=json.dumps(trained | {"limits": {"promise": promise}}),
        )
        links = SimpleNamespace(links=[SimpleNamespace(joint_name=joint) for joint in free[0].joints])
        measures = BundleMeasures(name, bundle, touches=MadeTouches(links) if error_scale else NoTouches(links))
        for recording in free + touched:
            estimates = make_estimates(recording, name, limits[name], rng, error_scale)
            save_estimates(estimates, results / "estimates" / name / f"{recording.name}.parquet")
            if recording in free:
                measures.add_free(recording, estimates)
            else:
                here = [touch for touch in touches if touch.recording == recording.name]
                measures.add_touched(here, recording, estimates, sensor_reference(recording, 20.0))
        history = make_loss_history(STEPS[recipe], rng)
        entries.append(measures.summary(touches, ten, history))
    ignorant = sanity_detectors(seed)
    for number, recording in enumerate(free + touched):
        for detector in ignorant:
            if recording in free:
                detector.add_free(number, recording)
            else:
                here = [touch for touch in touches if touch.recording == recording.name]
                detector.add_collisions(number, here, recording, estimates)
    provenance = {
        "command": "tauext reproduce --scale quick --seed 0",
        "version": "0.1.0",
        "seed": seed,
        "machine": "a made-up processor, 2 cores, Linux x86_64",
        "dataset": "data",
        "scale": scale,
    }
    content = Results(
        format=1,
        provenance=provenance,
        joints=free[0].joints,
        near_stiction_rad_s=NEAR_STICTION_RAD_S,
        ten_collisions=tuple(ten),
        collisions=tuple(touch.summary() for touch in touches),
        bundles=tuple(entries),
        own_torque=None,
        sanity=tuple(detector.summary() for detector in ignorant),
    )
    write_json(to_json(content), results / "results.json")
    return results, data


class NoTouches(TouchMeasures):
    """Of a bundle without touch estimates."""

    def add(self, touches, recording, estimates) -> None:
        """Nothing."""


class MadeTouches(TouchMeasures):
    """Three in four links right, and kinds in turn."""

    def add(self, touches, recording, estimates) -> None:
        for touch in touches:
            number, joints = len(self._reported), recording.joints
            first = touch.link if number % 4 else (touch.link + 1) % len(joints)
            ranked = [joints[first], *(joint for joint in joints if joint != joints[first])][:3]
            links = tuple(LinkProbability(joint, 0.95 / 20**k) for k, joint in enumerate(ranked))
            kind = ("push", "impact", "unknown", "clamp")[number % 4]
            self._reported.append(TouchEstimate(touch.id, kind, links, force_n=20.0 + number))
            self._labels.append((touch.link, touch.kind))


def make_loss_history(steps: int, rng: np.random.Generator) -> list[list[float]]:
    """A loss that falls, jumps up now and then and recovers; the validation loss flattens first."""
    at = np.unique(np.linspace(0, steps, 151).astype(int)[1:])
    jumps = lfilter([1], [1, -0.7], rng.random(len(at)) < 0.02)
    training = (0.08 * (at / 200) ** -0.75 + 4e-4) * np.exp(rng.normal(0, 0.12, len(at)) + jumps)
    validation = (0.03 * (at / 200) ** -0.6 + 9e-4) * np.exp(rng.normal(0, 0.05, len(at)) + jumps)
    return [list(entry) for entry in zip(at.tolist(), training.tolist(), validation.tolist(), strict=True)]


def make_recording(name: str, joints: int, seconds: float, contacts: bool, rng: np.random.Generator) -> Recording:
    """Rest-to-rest moves; contacts are half-sine pushes, their reference the push behind the sensor's low-pass."""
    samples = round(seconds * RATE_HZ)
    t_s = np.arange(samples) / RATE_HZ
    q = make_motion(samples, joints, rng)
    dq = np.gradient(q, 1 / RATE_HZ, axis=0)
    tau_ext = np.zeros((samples, joints))
    contact, link = np.zeros(samples, np.int8), np.full(samples, -1, np.int8)
    if contacts:
        for start_s in np.arange(4.0, seconds - 3.0, 5.0) + rng.uniform(0, 1):
            push = (t_s >= start_s) & (t_s < start_s + rng.uniform(0.15, 0.6))
            shape = np.sin(np.pi * np.linspace(0, 1, push.sum())) ** 0.5
            share = rng.uniform(0.3, 1.0, joints) * np.linspace(1.0, 0.4, joints)
            tau_ext[push] = rng.choice([-1, 1]) * rng.uniform(3, 30) * shape[:, None] * share
            contact[push], link[push] = 1, joints - 1
    tau = friction(dq) + 40 * np.cos(q) * np.linspace(1, 0.3, joints) - tau_ext + rng.normal(0, 0.5, q.shape)
    return Recording(
        name=name,
        joints=tuple(f"joint{j + 1}" for j in range(joints)),
        t_ns=np.arange(samples) * (1_000_000_000 // RATE_HZ),
        q=q,
        dq=dq,
        tau=tau,
        rate_hz=float(RATE_HZ),
        torque_timing="held",
        source="made up for tests of the report",
        robot_sha256="0" * 64,
        tau_ext=tau_ext,
        tau_ext_sensor=low_pass(tau_ext + rng.normal(0, 0.5, q.shape)),
        contact=contact,
        contact_link=link,
        provenance={"contacts": "pulses" if contacts else "none"},
    )


def make_motion(samples: int, joints: int, rng: np.random.Generator) -> np.ndarray:
    """Quintic moves of a few seconds with short pauses, (samples, joints), [rad]."""
    q, here, row = np.zeros((samples, joints)), np.zeros(joints), 0
    while row < samples:
        there = rng.uniform(-np.pi, np.pi, joints)
        length = round(np.abs(there - here).max() / np.deg2rad(rng.uniform(20, 50)) * RATE_HZ)
        s = np.linspace(0, 1, max(length, 2))[:, None]
        move = here + (there - here) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        move = np.vstack([move, np.repeat(there[None], rng.integers(0, 400), axis=0)])
        q[row : row + len(move)] = move[: samples - row]
        here, row = there, row + len(move)
    return q


def friction(dq: np.ndarray) -> np.ndarray:
    return np.linspace(11, 6, dq.shape[1]) * np.tanh(dq / 0.01) + np.linspace(8, 4, dq.shape[1]) * dq


def low_pass(x: np.ndarray) -> np.ndarray:
    """First order at 20 rad/s, as observer and sensor reference have it."""
    a = np.exp(-20 / RATE_HZ)
    return lfilter([1 - a], [1, -a], x, axis=0)


def make_estimates(
    recording: Recording, name: str, limit_nm: np.ndarray, rng: np.random.Generator, error_scale: bool = False
) -> Estimates:
    """An observer that sees friction, the model's error and the push; a network that errs most near stiction.

    With an error scale limits grow with the speed, and the standard error is a tenth of them.
    """
    n = len(recording.joints)
    model = MODEL_ERROR_NM.get(name.removesuffix("-paper"), 10.0) * np.cos(recording.q) * np.linspace(1, 0.3, n)
    uncertainty = low_pass(-friction(recording.dq) - model)
    near = np.abs(recording.dq) < NEAR_STICTION_RAD_S
    white = rng.standard_normal(recording.q.shape)
    slow = lfilter([0.02], [1, -0.98], white, axis=0) * 10
    network = uncertainty + slow * np.where(near, 1.2, 0.35) * np.linspace(1, 0.6, n)
    residual = uncertainty + low_pass(recording.tau_ext) + rng.normal(0, 0.05, network.shape)
    tau_ext = residual - network
    warm = recording.time_s < WARM_S
    network[warm] = tau_ext[warm] = np.nan
    limit = np.where(near, 2 * limit_nm, limit_nm)
    sigma = None
    if error_scale:
        limit = limit * (1 + np.abs(recording.dq))
        sigma = np.where(warm[:, None], np.nan, 0.1 * limit).astype(np.float32)
    with np.errstate(invalid="ignore"):
        detection = (np.abs(tau_ext) > limit).any(axis=1) & ~warm
    single = np.float32
    return Estimates(
        joints=recording.joints,
        t_ns=recording.t_ns,
        residual=residual.astype(single),
        network=network.astype(single),
        tau_ext=tau_ext.astype(single),
        limit_nm=limit.astype(single),
        sigma_nm=sigma,
        near_stiction=near,
        health=np.where(warm, WARMING_UP, OK).astype(np.int8),
        causes=np.zeros(recording.samples, np.uint32),
        detection=detection,
        held_alarm=np.where(detection, COLLISION, 0).astype(np.int8),
        touch=np.zeros(recording.samples, np.int8),
    )


PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


@contextmanager
def undrawn() -> Iterator[None]:
    """Figures are made as ever; the PNG of each is one pixel."""

    def print_pixel(self: FigureCanvasAgg, file: Path | BytesIO, **options: object) -> None:
        if isinstance(file, BytesIO):
            file.write(PIXEL)
        else:
            Path(file).write_bytes(PIXEL)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "print_png", print_pixel)
        yield


LONG_NAMES = tuple(
    f"{joint}_joint_{side}_arm"
    for side in ("left", "right")
    for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_1", "wrist_2", "wrist_3")
)


def texts_of(figure: Figure) -> list[str]:
    """All texts of a figure, with the numbers of its axes."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            axis.get_ticklabels(which="both")  # makes them
    return [text.get_text() for text in figure.findobj(Text)]


def words_of(page: str) -> str:
    """What a reader of the page sees."""
    return " ".join(re.sub(r"<(style|script).*?</\1>|<[^>]+>", " ", page, flags=re.S).split())


def run_command(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of one command."""
    capsys.readouterr()
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as stop:  # the argument parser's own way out
        code = stop.code or 0
    out, err = capsys.readouterr()
    return code, out, err
