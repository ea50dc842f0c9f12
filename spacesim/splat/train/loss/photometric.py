"""L1 and structural dissimilarity of pictures (thesis 2.8; SSIM of Wang et al. 2004) with their derivative by hand.

The Gaussian window is separable and symmetric: the adjoint of a blur is the same blur. On a CPU all of it is
`photometric_llvm`'s; else, and within recordings, three kernels follow that which writes the pictures: moments blurred
along rows; those blurred along columns, SSIM, its derivatives by the moments, and these blurred along columns; those
blurred along rows, and the gradient.
"""

from collections.abc import Sequence
from functools import partial
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.backend.blocks import new_block
from spacesim.backend.kernels.llvm import is_usable
from spacesim.splat.train.loss.photometric_llvm import loss_and_gradient
from spacesim.splat.train.loss.window import RADIUS, blurred, similarity

COLUMNS = 4  #: pixels of a row that a thread computes
ROWS = 16  #: pixels of a column that a thread computes


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
        self.gradient: Array3f | None = None
        if is_usable():
            sums, self.gradient = loss_and_gradient(prediction, target, width, height, ssim_weight)
            return dr.sum(sums)
        self.strips = strips = _Strips(width, height)
        self.l1, self.ssim = ((share / (3 * width * height)) for share in (1 - ssim_weight, ssim_weight))
        dr.eval(prediction, target)
        self.pairs = [(strips.padded(x), strips.padded(y)) for x, y in zip(prediction, target, strict=True)]
        dr.eval(self.pairs)
        moments, distances = _moments(strips, self.pairs)
        dr.eval(moments, distances)
        self.partials, dissimilarities = _partials(strips, moments)
        loss = self.l1 * _folded(distances, dr.width(dissimilarities)) + self.ssim * dissimilarities
        dr.eval(self.partials, loss)
        return dr.sum(loss)

    def backward(self) -> None:
        scale = cast(Float, self.grad_out())
        if self.gradient is not None:
            self.set_grad_in("prediction", scale * self.gradient)
            return
        strips = self.strips
        l1, ssim = scale * self.l1, scale * self.ssim
        thread = dr.arange(ad.UInt32, strips.height * strips.across)
        row, strip = thread // strips.across, thread % strips.across
        gradients = []
        for channel, pair in enumerate(self.pairs):
            partials = [strips.read_row(plane, channel * strips.height + row, strip, RADIUS) for plane in self.partials]
            by_mean, by_square, by_product = (_blur(values) for values in partials)
            xs, ys = (strips.read_row(plane, row, strip, 0) for plane in pair)
            values = []
            for j, (x, y) in enumerate(zip(xs, ys, strict=True)):
                by_ssim = by_mean[j] + 2 * x * by_square[j] + y * by_product[j]
                values.append(l1 * dr.sign(x - y) - ssim * by_ssim)
            gradient = dr.empty(ad.Float, strips.height * strips.stride)
            dr.scatter(gradient, ad.ArrayXf(values), thread)
            gradients.append(gradient)
        dr.eval(gradients)
        self.set_grad_in("prediction", ad.Array3f([strips.tight(plane) for plane in gradients]))

    def name(self) -> str:
        return "photometric"


def _moments(strips: "_Strips", pairs: list[tuple[Float, Float]]) -> tuple[list[Float], Float]:
    """Of each pair of planes x, y, x^2 + y^2 and x y, blurred along rows; and |x - y|, added up by each thread."""
    count = strips.height * strips.across
    thread = dr.arange(ad.UInt32, count)
    row, strip = thread // strips.across, thread % strips.across
    moments = [dr.empty(ad.Float, 3 * strips.height * strips.stride) for _ in range(4)]
    distances = ad.Float(0)
    for channel, pair in enumerate(pairs):
        xs, ys = (strips.read_row(plane, row, strip, RADIUS) for plane in pair)
        for j in range(RADIUS, RADIUS + COLUMNS):
            distances += dr.abs(xs[j] - ys[j])
        squares = [dr.fma(x, x, y * y) for x, y in zip(xs, ys, strict=True)]
        products = [x * y for x, y in zip(xs, ys, strict=True)]
        for array, values in zip(moments, (xs, ys, squares, products), strict=True):
            dr.scatter(array, ad.ArrayXf(_blur(values)), channel * count + thread, mode=dr.ReduceMode.NoConflicts)
    return moments, distances


