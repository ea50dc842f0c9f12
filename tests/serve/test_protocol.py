"""Requests as they are read, and answers as they are written and read."""

import inspect
import json
import re
from dataclasses import fields

import numpy as np
import pytest
from serving import CAMERA as CAMERA_SEEN
from serving import SUN

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at, quaternion_from_rotation
from spacesim.serve import protocol
from spacesim.serve.protocol import (
    MAX_REQUEST_BYTES,
    CameraFields,
    PictureRequest,
    arrays_of,
    error_answer,
    facts_answer,
    picture_answer,
    read_request,
)

CAMERA = {"position": [0, 0, -5], "rotation_wxyz": [1, 0, 0, 0], "width": 8, "height": 6, "fov_deg": 90}


def read(**fields):
    return read_request(json.dumps({"version": 1, "id": 7, **fields}).encode())


def test_a_request_is_read():
    number, request = read(camera=CAMERA, sun=[0, 0, 2], exposure=-1.5, outputs=["rgb", "depth"], seed=3)
    camera = request.camera.camera()
    assert (number, request.outputs, request.exposure, request.seed) == (7, ("rgb", "depth"), -1.5, 3)
    assert camera.position.tolist() == [0, 0, -5]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((4, 4, 4, 3))
    assert request.direction.direction.tolist() == [0, 0, 1]


def documented() -> str:
    return " ".join(protocol.__doc__.split())


def names_in(value) -> set[str]:
    """Keys of a JSON object, of those in it, too."""
    if isinstance(value, list):
        return set().union(*map(names_in, value))
    return set(value).union(*map(names_in, value.values())) if isinstance(value, dict) else set()


def test_every_field_of_a_request_is_documented_and_no_other():
    asked, answered = documented().split("An answer is")
    asked = asked.partition("a JSON object:")[2]
    known = {f.name for record in (PictureRequest, CameraFields) for f in fields(record)} | {"version", "id"}
    assert [name for name in sorted(known) if not re.search(rf"\b{name}\b", asked)] == []
    described = re.findall(r"^    (\w+)  +\S", protocol.__doc__, re.MULTILINE)
    assert set(described) == {f.name for f in fields(PictureRequest)} | {"version", "id"}
    assert answered


def test_every_field_of_an_answer_is_documented(ball, traced):
    answered = documented().split("An answer is")[1]
    made = [
        picture_answer(1, {"rgb": np.zeros((2, 3, 3), np.uint8)}, 0.1),
        error_answer(1, "no"),
        *(facts_answer(1, served.facts) for served in (ball, traced)),
    ]
    names = set().union(*(names_in(json.loads(answer[0])) for answer in made))
    assert len(names) > 10
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", answered)] == []


def test_arrays_have_the_types_that_are_documented(ball, traced):
    said = re.findall(r'^    "(\w+)",  # \[(H, W(?:, 3)?)\] (.+)$', inspect.getsource(protocol), re.MULTILINE)
    assert [name for name, _, _ in said] == list(protocol.OUTPUTS)
    for served, outputs in ((ball, ("rgb", "alpha", "depth", "normal")), (traced, protocol.OUTPUTS)):
        assert set(outputs) <= set(served.facts["outputs"])
        arrays = served.draw(CAMERA_SEEN, SUN, None, outputs, 0)
        for name, shape, words in said:
            if name in arrays:
                ends = {"H, W": (), "H, W, 3": (3,)}[shape]
                assert arrays[name].shape == (CAMERA_SEEN.height, CAMERA_SEEN.width, *ends), name
                assert re.search(rf"\b{arrays[name].dtype.name}\b", words.partition(":")[0]), name


