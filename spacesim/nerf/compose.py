"""Several radiance fields on one ray (thesis 3.1, algorithm 1): their intervals merged into one partition, in which
densities add up and colours are their means by density.

Rays are transformed and not fields: model m, which stands at x_world = s R x_model + t, is asked along the ray that a
camera in its own frame casts, in units of its box's side b. A length l_m there is l = s b l_m metres of the world, in
which all models are merged. What a model absorbs along a stretch is no matter of units, so its density is
sigma_m / (s b) per metre of the world: a model drawn twice as large is as opaque as before. (3.1 as printed scales
origins alone, and leaves lengths and densities as each model counts them.)

A segment without length weighs exactly 0: so the partition, which has one size for all rays, needs none of them taken
out.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, may_shade
from spacesim.data.records import Camera, Sun
from spacesim.nerf.draw import RaySamples, check_chunk, chunks, shown, sun_numbers, unit_normals
from spacesim.nerf.partition import DeviceSunOccluder, MutualShading, PlacedField, PlacedFields, model_rays, partition
from spacesim.nerf.run import NerfRun
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.sampling.rays import Rays, camera_rows
from spacesim.nerf.sampling.render import sum_rays, volume_weights
from spacesim.nerf.scene import DrawnScene, FieldScene
from spacesim.nerf.shadow import sun_visibility


def draw_chunk(fields: PlacedFields, pixel: UInt32, width: UInt32, count: int, normals: bool) -> Float:
    """[C R] planes, packed, of `count` pixels: colour (3), opacity, expected and median depth (metres), the share of
    each model in the opacity, then normals (3) where they are asked for, and the visibility of the Sun in a scene with
    shadows. Arguments as of `partition`."""
    seen = partition(fields, pixel, width, count, normals)
    merged, segments = seen.merged, fields.segments
    made = volume_weights(merged.density * (merged.high - merged.low), segments)
    rays = Rays(ad.Array3f(0), ad.Array3f(0), ad.Float(0), ad.Float(0), seen.across)
    planes = shown(made, RaySamples(merged.low, merged.high, merged.density, merged.color), rays, segments)
    planes += [sum_rays(made.weights * share, segments) for share in seen.shares]
    if seen.slopes is not None:
        planes += [sum_rays(made.weights * seen.slopes[i], segments) for i in range(3)]
    if seen.visibility is not None:
        planes.append(sum_rays(made.weights * seen.visibility, segments))
    return dr.concat(planes)


def find_crossing(fields: PlacedFields, first: UInt32, width: UInt32, count: int) -> UInt32:
    """[R] 1 where the ray through a pixel, number `first` and the following, crosses what a model fills."""
    pixel = dr.arange(ad.UInt32, count) + first
    result = dr.zeros(ad.UInt32, count)
    for number, model in zip(fields.which, fields.models, strict=True):
        _, crosses = fields.networks[number].occupancy.clip(model_rays(model, pixel, width), fields.filled[number])
        result |= dr.select(crosses, ad.UInt32(1), ad.UInt32(0))
    return result


_draw_chunk, _find_crossing = recorded(draw_chunk, elements=None), recorded(find_crossing, elements=None)


class Placed(Protocol):
    """A run and where it stands, as scene files have them."""

    run: NerfRun
    pose: Any  #: see `splat.compose.pose.Pose`
    name: str


class FieldComposition(FieldScene):
    """Posed radiance fields under one Sun; in scene files what `splat.compose.GaussianComposition` is to Gaussians.

    models: at least one
    config: how they shade each other: `shadows` is "none", or else by transmittance towards the Sun, which multiplies:
        the ratio of (4.15) is that of the others alone

    One model with no pose gives what its run gives alone, but for rounding.
    """

    def __init__(self, models: Sequence[Any], config: Any, path: Path | None = None) -> None:
        if not models:
            raise InputError("models: expected at least one, found none")
        super().__init__(models, config, path)
        self._runs: list[NerfRun] = list({id(model.run): model.run for model in self.models}.values())
        self._which = tuple(self._runs.index(model.run) for model in self.models)

    @property
    def model_bytes(self) -> int:
        """Size of the models' files, each counted once."""
        return sum(run.model_bytes for run in self._runs)

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self._shades or any(run.relightable for run in self._runs)

    @property
    def _shades(self) -> bool:
        """Whether models may shade each other."""
        return len(self.models) > 1 and self.config.shadows != "none"

    @property
    def has_shadows(self) -> bool:
        """Whether there is anything that casts them: one model on another, or on itself."""
        return self._shades or any(run.has_shadows for run in self._runs)

    @cached_property
    def contents(self) -> list[str]:
        """A digest of what each model is made of, in their order."""
        digests = [hashlib.sha256((run.path / "model.safetensors").read_bytes()).hexdigest() for run in self._runs]
        return [digests[number] for number in self._which]

    @property
    def gaussian_count(self) -> None:
        """There are none."""

    @property
    def places(self) -> list[Array]:
        """Where the middle of each model's box is, world, [3] metres."""
        return [centre for centre, _ in self.spheres]

    def field_alone(self, index: int) -> "FieldComposition":
        """The scene of model `index` alone."""
        return FieldComposition([self.models[index]], self.config, self.path)

    @property
    def chunk(self) -> int:
        """Rays that are drawn at once: no more than any of the models takes."""
        return min(run.networks.config.chunk for run in self._runs)

    def posed(self, poses: Sequence[Any]) -> "FieldComposition":
        """The scene with these poses, one of each model."""
        models = [replace(model, pose=pose) for model, pose in zip(self.models, poses, strict=True)]
        return FieldComposition(models, self.config, self.path)

    def _draw(
        self, camera: Camera, sun: Sun | None, normals: bool, median: bool, on_chunk: Callable[[], None] | None
    ) -> DrawnScene:
        """See `FieldScene`; the median depth is there in any case."""
        fields, width = self.placed(camera, sun), dr.opaque(ad.UInt32, camera.width)
        count = 6 + len(self.models) + 3 * normals + self.has_shadows
        planes = np.zeros((camera.height, camera.width, count), np.float32)
        flat = planes.reshape(-1, count)
        for part, padded in chunks(self.crossing(fields, camera), self.chunk, on_chunk):
            rays = dr.width(padded)
            packed = _draw_chunk(fields, padded, width, rays, normals)
            flat[part] = np.array(packed).reshape(-1, rays)[:, : len(part)].T
        rgb, alpha, depth, median_depth, shares, rest = np.split(planes, np.cumsum([3, 1, 1, 1, len(self.models)]), -1)
        return DrawnScene(
            np.ascontiguousarray(rgb),
            alpha[..., 0].copy(),
            depth[..., 0].copy(),
            median_depth[..., 0].copy(),
            rest[..., -1].copy() if self.has_shadows else None,
            unit_normals(rest[..., :3]) if normals else None,
            shares,
        )

    def crossing(self, fields: PlacedFields, camera: Camera) -> np.ndarray:
        """Numbers, row by row, of the pixels whose rays cross what a model fills. Raises MemoryError where a chunk of
        rays does not fit."""
        check_chunk([self._runs[number].networks.config for number in self._which], self.chunk)
        size, count, width = camera.width * camera.height, self.chunk, dr.opaque(ad.UInt32, camera.width)
        seen = (_find_crossing(fields, dr.opaque(ad.UInt32, first), width, count) for first in range(0, size, count))
        return np.flatnonzero(np.concatenate([np.array(part, bool) for part in seen])[:size]).astype(np.uint32)

    def placed(self, camera: Camera, sun: Sun | None, beside: Sequence[DeviceSunOccluder | None] = ()) -> PlacedFields:
        """The models as a camera sees them. beside: what else shades each, see `MutualShading`"""
        shading = None
        if sun is not None and (self._shades or beside):
            spheres = self.spheres
            casters = [
                tuple(j for j, one in enumerate(spheres) if j != k and may_shade(one, own, sun.direction))
                for k, own in enumerate(spheres)
            ]
            towards = [upload(model.pose.direction_in_model(sun.direction)) for model in self.models]
            eye = upload(camera_rows([camera], SceneBox(np.zeros(3), np.ones(3)))) if beside else None
            shading = MutualShading(towards, tuple(casters), eye, list(beside) or [None] * len(self.models))
        return PlacedFields(
            tuple(run.networks for run in self._runs),
            [run.parameters for run in self._runs],
            [run.filled for run in self._runs],
            self._which,
            [_place(model, camera, sun) for model in self.models],
            shading,
        )

    @property
    def spheres(self) -> list[tuple[Array, float]]:
        """(centre [3], radius) of each model, metres, world: around its box."""
        boxes = [(model.pose, model.run.box) for model in self.models]
        return [
            (pose.points(box.low + 0.5 * box.size), 0.5 * pose.scale * float(np.linalg.norm(box.size)))
            for pose, box in boxes
        ]

    def sun_visibility(self, points: Array, sun: Sun) -> Array:
        """[N] share of the Sun's light that comes through the models to points [N, 3] of the world, metres."""
        seen: Array = np.ones(len(points))
        for model, (centre, radius) in zip(self.models, self.spheres, strict=True):
            offset = centre - points
            ahead = offset @ sun.direction
            aside = np.linalg.norm(offset - ahead[:, None] * sun.direction, axis=1)
            reached = np.flatnonzero((ahead > -radius) & (aside < radius))  # others have nothing of it before the Sun
            if len(reached):
                run, pose = model.run, model.pose
                own = pose.inverse().points(points[reached]), pose.direction_in_model(sun.direction)
                seen[reached] *= sun_visibility(run.networks, run.parameters, run.filled, run.box, *own, bias=0.0)
        return seen


def _place(model: Placed, camera: Camera, sun: Sun | None) -> PlacedField:
    run, pose = model.run, model.pose
    towards = None
    if run.relightable and sun is not None:
        towards = sun_numbers(pose.direction_in_model(sun.direction), sun)
    turn: Array = np.asarray(pose.rotation, np.float64)
    return PlacedField(
        upload(camera_rows([pose.camera_in_model(camera)], run.box)),
        upload(run.box.extent),
        dr.opaque(ad.Float, pose.scale * run.box.side),
        upload(turn),
        towards,
    )
