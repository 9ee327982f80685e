"""The live page's server: who may use it, what it shows of the folder and the loop, and which lines it sends."""

import gzip
import http.client
import itertools
import json
import socket
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from made_live_page import JOINTS, FakeLoop, line, serving, write_folder
from tauext_commission import journal
from tauext_commission.budget import chosen_alarm
from tauext_commission.page import connections, live_server
from tauext_commission.page.access import is_own_name, listening_socket
from tauext_commission.page.live_arm import arm_facts
from tauext_commission.page.live_server import line_of
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tauext.config import AlarmConfig
from tauext.data.labels import Label
from tauext.errors import ConfigError

PATIENCE_S = 20.0
TOKEN = "right-token"


@contextmanager
def served(folder, state="monitoring", arm="rig", host="127.0.0.1", port=0, token=""):
    write_folder(folder / "cell7", state, arm)
    loop = FakeLoop(folder, state, arm, period_s=0.02)
    try:
        with serving(host, port, folder / "cell7", loop.live, loop.control, token) as port:
            yield port, loop
    finally:
        loop.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("p")) as both:
        yield both


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A page for a network, which needs a token."""
    with served(tmp_path_factory.mktemp("g"), host="0.0.0.0", token=TOKEN) as both:
        yield both


def get(port, path="/", **headers):
    return ask(port, "GET", path, None, headers)


def post(port, path, body, **headers):
    own = {"Origin": f"http://127.0.0.1:{port}", "Content-Type": "application/json"} | headers
    body = body if isinstance(body, bytes) else json.dumps(body).encode()
    return ask(port, "POST", path, body, {name: value for name, value in own.items() if value is not None})


def ask(port, method, path, body, headers):
    """Status, content and headers of the answer."""
    asked = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    asked.request(method, path, body, headers)
    answer = asked.getresponse()
    content = answer.read()
    asked.close()
    return answer.status, content, answer.headers


def listen(port, origin=None, **headers):
    """The stream of lines."""
    origin = origin or f"http://127.0.0.1:{port}"
    wait = {"open_timeout": PATIENCE_S, "close_timeout": 0.5}
    return connect(f"ws://127.0.0.1:{port}/live", origin=origin, additional_headers=headers, **wait)


# --- What it shows.


def test_the_page_is_one_file_that_loads_nothing_else(page):
    status, content, headers = get(page[0])
    assert status == 200 and b"NOTHING IS MONITORED" in content
    assert b"http://" not in content and b"https://" not in content and b"src=" not in content
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "script-src 'sha256-" in policy and "frame-ancestors 'none'" in policy


def test_the_state_is_the_folders_files_and_follows_them(tmp_path):
    with served(tmp_path, "monitoring") as (port, _):
        state = json.loads(get(port, "/state")[1])
        assert state["name"] == "cell7" and state["active"] == {"bundle": "b0004"}
        assert [one["id"] for one in state["events"]] == [15, 16] and len(state["history"]) == 10
        journal.append(tmp_path / "cell7", "label", asdict(Label(16, 1, 1, 2, "nothing", "page", "")))
        (tmp_path / "cell7" / "coverage.json").write_text('{"secon')
        state = json.loads(get(port, "/state")[1])
        assert state["events"][-1]["answer"] == "nothing" and state["events"][-1]["sentence"]
        assert state["coverage"]["kept_s"] == 3700  # the last whole one


@pytest.mark.parametrize("state", ["connecting", "learning"])
def test_a_folder_without_bundles_is_shown_too(tmp_path, state):
    with served(tmp_path, state, "none") as (port, _):
        shown = json.loads(get(port, "/state")[1])
        assert shown["active"] is None and shown["history"] == shown["events"] == []
        assert json.loads(get(port, "/arm")[1])["links"] == []


def test_a_robot_file_that_comes_after_the_joints_is_noticed(tmp_path):
    with served(tmp_path, "learning") as (port, _):
        file = tmp_path / "cell7" / "robot.xml"
        shown, content = json.loads(get(port, "/state")[1])["robot"], file.read_bytes()
        file.unlink()
        assert shown and json.loads(get(port, "/state")[1])["robot"] == ""
        assert json.loads(get(port, "/arm")[1])["links"] == []
        file.write_bytes(content)
        assert json.loads(get(port, "/state")[1])["robot"] and json.loads(get(port, "/arm")[1])["links"]


def test_lines_of_the_loop_arrive_and_their_end_is_seen(page):
    port, loop = page
    with listen(port) as stream:
        found = [json.loads(stream.recv(PATIENCE_S)) for _ in range(8)]
        assert {one["bundle"] for one in found} == {"b0004"} and found[-1]["t_ns"] > found[0]["t_ns"]


def test_a_trace_is_thinned_and_keeps_the_peak(page):
    status, content, _ = get(page[0], "/event/16")
    trace = json.loads(content)
    assert status == 200 and len(trace["t_s"]) == 800 and max(trace["tau"][1]) > 11.5
    assert trace["t_s"][0] == pytest.approx(-3, abs=0.02)
    for path in ("/event/15", "/event/99", "/event/-1", "/event/../x", "/event/", "/nothing", "/event/" + "9" * 30):
        assert get(page[0], path)[0] == 404, path


def test_the_arm_of_a_page_is_where_the_core_says(page):
    """Both ends of every shape, by the arithmetic of the page, against the core's kinematics."""
    facts = json.loads(get(page[0], "/arm")[1])
    assert facts["joints"] == list(JOINTS["rig"]) and len(facts["links"]) == 2 and facts["shapes"]
    q = np.array([0.4, -0.9])
    rotation, place = np.eye(3), np.zeros(3)
    for link, angle in zip(facts["links"], q, strict=True):  # the rig is a chain
        place = place + rotation @ link["translation"]
        turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        rotation = rotation @ np.reshape(link["rotation"], (3, 3)) @ turn
    assert np.allclose(place, tip_of_rig(q), atol=1e-9)


