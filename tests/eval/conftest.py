"""A tiny dataset of shaded spheres, written by hand, and runs that predict what a test wants."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.images import load_image, write_exr, write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun, Truth
from spacesim.data.store import SHADOW_LIT, SHADOW_SELF_CAST
from spacesim.splat.run import Prediction

SIZE = 40
SUNS = ((30.0, 20.0), (200.0, -10.0))


def sphere(sun, size=SIZE):
    """(rgb [H, W, 3] sRGB values, silhouette [H, W] bool) of a sphere seen along -z, lit by `sun`."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2.4 - 1.2
    inside = x * x + y * y < 1
    normal = np.stack([x, -y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)
    shade = np.clip(normal @ Sun.from_angles(*sun).direction[[1, 2, 0]], 0, 1)
    return (shade**0.5 * inside)[..., None] * [0.9, 0.8, 0.6], inside


@pytest.fixture
def dataset(tmp_path):
    """Four test frames under two suns, with all truth that evaluating reads."""
    root = tmp_path / "data"
    frames = []
    for index in range(4):
        sun = SUNS[index % 2]
        rgb, inside = sphere(sun)
        pixels = np.rint(np.dstack([rgb, inside]) * 255).astype(np.uint8)
        name = f"test_{index:05d}"
        write_png(root / "images" / f"{name}.png", pixels)
        write_png(root / "silhouette" / f"{name}.png", inside.astype(np.uint8) * 255)
        write_exr(root / "gt" / f"{name}.exr", truth_layers(inside))
        frames.append(
            Frame(
                f"images/{name}.png",
                Camera.from_fov(np.eye(4), SIZE, SIZE, 40),
                Sun.from_angles(*sun),
                gt_path=f"gt/{name}.exr",
                silhouette_path=f"silhouette/{name}.png",
            )
        )
    return Dataset(
        root,
        (),
        tuple(frames),
        scene={"scene": "sphere", "config": {"spp": 16, "seed": 1}, "parts": ["ball"]},
    )


def truth_layers(inside):
    """The left half of the sphere lies in cast shadow."""
    visibility = inside * (np.arange(SIZE) >= SIZE // 2).astype(np.float32)
    shadow = np.where(visibility > 0, SHADOW_LIT, SHADOW_SELF_CAST) * inside
    planes = {name: inside.astype(np.float32) for name in Truth.__dataclass_fields__}
    vectors = {name: np.dstack([planes[name]] * 3) for name in ("radiance", "normal", "albedo")}
    planes["distance"] *= 2  # not what depth is compared with
    return planes | vectors | {"sun_visibility": visibility, "shadow": shadow.astype(np.float32)}


@dataclass
class FakeRun:
    """Predicts `change(true rgb)` of the test frame with the same camera, whatever the Sun."""

    dataset: Dataset
    change: object = staticmethod(lambda rgb: rgb)
    visibility: object = None
    depth: object = 1.0
    path: Path = Path("runs/fake")
    gaussian_count: int = 123
    model_bytes: int = 45678
    backend: str = "llvm"
    parts: tuple = ()
    config: dict = field(default_factory=lambda: {"method": "vanilla", "preset": "demo", "seed": 7})
    training: dict = field(
        default_factory=lambda: {
            "history": [{"iteration": i, "loss": 1 / (i + 1), "gaussians": 100 + i} for i in range(0, 300, 100)],
            "seconds": 12.5,
            "backend": "llvm",
            "versions": {"drjit": "1.5.0"},
            "command": "spacesim train data --out runs/fake",
        }
    )

    relightable, gaussian_run, gaussians = False, None, None

    def draw_material(self, camera):
        raise InputError(f"{self.path}: expected a run with materials, found none")

    def predict(self, camera, sun, exposure=None):
        frame = next(frame for frame in self.dataset.test if frame.camera is camera)
        rgb = load_image(self.dataset, frame).over(np.zeros(3))
        alpha = np.ones(rgb.shape[:2], np.float32)
        return Prediction(rgb=self.change(rgb), alpha=alpha, depth=alpha * self.depth, visibility=self.visibility)


@dataclass
class RelightableRun(FakeRun):
    """Predicts the sphere under any Sun, and that its columns from `edge` on see the Sun."""

    relightable = True
    edge: int = SIZE // 2
    config: dict = field(default_factory=lambda: {"method": "shadow-map", "preset": "demo", "seed": 7})

    def predict(self, camera, sun, exposure=None):
        rgb, inside = sphere(sun.angles)
        columns = np.arange(SIZE) >= self.edge
        return Prediction(
            rgb=self.change(rgb),
            alpha=inside.astype(np.float32),
            depth=inside,
            visibility=inside * columns.astype(float),
        )


@pytest.fixture
def relightable(dataset):
    """relightable(edge=..., ...) -> RelightableRun and its dataset, trained under the first test frame's Sun alone."""
    trained = replace(dataset, train=(dataset.test[0],))
    return lambda **options: (RelightableRun(trained, **options), trained)


@pytest.fixture
def make_run(dataset):
    """make_run(change=..., visibility=..., ...) -> FakeRun on `dataset`."""
    return lambda *args, **options: FakeRun(dataset, *args, **options)
