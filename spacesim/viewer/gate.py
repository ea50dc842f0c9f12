"""What comes in from clients, looked at before anything acts on it: what is no use is dropped, in silence.

viser takes any message that it knows: one may replace parts of its own objects, ask for a tunnel to a public server, or
fail in a handler with a traceback. Here only the few that the viewer's controls send pass, with values that can be. A
page of another site that a user has open may connect to a server on loopback, too; browsers say where a page is from.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any
from urllib.parse import urlsplit

from spacesim.viewer.state import FARTHEST, view_of

LONGEST_TEXT = 200  #: characters that a field takes, chosen
_PHASES, _BUTTONS = ("start", "update", "end"), ("left", "middle", "right")

_log = logging.getLogger(__name__)


def admitted(message: Any) -> bool:
    """Whether a message is one of those that the viewer's controls send, with values that can be."""
    check = _CHECKS.get(type(message).__name__)
    try:
        return check is not None and bool(check(message))
    except (TypeError, ValueError, AttributeError, OverflowError):
        return False


def _camera(message: Any) -> bool:
    vectors = _numbers(message.look_at, 3) and _numbers(message.up_direction, 3) and any(message.up_direction)
    depths = _numbers((message.near, message.far), 2)
    told = message.wxyz, message.position, message.fov, message.image_width, message.image_height
    return vectors and depths and view_of(*told) is not None


def _update(message: Any) -> bool:
    updates = message.updates
    return _text(message.uuid) and isinstance(updates, dict) and set(updates) == {"value"} and _value(updates["value"])


def _value(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return len(value) <= 4 and all(_value(one) and not isinstance(one, list | tuple) for one in value)
    if isinstance(value, str):
        return len(value) <= LONGEST_TEXT
    return isinstance(value, int | float) and math.isfinite(value) and abs(value) <= 1e12


def _handle(message: Any) -> bool:
    turn = _numbers(message.wxyz, 4) and 0.5 < math.hypot(*message.wxyz) < 2
    return turn and _numbers(message.position, 3) and _text(message.name) and _text(message.owner)


def _grabbed(message: Any) -> bool:
    return _text(message.name) and _text(message.owner)


def _click(message: Any) -> bool:
    index = message.instance_index is None or isinstance(message.instance_index, int)
    rays = _numbers(message.ray_origin, 3) and _numbers(message.ray_direction, 3)
    return index and rays and _grabbed(message) and _modifier(message)


def _drag(message: Any) -> bool:
    places = _numbers(message.start_position, 3) and _numbers(message.end_position, 3)
    how = message.phase in _PHASES and message.button in _BUTTONS and _modifier(message)
    index = message.instance_index is None or isinstance(message.instance_index, int)
    return places and how and index and _grabbed(message)


def _modifier(message: Any) -> bool:
    return message.modifier is None or _text(message.modifier)


def _numbers(values: Any, count: int) -> bool:
    """A tuple of finite numbers no larger than a place may be."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return False
    return all(type(value) in (int, float) and abs(value) <= FARTHEST for value in values)


def _text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_TEXT


_CHECKS: dict[str, Callable[[Any], bool]] = {
    "ViewerCameraMessage": _camera,
    "GuiUpdateMessage": _update,
    "TransformControlsUpdateMessage": _handle,
    "TransformControlsDragStartMessage": _grabbed,
    "TransformControlsDragEndMessage": _grabbed,
    "SceneNodeClickMessage": _click,
    "SceneNodeDragMessage": _drag,
}


def guard(handler: Any) -> None:
    """From now on a server's or a connection's `handler` of messages (viser's infra) sees only admitted ones, and a
    failure over one ends in the log."""
    inner: Callable[[Any, Any], Coroutine[Any, Any, None]] = handler._handle_incoming_message

    async def handle(client: Any, message: Any) -> None:
        if not admitted(message):
            return
        try:
            await inner(client, message)
        except Exception as error:
            _log.debug("viewer: a message of client %s failed (%s)", client, error, exc_info=error)

    handler._handle_incoming_message = handle


class _Alarm(asyncio.Event):
    """Set from the event loop's thread alone. viser sets it at once from whichever thread has a message, then again on
    that thread: the former may meet the loop in the middle of its list of those who wait, and fail."""

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # another thread
            return
        super().set()


def wake_in_turn(handler: Any) -> None:
    """From now on other threads may send through a server or a connection (viser's infra), one that nothing was sent
    through yet, without harm to its event loop."""
    handler.get_message_buffer().message_event = _Alarm()


def is_foreign(headers: Any) -> bool:
    """Whether a browser says that the page which connects was loaded from another server than this one."""
    origin, host = headers.get("Origin"), headers.get("Host")
    return origin is not None and urlsplit(origin).netloc.lower() != (host or "").lower()


class Quiet(logging.Filter):
    """Of the loggers of websockets and asyncio: what a client's nonsense makes them say goes to our debug log."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno > logging.DEBUG:
            _log.debug("%s: %s", record.name, record.getMessage(), exc_info=record.exc_info)
        return False
