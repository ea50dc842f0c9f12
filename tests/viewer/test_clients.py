"""Clients without a browser: pictures for them, nonsense from them, leaving in the middle, memory."""

import asyncio
import contextlib
import ctypes
import gc
import random
import socket
import threading
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
from browser import PATIENCE, wait_for

from spacesim.data.geometry import look_at, quaternion_from_rotation
from spacesim.data.records import Sun
from spacesim.splat.compose.pose import MAX_SCALE, MIN_SCALE, Pose
from spacesim.viewer.client import Client
from spacesim.viewer.drawing.memory import give_back
from spacesim.viewer.network import message_filter
from spacesim.viewer.state import MAX_COORDINATE, SceneState, SharedScene

viser = pytest.importorskip("viser", reason="viser is not installed")
msgspec, zstandard = (pytest.importorskip(name) for name in ("msgspec", "zstandard"))  # which it brings
websockets = pytest.importorskip("websockets")
client = pytest.importorskip("websockets.sync.client")

pytestmark = pytest.mark.filterwarnings(r"ignore:(Queued a |\[viser\])")  # as the viewer has it; pytest undoes that


def connected(viewer):
    url = viewer.url.replace("http", "ws")
    return client.connect(
        url,
        subprotocols=[f"viser-v{viser.__version__}"],
        compression=None,
        max_size=None,
        max_queue=None,  # else one that reads nothing for a while answers no pings and is sent away
        ping_interval=None,
        open_timeout=PATIENCE,
        close_timeout=0.5,
    )


def camera_message(angle=0.0, **changes):
    """From 7 m away, looking at the scene."""
    place = [7 * np.sin(angle), -7 * np.cos(angle), 1.0]
    message = {
        "type": "ViewerCameraMessage",
        "wxyz": quaternion_from_rotation(look_at(place, [0.0, 0, 0.5])[:3, :3]).tolist(),
        "position": [float(x) for x in place],
        "fov": 0.9,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 240,
        "image_width": 320,
        "look_at": [0.0, 0.0, 0.5],
        "up_direction": [0.0, 0.0, 1.0],
    }
    return msgspec.msgpack.encode({**message, **changes})


def pictures(socket, count, patience=PATIENCE):
    """Messages until so many background pictures have come."""

    found, deadline = 0, time.monotonic() + patience
    while found < count:
        assert time.monotonic() < deadline, f"{found} of {count} pictures in {patience} s"
        data = socket.recv(timeout=patience)
        size = int.from_bytes(data[8:16], "little")
        plain = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
        messages = msgspec.msgpack.decode(plain)["messages"]
        found += sum(message["type"] == "BackgroundImageMessage" and bool(message["rgb_data"]) for message in messages)
    return found


def test_a_client_without_a_browser_gets_pictures(viewer):
    with connected(viewer) as socket:
        socket.send(camera_message())
        pictures(socket, 1)


