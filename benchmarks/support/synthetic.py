"""A data set for the benchmarks: pictures of a sphere of splats by our own rasterizer, and a trainer on it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.files import write_json
from spacesim.data.geometry import fibonacci_sphere
from spacesim.data.images import write_png
from spacesim.data.records import Dataset
from spacesim.data.store import intrinsics_of, read_dataset, write_points
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.config import LearningRates, TrainConfig
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.trainer import Trainer
from support.common import camera_from, sphere_arrays

VIEWS = 8
NEVER = 10**9  #: iterations
_SIZES: dict[str, Any] = {name: 1e-12 for name in LearningRates.__dataclass_fields__ if name != "decay"}
STILL = LearningRates(**_SIZES)
"""Step sizes that move nothing: every step has the same work, and the splats stay those of the sphere."""


def write_dataset(root: Path, count: int, pixels: int, views: int = VIEWS) -> Dataset:
    """Opaque pictures, over black, of a sphere of `count` splats, from all sides; `count` points to start from.

    The pictures show other splats than `sphere_arrays(count)`, so that there is something to learn.
    """
    arrays = sphere_arrays(count)
    model = Gaussians.from_numpy({**arrays, "sh": sphere_arrays(count, seed=1)["sh"]})
    frames = []
    (root / "images").mkdir(parents=True)
    for index, direction in enumerate(fibonacci_sphere(views)):
        camera = camera_from(direction, pixels)
        picture = render(model, Pinhole.of(camera), outputs=("color",)).image("color")
        name = f"images/train_{index:02d}.png"
        write_png(root / name, np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8), durable=False)
        frames.append({"file_path": name, "transform_matrix": camera.opengl.tolist()})
    write_points(root / "points.ply", arrays["means"], np.full((count, 3), 128, np.uint8))
    meta: dict[str, Any] = {"camera_model": "OPENCV", **intrinsics_of(camera)}
    meta |= {"ply_file_path": "points.ply", "frames": frames}
    meta |= {"train_filenames": [frame["file_path"] for frame in frames], "test_filenames": []}
    write_json(root / "transforms.json", meta)
    return read_dataset(root)


def still_trainer(
    dataset: Dataset, count: int, arrays: dict[str, np.ndarray] | None = None, base: TrainConfig | None = None
) -> Trainer:
    """A trainer whose steps are whole but move and refine nothing, with all harmonics, on pictures of full size.

    It holds the splats in `arrays`, or starts from the `count` points: opacity 0.1, as wide as their spacing.
    base: whose other settings count, by default those of `TrainConfig`
    """
    config = replace(
        base or TrainConfig(),
        iterations=NEVER,
        init="points",
        init_count=count,
        splatfacto_start=False,
        sh_every=0,
        num_downscales=0,
        rates=STILL,
        refinement=DensificationConfig(refine_start=NEVER, refine_stop=NEVER, max_gaussians=count),
    )
    trainer = Trainer(dataset, config)
    if arrays is not None:
        trainer.gaussians = Gaussians.from_numpy(arrays)
    return trainer
