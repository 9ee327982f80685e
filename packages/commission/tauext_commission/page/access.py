"""Who may connect to a page's server, and on which port it listens."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

from tauext.errors import ConfigError

LOOPBACK = ("localhost", "127.0.0.1", "::1")
PORTS = 20
"""Number of ports that are tried from the wanted one on."""


def is_own_name(name: str, host: str) -> bool:
    """Whether a browser that shows this page may call the server so.

    A page of another host may give its own name this machine's address and then pass for the server (DNS rebinding), so
    a name counts where no other machine can take it: loopback, an address in figures, what this machine calls itself.

    Args:
        host: address that the server listens on.
    """
    name = name.strip("[]").lower()
    if name in LOOPBACK or host in LOOPBACK:
        return name in LOOPBACK
    own = socket.gethostname().lower()
    if name in (host.lower(), own, f"{own}.local", socket.getfqdn().lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_host(host_header: str, host: str) -> bool:
    """Whether a Host header has a name of this server, see is_own_name()."""
    try:
        called = urlsplit(f"//{host_header}")
        return not called.path and is_own_name(called.hostname or "", host)
    except ValueError:
        return False


def is_from_own_page(method: str, path: str, headers: Mapping[str, str]) -> bool:
    """Whether a request comes from the server's own page, or a person opens the page.

    Browsers send Origin with every POST and WebSocket, and with what one page requests of another's server.
    Sec-Fetch-Site comes with every request to this computer (`none`: typed), but not to an address of the network.

    Args:
        headers: of the request; their names in any case.
    """
    own, origin, site = f"http://{headers.get('Host')}", headers.get("Origin"), headers.get("Sec-Fetch-Site")
    if origin != own and (origin is not None or method != "GET" or path == "/live"):
        return False
    if site in (None, "same-origin") or site == "none" and method == "GET":
        return True
    return method == "GET" and path == "/" and headers.get("Sec-Fetch-Dest") == "document"  # a link


def listening_socket(host: str, wanted: int) -> socket.socket:
    """A socket that listens at the first free port from the wanted one on; no other process can take it afterwards.

    Raises:
        ConfigError: none of them is free, or the host is not one of this machine.
    """
    if not 1 <= wanted <= 65535:
        raise ConfigError(f"port = {wanted} must be 1 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for port in range(wanted, min(wanted + PORTS, 65536)):
        try:
            return socket.create_server((host, port), family=family)
        except PermissionError as error:
            raise ConfigError(f"port = {wanted} needs rights that this user has not; take one from 1024") from error
        except (socket.gaierror, TypeError, UnicodeError) as error:
            raise ConfigError(f"host = {host} must be an address of this machine, e.g. 127.0.0.1") from error
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise ConfigError(f"host = {host} must be an address of this machine ({error.strerror})") from error
    raise ConfigError(f"port = {wanted}: it and the {PORTS - 1} after it are in use; choose another with --port")
