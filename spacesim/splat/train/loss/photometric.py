"""L1 and structural dissimilarity of pictures (thesis 2.8; SSIM of Wang et al. 2004) with their derivative by hand.

The Gaussian window is separable and symmetric: the adjoint of a blur is the same blur. Three kernels follow that which
writes the pictures: moments blurred along rows; those blurred along columns, SSIM, its derivatives by the moments, and
these blurred along columns; those blurred along rows, and the gradient. What a thread needs of a pixel stands side by
side, so that it reads and writes packets.
"""

from collections.abc import Sequence
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32

RADIUS = 5  #: 11 x 11 window
SIGMA = 1.5  #: pixels
COLUMNS = 8  #: pixels of a row that a thread computes
ROWS = 16  #: pixels of a column that a thread computes
_PACKET = 4  #: pixels of a pair of pictures that are read at once
_C1, _C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
_WEIGHTS = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
WINDOW: list[float] = (_WEIGHTS / _WEIGHTS.sum()).tolist()


def photometric_loss(prediction: Array3f, target: Array3f, width: int, height: int, ssim_weight: float = 0.2) -> Float:
    """(1 - w) mean |p - t| + w (1 - SSIM(p, t)), thesis 2.8 with D-SSIM = 1 - SSIM as gsplat takes it.

    prediction, target: Array3f [3, height * width];  returns a Float of width 1, differentiable in `prediction`.
    SSIM: Gaussian window of 11 x 11 pixels, sigma 1.5, data range 1; beyond the border the pictures are 0.
    """
    if ssim_weight == 0:
        return dr.sum(dr.sum(dr.abs(prediction - target))) / (3 * width * height)
    return dr.custom(_Photometric, prediction, target, width, height, ssim_weight)


class _Photometric(dr.CustomOp):
    def eval(self, prediction: Array3f, target: Array3f, width: int, height: int, ssim_weight: float) -> Float:
        self.strips = strips = _Strips(width, height)
        self.l1, self.ssim = ((share / (3 * width * height)) for share in (1 - ssim_weight, ssim_weight))
        self.pairs = [strips.write_pair(x, y) for x, y in zip(prediction, target, strict=True)]
        dr.eval(self.pairs)
        moments, distances = _moments(strips, self.pairs)
        dr.eval(moments, distances)
        self.partials, dissimilarities = _partials(strips, moments)
        loss = self.l1 * _folded(distances, dr.width(dissimilarities)) + self.ssim * dissimilarities
        dr.eval(self.partials, loss)
        return dr.sum(loss)

    def backward(self) -> None:
        strips, scale = self.strips, cast(Float, self.grad_out())
        l1, ssim = scale * self.l1, scale * self.ssim
        y = dr.arange(ad.UInt32, strips.across * strips.height)
        y, strip = y % strips.height, y // strips.height
        gradients = []
        for pair, plane in zip(self.pairs, self.partials, strict=True):
            by_mean, by_square, by_product = (_blur(values) for values in strips.read_partials(plane, strip, y))
            values = []
            for j, (x, t) in enumerate(zip(*strips.read_pair(pair, strip, y, 0), strict=True)):
                by_ssim = by_mean[j] + 2 * x * by_square[j] + t * by_product[j]
                values.append(l1 * dr.sign(x - t) - ssim * by_ssim)
            gradients.append(_write([values], y * strips.across + strip))
        dr.eval(gradients)
        self.set_grad_in("prediction", ad.Array3f([strips.tight(plane) for plane in gradients]))

    def name(self) -> str:
        return "photometric"


def _moments(strips: "_Strips", pairs: list[Float]) -> tuple[list[Float], Float]:
    """Of each pair of pictures x, y, x^2 + y^2 and x y, blurred along rows; and |x - y|, added up by each thread."""
    thread = dr.arange(ad.UInt32, strips.across * strips.height)
    y, strip = thread // strips.across, thread % strips.across
    moments, distances = [], ad.Float(0)
    for pair in pairs:
        xs, ys = strips.read_pair(pair, strip, y, RADIUS)
        for j in range(RADIUS, RADIUS + COLUMNS):
            distances += dr.abs(xs[j] - ys[j])
        squares = [dr.fma(x, x, y * y) for x, y in zip(xs, ys, strict=True)]
        products = [x * y for x, y in zip(xs, ys, strict=True)]
        blurred = [_blur(values) for values in (xs, ys, squares, products)]
        moments.append(_write(_transposed(blurred), thread))
    return moments, distances


