"""From where cameras look at their target, and how densely: a map of the sphere around it, of any dataset's poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from spacesim.data.geometry import Array, angles_from_direction, direction_from_angles, fibonacci_sphere
from spacesim.data.images import write_png
from spacesim.data.images.sheet import font
from spacesim.data.mesh import read_points
from spacesim.data.records import Dataset, Frame

BANDWIDTH_DEG = 5.0
"""Angle over which each camera is spread in the density."""

NAME = "camera_density.png"

_MAX_KERNELS = 4000  # more cameras are gathered on a lattice first: about 2 degrees from point to point
_STEP_DEG = 2.0
_PARALLEL = 1e-3  # mean squared sine of the angles between optical axes and their mean, about 2 degrees

_VIRIDIS = ("440154", "482878", "3e4a89", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725")
"""Ten even steps of matplotlib's viridis (S. van der Walt, N. Smith 2015, CC0), whose lightness rises evenly."""

_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_RED = (220, 30, 30)
_TRAIN_SUN, _TEST_SUN = (255, 150, 30), (255, 255, 255)


def write_camera_density(path: Path, dataset: Dataset) -> None:
    """Write the map of the training cameras, or of the test ones where there are no others, with its Suns, as a PNG.

    Raises InputError where the mesh or the points cannot be read or the file cannot be written.
    """
    suns = _suns(dataset.train)
    trained = {sun.tobytes() for sun in suns}
    test_suns = np.array([sun for sun in _suns(dataset.test) if sun.tobytes() not in trained]).reshape(-1, 3)
    positions = np.array([frame.camera.position for frame in dataset.train or dataset.test])
    what = "training" if dataset.train else "test"
    write_png(path, camera_density(positions, target_of(dataset), suns, test_suns, what))


def target_of(dataset: Dataset) -> Array:
    """[3] what cameras look at, metres: the middle of the true mesh's box, or else the point that is nearest to all
    optical axes. Where these are parallel, the median of the points to start from, if there are any.

    Raises InputError where the mesh or the points cannot be read.
    """
    if dataset.mesh_path is not None:
        points, _ = read_points(dataset.root / dataset.mesh_path)
        return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)), np.float64)
    axes = np.array([frame.camera.world_from_camera[:3, 2] for frame in dataset.frames])
    positions = np.array([frame.camera.position for frame in dataset.frames])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] projections along each axis
    if dataset.ply_file_path is not None and np.linalg.eigvalsh(across.mean(axis=0))[0] < _PARALLEL:
        return np.asarray(np.median(read_points(dataset.root / dataset.ply_file_path)[0], axis=0), np.float64)
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, positions), rcond=None)[0]


def density(directions: Array, points: Array) -> Array:
    """[M] views per steradian at unit vectors `points` [M, 3], from unit vectors `directions` [N, 3] towards cameras.

    Each camera is spread by von Mises and Fisher's law on the sphere (R. Fisher, "Dispersion on a sphere", 1953), with
    a concentration of 1 / BANDWIDTH^2, so that the integral over the sphere is N: areas count as they are on the
    sphere, not as they are on the map.
    """
    weights = np.ones(len(directions))
    if len(directions) > _MAX_KERNELS:
        from scipy.spatial import cKDTree  # a third of a second

        lattice = fibonacci_sphere(_MAX_KERNELS)
        weights = np.bincount(cKDTree(lattice).query(directions)[1], minlength=len(lattice)).astype(np.float64)
        directions = lattice
    concentration = 1 / math.radians(BANDWIDTH_DEG) ** 2
    scale = concentration / (2 * math.pi * (1 - math.exp(-2 * concentration)))
    rows = [np.exp(concentration * (part @ directions.T - 1)) @ weights for part in np.array_split(points, 64)]
    return scale * np.concatenate(rows)