def test_nonsense_of_a_client_harms_no_other(viewer, at_start, caplog, capfd):
    """1,000 messages: bytes, msgpack of anything, messages that look right with wild values."""

    rng = random.Random(0)
    wait_for(lambda: not viewer.clients, "those of other tests to be gone")
    uuids = list(viewer._server.gui._gui_input_handle_from_uuid)
    known = [viewer._sun.azimuth._impl.uuid, viewer.paths.step._impl.uuid, viewer.files.name._impl.uuid]
    shared_before = viewer.shared

    def anything(depth=0):
        values = [None, True, -1, 0.5, 1e308, float("nan"), float("inf"), 2**63 - 1, "", "x" * 300, b"\0\xff"]
        kinds = [lambda: rng.choice(values)]
        if depth < 3:
            kinds += [
                lambda: [anything(depth + 1) for _ in range(rng.randrange(5))],
                lambda: {rng.choice(["type", "uuid", "value", "name", "wxyz", "x"]): anything(depth + 1)},
            ]
        return rng.choice(kinds)()

    every = viser._messages.Message.get_subclasses()
    types = [one.__name__ for one in every]
    fields = {one.__name__: list(getattr(one, "__dataclass_fields__", {})) for one in every}

    def unreadable(k):
        return [rng.randbytes(rng.randrange(200)), msgspec.msgpack.encode(anything()), "text"][k % 3]

    def message(k):
        name = rng.choice(types) if k % 2 else rng.choice(["ViewerCameraMessage", "GuiUpdateMessage"])
        values = {field: anything() for field in fields[name]}
        if name == "GuiUpdateMessage":
            what = rng.choice(["value", "update_cb", "label"])
            values = {"uuid": rng.choice(known + uuids), "updates": {what: anything()}}
        if name.startswith("TransformControls"):
            values |= {"name": "/handles/models/0", "owner": ""}
        return msgspec.msgpack.encode({"type": name, **values})

    socket = connected(viewer)
    socket.send(camera_message())
    sent = dropped = 0
    while sent < 1000:
        try:
            socket.send(unreadable(sent) if sent % 20 == 0 else message(sent))
            sent += 1
        except websockets.exceptions.ConnectionClosed:  # over what cannot be read; the client comes back
            dropped += 1
            socket = connected(viewer)
            socket.send(camera_message())
    socket.close()
    assert dropped < 200
    with connected(viewer) as good:
        good.send(camera_message(0.3))
        pictures(good, 1)
    wait_for(lambda: not viewer.clients, "all of them to be gone")
    state = viewer.shared.state
    assert viewer.shared is shared_before
    assert viewer.shared.state is state
    assert all(np.isfinite(pose.matrix).all() for pose in state.poses)
    assert np.linalg.norm(state.sun.direction) == pytest.approx(1)
    assert viewer.loop._thread.is_alive()
    assert viewer._server._share_tunnel is None  # nobody can open a way in from outside
    said = caplog.text + "".join(capfd.readouterr())
    assert "Traceback" not in said


def frame(message):
    """Of RFC 6455, of 126 bytes and more, with a mask of zeros."""
    return b"\x82\xfe" + len(message).to_bytes(2, "big") + bytes(4) + message


def test_messages_that_come_at_once_are_handled_one_by_one(viewer, monkeypatch):
    """Else one client's would pile up, and others would wait until all of them are done."""
    tasks = []
    with connected(viewer) as one:
        monkeypatch.setattr(message_filter, "is_allowed", lambda _: tasks.append(len(asyncio.all_tasks())))
        one.socket.sendall(200 * frame(camera_message()))
        wait_for(lambda: len(tasks) == 400, "all of them")  # viser asks twice
    assert max(tasks) < 50


def test_pages_of_other_sites_are_refused_before_they_are_clients(viewer, monkeypatch, caplog):
    """Not even what they send with the request, before any answer, comes to a handler."""
    seen = []
    monkeypatch.setattr("spacesim.viewer.network.message_filter.is_allowed", seen.append)
    monkeypatch.setattr(viewer._server._websock_server, "_client_connect_cb", [seen.append])
    lines = ["GET / HTTP/1.1", f"Host: 127.0.0.1:{viewer.port}", "Origin: https://example.org", "Upgrade: websocket"]
    lines += ["Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
    head = "\r\n".join([*lines, f"Sec-WebSocket-Protocol: viser-v{viser.__version__}", "", ""]).encode()
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", viewer.port), PATIENCE) as page:
            page.sendall(head + 30 * frame(camera_message()))
            assert page.recv(12) == b"HTTP/1.1 403"
    assert seen == []
    assert caplog.text.count("https://example.org") == 1


def test_no_page_is_given_under_the_name_of_another(viewer):
    request = urllib.request.Request(viewer.url, headers={"Host": f"example.org:{viewer.port}"})
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(request, timeout=PATIENCE)
    assert b"no such name" in refused.value.read()


def test_a_message_that_is_too_large_ends_one_client_alone(viewer, at_start):
    with connected(viewer) as good, connected(viewer) as bad:
        for socket_ in (good, bad):
            socket_.send(camera_message())
            pictures(socket_, 1)
        bad.send(bytes(message_filter.MAX_MESSAGE_BYTES + 1))
        with pytest.raises(websockets.exceptions.ConnectionClosedError, match="1009"):
            pictures(bad, 100)
        good.send(camera_message(0.4))
        pictures(good, 1)


def test_clients_beyond_the_limit_get_a_message(viewer, monkeypatch):
    wait_for(lambda: not viewer._server._websock_server._live_connections, "those of other tests to be gone")
    monkeypatch.setattr(message_filter, "MAX_CLIENTS", 2)
    with connected(viewer), connected(viewer):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="503") as refused:
            connected(viewer)
        assert b"2 clients already" in refused.value.response.body


