"""Where the viewer listens, and what browsers may call it."""

import errno
import ipaddress
import re
import socket
from dataclasses import dataclass

from spacesim.data.errors import InputError

ATTEMPTS = 20  #: ports tried, one after another, where the first is taken; chosen
MOST_PORT = 65535
LOOPBACK = (ipaddress.ip_network("127.0.0.0/8"), ipaddress.ip_network("::1/128"))
EVERYTHING = (ipaddress.ip_network("0.0.0.0/0"), ipaddress.ip_network("::/0"))

_WILDCARDS = ("0.0.0.0", "::", "")  # hosts that stand for all addresses of this machine
_HOST = re.compile(r"(\[[0-9a-f:.]{2,45}\]|[a-z0-9][a-z0-9._-]{0,254})(?::([0-9]{1,5}))?", re.ASCII | re.IGNORECASE)

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


@dataclass(frozen=True)
class Names:
    """What browsers may call the server. names: in lower case;  networks: where its addresses are"""

    names: frozenset[str]
    networks: tuple[Network, ...]

    def include(self, name: str) -> bool:
        """Whether it is one of them. name: of `host_of`"""
        address = _address(name)
        if address is None:
            return name in self.names
        return any(address in network for network in self.networks)


def names_of(host: str) -> Names:
    """What a server may be called that listens at `host`.

    The name of another site may lead here, too, as whoever owns it decides (DNS rebinding). So only names count that
    are known to be this machine's. An address leads nowhere else: all count where all are listened at.
    """
    if host in _WILDCARDS:
        own = {_plain(name) for name in ("localhost", socket.gethostname(), socket.getfqdn())}
        return Names(frozenset(own), EVERYTHING)
    found = [_address(str(entry[4][0])) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]
    addresses = [address for address in found if address is not None]
    if all(address.is_loopback for address in addresses):
        return Names(frozenset({"localhost", _plain(host)}), LOOPBACK)
    return Names(frozenset({_plain(host)}), tuple(ipaddress.ip_network(address) for address in addresses))


def host_of(text: str) -> tuple[str, int | None] | None:
    """Name or address in the one spelling that `Names` has, and port if there is one, of "host:port" as browsers have
    it. None for what is malformed."""
    found = _HOST.fullmatch(text)
    if found is None:
        return None
    name, port = _plain(found[1]), int(found[2]) if found[2] else None
    if port is not None and port > MOST_PORT:
        return None
    if not name.startswith("["):
        return name, port
    address = _address(name[1:-1])
    return None if address is None else (str(address), port)


def _plain(name: str) -> str:
    return name.lower().removesuffix(".")


def _address(text: str) -> Address | None:
    """None for what is no address; IPv4 where it is that within IPv6, without a zone."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


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
    name = "localhost" if host in _WILDCARDS else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"
