"""Vizard's part of the talk with Basilisk, without Basilisk: messages that the tests write, in documented frames."""

import logging
import struct

import numpy as np
import pytest
from test_server import asked

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at, rotation_from_quaternion
from spacesim.data.images import png_bytes, read_png
from spacesim.data.records import Camera, Sun
from spacesim.serve import wire
from spacesim.serve.server import serving
from spacesim.serve.vizard import MAX_BODIES, Simulation, depth_colors, rotation_from_mrp


def varint(number):
    out = b""
    while number > 0x7F:
        out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
    return out + bytes([number])


def field(number, value):
    """A field of a message: a whole number, a float, text, bytes, or several numbers."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value % (1 << 64))
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, list | np.ndarray):
        whole = all(isinstance(item, int) for item in value)
        value = b"".join(varint(item) if whole else struct.pack("<d", item) for item in value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def message(number, **fields):
    """A message within; fields: f1=, f2=, ..."""
    return field(number, b"".join(field(int(name[1:]), value) for name, value in fields.items()))


def mrp_of(rotation):
    """[3] of a matrix [BN], by its quaternion (Schaub and Junkins, equation 3.144: sigma = beta / (1 + beta0))."""
    w = 0.5 * np.sqrt(max(1 + np.trace(rotation), 1e-12))
    axis = [rotation[1, 2] - rotation[2, 1], rotation[2, 0] - rotation[0, 2], rotation[0, 1] - rotation[1, 0]]
    return np.array(axis) / (4 * w) / (1 + w)


def spacecraft(name, position, body_from_inertial, parent=""):
    return message(3, f1=name, f2=np.array(position), f4=mrp_of(body_from_inertial), f19=parent)


def planet(name, position, rotation=None):
    return message(2, f1=name, f2=np.array(position), f4=np.ravel(np.eye(3) if rotation is None else rotation))


def camera(number=1, parent="chaser", position=(0.0, 0, 0), camera_from_body=None, fov=20.0, size=(32, 24), **more):
    """As vizInterface writes it: after the camera's own turn comes that of Unity's axes, MRP (1/3, 1/3, -1/3)."""
    unity = rotation_from_mrp(np.array([1, 1, -1]) / 3)
    turn = mrp_of(unity @ (np.eye(3) if camera_from_body is None else camera_from_body))
    lens = {"f3": fov, "f4": list(size), "f7": np.array(position, float), "f8": turn}
    return message(4, f1=number, f2=parent, **lens, **more)


@pytest.fixture
def flight():
    """(VizMessage, camera, Sun): two spacecraft that are turned somehow, far from the origin, one looks at the other;
    what the camera and the Sun are in the target's axes, by geometry done otherwise."""
    chaser, target = (rotation_from_quaternion(q) for q in ([0.9, 0.1, -0.3, 0.2], [0.4, 0.5, 0.6, -0.2]))  # [N, B]
    mount = rotation_from_quaternion([0.7, 0.5, -0.4, 0.3])  # [B, C]
    pose = look_at([4.0, 1.0, -2.0], [0.1, 0, 0.1])  # wanted, in the target's axes
    inertial_from_camera = target @ pose[:3, :3]
    chaser = inertial_from_camera @ mount.T
    where = np.array([7e6, -1e5, 2e5])
    lever = np.array([0.3, -0.2, 1.1])
    chaser_at = where + target @ pose[:3, 3] - chaser @ lever
    sun = np.array([1.2e11, -8e10, 3e10])
    said = message(1, f1=4, f2=1e9)
    said += planet("earth", [0.0, 0, 0]) + planet("sun", sun)
    said += spacecraft("chaser", chaser_at, chaser.T) + spacecraft("target", where, target.T)
    said += camera(position=lever, camera_from_body=mount.T)
    focal = 12 / np.tan(np.radians(10))
    return said, Camera(pose, 32, 24, focal, focal, 16, 12), Sun(target.T @ (sun - where))


def test_the_view_is_that_of_geometry(ball, flight):
    said, expected, sun = flight
    simulation = Simulation(ball)
    assert simulation.answer([b"SIM_UPDATE", b"", b"", said]) == [b"OK"]
    seen, light = simulation.view(1)
    assert np.allclose(seen.world_from_camera, expected.world_from_camera, atol=1e-8)
    assert (seen.width, seen.height) == (32, 24)
    assert (seen.fx, seen.fy, seen.cx, seen.cy) == pytest.approx((expected.fx, expected.fy, 16, 12))
    assert np.allclose(light.direction, sun.direction)