def test_a_pose_is_a_matrix_or_a_quaternion():
    pose = look_at([3.0, 1, 2], [0, 0, 0])
    lens = {"width": 8, "height": 6, "fx": 10, "fy": 11, "cx": 1, "cy": 2}
    turn = quaternion_from_rotation(pose[:3, :3]).tolist()
    _, first = read(camera={"world_from_camera": pose.tolist(), **lens})
    _, second = read(camera={"position": pose[:3, 3].tolist(), "rotation_wxyz": turn, **lens})
    assert np.allclose(first.camera.camera().world_from_camera, pose)
    assert np.allclose(second.camera.camera().world_from_camera, pose)
    assert second.camera.camera().fy == 11


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"camera": {**CAMERA, "rotation_wxyz": [2, 0, 0, 0]}}, "rotation_wxyz: expected a quaternion of length 1"),
        ({"camera": {**CAMERA, "rotation_wxyz": [0, 0, 0]}}, "camera.rotation_wxyz: expected a list of 4"),
        ({"camera": {**CAMERA, "position": [0, float("nan"), 0]}}, "camera.position[1]: expected a finite number"),
        ({"camera": {**CAMERA, "world_from_camera": np.eye(4).tolist()}}, "world_from_camera alone"),
        ({"camera": {**CAMERA, "position": None}}, "expected position and rotation_wxyz"),
        ({"camera": {**CAMERA, "fx": 10}}, "expected either fov_deg or fx, found both"),
        ({"camera": {**CAMERA, "fov_deg": 180}}, "fov_deg: expected an angle"),
        ({"camera": {**CAMERA, "width": 0}}, "at least 1x1"),
        ({"camera": {**CAMERA, "width": 10**9}}, "at most"),
        ({"camera": {**CAMERA, "widht": 3}}, "widht"),
        ({"camera": 3}, "camera: expected a table"),
        ({"outputs": ["rbg"]}, "did you mean rgb?"),
        ({"outputs": []}, "outputs: expected some of"),
        ({"sun": [1]}, "sun: expected a direction"),
        ({"sun": [0, 0, 0]}, "sun direction: expected"),
        ({"exposure": "bright"}, "exposure: expected a finite number"),
        ({"seed": -1}, "seed: expected"),
        ({"version": 2}, "version: expected 1, found 2"),
        ({"version": True}, "version: expected 1"),
    ],
)
def test_invalid_requests_are_refused(fields, words):
    number, request = read(**fields)
    if not isinstance(request, InputError):
        with pytest.raises(InputError) as caught:
            (request.camera and request.camera.camera(), request.direction)
        request = caught.value
    assert number == 7
    assert words in str(request)


@pytest.mark.parametrize(
    "frame",
    [
        *(b"", b"\x00\xff" * 50, b"[1]", b"{", b"null", b"[" * 60_000, b" " * (MAX_REQUEST_BYTES + 1)),
        *(b'{"id": [1]}', b"9" * 5000, b'{"version": 1, "id": 1.5}'),
    ],
)
def test_garbage_is_refused(frame):
    number, request = read_request(frame)
    assert number is None
    assert isinstance(request, InputError)


@pytest.mark.parametrize("name", ["camera", "seed", "version"])
def test_deeply_nested_brackets_are_refused(name):
    """However many: some depths can be read and not be written."""
    for depth in range(700, 1100):
        _, request = read_request(b'{"version": 1, "%s": %s%s}' % (name.encode(), b"[" * depth, b"]" * depth))
        assert isinstance(request, InputError)


def test_an_answer_is_read_as_it_was_written():
    arrays = {"rgb": np.arange(24, dtype=np.uint8).reshape(2, 4, 3), "depth": np.ones((2, 4), ">f4")[:, ::2]}
    frames = picture_answer("a", arrays, 0.25)
    header = json.loads(frames[0])
    assert (header["version"], header["id"], header["seconds"]) == (1, "a", 0.25)
    assert header["arrays"][1] == {"name": "depth", "dtype": "float32", "shape": [2, 2]}
    read_back = arrays_of(frames)
    assert all(np.array_equal(read_back[name], array) for name, array in arrays.items())
    with pytest.raises(InputError, match=r"^it rains$"):
        arrays_of(error_answer(1, "it rains"))


@pytest.mark.parametrize("frames", [[], [b"x"], [b"3"], [b'{"arrays": [{}]}', b""], [b'{"arrays": []}', b"more"]])
def test_what_is_no_answer_is_refused(frames):
    with pytest.raises(InputError, match="answer: expected one of spacesim serve"):
        arrays_of(frames)
