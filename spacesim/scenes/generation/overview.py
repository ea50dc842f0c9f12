"""Pictures that tell what a dataset holds: how densely cameras look at the target, and a contact sheet of frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from spacesim.data import sheet
from spacesim.data.geometry import Array, angles_from_direction, direction_from_angles, fibonacci_sphere
from spacesim.data.images import read_png, write_png
from spacesim.data.records import Dataset, Frame
from spacesim.data.sheet import Tile, font
from spacesim.data.store import read_points

BANDWIDTH_DEG = 5.0
"""Angle over which each camera is spread in the density (chosen)."""

MOST_TILES = 60

DENSITY_NAME, SHEET_NAME = "camera_density.png", "contact_sheet.png"

_MOST_KERNELS = 4000  # more cameras are gathered on a lattice first: about 2 degrees from point to point
_STEP_DEG = 2.0

_VIRIDIS = ("440154", "482878", "3e4a89", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725")
"""Ten even steps of matplotlib's viridis (S. van der Walt, N. Smith 2015, CC0), whose lightness rises evenly."""

_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_RED = (220, 30, 30)
_TRAIN_SUN, _TEST_SUN = (255, 150, 30), (255, 255, 255)


def write_overview(root: Path, dataset: Dataset) -> None:
    """Write the camera density and the contact sheet of `dataset` into the folder `root`.

    Raises InputError where a picture or the mesh cannot be read.
    """
    suns = _suns(dataset.train)
    trained = {sun.tobytes() for sun in suns}
    test_suns = np.array([sun for sun in _suns(dataset.test) if sun.tobytes() not in trained]).reshape(-1, 3)
    positions = np.array([frame.camera.position for frame in dataset.train or dataset.test])
    write_png(root / DENSITY_NAME, camera_density(positions, target_of(dataset), suns, test_suns))
    write_png(root / SHEET_NAME, contact_sheet(dataset))


def target_of(dataset: Dataset) -> Array:
    """[3] what cameras look at, metres: the middle of the true mesh's box, or else of the points to start from, or else
    the point that is nearest to all optical axes."""
    for path in (dataset.mesh_path, dataset.ply_file_path):
        if path is not None:
            points, _ = read_points(dataset.root / path)
            return 0.5 * (points.min(axis=0) + points.max(axis=0))
    axes = np.array([frame.camera.world_from_camera[:3, 2] for frame in dataset.frames])
    positions = np.array([frame.camera.position for frame in dataset.frames])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] projections along each axis
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, positions), rcond=None)[0]


def density(directions: Array, points: Array) -> Array:
    """[M] views per steradian at unit vectors `points` [M, 3], from unit vectors `directions` [N, 3] towards cameras.

    Each camera is spread by von Mises and Fisher's law on the sphere (R. Fisher, "Dispersion on a sphere", 1953), with
    a concentration of 1 / BANDWIDTH^2, so that the integral over the sphere is N: areas count as they are on the
    sphere, not as they are on the map.
    """
    weights = np.ones(len(directions))
    if len(directions) > _MOST_KERNELS:
        lattice = fibonacci_sphere(_MOST_KERNELS)
        weights = np.bincount(cKDTree(lattice).query(directions)[1], minlength=len(lattice)).astype(np.float64)
        directions = lattice
    concentration = 1 / math.radians(BANDWIDTH_DEG) ** 2
    scale = concentration / (2 * math.pi * (1 - math.exp(-2 * concentration)))
    rows = [np.exp(concentration * (part @ directions.T - 1)) @ weights for part in np.array_split(points, 64)]
    return scale * np.concatenate(rows)


def camera_density(
    positions: Array, target: Array, suns: Array | None = None, test_suns: Array | None = None
) -> np.ndarray:
    """[H, W, 3] uint8: a map of how many of the cameras at `positions` [N, 3] see `target` [3] from which direction,
    over azimuth (+x in the middle) and elevation, with the directions of Suns [S, 3] of training and of testing alone.
    """
    offsets = np.asarray(positions, np.float64) - target
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    azimuths = np.arange(_STEP_DEG / 2, 360, _STEP_DEG) - 180
    elevations = np.arange(90 - _STEP_DEG / 2, -90, -_STEP_DEG)
    grid = direction_from_angles(*np.meshgrid(azimuths, elevations))  # [rows, columns, 3]
    values = density(directions, grid.reshape(-1, 3)).reshape(grid.shape[:2])
    figure = _Map(values, len(positions))
    figure.draw_suns(np.reshape([] if suns is None else suns, (-1, 3)), "training Suns", _TRAIN_SUN)
    figure.draw_suns(np.reshape([] if test_suns is None else test_suns, (-1, 3)), "test Suns", _TEST_SUN)
    return np.asarray(figure.picture)


