"""What comes in from clients, looked at before anything acts on it: what is no use is dropped, in silence.

viser takes any message that it knows: one may replace parts of its own objects, ask for a tunnel to a public server, or
fail in a handler with a traceback. Here only the few that the viewer's controls send pass, with values that can be. A
page of another site that a user has open may connect to a server on loopback, too; browsers say where a page is from,
and what is not the viewer's own is refused before there is a connection. What one client can fill is bounded.
"""

import asyncio
import contextlib
import importlib
import logging
import math
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from spacesim.data.errors import InputError
from spacesim.viewer.network.address import AllowedHosts, parse_host
from spacesim.viewer.state import MAX_COORDINATE, parse_viewer_camera

if TYPE_CHECKING:
    from viser.infra import WebsockClientConnection, WebsockMessageHandler
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

MAX_TEXT_LENGTH = 200  #: characters that a field takes
MAX_MESSAGE_BYTES = (
    8 * 1024
)  #: bytes; nine times the largest that controls send: 884, a text of MAX_TEXT_LENGTH letters
WAITING_FRAMES = 16  #: frames of a client that wait to be read, from which on it is not listened to
MAX_REQUEST_BYTES = 32 * 1024  #: bytes before there is a connection; those of browsers take one or two thousand
MAX_FRAGMENTS = 64  #: of one message: browsers do not cut such short ones up
MAX_PONG_BYTES = 2**20  #: bytes of answers to a client's pings that it does not take
MAX_CLIENTS = 16  #: at once
MAX_SOCKETS = 64  #: at once, those included that have not said yet what they want
HANDSHAKE_TIMEOUT = 10.0  #: seconds that a client has to say what it wants
SEND_TIMEOUT = 30.0  #: seconds without a byte taken of those that wait to be sent
MAX_WARNINGS = 10  #: about pages that were refused

_FORBIDDEN_PARAMETERS = {
    "websocket",
    "playbackPath",
}  # with these in its address viser's page obeys another server, as ours
_PORTS = {"http": 80, "https": 443}
_PHASES, _BUTTONS = ("start", "update", "end"), ("left", "middle", "right")

Message = Any  #: one of viser's, of whichever kind

_log = logging.getLogger(__name__)


def is_allowed(message: object) -> bool:
    """Whether a message is one of those that the viewer's controls send, with values that can be."""
    check = _CHECKS.get(type(message).__name__)
    try:
        return check is not None and bool(check(message))
    except (TypeError, ValueError, AttributeError, OverflowError):
        return False


def _is_valid_camera(message: Message) -> bool:
    vectors = (
        _are_valid_numbers(message.look_at, 3)
        and _are_valid_numbers(message.up_direction, 3)
        and any(message.up_direction)
    )
    depths = _are_valid_numbers((message.near, message.far), 2)
    pose = message.wxyz, message.position, message.fov, message.image_width, message.image_height
    return vectors and depths and parse_viewer_camera(*pose) is not None


def _is_valid_update(message: Message) -> bool:
    updates = message.updates
    return (
        _is_valid_text(message.uuid)
        and isinstance(updates, dict)
        and set(updates) == {"value"}
        and _is_valid_value(updates["value"])
    )


def _is_valid_value(value: object) -> bool:
    if isinstance(value, list | tuple):
        return len(value) <= 4 and all(_is_valid_value(item) and not isinstance(item, list | tuple) for item in value)
    if isinstance(value, str):
        return len(value) <= MAX_TEXT_LENGTH
    return isinstance(value, int | float) and math.isfinite(value) and abs(value) <= 1e12


def _is_valid_handle(message: Message) -> bool:
    turn = _are_valid_numbers(message.wxyz, 4) and 0.5 < math.hypot(*message.wxyz) < 2
    return (
        turn
        and _are_valid_numbers(message.position, 3)
        and _is_valid_text(message.name)
        and _is_valid_text(message.owner)
    )


def _is_valid_handle_event(message: Message) -> bool:
    return _is_valid_text(message.name) and _is_valid_text(message.owner)


