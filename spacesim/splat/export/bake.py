"""A relightable model under one Sun as plain Gaussians with spherical harmonics, which every splat viewer draws."""

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.memory import check_memory
from spacesim.data.earth import Earth
from spacesim.data.geometry import Array, fibonacci_sphere, look_at
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import NAMES, SH_C0, Gaussians
from spacesim.splat.raster.render import render
from spacesim.splat.raster.tone import tone_map

VIEWS = 64  #: directions that the harmonics are fitted to, four times as many as degree 3 has terms
PIXELS = 256  #: on a side of the pictures that show how much of each Gaussian is seen from a direction
WITHIN = 0.999  #: share of the Gaussians that they hold
FAINT = 0.1  #: pixels: what a direction counts at least, from which a Gaussian is hidden
BLACK = 1e-3  #: colours up to which any value below is as good: colours below 0 are drawn as 0
ROUNDS = 4  #: of fits, after each of which such values are taken as they come
CHUNK = 1 << 14  #: Gaussians that are fitted at once


def bake(
    gaussians: Gaussians,
    light: LightModel,
    sun: np.ndarray | None,
    degree: int = 3,
    others: Float | None = None,
    earth: Earth | None = None,
) -> Gaussians:
    """The Gaussians with the colours, shadows included, that they have under a Sun in the direction `sun` [3], or None
    for a model that does not take one.

    others: Float [N], the share of sunlight that other models let through (v_inter of 4.16), or None for all of it
    earth: that the Sun lights, for a model that has learned its light; others do not shade it
    Harmonics of `degree` are fitted by least squares to the colours from `VIEWS` directions around, weighted by how
    much of each Gaussian is seen from there; what is sharper in the view than they can be, such as a glint, is
    smoothed. Colours are sRGB values, as in `vanilla`. Raises MemoryError where they do not fit into memory.
    """
    check_memory(16 * VIEWS * gaussians.count, "colours of all Gaussians from all around")
    directions = fibonacci_sphere(VIEWS)
    colors = np.empty((VIEWS, 3, gaussians.count), np.float32)
    weights = np.empty((VIEWS, gaussians.count), np.float32)
    if others is None:
        sunlight = light.sunlight(gaussians, sun)  # from all around the same
    else:
        own = light.visibility(gaussians, sun)
        sunlight = light.arriving(gaussians, sun, others if own is None else own * others)
    arrays = gaussians.to_numpy()
    centre = np.median(arrays["means"].astype(np.float64), axis=0)
    away = np.linalg.norm(arrays["means"] - centre, axis=1)
    radius = max(1.05 * float(np.quantile(away, WITHIN)), 1e-6)
    for view, direction in enumerate(directions):
        # A camera of parallel rays sees every Gaussian in one direction; how far it is away makes no difference.
        pose = look_at(centre - 2 * radius * direction, centre)
        camera = Orthographic.of(OrthographicCamera.from_extent(pose, PIXELS, PIXELS, 2 * radius))
        shown, _ = light.shade_picture(gaussians, camera, sun, sunlight=sunlight, earth=earth)
        if light.config.curve:
            shown = [tone_map(color, light.config.curve.tone, light.config.curve.white) for color in shown]
        colors[view] = [np.array(color) for color in shown]
        weights[view] = blended_weights(gaussians, camera)
    terms = _harmonics(directions, degree)
    parts = [slice(first, first + CHUNK) for first in range(0, gaussians.count, CHUNK)]
    fitted = [_fit(terms, weights[:, part] + FAINT, colors[..., part]) for part in parts]
    drawn = {name: arrays[name] for name in NAMES}
    return Gaussians.from_numpy(drawn | {"sh": np.concatenate(fitted)})


def blended_weights(gaussians: Gaussians, camera: Orthographic, antialiased: bool = False) -> np.ndarray:
    """[N]: the sum of each Gaussian's weights over a picture, pixels; 0 of those that others hide."""
    feature = dr.zeros(ad.Float, gaussians.count)
    dr.enable_grad(feature)
    drawn = render(gaussians, camera, outputs=(), features=[feature], antialiased=antialiased)
    assert drawn.features is not None
    dr.backward(dr.sum(drawn.features[0]))  # the gradient of a feature is the sum of its weights
    return np.array(dr.grad(feature))


def _fit(terms: Array, weights: np.ndarray, colors: np.ndarray) -> Array:
    """[M, K, 3] harmonics of colours [V, 3, M] from V directions. terms: [V, K] of each direction;  weights: [V, M]"""
    count = terms.shape[1]
    pairs = np.einsum("vi,vj->vij", terms, terms).reshape(len(terms), count * count)
    inverse = np.linalg.inv((weights.T.astype(np.float64) @ pairs).reshape(-1, count, count))
    wanted = colors.astype(np.float64)
    for _ in range(ROUNDS):
        sums = np.einsum("vk,vcm->mkc", terms, weights[:, None] * (wanted - 0.5), optimize=True)
        harmonics = inverse @ sums
        approximation = np.einsum("vk,mkc->vcm", terms, harmonics, optimize=True) + 0.5
        wanted = np.where((colors <= BLACK) & (approximation < colors), approximation, colors)
    return np.asarray(harmonics)


def _harmonics(directions: np.ndarray, degree: int) -> Array:
    """[V, K] terms of `view_colors`, constant included, for directions [V, 3]."""
    rows = dr.sh_eval(ad.Array3f(directions.T.astype(np.float32)), degree)
    columns = [np.array([SH_C0]), *(np.array(row) for row in rows[1:])]
    return np.stack([np.broadcast_to(column, len(directions)) for column in columns], axis=1).astype(np.float64)
