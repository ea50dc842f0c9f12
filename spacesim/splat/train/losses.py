"""What training minimises: L1 and structural dissimilarity (thesis 2.8), on planes of pixels."""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad

SSIM_RADIUS = 5  #: 11 x 11 window
SSIM_SIGMA = 1.5  #: pixels
_C1, _C2 = 0.01**2, 0.03**2


def photometric_loss(prediction: Any, target: Any, width: int, height: int, ssim_weight: float = 0.2) -> Any:
    """(1 - w) mean |p - t| + w (1 - SSIM(p, t)), thesis 2.8 with D-SSIM = 1 - SSIM as gsplat takes it.

    prediction, target: Array3f [3, height * width];  returns a Float of width 1.
    """
    pixels = 3 * width * height
    l1 = dr.sum(dr.sum(dr.abs(prediction - target))) / pixels
    if ssim_weight == 0:
        return l1
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(prediction, target, width, height))


def ssim(prediction: Any, target: Any, width: int, height: int) -> Any:
    """Mean structural similarity of two pictures (thesis 2.19), Float of width 1; differentiable in `prediction`.

    Gaussian window of 11 x 11 pixels, sigma 1.5, data range 1; beyond the border the pictures are 0.
    """
    return dr.custom(_Ssim, prediction, target, width, height)


class _Ssim(dr.CustomOp):
    """SSIM with its derivative by hand: the window is symmetric, so the adjoint of a blur is the same blur."""

    def eval(self, prediction: Any, target: Any, width: int, height: int) -> Any:
        self.pair, self.size = (prediction, target), (width, height)
        planes = []
        for x, y in zip(prediction, target, strict=True):
            planes += [x, y, x * x, y * y, x * y]
        blurred = gaussian_blur(planes, width, height)
        self.partials: list[Any] = []
        total: Any = ad.Float(0)
        for c in range(3):
            mx, my, mxx, myy, mxy = blurred[5 * c : 5 * c + 5]
            a1, a2 = 2 * mx * my + _C1, 2 * (mxy - mx * my) + _C2
            b1, b2 = mx * mx + my * my + _C1, mxx - mx * mx + myy - my * my + _C2
            inverse = dr.rcp(b1 * b2)
            value = a1 * a2 * inverse
            by_mean = 2 * my * (a2 - a1) * inverse + 2 * mx * value * (dr.rcp(b2) - dr.rcp(b1))
            self.partials += [by_mean, -value * dr.rcp(b2), 2 * a1 * inverse]
            total += dr.sum(value)
        dr.eval(total, self.partials)
        return total / (3 * width * height)

    def backward(self) -> None:
        width, height = self.size
        blurred = gaussian_blur(self.partials, width, height)
        by_mean_ssim: Any = self.grad_out()
        scale = by_mean_ssim / (3 * width * height)
        gradient = []
        for c, (x, y) in enumerate(zip(*self.pair, strict=True)):
            by_mean, by_square, by_product = blurred[3 * c : 3 * c + 3]
            gradient.append(scale * (by_mean + 2 * x * by_square + y * by_product))
        self.set_grad_in("prediction", ad.Array3f(gradient))

    def name(self) -> str:
        return "ssim"


def gaussian_blur(planes: list[Any], width: int, height: int) -> list[Any]:
    """Blur planes [height * width] with the SSIM window, zero beyond the border; rows, then columns."""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    pixel = dr.arange(ad.UInt32, width * height)
    for stride, position, extent in ((1, pixel % width, width), (width, pixel // width, height)):
        dr.eval(planes)
        sums = [ad.Float(0) for _ in planes]
        for offset, weight in zip(offsets.tolist(), weights.tolist(), strict=True):
            there = ad.Int32(position) + offset
            inside = (there >= 0) & (there < extent)
            source = ad.UInt32(ad.Int32(pixel) + offset * stride)
            sums = [
                dr.fma(weight, dr.gather(ad.Float, plane, source, inside), total)
                for plane, total in zip(planes, sums, strict=True)
            ]
        planes = sums
    dr.eval(planes)
    return planes
