"""The live page in Chromium: what it shows in each state, on a phone and on a desktop, light and dark."""

import json
import threading
import time
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import made_live_page
import numpy as np
import pytest

pytest.importorskip("websockets.sync.client")
from made_browser import CHROMIUM, Browser
from made_live_page import JOINTS, LOST
from tauext_commission.budget import chosen_alarm
from tauext_commission.page import live_server
from tauext_lab.sim.arms import ARMS
from test_live_page import TOKEN, served

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"needs {CHROMIUM}")
PATIENCE_S = 30.0
RED = {
    "connecting": "learning: 40 s more",
    "learning": "learning: 40 s more",
    "silent": "no news from the loop",
    "lost": "the source is silent: no sample for 12 s",
}
"""States in which nothing is monitored, and why."""


MORE = "Counted: 9 false alarms in 24 h. That is more than stated: thresholds are raised."
ROWS = [
    ["8", "h", "45", "N", "118", "N"],
    ["1", "h", "36", "N", "94", "N"],
    ["10", "min", "27", "N", "71", "N"],
]
BANNERS = {
    "alarm": "plain: Monitored by b0004",
    "answered": "plain: Monitored by b0004",
    "partly": "partly: Not fully monitored\nOnly 97.2 % of the last minute was monitored: samples came late",
    "journal": f"bad: Monitored by b0004, but learning stopped\n{LOST}",
    "blind": "bad: HARDLY MONITORED\nOnly 61.3 % of the last minute was monitored: samples came late",
}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    one = Browser(tmp_path_factory.mktemp("chromium"))
    yield one
    one.close()


def until(true, what):
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, what
        time.sleep(0.1)


def test_the_address_with_the_token_opens_the_page_and_its_stream(browser, tmp_path):
    with (
        served(tmp_path, "alarm", "rig", host="0.0.0.0", token=TOKEN) as (port, loop),
        browser.page(f"http://127.0.0.1:{port}/?token={TOKEN}", 1280, 900, "light") as page,
    ):
        until(lambda: page.value("banner.innerText").startswith("Monitored by b0004"), "the stream")
        assert page.value("location.search") == "" and page.value("document.cookie") == ""
        page.value("document.getElementById('nothing').click()")
        until(lambda: loop.received == ["nothing 17"], "the answer")


ATTEMPTS = """
window.ends = 0; window.opened = 0;
const ended = () => { ends += 1; };
for (const host of ["127.0.0.1:PORT", "localhost:PORT"]) {
  const socket = new WebSocket(`ws://${host}/live`);
  socket.onopen = () => { opened += 1; }; socket.onclose = ended;
  fetch(`http://${host}/state`, { mode: "no-cors" }).finally(ended);
  fetch(`http://${host}/answer`, { mode: "no-cors", method: "POST", body: '{"what":"touched"}' }).finally(ended);
  fetch(`http://${host}/answer`, { method: "POST", headers: { "Content-Type": "application/json" },
    body: '{"what":"touched"}' }).catch(ended);
  const image = new Image(); image.onload = image.onerror = ended; image.src = `http://${host}/state`;
  const events = new EventSource(`http://${host}/live`);
  events.onopen = () => { opened += 1; }; events.onerror = () => { events.close(); ended(); };
}"""


class Other(BaseHTTPRequestHandler):
    """An empty page."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *arguments):
        pass


@contextmanager
def closing(server):
    yield
    server.shutdown()
    server.server_close()


def test_a_page_of_another_server_gets_nothing_but_a_link(browser, tmp_path, monkeypatch):
    """Another port of this computer is the same site, and another name of it is another one."""
    shown = []
    monkeypatch.setattr(live_server.Folder, "state", lambda folder: shown.append(folder) or {})
    other = ThreadingHTTPServer(("127.0.0.1", 0), Other)
    threading.Thread(target=other.serve_forever, args=(0.05,), daemon=True).start()
    with closing(other), served(tmp_path) as (port, loop):
        with browser.page(f"http://localhost:{other.server_port}/", 800, 600, "light") as page:
            page.value(ATTEMPTS.replace("PORT", str(port)))
            until(lambda: page.value("ends") == 12, "the end of all attempts")
            assert page.value("opened") == 0 and loop.received == [] and shown == []
            page.value(f"location.href = 'http://127.0.0.1:{port}/'")
            until(lambda: page.value("document.querySelector('#banner')?.className") == "good", "the page by a link")


WORD = "</script><script>pwned=1</script><img src=x onerror=pwned=1>\"'&\u202e\n" + "x" * 300
FIXED = ("state", "level", "answer", "touch", "health", "kind", "severity", "code", "wall", "flight")
"""Keys of the page's JSON whose texts are words of tauext."""


