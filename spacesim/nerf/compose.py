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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Sun
from spacesim.learning.prediction import ComposedPrediction, check_picture
from spacesim.nerf.draw import Samples, sample_field, shown, unit_normals
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.run import NerfRun
from spacesim.nerf.sampling.rays import Rays, camera_rows, pixel_rays
from spacesim.nerf.sampling.render import sum_rays, volume_weights
from spacesim.nerf.sampling.sampler import count_below

COVERED = 0.5  #: alpha from which on a pixel shows a model
SHADOWS = ("trained", "none")  #: of models on each other, as scene files have it: fields know none


@dataclass
class Merged:
    """R rays in K segments each, sorted by t."""

    low: Float  #: [R K] t
    high: Float  #: [R K] t
    densities: list[Float]  #: [R K] of each model, per unit of t
    density: Float  #: [R K] their sum (3.6)
    color: list[Float]  #: 3 times [R K], mean by density; 0 where there is none
    intervals: list[UInt32]  #: [R K] of each model, which of its R S intervals a segment lies in; any where in none


def merge(models: Sequence[tuple[Samples, int]], rays: int) -> tuple[Merged, int]:
    """(the merged partition, its segments a ray) of models' (samples, intervals a ray) (3.2 to 3.6). A model's
    intervals abut; where they end, it has nothing."""
    edges = [_edges(samples, count, rays) for samples, count in models]
    total = sum(count + 1 for _, count in models)
    boundaries = dr.empty(ad.Float, rays * total)
    for number, (own, (_, count)) in enumerate(zip(edges, models, strict=True)):
        index = dr.arange(ad.UInt32, rays * (count + 1))
        ray, rank = index // (count + 1), index % (count + 1)
        for other, (values, (_, others)) in enumerate(zip(edges, models, strict=True)):
            if other != number:  # of equal boundaries the first model's comes first
                rank += count_below(values, ray * (others + 1), others + 1, own, equal=other < number)
        dr.scatter(boundaries, own, ray * total + rank, mode=dr.ReduceMode.Permute)
    dr.eval(boundaries)
    segments = total - 1
    index = dr.arange(ad.UInt32, rays * segments)
    ray = index // segments
    low, high = dr.gather(ad.Float, boundaries, index + ray), dr.gather(ad.Float, boundaries, index + ray + 1)
    middle = 0.5 * (low + high)
    density: Any = ad.Float(0)
    color: Any = [ad.Float(0)] * 3
    densities, intervals = [], []
    for own, (samples, count) in zip(edges, models, strict=True):
        passed: Any = count_below(own, ray * (count + 1), count + 1, middle, equal=True)
        inside = (passed > 0) & (passed <= count)
        interval = ray * count + dr.minimum(dr.maximum(passed, 1), count) - 1
        there = dr.gather(ad.Float, samples.density, interval, inside)
        density = density + there
        color = [
            c + there * dr.gather(ad.Float, s, interval, inside) for c, s in zip(color, samples.color, strict=True)
        ]
        densities.append(there)
        intervals.append(interval)
    share = dr.select(density > 0, dr.rcp(dr.maximum(density, 1e-30)), 0)
    return Merged(low, high, densities, density, [c * share for c in color], intervals), segments


def _edges(samples: Samples, count: int, rays: int) -> Float:
    """[R (S + 1)] boundaries of intervals that abut."""
    index = dr.arange(ad.UInt32, rays * (count + 1))
    ray, k = index // (count + 1), index % (count + 1)
    place = ray * count + dr.minimum(k, count - 1)
    low, high = dr.gather(ad.Float, samples.low, place), dr.gather(ad.Float, samples.high, place)
    return dr.select(k < count, low, high)


@dataclass
class PlacedField:
    """What is drawn of a model: arrays that change with camera, pose and Sun."""

    camera: Float  #: [16] see `rays.camera_rows`, in the model's frame
    extent: Float  #: [3] of its box
    unit: Float  #: of width 1, metres of the world for a side of its box
    turn: Float  #: [9] world_from_model, rotation by rows
    sun: Float | None  #: [3] towards it in the model's axes, of a field that is told


