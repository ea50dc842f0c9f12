"""The slow twins of light camera, bias and shadow mapping: float64 numpy, one receiver after another. For tests.

They share no code with the kernels: covariances are matrices, windows are measured pixel by pixel.
"""

from collections.abc import Mapping

import numpy as np

from spacesim.data.geometry import Array, rotation_from_quaternion
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.reference.rasterizer import ReferenceOutput, render_reference


def camera_record(camera: Orthographic) -> OrthographicCamera:
    """A fitted camera as a record, in float64: what the twins and other tools read."""
    values = np.array(camera.values, dtype=np.float64)
    pose = np.eye(4)
    pose[:3] = values[:12].reshape(3, 4)
    scale_x, scale_y, cx, cy, left, top = values[12:]
    inverse = np.asarray(np.linalg.inv(pose), dtype=np.float64)
    return OrthographicCamera(inverse, camera.width, camera.height, scale_x, scale_y, cx - left, cy - top)


def covariances(gaussians: Mapping[str, np.ndarray]) -> Array:
    """[N, 3, 3] metres^2, world axes (thesis 2.7)."""
    axes = rotation_from_quaternion(np.asarray(gaussians["quaternions"], np.float64))
    variances = np.exp(2 * np.asarray(gaussians["log_scales"], np.float64))
    return np.asarray(np.einsum("nij,nj,nkj->nik", axes, variances, axes))


def reference_bounds(gaussians: Mapping[str, np.ndarray], axes: Array, reach: float) -> Array:
    """[2, 2] metres: (low, high) of the image in light x and y, in world-centred light space (thesis 4.30 to 4.34).

    axes: [3, 3] of `light_axes`;  reach: standard deviations of the whole that the bounds may span to a side.
    """
    across = np.asarray(gaussians["means"], np.float64) @ axes[:, :2]
    variance = np.einsum("ji,njk,ki->ni", axes[:, :2], covariances(gaussians), axes[:, :2])
    middle = across.mean(axis=0)
    limit = reach * np.sqrt(((across - middle) ** 2 + variance).mean(axis=0))
    low = np.maximum((across - 3 * np.sqrt(variance)).min(axis=0), middle - limit)
    high = np.minimum((across + 3 * np.sqrt(variance)).max(axis=0), middle + limit)
    return np.stack([low, high], axis=1)


def reference_bias(gaussians: Mapping[str, np.ndarray], sun: Array, strength: float = 10.0) -> dict[str, Array]:
    """thickness, alignment, confidence and bias [N] (thesis 4.22 to 4.26): sigma^l = sqrt(s^T Sigma s), and the normal
    as the eigenvector of the least eigenvalue."""
    thickness = np.sqrt(np.einsum("i,nij,j->n", sun, covariances(gaussians), sun))
    scales = np.exp(np.asarray(gaussians["log_scales"], np.float64))
    normals = np.linalg.eigh(covariances(gaussians))[1][:, :, 0]
    alignment = np.abs(normals @ sun)
    confidence = 1 - scales.min(axis=1) / scales.max(axis=1)
    bias = strength * thickness * alignment * confidence
    return {"thickness": thickness, "alignment": alignment, "confidence": confidence, "bias": bias}


def reference_occlusion(
    gaussians: Mapping[str, np.ndarray],
    camera: OrthographicCamera,
    bias: Array,
    softness: float,
    config: MappingConfig | None = None,
) -> Array:
    """[N] raw occlusion, the twin of `occlusion_by_mapping`."""
    config = config or MappingConfig()
    pose = camera.camera_from_world
    centers = np.asarray(gaussians["means"], np.float64) @ pose[:3, :3].T + pose[:3, 3]
    if config.filter == "median":
        return _median(gaussians, camera, bias, softness, config)
    depths2 = centers[:, 2:] ** 2
    picture = render_reference(gaussians, camera, sh_degree=0, features=depths2, antialiased=config.antialiased)
    occlusion = np.zeros(len(centers))
    for i, (x, y, z) in enumerate(centers * [camera.scale_x, camera.scale_y, 1] + [camera.cx, camera.cy, 0]):
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            continue
        receiver = z - bias[i]
        if config.filter == "bilinear":
            share = _shares(x, y, 0.5, 0.5, camera) * (picture.alpha > 0)
            mean = (share * picture.depth).sum() / max(share.sum(), 1e-300)
            occlusion[i] = _shadowed(mean - receiver, softness) if share.sum() > 0 else 0
        elif config.filter == "variance":
            share = _shares(x, y, config.radius, config.radius, camera)
            occlusion[i] = _variance(picture, share, receiver, softness, config)
        else:
            occlusion[i] = _closer(picture, (x, y), receiver, softness, config, camera)
    return occlusion


