"""A small dataset of known truth: pictures of random Gaussians by the float64 reference, in Nerfstudio's layout."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera, Dataset
from spacesim.data.store import intrinsics_of, read_dataset, write_points
from spacesim.splat.raster.gaussians import SH_C0
from spacesim.splat.raster.lists import capacity
from spacesim.splat.reference.rasterizer import render_reference

VIEWS, TESTS, SIZE = 8, 2, 32


@pytest.fixture(autouse=True)
def forget_the_test_before():
    """What it found free of memory, and the tiles of its pictures: some tests have other tiles."""
    capacity._found.clear()
    capacity.Extent.of.cache_clear()


@pytest.fixture(scope="session")
def known_gaussians() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    sh = 0.1 * rng.normal(size=(60, 4, 3))
    sh[:, 0] = rng.uniform(-1, 1.5, (60, 3))
    return {
        "means": rng.uniform(-0.5, 0.5, (60, 3)),
        "log_scales": rng.uniform(-2.6, -1.8, (60, 3)),
        "quaternions": rng.normal(size=(60, 4)),
        "logit_opacities": rng.uniform(1, 4, 60),
        "sh": sh,
    }


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory, known_gaussians) -> Dataset:
    return _write_dataset(tmp_path_factory.mktemp("small"), known_gaussians)


@pytest.fixture(scope="session")
def black_dataset(tmp_path_factory, known_gaussians) -> Dataset:
    """The same shape, every surface black."""
    sh = np.zeros_like(known_gaussians["sh"])
    sh[:, 0] = -0.5 / SH_C0
    return _write_dataset(tmp_path_factory.mktemp("black"), {**known_gaussians, "sh": sh})


@pytest.fixture(scope="session")
def opaque_dataset(tmp_path_factory, known_gaussians) -> Dataset:
    """Pictures without alpha, over a black sky."""
    dataset = _write_dataset(tmp_path_factory.mktemp("opaque"), known_gaussians)
    for path in (dataset.root / frame.file_path for frame in dataset.frames):
        rgba = Image.open(path)
        sky = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
        sky.alpha_composite(rgba)
        sky.convert("RGB").save(path)
    return dataset


@pytest.fixture(scope="session")
def write_dataset():
    """The function (root, gaussians) -> Dataset."""
    return _write_dataset


def _write_dataset(root: Path, gaussians: dict[str, np.ndarray]) -> Dataset:
    (root / "images").mkdir()
    frames = []
    for index, direction in enumerate(fibonacci_sphere(VIEWS + TESTS)):
        camera = Camera.from_fov(look_at(3 * direction, np.zeros(3)), SIZE, SIZE, 35)
        picture = render_reference(gaussians, camera)
        alpha = picture.alpha[..., None]
        straight = np.where(alpha > 0, picture.color / np.maximum(alpha, 1e-9), 0)
        rgba = np.rint(255 * np.clip(np.concatenate([straight, alpha], axis=-1), 0, 1)).astype(np.uint8)
        name = f"images/{'test' if index % 5 == 4 else 'train'}_{index:02d}.png"
        Image.fromarray(rgba).save(root / name)
        frames.append({"file_path": name, "transform_matrix": camera.opengl.tolist()})
    listed = {
        f"{split}_filenames": [f["file_path"] for f in frames if split in f["file_path"]] for split in ("train", "test")
    }
    write_points(root / "points.ply", gaussians["means"], np.full((60, 3), 128, np.uint8))
    meta = {**intrinsics_of(camera), "ply_file_path": "points.ply", "frames": frames, **listed}
    (root / "transforms.json").write_text(json.dumps(meta))
    return read_dataset(root)


@pytest.fixture(scope="session")
def small_lit_dataset(tmp_path_factory) -> Dataset:
    """Path-traced pictures of the boxsat under two Suns, with truth."""
    from spacesim.scenes.generation.generate import generate
    from spacesim.scenes.scenefile import read_scene

    size = {"resolution": (32, 32), "spp": 8, "points": 400}
    scene = read_scene("boxsat", suns=2, views=5, test_suns=1, test_views=2, **size)
    return generate(scene, tmp_path_factory.mktemp("lit") / "data")


@pytest.fixture(scope="module")
def meshed(small_dataset, tmp_path_factory):
    """The small dataset with a ball about its Gaussians as mesh."""
    path = tmp_path_factory.mktemp("mesh") / "mesh.ply"
    trimesh.creation.icosphere(3, 0.75).export(path)
    return replace(small_dataset, mesh_path=str(path))
