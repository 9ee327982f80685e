"""Calibrating one arm on recordings in an object store: peak memory, time beside the same files on disk, bytes read.

    python benchmarks/store.py DATASET BUNDLE --gateway versitygw --out FOLDER --hours 200 --distinct-hours 10

DATASET has test recordings of the arm's free motion, BUNDLE is one that was trained on it. Recordings of 15 minutes are
put together of them, each from another moment on, with a gap in the stamps at every seam; each is put into the store
under several names until there are so many hours. The store is versitygw on loopback, its objects are files in FOLDER.
On disk the names are links. The cache of findings is empty at every run, so each recording is checked.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import arguments, free_port

MINUTES = 15.0
GAP_S = 2.0
KEYS = {"AWS_ACCESS_KEY_ID": "benchmark", "AWS_SECRET_ACCESS_KEY": "benchmark-secret", "AWS_REGION": "us-east-1"}


def make_recordings(dataset: Path, folder: Path, count: int) -> list[Path]:
    """So many recordings of MINUTES, NAME-000.parquet ..., from the test recordings; those that are there stay."""
    from tauext.data.dataset import load_dataset
    from tauext.data.free_motion import cut
    from tauext.data.recording import Recording
    from tauext.data.recording_file import save_recording

    sources = load_dataset(dataset).recordings("test")
    rate_hz = sources[0].rate_hz
    wanted = round(MINUTES * 60 * rate_hz)
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)

    def put_together(name: str) -> Recording:
        pieces, samples, end_ns, which = [], 0, 0, int(rng.integers(len(sources)))
        first = int(rng.integers(sources[which].samples // 2))
        while samples < wanted:
            piece = cut(sources[which], slice(first, min(sources[which].samples, first + wanted - samples)))
            pieces.append(replace(piece, t_ns=piece.t_ns - piece.t_ns[0] + end_ns))
            end_ns = int(pieces[-1].t_ns[-1]) + round(GAP_S * 1e9)
            samples, first, which = samples + piece.samples, 0, (which + 1) % len(sources)
        signals = [s for s in ("t_ns", "q", "dq", "tau", "temperature") if getattr(pieces[0], s) is not None]
        whole = {signal: np.concatenate([getattr(piece, signal) for piece in pieces]) for signal in signals}
        return replace(sources[0], **whole, name=name, contact=None, contact_link=None, tau_ext=None, q_des=None)

    files = [folder / f"calibration-{k:03d}.parquet" for k in range(count)]
    for file in files:
        recording = put_together(file.stem)  # also where it is there: the next one's dice
        if not file.is_file():
            save_recording(recording, file)
    return files


@contextmanager
def gateway(program: str, objects: Path) -> Iterator[tuple[subprocess.Popen, dict[str, str]]]:
    """versitygw on a free port, and the environment in which it is found."""
    (objects / "arms").mkdir(parents=True, exist_ok=True)
    port = free_port()
    command = [program, "--access", KEYS["AWS_ACCESS_KEY_ID"], "--secret", KEYS["AWS_SECRET_ACCESS_KEY"]]
    command += ["--port", f"127.0.0.1:{port}", "--quiet", "posix", str(objects)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        yield process, KEYS | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}
    finally:
        process.terminate()
        process.wait()


def fill(files: list[Path], copies: int, split: str, folder: Path) -> None:
    """The dataset on disk, as links, and in the store."""
    from tauext.files.copies import send
    from tauext.files.places import StoredPlace, place_of

    there = place_of("s3://arms/data")
    assert isinstance(there, StoredPlace)
    folder.mkdir(parents=True, exist_ok=True)
    for copy in range(copies):
        for file in files:
            name = f"{file.stem}-{copy:02d}.parquet"
            (folder / name).unlink(missing_ok=True)
            os.link(file, folder / name)
            send(file, there / name)
    (folder / "split.json").write_text(split)
    send(folder / "split.json", there / "split.json")


def calibrate(
    bundle: Path, data: str, out: Path, threads: int, environment: dict[str, str]
) -> tuple[float, float, float]:
    """Wall time and processor time [s], and peak resident memory [MB]."""
    shutil.rmtree(out.with_suffix(".cache"), ignore_errors=True)
    command = [sys.executable, "-m", "tauext", "calibrate", "--bundle", str(bundle), "--data", data]
    command += ["--out", str(out), "--threads", str(threads)]
    started = time.monotonic()
    own = os.environ | environment | {"XDG_CACHE_HOME": str(out.with_suffix(".cache"))}
    process = subprocess.Popen(command, env=own, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    return time.monotonic() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3


def sent(process: subprocess.Popen) -> int:
    """Bytes that the gateway wrote, to sockets for the most part."""
    lines = dict(line.split(": ") for line in Path(f"/proc/{process.pid}/io").read_text().splitlines())
    return int(lines["wchar"])


def main() -> None:
    parser = arguments(__doc__, "dataset", "bundle")
    parser.add_argument("--gateway", default=os.environ.get("TAUEXT_VERSITYGW", "versitygw"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hours", type=float, default=200.0)
    parser.add_argument("--distinct-hours", type=float, default=10.0)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--only", choices=("disk", "store"), default=None)
    asked = parser.parse_args()
    count = round(asked.distinct_hours * 60 / MINUTES)
    copies = round(asked.hours / asked.distinct_hours)
    files = make_recordings(asked.dataset, asked.out / "recordings", count)
    names = [f"{file.stem}-{copy:02d}.parquet" for copy in range(copies) for file in files]
    empty = {"train": [], "validation": [], "test": [], "collisions": []}
    split = json.dumps({"format": 1, **empty, "calibration": names}) + "\n"
    size = copies * sum(file.stat().st_size for file in files)
    print(f"{len(names)} recordings of {MINUTES:g} minutes, {size / 1e9:.2f} GB", flush=True)
    objects, folder = asked.out / "objects", asked.out / "data"
    with gateway(asked.gateway, objects) as (process, environment):
        os.environ.update(environment)
        try:
            started = time.monotonic()
            fill(files, copies, split, folder)
            print(f"sent in {time.monotonic() - started:.0f} s", flush=True)
            for threads in asked.threads:
                for what, data in (("store", "s3://arms/data"), ("disk", str(folder))):
                    if asked.only not in (None, what):
                        continue
                    before = sent(process)
                    out = asked.out / f"{what}-{threads}.tauext"
                    wall_s, busy_s, peak_mb = calibrate(asked.bundle, data, out, threads, environment)
                    came = f", {(sent(process) - before) / 1e9:.2f} GB sent by the store" if what == "store" else ""
                    print(
                        f"{what}, {threads} threads: {wall_s:.1f} s wall, {busy_s:.1f} s of processors, "
                        f"{peak_mb:.0f} MB at most{came}",
                        flush=True,
                    )
                if asked.only is None:
                    limits = [limits_of(asked.out / f"{what}-{threads}.run.json") for what in ("disk", "store")]
                    print(f"limits are the same: {limits[0] == limits[1]}", flush=True)
        finally:
            shutil.rmtree(objects, ignore_errors=True)
            shutil.rmtree(folder, ignore_errors=True)


def limits_of(run: Path) -> object:
    """What was found."""
    return json.loads(run.read_text())["limits"]


if __name__ == "__main__":
    main()
