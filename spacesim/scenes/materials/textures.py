"""Procedural images of surfaces: creased foil, solar cells, grains. Each repeats without a seam in both
directions, is square, uint8 RGB and comes out the same on every call.

Row 0 is the top of the image, where v = 1. Normal maps hold (n + 1) / 2 of tangent-space normals, x along u (to the
right), y along v (up), as in glTF. No shape or strength in them is measured.
"""

from functools import cache

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.images import srgb_from_linear

SIZE = 512  #: pixels of a side of cells and grains
FOIL_SIZE = 1024  #: of foil, which covers larger parts

Color = tuple[float, float, float]


@cache
def crinkle() -> np.ndarray:
    """Normal map of crinkled foil: flat facets of several sizes that meet in sharp creases, RMS slope 0.22."""
    from scipy.ndimage import gaussian_filter  # here and below: a tenth of a second, that plain scenes need not wait

    height = np.zeros((FOIL_SIZE, FOIL_SIZE))
    for seed, (count, strength) in enumerate([(126, 1.0), (540, 0.45), (2340, 0.2)]):
        height += strength * _facets(count, seed, FOIL_SIZE) / np.sqrt(count)
    return _normals(gaussian_filter(height, 0.7, mode="wrap"), rms_slope=0.22)


@cache
def grain() -> np.ndarray:
    """Normal map of loose soil: noise of amplitude frequency**-1.6 with rimmed pits, RMS slope 0.18."""
    height = 2.0 * _noise(1.6, seed=10) - 0.6 * _pits(90, seed=11)
    return _normals(height, rms_slope=0.18)


@cache
def cells(cell: Color, gap: Color = (0.06, 0.06, 0.065), metal: Color = (0.45, 0.45, 0.46)) -> np.ndarray:
    """sRGB-encoded image of 2 by 4 solar cells, twice as wide as high, with two cropped corners each: gaps of the
    laminate, the cover glass's bright edge, a busbar along the lower side and fine fingers.

    cell, gap, metal: linear RGB. The fingers are narrower than a pixel and darkened in proportion. The bare cell's
    colour is adjusted so that the mean over the cells' area without gaps, edges and busbars is `cell`.
    """
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE
    width, height = SIZE / 2.0, SIZE / 4.0  # pixels of a cell's pitch
    column, row = np.floor(2 * u), np.floor(4 * v)
    x, y = (2 * u - column) * width, (4 * v - row) * height  # pixels within the pitch
    inset = np.minimum.reduce([x, width - x, y, height - y])
    corner = np.minimum(x, width - x) + y  # the two upper corners are cut at 45 degrees
    inset = np.minimum(inset, (corner - 16.0) / np.sqrt(2.0))
    inside = np.clip(inset - 2.0, 0.0, 1.0)  # one pixel of smooth edge
    glass = inside * np.clip(4.0 - inset, 0.0, 1.0)
    busbar = inside * (np.abs(y - (height - 9.0)) < 2.0)
    finger = np.where(x % 4.0 < 1.0, 0.06, 0.0) * (y < height - 9.0)
    shade = 1.0 + 0.06 * np.random.default_rng(5).uniform(-1.0, 1.0, (4, 2))[row.astype(int), column.astype(int)]

    bare = np.maximum((np.asarray(cell) - 0.015 * np.asarray(metal)) / 0.985, 0.0)
    color = bare * shade[..., None]
    color = color + finger[..., None] * (np.asarray(metal) - color)
    color = color + glass[..., None] * 0.04
    color = color + busbar[..., None] * (np.asarray(metal) - color)
    color = np.asarray(gap) + inside[..., None] * (color - np.asarray(gap))
    return _encode(color, seed=6)


def _encode(color: Array, seed: int) -> np.ndarray:
    """Linear [H, W, 3] as sRGB bytes, rounded at random so that dark colours keep their mean."""
    noise = np.random.default_rng(seed).uniform(0.0, 1.0, color.shape)
    encoded = 255.0 * np.asarray(srgb_from_linear(np.clip(color, 0.0, 1.0)), np.float64)
    return np.minimum(encoded + noise, 255.0).astype(np.uint8)


def _facets(count: int, seed: int, size: int) -> Array:
    """Height [size, size] of a periodic surface of flat facets: over each of `count` random points stands a plane
    of random tilt, and the highest plane near a point is the surface, so that creases are straight and sharp."""
    random = np.random.default_rng(seed)
    points = random.uniform(0.0, 1.0, (count, 2))
    slopes = random.normal(0.0, 1.0, (count, 2))
    lifts = random.uniform(0.0, 0.5, count) / np.sqrt(count)
    reach = 2.2 * np.sqrt(count)  # a paraboloid below each plane keeps it to its neighbourhood
    half = min(size // 2, int(2.5 * size / np.sqrt(count)))  # farther away no plane is the highest
    near = np.arange(-half, half)
    wide = np.full((size + 2 * half, size + 2 * half), -np.inf)
    for (px, py), (sx, sy), lift in zip(points, slopes, lifts, strict=True):
        column, row = int(px * size), int(py * size)
        dx, dy = (column + near + 0.5) / size - px, ((row + near + 0.5) / size - py)[:, None]
        plane = (lift + sx * dx) + sy * dy - reach * np.maximum(dx**2, dy**2)
        window = wide[row : row + 2 * half, column : column + 2 * half]
        np.maximum(window, plane, out=window)
    for _ in range(2):  # what lies beyond an edge comes in at the opposite one
        inside = wide[half : half + size]
        np.maximum(inside[:half], wide[half + size :], out=inside[:half])
        np.maximum(inside[size - half :], wide[:half], out=inside[size - half :])
        wide = inside.T
    return wide * np.sqrt(count)


def _noise(exponent: float, seed: int) -> Array:
    """Periodic noise [SIZE, SIZE] of amplitude 1 / frequency**`exponent`, mean 0, deviation 1."""
    from scipy.fft import irfft2, rfft2

    white = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    frequency[0, 0] = np.inf
    noise = irfft2(rfft2(white) / frequency**exponent, s=(SIZE, SIZE))
    return noise / noise.std()


def _pits(count: int, seed: int) -> Array:
    """Periodic depth [SIZE, SIZE] of round pits, as many of each size as a power law of exponent -2 has."""
    random = np.random.default_rng(seed)
    result = np.zeros((SIZE, SIZE))
    for px, py, fraction in random.uniform(0.0, 1.0, (count, 3)):
        radius = 0.012 / np.sqrt(1.0 - 0.97 * fraction)
        near = np.arange(-int(3 * radius * SIZE), int(3 * radius * SIZE) + 1)
        column, row = int(px * SIZE), int(py * SIZE)
        distance = np.hypot(near, near[:, None]) / (radius * SIZE)
        depth = np.where(distance < 1.0, 1.0 - distance**2, -0.25 * np.exp(-4.0 * np.abs(distance - 1.0)))
        result[np.ix_((row + near) % SIZE, (column + near) % SIZE)] += 60.0 * radius * depth
    return result


def _normals(height: Array, rms_slope: float) -> np.ndarray:
    """Normal map of a periodic `height` field [N, N] scaled to the RMS of its slope."""
    along_u = 0.5 * (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1))
    along_v = 0.5 * (np.roll(height, 1, axis=0) - np.roll(height, -1, axis=0))  # v points up
    scale = rms_slope / np.sqrt(np.mean(along_u**2 + along_v**2))
    normal = np.stack([-scale * along_u, -scale * along_v, np.ones_like(height)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.round(127.5 * (normal + 1.0)).astype(np.uint8)