def hostile(value, key=""):
    """The value with a script in every text that a name, a bundle or a folder decides."""
    if isinstance(value, dict):
        return {one: hostile(inner, one) for one, inner in value.items()}
    if isinstance(value, list | tuple):
        return [hostile(one, key) for one in value]
    return f"{value}{WORD}" if isinstance(value, str) and value and key not in FIXED else value


@pytest.mark.parametrize("state", ["alarm", "learning", "connecting", "question"])
def test_no_name_is_a_script(browser, tmp_path, monkeypatch, state):
    """Names of joints, bundles, folders and events are texts of the page, whatever they hold."""
    plain, state_of, facts_of = made_live_page.line, live_server.Folder.state, live_server.Folder.arm
    monkeypatch.setattr(made_live_page, "line", lambda *words: hostile(plain(*words)))
    monkeypatch.setattr(live_server.Folder, "state", lambda folder: hostile(state_of(folder)))
    monkeypatch.setattr(live_server.Folder, "arm", lambda folder: hostile(facts_of(folder)))
    with (
        served(tmp_path, state, "rig") as (port, _),
        browser.page(f"http://127.0.0.1:{port}/", 1280, 900, "light") as page,
    ):
        until(lambda: "onerror" in page.value("document.body.innerText"), "the words")
        until(lambda: state != "alarm" or "pwned" in page.value("alarm.innerText"), "the alarm")
        time.sleep(0.3)  # a picture that fails runs its script later
        assert page.value("window.pwned") is None
        assert page.value("document.images.length + document.scripts.length") == 1  # the page's own script
        assert page.value("document.documentElement.scrollWidth") <= 1280  # nor does a long name break the page
        (tmp_path / "page.png").write_bytes(page.picture())


@pytest.mark.slow
def test_the_stream_begins_again_with_a_new_server(browser, tmp_path):
    with ExitStack() as stack:
        with served(tmp_path / "a") as (port, _):
            page = stack.enter_context(browser.page(f"http://127.0.0.1:{port}/", 800, 600, "light"))
            until(lambda: page.value("banner.className") == "good", "the stream")
        until(lambda: "no connection to tauext" in page.value("banner.innerText"), "its end")
        with served(tmp_path / "b", port=port):
            until(lambda: page.value("banner.className") == "good", "the new stream")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height", "scheme"), [(390, 844, "light"), (1280, 900, "dark")])
