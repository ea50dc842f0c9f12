"""Gaussians as opaque ellipsoids with dark edges, drawn by the rasterizer as it is.

A splat's alpha is min(o exp(-d^2 / 2), 0.999), d in standard deviations. With an opacity o of 1e30 that is opaque up to
d = 11.8 and nothing beyond 12.2: a disc with a sharp edge. So each splat is shrunk until that edge lies where SIGMAS of
the Gaussian were, and its opacity set so high. A second, slightly larger and dark disc behind it is the edge.
"""

import math
from dataclasses import fields
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.splat.raster.blend import ALPHA_MAX
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import Gaussians, opacities
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats, project
from spacesim.splat.raster.render import BlendedPlanes, blend
from spacesim.splat.raster.surface import normals

SIGMAS = 1.5  #: standard deviations at which an ellipsoid ends: neighbours of a surface just touch
FAINTEST = 0.1  #: opacity of Gaussians that are drawn at least: fainter ones are mist
AMPLITUDE = 1e30  #: opacity of discs; in float32, with 1 / ALPHA_MIN times it
EDGE = 1.12  #: size of the dark disc over that of the bright one
EDGE_SHADE = 0.25  #: its brightness
FLOOR = 0.12  #: grey under all colours: what lies in shadow has a shape, too

_INNER = math.sqrt(2 * math.log(AMPLITUDE / ALPHA_MAX))  # standard deviations up to which a disc is opaque
_OUTER = math.sqrt(2 * math.log(AMPLITUDE / ALPHA_MIN))  # and up to which it is drawn
_HALF = math.sqrt(2 * math.log(0.5 / ALPHA_MIN))  # up to which a splat of opacity 1/2 is


def draw_ellipsoids(gaussians: Gaussians, colors: list[Float], camera: Projection) -> BlendedPlanes:
    """Red, green and blue as planes, premultiplied, lit from the camera: |n . v| of each Gaussian's shortest axis.

    colors: 3 Floats [N], display values
    """
    half = Gaussians(
        gaussians.means, gaussians.log_scales, gaussians.quaternions, dr.zeros(ad.Float, gaussians.count), gaussians.sh
    )
    splats, footprints = project(half, camera)
    footprints.visible &= opacities(gaussians.logit_opacities) >= FAINTEST
    bright, dark = _discs(splats, footprints, 1.0), _discs(splats, footprints, EDGE)
    facing = dr.abs(dr.dot(normals(gaussians, camera), camera.directions_to(gaussians.means)))
    shade = 0.35 + 0.65 * facing
    seen = [shade * (FLOOR + (1 - FLOOR) * dr.clip(color, 0, 1)) for color in colors]
    features = [dr.concat([color, EDGE_SHADE * color]) for color in seen]
    both = [_joined(first, second) for first, second in zip(bright, dark, strict=True)]
    dr.eval(both, features)
    return blend(both[0], both[1], features, camera)


def _discs(splats: Splats, footprints: Footprints, size: float) -> tuple[Splats, Footprints]:
    """Opaque discs of `size` times SIGMAS."""
    shrink = _INNER / (size * SIGMAS)
    discs = Splats(
        x=splats.x,
        y=splats.y,
        a=splats.a * shrink**2,
        b=splats.b * shrink**2,
        c=splats.c * shrink**2,
        opacity=dr.full(ad.Float, AMPLITUDE, dr.width(splats.x)),
        depth=splats.depth,
    )
    reach = _OUTER / shrink / _HALF
    return discs, Footprints(
        reach * footprints.half_width, reach * footprints.half_height, footprints.visible, footprints.order
    )


def _joined(first: Any, second: Any) -> Any:
    """Two dataclasses of arrays one after the other."""
    return type(first)(*(dr.concat([getattr(first, f.name), getattr(second, f.name)]) for f in fields(first)))
