"""Coarse to fine, as splatfacto has it: training begins with pictures whose pixels are the means of squares.

Pictures stay packed and whole where they are kept; squares are averaged where the loss reads them, so that no second
size of any picture takes memory. Rows and columns that fill no square are left out, as splatfacto leaves them.
"""

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, ArrayT, Bool, Float, UInt32
from spacesim.splat.raster.supersample import mean_light
from spacesim.splat.raster.tone import inverse_tone_map
from spacesim.splat.train.loss.terms import TruthPlanes


def straight_color(rgba: UInt32, tone: str | None) -> tuple[Array3f, Float]:
    """(straight colour Array3f [3, N], alpha [N]) of packed pixels; colour is light where there is a tone curve, else
    sRGB values."""
    red, green, blue, alpha = (ad.Float((rgba >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24))
    color = ad.Array3f(red, green, blue)
    return (inverse_tone_map(color, tone) if tone else color), alpha


def covered_color(
    rgba: UInt32, size: tuple[int, int], times: int, tone: str | None = None, light: bool = False
) -> tuple[Array3f, Float]:
    """(colour times alpha Array3f [3, N], alpha [N]) of the N squares of `times` x `times` pixels: the means over them.

    Splatfacto averages straight colour and alpha each for itself, by which the black of transparent pixels darkens
    edges; the mean of colour times alpha is what the picture shows over any background.

    rgba: UInt32 [height * width] of `size` (width, height);  tone: curve of colours that are blended as light, or None;
    light: of sRGB values, those of the mean light are wanted, as supersampled pictures have them
    """
    if times == 1:
        color, alpha = straight_color(rgba, tone)
        return color * alpha, alpha
    parts = [straight_color(dr.gather(ad.UInt32, rgba, place), tone) for place in _places(size, times)]
    alphas, colors = [alpha for _, alpha in parts], [color * alpha for color, alpha in parts]
    if light and not tone:
        covered = ad.Array3f([mean_light([color[c] for color in colors], alphas) for c in range(3)])
    else:
        covered = _sum(colors) / times**2
    return covered, _sum(alphas) / times**2


def valid_squares(valid: Bool, size: tuple[int, int], times: int) -> Bool:
    """Bool [N], or of width 1 as `valid` is: squares of which every pixel counts."""
    if times == 1 or dr.width(valid) == 1:
        return valid
    all_valid = ad.Bool(True)
    for place in _places(size, times):
        all_valid &= dr.gather(ad.Bool, valid, place)
    return all_valid


def truth_of_squares(truth: TruthPlanes, size: tuple[int, int], times: int) -> TruthPlanes:
    """What the planes of `TargetImage.truth` say of squares, in the form that the loss compares with what is blended:
    visibility that is seen in a square (below 0 where there is no surface), so times alpha; the mean radiance; the mean
    depth and the mean normal, of unit length, of what surface there is; foreground where half of a square is."""
    if times == 1:
        return truth
    places, result = _places(size, times), TruthPlanes()
    for name, planes in truth.items():
        if name == "foreground":
            shares = [dr.select(dr.gather(ad.Bool, planes[0], place), ad.Float(1), 0) for place in places]
            result[name] = [_sum(shares) >= 0.5 * times**2, *planes[1:]]
            continue
        values = [ad.ArrayXf([dr.gather(ad.Float, plane, place) for plane in planes]) for place in places]
        if name == "visibility":
            seen = _sum([dr.maximum(value[0], 0) for value in values]) / times**2
            nearest = values[0][0]
            for value in values[1:]:
                nearest = dr.maximum(nearest, value[0])
            result[name] = [dr.select(nearest >= 0, seen, -1)]
        elif name == "depth":
            counts = [dr.select(value[0] > 0, ad.Float(1), 0) for value in values]
            result[name] = [_sum([value[0] for value in values]) / dr.maximum(_sum(counts), 1)]
        elif name == "radiance":
            result[name] = list(sum(values[1:], values[0]) / times**2)
        else:
            total = ad.Array3f(sum(values[1:], values[0]))
            result[name] = list(total * dr.rcp(dr.maximum(dr.norm(total), 1e-6)))
    return result


def _sum(values: list[ArrayT]) -> ArrayT:
    return sum(values[1:], values[0])


def _places(size: tuple[int, int], times: int) -> list[UInt32]:
    """UInt32 [N] each: the pixels of a square, of a picture of `size` (width, height)."""
    width, height = size
    across, down = width // times, height // times
    square = dr.arange(ad.UInt32, across * down)
    x, y = times * (square % across), times * (square // across)
    return [(y + j) * width + x + i for j in range(times) for i in range(times)]