def draw_chunk(
    networks: tuple[Networks, ...],
    parameters: list[Parameters],
    filled: list[Float],
    which: tuple[int, ...],
    placed: list[PlacedField],
    pixel: UInt32,
    width: UInt32,
    count: int,
) -> Float:
    """[C R] planes, packed, of `count` pixels: colour (3), opacity, expected and median depth (metres), normals (3),
    then the share of each model in the opacity.  which: number, among the networks, of each model's"""
    models, tapes = [], []
    across = Rays(ad.Array3f(0), ad.Array3f(0), ad.Float(0), ad.Float(0), ad.Float(0))
    for number, model in zip(which, placed, strict=True):
        field, own = networks[number], parameters[number]
        rays, crosses = field.occupancy.clip(_rays(model, pixel, width), filled[number])
        rays.far = dr.select(crosses, rays.far, rays.near)
        dr.eval(rays.origin, rays.direction, rays.near, rays.far, rays.across)
        samples = field.config.samples
        seen = sample_field(field, own, filled[number], model.extent, rays, count, model.sun)
        index = dr.arange(ad.UInt32, count * samples) // samples
        point, _ = rays.at(index, 0.5 * (seen.low + seen.high))
        _, tape = field.density_tape(own, point)
        slopes = field.field.density.slopes(field.of_round(own, 2)[: field.field.split], tape)
        tapes.append(_turned(model.turn, slopes) / (model.unit * model.unit))
        in_world = Samples(seen.low * model.unit, seen.high * model.unit, seen.density / model.unit, seen.color)
        dr.eval(in_world.low, in_world.high, in_world.density, in_world.color, tapes)
        models.append((in_world, samples))
        across = rays
    merged, segments = merge(models, count)
    made = volume_weights(merged.density * (merged.high - merged.low), segments)
    planes = shown(made, Samples(merged.low, merged.high, merged.density, merged.color), across, segments)
    normal: Any = ad.Array3f(0)
    shares = []
    for there, slopes, interval in zip(merged.densities, tapes, merged.intervals, strict=True):
        normal += dr.select(there > 0, dr.gather(ad.Array3f, slopes, interval), 0)
        share = dr.select(there > 0, there * dr.rcp(dr.maximum(merged.density, 1e-30)), 0)
        shares.append(sum_rays(made.weights * share, segments))
    planes += [sum_rays(made.weights * normal[i], segments) for i in range(3)]
    return dr.concat([*planes, *shares])


def find_crossing(
    networks: tuple[Networks, ...],
    filled: list[Float],
    which: tuple[int, ...],
    placed: list[PlacedField],
    first: UInt32,
    width: UInt32,
    count: int,
) -> UInt32:
    """[R] 1 where the ray through a pixel, number `first` and the following, crosses what a model fills."""
    pixel = dr.arange(ad.UInt32, count) + first
    result: Any = dr.zeros(ad.UInt32, count)
    for number, model in zip(which, placed, strict=True):
        _, crosses = networks[number].occupancy.clip(_rays(model, pixel, width), filled[number])
        result |= dr.select(crosses, ad.UInt32(1), ad.UInt32(0))
    return result


_draw_chunk, _find_crossing = recorded(draw_chunk, elements=None), recorded(find_crossing, elements=None)


class Placed(Protocol):
    """A run and where it stands, as scene files have them."""

    run: Any  #: a `NerfRun`
    pose: Any  #: see `splat.compose.pose.Pose`
    name: str