def tip_of_rig(q):
    """Origin of the second link, by MuJoCo."""
    import mujoco
    from tauext_lab.sim.arms import rig_arm

    model = mujoco.MjModel.from_xml_string(rig_arm().xml)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return data.xanchor[1]


def test_an_arm_without_shapes_or_model_is_drawn_nevertheless(tmp_path):
    from tauext_lab.sim.arms import rig_arm

    from tauext.robot.write import write_placeholder, write_robot

    assert arm_facts(None, ("a",))["links"] == []
    assert arm_facts(write_placeholder(["a"], tmp_path), ("a",))["links"] == []
    (tmp_path / "damaged.urdf").write_text("<robot")
    assert arm_facts(tmp_path / "damaged.urdf", ("a",))["notes"]
    (tmp_path / "rig.xml").write_text(rig_arm().xml)
    bare = write_robot(tmp_path / "rig.xml", tmp_path, {})  # without shapes
    facts = arm_facts(bare, JOINTS["rig"])
    assert len(facts["shapes"]) >= 2 and all(one["radius"] > 0 for one in facts["shapes"])


# --- What it sends.


@pytest.mark.parametrize(
    "path, body, sent",
    [
        ("/answer", {"what": "touched", "id": 17}, "touched 17"),
        ("/answer", {"what": "nothing"}, "nothing"),
        ("/reset", {}, "acknowledge"),
        ("/learn", {"yes": True}, "learn yes"),
        ("/learn", {"yes": False}, "learn no"),
        (
            "/push",
            {"joint": "joint2", "point": [0, 0.1, 0.2], "force": [1, -40, 3.5]},
            "sim push joint=joint2 force=1,-40,3.5 point=0,0.1,0.2 seconds=0.5",
        ),
        ("/sim", {"load": 1}, "sim load mass=1"),
        ("/sim", {"load": 0.2}, "sim load mass=0.2"),
        ("/sim", {"load": 0}, "sim load mass=0"),
        ("/sim", {"cold": 1.3}, "sim friction factor=1 start=1.3 minutes=20"),
        ("/sim", {"move": True}, "sim move"),
        ("/sim", {"move": False}, "sim stop"),
    ],
)
def test_a_button_is_a_control_line(page, path, body, sent):
    port, loop = page
    assert post(port, path, body)[:2] == (200, b'{"answer": "ok"}')
    assert loop.received[-1] == sent


