"""Whether a picture on disk is whole, by a few of its bytes: for 100,000 frames, decoding would take an hour.

Found are files that are missing, empty, cut off or longer than they say, which is what killed processes, full disks and
power cuts leave behind. A byte that has changed within is found by `spacesim.data.store.find_unreadable_files`, which
decodes.
"""

import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import open_regular
from spacesim.data.images import check_size_of, exr_size, read_exr, read_png, size_and_alpha, walk_exr_header
from spacesim.data.records import Camera, Dataset, Frame

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_EXR_START = b"\x76\x2f\x31\x01"
_EXR_MULTIPART = 0x1000
_TAIL = 1 << 12  # bytes at the end of a picture, where cameras may write their own behind the end of JPEG
_HEADERS = 1 << 16  # bytes that hold the headers and the chunk table of most EXR files


def is_whole(path: Path) -> bool:
    """A PNG file from its signature to its IEND chunk, or a multi-part EXR file to the end of its last chunk."""
    try:
        with open_regular(Path(path)) as file:
            size = os.fstat(file.fileno()).st_size
            return _png_is_whole(file, size) if Path(path).suffix == ".png" else _exr_is_whole(file, size)
    except (OSError, InputError):
        return False


def check_pictures(dataset: Dataset, frames: Iterable[Frame]) -> None:
    """Raise InputError for the first file that `load_image` would read of frames and that is missing, not whole or of
    another size than the camera: PNG and JPEG by their ends, others by their headers. What ends otherwise is decoded.
    """
    for frame in frames:
        is_transparent = _check_picture(dataset.root / frame.file_path, frame.camera)
        for path in (None if is_transparent else frame.silhouette_path, frame.mask_path):
            if path is not None:
                _check_picture(dataset.root / path, frame.camera)


def _check_picture(path: Path, camera: Camera) -> bool:
    """Whether it is transparent."""
    size, is_transparent = size_and_alpha(path)
    check_size_of(path, size, camera)
    with open_regular(path) as file:
        start = file.read(len(_PNG_START))
        file.seek(-min(_TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
        end = file.read()
    has_end = end.endswith(_PNG_END) if start == _PNG_START else _JPEG_END in end
    if not has_end and start.startswith((_PNG_START, _JPEG_START)):
        read_png(path)
    return is_transparent


def check_truth(dataset: Dataset, frames: Iterable[Frame]) -> None:
    """As `check_pictures`, of the EXR files of frames that name one."""
    for frame in frames:
        if frame.gt_path is not None:
            path, size = dataset.root / frame.gt_path, (frame.camera.width, frame.camera.height)
            if not is_whole(path) or exr_size(_head(path)) != size:
                read_exr(path, size)


def _head(path: Path) -> bytes:
    with open_regular(path) as file:
        return file.read(_HEADERS)


def _png_is_whole(file: BinaryIO, size: int) -> bool:
    if size < len(_PNG_START) + len(_PNG_END) or file.read(len(_PNG_START)) != _PNG_START:
        return False
    file.seek(-len(_PNG_END), os.SEEK_END)
    return file.read() == _PNG_END


def _exr_is_whole(file: BinaryIO, size: int) -> bool:
    """Chunks lie one behind the other: the last one ends where the file does (OpenEXR file layout)."""
    content = file.read(_HEADERS)
    if content[:4] != _EXR_START:
        return False
    while True:
        try:
            offsets = _chunk_offsets(content)
            break
        except (struct.error, IndexError, ValueError, KeyError, OverflowError):
            chunk = file.read(len(content))
            if not chunk:
                return False
            content += chunk
    if len(offsets) == 0 or offsets.min() == 0 or offsets.max() > size - 12:
        return False
    last = int(offsets.max())
    file.seek(last)
    return last + 12 + struct.unpack("<8xi", file.read(12))[0] == size


def _chunk_offsets(content: bytes) -> np.ndarray:
    """Where in a multi-part file its chunks begin: part number, line number and size, 4 bytes each, then data."""
    if not struct.unpack_from("<I", content, 4)[0] & _EXR_MULTIPART:
        return np.empty(0, "<u8")
    position, chunks = 8, 0
    while content[position]:
        count, position = walk_exr_header(content, position)
        chunks += count
    return np.frombuffer(content, "<u8", chunks, position + 1)