def test_silent_sockets_are_closed_when_there_are_too_many(viewer, monkeypatch):
    monkeypatch.setattr(message_filter, "MAX_SOCKETS", 4)
    with contextlib.ExitStack() as held:
        good = held.enter_context(connected(viewer))
        address = ("127.0.0.1", viewer.port)
        silent = [held.enter_context(socket.create_connection(address, PATIENCE)) for _ in range(8)]
        assert silent[0].recv(1) == b""  # not the client, though that is older
        good.send(camera_message(0.7))
        pictures(good, 1)


def test_a_request_of_endless_headers_is_ended(viewer):
    with socket.create_connection(("127.0.0.1", viewer.port), PATIENCE) as one:
        one.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{viewer.port}\r\n".encode())
        one.sendall((b"X: " + b"x" * 8000 + b"\r\n") * 10)  # websockets alone would take a megabyte
        with contextlib.suppress(ConnectionResetError):
            assert one.recv(1) == b""


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="the system cannot tell who reads nothing")
def test_clients_that_read_nothing_are_sent_away(viewer, at_start, monkeypatch):
    monkeypatch.setattr(message_filter, "SEND_TIMEOUT", 1.0)
    before = set(viewer.clients)
    deaf = socket.socket()
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.connect(("127.0.0.1", viewer.port))
    url = viewer.url.replace("http", "ws")
    version = [f"viser-v{viser.__version__}"]
    named = {"compression": None, "max_queue": 1, "ping_interval": None, "close_timeout": 0.5}
    with client.connect(url, sock=deaf, subprotocols=version, **named) as one:
        one.send(camera_message())
        wait_for(lambda: set(viewer.clients) - before, "the client")
        (number,) = set(viewer.clients) - before

        def gone():
            with contextlib.suppress(websockets.exceptions.ConnectionClosed):
                one.send(camera_message(time.monotonic(), image_width=1024, image_height=1024))
            return number not in viewer.clients

        wait_for(gone, "it to be sent away", patience=15.0)


def test_one_file_at_a_time_waits_for_a_client(viewer):
    connection = viewer._server._websock_server
    assert not message_filter.has_pending_files(connection)
    buffer = type(connection.get_message_buffer())(connection._background_event_loop, persistent_messages=False)
    slow = SimpleNamespace(get_message_buffer=lambda: buffer)
    buffer.push(viser._messages.FileTransferPart(None, "a", 0, b"x"))
    assert message_filter.has_pending_files(slow)
    with buffer.buffer_lock:
        buffer.pop_message_locked(0)
    assert not message_filter.has_pending_files(slow)


@pytest.mark.parametrize("scales", [(MIN_SCALE, 1.0), (1.0, MIN_SCALE), (MAX_SCALE, MIN_SCALE), (MAX_SCALE, MAX_SCALE)])
def test_models_of_any_size_that_the_panel_takes_are_drawn(viewer, at_start, caplog, scales):
    poses = [Pose(pose.rotation, pose.translation, scale) for pose, scale in zip(at_start.poses, scales, strict=True)]
    with connected(viewer) as socket:
        socket.send(camera_message(0.4))
        pictures(socket, 1)
        viewer.set_state(SceneState(tuple(poses), at_start.sun))
        pictures(socket, 1)  # a second one may take its place before it is sent
        wait_for(lambda: viewer.loop.idle, "the picture at rest")
    assert "a picture failed" not in caplog.text
    viewer.set_state(at_start)


