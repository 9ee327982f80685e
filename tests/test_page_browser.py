"""The demo's page: slow and stuck clients, and a mouse in a real browser."""

import asyncio
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from made_page import CHROMIUM, PATIENCE_S, SHORT, drag, on_screen, open_pages, until

from tauext.page.door import free_port
from tauext.page.page import Session, open_server
from tauext.page.panel import GIVE, TAKE, HandPanel, last_alarm
from tauext.page.snapshot import Event, Held
from tauext.sim.arms import ARMS

viser = pytest.importorskip("viser", reason="the page needs the extra tauext[live]")


@pytest.fixture
def session(rig_bundles):
    """The rig on a page, in a thread of its own."""
    server = open_server("127.0.0.1", free_port("127.0.0.1", 9500))
    session = Session(server, "rig", 0, rig_bundles["tauext"].parent.parent, SHORT)
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
        sync.connect(
            f"ws://127.0.0.1:{port}",
            origin=f"http://127.0.0.1:{port}",
            subprotocols=[protocol],
            max_queue=1,
            compression=None,
        )
        for _ in range(3)
    ]
    waiting = session.server._websock_server._broadcast_buffer.message_from_id
    began_s = session.snapshot.time_s
    wait_for(lambda: session.snapshot.time_s > began_s + 0.7)
    messages = len(waiting)
    wait_for(lambda: session.snapshot.time_s > began_s + 2.0)
    assert len(waiting) < 1.2 * messages + 20  # newer ones replace older ones of the same thing
    for connection in stuck:
        connection.socket.close()  # a tab that is gone without a word
    gone_s = session.snapshot.time_s
    wait_for(lambda: session.snapshot.time_s > gone_s + 0.5)


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


def test_the_hands_button_puts_a_weight_in_and_takes_it_out():
    server, sent = open_server("127.0.0.1", free_port("127.0.0.1", 9560)), []

    def send(*words):
        sent.append(words)

    try:
        hand = HandPanel(server.gui, send)
        assert (hand._button.label, hand._move_on.visible) == (GIVE, False)
        hand._mass.value, hand._set_load.value = 1.5, True
        hand._press(send)
        hand.show(told(Held(1.5, 3.0, True, "")), "Fits a load of 1.50 ± 0.02 kg.")
        assert (hand._button.label, hand._move_on.visible, hand._mass.disabled) == (TAKE, True, True)
        assert "Fits a load of 1.50" in hand._words._content and "set to 1.5 kg" in hand._words._content
        hand._press(send)
        hand.show(told(None), "")
        assert (hand._button.label, hand._mass.disabled, hand._words._content) == (GIVE, False, "")
    finally:
        server.stop()
    assert sent == [("hold", 1.5, True), ("let_go",)]


@pytest.mark.parametrize(
    "after_push_s, after_limit_s, by_weight, text",
    [
        (0.9, 0.0224, False, "joint2, 22 ms"),
        (0.9, None, False, "joint2, below its limit"),
        (None, None, True, "joint2, weight"),
        (None, None, False, "joint2, false"),
    ],
)
def test_the_last_alarm_shows_the_delay_over_the_limit(after_push_s, after_limit_s, by_weight, text):
    event = Event(1.0, "tauext", "collision", 1, after_push_s, after_limit_s, by_weight)
    assert last_alarm(event, ARMS["seven"]()) == text


def told(held):
    return SimpleNamespace(held=held, doing="moving")


@pytest.mark.parametrize("training", [False, True], ids=["importing", "training"])
def test_ctrl_c_ends_the_page_at_once_whatever_it_is_doing(training, tmp_path):
    """While libraries are imported that swallow the exception of a Ctrl-C, and while a first training runs."""
    words = [sys.executable, "-m", "tauext", "demo", "--no-open", "--port", str(free_port("127.0.0.1", 9600))]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    page = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert page.stdout.readline().startswith("http://localhost")
        if training:  # a process of its own, which has made its folder
            wait_for(lambda: list(tmp_path.glob("tauext/demo/*.part-*")))
        page.send_signal(signal.SIGINT)
        out, err = page.communicate(timeout=PATIENCE_S)
    finally:
        page.kill()
    assert (page.returncode, out) == (0, "") and "Traceback" not in err
    assert not list(tmp_path.glob("tauext/demo/*"))  # of a training that was cut off


def in_chromium(test):
    missing = not CHROMIUM.exists() or importlib.util.find_spec("playwright") is None
    return pytest.mark.slow(pytest.mark.skipif(missing, reason=f"needs {CHROMIUM} and playwright")(test))


@in_chromium
def test_a_mouse_pushes_a_link_and_the_page_says_so(session, record_property):
    asyncio.run(push_in_a_browser(session, record_property))
    wait_for(lambda: not session.server.get_clients())


