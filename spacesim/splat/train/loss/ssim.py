"""Structural similarity (Wang et al. 2004; thesis 2.19) with its derivative by hand, in four kernels.

The Gaussian window is separable and symmetric: the adjoint of a blur is the same blur. A thread blurs a strip of ROWS
pixels along one axis, reading each neighbour once, and writes it as one packet across that axis, so that the next
kernel reads neighbours of the other axis just as it read these.
"""

from collections.abc import Sequence
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float

RADIUS = 5  #: 11 x 11 window
SIGMA = 1.5  #: pixels
ROWS = 8  #: pixels of a strip
_C1, _C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
_WEIGHTS = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
WINDOW: list[float] = (_WEIGHTS / _WEIGHTS.sum()).tolist()


def ssim(prediction: Array3f, target: Array3f, width: int, height: int) -> Float:
    """Mean structural similarity of two pictures (thesis 2.19), Float of width 1; differentiable in `prediction`.

    prediction, target: Array3f [3, height * width]. Gaussian window of 11 x 11 pixels, sigma 1.5, data range 1; beyond
    the border the pictures are 0.
    """
    return dr.custom(_Ssim, prediction, target, width, height)


class _Ssim(dr.CustomOp):
    def eval(self, prediction: Array3f, target: Array3f, width: int, height: int) -> Float:
        self.pair = list(prediction), list(target)
        self.down = down = _Strips(width, height, width)
        self.across = across = _Strips(height, width, down.stride)
        dr.eval(self.pair)
        planes = []
        for x, y in zip(*self.pair, strict=True):
            xs, ys = down.read(x), down.read(y)
            squares = [dr.fma(x, x, y * y) for x, y in zip(xs, ys, strict=True)]
            products = [x * y for x, y in zip(xs, ys, strict=True)]
            planes += [down.write(_blur(values)) for values in (xs, ys, squares, products)]
        dr.eval(planes)
        total = ad.Float(0)
        self.partials: list[Float] = []
        for c in range(3):
            moments = [_blur(across.read(plane)) for plane in planes[4 * c : 4 * c + 4]]
            columns = [_similarity(*pixel) for pixel in zip(*moments, strict=True)]
            for j, (value, *_) in enumerate(columns):
                total += dr.select(across.first + j < width, value, 0)
            self.partials += [across.write([pixel[i] for pixel in columns]) for i in (1, 2, 3)]
        dr.eval(total, self.partials)
        self.scale = 1 / (3 * width * height)
        return dr.sum(total) * self.scale

    def backward(self) -> None:
        down = _Strips(self.across.extent, self.down.extent, self.across.stride)
        planes = [down.write(_blur(down.read(partial))) for partial in self.partials]
        dr.eval(planes)
        gradient = cast(Float, self.grad_out())
        scale, across = gradient * self.scale, self.across
        gradients = []
        for c, (x, y) in enumerate(zip(*self.pair, strict=True)):
            grad_mean, grad_square, grad_product = (_blur(across.read(plane)) for plane in planes[3 * c : 3 * c + 3])
            row = []
            for j in range(ROWS):
                pixel = across.cross * across.extent + across.first + j
                inside = across.first + j < across.extent
                px, py = dr.gather(ad.Float, x, pixel, inside), dr.gather(ad.Float, y, pixel, inside)
                row.append(scale * (grad_mean[j] + 2 * px * grad_square[j] + py * grad_product[j]))
            gradients.append(across.write(row))
        dr.eval(gradients)
        self.set_grad_in("prediction", ad.Array3f([across.tight(plane) for plane in gradients]))

    def name(self) -> str:
        return "ssim"


def _similarity(mx: Float, my: Float, squares: Float, product: Float) -> tuple[Float, Float, Float, Float]:
    """SSIM of a pixel from the means of x, y, x^2 + y^2 and x y under its window, and its derivatives by those of x,
    x^2 and x y (the first with the window's other means held)."""
    mxy, mm = mx * my, dr.fma(mx, mx, my * my)
    a1, a2 = 2 * mxy + _C1, 2 * (product - mxy) + _C2
    r1, r2 = dr.rcp(mm + _C1), dr.rcp(squares - mm + _C2)
    inverse = r1 * r2
    value = a1 * a2 * inverse
    grad_mean = 2 * my * (a2 - a1) * inverse + 2 * mx * value * (r2 - r1)
    return value, grad_mean, -value * r2, 2 * a1 * inverse


def _blur(values: Sequence[Float]) -> list[Float]:
    """Of ROWS + 2 RADIUS neighbours, the blurred ROWS in the middle."""
    result = []
    for j in range(ROWS):
        total = values[j] * WINDOW[0]
        for k in range(1, len(WINDOW)):
            total = dr.fma(values[j + k], WINDOW[k], total)
        result.append(total)
    return result


class _Strips:
    """Threads that hold ROWS pixels along an axis of `extent`; `crossing` is the size of the other. Pixels next to each
    other along the axis stand `step` apart in memory, those across it 1."""

    def __init__(self, crossing: int, extent: int, step: int) -> None:
        count = -(-extent // ROWS)
        self.crossing, self.extent, self.step, self.stride = crossing, extent, step, count * ROWS
        strip = dr.arange(ad.UInt32, crossing * count)
        self.cross, self.first = strip % crossing, (strip // crossing) * ROWS
        self._packet = self.cross * count + strip // crossing

    def read(self, plane: Float) -> list[Float]:
        """ROWS + 2 RADIUS values along the axis, 0 beyond its ends."""
        values = []
        for j in range(-RADIUS, ROWS + RADIUS):
            along = ad.Int32(self.first) + j
            inside = (along >= 0) & (along < self.extent)
            values.append(dr.gather(ad.Float, plane, ad.UInt32(along * self.step + ad.Int32(self.cross)), inside))
        return values

    def write(self, values: Sequence[Float]) -> Float:
        """A plane in which neighbours along the axis lie next to each other, lines of them `stride` apart."""
        plane = dr.empty(ad.Float, self.crossing * self.stride)
        dr.scatter(plane, ad.ArrayXf(list(values)), self._packet)
        return plane

    def tight(self, plane: Float) -> Float:
        """What `write` has written, without the space between lines."""
        if self.stride == self.extent:
            return plane
        pixel = dr.arange(ad.UInt32, self.crossing * self.extent)
        return dr.gather(ad.Float, plane, (pixel // self.extent) * self.stride + pixel % self.extent)


def gaussian_blur(plane: Float, width: int, height: int) -> Float:
    """A plane [height * width] under the window of SSIM, zero beyond the border."""
    down = _Strips(width, height, width)
    across = _Strips(height, width, down.stride)
    dr.eval(plane)
    turned = down.write(_blur(down.read(plane)))
    dr.eval(turned)
    result = across.write(_blur(across.read(turned)))
    dr.eval(result)
    return across.tight(result)