def contact_sheet(dataset: Dataset) -> np.ndarray:
    """[H, W, 3] uint8: up to MOST_TILES frames, evenly chosen, over black, each with its name and Sun.

    Raises InputError where a picture cannot be read.
    """
    frames = dataset.frames
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, MOST_TILES).round().astype(int))]
    aspect = max(frame.camera.height / frame.camera.width for frame in chosen)
    tiles = (_tile(dataset.root, frame) for frame in chosen)
    return sheet.contact_sheet(_title(dataset, len(chosen)), tiles, len(chosen), aspect)


def _tile(root: Path, frame: Frame) -> Tile:
    angles = "" if frame.sun is None else "Sun {:.0f}°, {:.0f}°".format(*frame.sun.angles)
    return Tile(read_png(root / frame.file_path), Path(frame.file_path).stem, angles)


@dataclass
class _Map:
    """The density map as it is drawn: axes, colours, colour bar, marks. values: [rows, columns], north first."""

    values: Array
    cameras: int
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
        colours = _colours(smooth[border : border + self.HIGH, border : border + self.WIDE])
        self.picture.paste(Image.fromarray(colours), (self.LEFT, self.TOP))
        self._draw_axes()
        self._draw_bar()
        title = f"Camera density, {self.cameras:,} view{'s' if self.cameras > 1 else ''}"
        self.draw.text((self.LEFT, self.TOP - 14), title, _BLACK, font(20), anchor="ls")

    def place(self, azimuth: float, elevation: float) -> tuple[float, float]:
        """Pixels of a direction, degrees."""
        east = (azimuth + 180) % 360
        return self.LEFT + self.WIDE * east / 360, self.TOP + self.HIGH * (90 - elevation) / 180

    def draw_suns(self, suns: Array, name: str, colour: tuple[int, int, int]) -> None:
        """Mark the directions of Suns [S, 3], and say so above the map."""
        if len(suns) == 0:
            return
        r = 8 if len(suns) <= 60 else 4 if len(suns) <= 400 else 2
        for sun in suns:
            self._disc(*self.place(*angles_from_direction(sun)), r, colour)
        label = f"{len(suns)} {name if len(suns) > 1 else name[:-1]}"
        self.draw.text((self.legend, self.TOP - 14), label, _BLACK, font(18), anchor="rs")
        self.legend -= self.draw.textlength(label, font(18)) + 16
        self._disc(self.legend, self.TOP - 20, 7, colour)
        self.legend -= 30

    def _disc(self, x: float, y: float, r: float, colour: tuple[int, int, int]) -> None:
        self.draw.ellipse((x - r, y - r, x + r, y + r), colour, _BLACK, width=2 if r > 3 else 1)

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
        self.draw.text((self.LEFT + self.WIDE / 2, bottom + 40), "azimuth", _BLACK, font(20), anchor="ma")
        label = Image.new("RGB", (120, 30), _WHITE)
        ImageDraw.Draw(label).text((60, 15), "elevation", _BLACK, font(20), anchor="mm")
        self.picture.paste(label.rotate(90, expand=True), (4, self.TOP + self.HIGH // 2 - 60))

    def _draw_bar(self) -> None:
        wide, bottom = 26, self.TOP + self.HIGH
        ramp = np.repeat(np.linspace(1, 0, self.HIGH)[:, None], wide, axis=1)
        self.picture.paste(Image.fromarray(_colours(ramp)), (self.BAR, self.TOP))
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


def _colours(values: np.ndarray) -> np.ndarray:
    """[..., 3] uint8 of values in [0, 1]."""
    return _table()[np.rint(255 * np.clip(values, 0, 1)).astype(np.intp)]


def _suns(frames: Sequence[Frame]) -> Array:
    """[S, 3] directions of the Suns of frames, each once."""
    directions = {f.sun.direction.tobytes(): f.sun.direction for f in frames if f.sun is not None}
    return np.array(list(directions.values())).reshape(-1, 3)


def _title(dataset: Dataset, shown: int) -> str:
    name = dataset.scene.get("scene", dataset.root.name)
    camera = dataset.frames[0].camera
    suns = len({f.sun.direction.tobytes() for f in dataset.frames if f.sun is not None})
    parts = [str(name), f"{len(dataset.train)} training and {len(dataset.test)} test frames"]
    parts += [f"{suns} Sun{'s' if suns > 1 else ''}"] if suns else []
    parts += [f"{camera.width} x {camera.height} px"]
    return ", ".join(parts) + (f"; {shown} shown" if shown < len(dataset.frames) else "")
