"""Vizard's side of the talk with Basilisk's `vizInterface`, so that Basilisk takes our pictures for Vizard's.

Basilisk (2.12) sends, each time waiting for the answer:

    PING                                    PONG
    SIM_UPDATE, "", "", a VizMessage        OK, or a sentence, which ends the simulation
    REQUEST_IMAGE_<camera>                  length (4 bytes, the highest first), a PNG; 0 and nothing where there is no
                                            picture, which the log says why
    REQUEST_INPUT                           VIZARD_INPUT, a VizInput, which is empty

A VizMessage has the bodies in the inertial frame N and the cameras on them. What is served stands for one of the
bodies, the target: the one that is called as it or its object is, else the only spacecraft that does not carry the
camera, else the only celestial body but the Sun. Its body axes are our world's. The Sun is the celestial body whose
name begins with "sun".
"""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import Array, cross_matrix
from spacesim.data.images import png_bytes
from spacesim.data.records import Camera, Sun
from spacesim.serve import wire
from spacesim.serve.draw import Served, draw
from spacesim.serve.wire import Value

MAX_BODIES = 4096  #: that a simulation may name
MAX_NUMBER = 1e18  #: of a message: metres, parameters of a rotation (a hundred light years)
FAR = 100.0  #: metres of the plane beyond which a depth map is white, where the camera does not say
_REQUEST = re.compile(rb"REQUEST_IMAGE_(-?[0-9]{1,19})")
_UNITY_FROM_CAMERA = (1 / 3, 1 / 3, -1 / 3)  # MRP that vizInterface puts after the camera's own (Unity looks along -x)
_DEPTH_MAP = 1  # render mode

_log = logging.getLogger(__name__)


def rotation_from_mrp(mrp: Array) -> Array:
    """[3, 3] the matrix [BN] that takes components in N to those in B, by the modified Rodrigues parameters [3] of B
    relative to N (Schaub and Junkins, Analytical Mechanics of Space Systems, equation 3.152)."""
    cross = cross_matrix(mrp)
    square = float(mrp @ mrp)
    return np.eye(3) + (8 * cross @ cross - 4 * (1 - square) * cross) / (1 + square) ** 2


