"""Where the viewer listens, and what browsers may call it."""

import errno
import ipaddress
import re
import socket
from dataclasses import dataclass

from spacesim.data.errors import InputError

PORT_ATTEMPTS = 20  #: ports tried, one after another, where the first is taken
MAX_PORT = 65535
LOOPBACK_NETWORKS = (ipaddress.ip_network("127.0.0.0/8"), ipaddress.ip_network("::1/128"))
ALL_NETWORKS = (ipaddress.ip_network("0.0.0.0/0"), ipaddress.ip_network("::/0"))

_WILDCARDS = ("0.0.0.0", "::", "")  # hosts that stand for all addresses of this machine
_HOST = re.compile(r"(\[[0-9a-f:.]{2,45}\]|[a-z0-9][a-z0-9._-]{0,254})(?::([0-9]{1,5}))?", re.ASCII | re.IGNORECASE)

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


@dataclass(frozen=True)
class AllowedHosts:
    """What browsers may call the server."""

    names: frozenset[str]  #: in lower case
    networks: tuple[Network, ...]  #: where its addresses are

    def include(self, name: str) -> bool:
        """Whether it is one of them. name: of `parse_host`"""
        address = _parse_address(name)
        if address is None:
            return name in self.names
        return any(address in network for network in self.networks)


def allowed_hosts(host: str) -> AllowedHosts:
    """What a server may be called that listens at `host`.

    The name of another site may lead here, too, as its owner decides (DNS rebinding). So only names count that
    are known to be this machine's. An address leads nowhere else: all count where all are listened at.
    """
    if host in _WILDCARDS:
        names = {_normalised_name(name) for name in ("localhost", socket.gethostname(), socket.getfqdn())}
        return AllowedHosts(frozenset(names), ALL_NETWORKS)
    resolved = [_parse_address(str(entry[4][0])) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]
    addresses = [address for address in resolved if address is not None]
    if all(address.is_loopback for address in addresses):
        return AllowedHosts(frozenset({"localhost", _normalised_name(host)}), LOOPBACK_NETWORKS)
    return AllowedHosts(
        frozenset({_normalised_name(host)}), tuple(ipaddress.ip_network(address) for address in addresses)
    )


def parse_host(text: str) -> tuple[str, int | None] | None:
    """Name or address in the one spelling that `AllowedHosts` has, and port if there is one, of "host:port" as browsers
    have it. None for what is malformed."""
    match = _HOST.fullmatch(text)
    if match is None:
        return None
    name, port = _normalised_name(match[1]), int(match[2]) if match[2] else None
    if port is not None and port > MAX_PORT:
        return None
    if not name.startswith("["):
        return name, port
    address = _parse_address(name[1:-1])
    return None if address is None else (str(address), port)


def _normalised_name(name: str) -> str:
    return name.lower().removesuffix(".")


def _parse_address(text: str) -> Address | None:
    """None for what is no address; IPv4 where it is that within IPv6, without a zone."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def free_port(host: str, port: int) -> int:
    """`port`, or the next one that is free. Raises InputError for a host that is no address of this machine, a port out
    of range, one that only the administrator may open, and where PORT_ATTEMPTS ports are taken."""
    if not 0 <= port <= MAX_PORT:
        raise InputError(f"port: expected 0 to {MAX_PORT}, found {port}")
    last = min(port + PORT_ATTEMPTS - 1, MAX_PORT)
    for candidate in range(port, last + 1):
        try:
            return _bind_port(host, candidate)
        except OSError as error:
            if error.errno == errno.EACCES:
                raise InputError(f"port: expected a port that you may open, found {candidate}; try 8080") from None
            if error.errno != errno.EADDRINUSE:
                reason = error.strerror or error
                raise InputError(
                    f"host: expected a name or address of this machine, found {host!r} ({reason})"
                ) from None
        except UnicodeError:
            raise InputError(f"host: expected a name or address of this machine, found {host!r}") from None
    raise InputError(f"port: expected a free port, found {port} to {last} taken")


def _bind_port(host: str, port: int) -> int:
    """The port that can be bound; what the system chooses for 0."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind, protocol) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        return int(listener.getsockname()[1])


def is_loopback(host: str) -> bool:
    """Whether only this machine can connect."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def viewer_url(host: str, port: int) -> str:
    """What to open in a browser."""
    name = "localhost" if host in _WILDCARDS else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"
