"""Messages of clients: those of the controls pass, others and nonsense do not."""

import asyncio
import random
import socket
import threading

import pytest
from browser import PATIENCE, wait_for

from spacesim.data.errors import InputError
from spacesim.viewer.network.address import PORT_ATTEMPTS, allowed_hosts, free_port, is_loopback, viewer_url
from spacesim.viewer.network.message_filter import (
    MAX_MESSAGE_BYTES,
    MAX_TEXT_LENGTH,
    filter_messages,
    guard_server,
    is_allowed,
    make_sends_thread_safe,
    refusal_reason,
)

pytest.importorskip("viser", reason="viser is not installed")
import msgspec
import websockets
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
    assert is_allowed(message)


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
            refused += not is_allowed(message)
        setattr(message, name, kept)
        assert refused >= 8 or name in ("owner", "name"), name
    assert is_allowed(message)
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
    assert not is_allowed(message)


def test_messages_are_handled_after_a_failed_handler():
    seen = []

    class Handler:
        async def _handle_incoming_message(self, client, message):
            seen.append(message)
            raise KeyError("nothing of that name")

    handler = Handler()
    filter_messages(handler)
    asyncio.run(handler._handle_incoming_message(1, GOOD[0]))
    asyncio.run(handler._handle_incoming_message(1, messages.ShareUrlRequest()))
    assert seen == [GOOD[0]]


def asked(*headers, path="/", host="127.0.0.1"):
    """Why a request with these headers is refused by a server that listens at `host`, "" for not at all."""
    return refusal_reason(websockets.Headers(headers), path, allowed_hosts(host)) or ""


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:8080", "http://localhost:8080"),
        ("localhost:8080", "https://LOCALHOST:8080"),
        ("LocalHost.:8080", "http://localhost:8080"),
        ("localhost", "http://localhost:80"),
        ("localhost", "https://localhost"),
        ("127.3.2.1:1", None),
        ("[::1]:8080", "http://[0:0::1]:8080"),
        ("[::ffff:127.0.0.1]", None),
    ],
)
def test_own_pages_are_let_in(host, origin):
    origins = [("Origin", origin)] if origin else []
    assert asked(("Host", host), *origins) == ""


@pytest.mark.parametrize(
    "origin",
    [
        *(
            "null",
            "",
            "*",
            "http://",
            "://localhost:8080",
            "localhost:8080",
            "http://localhost",
            "http://localhost:9000",
        ),
        *("http://127.0.0.1:8080", "https://example.org", "ftp://localhost:8080", "http://localhost:8080/"),
        *("http://a@localhost:8080", "http://localhost:8080.example.org", "http://localhost:8080 http://example.org"),
    ],
)
def test_pages_of_other_sites_are_refused(origin):
    assert "not the viewer's" in asked(("Host", "localhost:8080"), ("Origin", origin))


def test_two_origin_headers_are_refused():
    twice = [("Origin", "http://localhost")] * 2
    assert "not the viewer's" in asked(("Host", "localhost"), *twice)


@pytest.mark.parametrize(
    "host",
    [
        *(
            "",
            ".",
            "example.org",
            "example.org:8080",
            "localhost.example.org",
            "127.0.0.1.example.org",
            "0.0.0.0",
            "::1",
        ),
        *(
            "[::1",
            "[::1]x",
            "[::2]",
            "10.0.0.1",
            "127.1",
            "2130706433",
            "localhost:",
            "localhost:99999",
            "localhost:8 0",
        ),
        *("a@localhost", "localhost/", "localhost, example.org", "loc\xe4lhost", "localhost..", "localhost:\xb2"),
    ],
)
def test_names_of_others_are_refused(host):
    for origins in ([], [("Origin", f"http://{host}")]):
        assert "no such name" in asked(("Host", host), *origins)


def test_one_host_header_is_required():
    assert "no such name" in asked()
    assert "no such name" in asked(("Host", "localhost"), ("Host", "localhost"))


