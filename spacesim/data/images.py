"""Images in and out: PNG (sRGB, labels), EXR (linear truth), and what a frame shows to training and evaluating.

EXR layout: one multi-part file a frame, each part one layer, ZIP-compressed scan lines of float32. Layers of
three channels are R, G, B (radiance, albedo) or X, Y, Z (normal); single ones A (alpha), Z (depth) or Y (all
else), so that viewers show each part as a picture. Labels are stored as whole numbers in float32. Nothing in
the bytes depends on when or where they were written.
"""

import io
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image as PillowImage
from PIL import UnidentifiedImageError

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import open_regular, read_bytes, write_bytes
from spacesim.data.records import Camera, Dataset, Frame, Image, check_size

Float = NDArray[np.floating]
T = TypeVar("T")

_CHANNELS = {"alpha": "A", "depth": "Z", "normal": "XYZ"}  # other layers: Y, or RGB
_PNG_LEVEL = 3  # zlib's: 1.4 ms for a frame of 256 x 256, and a quarter more bytes than the 2.2 ms of its default, 6
DECODING = 64  #: bytes a pixel that `load_image` takes for a while: floats, their copies, and the file's own
_GREY_16 = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXR_MULTIPART = 0x1000


def srgb_from_linear(linear: ArrayLike) -> Float:
    """sRGB values of linear ones, clipped to [0, 1] first (IEC 61966-2-1). Any shape; float32 stays so."""
    x = np.clip(_as_float(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(x.dtype)


def linear_from_srgb(srgb: ArrayLike) -> Float:
    """Linear values of sRGB ones, clipped to [0, 1] first (IEC 61966-2-1). Any shape; float32 stays so."""
    x = np.clip(_as_float(srgb), 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(x.dtype)


def luminance(rgb: ArrayLike) -> Float:
    """[...] luminance of the values `rgb` [..., 3] as they are, by the weights of Rec. 709."""
    rgb = _as_float(rgb)
    return rgb @ np.array([0.2126, 0.7152, 0.0722], rgb.dtype)


def read_png(path: Path, content: bytes | None = None) -> np.ndarray:
    """Pixels of an image file (its `content`): [H, W], [H, W, 3] or [H, W, 4] uint8, or [H, W] uint16 of 16-bit grey.

    Takes what Pillow reads (JPEG, TIFF, ... too). Palettes and grey with alpha become RGB or RGBA. Raises
    InputError where the file is missing, broken, no image, or one of floating-point numbers, which have no range.
    """
    content = read_bytes(path) if content is None else content
    try:
        with PillowImage.open(io.BytesIO(content)) as picture:
            _check_size(path, picture)
            _check_png(content)
            if picture.mode == "F":
                raise InputError(f"{path}: expected whole numbers of 8 or 16 bits a channel, found floating-point ones")
            if picture.mode in _GREY_16:
                return np.clip(np.asarray(picture), 0, 65535).astype(np.uint16)
            is_grey = picture.mode in ("1", "L")
            return np.array(picture.convert("RGBA" if _is_transparent(picture) else "L" if is_grey else "RGB"))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Pillow's decoders raise what they like on damaged data
        raise InputError(_describe_failure(path, error)) from None


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header alone. Raises InputError as `read_png` does."""
    return _read_header(path, lambda picture: picture.size)


def has_alpha(path: Path) -> bool:
    """Whether an image file has transparency, from its header alone. Raises InputError as `read_png` does."""
    return _read_header(path, _is_transparent)


def _read_header(path: Path, tell: Callable[[PillowImage.Image], T]) -> T:
    try:
        with open_regular(path) as file, PillowImage.open(file) as picture:
            return tell(picture)
    except InputError:
        raise
    except Exception as error:
        raise InputError(_describe_failure(path, error)) from None


def _is_transparent(picture: PillowImage.Image) -> bool:
    return "A" in picture.getbands() or "transparency" in picture.info


def _check_size(path: Path, picture: PillowImage.Image) -> None:
    """Raises InputError for more pixels than any camera has, MemoryError where they do not fit into memory."""
    width, height = picture.size
    check_size(width, height, str(path))
    check_memory(DECODING * width * height, f"{path}: a picture of {width} x {height} pixels")


def _check_png(content: bytes) -> None:
    """Raises ValueError where a chunk of a PNG file is not what its checksum says (ISO/IEC 15948, 5.3): Pillow passes
    over that of the pixels. Files of other formats pass."""
    if not content.startswith(_PNG_SIGNATURE):
        return
    view, position = memoryview(content), len(_PNG_SIGNATURE)
    while position < len(content):
        size, kind = struct.unpack_from(">I4s", content, position)
        end = position + 8 + size
        if struct.unpack_from(">I", content, end)[0] != zlib.crc32(view[position + 4 : end]):
            raise ValueError(f"the checksum of its chunk {kind.decode('ascii', 'replace')} is another")
        position = end + 4
        if kind == b"IEND":
            return
    raise ValueError("it has no end")


def write_png(path: Path, pixels: np.ndarray, durable: bool = True) -> None:
    """Write [H, W], [H, W, 3] or [H, W, 4] uint8, or [H, W] uint16, as PNG: whole or not at all (see `write_bytes`)."""
    write_bytes(path, png_bytes(pixels), durable)


def png_bytes(pixels: np.ndarray) -> bytes:
    """What `write_png` writes."""
    is_grey = pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16)
    is_color = pixels.ndim == 3 and pixels.shape[2] in (3, 4) and pixels.dtype == np.uint8
    if pixels.size == 0 or not (is_grey or is_color):
        raise ValueError(
            "pixels: expected [H, W], [H, W, 3] or [H, W, 4] uint8 or [H, W] uint16, "
            f"found {list(pixels.shape)} {pixels.dtype}"
        )
    stream = io.BytesIO()
    PillowImage.fromarray(np.ascontiguousarray(pixels)).save(stream, format="PNG", compress_level=_PNG_LEVEL)
    return stream.getvalue()


def write_exr(path: Path, layers: Mapping[str, np.ndarray], durable: bool = True) -> None:
    """Write layers {name: [H, W] or [H, W, 3]} as parts of one EXR file (see above): whole or not at all (see
    `write_bytes`)."""
    parts = []
    for name, layer in layers.items():
        pixels = np.asarray(layer, np.float32)
        names = _CHANNELS.get(name, "RGB" if pixels.ndim == 3 else "Y")
        if pixels.size == 0 or pixels.ndim < 2 or pixels.shape[2:] != ((3,) if len(names) == 3 else ()):
            raise ValueError(f"layers: expected [H, W] or [H, W, 3] for {name!r}, found {list(pixels.shape)}")
        planes = pixels.reshape(*pixels.shape[:2], len(names))
        channels = {channel: np.ascontiguousarray(planes[..., k]) for k, channel in enumerate(names)}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        parts.append(OpenEXR.Part(header, channels, name))
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    write_bytes(path, stream.getvalue(), durable)


def read_exr(path: Path, size: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
    """Layers {name: [H, W] or [H, W, 3] float32} of an EXR file; a lone unnamed part is "".

    size: (width, height) that it must have, pixels. Raises InputError where the file is missing, cut off, damaged, no
    EXR or of another size, before it is decoded.
    """
    content = read_bytes(path, "an EXR file")
    expected = _count_exr_parts(content)  # OpenEXR itself only warns, and leaves out what it cannot read
    if expected is None:
        raise InputError(f"{path}: expected an EXR file, found one that is cut off or damaged")
    width, height = _exr_size(content)
    if size is not None and (width, height) != size:
        expected_size = f"{size[0]}x{size[1]} pixels as the camera says"
        raise InputError(f"{path}: expected {expected_size}, found {width}x{height}")
    check_size(width, height, str(path))
    check_memory(DECODING * expected * width * height, f"{path}: a file of {width} x {height} pixels")
    try:
        parts = OpenEXR.File(io.BytesIO(content), separate_channels=True).parts
        layers = {part.name(): _layer_of(part) for part in parts}
    except Exception as error:  # OpenEXR documents none of what it raises
        raise InputError(f"{path}: expected an EXR file, found a damaged one ({error})") from None
    if len(layers) != expected:
        raise InputError(f"{path}: expected {expected} readable parts in the EXR file, found {len(layers)}")
    return layers


def load_image(dataset: Dataset, frame: Frame) -> Image:
    """The image of `frame` as trained on and compared with, undistorted where the frame says so: rgb [H, W, 3] sRGB
    values in [0, 1], alpha [H, W], valid [H, W].

    Straight alpha comes from the file, else from the silhouette, else it is 1. Pixels to be ignored are opaque
    black whatever the file holds, so that it cannot reach their neighbours through a window. Raises InputError
    where a file is missing, broken or of another size than the camera.
    """
    pixels = _read_sized(dataset.root / frame.file_path, frame.camera)
    values = np.atleast_3d(pixels).astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    alpha = np.ones(values.shape[:2], np.float32)
    if values.shape[2] == 4:
        alpha = np.ascontiguousarray(values[..., 3])
    elif frame.silhouette_path is not None:
        alpha = (read_labels(dataset.root / frame.silhouette_path, frame.camera) > 0).astype(np.float32)
    valid = np.ones(alpha.shape, bool)
    if frame.mask_path is not None:
        valid = read_labels(dataset.root / frame.mask_path, frame.camera) > 0
    rgb = np.ascontiguousarray(np.broadcast_to(values[..., :3], (*alpha.shape, 3)))
    image = Image(*_without_ignored(rgb, alpha, valid), valid)
    return undistort(image, frame.camera, frame.distortion) if any(frame.distortion) else image


def undistort(image: Image, camera: Camera, distortion: tuple[float, ...]) -> Image:
    """`image` as the pinhole `camera` sees it, resampled bilinearly. What comes from outside is not valid.

    distortion: see `distort_points`. Colours are weighted by alpha, so that none bleeds in from where alpha is 0.
    Pixels that are not valid are opaque black.
    """
    return resample(image, Undistortion(camera, distortion))


def resample(image: Image, source: "Resampling") -> Image:
    """`image` in the pixels of `source`, as `undistort`."""
    alpha = source.linear(image.alpha)
    weighted = source.linear(image.rgb * image.alpha[..., None])
    rgb = np.clip(weighted / np.where(alpha > 0, alpha, 1)[..., None], 0, 1)
    valid = source.inside & (source.linear(image.valid.astype(np.float32)) > 0.999)  # no ignored pixel takes part
    return Image(*_without_ignored(rgb, alpha, valid), valid)


def _without_ignored(rgb: np.ndarray, alpha: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rgb, alpha), opaque black where not `valid`."""
    return np.where(valid[..., None], rgb, np.float32(0)), np.where(valid, alpha, np.float32(1))


class Resampling:
    """Pictures resampled to another camera's pixels. inside: [H, W] bool of the new one, where the old one has any.

    columns, rows: [H, W] where each new pixel lies in the old picture, 0 at the centre of its first pixel
    """

    def __init__(self, columns: np.ndarray, rows: np.ndarray, inside: np.ndarray) -> None:
        self._columns, self._rows, self.inside = columns, rows, inside

    def linear(self, picture: np.ndarray) -> np.ndarray:
        """`picture` [H, W] or [H, W, C] resampled bilinearly, float32; 0 outside."""
        from scipy.ndimage import map_coordinates  # a quarter of a second, that most who read pictures need not wait

        if picture.ndim == 3:
            return np.stack([self.linear(picture[..., k]) for k in range(picture.shape[2])], axis=-1)
        places = [self._rows, self._columns]
        sampled = map_coordinates(picture, places, output=np.float32, order=1, mode="nearest")
        return np.where(self.inside, sampled, np.float32(0))

    def nearest(self, labels: np.ndarray) -> np.ndarray:
        """The nearest pixels' values of `labels` [H, W] or [H, W, C], none averaged, of the same type; 0 outside."""
        height, width = labels.shape[:2]
        rows = np.rint(np.where(self.inside, self._rows, 0)).astype(np.intp).clip(0, height - 1)
        columns = np.rint(np.where(self.inside, self._columns, 0)).astype(np.intp).clip(0, width - 1)
        inside = self.inside if labels.ndim == 2 else self.inside[..., None]
        return np.where(inside, labels[rows, columns], np.zeros((), labels.dtype))


class Undistortion(Resampling):
    """Pictures of a lens, resampled to what the pinhole `camera` sees. inside: where the lens sees it.

    distortion: see `distort_points`.
    """

    def __init__(self, camera: Camera, distortion: tuple[float, ...]) -> None:
        x = (np.arange(camera.width) + 0.5 - camera.cx)[None, :] / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy)[:, None] / camera.fy
        u, v = distort_points(x, y, distortion)
        columns, rows = u * camera.fx + camera.cx - 0.5, v * camera.fy + camera.cy - 0.5
        inside = (columns >= -0.5) & (columns <= camera.width - 0.5)
        inside &= (rows >= -0.5) & (rows <= camera.height - 0.5)
        k1, k2, _, _, k3 = distortion
        r2 = x * x + y * y
        inside &= 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0  # past this the model folds back on itself
        super().__init__(columns, rows, inside)


def distort_points(x: Any, y: Any, distortion: Sequence[Any]) -> tuple[Any, Any]:
    """Where the lens images the direction (x, y, 1), on the plane at depth 1: any arrays, of numpy or of Dr.Jit.

    distortion: k1, k2, p1, p2, k3 of the Brown-Conrady model (D. C. Brown, "Close-range camera calibration",
    1971, in OpenCV's order).
    """
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def undistort_points(u: Any, v: Any, distortion: Sequence[Any], steps: int = 8) -> tuple[Any, Any]:
    """The direction (x, y, 1) that the lens images at (u, v): the inverse of `distort_points`, by Newton's method.

    From (u, v) it goes straight to the solution, also near a fold: along a radius the map is concave for barrel
    distortion, convex for pincushion.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = u, v
    for _ in range(steps):
        r2 = x * x + y * y
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # of the radial factor, over r^2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        a = radial + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x  # the derivative, [[a, b], [b, d]]
        b = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
        d = radial + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
        at_x, at_y = distort_points(x, y, distortion)
        e, f, determinant = u - at_x, v - at_y, a * d - b * b
        x, y = x + (d * e - b * f) / determinant, y + (a * f - b * e) / determinant
    return x, y


def _read_sized(path: Path, camera: Camera) -> np.ndarray:
    pixels = read_png(path)
    expected, found = f"{camera.width}x{camera.height}", f"{pixels.shape[1]}x{pixels.shape[0]}"
    if found != expected:
        raise InputError(f"{path}: expected {expected} pixels as the camera says, found {found}")
    return pixels


def read_labels(path: Path, camera: Camera) -> np.ndarray:
    """[H, W] of a mask or silhouette, its brightest channel. Raises InputError for another size than the camera's."""
    pixels = _read_sized(path, camera)
    return pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=-1)


def _as_float(values: ArrayLike) -> Float:
    array = np.asarray(values)
    return array if np.issubdtype(array.dtype, np.floating) else array.astype(np.float64)


def _describe_failure(path: Path, error: BaseException) -> str:
    if isinstance(error, UnidentifiedImageError):  # EXR among them
        return f"{path}: expected PNG, JPEG or another image that Pillow reads, found a damaged or another file"
    return f"{path}: expected a readable image, found a file that is broken or cut off ({error})"


def _layer_of(part: OpenEXR.Part) -> np.ndarray:
    planes = {name: channel.pixels for name, channel in part.channels.items()}
    for names in ("RGB", "XYZ"):
        if set(planes) == set(names):
            return np.stack([planes[name] for name in names], axis=-1)
    if len(planes) != 1:
        raise ValueError(f"part {part.name()!r} has channels {', '.join(sorted(planes)) or 'none'}")
    return next(iter(planes.values()))


def _count_exr_parts(content: bytes) -> int | None:
    """Number of parts of an EXR file, None where a chunk of a multi-part one is not wholly within `content`.

    After the OpenEXR file layout: magic, version, headers of (name, type, size, value), a table of chunk
    offsets a part, then chunks that begin with part number, line number and their own size.
    """
    try:
        if content[:4] != _EXR_MAGIC:
            return None
        if not struct.unpack_from("<I", content, 4)[0] & _EXR_MULTIPART:
            return 1
        position, chunks = 8, []
        while content[position]:
            count, position = walk_exr_header(content, position)
            chunks.append(count)
        for offset in np.frombuffer(content, "<u8", sum(chunks), position + 1).tolist():
            size = struct.unpack_from("<i", content, offset + 8)[0]
            if size < 0 or offset + 12 + size > len(content):
                return None
        return len(chunks)
    except (struct.error, IndexError, ValueError, KeyError, OverflowError):
        return None


def _exr_size(content: bytes) -> tuple[int, int]:
    """(width, height), pixels, of the largest part of an EXR file; (0, 0) where no header tells."""
    largest, position = (0, 0), 8
    try:
        while content[position]:
            attributes, position = _exr_attributes(content, position)
            left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
            largest = max(largest, (right - left + 1, bottom - top + 1), key=lambda size: max(size[0] * size[1], 0))
            if not struct.unpack_from("<I", content, 4)[0] & _EXR_MULTIPART:
                break
    except (struct.error, IndexError, ValueError, KeyError, OverflowError):
        pass
    return largest


def walk_exr_header(content: bytes, position: int) -> tuple[int, int]:
    """(number of chunks that the header at `position` tells, position after it)."""
    attributes, position = _exr_attributes(content, position)
    return struct.unpack("<i", attributes[b"chunkCount"])[0], position


def _exr_attributes(content: bytes, position: int) -> tuple[dict[bytes, bytes], int]:
    """(values of the header at `position` by name, position after it)."""
    attributes = {}
    while content[position]:
        name, kind, _ = content[position : position + 1024].split(b"\0", 2)
        position += len(name) + len(kind) + 2
        size = struct.unpack_from("<I", content, position)[0]
        attributes[name] = content[position + 4 : position + 4 + size]
        position += 4 + size
    return attributes, position + 1
