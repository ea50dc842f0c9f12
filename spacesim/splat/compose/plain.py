"""A scene under one Sun as one set of plain Gaussians with harmonics, which every splat viewer draws."""

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.records import Sun
from spacesim.splat.compose.scene import GaussianComposition
from spacesim.splat.export.bake import bake
from spacesim.splat.harmonics import rotate_harmonics
from spacesim.splat.raster.gaussians import SH_C0, Gaussians


def bake_scene(composition: GaussianComposition, sun: Sun | None) -> Gaussians:
    """All models in the world, in the order of `composition.placed`: colours of relightable runs as `bake` has them,
    harmonics turned with their models, shadows of models on each other included. sRGB values.

    Raises InputError where the Sun matters and none is given.
    """
    if sun is None and composition.relightable:
        source = composition.path or composition.models[0].run.path
        raise InputError(f"{source}: expected the Sun's direction for a scene that it changes, found none")
    if not composition.placed:
        return composition.in_world()
    parts = []
    for model, visible in zip(composition.placed, composition.cross_visibility(sun), strict=True):
        run, gaussians = model.run, model.run.gaussians
        if run.light is not None:
            direction = None if sun is None else model.pose.direction_in_model(sun.direction)
            earth = model.pose.earth_in_model(sun.earth) if sun else None
            # linear colours are dimmed before their tone curve
            gaussians = bake(gaussians, run.light, direction, others=visible, earth=earth)
        harmonics = gaussians.to_numpy()["sh"].astype(np.float64)
        if visible is not None and run.light is None:
            harmonics = dim_harmonics(harmonics, np.array(visible, np.float64))
        parts.append(rotate_harmonics(harmonics, model.pose.rotation))
    terms = max(part.shape[1] for part in parts)
    padded = [np.pad(part, ((0, 0), (0, terms - part.shape[1]), (0, 0))) for part in parts]
    world = composition.in_world().to_numpy()
    return Gaussians.from_numpy(world | {"sh": np.concatenate(padded)})


def dim_harmonics(harmonics: np.ndarray, visibility: np.ndarray) -> np.ndarray:
    """Harmonics [N, K, 3] of v c(d), of those of c(d) = sum a Y + 1/2. visibility: v, [N]"""
    dim = visibility[:, None, None] * harmonics
    dim[:, 0] += 0.5 * (visibility - 1)[:, None] / SH_C0
    return dim