def _partials(strips: "_Strips", moments: list[Float]) -> tuple[list[Float], Float]:
    """Of each of `_moments`, the derivatives of SSIM, blurred along columns; and 1 - SSIM, added up by each thread."""
    thread = dr.arange(ad.UInt32, strips.width * strips.down)
    column, first = thread % strips.width, (thread // strips.width) * ROWS
    inside = [inside for _, inside in _neighbours(first, range(-RADIUS, ROWS + RADIUS), strips.height)]
    partials, similarities = [], ad.Float(0)
    for plane in moments:
        blurred = [_blur(values) for values in strips.read_moments(plane, column, first)]
        pixels = [_similarity(*means, active) for *means, active in zip(*blurred, inside, strict=True)]
        for value, *_ in pixels[RADIUS:-RADIUS]:
            similarities += value
        derivatives = [_blur(values) for values in _transposed(pixels)[1:]]
        packets = [[*pixel, ad.Float(0)] for pixel in _transposed(derivatives)]
        partials.append(_write(packets, column * strips.down + first // ROWS))
    pixels_inside = len(moments) * dr.minimum(strips.height - first, ROWS)
    return partials, ad.Float(pixels_inside) - similarities


def _similarity(
    mx: Float, my: Float, squares: Float, product: Float, inside: Bool
) -> tuple[Float, Float, Float, Float]:
    """SSIM of a pixel from the means of x, y, x^2 + y^2 and x y under its window, and its derivatives by those of x,
    x^2 and x y (the first with the window's other means held); all 0 where not `inside`."""
    mxy, mm = mx * my, dr.fma(mx, mx, my * my)
    a1, a2 = 2 * mxy + _C1, 2 * (product - mxy) + _C2
    r1, r2 = dr.rcp(mm + _C1), dr.rcp(squares - mm + _C2)
    inverse = dr.select(inside, r1 * r2, 0)
    value = a1 * a2 * inverse
    grad_mean = 2 * my * (a2 - a1) * inverse + 2 * mx * value * (r2 - r1)
    return value, grad_mean, -value * r2, 2 * a1 * inverse


def _blur(values: Sequence[Float]) -> list[Float]:
    """Of neighbours, the blurred ones but RADIUS at each end."""
    result = []
    for j in range(len(values) - 2 * RADIUS):
        total = values[j] * WINDOW[0]
        for k in range(1, len(WINDOW)):
            total = dr.fma(values[j + k], WINDOW[k], total)
        result.append(total)
    return result


class _Strips:
    """Where pixels stand in memory. Threads hold COLUMNS pixels of a row or ROWS of a column.

    A pair of pictures: two numbers a pixel, row by row. Moments: four, in the same order. Partials: three and a 0,
    column by column. Rows and columns are as long as their strips: beyond the picture, pairs and partials are 0.

    across, down: strips of a row, of a column;  stride: pixels of a row
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.across, self.down = -(-width // COLUMNS), -(-height // ROWS)
        self.stride = self.across * COLUMNS

    def write_pair(self, x: Float, y: Float) -> Float:
        """Planes [height * width] as a pair."""
        pixel = dr.arange(ad.UInt32, self.width * self.height)
        if self.stride == self.width:
            return _write([[x, y]], pixel)
        pair = dr.zeros(ad.Float, 2 * self.stride * self.height)
        dr.scatter(pair, ad.Array2f(x, y), (pixel // self.width) * self.stride + pixel % self.width)
        return pair

    def read_pair(self, pair: Float, strip: UInt32, row: UInt32, halo: int) -> tuple[list[Float], list[Float]]:
        """Both pictures' pixels of a strip and `halo` of its row to either side, 0 beyond the row's ends."""
        beside, inner, packets = -(-halo // _PACKET), COLUMNS // _PACKET, self.stride // _PACKET
        values: list[Float] = []
        for place, inside in _neighbours(strip * inner, range(-beside, inner + beside), packets):
            values += _read(pair, 2 * _PACKET, row * packets + place, inside)
        spare = 2 * (beside * _PACKET - halo)
        values = values[spare : len(values) - spare]
        return values[::2], values[1::2]

    def read_moments(self, plane: Float, column: UInt32, first: UInt32) -> list[list[Float]]:
        """Of a column's ROWS pixels from `first` and 2 RADIUS to either side, 0 beyond the column's ends."""
        places = _neighbours(first, range(-2 * RADIUS, ROWS + 2 * RADIUS), self.height)
        return _transposed([_read(plane, 4, place * self.stride + column, inside) for place, inside in places])

    def read_partials(self, plane: Float, strip: UInt32, row: UInt32) -> list[list[Float]]:
        """Of a strip's pixels and RADIUS of its row to either side, 0 beyond the row's ends."""
        places = _neighbours(strip * COLUMNS, range(-RADIUS, COLUMNS + RADIUS), self.width)
        depth = self.down * ROWS
        return _transposed([_read(plane, 4, place * depth + row, inside) for place, inside in places])[:3]

    def tight(self, plane: Float) -> Float:
        """A plane [height * stride] without what is beyond the picture."""
        if self.stride == self.width:
            return plane
        pixel = dr.arange(ad.UInt32, self.width * self.height)
        return dr.gather(ad.Float, plane, (pixel // self.width) * self.stride + pixel % self.width)


def _neighbours(first: UInt32, offsets: range, extent: int) -> list[tuple[UInt32, Bool]]:
    """Places along an axis, and whether they are from 0 to `extent`: a place below 0 wraps around, far beyond it."""
    places = [first + ad.UInt32(offset % 2**32) for offset in offsets]
    return [(place, place < extent) for place in places]


def _transposed(pixels: list[list[Float]]) -> list[list[Float]]:
    return [list(values) for values in zip(*pixels, strict=True)]


def _read(plane: Float, size: int, index: UInt32, active: Bool) -> list[Float]:
    """Packet `index` of `size` numbers, zeros where not `active`."""
    return list(dr.gather(ad.ArrayXf, plane, index, active, shape=(size, dr.width(index))))


def _write(packets: list[list[Float]], index: UInt32) -> Float:
    """A new array of each thread's packets, one after another, at its index."""
    values = [value for packet in packets for value in packet]
    plane = dr.empty(ad.Float, len(values) * dr.width(index))
    dr.scatter(plane, ad.ArrayXf(values), index)
    return plane


def _folded(values: Float, count: int) -> Float:
    """Numbers added up to so many."""
    thread, total = dr.arange(ad.UInt32, count), ad.Float(0)
    for start in range(0, dr.width(values), count):
        place = start + thread
        total += dr.gather(ad.Float, values, place, place < dr.width(values))
    return total
