"""A dataset with a lens, whose objects hide each other and are cut off."""

from pathlib import Path

import pytest

from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.scenes.config import ObjectConfig, SceneConfig, with_options
from spacesim.scenes.generation.generate import generate

LENS = (-0.25, 0.08, 0.002, -0.001, 0.0)


@pytest.fixture(scope="session")
def three_objects() -> SceneConfig:
    """Two boxsats and a cubesat that hide each other."""
    objects = (
        ObjectConfig(spacecraft="boxsat"),
        ObjectConfig(spacecraft="cubesat", position=(2.0, 1.0, 2.0), rotation_wxyz=(0.8, 0.1, -0.5, 0.3), scale=2.0),
        ObjectConfig(spacecraft="boxsat", name="twin", position=(-3.0, -3.0, -3.0)),
    )
    return with_options(SceneConfig("three", objects), spp=1, points=50, fov_deg=40.0, distance=9.0)


@pytest.fixture(scope="session")
def labelled(three_objects, tmp_path_factory) -> Dataset:
    """`three_objects`, 3 training and 1 test view of 160 x 120 pixels."""
    options = {"views": 3, "test_views": 1, "resolution": (160, 120), "distortion": LENS}
    root: Path = tmp_path_factory.mktemp("labelled") / "data"
    generate(with_options(three_objects, **options), root)
    return read_dataset(root)
