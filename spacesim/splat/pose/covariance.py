"""How sure a refined pose is."""

import numpy as np

from spacesim.data.geometry import Array
from spacesim.splat.pose.picture import smoothed
from spacesim.splat.pose.solver import STEP, PyramidLevel, State, cauchy_weights, damped, weighed_products

SMOOTHING = 0.08  #: of the model's apparent radius: errors are smoothed so far, against noise, for what is next
WIDE = 4.0  #: steps to either side for the covariance's: jumps of pictures, as of order in depth, look like knowledge
BLOCK = 8  #: pixels: errors within a square of this side may depend on each other
ROUNDING = 1 / 255 / np.sqrt(12)  #: standard deviation of sRGB values of 8 bits


def uncertainty(level: PyramidLevel, state: State) -> tuple[Array, float, float]:
    """Covariance [6, 6] and root mean square error, see `RefinedPose`; and the shift whose smoothed errors
    are as large, as a share of the model's radius."""
    colors = level.shade(state.camera)
    picture = level.picture(state.camera, colors)
    errors = level.errors(picture, state.gain)
    columns = level.derivatives(state.camera, picture, colors, state.gain, WIDE)
    weights = cauchy_weights(errors, level.outlier)
    scores, normals = sums_of_blocks(columns, errors, weights)
    normal = damped(normals.sum(axis=0), 0.0)
    left_out = np.linalg.solve(normal - normals, scores[..., None])[..., 0]  # by how much it moves without a block
    inverse = np.linalg.inv(normal)
    rounding = inverse @ weighed_products(columns, columns, weights * weights) @ inverse
    twists = level.twists(state.camera)
    covariance = twists @ (left_out.T @ left_out + ROUNDING**2 * rounding)[:6, :6] @ twists.T
    inside = weights * (picture[..., 3] > 1 / 255)
    error = np.sqrt((inside * (errors * errors).mean(axis=-1)).sum() / max(inside.sum(), 1e-12))
    pixel = level.units(state.camera)[3] / STEP / level.pivot.radius
    roots = np.sqrt(weights)[..., None]
    soft = [smoothed(roots * planes, SMOOTHING / pixel) for planes in (errors, *columns[3:5])]
    squares = [float((planes * planes).sum(dtype=np.float64)) for planes in soft]
    shift = STEP * pixel * np.sqrt(2 * squares[0] / max(squares[1] + squares[2], 1e-12))
    return 0.5 * (covariance + covariance.T), float(error), float(shift)


def sums_of_blocks(columns: np.ndarray, errors: np.ndarray, weights: np.ndarray) -> tuple[Array, Array]:
    """([B, I] weighed sums of products of columns [I, h, w, C] and errors [h, w, C], [B, I, I] of columns with each
    other) over squares of `BLOCK` pixels."""
    starts = np.arange(0, errors.shape[1], BLOCK)
    scores: list[Array] = []
    normals: list[Array] = []
    for top in range(0, errors.shape[0], BLOCK):
        band = np.s_[top : top + BLOCK]
        weighed = columns[:, band] * weights[band, :, None]
        for rows, sums in (
            (scores, np.einsum("ihwc,hwc->wi", weighed, errors[band], dtype=np.float64)),
            (normals, np.einsum("ihwc,jhwc->wij", weighed, columns[:, band], dtype=np.float64)),
        ):
            rows.append(np.add.reduceat(sums, starts, axis=0))
    return np.concatenate(scores), np.concatenate(normals)