def test_a_picture_is_the_one_that_is_drawn_from_there(ball, flight, tmp_path):
    said, view, sun = flight
    expected = ball.draw(view, sun, None, ("rgb",), 4)["rgb"]
    import zmq

    with serving(ball) as address, zmq.Context() as context, context.socket(zmq.REQ) as basilisk:
        basilisk.connect(address)
        answers = []
        for frames in [[b"PING"], [b"SIM_UPDATE", b"", b"", said], [b"REQUEST_IMAGE_1"], [b"REQUEST_INPUT"], [b"PING"]]:
            basilisk.send_multipart(frames)
            answers.append(basilisk.recv_multipart())
    assert answers[0] == answers[4] == [b"PONG"]
    assert answers[1] == [b"OK"]
    assert answers[3] == [b"VIZARD_INPUT", b""]
    length, picture = answers[2]
    assert int.from_bytes(length, "big") == len(picture)
    seen = read_png(tmp_path / "view.png", picture)
    assert seen.any()
    assert np.abs(seen.astype(int) - expected).max() <= 1  # the pose went through MRPs


def test_depth_maps_are_decoded_by_vizards_formula(ball, flight, tmp_path):
    said, view, sun = flight
    depth = ball.draw(view, sun, None, ("depth",), 0)["depth"]
    said += camera(2, position=(0.3, -0.2, 1.1), camera_from_body=np.eye(3), f16=1, f17=np.array([0.1, 20.0]))
    simulation = Simulation(ball)
    simulation.answer([b"SIM_UPDATE", b"", b"", said])
    assert simulation.answer([b"REQUEST_IMAGE_2"])[1][:4] == b"\x89PNG"
    colors = read_png(tmp_path / "depth.png", png_bytes(depth_colors(depth, 20.0))).astype(float)
    decoded = 20.0 * (colors / [255, 255**2, 255**3]).sum(axis=-1)
    surface = depth > 0
    assert surface.any()
    assert np.allclose(decoded[surface], depth[surface], atol=20 / 255**3 + 1e-6)
    assert (colors[~surface] == 255).all()


def test_which_body_is_the_target(ball):
    """One that is called as what is served; else the only other spacecraft; else the only planet but the Sun."""
    here, far, turn = spacecraft("chaser", [0.0, 0, 0], np.eye(3)), [0.0, 0, 9.0], np.eye(3)
    cases = [
        (spacecraft("hubble", far, turn), 9),
        (spacecraft("hubble", far, turn) + spacecraft("panel", [0.0, 1, 0], turn, parent="chaser"), 9),
        (spacecraft("hubble", far, turn) + spacecraft("dish", [0.0, 1, 0], turn, parent="hubble"), 9),
        (spacecraft("hubble", [0.0, 0, 3], turn) + spacecraft("Ball", far, turn), 9),
        (planet("sun_planet_data", [1.0, 1, 1]) + planet("bennu", far), 9),
        (planet("earth", [1.0, 1, 1]) + spacecraft("hubble", far, turn), 9),
        (planet("earth", [1.0, 1, 1]) + planet("ball", far), 9),
        (planet("earth", [1.0, 1, 1]) + planet("mars", far), "found earth, mars"),
        (spacecraft("a", far, turn) + spacecraft("b", far, turn), "one called ball, found a, b"),
        (b"", "found none"),
    ]
    for others, distance in cases:
        simulation = Simulation(ball)
        simulation.update(here + others + camera())
        if isinstance(distance, str):
            with pytest.raises(InputError, match=distance):
                simulation.view(1)
        else:
            assert simulation.view(1)[0].position.tolist() == pytest.approx([0, 0, -distance])


def test_without_a_sun_a_run_of_one_light_is_drawn_all_the_same(ball, traced, caplog):
    said = spacecraft("chaser", [0.0, 0, -5], np.eye(3)) + spacecraft("other", [0.0, 0, 0], np.eye(3)) + camera()
    simulation = Simulation(ball)
    simulation.answer([b"SIM_UPDATE", b"", b"", said])
    assert simulation.answer([b"REQUEST_IMAGE_1"])[1][:4] == b"\x89PNG"
    simulation = Simulation(traced)
    simulation.answer([b"SIM_UPDATE", b"", b"", said])
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert simulation.answer([b"REQUEST_IMAGE_1"]) == [bytes(4), b""]
    assert [record.message for record in caplog.records] == [
        "Basilisk gets no picture: sun: expected its direction for a scene, found none"
    ]