@pytest.mark.parametrize(
    "path, body",
    [
        ("/answer", {}),
        ("/answer", {"what": "stop"}),
        ("/answer", {"what": "touched", "id": "17\nstop"}),
        ("/answer", {"what": "touched", "id": 1.5}),
        ("/answer", {"what": "touched", "id": True}),
        ("/answer", {"what": "touched", "id": -1}),
        ("/answer", {"what": ["touched"]}),
        ("/reset", {"x": 1}),
        ("/learn", {"yes": 1}),
        ("/learn", {}),
        ("/push", {"joint": "a\nstop", "point": [0, 0, 0], "force": [1, 0, 0]}),
        ("/push", {"joint": "a b", "point": [0, 0, 0], "force": [1, 0, 0]}),
        ("/push", {"joint": "a", "point": [0, 0], "force": [1, 0, 0]}),
        ("/push", {"joint": "a", "point": [0, 0, 0], "force": [1e99, 0, 0]}),
        ("/push", {"joint": "a", "point": [0, 0, 0], "force": [float("nan"), 0, 0]}),
        ("/push", {"joint": "a", "point": [0, 0, True], "force": [0, 0, 0]}),
        ("/sim", {}),
        ("/sim", {"load": 1, "move": True}),
        ("/sim", {"load": True}),
        ("/sim", {"load": "1"}),
        ("/sim", {"load": -1}),
        ("/sim", {"load": 6}),
        ("/sim", {"load": float("nan")}),
        ("/sim", {"cold": 0.5}),
        ("/sim", {"move": 1}),
        ("/sim", {"off": 1}),
    ],
)
def test_any_other_request_sends_nothing(page, path, body):
    port, loop = page
    before = list(loop.received)
    assert line_of(path, body) is None
    assert post(port, path, body)[0] == 400 and post(port, "/nothing", body)[0] == 404 and loop.received == before


@pytest.mark.parametrize(
    "body", [{}, {"per_hour": True}, {"per_hour": -1}, {"per_hour": "1"}, {"per_hour": 1, "x": 1}, []]
)
def test_a_malformed_budget_is_refused(page, body):
    assert post(page[0], "/budget", body)[:2] == (400, b"the request is malformed\n")


def test_a_budget_of_the_table_is_chosen_and_any_other_is_refused(tmp_path):
    with served(tmp_path) as (port, loop):
        folder = tmp_path / "cell7"
        limits = json.loads(get(port, "/state")[1])["limits"]
        assert limits["bundle"] == "b0004" and limits["per_hour"] == limits["chosen_per_hour"] == 0.125
        assert limits["proved_words"] == "The data alone prove 1 in 2.25 minutes."
        status, content, _ = post(port, "/budget", {"per_hour": 3})
        rule = "must be one of 0.125 (1 in 8 h), 1 (1 in 1 h), 6 (1 in 10 minutes)"
        assert status == 409 and json.loads(content)["answer"] == f"error: false alarms an hour = 3 {rule}"
        assert chosen_alarm(folder) == AlarmConfig()
        assert post(port, "/budget", {"per_hour": 6})[0] == 200 and loop.received == []
        assert chosen_alarm(folder).in_hours == 1 / 6
        state = json.loads(get(port, "/state")[1])
        assert state["limits"]["chosen_per_hour"] == 6 and state["limits"]["per_hour"] == 0.125
        assert state["history"][-1]["words"].startswith("target false alarm rate 1 in 10 minutes")
        (folder / "bundles" / "b0004.tauext").unlink()
        status, content, _ = post(port, "/budget", {"per_hour": 1})
        assert status == 409 and b"there is no table of target false alarm rates yet" in content


