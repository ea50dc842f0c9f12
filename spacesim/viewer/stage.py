"""The models that are shown, and their planes under any camera, Sun and poses.

Only the render thread draws: a recorded call holds Dr.Jit's lock while it runs Python, so that another thread that asks
Dr.Jit for anything at all, be it the length of an array, would wait for it for ever, and keep Python from going on. All
that others ask of a `Stage` is therefore found out when it is made.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.records import Camera
from spacesim.splat.compose import Composition
from spacesim.splat.raster.cameras import Pinhole
from spacesim.viewer.ellipsoids import draw_ellipsoids
from spacesim.viewer.paint import NEEDED, Planes
from spacesim.viewer.state import Stand

LEAST_RADIUS = 1e-6  #: metres of a model, where all its Gaussians are in one place


@dataclass(frozen=True, eq=False)
class Model:
    """What handles and cameras need of a model. name: unlike the others';  centre: [3] and radius of its Gaussians,
    its own frame, metres"""

    name: str
    centre: Array
    radius: float


class Stage:
    """A composed scene to be drawn. composition: with the poses that the viewer starts with

    gaussians: how many there are;  relightable: whether the Sun changes the picture;  backend: that draws
    """

    def __init__(self, composition: Composition) -> None:
        self.composition = composition
        self.gaussians = composition.gaussians
        self.relightable = composition.relightable
        self.backend = composition.backend
        names = _told_apart([placed.name or placed.run.path.resolve().name for placed in composition.models])
        self.models = tuple(
            Model(name, *_bounds(placed.run.model.to_numpy()))
            for name, placed in zip(names, composition.models, strict=True)
        )

    def bounds(self, stand: Stand) -> tuple[Array, float]:
        """(centre [3], radius) of a sphere about all models, world, metres."""
        spheres = [
            (pose.points(model.centre), pose.scale * model.radius)
            for model, pose in zip(self.models, stand.poses, strict=True)
        ]
        low = np.min([centre - radius for centre, radius in spheres], axis=0)
        high = np.max([centre + radius for centre, radius in spheres], axis=0)
        centre = spheres[0][0] if len(spheres) == 1 else 0.5 * (low + high)
        return centre, max(float(np.linalg.norm(at - centre) + radius) for at, radius in spheres)

    def draw(self, stand: Stand, camera: Camera, mode: str) -> Planes:
        """The planes that a mode needs, and alpha. Raises InputError where the Sun matters and none is told."""
        scene = self.composition.posed(stand.poses)
        if mode == "ellipsoids":
            gaussians, colours = scene.lit_gaussians(camera, stand.sun)
            blended = draw_ellipsoids(gaussians, colours, Pinhole.of(camera))
            shape = camera.height, camera.width
            rgb = np.stack([np.array(plane).reshape(shape) for plane in blended.planes], axis=-1)
            return Planes(1 - np.array(blended.transmittance).reshape(shape), rgb=rgb)
        wanted = {"rgb": "rgb", "depth": "depth", "visibility": "visibility", "normal": "normal", "object_id": "id"}
        name = NEEDED[mode]
        drawn = scene.draw(camera, stand.sun, [wanted[name]] if name in wanted else [], supersample=1)
        alpha = drawn.image("alpha")
        if name not in wanted or (name == "visibility" and "visibility" not in drawn.planes):
            return Planes(alpha)
        return Planes(alpha, **{name: drawn.image(wanted[name])})

    def lacks(self, plane: str) -> str:
        """Why a plane cannot be had, in words."""
        if plane == "visibility":
            return "no model here predicts shadows (train with --method shadow-map, shadow-splat or park)"
        return f"no model here predicts {plane}"


def _bounds(arrays: dict[str, np.ndarray]) -> tuple[Array, float]:
    """(centre [3], radius) of the Gaussians but for the farthest 1 %, metres."""
    means = arrays["means"].astype(np.float64)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        return np.zeros(3), 1.0
    centre = np.median(means, axis=0)
    away = np.linalg.norm(means - centre, axis=1)
    kept = means[away <= np.percentile(away, 99)]
    centre = 0.5 * (kept.min(axis=0) + kept.max(axis=0))
    radius = float(np.linalg.norm(kept - centre, axis=1).max())
    return centre, max(radius, LEAST_RADIUS)


def _told_apart(names: Sequence[str]) -> list[str]:
    """The names, numbered from 2 where they occur again."""
    result: list[str] = []
    for name in names:
        number, own = 2, name
        while own in result:
            own, number = f"{name} {number}", number + 1
        result.append(own)
    return result
