"""Planes of numbers to pictures for people: a colour map for each mode, the truth beside the prediction, a scale."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from spacesim.data.images.color import srgb_from_linear
from spacesim.data.images.sheet import font
from spacesim.eval.pictures import depth_colors, error_colors
from spacesim.learning.pictures import LIT, SHADOWED
from spacesim.viewer.state import MATERIALS

Bytes = NDArray[np.uint8]

PALETTE = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167))
"""sRGB colours of objects, from the first again for the eighth: Okabe and Ito's, for the colour-blind, too."""

ERROR_SCALE = 0.25  #: mean absolute error of the channels at the bright end, as in reports
SURFACE = 0.5  #: alpha from which a pixel shows a surface, of depth's range and of ids
UNKNOWN = (38, 38, 42)  #: sRGB colour of where the truth is not known
_LINE = (255, 255, 255)
_SHADES = 1024  # of the colour map of depths


@dataclass(frozen=True, eq=False)
class Planes:
    """What a frame knows, float32; None for what was not asked for or cannot be had."""

    alpha: np.ndarray  #: [H, W]
    rgb: np.ndarray | None = None  #: [H, W, 3] sRGB values over black
    depth: np.ndarray | None = None  #: [H, W] metres, 0 where there is none
    visibility: np.ndarray | None = None  #: [H, W] of the Sun
    normal: np.ndarray | None = None  #: [H, W, 3] world axes, 0 where there is none
    albedo: np.ndarray | None = None  #: [H, W, 3] linear reflectance, 0 where there is no surface
    specular: np.ndarray | None = None  #: [H, W, 3] linear reflectance of facets, 0 where none are seen
    roughness: np.ndarray | None = None  #: [H, W] alpha of GGX
    metallic: np.ndarray | None = None  #: [H, W] share of metals
    object_id: np.ndarray | None = None  #: [H, W] uint8, from 1, 0 none


NEEDED = {
    "colour": "rgb",
    "depth": "depth",
    "accumulation": "alpha",
    "visibility": "visibility",
    "normals": "normal",
    **{name: name for name in MATERIALS},
    "object id": "object_id",
    "ellipsoids": "rgb",
}
"""The plane that each mode shows."""


def depth_range(planes: Planes) -> tuple[float, float] | None:
    """(nearest, farthest) depth of surfaces, metres; None where there is none."""
    if planes.depth is None:
        return None
    seen = planes.depth[(planes.alpha >= SURFACE) & (planes.depth > 0)]
    return (float(seen.min()), float(seen.max())) if seen.size else None


def paint(planes: Planes, mode: str, depths: tuple[float, float] | None = None) -> Bytes | None:
    """[H, W, 3] of the planes in a mode; None where the plane that it shows is not there. depths: of the colour map's
    ends, metres. What is no number is 0. Done for every frame of a view that moves: single precision, few copies."""
    values = getattr(planes, NEEDED[mode])
    if values is None:
        return None
    with np.errstate(invalid="ignore", over="ignore"):
        if NEEDED[mode] == "rgb":
            return _bytes(_clip_to_unit(values))
        if mode == "object id":
            return _colors_by_id(values)
        alpha = _clip_to_unit(planes.alpha)
        if mode in ("albedo", "specular"):
            return _bytes(_clip_to_unit(srgb_from_linear(_clip_to_unit(values)) * alpha[..., None]))
        if mode in ("roughness", "metallic"):
            return np.repeat(_bytes(_clip_to_unit(values) * alpha)[..., None], 3, axis=-1)
        if mode == "accumulation":
            return np.repeat(_bytes(alpha)[..., None], 3, axis=-1)
        if mode == "depth":
            near, far = depths or depth_range(planes) or (0.0, 1.0)
            share = _clip_to_unit((values - np.float32(near)) * np.float32(1 / max(far - near, 1e-9)))
            share *= np.float32(_SHADES - 1)
            alpha *= values > 0
            picture = _depth_color_map().take(np.rint(share, out=share).astype(np.intp), axis=0)
            picture *= alpha[..., None]
            return picture.astype(np.uint8)
        picture = np.empty((*alpha.shape, 3), np.float32)
        if mode == "visibility":
            seen = _clip_to_unit(values) * alpha
            for c, (lit, shadowed) in enumerate(zip(LIT, SHADOWED, strict=True)):
                picture[..., c] = alpha * np.float32(shadowed / 255) + seen * np.float32((lit - shadowed) / 255)
        else:
            alpha *= (values[..., 0] != 0) | (values[..., 1] != 0) | (values[..., 2] != 0)
            alpha *= np.float32(0.5)
            for c in range(3):
                picture[..., c] = (1 + values[..., c]) * alpha
        return _bytes(_clip_to_unit(picture))


