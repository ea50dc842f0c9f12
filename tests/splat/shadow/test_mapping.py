"""Shadow mapping: hand-placed blockers, the float64 twin, walls under every Sun, hostile input, repeatability."""

import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad
from spacesim.data.geometry import look_at
from spacesim.splat.cameras import Orthographic, OrthographicCamera
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.shadow.reference import camera_record, reference_bias, reference_occlusion
from spacesim.splat.shadow.sunlight import fit_camera, light_rows

CONFIGS = {
    "bilinear": MappingConfig(),
    "closer": MappingConfig("percentage-closer", radius=1.3),
    "penumbra": MappingConfig("percentage-closer", sun_radius_deg=4.0, widest=5.0),
    "variance": MappingConfig("variance", radius=1.0),
}
SOFTNESS = 1e-3


def splats(means, scales, opacities=0.99, quaternions=(1, 0, 0, 0)):
    means = np.atleast_2d(np.asarray(means, dtype=float))
    count = len(means)
    opacities = np.broadcast_to(np.asarray(opacities, dtype=float), count)
    return {
        "means": means,
        "log_scales": np.log(np.broadcast_to(np.asarray(scales, dtype=float), (count, 3))),
        "quaternions": np.broadcast_to(np.asarray(quaternions, dtype=float), (count, 4)).copy(),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh": np.zeros((count, 1, 3)),
    }


def joined(*sets):
    return {name: np.concatenate([one[name] for one in sets]) for name in sets[0]}


def from_above(size=64, metres=2.0):
    """A light camera for a Sun overhead, centred on the origin."""
    pose = look_at([0, 0, 0], [0, 0, -1])
    return Orthographic.of(OrthographicCamera.from_extent(pose, size, size, metres))


def occlusion(arrays, camera, bias=None, softness=SOFTNESS, config=None):
    bias = np.zeros(len(arrays["means"])) if bias is None else bias
    found = occlusion_by_mapping(Gaussians.from_numpy(arrays), camera, ad.Float(bias), softness, config)
    return np.array(found)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("sun", [[0.3, -0.5, 0.8], [0, 0, -1]], ids=str)
def test_equals_the_twin(name, sun):
    """Softness as wide as gaps are: no test may flip by rounding."""
    arrays = random_splats(80, seed=1)
    camera = fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 32)
    bias = 0.1 * reference_bias(arrays, np.asarray(sun) / np.linalg.norm(sun))["bias"]
    found = occlusion(arrays, camera, bias, 0.05, CONFIGS[name])
    expected = reference_occlusion(arrays, camera_record(camera), bias, 0.05, CONFIGS[name])
    assert found == pytest.approx(expected, abs=2e-4)
    assert 0.1 < expected.mean() < 0.9


@pytest.mark.parametrize("name", CONFIGS)
def test_full_and_none(name):
    """A plate of 0.3 m half a metre above one of two receivers."""
    arrays = joined(splats([[-0.6, 0, 0.5]], [0.3, 0.3, 0.001]), splats([[-0.6, 0, 0], [0.6, 0, 0]], 0.02))
    plate, shadowed, lit = occlusion(arrays, from_above(), [0.01] * 3, config=CONFIGS[name])
    assert shadowed > 0.97
    assert lit < 0.01
    assert plate < 0.01
