"""Pictures as an H.264 video in an MP4 file, which browsers and office programs play.

The same pictures give the same bytes with the same version of the library: one thread encodes, without x264's
macroblock tree, whose vector code gives other bits from call to call; the conversion to luma and chroma is our own, and
nothing is written of when or where.
"""

import importlib
import io
from fractions import Fraction
from types import ModuleType
from typing import Any

import numpy as np

INSTALL = "pip install 'spacesim[video]'"
FASTEST_RATE = 10_000  #: pictures a second
FINEST_RATE = 100_000  #: largest denominator of pictures a second: 24000/1001 is meant by 23.976023976
QUALITY = "18"  #: x264's constant rate factor: artefacts are hard to see
_BT709, _SRGB_TRANSFER = 1, 13  # numbers of ITU-T H.273


def encoder() -> ModuleType | None:
    """PyAV, which brings x264; None where it is not installed or cannot be loaded."""
    try:
        return importlib.import_module("av")
    except (ImportError, OSError):
        return None


class Video:
    """A film in the making: `add` pictures, then take the file's `content`.

    width, height: pixels of every picture; an odd side gets one more row or column, as H.264 wants even ones
    bit_rate: bits a second; None: as many as QUALITY takes
    rate: pictures a second; in the file it is the nearest fraction with a denominator of FINEST_RATE at most
    Raises RuntimeError where there is no `encoder`, ValueError for a rate that is none.
    """

    def __init__(self, width: int, height: int, rate: float | Fraction, bit_rate: int | None = None) -> None:
        library = encoder()
        if library is None:
            raise RuntimeError(f"video: PyAV is not installed; type: {INSTALL}")
        if not 1 / FINEST_RATE <= rate <= FASTEST_RATE:
            raise ValueError(f"rate: expected {1 / FINEST_RATE:g} to {FASTEST_RATE} pictures a second, found {rate}")
        exact = Fraction(rate).limit_denominator(FINEST_RATE)
        self._library = library
        self._shape = height, width, 3
        self._buffer = io.BytesIO()
        self._file = library.open(self._buffer, "w", format="mp4", options={"fflags": "+bitexact"})
        options = {"preset": "medium", "threads": "1", "flags": "+bitexact", "x264-params": "mbtree=0"}
        if bit_rate is None:
            options["crf"] = QUALITY
        self._stream: Any = self._file.add_stream("libx264", rate=exact, options=options)
        self._stream.width, self._stream.height = width + width % 2, height + height % 2
        self._stream.pix_fmt = "yuv420p"
        if bit_rate is not None:
            self._stream.bit_rate = bit_rate
        self._stream.gop_size = max(1, round(exact))  # a picture that stands alone each second
        context = self._stream.codec_context
        context.color_primaries = context.colorspace = _BT709
        context.color_trc, context.color_range = _SRGB_TRANSFER, 1
        self._count = 0

    def add(self, picture: np.ndarray) -> None:
        """Append [H, W, 3] uint8, sRGB. Raises ValueError for another shape or type."""
        if picture.shape != self._shape or picture.dtype != np.uint8:
            raise ValueError(
                f"picture: expected {list(self._shape)} uint8, found {list(picture.shape)} {picture.dtype}"
            )
        frame = self._library.VideoFrame.from_ndarray(yuv420_from_rgb(picture), format="yuv420p")
        frame.pts = self._count
        self._count += 1
        self._file.mux(self._stream.encode(frame))

    def content(self) -> bytes:
        """The bytes of the MP4 file; nothing can be added after that."""
        self._file.mux(self._stream.encode(None))
        self._file.close()
        return self._buffer.getvalue()


def yuv420_from_rgb(picture: np.ndarray) -> np.ndarray:
    """[3/2 H, W] uint8: luma, then both chroma planes of half the size, of [H, W, 3] uint8; odd sides are made even by
    repeating the last row or column. ITU-R BT.709, limited range; chroma is the mean of its four pixels."""
    even = np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), mode="edge")
    red, green, blue = np.moveaxis(even.astype(np.float64) / 255, -1, 0)
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    planes = [16 + 219 * luma]
    for color, span in ((blue, 1.8556), (red, 1.5748)):
        chroma = 128 + 224 * (color - luma) / span
        planes.append(0.25 * (chroma[::2, ::2] + chroma[1::2, ::2] + chroma[::2, 1::2] + chroma[1::2, 1::2]))
    packed = np.concatenate([plane.ravel() for plane in planes]).reshape(-1, even.shape[1])
    return np.rint(packed).astype(np.uint8)
