"""The figure of docs/research/geometry.md on flat discs: python tests/splat/raster/disc_outlines.py RUN DATA    seconds

Discs are projected as flat Gaussians, to first order about their centres (EWA, Zwicker et al. 2002). Where a ray meets
a disc (2DGS, Huang et al. 2024) differs from that by how much perspective bends its outline. Prints by how much, in
pixels, for the discs of a trained run in all held-out views.
"""

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from spacesim.data.records import Camera
from spacesim.data.store import read_dataset
from spacesim.splat.run import load_run

SHARES = 50, 90, 99, 100
SPREAD = 2  #: standard deviations of an outline
ANGLES = np.linspace(0, 2 * np.pi, 256, endpoint=False)


def displacements(means: np.ndarray, axes: np.ndarray, camera: Camera) -> np.ndarray:
    """Float [K], pixels: the most by which a disc's outline at `SPREAD` deviations moves across itself from the flat
    projection to the exact one, of those whose centres are in the picture and that lie before the camera as a whole.

    means: float [N, 3], metres;  axes: float [N, 2, 3], metres, both of a disc, one deviation long
    """
    turn, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    centre, axes = means @ turn.T + shift, axes @ turn.T
    offset = SPREAD * np.einsum("ak,nkx->nax", np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1), axes)
    ahead = (centre[:, None] + offset)[..., 2].min(axis=1) > 0
    centre, offset = centre[ahead], offset[ahead]
    focal, size = np.array([camera.fx, camera.fy]), np.array([camera.width, camera.height])
    middle = focal * centre[:, :2] / centre[:, 2:] + np.array([camera.cx, camera.cy])
    inside = ((middle > 0) & (middle < size)).all(axis=1)
    centre, offset = centre[inside, None], offset[inside]
    flat = focal * (offset[..., :2] - centre[..., :2] * offset[..., 2:] / centre[..., 2:]) / centre[..., 2:]
    bent = centre + offset
    moved = focal * (bent[..., :2] / bent[..., 2:] - centre[..., :2] / centre[..., 2:]) - flat
    along = np.roll(flat, -1, axis=1) - np.roll(flat, 1, axis=1)
    across = np.stack([-along[..., 1], along[..., 0]], -1) / np.maximum(np.linalg.norm(along, axis=-1), 1e-9)[..., None]
    return np.abs((moved * across).sum(axis=-1)).max(axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="with discs (`surfels`)")
    parser.add_argument("data", help="dataset whose held-out views are taken")
    options = parser.parse_args()
    arrays, views = load_run(options.run).gaussians.to_numpy(), read_dataset(options.data).test
    axes = axes_of(arrays["quaternions"], np.exp(arrays["log_scales"]))
    found = np.concatenate([displacements(arrays["means"], axes, frame.camera) for frame in views])
    print(f"{len(found)} outlines: " + ", ".join(f"{share} % by {np.percentile(found, share):.3f}" for share in SHARES))


def axes_of(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Float [N, 2, 3]: the second and the third axis of discs, whose normal is the first. quaternions: [N, 4], real
    part first;  scales: [N, 3]"""
    columns = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    return np.moveaxis(scales[:, None, 1:] * columns[:, :, 1:], 1, 2)


if __name__ == "__main__":
    main()
