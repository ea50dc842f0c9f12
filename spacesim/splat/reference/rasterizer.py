"""The slow twin: the same maths as `render`, dense, in float64 numpy, one Gaussian after another. For tests.

It shares no code with the kernels: covariances are formed as matrices (2.10 to 2.13), spherical harmonics come from
associated Legendre functions, every Gaussian is tried on every pixel.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import factorial, lpmv

from spacesim.data.geometry import rotation_from_quaternion
from spacesim.data.records import Camera
from spacesim.splat.raster.cameras import OrthographicCamera

DILATION, PIXEL = 0.3, 1 / 12  #: pixels^2 added to covariances, and to those of anti-aliased splats


@dataclass(frozen=True, eq=False)
class ReferenceOutput:
    """The planes of `RenderOutput`, float64."""

    color: np.ndarray  #: [H, W, 3] over black
    alpha: np.ndarray  #: [H, W]
    depth: np.ndarray  #: [H, W] expected depth, metres
    median_depth: np.ndarray  #: [H, W] metres
    normal: np.ndarray  #: [H, W, 3] unit, or 0
    features: np.ndarray  #: [H, W, C]


def render_reference(
    gaussians: Mapping[str, np.ndarray],
    camera: Camera | OrthographicCamera,
    sh_degree: int = 3,
    features: np.ndarray | None = None,
    antialiased: bool = False,
) -> ReferenceOutput:
    """Render `Gaussians.to_numpy()`-like arrays: means [N, 3], log_scales [N, 3], quaternions [N, 4],
    logit_opacities [N], sh [N, K, 3]; features [N, C]."""
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in gaussians.items()}
    perspective = isinstance(camera, Camera)
    R, t = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    centers = arrays["means"] @ R.T + t
    opacity = 1 / (1 + np.exp(-arrays["logit_opacities"]))
    feature_rows = np.zeros((len(centers), 0)) if features is None else np.asarray(features, dtype=np.float64)
    directions = _directions(arrays["means"], camera)
    blended = np.concatenate(
        [_colors(arrays["sh"], directions, sh_degree), centers[:, 2:], _normals(arrays, directions), feature_rows],
        axis=1,
    )
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)

    sums = np.zeros((camera.height, camera.width, blended.shape[1]))
    median_depth = np.zeros((camera.height, camera.width))
    transmittance = np.ones((camera.height, camera.width))
    finished = np.zeros((camera.height, camera.width), bool)
    for i in np.argsort(centers[:, 2], kind="stable"):
        if perspective and centers[i, 2] <= 0.01:
            continue
        (x, y), J = _linearize(centers[i], camera)
        axes = rotation_from_quaternion(arrays["quaternions"][i])
        covariance = J @ R @ axes @ np.diag(np.exp(2 * arrays["log_scales"][i])) @ axes.T @ R.T @ J.T
        dilated = covariance + (PIXEL if antialiased else DILATION) * np.eye(2)
        share = np.sqrt(np.linalg.det(covariance) / np.linalg.det(dilated)) if antialiased else 1.0
        inverse = np.linalg.inv(dilated)
        dx, dy = columns - x, rows - y
        squared = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        alpha = np.minimum(opacity[i] * share * np.exp(-0.5 * squared), 0.999)
        alpha[alpha < 1 / 255] = 0
        finished |= transmittance * (1 - alpha) <= 1e-4  # which the splat that does it has no part in
        alpha[finished] = 0
        sums += (alpha * transmittance)[..., None] * blended[i]
        behind = transmittance * (1 - alpha)
        median_depth[(transmittance >= 0.5) & (behind < 0.5)] = centers[i, 2]
        transmittance = behind
    alpha, normal = 1 - transmittance, sums[..., 4:7]
    return ReferenceOutput(
        color=sums[..., :3],
        alpha=alpha,
        depth=sums[..., 3] / np.where(alpha > 0, alpha, 1),
        median_depth=median_depth,
        normal=normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12),
        features=sums[..., 7:],
    )


def _linearize(center: np.ndarray, camera: Camera | OrthographicCamera) -> tuple[tuple[float, float], np.ndarray]:
    """((x, y) in pixels, Jacobian [2, 3] in pixels per metre) of a point [3] in camera axes."""
    x, y, z = center
    if isinstance(camera, OrthographicCamera):
        J = np.array([[camera.scale_x, 0, 0], [0, camera.scale_y, 0]])
        return (camera.scale_x * x + camera.cx, camera.scale_y * y + camera.cy), J
    right, bottom = (camera.width - camera.cx) / camera.fx, (camera.height - camera.cy) / camera.fy
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    u = np.clip(x / z, -camera.cx / camera.fx - margin_x, right + margin_x)
    v = np.clip(y / z, -camera.cy / camera.fy - margin_y, bottom + margin_y)
    J = np.array([[camera.fx, 0, -camera.fx * u], [0, camera.fy, -camera.fy * v]]) / z
    return (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), J


def _directions(means: np.ndarray, camera: Camera | OrthographicCamera) -> np.ndarray:
    """[N, 3] unit, world axes: from the camera to the Gaussians."""
    if isinstance(camera, OrthographicCamera):
        return np.tile(camera.world_from_camera[:3, 2], (len(means), 1))
    offset = means - camera.position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


def _colors(sh: np.ndarray, directions: np.ndarray, sh_degree: int) -> np.ndarray:
    """[N, 3] colours at least 0."""
    terms = min((sh_degree + 1) ** 2, sh.shape[1])
    basis = real_spherical_harmonics(directions, sh_degree)[:, :terms]
    return np.maximum(np.einsum("nk,nkc->nc", basis, sh[:, :terms]) + 0.5, 0)


def _normals(arrays: Mapping[str, np.ndarray], directions: np.ndarray) -> np.ndarray:
    """[N, 3] shortest axes, against the direction of view."""
    axes = rotation_from_quaternion(arrays["quaternions"])
    shortest = axes[np.arange(len(axes)), :, np.argmin(arrays["log_scales"], axis=1)]
    return np.asarray(shortest * np.where((shortest * directions).sum(axis=1, keepdims=True) > 0, -1, 1))


def real_spherical_harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """[N, (degree + 1)^2] real orthonormal basis with the Condon-Shortley phase, ordered l then m = -l .. l."""
    azimuth, cosine = np.arctan2(directions[:, 1], directions[:, 0]), directions[:, 2]
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            scale = np.sqrt((2 * n + 1) / (4 * np.pi) * factorial(n - k) / factorial(n + k))
            value = scale * lpmv(k, n, cosine)
            if m != 0:
                value = value * np.sqrt(2) * (np.cos(k * azimuth) if m > 0 else np.sin(k * azimuth))
            columns.append(value)
    return np.stack(columns, axis=1)
