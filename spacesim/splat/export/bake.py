"""A relightable model under one Sun as plain Gaussians with spherical harmonics, which every splat viewer draws."""

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.tone import tone_map

VIEWS = 64  #: directions that the harmonics are fitted to, four times as many as degree 3 has terms


def bake(
    gaussians: Gaussians, light: LightModel, sun: np.ndarray | None, degree: int = 3, others: Float | None = None
) -> Gaussians:
    """The Gaussians with the colours, shadows included, that they have under a Sun in the direction `sun` [3], or None
    for a model that is not told.

    others: Float [N], the share of sunlight that other models let through (v_inter of 4.16), or None for all of it
    Harmonics of `degree` are fitted by least squares to the colours from `VIEWS` directions around; what is sharper in
    the view than they can be, such as a glint, is smoothed. Colours are sRGB values, as in `vanilla`.
    """
    directions = fibonacci_sphere(VIEWS)
    columns = [np.broadcast_to(np.array(term), VIEWS) for term in _harmonics(directions, degree)]
    fit = np.linalg.pinv(np.stack(columns, axis=1).astype(np.float64))  # [terms, VIEWS]
    coefficients = [ad.Float(0) for _ in range(3 * len(fit))]
    sunlight = light.sunlight(gaussians, sun)  # from all around the same
    for view, direction in enumerate(directions):
        # A camera of parallel rays sees every Gaussian in one direction; how far it is away makes no difference.
        camera = OrthographicCamera.from_extent(look_at(-direction, np.zeros(3)), 4, 4, 1.0)
        colors, _ = light.shade_picture(gaussians, Orthographic.of(camera), sun, sunlight=sunlight)
        if others is not None:
            colors = [color * others for color in colors]
        if light.config.curve:
            colors = [tone_map(color, light.config.curve[0]) for color in colors]
        for k in range(len(fit)):
            weight = ad.Float([float(np.float32(fit[k, view]))])
            for channel in range(3):
                coefficients[3 * k + channel] += weight * (colors[channel] - 0.5)
        dr.eval(coefficients)
    drawn = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logit_opacities
    return Gaussians(*drawn, ad.ArrayXf(coefficients))


def _harmonics(directions: np.ndarray, degree: int) -> list:
    """Terms of `view_colors`, constant included, for directions [V, 3]."""
    rows = dr.sh_eval(ad.Array3f(directions.T.astype(np.float32)), degree)
    return [np.array([SH_C0]), *(np.array(row) for row in rows[1:])]
