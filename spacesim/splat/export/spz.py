"""Gaussians as SPZ, a sixth of a PLY's size: versions 3 (gzip) and 4 (zstandard).

Source: nianticlabs/spz of 10 July 2026, README.md (containers) and src/cc/load-spz.cc (how numbers are quantised).
"""

import gzip
import struct
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import write_bytes
from spacesim.splat.export.frame import unit_quaternions
from spacesim.splat.export.glb import opacity_of
from spacesim.splat.raster.gaussians import Gaussians

VERSIONS = (3, 4)
INSTALL = "pip install 'spacesim[spz]'"
COLOR_SCALE = 0.15  #: a constant coefficient of 1 / COLOR_SCALE takes a byte from one end to the other
MOST_BITS = 20  #: of a coordinate, after the point
LEVEL = 12  #: of zstandard, as its authors write files
_MAGIC = 0x5053474E  # "NGSP"
_LARGEST = (1 << 23) - 1  # of a signed number of 24 bits


def write_spz(gaussians: Gaussians, path: Path, antialiased: bool = False, version: int = 3) -> None:
    """Write coordinates of 24 bits, as fine as the model's size lets them be, log scales in steps of 1/16 from -10,
    opacities and constant terms of 8 bits, higher ones in steps of 1/128 from -1 to 1, the three smallest components
    of each quaternion with 10 bits. Axes are taken as they are: the format's are x right, y up, z backward.

    antialiased: whether the model is drawn with the anti-aliasing filter, which the file records
    Raises InputError for another version and for coordinates beyond 8,388 km, WorkError where version 4's library is
    missing.
    """
    if version not in VERSIONS:
        raise InputError(f"spz_version: expected {' or '.join(map(str, VERSIONS))}, found {version}")
    arrays = gaussians.to_numpy()
    bits = _fraction_bits(arrays["means"], path)
    streams = [
        _fixed24(arrays["means"], bits),
        _bytes(255 * opacity_of(arrays["logit_opacities"])),
        _bytes(255 * (COLOR_SCALE * arrays["sh"][:, 0] + 0.5)),
        _bytes(16 * (arrays["log_scales"] + 10)),
        _smallest_three(unit_quaternions(arrays["quaternions"])),
        _bytes(128 * arrays["sh"][:, 1:] + 128),
    ]
    head = struct.pack("<IIIBBB", _MAGIC, version, gaussians.count, gaussians.sh_degree, bits, antialiased)
    if version == 3:
        write_bytes(path, gzip.compress(head + b"\0" + b"".join(streams), mtime=0))
        return
    streams = [stream for stream in streams if stream]
    packed = [_zstandard(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(one), len(stream)) for one, stream in zip(packed, streams, strict=True))
    write_bytes(path, b"".join([head, struct.pack("<BI12x", len(streams), 32), table, *packed]))


def _fraction_bits(points: np.ndarray, path: Path) -> int:
    """As many as let every coordinate fit."""
    farthest = float(np.abs(points).max(initial=0.0))
    if farthest > _LARGEST:
        raise InputError(f"{path}: expected coordinates within {_LARGEST:,} units, found {farthest:,.0f}")
    bits = MOST_BITS
    while bits > 0 and round(farthest * (1 << bits)) > _LARGEST:
        bits -= 1
    return bits


def _fixed24(points: np.ndarray, bits: int) -> bytes:
    numbers = np.rint(points.astype(np.float64) * (1 << bits)).astype("<i4")
    return numbers.reshape(-1, 1).view(np.uint8)[:, :3].tobytes()


def _bytes(values: np.ndarray) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _smallest_three(quaternions: np.ndarray) -> bytes:
    """32 bits of each of quaternions [N, 4] (w, x, y, z): which of x, y, z, w is the largest, then of the others, in
    that order, a sign and 9 bits in units of sqrt(1/2) / 511, the largest being positive."""
    values = np.roll(quaternions, -1, axis=1)
    largest = np.abs(values).argmax(axis=1)
    values = values * np.where(np.take_along_axis(values, largest[:, None], axis=1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for place in range(4):
        size = np.minimum(np.rint(511 * np.sqrt(2) * np.abs(values[:, place])), 511).astype(np.uint32)
        word = (values[:, place] < 0).astype(np.uint32) << 9 | size
        packed = np.where(place == largest, packed, packed << 10 | word)
    return packed.astype("<u4").tobytes()


def _zstandard(content: bytes) -> bytes:
    try:
        import zstandard
    except ImportError:
        raise WorkError(f"spz: version 4 needs the library zstandard; type: {INSTALL}; or write version 3") from None
    return bytes(zstandard.ZstdCompressor(level=LEVEL).compress(content))