@dataclass(frozen=True, eq=False)
class Body:
    """A spacecraft or a celestial body."""

    name: str  #: as Basilisk has it
    position: Array  #: [3] metres, N
    body_from_inertial: Array  #: [3, 3]
    is_spacecraft: bool  #: false of a celestial body
    parent: str = ""  #: the spacecraft that it is a component of

    @property
    def is_sun(self) -> bool:
        """Whether it is what lights the scene."""
        return not self.is_spacecraft and self.name.lower().startswith("sun")


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera on a body."""

    number: int  #: by which Basilisk asks for its pictures
    parent: str  #: name of the body
    fov_deg: float  #: across the height
    width: int  #: pixels
    height: int  #: pixels
    position: Array  #: [3] metres, body axes
    camera_from_body: Array  #: [3, 3], x right, y down, z forward
    far: float | None  #: metres, of a camera that maps depth; None of one that takes pictures


class Simulation:
    """The state that one Basilisk has sent so far; the number of its frame makes the noise of path-traced pictures."""

    def __init__(self, served: Served) -> None:
        self._served = served
        self._bodies: dict[str, Body] = {}
        self._cameras: dict[int, MountedCamera] = {}
        self._frame = 0
        self._last_warning = ""

    def answer(self, frames: Sequence[bytes]) -> list[bytes] | None:
        """Frames of the answer; None where this is none of Basilisk's words."""
        word = frames[0]
        if word == b"PING":
            return [b"PONG"]
        if word == b"SIM_UPDATE":
            return [self._update(frames[-1])]
        if word == b"REQUEST_INPUT":
            return [b"VIZARD_INPUT", b""]
        request = _REQUEST.fullmatch(word)
        if request is None:
            return None
        picture = self._picture(int(request[1]))
        return [len(picture).to_bytes(4, "big"), picture]

    def update(self, message: bytes) -> None:
        """Take in a VizMessage. Raises InputError for what is none."""
        bodies, cameras = dict(self._bodies), dict(self._cameras)
        for number, value in wire.fields(message):
            if number == 1:
                numbers = [wire.integers(inner) for key, inner in wire.fields(_message(value)) if key == 1]
                self._frame = max(0, *(frame for frames in numbers for frame in frames), 0)
            elif number in (2, 3):
                body = _read_body(value, is_spacecraft=number == 3)
                bodies[body.name] = body
            elif number == 4:
                camera = _read_camera(value)
                cameras[camera.number] = camera
            if len(bodies) + len(cameras) > MAX_BODIES:
                raise InputError(f"message: expected at most {MAX_BODIES} bodies and cameras, found more")
        self._bodies, self._cameras = bodies, cameras

    def view(self, number: int) -> tuple[Camera, Sun | None]:
        """Camera `number` and the Sun in the target's axes. Raises InputError where bodies are missing."""
        mounted = self._mounted(number)
        carrier = self._carrier(mounted)
        target = self._target(carrier)
        inertial_from_carrier, target_from_inertial = carrier.body_from_inertial.T, target.body_from_inertial
        place = carrier.position - target.position + inertial_from_carrier @ mounted.position
        pose = np.eye(4)
        pose[:3, :3] = target_from_inertial @ inertial_from_carrier @ mounted.camera_from_body.T
        pose[:3, 3] = target_from_inertial @ place
        width, height = mounted.width, mounted.height
        focal = 0.5 * height / np.tan(0.5 * np.radians(mounted.fov_deg))
        camera = Camera(pose, width, height, focal, focal, 0.5 * width, 0.5 * height)
        suns = [body for body in self._bodies.values() if body.is_sun]
        if not suns:
            return camera, None
        return camera, Sun(target_from_inertial @ (suns[0].position - target.position))

    def _mounted(self, number: int) -> MountedCamera:
        if number not in self._cameras:
            known = f"one of {sorted(self._cameras)}" if self._cameras else "a camera that Basilisk has mounted"
            raise InputError(f"camera: expected {known}, found {number}")
        return self._cameras[number]

    def _carrier(self, camera: MountedCamera) -> Body:
        crafts = [body.name for body in self._bodies.values() if body.is_spacecraft]
        name = camera.parent or next(iter(crafts), "")
        if name not in self._bodies:
            raise InputError(f"camera {camera.number}: expected a body called {name!r} that carries it, found none")
        return self._bodies[name]

    def _target(self, carrier: Body) -> Body:
        others = [body for body in self._bodies.values() if body is not carrier]
        wanted = [name.lower() for name in self._served.names]
        named = [body for name in wanted for body in others if body.name.lower() == name]
        if named:
            return named[0]
        aboard = {carrier.name, carrier.parent}
        crafts = [body for body in others if body.is_spacecraft and body.name not in aboard and not body.parent]
        planets = [body for body in others if not body.is_spacecraft and not body.is_sun]
        only = crafts or planets
        if len(only) != 1:
            names = ", ".join(body.name for body in only) or "none"
            raise InputError(f"target: expected one body, or one called {' or '.join(wanted)}, found {names}")
        return only[0]

    def _update(self, message: bytes) -> bytes:
        try:
            self.update(message)
        except InputError as error:
            self._tell(str(error))
            return f"ERROR {error}".encode()
        return b"OK"

    def _picture(self, number: int) -> bytes:
        """A PNG; nothing where there is none, which the log says why."""
        try:
            camera, sun = self.view(number)
            far = self._mounted(number).far
            if far is None:
                return png_bytes(draw(self._served, camera, sun, None, ("rgb",), self._frame)["rgb"])
            return png_bytes(depth_colors(draw(self._served, camera, sun, None, ("depth",), 0)["depth"], far))
        except (InputError, WorkError, MemoryError) as error:
            self._tell(str(error))
            return b""

    def _tell(self, sentence: str) -> None:
        """Once: Basilisk asks again and again."""
        if sentence != self._last_warning:
            _log.warning("Basilisk gets no picture: %s", sentence)
        self._last_warning = sentence


