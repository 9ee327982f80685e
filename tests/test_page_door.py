"""Who the demo's server talks to: its own page, and nobody whom another page sent; garbage ends one connection."""

import http.client
import socket

import pytest

from tauext.errors import ConfigError
from tauext.page.door import free_port, is_own_name
from tauext.page.page import open_server, why_not

viser = pytest.importorskip("viser", reason="the page needs the extra tauext[live]")
sync = pytest.importorskip("websockets.sync.client")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

PROTOCOL = f"viser-v{viser.__version__}"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def port():
    server = open_server("127.0.0.1", free_port("127.0.0.1", 9600))
    yield server.get_port()
    server.stop()


def page(port: int, name: str = "127.0.0.1", **options):
    """A connection as the server's own page makes it, or with something else in its place."""
    options = {"origin": f"http://{name}:{port}", "subprotocols": [PROTOCOL], "compression": None} | options
    return sync.connect(f"ws://127.0.0.1:{port}", additional_headers={}, **options)


def test_its_own_page_is_let_in(port):
    with page(port) as connection:
        assert connection.recv(timeout=PATIENCE_S)


@pytest.mark.parametrize("origin", ["http://evil.example", "https://127.0.0.1:{}", "http://127.0.0.1:1", "null", None])
def test_a_page_of_another_origin_is_turned_away(port, origin, capfd):
    with pytest.raises(InvalidStatus, match="403"):
        page(port, origin=origin and origin.format(port))
    assert capfd.readouterr().err == ""


def test_a_name_that_another_host_could_own_is_turned_away(port):
    """DNS rebinding: the browser believes that evil.example is this machine."""
    for name, status in (("evil.example", 403), ("localhost", 200), ("127.0.0.1", 200)):
        asked = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        asked.request("GET", "/", headers={"Host": f"{name}:{port}"})
        assert asked.getresponse().status == status, name


@pytest.mark.parametrize("garbage", [b"", b"\xc1", b"\x93\x01\x02", b"\x81\xa4type\xa4none", "text", b"\x00" * 100_000])
def test_garbage_ends_its_connection_without_a_word(port, garbage, capfd):
    with page(port) as connection, page(port) as other:
        connection.send(garbage)
        with pytest.raises(ConnectionClosed):
            while True:
                connection.recv(timeout=PATIENCE_S)
        assert other.recv(timeout=PATIENCE_S)
    said = capfd.readouterr()
    assert said.out == said.err == ""


def test_bytes_that_are_no_http_are_dropped_without_a_word(port, capfd):
    for raw in (b"\x16\x03\x01\x02garbage\r\n\r\n", b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"\xff" * 5000):
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as wire:
            wire.sendall(raw)
            wire.shutdown(socket.SHUT_WR)
            while wire.recv(4096):
                pass
    with page(port) as connection:
        assert connection.recv(timeout=PATIENCE_S)
    assert capfd.readouterr().err == ""


def test_a_server_for_a_network_goes_by_addresses_and_its_own_name():
    own = socket.gethostname()
    for name in ("192.168.0.7", "[fe80::1]", own, f"{own}.local", "localhost"):
        assert is_own_name(name, "0.0.0.0"), name
    assert not is_own_name("evil.example", "0.0.0.0")
    assert not is_own_name("192.168.0.7", "127.0.0.1")
    headers = {"Host": "192.168.0.7:80", "Upgrade": "websocket", "Origin": "http://192.168.0.7:80"}
    assert why_not(headers | {"Sec-WebSocket-Protocol": f"x, {PROTOCOL}"}, "0.0.0.0", PROTOCOL) == ""
    assert why_not(headers | {"Sec-WebSocket-Protocol": "viser-v0"}, "0.0.0.0", PROTOCOL)


def test_a_host_that_no_name_can_be_is_refused():
    with pytest.raises(ConfigError, match="must be an address of this machine"):
        free_port("\xe4\udcff", 8123)
