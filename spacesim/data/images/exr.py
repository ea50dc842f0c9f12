"""EXR in and out: linear truth.

One multi-part file a frame, each part one layer, ZIP-compressed scan lines of float32. Layers of three channels are
R, G, B (radiance, albedo) or X, Y, Z (normal); single ones A (alpha), Z (depth) or Y (all else), so that viewers show
each part as a picture. Labels are stored as whole numbers in float32. Nothing in the bytes depends on when or where
they were written.
"""

import io
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import read_bytes, write_bytes
from spacesim.data.images.png import DECODING
from spacesim.data.records import check_size

_CHANNELS = {"alpha": "A", "depth": "Z", "normal": "XYZ"}  # other layers: Y, or RGB
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXR_MULTIPART = 0x1000


def write_exr(path: Path, layers: Mapping[str, np.ndarray], durable: bool = True) -> None:
    """Write `exr_bytes` of layers: whole or not at all (see `write_bytes`)."""
    write_bytes(path, exr_bytes(layers), durable)


def exr_bytes(layers: Mapping[str, np.ndarray]) -> bytes:
    """Layers {name: [H, W] or [H, W, 3]} as parts of one EXR file (see above). Raises ValueError for other arrays."""
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
    return stream.getvalue()


def read_exr(path: Path, size: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
    """Layers {name: [H, W] or [H, W, 3] float32} of an EXR file; a lone unnamed part is "".

    size: (width, height) that it must have, pixels. Raises InputError where the file is missing, cut off, damaged, no
    EXR or of another size, before it is decoded.
    """
    content = read_bytes(path, "an EXR file")
    expected = _count_exr_parts(content)  # OpenEXR itself only warns, and leaves out what it cannot read
    if expected is None:
        raise InputError(f"{path}: expected an EXR file, found one that is cut off or damaged")
    width, height = exr_size(content)
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


def exr_size(content: bytes) -> tuple[int, int]:
    """(width, height), pixels, of the largest part of an EXR file, by its first bytes; (0, 0) where no header says."""
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
    """(number of chunks in the header at `position`, position after it)."""
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
