"""The slow twin of shadow splatting: every receiver against every blocker on every pixel, in float64 numpy. For tests.

It sorts nothing, walks no lists and ends no pixel early: the products of 4.8 are formed as the thesis writes them.
"""

from collections.abc import Mapping

import numpy as np

from spacesim.data.geometry import rotation_from_quaternion
from spacesim.splat.light.shadow.splatting import BETA_MIN
from spacesim.splat.raster.cameras import OrthographicCamera
from spacesim.splat.reference.rasterizer import DILATION, PIXEL

ALPHA_MIN, ALPHA_MAX = 1 / 255, 0.999


def occlusion_reference(
    gaussians: Mapping[str, np.ndarray],
    camera: OrthographicCamera,
    bias: np.ndarray,
    beta_min: float = BETA_MIN,
    antialiased: bool = False,
    points: np.ndarray | None = None,
) -> np.ndarray:
    """[N] float64 in [0, 1]: `occlusion_by_splatting` of `Gaussians.to_numpy()`-like arrays; bias [N] metres;
    points [N, 3] where the receivers are, if not at the means."""
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in gaussians.items() if name != "sh"}
    R, t = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    centers = arrays["means"] @ R.T + t
    falloff, share = _footprints(arrays, centers, R, camera, PIXEL if antialiased else DILATION)
    opacity = share if antialiased else 1.0
    opacity = opacity / (1 + np.exp(-arrays["logit_opacities"]))
    alpha = np.minimum(opacity[:, None] * falloff, ALPHA_MAX)
    passed = np.log1p(-np.where(alpha >= ALPHA_MIN, alpha, 0))  # [N, P], ln(1 - alpha)
    received = centers if points is None else points @ R.T + t
    if points is not None or antialiased:
        falloff, _ = _footprints(arrays, received, R, camera, DILATION)
    beta = np.where(falloff >= beta_min, falloff, 0)
    occlusion = np.zeros(len(centers))
    for i, depth in enumerate(received[:, 2]):
        before = depth - centers[:, 2] - bias[i] > 0
        if beta[i].any():
            occlusion[i] = (beta[i] * -np.expm1(passed[before].sum(axis=0))).sum() / beta[i].sum()
    return occlusion


def _footprints(
    arrays: Mapping[str, np.ndarray], centers: np.ndarray, R: np.ndarray, camera: OrthographicCamera, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """(exp(-d^T Sigma^-1 d / 2) [N, H W] at the pixel centres (4.7), sqrt(det Sigma / det(Sigma + spread I)) [N])."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    J = np.diag([camera.scale_x, camera.scale_y]) @ R[:2]
    falloff, share = np.zeros((len(centers), columns.size)), np.zeros(len(centers))
    for i, center in enumerate(centers):
        axes = rotation_from_quaternion(arrays["quaternions"][i])
        covariance = J @ axes @ np.diag(np.exp(2 * arrays["log_scales"][i])) @ axes.T @ J.T
        dilated = covariance + spread * np.eye(2)
        inverse = np.linalg.inv(dilated)
        dx = columns.ravel() - (camera.scale_x * center[0] + camera.cx)
        dy = rows.ravel() - (camera.scale_y * center[1] + camera.cy)
        squared = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        falloff[i] = np.exp(-0.5 * squared)
        share[i] = np.sqrt(max(np.linalg.det(covariance), 0) / np.linalg.det(dilated))
    return falloff, share