def test_missing_cameras_and_bodies_are_refused(ball, flight):
    said, _, _ = flight
    simulation = Simulation(ball)
    simulation.update(said)
    with pytest.raises(InputError, match=r"camera: expected one of \[1\], found 3"):
        simulation.view(3)
    simulation.update(camera(3, parent="nobody"))
    with pytest.raises(InputError, match="camera 3: expected a body called 'nobody'"):
        simulation.view(3)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (spacecraft("a", [0.0, 1], np.eye(3)), "a: position: expected 3 finite numbers, found 2"),
        (spacecraft("a", [0.0, 1, np.nan], np.eye(3)), "a: position: expected 3 finite numbers"),
        (message(3, f1="a", f2=np.zeros(3)), "a: rotation: expected 3"),
        (message(2, f1="a", f2=np.zeros(3), f4=np.zeros(3)), "a: rotation: expected 9"),
        (camera(size=(0, 3)), "camera 1: expected a number, a width and a height"),
        (camera(fov=0.0), "camera 1: expected a field of view between 0 and 180"),
        (field(3, 1), "expected a message within"),
        (message(3, f1=3), "expected bytes"),
        (message(3, f2=b"1234567"), "expected numbers of 8 bytes"),
        (b"\x1a\x05abc", "cut off"),
        (b"\x1a", "cut off"),
        (b"\xff" * 11, "at most 10 bytes"),
        (b"\x00", "numbered from 1"),
        (b"\x0b", "expected wire types"),
    ],
)
def test_broken_messages_are_answered_with_an_error(ball, said, words):
    (answer,) = Simulation(ball).answer([b"SIM_UPDATE", b"", b"", said])
    assert answer.startswith(b"ERROR ")
    assert words in answer.decode()


def test_no_more_bodies_are_kept_than_there_may_be(ball, flight):
    simulation = Simulation(ball)
    simulation.answer([b"SIM_UPDATE", b"", b"", flight[0]])
    before = simulation.view(1)[0].world_from_camera
    many = b"".join(spacecraft(str(k), [0.0, 0, 0], np.eye(3)) for k in range(MAX_BODIES + 1))
    (answer,) = simulation.answer([b"SIM_UPDATE", b"", b"", many])
    assert b"expected at most" in answer
    assert simulation.answer([b"SIM_UPDATE", b"", b"", flight[0]]) == [b"OK"]
    np.testing.assert_array_equal(simulation.view(1)[0].world_from_camera, before)


def test_bytes_that_flip_do_no_harm(ball, flight):
    random, said = np.random.default_rng(1), flight[0]
    answers = set()
    for _ in range(2000):
        broken = bytearray(said)
        for place in random.integers(len(said), size=random.integers(1, 4)):
            broken[place] = random.integers(256)
        simulation = Simulation(ball)
        answers.add(
            simulation.answer([b"SIM_UPDATE", b"", b"", bytes(broken[: random.integers(1, 2 * len(said))])])[0][:2]
        )
        try:
            simulation.view(1)
        except InputError:
            continue
    assert answers == {b"OK", b"ER"}


def test_the_wire_is_read_as_protobuf_writes_it():
    descriptor = pytest.importorskip("google.protobuf.wrappers_pb2", reason="protobuf is not installed")
    for kind, number in ((descriptor.Int64Value, -7), (descriptor.UInt64Value, 2**63), (descriptor.Int64Value, 300)):
        ((at, value),) = wire.fields(kind(value=number).SerializeToString())
        assert (at, wire.integers(value)[0] % 2**64) == (1, number % 2**64)
    ((_, value),) = wire.fields(descriptor.DoubleValue(value=-2.5).SerializeToString())
    assert wire.doubles(value).tolist() == [-2.5]
    ((_, value),) = wire.fields(descriptor.StringValue(value="Bénnu").SerializeToString())
    assert wire.text(value) == "Bénnu"


def test_our_own_protocol_is_not_taken_for_basilisks(ball):
    with serving(ball) as address:
        assert b"error" in asked(address, b"REQUEST_IMAGE_")[0]
        assert b"error" in asked(address, b"PINGPONG")[0]