def test_a_refusal_and_a_loop_that_is_gone_are_reported(tmp_path):
    with served(tmp_path) as (port, loop):
        loop.answer = "error: nothing: there was no alarm yet"
        assert post(port, "/answer", {"what": "nothing"})[:2] == (409, json.dumps({"answer": loop.answer}).encode())
        loop.close()
        loop.control.unlink()
        status, content, _ = post(port, "/answer", {"what": "nothing"})
        assert status == 409 and b"the loop does not answer" in content


# --- Who may connect.


def test_only_its_own_page_may_send(page):
    port, loop = page
    before = list(loop.received)
    body = {"what": "touched"}
    for origin in ("http://evil.example", f"https://127.0.0.1:{port}", "http://127.0.0.1:1", "null", None, ""):
        assert post(port, "/answer", body, Origin=origin)[0] == 403, origin
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None, ""):
        assert post(port, "/answer", body, **{"Content-Type": kind})[0] == 415, kind
    for length, status in (("1001", 413), ("9" * 18, 413), ("-1", 400), ("x", 400), ("", 400), ("9" * 20, 400)):
        assert post(port, "/answer", body, **{"Content-Length": length})[0] == status, length
    for raw in (b"", b"[]", b"nul", b"\xff", b"[" * 900):
        assert post(port, "/answer", raw)[0] == 400, raw
    assert loop.received == before


def test_a_name_that_another_host_could_own_is_turned_away(page):
    """DNS rebinding: the browser believes that evil.example is this machine."""
    port = page[0]
    for name, status in (
        ("evil.example", 403),
        ("192.168.0.7", 403),
        ("localhost", 200),
        ("127.0.0.1", 200),
        ("", 403),
    ):
        for path in ("/", "/state", "/?token=x"):
            wanted = 303 if status == 200 and "?" in path else status
            assert get(port, path, Host=f"{name}:{port}")[0] == wanted, (name, path)
    with open_wire(port) as wire:
        wire.sendall(b"GET /state HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n")
        assert wire.recv(20).split()[1] == b"400"


def test_a_page_for_a_network_needs_the_token_everywhere(guarded):
    port, loop = guarded
    for path in ("/", "/state", "/arm", "/live", "/event/16"):
        assert get(port, path)[0] == 403 and get(port, path, Cookie="tauext=wrong")[0] == 403, path
    assert post(port, "/answer", {"what": "touched"})[0] == 403 and loop.received == []
    assert get(port, "/", Cookie=b"tauext=\xff\xfe")[0] == get(port, "/?token=%ff%00")[0] == 403
    assert get(port, "/?token=wrong")[0] == 403 and get(port, "/?token=")[0] == 403
    status, _, headers = get(port, f"/?token={TOKEN}")
    cookie = headers["Set-Cookie"]
    assert (status, headers["Location"]) == (303, "/") and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    shown = {"Cookie": cookie.partition(";")[0]}
    assert get(port, "/", **shown)[0] == 200
    assert post(port, "/answer", {"what": "touched"}, **shown)[0] == 200 and loop.received == ["touched"]


def test_a_server_for_a_network_goes_by_addresses_and_its_own_name():
    own = socket.gethostname()
    for name in ("192.168.0.7", "[fe80::1]", own, f"{own}.local", "localhost"):
        assert is_own_name(name, "0.0.0.0"), name
    assert not is_own_name("evil.example", "0.0.0.0")
    assert not is_own_name("192.168.0.7", "127.0.0.1")