def test_allowed_hosts_depend_on_the_address(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Station")
    monkeypatch.setattr(socket, "getfqdn", lambda: "station.lab.")
    everywhere = allowed_hosts("0.0.0.0")
    for name in ("localhost", "station", "station.lab", "10.1.2.3", "::1", "fe80::1", "127.0.0.1"):
        assert everywhere.include(name)
    assert not everywhere.include("example.org")
    assert allowed_hosts("::") == everywhere

    places = {"box": ["10.0.0.7", "fd00::7"], "10.0.0.7": ["10.0.0.7"], "mine": ["127.0.1.1"], "::1": ["::1"]}
    monkeypatch.setattr(socket, "getaddrinfo", lambda host, *_, **__: [(0,) * 4 + ((one, 0),) for one in places[host]])
    box = allowed_hosts("box")
    assert all(map(box.include, ("box", "10.0.0.7", "fd00::7")))
    assert not any(map(box.include, ("localhost", "127.0.0.1", "10.0.0.8", "station")))
    assert not allowed_hosts("10.0.0.7").include("box")
    assert all(map(allowed_hosts("mine").include, ("mine", "localhost", "127.0.0.1", "::1")))
    assert all(map(allowed_hosts("::1").include, ("localhost", "127.0.0.1", "::1")))


@pytest.mark.parametrize("query", ["websocket=ws://example.org", "a&playbackPath", "%77ebsocket=", "a=1&websocket=x"])
def test_urls_that_name_another_server_are_refused(query):
    assert "this server alone" in asked(("Host", "localhost"), path=f"/?{query}")
    assert asked(("Host", "localhost"), path="/?darkMode&a=websocket") == ""


def test_messages_may_be_some_times_as_large_as_those_of_controls():
    longest = messages.GuiUpdateMessage("0" * 36, {"value": "\U0001d11e" * MAX_TEXT_LENGTH})
    assert is_allowed(longest)
    largest = max(len(msgspec.msgpack.encode(one.as_serializable_dict())) for one in (*GOOD, longest))
    assert 8 * largest < MAX_MESSAGE_BYTES < 16 * largest


def test_an_unguarded_server_is_refused():
    import websockets.asyncio.server as library

    before = library.serve
    with pytest.raises(InputError, match="viser"), guard_server(allowed_hosts("127.0.0.1")):
        assert library.serve is not before
    assert library.serve is before


def test_ports_and_hosts():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        if port < 65000:
            assert port < free_port("127.0.0.1", port) < port + PORT_ATTEMPTS
    assert free_port("127.0.0.1", 0) > 0
    for host, port in (("127.0.0.1", -1), ("127.0.0.1", 65536), ("192.0.2.1", 8080), ("no such host.", 8080)):
        with pytest.raises(InputError, match=r"^(host|port): "):
            free_port(host, port)
    assert [is_loopback(host) for host in ("localhost", "127.0.0.1", "::1", "0.0.0.0", "10.0.0.1")] == [
        *(True, True, True),
        *(False, False),
    ]
    assert viewer_url("0.0.0.0", 80) == "http://localhost:80"
    assert viewer_url("::1", 80) == "http://[::1]:80"


def test_the_event_loop_is_woken_by_its_own_thread_alone():
    """Another thread that goes through the list of those who wait meets changes in it: "deque mutated"."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    loop = asyncio.new_event_loop()
    buffer = AsyncMessageBuffer(loop, persistent_messages=True)
    handler = type("Handler", (), {"get_message_buffer": lambda _: buffer})()
    make_sends_thread_safe(handler)
    sent = []

    async def listen():
        windows = buffer.window_generator(0)
        while len(sent) < 50:
            sent.extend(await anext(windows))
        await windows.aclose()

    def send():
        for k in range(50):
            buffer.push(messages.SetGuiPanelLabelMessage(str(k)) if k else GOOD[0])
            wait_for(lambda k=k: len(sent) > k, "each to be heard before the next")

    thread = threading.Thread(target=send)
    thread.start()
    loop.run_until_complete(asyncio.wait_for(listen(), PATIENCE))
    thread.join()
    loop.close()
    assert [message.label for message in sent[1:]] == [str(k) for k in range(1, 50)]
    buffer.message_event.clear()
    buffer.message_event.set()
    assert not buffer.message_event.is_set()
