"""The models that are shown, and their planes under any camera, Sun and poses.

Only the render thread draws: should Dr.Jit run Python while it holds its lock (see `Recorded`), another thread that
asks it for anything at all, be it the length of an array, would wait for ever, and keep Python from going on. All that
others ask of a `SceneRenderer` is therefore found out when it is made.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.records import Camera
from spacesim.splat.compose import GaussianComposition
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.output import planes_image
from spacesim.viewer.drawing.ellipsoids import draw_ellipsoids
from spacesim.viewer.drawing.paint import NEEDED, Planes
from spacesim.viewer.state import MATERIALS, MODES, SceneState

OF_GAUSSIANS = *MATERIALS, "ellipsoids"  #: modes of scenes of Gaussians alone
MIN_RADIUS = 1e-6  #: metres of a model, where all its Gaussians are in one place


@dataclass(frozen=True, eq=False)
class ViewerModel:
    """What handles and cameras need of a model."""

    name: str  #: unlike the others'
    centre: Array  #: [3] and radius of its Gaussians, or of its box, its own frame, metres
    radius: float  #: metres, as `centre`


class SceneRenderer:
    """A composed scene to be drawn.

    composition: with the poses that the viewer starts with, of Gaussians, or another that predicts as
        `nerf.compose.FieldComposition` does
    gaussian_count: of all models
    content: what there is, in words
    progressive: whether a picture takes so long that it comes in steps, of radiance fields
    modes: of `MODES`, those that there can be
    relightable: whether the Sun changes the picture
    is_linear: whether an exposure does: colours are linear light
    backend: that draws
    """

    def __init__(self, composition: Any) -> None:
        self.composition = composition
        counts = [placed.run.gaussian_count for placed in composition.models]
        self.gaussian_count = sum(count or 0 for count in counts)
        self.content = _describe(counts)
        self.progressive = not isinstance(composition, GaussianComposition)
        self.modes = tuple(mode for mode in MODES if mode not in OF_GAUSSIANS or not self.progressive)
        self.relightable = composition.relightable
        self.is_linear = not self.progressive and composition.curve is not None
        self.backend = composition.backend
        names = _unique_names([placed.name or placed.run.path.resolve().name for placed in composition.models])
        self.models = tuple(
            ViewerModel(name, *_bounds(placed.run)) for name, placed in zip(names, composition.models, strict=True)
        )

    def bounds(self, state: SceneState) -> tuple[Array, float]:
        """(centre [3], radius) of a sphere about all models, world, metres."""
        spheres = [
            (pose.points(model.centre), pose.scale * model.radius)
            for model, pose in zip(self.models, state.poses, strict=True)
        ]
        low = np.min([centre - radius for centre, radius in spheres], axis=0)
        high = np.max([centre + radius for centre, radius in spheres], axis=0)
        centre = spheres[0][0] if len(spheres) == 1 else 0.5 * (low + high)
        return centre, max(float(np.linalg.norm(at - centre) + radius) for at, radius in spheres)

    def draw(
        self,
        state: SceneState,
        camera: Camera,
        mode: str,
        on_chunk: Callable[[], None] | None = None,
        exposure: float = 0.0,
    ) -> Planes:
        """The planes that a mode needs, and alpha. on_chunk: called now and then within a picture of a `progressive`
        scene, which an exception ends; exposure: EV more than in training, of one that `is_linear`. Raises InputError
        where the Sun matters and none is given."""
        scene = self.composition.posed(state.poses)
        if self.progressive:
            seen = scene.predict(camera, state.sun, normals=NEEDED[mode] == "normal", on_chunk=on_chunk)
            return Planes(seen.alpha, seen.rgb, seen.depth, seen.visibility, seen.normal, object_id=seen.id)
        if mode == "ellipsoids":
            gaussians, colors = scene.lit_gaussians(camera, state.sun)
            blended = draw_ellipsoids(gaussians, colors, Pinhole.of(camera))
            size = camera.width, camera.height
            rgb, transmittance = planes_image(blended.planes, *size), planes_image([blended.transmittance], *size)
            return Planes(1 - transmittance[..., 0], rgb=rgb)
        if mode in MATERIALS:
            materials = scene.draw_material(camera)
            return Planes(materials.alpha, **{mode: getattr(materials, mode)})
        outputs = {"rgb": "rgb", "depth": "depth", "visibility": "visibility", "normal": "normal", "object_id": "id"}
        name = NEEDED[mode]
        drawn = scene.draw(camera, state.sun, [outputs[name]] if name in outputs else [], supersample=1)
        alpha = drawn.image("alpha")
        if name not in outputs or (name == "visibility" and "visibility" not in drawn.planes):
            return Planes(alpha)
        return Planes(alpha, **{name: drawn.image(outputs[name], exposure)})

    def why_missing(self, plane: str) -> str:
        """Why a plane cannot be had, in words."""
        if plane == "visibility":
            methods = "shadow-map, shadow-splat, baseline-park and nerf-relight"
            return f"no model here predicts shadows (the methods {methods} do)"
        return f"no model here predicts {plane}"


def _describe(counts: Sequence[int | None]) -> str:
    """counts: Gaussians of each model, None of a field"""
    fields = counts.count(None)
    models = len(counts) - fields
    parts = [f"{sum(count or 0 for count in counts):,} Gaussians in {models} model{'s' * (models > 1)}"] * (models > 0)
    return ", ".join([*parts, *[f"{fields} radiance field{'s' * (fields > 1)}"] * (fields > 0)])


def _bounds(run: Any) -> tuple[Array, float]:
    """(centre [3], radius) of a field's box, or of the Gaussians but for the farthest 1 %, metres."""
    if run.gaussian_count is None:
        return run.box.low + 0.5 * run.box.size, 0.5 * float(np.linalg.norm(run.box.size))
    means = run.gaussians.to_numpy()["means"].astype(np.float64)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        return np.zeros(3), 1.0
    centre = np.median(means, axis=0)
    away = np.linalg.norm(means - centre, axis=1)
    central = means[away <= np.percentile(away, 99)]
    centre = 0.5 * (central.min(axis=0) + central.max(axis=0))
    radius = float(np.linalg.norm(central - centre, axis=1).max())
    return centre, max(radius, MIN_RADIUS)


def _unique_names(names: Sequence[str]) -> list[str]:
    """The names, numbered from 2 where they occur again."""
    result: list[str] = []
    for name in names:
        number, unique = 2, name
        while unique in result:
            unique, number = f"{name} {number}", number + 1
        result.append(unique)
    return result