async def push_in_a_browser(session, record_property):
    async with open_pages(1) as (page,):
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url))
        home = f"127.0.0.1:{session.server.get_port()}"
        await page.goto(f"http://{home}")
        await page.get_by_text("Free motion").wait_for()
        session._drawing.simplify(True)  # this browser has no GPU
        await asyncio.sleep(6.0)  # it finds out so, and draws fewer pixels
        delays_ms = []
        for _ in range(PUSHES):
            delays_ms.append(await push(page, session))
            collision = [e for e in session.events if e.alarm == "collision" and e.method == "tauext"][-1]
            assert collision.joint == 0  # the first link's push turns the first joint alone
            assert session.snapshot.touch.joint == 0
            await page.mouse.up()
            await until(lambda: session.snapshot.touch is None)
            await page.get_by_role("button", name="Resume").click()
            await until(lambda: session.snapshot.doing == "moving")
            await asyncio.sleep(2.0)  # every joint has slid, and limits are the trained ones again
        print(f"hand's first movement to the alarm on the screen: {', '.join(f'{d:.0f}' for d in delays_ms)} ms")
        record_property("push_to_screen_ms", delays_ms)
        assert all(home in url for url in asked), asked


@in_chromium
@pytest.mark.parametrize("width, height", [(1000, 400), (760, 420), (1280, 900)])
def test_the_pointer_reaches_the_link_though_the_browser_has_no_gpu(session, width, height):
    asyncio.run(point_at_a_link(session, width, height))


async def point_at_a_link(session, width, height):
    async with open_pages(1, width, height) as (page,):
        await page.goto(f"http://127.0.0.1:{session.server.get_port()}")
        await page.get_by_text("Free motion").wait_for()
        notice = page.get_by_text("Software WebGL rendering detected")
        await notice.wait_for()
        await until(lambda: len(session.server.get_clients()) == 1)
        session.send("rest")
        await until(lambda: session.snapshot.doing == "stop")
        grabbed, _ = grab_point(session)
        at = await on_screen(page, session.server, grabbed)
        covers = await notice.evaluate("(element, at) => " + NOTICE_COVERS, list(map(float, at)))
        reached = await page.evaluate("at => document.elementFromPoint(...at).tagName", list(map(float, at)))
        assert (reached, covers) == ("CANVAS", False)
        await notice.wait_for(state="hidden")  # by itself


NOTICE_COVERS = """{
  const box = element.closest('.mantine-Notification-root').getBoundingClientRect();
  return box.left <= at[0] && at[0] <= box.right && box.top <= at[1] && at[1] <= box.bottom;
}"""


@in_chromium
def test_two_browsers_see_the_same_and_one_that_closes_leaves_the_other(session):
    asyncio.run(push_with_two_browsers(session))


async def push_with_two_browsers(session):
    async with open_pages(2) as (first, second):
        for page in (first, second):
            await page.goto(f"http://127.0.0.1:{session.server.get_port()}")
            await page.get_by_text("Free motion").wait_for()
        session._drawing.simplify(True)
        await until(lambda: len(session.server.get_clients()) == 2)
        pace = [session.snapshot.real_time_factor]
        await push(first, session)
        await second.get_by_text("Collision: joint1").wait_for()  # pushed in one, said in both
        pace.append(session.snapshot.real_time_factor)
        await first.close()  # while it holds the link
        await until(lambda: len(session.server.get_clients()) == 1)
        await until(lambda: session.snapshot.touch is None)  # nobody holds it any more
        await second.get_by_role("button", name="Resume").click()
        await until(lambda: session.snapshot.doing == "moving")
        await second.get_by_text("Free motion").wait_for()
        pace.append(session.snapshot.real_time_factor)
        assert min(pace) > 0.98, pace


PUSHES = 8


async def push(page, session) -> float:
    """Push the resting arm's first link by hand until the page says so; how long that took, [ms]."""
    while True:
        await until(lambda: stretched(session))  # else the second link hides the first
        session.send("rest")
        await until(lambda: session.snapshot.doing == "stop")
        await asyncio.sleep(1.5)  # the arm is at rest, on the screen too
        if stretched(session) and session.snapshot.verdicts["tauext"].alarm == "none":
            break
        session.send("resume")
        await asyncio.sleep(1.0)
    events = len(session.events)
    grabbed, across = grab_point(session)
    start = await on_screen(page, session.server, grabbed)
    end = await on_screen(page, session.server, grabbed + 0.25 * across)
    await page.evaluate(WATCH_BANNER)
    began_s = await drag(page, start, end)
    await until(lambda: any(e.alarm == "collision" and e.method == "tauext" for e in session.events[events:]))
    await page.get_by_text("Collision: joint1").wait_for()
    return await page.evaluate("() => window.seenMs") - 1e3 * began_s


WATCH_BANNER = """() => {
  window.seenMs = null;
  new MutationObserver((_, watcher) => {
    if (document.body.innerText.includes('Collision')) {
      window.seenMs = performance.timeOrigin + performance.now();
      watcher.disconnect();
    }
  }).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""


def stretched(session) -> bool:
    """Whether the rig's second link points away from the first, by less than a right angle."""
    links = [viser.transforms.SO3(pose[3:]).as_matrix()[:, 2] for pose in session.snapshot.poses]
    return links[0] @ links[1] > 0.0


def grab_point(session) -> tuple[np.ndarray, np.ndarray]:
    """A point on the front of the first link, near its end, and the direction across the link, in the base frame."""
    pose = session.snapshot.poses[0]
    rotation = viser.transforms.SO3(pose[3:]).as_matrix()
    return pose[:3] + rotation @ [0.0, 0.05, 0.15], rotation[:, 0]