def test_a_busy_port_is_passed_over(monkeypatch):
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with (
            listening_socket("127.0.0.1", port) as found,
            listening_socket("127.0.0.1", port) as another,
        ):
            assert port < found.getsockname()[1] < another.getsockname()[1]
        monkeypatch.setattr("tauext_commission.page.access.PORTS", 1)
        with pytest.raises(ConfigError, match=f"port = {port}: .* in use; choose another with --port"):
            listening_socket("127.0.0.1", port)
    with pytest.raises(ConfigError, match="port = 0 must be 1 to 65535"):
        listening_socket("127.0.0.1", 0)
    for host in ("192.0.2.1", "\xe4\udcff"):
        with pytest.raises(ConfigError, match="must be an address of this machine"):
            listening_socket(host, 8080)


# --- Strangers.


@pytest.mark.parametrize(
    "path, headers, status",
    [
        ("/", {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}, 200),  # typed
        ("/?token=x", {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}, 303),
        ("/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}, 200),
        ("/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"}, 403),
        ("/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, 403),
        ("/state", {"Sec-Fetch-Site": "same-origin"}, 200),
        ("/state", {"Sec-Fetch-Site": "same-site"}, 403),  # another port of this computer
        ("/state", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}, 403),
        ("/state", {"Sec-Fetch-Site": "x"}, 403),
        ("/state", {"Origin": "http://evil.example"}, 403),
        ("/arm", {"Origin": "null"}, 403),
        ("/event/16", {"Origin": "http://127.0.0.1:1"}, 403),
        ("/none", {"Origin": "http://evil.example"}, 403),
    ],
)
def test_another_page_gets_nothing_and_a_person_gets_the_page(page, path, headers, status):
    assert get(page[0], path, **headers)[0] == status


def test_another_page_gets_no_stream(page):
    port = page[0]
    for origin, headers in (
        ("http://evil.example", {}),
        (f"https://127.0.0.1:{port}", {}),
        ("null", {}),
        (None, {"Sec-Fetch-Site": "cross-site"}),
    ):
        with pytest.raises(InvalidStatus, match="403"):
            listen(port, origin, **headers)
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    assert get(port, "/live", **upgrade, **{"Sec-WebSocket-Key": "A" * 22 + "=="})[0] == 403  # without an origin
    assert get(port, "/live", Origin=f"http://127.0.0.1:{port}")[0] == 400  # no WebSocket
    with listen(port) as stream:
        stream.send("x")
        with pytest.raises(ConnectionClosed):
            while True:
                stream.recv(PATIENCE_S)


def raw(port, content, ends=False):
    """What the server answers to these bytes until it closes."""
    with open_wire(port) as wire:
        found = b""
        with suppress(OSError):
            wire.sendall(content)
            if ends:
                wire.shutdown(socket.SHUT_WR)
            while more := wire.recv(1 << 16):
                found += more
        return found


PACKED = gzip.compress(b'{"what":"touched"}', mtime=0)


@pytest.mark.parametrize(
    "body, extra, status",
    [
        (b"12\r\n" + b'{"what":"touched"}' + b"\r\n0\r\n\r\n", b"", b"200"),
        (b"5\r\n{}   \r\n0\r\n\r\n", b"", b"400"),
        (b"7d0\r\n" + b" " * 2000 + b"\r\n0\r\n\r\n", b"", b"413"),
        (b"-1\r\nx\r\n0\r\n\r\n", b"", b"400"),
        (b"zz\r\n", b"", b"400"),
        (b"12\r\n" + b'{"what":"touched"}' + b"\r\n0\r\n\r\n", b"Content-Length: 18\r\n", b"400"),  # two lengths
        (b"%x\r\n" % len(PACKED) + PACKED + b"\r\n0\r\n\r\n", b"Content-Encoding: gzip\r\n", b"400"),
    ],
)
def test_a_body_in_chunks_is_bounded_too(page, body, extra, status):
    port, loop = page
    before = len(loop.received)
    head = f"POST /answer HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
    head = head.encode() + b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n" + extra + b"\r\n"
    assert raw(port, head + body).split()[1] == status
    assert len(loop.received) - before == (status == b"200")


