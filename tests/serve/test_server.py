"""The server's answers are what `render` and `generate` draw, and nothing that clients do harms it."""

import json
import os
import socket
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from serving import CAMERA, SUN

from spacesim.data.errors import InputError, WorkError
from spacesim.data.images.tone import as_bytes
from spacesim.data.records import Sun
from spacesim.serve import client as client_module
from spacesim.serve.client import CameraClient
from spacesim.serve.draw import PredictedRun, load_served
from spacesim.serve.protocol import OUTPUTS, arrays_of
from spacesim.serve.server import MAX_FRAME_BYTES, CameraServer, serving
from spacesim.splat.compose import ComposeConfig, GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.run import ComposedRun

DROPPED = "serve: a client takes no answers; what it asks for is dropped"
PATIENCE = 60_000  #: milliseconds
POSE = {"position": [5, 0, 0], "rotation_wxyz": [0.5, -0.5, -0.5, 0.5]}
REQUEST = {"version": 1, "id": 5, "camera": {**POSE, "width": 16, "height": 16, "fov_deg": 30}}


def asked(address, *frames, kind="REQ"):
    """The frames that answer those of a client of its own."""
    import zmq

    with zmq.Context() as context, context.socket(getattr(zmq, kind)) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.connect(address)
        client.send_multipart(frames)
        assert client.poll(PATIENCE)
        return client.recv_multipart()


def test_a_run_is_drawn_as_it_predicts(ball):
    expected = ball.run.predict(CAMERA, normals=True)
    with serving(ball) as address, CameraClient(address) as client:
        seen = client.picture(CAMERA, outputs=("rgb", "alpha", "depth", "normal"))
    assert np.array_equal(seen["rgb"], as_bytes(expected.rgb))
    assert seen["rgb"].any()
    for name in ("alpha", "depth", "normal"):
        assert np.array_equal(seen[name], getattr(expected, name)), name


def test_a_scene_is_path_traced_with_its_labels(traced):
    from spacesim.scenes.build import build
    from spacesim.scenes.render import Renderer
    from spacesim.scenes.scenefile import read_scene

    config = read_scene("boxsat")
    truth = Renderer(build(config), 4, config.quality.max_depth).render(CAMERA, SUN, (config.seed, 9))
    with serving(traced) as address, CameraClient(address) as client:
        seen = client.picture(CAMERA, SUN, outputs=OUTPUTS, seed=9)
        again = client.picture(CAMERA, SUN, seed=9)
        other = client.picture(CAMERA, SUN, seed=10)
        brighter = client.picture(CAMERA, SUN, seed=9, exposure=1.0)
    assert set(seen) == set(OUTPUTS)
    for name in ("radiance", "alpha", "depth", "normal", "object_id", "part_id", "shadow"):
        assert np.array_equal(seen[name], getattr(truth, name)), name
    assert np.array_equal(seen["visibility"], truth.sun_visibility)
    assert np.array_equal(seen["rgb"], again["rgb"])
    assert not np.array_equal(seen["rgb"], other["rgb"])
    assert brighter["rgb"].mean() > seen["rgb"].mean() > 1


def test_pictures_are_those_of_generate(tmp_path, spacesim):
    """Of a scene with a sensor, whose noise the frame's number makes, and of one without."""
    from spacesim.data.images import load_image, read_png
    from spacesim.data.store import read_dataset

    text = '[[objects]]\nspacecraft = "boxsat"\n[camera]\nresolution = [24, 24]\n'
    for name, more in (("plain", ""), ("noisy", "[camera.sensor]\n")):
        scene = tmp_path / f"{name}.toml"
        scene.write_text(text + more)
        done = spacesim("generate", scene, "--out", tmp_path / name, "--views", 2, "--test-views", 1, "--spp", 4)
        assert done.code == 0, done.errors
        data = read_dataset(tmp_path / name)
        frame = data.train[1]
        with serving(load_served(scene, spp=4)) as address, CameraClient(address) as client:
            seen = client.picture(frame.camera, frame.sun, seed=1)["rgb"]
        if name == "noisy":
            assert np.array_equal(seen, read_png(data.root / frame.file_path))
        else:
            image = load_image(data, frame)
            assert np.abs(seen / 255 - image.over(np.zeros(3))).max() < 1.01 / 255