def _median(
    gaussians: Mapping[str, np.ndarray], camera: OrthographicCamera, bias: Array, softness: float, config: MappingConfig
) -> Array:
    """[N]: tests against where half of the light is gone, averaged over the window. A Gaussian's surface on a ray is
    where its density peaks, the mean of z given x and y of its normal distribution, within two of its longest standard
    deviations of its centre."""
    pose = camera.camera_from_world
    places = np.asarray(gaussians["means"], np.float64) @ pose[:3, :3].T + pose[:3, 3]
    spreads = pose[:3, :3] @ covariances(gaussians) @ pose[:3, :3].T
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (columns - camera.cx) / camera.scale_x, (rows - camera.cy) / camera.scale_y
    surface, behind, nearest = np.zeros(x.shape), np.ones(x.shape), np.argsort(places[:, 2], kind="stable")
    for i in nearest:
        gaussian = {name: np.asarray(values)[i : i + 1] for name, values in gaussians.items()}
        alpha = render_reference(gaussian, camera, sh_degree=0, antialiased=config.antialiased).alpha
        slope = np.linalg.solve(spreads[i][:2, :2], spreads[i][:2, 2])
        reach = 2 * np.exp(np.asarray(gaussians["log_scales"])[i].max())
        offset = (x - places[i, 0]) * slope[0] + (y - places[i, 1]) * slope[1]
        ends = (behind >= 0.5) & (behind * (1 - alpha) < 0.5)
        surface[ends] = places[i, 2] + np.clip(offset, -reach, reach)[ends]
        behind *= 1 - alpha
    gone, occlusion = behind < 0.5, np.zeros(len(places))
    for i, (u, v, z) in enumerate(places * [camera.scale_x, camera.scale_y, 1] + [camera.cx, camera.cy, 0]):
        if 0 <= u < camera.width and 0 <= v < camera.height:
            tests = gone * _shadowed(surface - (z - bias[i]), softness)
            occlusion[i] = (_shares(u, v, config.radius, config.radius, camera) * tests).sum() / (4 * config.radius**2)
    return occlusion


def _closer(
    picture: ReferenceOutput,
    at: tuple[float, float],
    receiver: float,
    softness: float,
    config: MappingConfig,
    camera: OrthographicCamera,
) -> float:
    blocked = picture.alpha * _shadowed(picture.depth - receiver, softness)
    share = _shares(*at, config.radius, config.radius, camera)
    return float((share * blocked).sum() / (4 * config.radius**2))


def _variance(picture: ReferenceOutput, share: Array, receiver: float, softness: float, config: MappingConfig) -> float:
    covered = (share * picture.alpha).sum()
    if covered == 0:
        return 0.0
    mean = (share * picture.alpha * picture.depth).sum() / covered
    variance = max((share * picture.features[..., 0]).sum() / covered - mean**2, softness**2)
    passes = variance / (variance + max(receiver - mean, 0) ** 2)
    passes = np.clip((passes - config.bleeding) / (1 - config.bleeding), 0, 1)
    return float((1 - passes) * covered / (4 * config.radius**2))


def _shadowed(gap: Array, softness: float) -> Array:
    return 1 / (1 + np.exp(np.clip(gap / softness, -60, 60)))


def _shares(x: float, y: float, half_x: float, half_y: float, camera: OrthographicCamera) -> Array:
    """[H, W]: how much of each pixel the box (x +- half_x, y +- half_y) covers."""
    columns = np.clip(np.arange(camera.width + 1), x - half_x, x + half_x)
    rows = np.clip(np.arange(camera.height + 1), y - half_y, y + half_y)
    return np.asarray(np.outer(np.diff(rows), np.diff(columns)))
