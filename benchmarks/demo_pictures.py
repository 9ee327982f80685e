"""The pictures of docs/demo.md: a hand pushes both arms of the demo in Chromium.

python benchmarks/demo_pictures.py --out docs/pictures
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import io
import sys
import threading
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from made_page import drag, on_screen, open_pages, until
from viser.transforms import SO3

from tauext.page.bundles import cache_folder
from tauext.page.door import free_port
from tauext.page.page import Session, open_server

GRABBED = {"rig": (1, (0.0, 0.05, 0.2)), "seven": (5, (0.0, 0.0, 0.05))}
"""Link by its joint, counted from 0, and the point on it, [m]."""
ANIMATION = (840, 448)


class Film:
    """Every picture that the browser draws, with its time, [s]."""

    def __init__(self, page):
        self._page = page
        self._shots: list[tuple[float, str]] = []

    async def __aenter__(self) -> Film:
        self._devtools = await self._page.context.new_cdp_session(self._page)
        self._devtools.on("Page.screencastFrame", self._take)
        await self._devtools.send("Page.startScreencast", {"format": "jpeg", "quality": 92})
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._devtools.send("Page.stopScreencast")

    def _take(self, frame: dict) -> None:
        self._shots.append((frame["metadata"]["timestamp"], frame["data"]))
        asyncio.get_running_loop().create_task(
            self._devtools.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})
        )

    def save(self, path: Path) -> None:
        """An animation at the pace at which it was drawn."""
        times = [time_s for time_s, _ in self._shots]
        pictures = [Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB") for _, data in self._shots]
        small = [picture.resize(ANIMATION, Image.Resampling.LANCZOS) for picture in pictures]
        lasts_ms = [max(1, round(1e3 * s)) for s in np.diff(times)] + [1000]
        small[0].save(path, save_all=True, append_images=small[1:], duration=lasts_ms, loop=0, quality=55, method=6)


async def push(page, session: Session) -> None:
    """By hand, in a third of a second; the hand holds."""
    joint, local = GRABBED[session.arm.name]
    pose = session.snapshot.poses[joint]
    rotation = SO3(pose[3:]).as_matrix()
    grabbed = pose[:3] + rotation @ local
    start, end = [await on_screen(page, session.server, p) for p in (grabbed, grabbed + 0.25 * rotation[:, 0])]
    await drag(page, start, end, 0.3)


async def photograph(session: Session, out: Path) -> None:
    """A picture of a push on either arm; a film of one, without floor and shadows: it would come to three a second."""
    async with open_pages(1, 1280, 683) as (page,):
        await page.goto(f"http://127.0.0.1:{session.server.get_port()}")
        await page.get_by_text("Free motion").wait_for(timeout=200e3)
        await asyncio.sleep(9.5)  # the line that this browser has no GPU has left by then
        session.send("rest")  # a picture takes so long that the link would not be where the hand reaches for it
        await asyncio.sleep(1.0)
        await push(page, session)
        await asyncio.sleep(2.0)
        assert session.snapshot.touch is not None, "the hand missed the link; once more"
        await page.screenshot(path=out / ("demo.png" if session.arm.name == "rig" else "demo-seven.png"))
        await page.mouse.up()
        if session.arm.name == "rig":
            return
        session._drawing.simplify(True)
        await page.get_by_role("button", name="Resume").click()
        await until(lambda: session.snapshot.doing == "moving")
        await asyncio.sleep(6.0)
        async with Film(page) as film:
            await asyncio.sleep(2.5)
            await push(page, session)
            await asyncio.sleep(1.5)
            await page.mouse.up()
            await asyncio.sleep(0.8)
            await page.get_by_role("button", name="Resume").click()
            await asyncio.sleep(2.5)
        film.save(out / "demo.webp")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for arm in GRABBED:
        server = open_server("127.0.0.1", free_port("127.0.0.1", 9700))
        session = Session(server, arm, 0, cache_folder())
        session.server = server
        running = threading.Thread(target=session.run)
        running.start()
        try:
            asyncio.run(photograph(session, out))
        finally:
            session.stop()
            running.join()
            server.stop()


if __name__ == "__main__":
    main()
