"""One small field for all tests of radiance fields."""

import pytest
from small_field import CONFIG

from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.nerf.run import NerfRun
from spacesim.nerf.train.train import train


@pytest.fixture(scope="session")
def dataset(tiny_data) -> Dataset:
    return read_dataset(tiny_data)


@pytest.fixture(scope="session")
def finished(dataset, tmp_path_factory) -> NerfRun:
    """Trained on `dataset` with `CONFIG`."""
    return train(dataset, tmp_path_factory.mktemp("nerf") / "run", CONFIG)
