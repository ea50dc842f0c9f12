"""Pictures of an evaluated frame for people to look at: the error in colours, shadow masks with mistakes."""

from functools import cache

import numpy as np

from spacesim.data.images import srgb_from_linear
from spacesim.data.images.tone import as_bytes
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT
from spacesim.eval.metrics.image import Mask
from spacesim.eval.metrics.shadow import KINDS
from spacesim.learning.pictures import LIT, SHADOWED

ERROR_SCALE = 0.25
"""Mean absolute error of the channels at the bright end of the colour map; more is drawn as that."""

FARTHEST_SHADE = 0.15  #: of the colour map at the farthest depth: the background alone is black

WRONGLY_SHADOWED, WRONGLY_LIT = (213, 94, 0), (86, 180, 233)
"""sRGB colours of shadow masks; the mistakes' are Okabe and Ito's, which colour-blind readers can distinguish."""

ATTACHED, SELF_CAST, OTHER_CAST = (124, 130, 142), SHADOWED, (122, 78, 132)
"""sRGB colours of the kinds of true shadow."""

ATTACHED_LIT = (176, 202, 216)
"""sRGB colour of a surface that faces away from the Sun and is predicted to see it: paler than mistakes, as
masks are only evaluated where a surface faces the Sun."""


def error_picture(prediction: np.ndarray, truth: np.ndarray, valid: Mask) -> np.ndarray:
    """[H, W, 3] uint8 colours of the mean absolute error, 0 to `ERROR_SCALE`; black where not valid."""
    error = np.abs(prediction - truth).mean(axis=-1) * valid
    return error_colors(error / ERROR_SCALE)


def error_colors(values: np.ndarray) -> np.ndarray:
    """[..., 3] uint8 colours of values in [0, 1]: black, violet, red, yellow, white in even steps."""
    table = _color_table()
    return table[np.rint(np.clip(values, 0, 1) * (len(table) - 1)).astype(np.intp)]


def shadow_picture(predicted: Mask, shadowed: Mask, mask: Mask) -> np.ndarray:
    """[H, W, 3] uint8: the pixels of `mask` as predicted, mistakes in their colours; the rest black."""
    picture = np.zeros((*mask.shape, 3), np.uint8)
    picture[mask & ~predicted & ~shadowed] = LIT
    picture[mask & predicted & shadowed] = SHADOWED
    picture[mask & predicted & ~shadowed] = WRONGLY_SHADOWED
    picture[mask & ~predicted & shadowed] = WRONGLY_LIT
    return picture


def mask_picture(predicted: Mask, classes: np.ndarray, mask: Mask) -> np.ndarray:
    """[H, W, 3] uint8: the pixels of `mask` as predicted, mistakes in their colours by the true shadow class [H, W];
    what faces away from the Sun in colours of its own. predicted: [H, W], in shadow"""
    picture = shadow_picture(predicted, classes != SHADOW_LIT, mask)
    attached = mask & (classes == SHADOW_ATTACHED)
    picture[attached & predicted] = ATTACHED
    picture[attached & ~predicted] = ATTACHED_LIT
    return picture


def kinds_picture(classes: np.ndarray, mask: Mask) -> np.ndarray:
    """[H, W, 3] uint8: what each pixel of `mask` truly is, by its shadow class [H, W]; the rest black."""
    picture = np.zeros((*mask.shape, 3), np.uint8)
    picture[mask] = LIT
    for (first, last), color in zip(KINDS.values(), (ATTACHED, SELF_CAST, OTHER_CAST), strict=True):
        picture[mask & (classes >= first) & (classes <= last)] = color
    return picture


def visibility_picture(visibility: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8: predicted visibility [H, W] in [0, 1], from the colour of shadow to that of light in even steps,
    over black by `alpha` [H, W]."""
    seen = np.clip(visibility, 0, 1)[..., None]
    colors = (np.array(SHADOWED) * (1 - seen) + np.array(LIT) * seen) / 255
    return as_bytes(colors * np.clip(alpha, 0, 1)[..., None])


def depth_colors(shares: np.ndarray) -> np.ndarray:
    """[..., 3] uint8 colours of depths from the nearest, 0, to the farthest, 1: near is bright."""
    return error_colors(1 - (1 - FARTHEST_SHADE) * np.clip(shares, 0, 1))


def depth_picture(depth: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """[H, W, 3] uint8 colours of depths [H, W] by the nearest and the farthest of the map, metres; black where there is
    none."""
    near, far = span
    return depth_colors((depth - near) / max(far - near, 1e-9)) * (depth > 0)[..., None].astype(np.uint8)


@cache
def _color_table() -> np.ndarray:
    """[256, 3] uint8: a path of rising lightness through Oklab in even steps."""
    lightness = [0, 0.2, 0.4, 0.6, 0.78, 0.92, 1]
    chroma = [0, 0.1, 0.17, 0.19, 0.15, 0.12, 0]
    hue = np.radians([290, 290, 320, 375, 420, 458, 465])
    knots = np.linspace(0, 1, len(lightness))
    fine = np.linspace(0, 1, 2001)
    C, h = np.interp(fine, knots, chroma), np.interp(fine, knots, hue)
    path = np.stack([np.interp(fine, knots, lightness), C * np.cos(h), C * np.sin(h)], axis=-1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))])
    even = np.interp(np.linspace(0, length[-1], 256), length, fine)
    return as_bytes(_srgb_from_oklab(np.stack([np.interp(even, fine, channel) for channel in path.T], axis=-1)))


def _srgb_from_oklab(lab: np.ndarray) -> np.ndarray:
    """sRGB values [..., 3] of Oklab ones (B. Ottosson, 2020)."""
    cone_roots = (
        lab
        @ np.array(
            [
                [1, 0.3963377774, 0.2158037573],
                [1, -0.1055613458, -0.0638541728],
                [1, -0.0894841775, -1.2914855480],
            ]
        ).T
    )
    linear = (
        cone_roots**3
        @ np.array(
            [
                [4.0767416621, -3.3077115913, 0.2309699292],
                [-1.2684380046, 2.6097574011, -0.3413193965],
                [-0.0041960863, -0.7034186147, 1.7076147010],
            ]
        ).T
    )
    return srgb_from_linear(linear)
