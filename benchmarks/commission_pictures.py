"""A first use of `tauext commission` from nothing: what it prints, and pictures of its page in each state.

CHROMIUM=/usr/bin/chromium python benchmarks/commission_pictures.py --out docs/results/commission

Needs Chromium and websockets (extra `dev`); takes four minutes.
"""

from __future__ import annotations

import argparse
import io
import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from made_browser import Browser, Page

SIZES = {"phone": (390, 1500), "desktop": (1280, 1000)}
"""Width and height of the pictures."""
PORT = 8795
PUSH = "sim push joint=joint2 force=0,0,-60 seconds=0.4"


def first_use(out: Path, browser: Browser, arm: str, loop: list[str]) -> str:
    """The transcript of the command with these further options; pictures are written meanwhile."""
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "try"
        words = ["commission", "--source", f"sim:{arm}", "--out", str(folder), "--port", str(PORT), *loop]
        began = time.monotonic()
        command = subprocess.Popen([sys.executable, "-m", "tauext", *words], stdout=subprocess.PIPE, text=True)

        def read() -> None:
            for line in command.stdout or ():
                lines.append(f"{time.monotonic() - began:6.0f} s  {line.rstrip()}".replace(str(folder), "try"))
                print(lines[-1], flush=True)

        reading = threading.Thread(target=read)
        reading.start()
        try:
            url = f"http://127.0.0.1:{PORT}/"
            wait_for(answers)
            photograph(browser, url, out, "connecting", settle_s=2.0)
            wait_for(lambda: state_of(folder) == "learning")
            wait_for(lambda: len(list(folder.glob("seg-*.parquet"))) >= 4)
            photograph(browser, url, out, "learning")
            wait_for(lambda: state_of(folder) == "monitoring")
            time.sleep(20)
            photograph(browser, url, out, "monitoring")
            shown = {size: browser.page(url, *SIZES[size], scheme) for size, scheme in LOOKS}
            pages = {size: page.__enter__() for size, page in shown.items()}
            time.sleep(15)
            ask(folder, PUSH)
            lines.append(f"{time.monotonic() - began:6.0f} s  (the arm is pushed with 60 N for 0.4 s)")
            time.sleep(1.0)
            for size, page in pages.items():
                save(page, out / f"asking-{size}.png")
            pages["desktop"].show("light")
            time.sleep(0.3)
            save(pages["desktop"], out / "asking-desktop-light.png")  # for the first page of the documentation
            for page in shown.values():
                page.__exit__(None, None, None)
            lines.append(f"{time.monotonic() - began:6.0f} s  key t: {ask(folder, 'touched')}")
            command.send_signal(signal.SIGINT)
            command.wait(60)
            reading.join()
        finally:
            command.kill()
    return "\n".join(lines)


LOOKS = (("phone", "light"), ("desktop", "dark"))


def save(page: Page, path: Path) -> None:
    """A picture with few colours, so that it is small."""
    picture = Image.open(io.BytesIO(page.picture())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def photograph(browser: Browser, url: str, out: Path, name: str, settle_s: float = 8.0) -> None:
    """The page on a phone and on a desktop."""
    for size, scheme in LOOKS:
        with browser.page(url, *SIZES[size], scheme) as page:
            time.sleep(settle_s)
            save(page, out / f"{name}-{size}.png")


def wait_for(true, patience_s: float = 600.0) -> None:
    end = time.monotonic() + patience_s
    while not true():
        if time.monotonic() > end:
            raise SystemExit("what was waited for did not come")
        time.sleep(0.2)


def state_of(folder: Path) -> str:
    try:
        return json.loads((folder / "commission.json").read_text()).get("state", "")
    except (OSError, ValueError):
        return ""


def answers() -> bool:
    """Whether the page is served."""
    try:
        socket.create_connection(("127.0.0.1", PORT), timeout=1.0).close()
    except OSError:
        return False
    return True


def ask(folder: Path, line: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
        wire.connect(str(folder / "control.sock"))
        wire.sendall(line.encode() + b"\n")
        with wire.makefile() as answers:
            return answers.readline().strip()


TEXT = """\
# A first use of `tauext commission`

Made by `benchmarks/commission_pictures.py --arm {arm}` on a simulated arm, in real time. Times count from the command.

    $ tauext commission --source sim:{arm} --out try{loop}
{lines}

| state | phone, light | desktop, dark |
|---|---|---|
{rows}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--arm", default="rig")
    parser.add_argument("--loop", default="", help="further options on a busy computer: '--core 1 --priority 50'")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        browser = Browser(Path(temporary))
        try:
            transcript = first_use(options.out, browser, options.arm, options.loop.split())
        finally:
            browser.close()
    states = ("connecting", "learning", "monitoring", "asking")
    rows = "\n".join(f"| {name} | ![]({name}-phone.png) | ![]({name}-desktop.png) |" for name in states)
    lines = "\n".join(f"    {line}" for line in transcript.splitlines())
    loop = f" {options.loop}" if options.loop else ""
    (options.out / "first-use.md").write_text(TEXT.format(arm=options.arm, loop=loop, lines=lines, rows=rows))


if __name__ == "__main__":
    main()