def _colors_by_id(numbers: np.ndarray) -> Bytes:
    """The colours of objects [H, W]."""
    every = np.arange(int(numbers.max(initial=0)) + 1)
    colors = np.array([(0, 0, 0), *PALETTE], np.uint8)[np.where(every > 0, 1 + (every - 1) % len(PALETTE), 0)]
    return colors.take(numbers, axis=0, mode="clip")


@cache
def _depth_color_map() -> np.ndarray:
    """[_SHADES, 3] float32: the colour map of depths from the nearest to the farthest."""
    return depth_colors(np.linspace(0, 1, _SHADES)).astype(np.float32)


def _clip_to_unit(values: np.ndarray) -> np.ndarray:
    """Clipped to [0, 1], 0 where they are no numbers: a new float32 array."""
    result = np.fmax(values, np.float32(0), dtype=np.float32)
    return np.minimum(result, np.float32(1), out=result)


def _bytes(values: np.ndarray) -> Bytes:
    """8-bit numbers of float32 values in [0, 1], which are lost."""
    values *= np.float32(255)
    return np.rint(values, out=values).astype(np.uint8)


def compare_pictures(picture: Bytes, truth: Bytes, has_truth: NDArray[np.bool_], how: str, wipe: float) -> Bytes:
    """The prediction with the truth, [H, W, 3] both, by one of COMPARISONS.

    has_truth: [H, W], where there is truth;  wipe: left of that share of the width is the truth;  beside: both, each
    half as large, the truth on the left;  difference: mean absolute difference of the channels as a colour, black none
    """
    height, width = picture.shape[:2]
    truth = np.where(has_truth[..., None], truth, np.array(UNKNOWN, np.uint8))
    if how == "wipe":
        edge = round(wipe * width)
        result = np.concatenate([truth[:, :edge], picture[:, edge:]], axis=1)
        if 0 < edge < width:
            result[:, edge : edge + 1] = _LINE
        return result
    if how == "beside":
        half = max(1, width // 2), max(1, height // 2)
        small = [np.asarray(Image.fromarray(image).resize(half, Image.Resampling.BOX)) for image in (truth, picture)]
        result = np.zeros_like(picture)
        top = (height - small[0].shape[0]) // 2
        for left, image in zip((0, width - small[1].shape[1]), small, strict=True):
            result[top : top + image.shape[0], left : left + image.shape[1]] = image
        result[top : top + small[0].shape[0], width // 2] = _LINE
        return result
    if how == "difference":
        error = np.abs(picture.astype(np.float32) - truth).mean(axis=-1) / 255
        return np.where(has_truth[..., None], error_colors(error / ERROR_SCALE), np.array(UNKNOWN, np.uint8))
    return picture


def add_color_bar(picture: Bytes, depths: tuple[float, float]) -> Bytes:
    """A picture of depths with the colour map and its ends in metres at the bottom; unchanged where too small."""
    height, width = picture.shape[:2]
    if width < 160 or height < 80:
        return picture
    page = Image.fromarray(picture)
    draw, size = ImageDraw.Draw(page), 14
    left, right, bottom = 12, 12 + min(240, width - 24), height - 10
    bar = depth_colors(np.linspace(0, 1, right - left))
    page.paste(Image.fromarray(np.repeat(bar[None], 10, axis=0)), (left, bottom - 10))
    near, far = (f"{value:.4g} m" for value in depths)
    draw.text((left, bottom - 14), near, (255, 255, 255), font(size), anchor="ls")
    draw.text((right, bottom - 14), far, (255, 255, 255), font(size), anchor="rs")
    return np.array(page)


def color_bar_html(depths: tuple[float, float] | None) -> str:
    """The colour map of depths and its ends for the panel."""
    if depths is None:
        return ""
    stops = depth_colors(np.linspace(0, 1, 9))
    colors = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in stops.tolist())
    near, far = (f"{value:.4g} m" for value in depths)
    return (
        f'<div style="margin: 0 0.8em 0.4em; font-size: 0.85em"><div style="height: 0.8em; background: '
        f'linear-gradient(to right, {colors})"></div><span>{near}</span><span style="float: right">{far}</span></div>'
    )