class Composition:
    """Posed radiance fields under one Sun; in scene files what `splat.compose.Composition` is to Gaussians.

    models: at least one;  config: its `shadows` is one of `SHADOWS`. One model with no pose gives what its run gives
    alone, but for rounding. Raises InputError for other shadows.
    """

    def __init__(self, models: Sequence[Any], config: Any, path: Path | None = None) -> None:
        if not models:
            raise InputError("models: expected at least one, found none")
        if config.shadows not in SHADOWS:
            expected = f"expected {' or '.join(SHADOWS)} in a scene of radiance fields, which know no shadows"
            raise InputError(f"shadows: {expected}, found {config.shadows}")
        self.models, self.config, self.path = tuple(models), config, path
        self._runs: list[NerfRun] = list({id(model.run): model.run for model in self.models}.values())
        self._which = tuple(self._runs.index(model.run) for model in self.models)

    @property
    def model_bytes(self) -> int:
        """Size of the models' files, each counted once."""
        return sum(run.model_bytes for run in self._runs)

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return any(run.relightable for run in self._runs)

    @cached_property
    def contents(self) -> list[str]:
        """A digest of what each model is made of, in their order."""
        digests = [hashlib.sha256((run.path / "model.safetensors").read_bytes()).hexdigest() for run in self._runs]
        return [digests[number] for number in self._which]

    def stops(self, exposure: float | None) -> float:
        """0: colours are sRGB values. Raises InputError for an exposure."""
        if exposure is not None:
            raise InputError(f"exposure: expected runs trained in linear light (light.linear), found {self.path}")
        return 0.0

    def posed(self, poses: Sequence[Any]) -> "Composition":
        """The scene with these poses, one of each model."""
        models = [replace(model, pose=pose) for model, pose in zip(self.models, poses, strict=True)]
        return Composition(models, self.config, self.path)

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> ComposedPrediction:
        """Render one view. Raises InputError where the Sun matters and none is told, and for an exposure."""
        self.stops(exposure)
        if sun is None and self.relightable:
            raise InputError("sun: expected its direction for a scene that it changes, found none")
        check_picture(camera)
        size, count = camera.width * camera.height, self._runs[0].networks.config.chunk
        placed = [self._placed(model, camera, sun) for model in self.models]
        networks = tuple(run.networks for run in self._runs)
        filled = [run.filled for run in self._runs]
        width = dr.opaque(ad.UInt32, camera.width)
        seen = (
            _find_crossing(networks, filled, self._which, placed, dr.opaque(ad.UInt32, first), width, count)
            for first in range(0, size, count)
        )
        pixels = np.flatnonzero(np.concatenate([np.array(part, bool) for part in seen])[:size]).astype(np.uint32)
        planes = np.zeros((9 + len(self.models), size), np.float32)
        parameters = [run.parameters for run in self._runs]
        for start in range(0, len(pixels), count):
            part = pixels[start : start + count]
            padded = upload(np.concatenate([part, np.repeat(part[-1:], count - len(part))]), ad.UInt32)
            packed = _draw_chunk(networks, parameters, filled, self._which, placed, padded, width, count)
            planes[:, part] = np.array(packed).reshape(-1, count)[:, : len(part)]
        pictures = planes.reshape(-1, camera.height, camera.width)
        alpha, shares = pictures[3].copy(), pictures[9:]
        number = np.where(alpha >= COVERED, shares.argmax(axis=0) + 1, 0).astype(np.int32)
        normal = unit_normals(np.moveaxis(pictures[6:9], 0, -1)) if normals else None
        rgb = np.ascontiguousarray(np.moveaxis(pictures[:3], 0, -1))
        return ComposedPrediction(rgb, alpha, pictures[4].copy(), None, normal, number)

    def _placed(self, model: Placed, camera: Camera, sun: Sun | None) -> PlacedField:
        run, pose = model.run, model.pose
        towards = None
        if run.relightable and sun is not None:
            towards = upload(pose.direction_in_model(sun.direction))
        turn: Array = np.asarray(pose.rotation, np.float64)
        return PlacedField(
            upload(camera_rows([pose.camera_in_model(camera)], run.box)),
            upload(run.box.extent),
            dr.opaque(ad.Float, pose.scale * run.box.side),
            upload(turn),
            towards,
        )


def _rays(model: PlacedField, pixel: UInt32, width: UInt32) -> Rays:
    across = dr.maximum(width, 1)
    x, y = ad.Float(pixel % across) + 0.5, ad.Float(pixel // across) + 0.5
    return pixel_rays(model.camera, dr.zeros(ad.UInt32, dr.width(pixel)), x, y, model.extent)


def _turned(turn: Float, vectors: Array3f) -> Array3f:
    numbers = [dr.gather(ad.Float, turn, ad.UInt32(i)) for i in range(9)]
    rows = [sum((numbers[3 * i + k] * vectors[k] for k in range(3)), ad.Float(0)) for i in range(3)]
    return ad.Array3f(*rows)