@pytest.mark.parametrize(
    ("state", "arm"),
    [
        ("connecting", "none"),
        ("learning", "none"),
        ("monitoring", "rig"),
        ("alarm", "seven"),
        ("answered", "rig"),
        ("unanswered", "rig"),
        ("question", "seven"),
        ("silent", "rig"),
        ("lost", "rig"),
        ("journal", "rig"),
        ("partly", "rig"),
        ("blind", "rig"),
    ],
)
def test_a_state_is_shown(browser, tmp_path, state, arm, width, height, scheme):
    with (
        served(tmp_path, state, arm) as (port, loop),
        browser.page(f"http://127.0.0.1:{port}/", width, height, scheme) as page,
    ):

        def text():
            return page.value("document.body.innerText")

        def banner():
            return page.value("banner.className + ': ' + banner.innerText")

        shown = (
            f"bad: NOTHING IS MONITORED\n{RED[state]}"
            if state in RED
            else BANNERS.get(state, "good: Monitored by b0004")
        )
        until(lambda: banner().startswith(shown), shown)
        until(lambda: arm == "none" or page.value("!!(arm && shown && shown.drawn.length)"), "the arm")
        assert page.value("document.documentElement.scrollWidth") <= width  # nothing hangs over
        if state in ("alarm", "answered"):
            until(lambda: page.value(GREEN) == [], "nothing green while the alarm stands")
            assert page.value("alarm.getBoundingClientRect().top < banner.getBoundingClientRect().top")
            assert page.value("alarm.children[0].innerText") == "Touched at joint2, 28 to 42 N"
        if state == "learning":
            assert page.value("!learn.hidden && learn.innerText.startsWith('about ')")
        if state == "monitoring":
            until(lambda: page.value("past.length > 250 && past[0].ms < heard_ms - 19000"), "the past of the curves")
            words = "Set for one false alarm in 8 h, extrapolated from 7 minutes: between 1 in 50 minutes and 1 in 60 h"
            assert page.value("document.getElementById('promise').innerText") == f"{words} (90 %)."
            proved = "The data alone prove 1 in 2.25 minutes."
            assert page.value("document.getElementById('proved').innerText") == proved
            assert page.value("document.getElementById('counted').innerText") == MORE
            assert "promise" not in text().lower()
            rows = page.value("[...document.querySelectorAll('#budgets tr')].map(row => row.innerText)")
            assert [row.split() for row in rows[1:]] == ROWS
            page.value("document.querySelectorAll('#budgets input')[1].click()")
            until(lambda: "1 in 1 h is chosen. Its thresholds take over" in text(), "the choice")
            assert chosen_alarm(tmp_path / "cell7").in_hours == 1.0
        if state == "alarm":
            until(lambda: "The alarm stands until" in text(), "the alarm")
            assert page.value("scrollTo(0, 900), scrollY > 300 && alarm.getBoundingClientRect().top >= 0"), (
                "out of view"
            )
            cut = (
                "[...document.querySelectorAll('.joint *')].filter(e => e.clientWidth && e.scrollWidth > e.clientWidth)"
            )
            assert page.value(f"{cut}.map(e => e.innerText)") == []
            page.value("document.getElementById('nothing').click()")
            until(lambda: loop.received == ["nothing 17"], "the answer")
        if state == "answered":
            until(lambda: "Answered: touched. The alarm ends once" in text(), "the answered alarm")
            assert page.value("[...document.querySelectorAll('#alarm button')].every(b => b.hidden)")
        if state == "unanswered":
            until(lambda: "No answer is also allowed" in text(), "the question")
            page.value("document.getElementById('touched').click()")
            until(lambda: loop.received == ["touched 16"], "the answer")
        if state == "question":
            until(lambda: "Shall the monitor learn this?" in text(), "the question")
            page.value("document.querySelector('#question button').click()")
            until(lambda: loop.received == ["learn yes"], "the answer")
        if state == "connecting":
            until(lambda: "wrong sign" in text() and "500 samples a second" in text(), "the findings")


@pytest.mark.slow
def test_the_arm_is_drawn_once_its_robot_file_is_there(browser, tmp_path):
    with served(tmp_path, "learning", "rig") as (port, _):
        file = tmp_path / "cell7" / "robot.xml"
        content = file.read_bytes()
        file.unlink()
        with browser.page(f"http://127.0.0.1:{port}/", 1280, 900, "light") as page:
            until(lambda: "no model of the arm" in page.value("document.body.innerText"), "the bars")
            file.write_bytes(content)
            until(lambda: page.value("!!(shown && shown.drawn.length)"), "the arm")
            assert "no model of the arm" not in page.value("document.body.innerText")


@pytest.mark.slow
def test_buttons_of_a_simulated_arm_are_control_lines(browser, tmp_path):
    with (
        served(tmp_path, "monitoring", "rig") as (port, loop),
        browser.page(f"http://127.0.0.1:{port}/", 390, 844, "light") as page,
    ):
        until(lambda: page.value("!document.getElementById('sim').hidden"), "the buttons")
        page.value("document.querySelectorAll('#sim button').forEach(b => b.click())")
        lines = {"load mass=1", "load mass=0", "friction factor=1 start=1.3 minutes=20", "stop", "move"}
        until(lambda: {f"sim {one}" for one in lines} <= set(loop.received), "the lines")


