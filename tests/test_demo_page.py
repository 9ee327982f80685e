"""The demo's page: slow and stuck clients, and a mouse in a real browser."""

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_demo import SHORT

from tauext.demo.bundles import train_bundles
from tauext.demo.page import Session, free_port, open_server

viser = pytest.importorskip("viser", reason="the page needs the extra tauext[live]")
CHROMIUM = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))
PATIENCE_S = 60.0
"""A browser that draws by software on a busy machine takes seconds for what takes it milliseconds elsewhere."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    from tauext.demo.arms import rig_arm

    train_bundles(rig_arm(), "exact", SHORT, 0, folder)
    return folder


@pytest.fixture
def session(cache):
    """The rig on a page, in a thread of its own."""
    server = open_server("127.0.0.1", free_port("127.0.0.1", 9500))
    session = Session(server, "rig", 0, cache, SHORT)
    session.server = server
    thread = threading.Thread(target=session.run)
    thread.start()
    wait_for(lambda: session.snapshot is not None and session.snapshot.verdicts)
    yield session
    session.stop()
    thread.join(10)
    server.stop()


def wait_for(done):
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end, "nothing came of it"
        time.sleep(0.02)


def test_clients_that_never_read_hold_up_nothing_and_fill_nothing(session):
    sync = pytest.importorskip("websockets.sync.client")
    port = session.server.get_port()
    protocol = f"viser-v{viser.__version__}"
    stuck = [
        sync.connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_queue=1, compression=None) for _ in range(3)
    ]
    waiting = session.server._websock_server._broadcast_buffer.message_from_id
    began_s = session.snapshot.time_s
    wait_for(lambda: session.snapshot.time_s > began_s + 2.0)
    messages = len(waiting)
    wait_for(lambda: session.snapshot.time_s > began_s + 5.0)
    assert len(waiting) < 1.2 * messages + 20  # newer ones replace older ones of the same thing
    for connection in stuck:
        connection.socket.close()  # a tab that is gone without a word
    gone_s = session.snapshot.time_s
    wait_for(lambda: session.snapshot.time_s > gone_s + 1.0)


def test_the_session_ends_its_processes(session):
    session.stop()
    wait_for(lambda: not session._process.is_alive())


def test_another_arm_or_model_error_is_taken_up(session):
    session._choose_error("mass")  # not trained yet: nobody watches, and a training begins
    wait_for(lambda: session._trainer is not None and not session.snapshot.verdicts)
    session._choose_error("exact")
    wait_for(lambda: session._trainer is None and session.snapshot.verdicts)
    session._choose_arm("seven")
    wait_for(lambda: not session._process.is_alive())
    assert not list(session._cache.glob("*.part-*"))  # of the training that was cut off


@pytest.mark.slow
def test_a_mouse_pushes_a_link_and_the_page_says_so(session, record_property, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not there")
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        page = browser.new_page(viewport={"width": 1000, "height": 400})
        page.set_default_timeout(1e3 * PATIENCE_S)
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url))
        home = f"127.0.0.1:{session.server.get_port()}"
        page.goto(f"http://{home}")
        page.get_by_text("Free motion").wait_for()
        session._drawing.simplify(True)  # this browser has no GPU
        session.send("rest")
        wait_for(lambda: session.server.get_clients() and session.snapshot.doing == "stop")
        time.sleep(1.0)  # the arm is at rest, on the screen too
        grabbed, across = grab_point(session)
        x, y = on_screen(page, session, grabbed)
        end = on_screen(page, session, grabbed + 0.25 * across)
        page.evaluate(WATCH_BANNER)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(*end, steps=8)
        wait_for(lambda: any(e.alarm == "collision" and e.method == "tauext" for e in session.events))
        page.get_by_text("Collision: joint1").wait_for()
        seen_ms = page.evaluate("() => window.seenMs")
        record_property("push_to_screen_ms", seen_ms)
        print(f"first movement of the mouse to the alarm on the screen: {seen_ms:.0f} ms")
        collision = next(e for e in session.events if e.alarm == "collision" and e.method == "tauext")
        assert collision.joint == 0  # the first link's push turns the first joint alone
        assert session.snapshot.touch.joint == 0
        page.mouse.up()
        wait_for(lambda: session.snapshot.touch is None)
        page.get_by_role("button", name="Resume").click()
        wait_for(lambda: session.snapshot.doing == "moving")
        assert all(home in url for url in asked), asked
        browser.close()
    wait_for(lambda: not session.server.get_clients())


WATCH_BANNER = """() => {
  let began = null;
  window.seenMs = null;
  window.addEventListener('pointermove', e => { if (e.buttons && began === null) began = performance.now(); }, true);
  new MutationObserver(() => {
    if (began !== null && window.seenMs === null && document.body.innerText.includes('Collision'))
      window.seenMs = performance.now() - began;
  }).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""


def grab_point(session) -> tuple[np.ndarray, np.ndarray]:
    """A point on the front of the first link, near its end, and the direction across the link, in the base frame."""
    pose = session.snapshot.poses[0]
    rotation = viser.transforms.SO3(pose[3:]).as_matrix()
    return pose[:3] + rotation @ [0.0, 0.05, 0.15], rotation[:, 0]


def on_screen(page, session, point: np.ndarray) -> tuple[float, float]:
    """Where the browser's camera sees a point, in pixels of the page."""
    camera = next(iter(session.server.get_clients().values())).camera
    right, down, ahead = viser.transforms.SO3(camera.wxyz).as_matrix().T @ (point - camera.position)
    box = page.query_selector("canvas").bounding_box()
    focal = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
    return box["x"] + 0.5 * box["width"] + focal * right / ahead, box["y"] + 0.5 * box["height"] + focal * down / ahead
