"""Pictures and losses by our rasterizer and by its twin, the float64 reference, for tests and `accuracy.py`."""

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.cameras import OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import render
from spacesim.splat.reference.rasterizer import render_reference

KINDS = ("perspective", "orthographic")
POSE = look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0])
PLANES = ("color", "alpha", "depth", "normal", "features")


def record(kind: str, width: int = 40, height: int = 28, pose=POSE) -> Camera | OrthographicCamera:
    if kind == "perspective":
        return Camera(pose, width, height, 1.3 * width, 1.2 * width, 0.52 * width, 0.47 * height)
    return OrthographicCamera(pose, width, height, 0.55 * width, 0.6 * width, 0.52 * width, 0.47 * height)


def wide_splats() -> dict[str, np.ndarray]:
    """Five half-transparent splats wider than the picture: no cut-off and no clamped colour within a step's reach."""
    rng = np.random.default_rng(7)
    sh = rng.normal(size=(5, 16, 3)) * 0.04
    sh[:, 0] = rng.uniform(0.2, 0.8, (5, 3))
    return {
        "means": np.array([[0.3, 0.05, 0.0], [0.0, -0.2, 0.1], [-0.3, 0.15, -0.1], [-0.6, 0, 0.05], [-0.9, 0.1, 0.1]]),
        "log_scales": np.log(rng.uniform(0.7, 1.3, (5, 3))),
        "quaternions": rng.normal(size=(5, 4)),
        "logit_opacities": np.array([-0.4, 0.2, -0.8, 0.5, 0.1]),
        "sh": sh,
    }


def own_features(count: int) -> np.ndarray:
    return np.random.default_rng(9).normal(size=(count, 2))


def weights(size: int) -> list[np.ndarray]:
    """One for each plane of `flat`."""
    return list(np.random.default_rng(3).normal(size=(10, size)))


def flat(output) -> list:
    """Planes of an output of the twin: r, g, b, alpha, depth, normal (3), features (2)."""
    columns = [np.atleast_3d(getattr(output, name)) for name in PLANES]
    return [plane.ravel() for column in columns for plane in np.moveaxis(column, -1, 0)]


def twin_loss(arrays, view, features, **options) -> float:
    planes = flat(render_reference(arrays, view, features=features, **options))
    return float(sum(w @ p for w, p in zip(weights(planes[0].size), planes, strict=True)))


def our_loss(gaussians, camera, features, **options):
    outputs = [name for name in PLANES if name != "features"]
    output = render(gaussians, camera, outputs=outputs, features=features, **options)
    planes = [*output.color, output.alpha, output.depth, *output.normal, *output.features]
    loss = ad.Float(0)
    for weight, plane in zip(weights(camera.width * camera.height), planes, strict=True):
        loss += dr.sum(upload(weight.astype(np.float32)) * plane)
    return loss


def columns_of(features: np.ndarray) -> list:
    return [upload(np.ascontiguousarray(column, dtype=np.float32)) for column in features.T]


def slope(function, values: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of a scalar function of an array."""
    result = np.empty(values.shape)
    for index in np.ndindex(values.shape):
        ends = []
        for sign in (1, -1):
            moved = np.array(values, dtype=np.float64)
            moved[index] += sign * step
            ends.append(function(moved))
        result[index] = (ends[0] - ends[1]) / (2 * step)
    return result


def picture(arrays, camera, names=("color", "alpha", "depth"), **options) -> dict[str, np.ndarray]:
    output = render(Gaussians.from_numpy(arrays), camera, outputs=names, **options)
    return {name: output.image(name) for name in names}
