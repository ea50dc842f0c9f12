"""Where the viewer listens."""

import errno
import ipaddress
import socket

from spacesim.data.errors import InputError

ATTEMPTS = 20  #: ports tried, one after another, where the first is taken; chosen
MOST_PORT = 65535


def free_port(host: str, port: int) -> int:
    """`port`, or the next one that is free. Raises InputError for a host that is no address of this machine, a port out
    of range, one that only the administrator may open, and where ATTEMPTS ports are taken."""
    if not 0 <= port <= MOST_PORT:
        raise InputError(f"--port: expected 0 to {MOST_PORT}, found {port}")
    last = min(port + ATTEMPTS - 1, MOST_PORT)
    for candidate in range(port, last + 1):
        try:
            return _bound(host, candidate)
        except OSError as error:
            if error.errno == errno.EACCES:
                raise InputError(f"--port: expected a port that you may open, found {candidate}; try 8080") from None
            if error.errno != errno.EADDRINUSE:
                reason = error.strerror or error
                raise InputError(
                    f"--host: expected a name or address of this machine, found {host!r} ({reason})"
                ) from None
        except UnicodeError:
            raise InputError(f"--host: expected a name or address of this machine, found {host!r}") from None
    raise InputError(f"--port: expected a free port, found {port} to {last} taken")


def _bound(host: str, port: int) -> int:
    """The port that can be bound; what the system chooses for 0."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind, protocol) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(address)
        return int(one.getsockname()[1])


def is_loopback(host: str) -> bool:
    """Whether only this machine can connect."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def url(host: str, port: int) -> str:
    """What to open in a browser."""
    everywhere = host in ("0.0.0.0", "::", "")
    name = "localhost" if everywhere else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"