def _is_valid_click(message: Message) -> bool:
    index = message.instance_index is None or isinstance(message.instance_index, int)
    rays = _are_valid_numbers(message.ray_origin, 3) and _are_valid_numbers(message.ray_direction, 3)
    return index and rays and _is_valid_handle_event(message) and _is_valid_modifier(message)


def _is_valid_drag(message: Message) -> bool:
    places = _are_valid_numbers(message.start_position, 3) and _are_valid_numbers(message.end_position, 3)
    how = message.phase in _PHASES and message.button in _BUTTONS and _is_valid_modifier(message)
    index = message.instance_index is None or isinstance(message.instance_index, int)
    return places and how and index and _is_valid_handle_event(message)


def _is_valid_modifier(message: Message) -> bool:
    return message.modifier is None or _is_valid_text(message.modifier)


def _are_valid_numbers(values: object, count: int) -> bool:
    """A tuple of finite numbers no larger than a place may be."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return False
    return all(type(value) in (int, float) and abs(value) <= MAX_COORDINATE for value in values)


def _is_valid_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= MAX_TEXT_LENGTH


_CHECKS: dict[str, Callable[[Message], bool]] = {
    "ViewerCameraMessage": _is_valid_camera,
    "GuiUpdateMessage": _is_valid_update,
    "TransformControlsUpdateMessage": _is_valid_handle,
    "TransformControlsDragStartMessage": _is_valid_handle_event,
    "TransformControlsDragEndMessage": _is_valid_handle_event,
    "SceneNodeClickMessage": _is_valid_click,
    "SceneNodeDragMessage": _is_valid_drag,
}


def filter_messages(handler: "WebsockMessageHandler") -> None:
    """From now on a server's or a connection's `handler` of messages (viser's infra) sees only allowed ones, and a
    failure over one ends in the log."""
    inner: Callable[[object, object], Awaitable[None]] = handler._handle_incoming_message

    async def handle(client: object, message: object) -> None:
        if not is_allowed(message):
            return
        try:
            await inner(client, message)
        except Exception as error:
            _log.debug("viewer: a message of client %s failed (%s)", client, error, exc_info=error)

    handler._handle_incoming_message = handle


class _ThreadSafeEvent(asyncio.Event):
    """Set from the event loop's thread alone. viser sets it at once from whichever thread has a message, then again on
    that thread: the former may meet the loop in the middle of its list of those who wait, and fail."""

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # another thread
            return
        super().set()


def make_sends_thread_safe(handler: "WebsockMessageHandler") -> None:
    """From now on other threads may send through a server or a connection (viser's infra), one that nothing was sent
    through yet, without harm to its event loop."""
    handler.get_message_buffer().message_event = _ThreadSafeEvent()


def refusal_reason(headers: "Headers", path: str, names: AllowedHosts) -> str | None:
    """Why a request is refused, None for one that is not. headers: of websockets;  path: with its query;  names: of
    this server"""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    host = parse_host(hosts[0]) if len(hosts) == 1 else None
    if host is None or not names.include(host[0]):
        return "this server has no such name: open the address that spacesim view says, or make it listen here (host)"
    if origins and (len(origins) > 1 or not _is_own(origins[0], *host)):
        return "this page is not the viewer's"
    if not _FORBIDDEN_PARAMETERS.isdisjoint(
        key for key, _ in parse_qsl(path.partition("?")[2], keep_blank_values=True)
    ):
        return "the viewer's page shows this server alone"
    return None


def _is_own(origin: str, name: str, port: int | None) -> bool:
    """Whether a page was loaded from the server that it asks."""
    scheme, separator, rest = origin.partition("://")
    usual = _PORTS.get(scheme.lower())
    host = parse_host(rest)
    if not separator or usual is None or host is None:
        return False
    return (host[0], host[1] or usual) == (name, port or usual)


@contextlib.contextmanager
def guard_server(names: AllowedHosts) -> Iterator[None]:
    """A server of viser that is made inside refuses what `refusal_reason` does, before anything else sees it, and is
    bounded. It takes clients once this ends. viser hands no such parameters on to websockets, so its `serve` is another
    one meanwhile. Raises InputError where viser has not asked for it."""
    library: Any = importlib.import_module("websockets.asyncio.server")
    serve, connection = library.serve, _bounded_connection(library.ServerConnection)
    served, ready = threading.Event(), threading.Event()
    refused: set[str] = set()

    def guarded_serve(
        *arguments: object,
        process_request: Callable[["ServerConnection", "Request"], "Response | None"],
        **named: object,
    ) -> object:
        def process(client: "ServerConnection", request: "Request") -> "Response | None":
            reason = refusal_reason(request.headers, request.path, names)
            if reason is not None:
                origin = ", ".join(f"{key} {request.headers.get_all(key)!a:.200}" for key in ("Host", "Origin"))
                if origin not in refused and len(refused) < MAX_WARNINGS:
                    refused.add(origin)
                    _log.warning("viewer: a page was refused (%s): %s", origin, reason)
                return client.respond(403, f"{reason}\n")
            response = process_request(client, request)
            if response is None and not ready.is_set():
                return client.respond(503, "the viewer is starting\n")
            if response is None and len(client.server.connections) >= MAX_CLIENTS:
                return client.respond(503, f"the viewer has {MAX_CLIENTS} clients already: close one\n")
            return response

        served.set()
        bounds: dict[str, object] = {
            "max_size": MAX_MESSAGE_BYTES,
            "max_queue": WAITING_FRAMES,
            "open_timeout": HANDSHAKE_TIMEOUT,
        }
        bounds |= {"close_timeout": HANDSHAKE_TIMEOUT, "compression": None, "create_connection": connection}
        return serve(*arguments, process_request=process, **{**named, **bounds})

    library.serve = guarded_serve
    try:
        yield
    finally:
        library.serve = serve
    if not served.is_set():
        raise InputError("the viewer needs a viser that makes its server with websockets.asyncio.server.serve")
    ready.set()


def _bounded_connection(kind: Any) -> "type[ServerConnection]":
    """A connection of websockets (`kind`) of which nothing piles up without bound."""

    class Bounded(kind):
        _fragments = _answers = _asked = 0

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            """One too many takes the place of the oldest that is no client."""
            super().connection_made(transport)
            milliseconds = round(1000 * SEND_TIMEOUT)
            with contextlib.suppress(AttributeError, OSError):  # of Linux; elsewhere one that reads nothing stays
                transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)
            there = [handler for handler in self.server.handlers if not handler.transport.is_closing()]
            if len(there) > MAX_SOCKETS:
                clients = self.server.connections
                next(handler for handler in there if handler not in clients).transport.abort()

        def process_event(self, event: Any) -> None:
            super().process_event(event)
            if not getattr(event, "fin", True):
                self._fragments += 1
            elif self._fragments and event.opcode == 0:  # the last one
                self._fragments = 0

        def data_received(self, data: bytes) -> None:
            if self.request is None:  # websockets alone would keep a megabyte of headers a socket
                self._asked += len(data)
                if self._asked > MAX_REQUEST_BYTES:
                    self.transport.abort()
                    return
            before = self.transport.get_write_buffer_size()
            super().data_received(data)
            grown = self.transport.get_write_buffer_size() - before
            self._answers = self._answers + grown if self.paused else 0
            if self._fragments > MAX_FRAGMENTS or self._answers > MAX_PONG_BYTES:
                self.transport.abort()

        async def recv(self, decode: bool | None = None) -> str | bytes:
            """The next message, once all has been done about the one before; other clients come in between."""
            await asyncio.sleep(0)
            return await super().recv(decode)

    return Bounded


def has_pending_files(connection: "WebsockClientConnection") -> bool:
    """Whether parts of files wait to be sent to a client (a connection of viser's infra). Of all other messages, newer
    ones take the place of older."""
    buffer = connection.get_message_buffer()
    with buffer.buffer_lock:
        return any(type(message).__name__ == "FileTransferPart" for message in buffer.message_from_id.values())


class DebugLogFilter(logging.Filter):
    """Of the loggers of websockets and asyncio: what a client's nonsense makes them say goes to our debug log."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno > logging.DEBUG:
            _log.debug("%s: %s", record.name, record.getMessage(), exc_info=record.exc_info)
        return False