def test_wild_values_that_are_admitted_fail_no_picture(viewer, at_start, caplog):
    """Of one client, while another one looks: places, sizes, Suns and cameras at and within the bounds."""
    rng = np.random.default_rng(5)

    def size(least, most):
        return float(rng.choice([least, most, np.exp(rng.uniform(np.log(least), np.log(most)))]))

    def turn():
        return (lambda q: (q / np.linalg.norm(q)).tolist())(rng.normal(size=4))

    def place():
        return (rng.choice([-1, 0, 1], 3) * size(1e-3, MAX_COORDINATE)).tolist()

    scales = viewer._models.scales
    with connected(viewer) as wild, connected(viewer) as good:
        before = set(viewer.clients)
        good.send(camera_message(0.1))
        pictures(good, 1)
        (number,) = set(viewer.clients) - before
        for k in range(25):
            model = int(rng.integers(2))
            handle = {"type": "TransformControlsUpdateMessage", "name": f"/handles/models/{model}", "owner": ""}
            wild.send(msgspec.msgpack.encode({**handle, "wxyz": turn(), "position": place()}))
            press(wild, scales[model], size(MIN_SCALE, MAX_SCALE))
            press(wild, viewer._sun.azimuth, float(rng.uniform(0, 360)))
            press(wild, viewer._sun.elevation, float(rng.choice([-90, 90, 0])))
            width, height = (round(size(1, 8192)) for _ in range(2))
            sight = {"fov": size(2e-4, 2.9), "image_width": width, "image_height": height, "position": place()}
            wild.send(camera_message(**sight, wxyz=turn()))
            good.send(camera_message(0.1 * k + 0.2))
            pictures(good, 1)
            wait_for(lambda: viewer.loop.idle, "all pictures")
            assert "no picture" not in viewer.clients[number].controls.status.content
    assert "a picture failed" not in caplog.text
    assert any(pose.key != old.key for pose, old in zip(viewer.shared.state.poses, at_start.poses, strict=True))
    viewer.set_state(at_start)


def test_clients_that_leave_in_the_middle(viewer, at_start):
    """While pictures are on their way to them."""
    threads = threading.active_count()
    for k in range(12):
        socket = connected(viewer)
        for j in range(5):
            socket.send(camera_message(0.1 * j + k))
        if k % 2:
            socket.close()
        else:
            socket.socket.close()  # without a word
    with connected(viewer) as good:
        good.send(camera_message(-0.3))
        pictures(good, 1)
    wait_for(lambda: threading.active_count() <= threads + 34, "threads to end")  # viser has a pool of up to 32


def test_the_page_is_served_and_nothing_else(viewer):
    with urllib.request.urlopen(viewer.url, timeout=PATIENCE) as answer:
        assert b"<html" in answer.read()[:500].lower()
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(f"{viewer.url}/../../../etc/passwd", timeout=PATIENCE)


class Allocated(ctypes.Structure):
    """What glibc's mallinfo2 tells; of interest: mapped blocks and blocks in use, bytes."""

    _fields_ = [(name, ctypes.c_size_t) for name in ("a", "b", "c", "d", "mapped", "e", "f", "used", "g", "h")]


def mallinfo():
    """mallinfo2 of the C library, None where it is another one."""
    try:
        function = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    function.restype = Allocated
    return function


def memory(viewer):
    """Bytes that are in use by this process, whose allocators have given back what is free."""
    done, found = threading.Event(), []

    def read():
        gc.collect()
        give_back()
        statistics = mallinfo()()
        found.append(statistics.mapped + statistics.used)
        done.set()

    viewer.loop.submit(read)
    assert done.wait(PATIENCE)
    return found[0]


@pytest.mark.skipif(mallinfo() is None, reason="the C library does not tell how much memory is in use")
def test_looking_around_takes_no_memory(viewer, at_start, monkeypatch):
    """60 pictures under some Suns for clients that come and go, after as many to warm up; and a viewer that kept its
    pictures would be found out. What is in use goes up and down by some MiB as Dr.Jit's recordings come and go."""
    kept, show = [], Client.show
    monkeypatch.setattr("spacesim.viewer.drawing.frames.BUDGET", 1e9)  # all pictures in full resolution, however slow

    def keep(self, picture, sharp):
        kept.append(picture.copy())
        show(self, picture, sharp)

    def look_around():
        for k in range(3):
            viewer.set_state(SceneState(at_start.poses, Sun.from_angles(40 * k, 30)))
            with connected(viewer) as socket:
                for j in range(20):
                    socket.send(camera_message(0.02 * j + k))
                    pictures(socket, 1)
            wait_for(lambda: not viewer.clients and viewer.loop.idle, "all to be gone")
        return memory(viewer)

    warm, clean = look_around(), look_around()
    monkeypatch.setattr(Client, "show", keep)
    leaking = look_around()
    pictured = 60 * 384 * 288 * 3  # bytes of the pictures
    message = f"{(clean - warm) / 2**20:.1f} MiB, {(leaking - clean) / 2**20:.1f} MiB with all pictures kept"
    assert clean - warm < 0.5 * pictured, message
    assert leaking - clean > 0.5 * pictured, message


