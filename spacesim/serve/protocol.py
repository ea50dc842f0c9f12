"""Requests of clients and their answers, in frames of ZeroMQ.

A request is one frame, a JSON object:

    version   1
    id        any text or whole number; the answer has it, too
    camera    position [3] (metres, world) and rotation_wxyz [4], the quaternion that turns camera axes (x right, y
              down, z forward) into the world's, or world_from_camera [4, 4]; width, height (pixels); fov_deg (across
              the width), or fx, fy, cx, cy (pixels). Without a camera the answer says what is served
    sun       direction towards the Sun [3], world, or azimuth and elevation [2], degrees
    exposure  EV, by default that of the scene or of the training pictures
    outputs   names of arrays, of OUTPUTS; by default rgb alone
    seed      a whole number that makes the noise, 0 by default

An answer is a JSON object with version, id, seconds that drawing took, and arrays [{name, dtype, shape}], then a frame
for each array: its numbers, little-endian, the last index fastest. What is served is one frame, with version, id,
served (its name), kind ("scene" or "run"), spp (samples a pixel, of a scene) or method (of a run), relightable (whether
it takes a Sun) and outputs (names of arrays that it has; an error for another lists them). A request that cannot be
met is answered by one frame, with version, id, and error, a sentence.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Literal, get_args

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict
from spacesim.data.geometry import rotation_from_quaternion
from spacesim.data.records import Camera, Sun, check_size
from spacesim.data.structure import Rules, structure
from spacesim.data.toml import Document

VERSION = 1
INSTALL = "pip install 'spacesim[serve]'"
MAX_REQUEST_BYTES = 1 << 16

Output = Literal[
    "rgb",  # [H, W, 3] uint8: sRGB over black, or over what the scene has behind its objects
    "alpha",  # [H, W] float32, 0 to 1
    "radiance",  # [H, W, 3] float32, W m^-2 sr^-1, linear
    "depth",  # [H, W] float32, metres along the optical axis; 0 where there is no surface
    "normal",  # [H, W, 3] float32, world axes
    "visibility",  # [H, W] float32: share of the Sun that the surface sees
    "object_id",  # [H, W] uint8 or int32: 1 for the first object, 0 none
    "part_id",  # [H, W] uint8: 1 for the first part
    "shadow",  # [H, W] uint8: classes of docs/reference/dataset.md
]
OUTPUTS: tuple[Output, ...] = get_args(Output)
Row = tuple[float, float, float, float]
Identity = str | int | None
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class CameraFields:
    """The camera of a request, see above. Raises InputError where a pose or a lens is missing or given twice."""

    width: int  #: pixels
    height: int  #: pixels
    position: tuple[float, float, float] | None = None  #: metres, world
    rotation_wxyz: Row | None = None  #: from camera axes to the world's
    world_from_camera: tuple[Row, Row, Row, Row] | None = None  #: in place of both
    fov_deg: float | None = None  #: across the width
    fx: float | None = None  #: pixels, in place of fov_deg
    fy: float | None = None  #: pixels; None: fx
    cx: float | None = None  #: pixels; None: the middle
    cy: float | None = None  #: pixels; None: the middle

    def camera(self) -> Camera:
        """The record. Raises InputError for one that cannot be."""
        width, height = self.width, self.height
        if min(width, height) < 1:
            raise InputError(f"camera: expected a size of at least 1x1 pixels, found {width}x{height}")
        check_size(width, height, "camera")
        if (self.fov_deg is None) == (self.fx is None):
            raise InputError(f"camera: expected either fov_deg or fx, found {'both' if self.fx else 'neither'}")
        if self.fov_deg is not None:
            expect(0 < self.fov_deg < 180, "fov_deg", "an angle between 0 and 180 degrees", self.fov_deg)
            fx = 0.5 * width / float(np.tan(0.5 * np.radians(self.fov_deg)))
        else:
            fx = float(self.fx or 0)
        cx = 0.5 * width if self.cx is None else self.cx
        cy = 0.5 * height if self.cy is None else self.cy
        return Camera(self._pose(), width, height, fx, fx if self.fy is None else self.fy, cx, cy)

    def _pose(self) -> np.ndarray:
        halves = self.position is not None, self.rotation_wxyz is not None
        if self.world_from_camera is not None and not any(halves):
            pose = np.array(self.world_from_camera)
            last = pose[3].tolist()
            expect(last == [0, 0, 0, 1], "world_from_camera", "0, 0, 0, 1 as its last row", last)
            return pose
        if self.world_from_camera is not None or not all(halves):
            raise InputError("camera: expected position and rotation_wxyz, or world_from_camera alone")
        length = float(np.linalg.norm(self.rotation_wxyz))  # type: ignore[arg-type]
        if not abs(length - 1) < 1e-3:
            raise InputError(f"rotation_wxyz: expected a quaternion of length 1, found one of {length:.4g}")
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quaternion(np.array(self.rotation_wxyz))
        pose[:3, 3] = self.position
        return pose


@dataclass(frozen=True)
class PictureRequest:
    """What is to be drawn."""

    camera: CameraFields | None = None  #: None: nothing, say what is served
    #: azimuth and elevation, degrees, or a direction [3] towards it; None: not given
    sun: tuple[float, ...] | None = None
    exposure: float | None = None  #: EV
    outputs: tuple[Output, ...] = ("rgb",)  #: names of the planes that are asked for
    seed: int = 0  #: of the noise of path-traced pictures

    def __post_init__(self) -> None:
        expect(0 <= self.seed < 2**63, "seed", "0 to 2^63 - 1", self.seed)
        if not self.outputs:
            raise InputError(f"outputs: expected some of {', '.join(OUTPUTS)}, found none")
        if self.sun is not None and len(self.sun) not in (2, 3):
            raise InputError(f"sun: expected a direction [3] or two angles in degrees, found {len(self.sun)} numbers")

    @property
    def direction(self) -> Sun | None:
        """Of the Sun. Raises InputError for numbers that are none."""
        return Sun.of(self.sun)


def read_request(frame: bytes) -> tuple[Identity, PictureRequest | InputError]:
    """(id, the request or why it is none)."""
    if len(frame) > MAX_REQUEST_BYTES:
        return None, InputError(f"request: expected at most {MAX_REQUEST_BYTES:,} bytes, found {len(frame):,}")
    try:
        values = json.loads(frame)
    except (ValueError, RecursionError):
        return None, InputError("request: expected a JSON object, found something else")
    if not isinstance(values, dict):
        return None, InputError("request: expected a JSON object, found another value of JSON")
    number, version = values.pop("id", None), values.pop("version", None)
    if not (number is None or type(number) in (str, int)):
        return None, InputError("id: expected text or a whole number, found another value")
    try:
        if version != VERSION or type(version) is not int:
            return number, InputError(f"version: expected {VERSION}, found {version!s:.60}")
        return number, structure(PictureRequest, Document("", values, {}), Rules())
    except InputError as error:
        return number, error
    except RecursionError:  # brackets that can just be read, but not be shown in a message
        return number, InputError("request: expected a few brackets within each other, found hundreds")


def picture_answer(number: Identity, arrays: Arrays, seconds: float) -> list[bytes]:
    """Frames of a picture."""
    planes = {name: array.astype(array.dtype.newbyteorder("<"), copy=False) for name, array in arrays.items()}
    listed = [{"name": name, "dtype": plane.dtype.name, "shape": list(plane.shape)} for name, plane in planes.items()]
    header = {"version": VERSION, "id": number, "seconds": round(seconds, 6), "arrays": listed}
    return [json.dumps(header).encode(), *(plane.tobytes() for plane in planes.values())]


def facts_answer(number: Identity, facts: JsonDict) -> list[bytes]:
    """Frame of what is served."""
    return [json.dumps({"version": VERSION, "id": number, **facts}).encode()]


def error_answer(number: Identity, sentence: str) -> list[bytes]:
    """Frame of a request that cannot be met."""
    return [json.dumps({"version": VERSION, "id": number, "error": sentence}).encode()]


def arrays_of(frames: Sequence[bytes]) -> dict[str, np.ndarray]:
    """The arrays of an answer. Raises InputError with the server's sentence, or for what is no answer."""
    try:
        header = json.loads(frames[0])
        if "error" in header:
            raise InputError(str(header["error"]))
        described = zip(header.get("arrays", []), frames[1:], strict=True)
        return {
            item["name"]: np.frombuffer(frame, np.dtype(item["dtype"]).newbyteorder("<")).reshape(item["shape"])
            for item, frame in described
        }
    except (ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"answer: expected one of spacesim serve, found another ({error})") from None


def import_zmq() -> ModuleType:
    """pyzmq. Raises InputError where it is not installed."""
    try:
        import zmq
    except ImportError as error:
        raise InputError(f"serve needs pyzmq, which cannot be imported ({error}); type: {INSTALL}") from None
    return zmq