def test_a_request_without_a_picture_describes_the_server(ball, traced):
    for served, kind in ((ball, "run"), (traced, "scene")):
        with serving(served) as address:
            facts = json.loads(asked(address, b'{"version": 1, "id": "who"}')[0])
        assert (facts["id"], facts["kind"], facts["served"]) == ("who", kind, served.names[0])
        assert "rgb" in facts["outputs"]


@pytest.mark.parametrize("shadows", ["trained", "none"])
def test_pictures_have_the_announced_arrays(ball, shadows):
    """And no others; of a run and of a composed scene, whose models shade each other or do not."""
    models = [PlacedRun(ball.run), PlacedRun(ball.run, Pose(translation=[0, 0, 1.6]))]
    pair = PredictedRun(ComposedRun(GaussianComposition(models, ComposeConfig(shadows)), Path("pair.toml")))
    seen = {"trained": {"visibility"}, "none": set()}[shadows]
    always = {"rgb", "alpha", "depth", "normal"}
    for served, expected in ((ball, always), (pair, always | {"object_id"} | seen)):
        with serving(served) as address, CameraClient(address) as client:
            said = json.loads(asked(address, b'{"version": 1}')[0])["outputs"]
            assert (len(said), set(said)) == (len(expected), expected)
            assert set(client.picture(CAMERA, SUN, outputs=said)) == expected
            sentence = f"outputs: expected some of {', '.join(said)} of {served.names[0]}, found "
            for name in set(OUTPUTS) - expected:
                with pytest.raises(InputError, match=f"^{sentence}{name}$"):
                    client.picture(CAMERA, SUN, outputs=("rgb", name))


def test_errors_are_sentences(ball, traced):
    with serving(ball) as address, CameraClient(address) as client:
        with pytest.raises(InputError, match="outputs: expected some of rgb, alpha, depth, normal of ball, found"):
            client.picture(CAMERA, outputs=("visibility",))
        with pytest.raises(InputError, match="exposure: expected a run trained in linear light"):
            client.picture(CAMERA, exposure=1.0)
        assert client.picture(CAMERA)["rgb"].shape == (32, 40, 3)
    with serving(traced) as address, CameraClient(address) as client:
        with pytest.raises(InputError, match="sun: expected its direction"):
            client.picture(CAMERA)
        with pytest.raises(InputError, match="exposure: expected -40 to 40 EV"):
            client.picture(CAMERA, SUN, exposure=1e3)


class Broken:
    """Fails as Dr.Jit does."""

    names, facts = ("broken",), {}

    def draw(self, *arguments):
        raise RuntimeError("jit_eval(): \n out of luck")


def test_a_computation_that_fails_ends_no_server(caplog):
    from test_vizard import camera, spacecraft

    said = spacecraft("chaser", [0.0, 0, -5], np.eye(3)) + spacecraft("other", [0.0, 0, 0], np.eye(3)) + camera()
    with serving(Broken()) as address, CameraClient(address) as client:
        for _ in range(2):
            with pytest.raises(InputError, match="the computation failed; the server's log says why"):
                client.picture(CAMERA)
        import zmq

        with zmq.Context() as context, context.socket(zmq.REQ) as basilisk:
            basilisk.connect(address)
            for frames, answer in (([b"SIM_UPDATE", said], [b"OK"]), ([b"REQUEST_IMAGE_1"], [bytes(4), b""])):
                basilisk.send_multipart(frames)
                assert basilisk.recv_multipart() == answer
    assert "serve: the computation failed (jit_eval(): out of luck)" in caplog.messages


def test_any_socket_that_asks_is_answered(ball):
    with serving(ball) as address:
        for kind in ("REQ", "DEALER"):
            assert arrays_of(asked(address, json.dumps(REQUEST).encode(), kind=kind))["rgb"].any()