def test_only_the_first_of_requests_in_one_packet_is_answered(page):
    port, loop = page
    before, body = len(loop.received), b'{"what":"nothing"}'
    head = f"POST /answer HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
    one = head.encode() + b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(body) + body
    assert raw(port, one * 50).count(b"HTTP/1.1") == 1 and len(loop.received) == before + 1


def test_paths_lead_nowhere_else(page):
    for path in (
        "/../../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/event/..%2f..%2fcommission.json",
        "/event/16%00",
        "/event/16/../15",
        "/events.jsonl",
        "//127.0.0.1/state",
        "/" + "a" * 5000,
        "*",
    ):
        answer = raw(page[0], f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{page[0]}\r\n\r\n".encode())
        assert answer.split()[1] in (b"400", b"403", b"404"), (path, answer)


def test_the_bytes_of_a_request_are_bounded_as_a_whole(page):
    head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page[0]}\r\n".encode()
    fields = [b"a%d: %s\r\n" % (k, b"b" * 4000) for k in range(40)]
    assert b" 200 " in raw(page[0], head + b"".join(fields[:5]) + b"\r\n")
    assert raw(page[0], head + b"".join(fields) + b"\r\n") == b""


def test_bytes_that_are_no_http_end_their_connection_without_a_word(page, capfd):
    port, own = page[0], f"Host: 127.0.0.1:{page[0]}\r\n".encode()
    for content in (
        b"\x16\x03\x01\x02garbage\r\n\r\n",
        b"\xff" * 5000,
        b"\r\n",
        b"",
        b"GET / HTTP/1.1\r\n" + own + b"a: b\r\n" * 500 + b"\r\n",
        b"GET / HTTP/1.1\r\n" + own + b"a: " + b"b" * 20_000 + b"\r\n\r\n",
        b"GET / HTTP/9.9\r\n" + own + b"\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"BREW / HTTP/1.1\r\n" + own + b"\r\n",
        b"HEAD / HTTP/1.1\r\n" + own + b"\r\n",
        b"GET / HTTP/1.1\r\n" + own + b"Cookie: tauext=\xff; \x80\r\n\r\n",
    ):
        answers = raw(port, content, ends=True)
        assert b" 200 " not in answers or content.endswith(b"\x80\r\n\r\n"), content
    assert get(port)[0] == 200 and capfd.readouterr().err == ""


def dripped(port, content):
    """Time until the server closes a connection that sends a byte every 50 ms, [s]."""
    began_s = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), timeout=0.05) as wire, suppress(ConnectionError):
        for byte in itertools.cycle(content):
            wire.sendall(bytes([byte]))
            with suppress(TimeoutError):
                if not wire.recv(1 << 16):
                    break
            assert time.monotonic() < began_s + PATIENCE_S, "it is held for ever"
    return time.monotonic() - began_s


def test_the_time_limit_is_that_of_the_whole_request(page, monkeypatch):
    port, own = page[0], f"127.0.0.1:{page[0]}"
    monkeypatch.setattr(connections, "REQUEST_S", 0.4)
    assert 0.3 < dripped(port, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\na: aaaaaaaa\r\n") < 3
    head = f"POST /answer HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nContent-Type: application/json\r\n"
    with open_wire(port) as wire:
        wire.sendall(f"{head}Content-Length: 900\r\n\r\n".encode())
        assert wire.recv(100) == b""  # its body does not come


def test_a_stream_that_is_not_read_ends_and_one_that_is_read_lasts(page, monkeypatch):
    monkeypatch.setattr(live_server, "ALIVE_S", 0.3)
    with listen(page[0]) as stream, unread_stream(page[0]) as wire:
        began_s = time.monotonic()
        while not is_closed(wire):
            assert time.monotonic() < began_s + PATIENCE_S
            lines_for(stream, 0.05)  # all of them: pings wait behind lines that nobody takes
        lines_for(stream, 0.5)


def open_wire(port):
    return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)