GREEN = """(() => {
  const one = document.createElement("i"); one.style.color = css("--green"); document.body.append(one);
  const green = getComputedStyle(one).color; one.remove();
  const is_green = e => [getComputedStyle(e).color, getComputedStyle(e).borderLeftColor].includes(green);
  return [...document.querySelectorAll("body *")].filter(e => e.offsetParent && is_green(e)).map(e => e.innerText);
})()"""
PRESS = """(() => {
  const s = shown.drawn.at(-1), x = (s.pa[0] + s.pb[0]) / 2, y = (s.pa[1] + s.pb[1]) / 2;
  const c = arm_canvas, r = c.getBoundingClientRect();
  const send = (kind, x, y) => c.dispatchEvent(
    new PointerEvent(kind, { clientX: r.left + x, clientY: r.top + y, pointerId: 1 }));
  c.setPointerCapture = () => {};
  send("pointerdown", x, y);
  send("pointermove", x + 60, y);
})()"""
SHOW = "[...document.querySelectorAll('button')].find(b => b.textContent === 'show trace').click()"


@pytest.mark.slow
def test_a_link_is_pushed_with_the_pointer_and_a_trace_is_drawn(browser, tmp_path):
    with (
        served(tmp_path, "monitoring", "rig") as (port, loop),
        browser.page(f"http://127.0.0.1:{port}/", 1280, 900, "light") as page,
    ):
        until(lambda: page.value("!!(shown && shown.drawn.length && state.commission)"), "the arm")
        page.value(PRESS)
        until(lambda: any(one.startswith("sim push joint=joint") for one in loop.received), "the push")
        size, why = page.value("push_words(live.q)")
        assert 20 <= int(size.removesuffix(" N")) <= 50 and (
            "below the threshold of" in why or why == "this force turns no joint"
        )
        near = "(pushed.x = pushed.x0 + 2, pushed.y = pushed.y0, push_words(live.q))"  # the arm moves on meanwhile
        assert page.value(near) == ["1 N", "drag further"]
        page.value("arm_canvas.dispatchEvent(new PointerEvent('pointerup', { pointerId: 1 }))")
        time.sleep(0.3)
        count = len(loop.received)
        time.sleep(0.5)
        assert len(loop.received) == count  # it is not renewed any more
        page.value(SHOW)
        until(lambda: page.value("document.querySelectorAll('canvas.trace').length") == 1, "the trace")


@pytest.mark.parametrize("arm", ["rig", "seven"])
def test_torques_of_a_push_are_those_of_mujoco(browser, tmp_path, arm):
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARMS[arm]().xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(7)
    with (
        served(tmp_path, "monitoring", arm) as (port, _),
        browser.page(f"http://127.0.0.1:{port}/", 1280, 900, "light") as page,
    ):
        until(lambda: page.value("!!(arm && shown)"), "the arm")
        for link in range(len(JOINTS[arm])):
            data.qpos[:] = rng.uniform(-1, 1, model.nq)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            point, force = rng.uniform(-1, 1, 3), rng.uniform(-50, 50, 3)
            turning = np.zeros((3, model.nv))
            body = model.jnt_bodyid[link]
            mujoco.mj_jac(model, data, turning, None, point, body)
            words = ", ".join(json.dumps(list(map(float, one))) for one in (data.qpos, point, force))
            found = page.value(f"((q, point, force) => torques_of(q, {link}, point, force))({words})")
            np.testing.assert_allclose(found, turning.T @ force, atol=1e-6)


def test_a_message_covers_no_button(browser, tmp_path):
    with (
        served(tmp_path, "alarm", "seven") as (port, _),
        browser.page(f"http://127.0.0.1:{port}/", 390, 844, "light") as page,
    ):
        until(lambda: page.value("!document.getElementById('alarm').hidden"), "the alarm")
        page.value("say('stored: touched; this motion is never trained on')")
        over = """(() => {
          const t = toast.getBoundingClientRect(), meets = r => r.width && r.top < t.bottom && r.bottom > t.top
            && r.left < t.right && r.right > t.left;
          return [...document.querySelectorAll("button")].filter(b => meets(b.getBoundingClientRect())).length;
        })()"""
        assert page.value("toast.getBoundingClientRect().height > 10") and page.value(over) == 0