def test_garbage_and_clients_that_hang_up_do_no_harm(ball):
    random = np.random.default_rng(0)
    request = json.dumps(REQUEST).encode()
    with serving(ball) as address:
        place = ("127.0.0.1", int(address.rpartition(":")[2]))
        greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
        ready = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
        part = b"\x01\x00\x00" + bytes([len(request)])  # of a message: its length, then half of it
        openings = [random.bytes(200), b"GET / HTTP/1.1\r\n\r\n", greeting, greeting[:20], greeting + ready]
        openings += [greeting + ready + part + request[:20], greeting + ready + b"\x02" + struct.pack(">Q", 1 << 60)]
        for opening in openings * 3:
            with socket.create_connection(place) as client:
                client.sendall(opening)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with pytest.raises(AssertionError):  # too long: the connection ends without a word
            asked_soon(address, bytes(MAX_FRAME_BYTES + 1))
        for frames in ([b""], [b"", b"", b""], [random.bytes(99)] * 50, [b"SIM_UPDATE"], [b"REQUEST_IMAGE_1"]):
            asked(address, *frames)
        for size in ({"width": 10**400}, {"height": 10**400}, {"width": 2**20}):
            huge = json.dumps(REQUEST | {"camera": REQUEST["camera"] | size}).encode()
            assert b"camera: expected at most" in asked(address, huge)[0]
        assert arrays_of(asked(address, request))["rgb"].any()


def asked_soon(address, *frames):
    """As `asked`, without patience."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.connect(address)
        client.send_multipart(frames)
        assert client.poll(500)


def test_many_requests_at_once_are_all_answered_in_order_and_memory_stays(ball):
    """benchmarks/serve.py does it with 10,000."""
    import zmq

    clients, each, ahead = 3, 300, 20
    with serving(ball) as address, zmq.Context() as context:
        sockets = [context.socket(zmq.DEALER) for _ in range(clients)]
        for client in sockets:
            client.connect(address)
        before = None
        for k in range(each + ahead):
            for client in sockets:
                if k < each:
                    client.send(json.dumps({**REQUEST, "id": k}).encode())
                if k >= ahead:
                    assert client.poll(PATIENCE)
                    answer = client.recv_multipart()
                    assert json.loads(answer[0])["id"] == k - ahead
                    assert len(answer[1]) == 16 * 16 * 3
            before = resident() if k == each // 3 else before
        for client in sockets:
            client.close(0)
    assert resident() - before < 20e6


def resident():
    """Bytes of this process in memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_client_that_takes_no_answers_does_not_stop_the_others(ball, monkeypatch, caplog):
    import zmq

    monkeypatch.setattr("spacesim.serve.server.PATIENCE", 1.0)
    large = {**REQUEST, "camera": {**REQUEST["camera"], "width": 512, "height": 512}}
    with serving(ball) as address, zmq.Context() as context, context.socket(zmq.DEALER) as greedy:
        greedy.setsockopt(zmq.LINGER, 0)
        greedy.setsockopt(zmq.RCVHWM, 1)
        greedy.setsockopt(zmq.RCVBUF, 4096)
        greedy.connect(address)
        for _ in range(60):
            greedy.send(json.dumps(large).encode())
        start = time.monotonic()
        while DROPPED not in caplog.messages and time.monotonic() - start < 60:
            time.sleep(0.1)
        start = time.monotonic()
        assert arrays_of(asked(address, json.dumps(REQUEST).encode()))["rgb"].any()
        assert time.monotonic() - start < 20  # far less than a wait for each
    assert caplog.messages.count(DROPPED) == 1


def test_a_client_waits_no_longer_than_its_timeout(monkeypatch, caplog):
    monkeypatch.setattr(client_module, "PATIENCE", 0.02)
    with CameraClient("tcp://127.0.0.1:9", timeout=0.1) as client:
        with pytest.raises(InputError, match="camera: expected a Camera"):
            client.picture(3, sun=(1, 2))
        for _ in range(2):
            caplog.clear()
            with pytest.raises(WorkError, match=r"127.0.0.1:9: expected an answer within 0.1 s"):
                client.picture(CAMERA, Sun(np.array([0.0, 0, 1])))
            assert caplog.messages == ["tcp://127.0.0.1:9: no answer after 0.02 s, waiting up to 0.1 s"]


def test_addresses_that_cannot_be_had(ball):
    with serving(ball) as address:
        taken = int(address.rpartition(":")[2])
        for host, port, words in [
            ("127.0.0.1", taken, f"port: expected a free port, found {taken}"),
            ("127.0.0.1", 65536, "port: expected 0 to 65535"),
            ("192.0.2.1", 0, "host: expected a name or address of this machine"),
            ("no such name", 0, "host: expected a name or address"),
        ]:
            with pytest.raises(InputError, match=words):
                CameraServer(ball, host, port)
    server = CameraServer(ball, "localhost", 0)
    server.close()
    assert "127.0.0.1" in server.address or "::1" in server.address
