"""PNG in and out, and what else Pillow reads."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image as PillowImage
from PIL import UnidentifiedImageError

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import open_regular, read_bytes, write_bytes
from spacesim.data.records import check_size

T = TypeVar("T")
_PNG_LEVEL = 3  # zlib's: 1.4 ms for a frame of 256 x 256, and a quarter more bytes than the 2.2 ms of its default, 6
DECODING = 64  #: bytes a pixel that `load_image` takes for a while: floats, their copies, and the file's own
_GREY_16 = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_png(path: Path, content: bytes | None = None) -> np.ndarray:
    """Pixels of an image file (its `content`): [H, W], [H, W, 3] or [H, W, 4] uint8, or [H, W] uint16 of 16-bit grey.

    Takes what Pillow reads (JPEG, TIFF, ... too). Palettes and grey with alpha become RGB or RGBA. Raises
    InputError where the file is missing, broken, no image, or one of floating-point numbers, which have no range.
    """
    content = read_bytes(path) if content is None else content
    try:
        with PillowImage.open(io.BytesIO(content)) as picture:
            _check_size(path, picture)
            _check_png(path, content)
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


def size_and_alpha(path: Path) -> tuple[tuple[int, int], bool]:
    """(`image_size`, `has_alpha`), of a file that is opened once."""
    return _read_header(path, lambda picture: (picture.size, _is_transparent(picture)))


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


def _check_png(path: Path, content: bytes) -> None:
    """Raises InputError where a chunk of a PNG file is not what its checksum says (ISO/IEC 15948, 5.3): Pillow passes
    over that of the pixels; struct.error or ValueError where it is cut off. Files of other formats pass."""
    if not content.startswith(_PNG_SIGNATURE):
        return
    view, position = memoryview(content), len(_PNG_SIGNATURE)
    while position < len(content):
        size, kind = struct.unpack_from(">I4s", content, position)
        end = position + 8 + size
        if struct.unpack_from(">I", content, end)[0] != zlib.crc32(view[position + 4 : end]):
            name = kind.decode("ascii", "replace")
            raise InputError(f"{_unreadable(path)} (the checksum of its chunk {name} is another)")
        position = end + 4
        if kind == b"IEND":
            return
    raise ValueError("it has no end")


def write_png(path: Path, pixels: np.ndarray, durable: bool = True) -> None:
    """Write `png_bytes` of pixels: whole or not at all (see `write_bytes`)."""
    write_bytes(path, png_bytes(pixels), durable)


def png_bytes(pixels: np.ndarray) -> bytes:
    """[H, W], [H, W, 3] or [H, W, 4] uint8, or [H, W] uint16, as a PNG file. Raises ValueError for other arrays."""
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


def _describe_failure(path: Path, error: BaseException) -> str:
    if isinstance(error, UnidentifiedImageError):  # EXR among them
        return f"{path}: expected PNG, JPEG or another image that Pillow reads, found a damaged or another file"
    return _unreadable(path)


def _unreadable(path: Path) -> str:
    return f"{path}: expected a readable image, found a file that is broken or cut off"
