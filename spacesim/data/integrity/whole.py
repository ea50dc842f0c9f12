"""Whether a picture on disk is whole, by a few of its bytes: for 100,000 frames, decoding would take an hour.

Found are files that are missing, empty, cut off or longer than they say, which is what killed processes, full disks and
power cuts leave behind. A byte that has changed within is found by `spacesim.data.store.find_unreadable_files`, which
decodes.
"""

import os
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import open_regular
from spacesim.data.images import walk_exr_header

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
_EXR_START = b"\x76\x2f\x31\x01"
_EXR_MULTIPART = 0x1000
_HEADERS = 1 << 16  # bytes that hold the headers and the chunk table of most EXR files


def is_whole(path: Path) -> bool:
    """A PNG file from its signature to its IEND chunk, or a multi-part EXR file to the end of its last chunk."""
    try:
        with open_regular(Path(path)) as file:
            size = os.fstat(file.fileno()).st_size
            return _png_is_whole(file, size) if Path(path).suffix == ".png" else _exr_is_whole(file, size)
    except (OSError, InputError):
        return False


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