def lines_for(stream, seconds):
    """Read a stream for this long."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        stream.recv(PATIENCE_S)


def unread_stream(port, cookie=""):
    """A connection that asks for the stream and reads nothing."""
    wire = open_wire(port)
    own = f"127.0.0.1:{port}"
    wire.sendall(
        f"GET /live HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\nCookie: {cookie}\r\n\r\n".encode()
    )
    return wire


def is_closed(wire):
    """Whether the server has closed this connection, which nobody reads: its end stays behind lines that wait there."""
    own, other = (f":{port:04X}" for port in (wire.getpeername()[1], wire.getsockname()[1]))
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()]
    return not any(row[1].endswith(own) and row[2].endswith(other) and row[3] == "01" for row in rows)


@pytest.mark.parametrize("token", ["", TOKEN])
def test_slow_connections_and_unread_streams_keep_nobody_out(tmp_path, token):
    """24 slow connections and many unread streams stay open; a page is loaded, and its stream goes on."""
    own = {"Cookie": f"tauext={token}"} if token else {}
    with served(tmp_path, host="0.0.0.0" if token else "127.0.0.1", token=token) as (port, _), ExitStack() as stack:
        early = stack.enter_context(listen(port, **own)) if token else None
        for _ in range(24):
            slow = stack.enter_context(open_wire(port))
            slow.sendall(b"GET / HTTP/1.1\r\nHo")
        for _ in range(200):
            stack.enter_context(unread_stream(port))
        took_s = []
        for path in ("/", "/state", "/arm"):
            began_s = time.monotonic()
            assert get(port, path, **own)[0] == 200
            took_s.append(time.monotonic() - began_s)
        assert took_s[0] < 2.0
        for stream in filter(None, (stack.enter_context(listen(port, **own)), early)):
            for _ in range(3):
                stream.recv(PATIENCE_S)


def test_slow_requests_go_first_then_young_streams_and_whoever_has_the_token_last(monkeypatch, tmp_path):
    monkeypatch.setattr(connections, "MOST_OF_ADDRESS", 4)
    monkeypatch.setattr(connections, "FRESH_S", 0.2)
    monkeypatch.setattr(connections, "PROVEN_S", 0.4)
    with served(tmp_path) as (port, _), ExitStack() as stack:
        slow = stack.enter_context(open_wire(port))
        old = stack.enter_context(listen(port))
        lines_for(old, 0.5)
        young, fresh = stack.enter_context(listen(port)), stack.enter_context(open_wire(port))
        more = [stack.enter_context(listen(port))]  # there are four of them now
        assert slow.recv(1) == b""
        more += [stack.enter_context(listen(port)) for _ in range(3)]
        with pytest.raises(ConnectionClosed):
            lines_for(young, PATIENCE_S)
        lines_for(old, 0.1)
        fresh.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert b" 200 " in fresh.recv(100)
    with served(tmp_path / "g", host="0.0.0.0", token=TOKEN) as (port, _), ExitStack() as stack:
        own = {"Cookie": f"tauext={TOKEN}"}
        mine = [stack.enter_context(listen(port, **own)) for _ in range(3)]
        for _ in range(20):
            stack.enter_context(open_wire(port))
            assert get(port, **own)[0] == 200
        for one in mine:
            lines_for(one, 0.3)


def test_the_stand_in_writes_lines_of_the_right_kind():
    """The fields that the page reads are those of the loop."""
    from tauext_commission.live import LiveSink

    assert set(line("alarm", JOINTS["rig"], 0.0)) <= set(line_fields(LiveSink)), "the page reads what no loop sends"


def line_fields(kind):
    import ast
    import inspect

    tree = ast.parse(inspect.getsource(inspect.getmodule(kind)))
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
