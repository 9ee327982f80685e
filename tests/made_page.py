"""What the live page's tests share: a short lesson, an arm that needs none, and a hand at Chromium's mouse."""

import asyncio
import contextlib
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, ObserverConfig, PriorConfig, TrainConfig
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.page.bundles import Lesson, practice_recording
from tauext.robot.load import load_tree
from tauext.sim.arms import ARMS, DemoArm

SHORT = Lesson(
    recordings=4,
    recording_s=15.0,
    validation=1,
    prior_recordings=4,
    methods={
        "tauext": TrainConfig(
            recipe="prior", alarm=AlarmConfig(friction_reserve=0.1), prior=PriorConfig(most_ripples=0)
        ),
        "observer": TrainConfig(recipe="observer"),
    },
)


def _smooth_arm() -> DemoArm:
    seven = ARMS["seven"]()
    little = {"coulomb_nm": 1e-4, "static_nm": 1.2e-4, "viscous_nm_s_rad": 0.0, "ripple_nm": 0.0}
    return replace(seven, friction=tuple(replace(friction, **little) for friction in seven.friction))


SMOOTH_ARM = _smooth_arm()
"""The seven-axis arm without friction: an observer knows all of it, and nothing needs to be trained."""


def smooth_bundle(folder: Path, limit_nm: float) -> tuple[_core.Bundle, _core.Tree]:
    """An observer of SMOOTH_ARM, whose file robot.xml is written into the folder."""
    (folder / "robot.xml").write_text(SMOOTH_ARM.xml)
    tree, free = load_tree(folder / "robot.xml"), practice_recording(SMOOTH_ARM, 1.0, 0, 0)
    return make_bundle("free", build_setup(tree, free, ObserverConfig(window_s=0.1)), limit_nm, free), tree


CHROMIUM = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE_S = 60.0
"""A browser that draws by software on a busy machine takes seconds for what takes it milliseconds elsewhere."""
HAND_S, HAND_EVENTS = 0.064, 8
"""A quick push: the mouse tells of it 125 times a second, whether the browser has drawn meanwhile or not."""


@contextlib.asynccontextmanager
async def open_pages(number: int, width: int = 1000, height: int = 400):
    """Pages of so many browsers."""
    from playwright.async_api import async_playwright

    async with async_playwright() as kinds:
        browsers = [await kinds.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS) for _ in range(number)]
        pages = [await browser.new_page(viewport={"width": width, "height": height}) for browser in browsers]
        for page in pages:
            page.set_default_timeout(1e3 * PATIENCE_S)
        yield pages
        for browser in browsers:
            await browser.close()


async def until(done):
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end, "nothing came of it"
        await asyncio.sleep(0.01)


async def drag(page, start, end, hand_s=HAND_S) -> float:
    """Press the mouse at start and move it to end, pixels of the page; the time at which the hand set out, [s]."""
    await page.mouse.move(*start)
    await page.mouse.down()
    began_s, moves = time.time(), []
    for k in range(1, HAND_EVENTS + 1):
        await asyncio.sleep(max(0.0, began_s + hand_s * k / HAND_EVENTS - time.time()))
        moves.append(asyncio.create_task(page.mouse.move(*(start + (end - start) * k / HAND_EVENTS))))
    await asyncio.gather(*moves)
    return began_s


async def on_screen(page, server, point) -> np.ndarray:
    """Where the camera of a viser server's first browser sees a point of the base frame, in pixels of its page."""
    from viser.transforms import SO3

    camera = next(iter(server.get_clients().values())).camera
    right, down, ahead = SO3(camera.wxyz).as_matrix().T @ (point - camera.position)
    box = await (await page.query_selector("canvas")).bounding_box()
    focal = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
    centre = np.array([box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]])
    return centre + focal * np.array([right, down]) / ahead