def camera_density(
    positions: Array, target: Array, suns: Array | None = None, test_suns: Array | None = None, what: str = "training"
) -> np.ndarray:
    """[H, W, 3] uint8: a map of how many of the cameras at `positions` [N, 3] see `target` [3] from which direction,
    over azimuth (+x in the middle) and elevation, with the directions of Suns [S, 3] of training and of testing alone.
    what: which views they are, for the title
    """
    offsets = np.asarray(positions, np.float64) - target
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    azimuths = np.arange(_STEP_DEG / 2, 360, _STEP_DEG) - 180
    elevations = np.arange(90 - _STEP_DEG / 2, -90, -_STEP_DEG)
    grid = direction_from_angles(*np.meshgrid(azimuths, elevations))  # [rows, columns, 3]
    values = density(directions, grid.reshape(-1, 3)).reshape(grid.shape[:2])
    figure = _DensityMap(values, len(positions), what, np.asarray(target, np.float64))
    figure.draw_suns(np.reshape([] if suns is None else suns, (-1, 3)), "training Suns", _TRAIN_SUN)
    figure.draw_suns(np.reshape([] if test_suns is None else test_suns, (-1, 3)), "test Suns", _TEST_SUN)
    return np.asarray(figure.picture)


@dataclass
class _DensityMap:
    """The density map as it is drawn: axes, colours, colour bar, marks."""

    values: Array  #: [rows, columns], north first
    cameras: int
    what: str  #: which views they are
    target: Array  #: [3] metres, what they look at
    picture: Image.Image = field(init=False)

    LEFT, TOP, WIDE, HIGH, BAR = 92, 58, 1080, 540, 1200
    SIZE = (1340, 700)

    def __post_init__(self) -> None:
        self.even = self.cameras / (4 * math.pi)
        self.top = max(float(self.values.max()), 2 * self.even)
        self.picture = Image.new("RGB", self.SIZE, _WHITE)
        self.draw = ImageDraw.Draw(self.picture)
        self.legend = float(self.LEFT + self.WIDE)
        # The map closes on itself: columns are repeated before they are interpolated.
        wrapped = np.pad(np.pad(self.values / self.top, ((0, 0), (4, 4)), mode="wrap"), ((4, 4), (0, 0)), mode="edge")
        scale = self.WIDE / self.values.shape[1]
        size = round(scale * wrapped.shape[1]), round(scale * wrapped.shape[0])
        smooth = np.asarray(Image.fromarray(wrapped.astype(np.float32)).resize(size, Image.Resampling.BILINEAR))
        border = round(4 * scale)
        colors = _colors(smooth[border : border + self.HIGH, border : border + self.WIDE])
        self.picture.paste(Image.fromarray(colors), (self.LEFT, self.TOP))
        self._draw_axes()
        self._draw_bar()
        title = f"Camera density, {self.cameras:,} {self.what} view{'s' if self.cameras > 1 else ''}"
        self.draw.text((self.LEFT, self.TOP - 14), title, _BLACK, font(20), anchor="ls")
        place = ", ".join(f"{value:.3g}" for value in self.target + 0.0)
        note = f"Directions from ({place}) to the cameras; each view is spread by {BANDWIDTH_DEG:g}°"
        self.draw.text((self.LEFT, self.TOP + self.HIGH + 92), note, _BLACK, font(15), anchor="ls")

    def place(self, azimuth: float, elevation: float) -> tuple[float, float]:
        """Pixels of a direction, degrees."""
        east = (azimuth + 180) % 360
        return self.LEFT + self.WIDE * east / 360, self.TOP + self.HIGH * (90 - elevation) / 180

    def draw_suns(self, suns: Array, name: str, color: tuple[int, int, int]) -> None:
        """Mark the directions of Suns [S, 3], and say so above the map."""
        if len(suns) == 0:
            return
        r = 8 if len(suns) <= 60 else 4 if len(suns) <= 400 else 2
        for sun in suns:
            self._disc(*self.place(*angles_from_direction(sun)), r, color)
        label = f"{len(suns)} {name if len(suns) > 1 else name[:-1]}"
        self.draw.text((self.legend, self.TOP - 14), label, _BLACK, font(18), anchor="rs")
        self.legend -= self.draw.textlength(label, font(18)) + 16
        self._disc(self.legend, self.TOP - 20, 7, color)
        self.legend -= 30

    def _disc(self, x: float, y: float, r: float, color: tuple[int, int, int]) -> None:
        self.draw.ellipse((x - r, y - r, x + r, y + r), color, _BLACK, width=2 if r > 3 else 1)

    def _draw_axes(self) -> None:
        right, bottom = self.LEFT + self.WIDE, self.TOP + self.HIGH
        for east in range(0, 361, 30):
            x = self.LEFT + self.WIDE * east / 360
            self.draw.line((x, bottom, x, bottom + 7), _BLACK, 2)
            self.draw.text((x, bottom + 11), f"{(east + 180) % 360}°", _BLACK, font(18), anchor="ma")
        for elevation in range(-90, 91, 30):
            _, y = self.place(0, elevation)
            self.draw.line((self.LEFT - 7, y, self.LEFT, y), _BLACK, 2)
            self.draw.text((self.LEFT - 11, y), f"{elevation}°", _BLACK, font(18), anchor="rm")
        self.draw.rectangle((self.LEFT - 1, self.TOP - 1, right, bottom), None, _BLACK, 2)
        self.draw.text(
            (self.LEFT + self.WIDE / 2, bottom + 40), "azimuth, +x at 0°, +y at 90°", _BLACK, font(20), anchor="ma"
        )
        label = Image.new("RGB", (240, 30), _WHITE)
        ImageDraw.Draw(label).text((120, 15), "elevation, +z at 90°", _BLACK, font(20), anchor="mm")
        self.picture.paste(label.rotate(90, expand=True), (4, self.TOP + self.HIGH // 2 - 120))

    def _draw_bar(self) -> None:
        wide, bottom = 26, self.TOP + self.HIGH
        ramp = np.repeat(np.linspace(1, 0, self.HIGH)[:, None], wide, axis=1)
        self.picture.paste(Image.fromarray(_colors(ramp)), (self.BAR, self.TOP))
        self.draw.rectangle((self.BAR - 1, self.TOP - 1, self.BAR + wide, bottom), None, _BLACK, 2)
        for value in _ticks(self.top):
            y = bottom - self.HIGH * value / self.top
            self.draw.line((self.BAR + wide, y, self.BAR + wide + 7, y), _BLACK, 2)
            self.draw.text((self.BAR + wide + 12, y), f"{value:g}", _BLACK, font(18), anchor="lm")
        self.draw.text((self.BAR, self.TOP - 14), "views per sr", _BLACK, font(18), anchor="ls")
        y = bottom - self.HIGH * self.even / self.top
        self.draw.line((self.BAR - 9, y, self.BAR + wide - 1, y), _RED, 3)
        self.draw.text((self.BAR, bottom + 11), "red: even\ncoverage", _RED, font(15), spacing=2)


def _ticks(top: float) -> list[float]:
    """About six round values from 0 to `top`."""
    rough = top / 5
    unit = 10.0 ** math.floor(math.log10(rough))
    step = unit * min((m for m in (1, 2, 5, 10) if m * unit >= rough), default=10)
    return [round(k * step, 12) for k in range(math.floor(top / step) + 1)]


@cache
def _table() -> np.ndarray:
    """[256, 3] uint8."""
    knots = np.array([[int(code[k : k + 2], 16) for k in (0, 2, 4)] for code in _VIRIDIS])
    places = np.linspace(0, len(knots) - 1, 256)
    channels = [np.interp(places, np.arange(len(knots)), channel) for channel in knots.T]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def _colors(values: np.ndarray) -> np.ndarray:
    """[..., 3] uint8 of values in [0, 1]."""
    return _table()[np.rint(255 * np.clip(values, 0, 1)).astype(np.intp)]


def _suns(frames: Sequence[Frame]) -> Array:
    """[S, 3] directions of the Suns of frames, each once."""
    directions = {f.sun.direction.tobytes(): f.sun.direction for f in frames if f.sun is not None}
    return np.array(list(directions.values())).reshape(-1, 3)