def messages_of(data):
    size = int.from_bytes(data[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
    position, buffers = 16 + size, []
    for length in content["binaryBufferLengths"]:
        position += -position % 8
        buffers.append(data[position : position + length])
        position += length
    return content["messages"], buffers


def press(socket, handle, value=True):
    """What a browser sends where a control is used."""
    message = {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
    socket.send(msgspec.msgpack.encode(message))


def button(viewer, label, client=None):
    """The control of that label."""
    gui = client.handle.gui if client else viewer._server.gui
    return next(h for h in gui._gui_input_handle_from_uuid.values() if getattr(h, "label", None) == label)


def test_a_picture_is_sent_as_a_png(viewer, at_start):
    import io

    from PIL import Image

    with connected(viewer) as socket:
        before = set(viewer.clients)
        socket.send(camera_message())
        pictures(socket, 1)
        (number,) = set(viewer.clients) - before or set(viewer.clients)
        press(socket, button(viewer, "Picture (PNG)", viewer.clients[number]))
        content, name, deadline = b"", None, time.monotonic() + PATIENCE
        while not content and time.monotonic() < deadline:
            messages, buffers = messages_of(socket.recv(timeout=PATIENCE))
            for message in messages:
                if message["type"] == "FileTransferStartDownload":
                    name = message["filename"]
                if message["type"] == "FileTransferPart":
                    part = message["content"]
                    content += buffers[part["__binary_index"]] if isinstance(part, dict) else part
    assert name == "colour.png"
    with Image.open(io.BytesIO(content)) as image:
        assert image.size == (320, 240)
        assert np.asarray(image).max() > 60


def test_a_path_is_played_by_the_camera_of_who_asks(viewer, at_start, monkeypatch):
    moves, look_from, moments = [], Client.look_from, iter(np.arange(1000) * 0.1)

    def watched(self, world_from_camera, fov):
        moves.append(world_from_camera[:3, 3])
        look_from(self, world_from_camera, fov)

    monkeypatch.setattr(Client, "look_from", watched)
    monkeypatch.setattr("spacesim.viewer.path.time", SimpleNamespace(monotonic=lambda: next(moments)))
    with connected(viewer) as socket, connected(viewer) as other:
        for one in (socket, other):
            one.send(camera_message())
            pictures(one, 1)
        viewer.paths._change(type(viewer.paths.path)())
        press(socket, button(viewer, "Add this view"))
        wait_for(lambda: len(viewer.paths.path.keyframes) == 1, "a keyframe")
        socket.send(camera_message(np.pi / 2))
        pictures(socket, 1)
        press(socket, viewer.paths.step, 3.0)
        wait_for(lambda: viewer.paths.step.value == 3.0, "the time")
        press(socket, button(viewer, "Add this view"))
        wait_for(lambda: len(viewer.paths.path.keyframes) == 2, "another keyframe")
        assert viewer.paths.path.seconds == 3.0
        press(socket, button(viewer, "Play / stop"))
        places, deadline = [], time.monotonic() + PATIENCE
        while (not places or np.abs(np.array(places[-1]) - [7, 0, 1]).max() > 1e-3) and time.monotonic() < deadline:
            messages, _ = messages_of(socket.recv(timeout=PATIENCE))
            places += [m["position"] for m in messages if m["type"] == "SetCameraPositionMessage"]
        assert len(moves) == 30  # every 0.1 s
        assert moves[0] == pytest.approx([0.1 / 3 * 7, -7 + 0.1 / 3 * 7, 1], abs=1e-3)
        wait_for(lambda: not viewer.paths._players, "the end")
        press(socket, button(viewer, "Remove all"))
        wait_for(lambda: not viewer.paths.path.keyframes, "no keyframes")
        moved = []
        other.send(camera_message(0.2))
        for _ in range(2):
            messages, _ = messages_of(other.recv(timeout=PATIENCE))
            moved += [m for m in messages if m["type"] == "SetCameraPositionMessage" and not m["initial"]]
        assert moved == []


def test_a_click_on_a_camera_of_the_data_looks_from_there(viewer, at_start):
    frame = viewer.setup.dataset.frames[3]
    with connected(viewer) as socket:
        before = set(viewer.clients)
        socket.send(camera_message())
        pictures(socket, 1)
        client = viewer.clients[next(iter(set(viewer.clients) - before))]
        press(socket, button(viewer, "Cameras", client))
        names, owner, place, deadline = set(), "", None, time.monotonic() + PATIENCE
        while place is None and time.monotonic() < deadline:
            for message in messages_of(socket.recv(timeout=PATIENCE))[0]:
                if message["type"] == "CameraFrustumMessage":
                    names.add(message["name"])
                    owner = message["owner"]
                if message["type"] == "SetCameraPositionMessage" and not message["initial"]:
                    place = message["position"]
            if len(names) == len(viewer.setup.dataset.frames):
                rays = {"ray_origin": [0.0] * 3, "ray_direction": [0.0, 0, 1], "screen_pos": [0.5, 0.5]}
                click = {"name": "/handles/cameras/3", "instance_index": None, "modifier": None, "owner": owner, **rays}
                socket.send(msgspec.msgpack.encode({"type": "SceneNodeClickMessage", **click}))
                names = set()
        assert place == pytest.approx(frame.camera.position.tolist())


def test_only_the_render_thread_asks_dr_jit(viewer, at_start, monkeypatch):
    """Whatever is pressed: a second thread in Dr.Jit would stop the whole process for good, now and then."""
    import drjit

    asked = set()

    def watched(function):
        def call(*arguments, **named):
            asked.add(threading.current_thread().name)
            return function(*arguments, **named)

        return call

    for name in ("width", "eval", "gather", "select", "zeros", "full", "sync_thread", "concat", "opaque"):
        monkeypatch.setattr(drjit, name, watched(getattr(drjit, name)))
    with connected(viewer) as socket:
        before = set(viewer.clients)
        socket.send(camera_message(0.1))
        pictures(socket, 1)
        client = viewer.clients[next(iter(set(viewer.clients) - before))]
        for gui in (viewer._server.gui, client.handle.gui):
            for handle in list(gui._gui_input_handle_from_uuid.values()):
                if getattr(handle, "label", "") == "Compare":
                    continue  # tracing is a process of its own
                value = getattr(handle, "value", True)
                if isinstance(value, bool):
                    press(socket, handle, not value)
                    press(socket, handle, value)
                elif isinstance(value, float | int):
                    press(socket, handle, value + 1)
                    press(socket, handle, value)
        for mode in ("depth", "object id", "ellipsoids", "normals", "colour"):
            press(socket, client.controls.mode, mode)
            pictures(socket, 1)
        moved = {"type": "TransformControlsUpdateMessage", "name": "/handles/models/0", "owner": ""}
        socket.send(msgspec.msgpack.encode({**moved, "wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 0.2]}))
        pictures(socket, 1)
        socket.send(camera_message(0.5))
        pictures(socket, 1)
    viewer.paths.stop()
    assert asked == {"render"}


def test_a_player_that_was_stopped_does_not_end_the_next(viewer):
    """Two clicks in a row: what plays then can be stopped, too."""
    paths = viewer.paths
    paths._start(-1, lambda when: None, 60.0)
    first = paths._players[-1]
    paths.forget(-1)
    paths._start(-1, lambda when: None, 60.0)
    first._thread.join(PATIENCE)
    assert paths._stop_playing(-1)
    wait_for(lambda: not paths._players, "the end")


def test_a_frame_brings_its_sun_where_no_model_can_be_relit(viewer, at_start):
    """As its truth is of that Sun, though the models' colours are not."""
    dataset, shared = viewer.setup.dataset, SharedScene(at_start)
    before = at_start.sun.direction
    number = next(k for k, frame in enumerate(dataset.frames) if not np.allclose(frame.sun.direction, before))
    session = SimpleNamespace(view=None)
    one = SimpleNamespace(
        _dataset=dataset, _sun=None, _shared=shared, session=session, look_from=lambda pose, fov: None
    )
    Client.jump_to_frame(one, number)
    assert shared.state.sun is dataset.frames[number].sun
