"""A relightable model under one Sun as plain Gaussians with spherical harmonics, which every splat viewer draws."""

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.tone import picture_of

VIEWS = 64  #: directions that the harmonics are fitted to, four times as many as degree 3 has terms


def baked(gaussians: Gaussians, light: LightModel, sun: np.ndarray, degree: int = 3) -> Gaussians:
    """The Gaussians with the colours, shadows included, that they have under a Sun in the direction `sun` [3].

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
        colours, _ = light.lit(gaussians, Orthographic.of(camera), sun, known=sunlight)
        if light.config.curve:
            colours = [picture_of(colour, light.config.curve[0]) for colour in colours]
        for k in range(len(fit)):
            weight = ad.Float(np.array([fit[k, view]], dtype=np.float32))
            for channel in range(3):
                coefficients[3 * k + channel] += weight * (colours[channel] - 0.5)
        dr.eval(coefficients)
    drawn = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logit_opacities
    return Gaussians(*drawn, ad.ArrayXf(coefficients))


def _harmonics(directions: np.ndarray, degree: int) -> list:
    """Terms of `view_colours`, constant included, for directions [V, 3]."""
    rows = dr.sh_eval(ad.Array3f(directions.T.astype(np.float32)), degree)
    return [np.array([SH_C0]), *(np.array(row) for row in rows[1:])]