def depth_colors(depth: Array, far: float) -> np.ndarray:
    """[H, W, 3] uint8 of a depth map [H, W], metres, as Vizard's documents have it: far (r / 255 + g / 255^2 +
    b / 255^3); white beyond `far` and where there is no surface (depth 0)."""
    rest = np.where((depth > 0) & (depth < far), np.asarray(depth, np.float64) / far, 0.0)
    digits = []
    for _ in range(3):
        rest = 255 * rest
        digits.append(np.floor(rest))
        rest = rest - digits[-1]
    colors = np.stack(digits, axis=-1).astype(np.uint8)
    colors[(depth <= 0) | (depth >= far)] = 255
    return colors


def _read_body(value: Value, is_spacecraft: bool) -> Body:
    name, parent = "", ""
    lists: dict[int, list[float]] = {2: [], 4: []}
    for number, inner in wire.fields(_message(value)):
        if number == 1:
            name = wire.text(inner)
        elif number in lists:
            lists[number].extend(wire.doubles(inner))
        elif number == 19 and is_spacecraft:
            parent = wire.text(inner)
    position = _vector(lists[2], f"{name}: position", 3)
    turn = _vector(lists[4], f"{name}: rotation", 3 if is_spacecraft else 9)
    rotation = rotation_from_mrp(turn) if is_spacecraft else turn.reshape(3, 3)
    return Body(name, position, rotation, is_spacecraft, parent)


def _read_camera(value: Value) -> MountedCamera:
    texts: dict[int, str] = {2: ""}
    numbers: dict[int, list[int]] = {1: [0], 4: [], 16: [0]}
    lists: dict[int, list[float]] = {3: [], 7: [], 8: [], 17: []}
    for number, inner in wire.fields(_message(value)):
        if number in texts:
            texts[number] = wire.text(inner)
        elif number in lists:
            lists[number].extend(wire.doubles(inner))
        elif number == 4:
            numbers[4].extend(wire.integers(inner))
        elif number in numbers:
            numbers[number] = wire.integers(inner)
    which = f"camera {numbers[1][0]}" if numbers[1] else "camera"
    if len(numbers[1]) != 1 or len(numbers[4]) != 2 or min(numbers[4]) < 1:
        raise InputError(f"{which}: expected a number, a width and a height, found others")
    fov = float(_vector(lists[3], f"{which}: field of view", 1)[0])
    if not 0 < fov < 180:
        raise InputError(f"{which}: expected a field of view between 0 and 180 degrees, found {fov:g}")
    turned = rotation_from_mrp(_vector(lists[8], f"{which}: direction", 3))  # [unity, body]
    unity_from_camera = rotation_from_mrp(np.array(_UNITY_FROM_CAMERA))
    far = None
    if numbers[16] and numbers[16][0] == _DEPTH_MAP:
        far = float(lists[17][1]) if len(lists[17]) == 2 and 0 < lists[17][1] < MAX_NUMBER else FAR
    width, height = numbers[4]
    place = _vector(lists[7], f"{which}: position", 3)
    return MountedCamera(numbers[1][0], texts[2], fov, width, height, place, unity_from_camera.T @ turned, far)


def _message(value: Value) -> bytes:
    if isinstance(value, int):
        raise InputError("message: expected a message within, found a whole number")
    return value


def _vector(numbers: Sequence[float], what: str, count: int) -> Array:
    vector = np.array(numbers, np.float64)
    if vector.shape != (count,) or not (np.abs(vector) <= MAX_NUMBER).all():
        raise InputError(f"{what}: expected {count} finite number{'s' * (count > 1)}, found {len(numbers)}")
    return vector