def _partials(strips: "_Strips", moments: list[Float]) -> tuple[list[Float], Float]:
    """Of `_moments`, the three derivatives of SSIM, blurred along columns; and 1 - SSIM, added up by each thread."""
    thread = dr.arange(ad.UInt32, 3 * strips.down * strips.stride)
    column, strip = thread % strips.stride, thread // strips.stride
    channel, first = strip // strips.down, (strip % strips.down) * ROWS
    means = [_blur(values) for values in strips.read_moments(moments, channel, first, column)]
    rows = _neighbours(first, range(-RADIUS, ROWS + RADIUS), strips.height)
    inside = [active & (column < strips.width) for _, active in rows]
    pixels = [
        similarity(of_pixel, partial(_only, active), dr.fma, dr.rcp)
        for of_pixel, active in zip(_transposed(means), inside, strict=True)
    ]
    dissimilarity = ad.Float(0)
    for (value, *_), active in list(zip(pixels, inside, strict=True))[RADIUS:-RADIUS]:
        dissimilarity += dr.select(active, 1 - value, 0)
    partials = []
    for values in _transposed(pixels)[1:]:
        plane = dr.empty(ad.Float, 3 * strips.height * strips.stride)
        for value, (row, active) in zip(_blur(values), rows[RADIUS:-RADIUS], strict=True):
            place = (channel * strips.height + row) * strips.stride + column
            dr.scatter(plane, value, place, active, dr.ReduceMode.NoConflicts)
        partials.append(plane)
    return partials, dissimilarity


def _only(active: Bool, value: Float) -> Float:
    """0 where not `active`."""
    return dr.select(active, value, 0)


def _blur(values: Sequence[Float]) -> list[Float]:
    """Of neighbours, the blurred ones but RADIUS at each end."""
    result = []
    for j in range(RADIUS, len(values) - RADIUS):
        new_block()
        result.append(blurred(values[j - RADIUS : j + RADIUS + 1], dr.fma))
    return result


class _Strips:
    """Where pixels stand in memory. Threads hold `COLUMNS` of a row or `ROWS` of a column.

    Pictures are planes of one channel, moments and partials of three. Rows are as long as their strips; beyond the
    picture, pictures and partials are 0.

    across, down: strips of a row, of a column;  stride: pixels of a row
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.across, self.down = -(-width // COLUMNS), -(-height // ROWS)
        self.stride = self.across * COLUMNS

    def padded(self, plane: Float) -> Float:
        """A plane [height * width] as one [height * stride], 0 beyond the picture."""
        if self.stride == self.width:
            return plane
        pixel = dr.arange(ad.UInt32, self.height * self.stride)
        row, column = pixel // self.stride, pixel % self.stride
        return dr.gather(ad.Float, plane, row * self.width + column, column < self.width)

    def tight(self, plane: Float) -> Float:
        """A plane [height * stride] as one [height * width]."""
        if self.stride == self.width:
            return plane
        pixel = dr.arange(ad.UInt32, self.height * self.width)
        return dr.gather(ad.Float, plane, (pixel // self.width) * self.stride + pixel % self.width)

    def read_row(self, plane: Float, row: UInt32, strip: UInt32, halo: int) -> list[Float]:
        """A strip's pixels and `halo` to either side, 0 beyond the row's ends."""
        beside, values = -(-halo // COLUMNS), list[Float]()
        for place, inside in _neighbours(strip, range(-beside, beside + 1), self.across):
            values += _read(plane, row * self.across + place, inside)
        spare = beside * COLUMNS - halo
        return values[spare : len(values) - spare]

    def read_moments(self, moments: list[Float], channel: UInt32, first: UInt32, column: UInt32) -> list[list[Float]]:
        """The four of a column's ROWS pixels from `first`, of 2 RADIUS to either side; 0 beyond the column's ends."""
        places = _neighbours(first, range(-2 * RADIUS, ROWS + 2 * RADIUS), self.height)
        start = channel * (self.height * self.stride) + column
        pixels = [(start + place * self.stride, inside) for place, inside in places]
        return [[dr.gather(ad.Float, plane, *pixel) for pixel in pixels] for plane in moments]


def _neighbours(first: UInt32, offsets: range, extent: int) -> list[tuple[UInt32, Bool]]:
    """Places along an axis, and whether they are from 0 to `extent`: a place below 0 wraps around, far beyond it."""
    places = [first + ad.UInt32(offset % 2**32) for offset in offsets]
    return [(place, place < extent) for place in places]


def _read(array: Float, index: UInt32, active: Bool) -> list[Float]:
    """Packet `index` of `COLUMNS` numbers, zeros where not `active`."""
    return list(dr.gather(ad.Array4f, array, index, active))


def _transposed(lists: Sequence[Sequence[Float]]) -> list[list[Float]]:
    return [list(values) for values in zip(*lists, strict=True)]


def _folded(values: Float, count: int) -> Float:
    """Numbers added up to so many."""
    thread, total = dr.arange(ad.UInt32, count), ad.Float(0)
    for start in range(0, dr.width(values), count):
        place = start + thread
        total += dr.gather(ad.Float, values, place, place < dr.width(values))
    return total
