"""Tables of what the Sun gives each Gaussian, against the light that they are of."""

from types import SimpleNamespace

import numpy as np
import pytest

from spacesim.backend.upload import upload
from spacesim.splat.export.html import sunlight
from spacesim.splat.export.html.sunlight import BOUNCE_SIDE, octahedral_directions, tabulate_sunlight
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.gaussians import Gaussians

COUNT = 40


class SmoothLight:
    """Light that changes little from Sun to Sun, and says for how many it was asked."""

    def __init__(self, shadow: bool) -> None:
        self.config = SimpleNamespace(shadow=shadow or None, bounce=8, albedos=0, specular=None, sunlit_white=1.0)
        self.slopes = np.random.default_rng(1).uniform(-1, 1, (COUNT, 6, 3))
        self.asked = 0

    def bounced(self, sun: np.ndarray) -> np.ndarray:
        """[N, 6]: few components make its square root."""
        return (3 + self.slopes @ sun) ** 2

    def visibility(self, _gaussians: Gaussians, sun: np.ndarray):
        return upload((self.slopes[:, 0] @ sun > 0).astype(np.float32)) if self.config.shadow else None

    def sunlight(self, gaussians: Gaussians, sun: np.ndarray) -> Sunlight:
        self.asked += 1
        return Sunlight(self.visibility(gaussians, sun), [upload(row) for row in self.bounced(sun).T])


@pytest.mark.parametrize(("side", "shadow", "asked"), [(32, True, 256), (16, True, 256), (32, False, 64)])
def test_tables_are_of_the_light_under_each_sun(monkeypatch, side, shadow, asked):
    monkeypatch.setattr(sunlight, "SIDE", side)
    arrays = Gaussians.random(COUNT, 1.0, 0.1).to_numpy()
    gaussians = Gaussians.from_numpy({**arrays, "features": np.zeros((COUNT, 3))})
    light = SmoothLight(shadow)
    tables = tabulate_sunlight(gaussians, light, lambda: None)
    assert (tables.side, light.asked) == (side if shadow else BOUNCE_SIDE, asked)

    suns = octahedral_directions(tables.side)
    blocks = tables.side // BOUNCE_SIDE
    every = np.stack([light.bounced(sun) for sun in suns]).reshape(BOUNCE_SIDE, blocks, BOUNCE_SIDE, blocks, COUNT, 6)
    expected = np.sqrt(0.5 * every.mean(axis=(1, 3)).reshape(BOUNCE_SIDE**2, -1))  # an albedo of 1/2
    found = tables.bounce_table @ tables.bounce.reshape(len(tables.bounce), -1) / 127
    np.testing.assert_allclose(found, expected, atol=0.03)
    if shadow:
        levels = np.stack([tables.visibility & 15, tables.visibility >> 4], axis=-1).reshape(COUNT, -1)
        np.testing.assert_array_equal(levels, 15 * (light.slopes[:, 0] @ suns.T > 0))
