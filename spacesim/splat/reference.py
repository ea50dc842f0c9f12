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


@dataclass(frozen=True, eq=False)
class ReferenceOutput:
    """colour [H, W, 3] over black, alpha [H, W], depth [H, W] expected depth in metres, 0 where alpha is 0."""

    colour: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


def render_reference(gaussians: Mapping[str, np.ndarray], camera: Camera, sh_degree: int = 3) -> ReferenceOutput:
    """Render `Gaussians.to_numpy()`-like arrays: means [N, 3], log_scales [N, 3], quaternions [N, 4],
    logit_opacities [N], sh [N, K, 3]."""
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in gaussians.items()}
    R, t = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    centers = arrays["means"] @ R.T + t
    opacity = 1 / (1 + np.exp(-arrays["logit_opacities"]))
    colours = _colours(arrays, camera, sh_degree)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)

    colour = np.zeros((camera.height, camera.width, 3))
    weighted_depth = np.zeros((camera.height, camera.width))
    transmittance = np.ones((camera.height, camera.width))
    for i in np.argsort(centers[:, 2], kind="stable"):
        x, y, z = centers[i]
        if z <= 0.01:
            continue
        covariance = _screen_covariance(arrays["quaternions"][i], arrays["log_scales"][i], centers[i], R, camera)
        inverse = np.linalg.inv(covariance)
        dx, dy = columns - (camera.fx * x / z + camera.cx), rows - (camera.fy * y / z + camera.cy)
        squared = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * squared), 0.999)
        alpha[(alpha < 1 / 255) | (transmittance <= 1e-4)] = 0
        weight = alpha * transmittance
        colour += weight[..., None] * colours[i]
        weighted_depth += weight * z
        transmittance *= 1 - alpha
    alpha = 1 - transmittance
    return ReferenceOutput(colour, alpha, weighted_depth / np.where(alpha > 0, alpha, 1))


def _screen_covariance(
    quaternion: np.ndarray, log_scales: np.ndarray, center: np.ndarray, R: np.ndarray, camera: Camera
) -> np.ndarray:
    """[2, 2] pixels^2: K J R Sigma R^T J^T K^T + 0.3 I."""
    axes = rotation_from_quaternion(quaternion)
    covariance = R @ axes @ np.diag(np.exp(2 * log_scales)) @ axes.T @ R.T
    x, y, z = center
    right, bottom = (camera.width - camera.cx) / camera.fx, (camera.height - camera.cy) / camera.fy
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    u = np.clip(x / z, -camera.cx / camera.fx - margin_x, right + margin_x)
    v = np.clip(y / z, -camera.cy / camera.fy - margin_y, bottom + margin_y)
    J = np.array([[camera.fx, 0, -camera.fx * u], [0, camera.fy, -camera.fy * v]]) / z
    return J @ covariance @ J.T + 0.3 * np.eye(2)


def _colours(arrays: Mapping[str, np.ndarray], camera: Camera, sh_degree: int) -> np.ndarray:
    """[N, 3] colours at least 0, from directions camera to Gaussian."""
    offset = arrays["means"] - camera.position
    directions = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    terms = min((sh_degree + 1) ** 2, arrays["sh"].shape[1])
    basis = real_spherical_harmonics(directions, sh_degree)[:, :terms]
    return np.maximum(np.einsum("nk,nkc->nc", basis, arrays["sh"][:, :terms]) + 0.5, 0)


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
