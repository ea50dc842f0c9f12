"""Messages of clients: those of the controls pass, others and nonsense do not."""

import asyncio
import random
import threading

import pytest
from browser import PATIENCE, wait_for

from spacesim.viewer.address import ATTEMPTS, free_port, is_loopback, url
from spacesim.viewer.gate import admitted, guard, is_foreign, wake_in_turn

pytest.importorskip("viser", reason="viser is not installed")
from viser import _messages as messages

CAMERA = {
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -3.0),
    "fov": 0.7,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
DRAG = {
    "phase": "update",
    "name": "/sun/ball",
    "instance_index": None,
    "start_position": (0.0, 0, 1),
    "start_screen_pos": (0.5, 0.5),
    "end_position": (0.0, 1, 1),
    "end_screen_pos": (0.5, 0.6),
    "button": "left",
    "modifier": None,
}
GOOD = [
    messages.ViewerCameraMessage(**CAMERA),
    messages.GuiUpdateMessage("a", {"value": 3}),
    messages.GuiUpdateMessage("a", {"value": "depth"}),
    messages.GuiUpdateMessage("a", {"value": True}),
    messages.GuiUpdateMessage("a", {"value": [0.5, 1]}),
    messages.TransformControlsUpdateMessage("/models/0", (1.0, 0, 0, 0), (0.0, 1, 2)),
    messages.TransformControlsDragStartMessage("/models/0"),
    messages.TransformControlsDragEndMessage("/models/0"),
    messages.SceneNodeDragMessage(**DRAG),
    messages.SceneNodeClickMessage("/cameras/0", None, (0.0, 0, 0), (0.0, 0, 1), (0.5, 0.5), None),
]


@pytest.mark.parametrize("message", GOOD, ids=lambda message: type(message).__name__)
def test_what_controls_send_passes(message):
    assert admitted(message)


@pytest.mark.parametrize("message", GOOD, ids=lambda message: type(message).__name__)
def test_no_field_may_be_nonsense(message):
    """Of every field that is looked at, most values of another kind are refused; none raises."""
    rng = random.Random(0)
    odd = [None, float("nan"), [], {}, "x" * 1000, (1, 2), 10**400, b"\xff", [[1]], -1.0, ("a", "b", "c")]
    for name in vars(message):
        if name in ("start_screen_pos", "end_screen_pos", "screen_pos", "excluded_self_client"):
            continue  # which nothing reads
        kept = getattr(message, name)
        refused = 0
        for value in odd:
            setattr(message, name, value)
            refused += not admitted(message)
        setattr(message, name, kept)
        assert refused >= 8 or name in ("owner", "name"), name
    assert admitted(message)
    assert rng


@pytest.mark.parametrize(
    "message",
    [
        messages.ShareUrlRequest(),
        messages.ShareUrlDisconnect(),
        messages.GuiUpdateMessage("a", {"update_cb": []}),
        messages.GuiUpdateMessage("a", {"value": 1, "label": "x"}),
        messages.GuiUpdateMessage("a", {"value": float("inf")}),
        messages.GuiUpdateMessage(["a"], {"value": 1}),
        messages.GuiButtonHoldMessage("a", 10.0),
        messages.FileTransferStartUpload("a", "b", "c", "d", 1, 10**12),
        messages.RemoveSceneNodeMessage("/models/0"),
        "no message",
        None,
    ],
    ids=lambda message: type(message).__name__,
)
def test_everything_else_is_dropped(message):
    assert not admitted(message)


def test_a_handler_that_fails_is_no_end():
    seen = []

    class Handler:
        async def _handle_incoming_message(self, client, message):
            seen.append(message)
            raise KeyError("nothing of that name")

    handler = Handler()
    guard(handler)
    asyncio.run(handler._handle_incoming_message(1, GOOD[0]))
    asyncio.run(handler._handle_incoming_message(1, messages.ShareUrlRequest()))
    assert seen == [GOOD[0]]


@pytest.mark.parametrize(
    ("headers", "foreign"),
    [
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, False),
        ({"Host": "localhost:8080", "Origin": "https://LOCALHOST:8080"}, False),
        ({"Host": "localhost:8080"}, False),
        ({"Host": "127.0.0.1:8080", "Origin": "https://example.org"}, True),
        ({"Host": "127.0.0.1:8080", "Origin": "null"}, True),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:9000"}, True),
        ({"Origin": "http://127.0.0.1:9000"}, True),
    ],
)
def test_pages_of_other_sites_are_told_apart(headers, foreign):
    assert is_foreign(headers) is foreign


def test_ports_and_hosts():
    import socket

    from spacesim.data.errors import InputError

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        if port < 65000:
            assert port < free_port("127.0.0.1", port) < port + ATTEMPTS
    assert free_port("127.0.0.1", 0) > 0
    for host, port in (("127.0.0.1", -1), ("127.0.0.1", 65536), ("192.0.2.1", 8080), ("no such host.", 8080)):
        with pytest.raises(InputError, match=r"--host|--port"):
            free_port(host, port)
    assert [is_loopback(host) for host in ("localhost", "127.0.0.1", "::1", "0.0.0.0", "10.0.0.1")] == [
        *(True, True, True),
        *(False, False),
    ]
    assert url("0.0.0.0", 80) == "http://localhost:80"
    assert url("::1", 80) == "http://[::1]:80"


def test_the_event_loop_is_woken_by_its_own_thread_alone():
    """Another thread that goes through the list of those who wait meets changes in it: "deque mutated"."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    loop = asyncio.new_event_loop()
    buffer = AsyncMessageBuffer(loop, persistent_messages=True)
    handler = type("Handler", (), {"get_message_buffer": lambda _: buffer})()
    wake_in_turn(handler)
    told = []

    async def listen():
        windows = buffer.window_generator(0)
        while len(told) < 50:
            told.extend(await anext(windows))
        await windows.aclose()

    def send():
        for k in range(50):
            buffer.push(messages.SetGuiPanelLabelMessage(str(k)) if k else GOOD[0])
            wait_for(lambda k=k: len(told) > k, "each to be heard before the next")

    thread = threading.Thread(target=send)
    thread.start()
    loop.run_until_complete(asyncio.wait_for(listen(), PATIENCE))
    thread.join()
    loop.close()
    assert [message.label for message in told[1:]] == [str(k) for k in range(1, 50)]
    buffer.message_event.clear()
    buffer.message_event.set()
    assert not buffer.message_event.is_set()
