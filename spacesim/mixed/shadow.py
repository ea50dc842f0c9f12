"""Shadows between Gaussians and radiance fields: of fields on Gaussians by transmittance towards the Sun from their
centres, of Gaussians on fields by the depth test that runs without shadows of their own receive (thesis 4.3.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.nerf.compose import FieldComposition
from spacesim.splat.compose.members import MODEL_DISTANCE, PLAIN_SHADOWS
from spacesim.splat.light.shadow.clusters import Supports, light_cameras
from spacesim.splat.light.shadow.light_camera import light_axes
from spacesim.splat.light.shadow.mapping import MappingConfig, SunView
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians

TEST = MappingConfig("percentage-closer", radius=0.5)  #: as `Member.cross_shadow_config` has it of such runs


@dataclass(frozen=True, eq=False)
class FieldOccluder:
    """Fields in the Sun's way of Gaussians, see `splat.compose.light.SunOccluder`."""

    fields: FieldComposition  #: radiance fields where they stand

    @property
    def key(self) -> bytes:
        """Of where the fields stand."""
        return b"".join(model.pose.key for model in self.fields.models)

    def sun_visibility(self, points: Array, sun: Sun) -> Array:
        """[N] share of the Sun's light that comes through to points [N, 3] of the world, metres."""
        return self.fields.sun_visibility(points, sun)


def sun_views(casters: Gaussians, fields: FieldComposition, sun: Sun) -> "list[SunView | None]":
    """What the Sun sees of Gaussians, of each field over its box: `SunView`, or None where they cannot shade it."""
    axes, views = light_axes(sun.direction), []
    for corners in box_corners(fields):
        supports = Supports(corners @ axes, np.zeros((8, 2)))
        (camera,) = light_cameras(supports, [np.arange(8)], axes, PLAIN_SHADOWS.size)
        reach = 0.5 * float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
        softness = PLAIN_SHADOWS.softness * MODEL_DISTANCE * reach
        views.append(SunView.of(casters, Orthographic.of(camera), softness, TEST))
    return views


def box_corners(fields: FieldComposition) -> Sequence[Array]:
    """[8, 3] metres, world, of each field's box."""
    units = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(8, 3)
    return [model.pose.points(model.run.box.low + units * model.run.box.size) for model in fields.models]
