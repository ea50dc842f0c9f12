"""Gaussians and radiance fields in one picture, in the order of their depths on each ray (`walk`).

Gaussians are lit, projected, binned and blended as in a scene of their own; pixels that cross no field show that. Of
the others, fields are merged into one partition of each ray (thesis 3.1, algorithm 1), some rays at a time, and the
tile's list of Gaussians is walked once more, together with it. All is blended as sRGB values.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Bool, UInt32
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.records import Camera, Sun
from spacesim.mixed.shadow import FieldOccluder, sun_views
from spacesim.mixed.walk import ListedSplats, Segments, blend_segments, listed
from spacesim.nerf.compose import FieldComposition
from spacesim.nerf.draw import chunks, unit_normals
from spacesim.nerf.partition import PlacedFields, partition
from spacesim.nerf.run import NerfRun
from spacesim.nerf.scene import DrawnScene, FieldScene
from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.scene import ComposeConfig, GaussianComposition, LitGaussians
from spacesim.splat.light.shadow.mapping import SunView
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.output import RenderOutput, over_alpha
from spacesim.splat.raster.project import Footprints
from spacesim.splat.raster.project import Splats as Projected
from spacesim.splat.raster.records import ListedRecords
from spacesim.splat.raster.render import blend, median_depth, prepare
from spacesim.splat.raster.supersample import render_supersampled, upsampled_camera

COMMON = 4  #: features that both have: colour, visibility


T = TypeVar("T")


class MixedComposition(FieldScene):
    """Posed runs of both families under one Sun; in scene files what `splat.compose.GaussianComposition` is to
    Gaussians.

    models: at least one of each family
    config: how they shade each other. `shadows` is of Gaussians on each other; what has to do with a field is "none",
        or by light that comes through, which multiplies, so that the ratio of (4.15) is that of the others alone
    """

    def __init__(self, models: Sequence[Any], config: ComposeConfig | None = None, path: Path | None = None) -> None:
        super().__init__(models, config or ComposeConfig(), path)
        are_fields = [isinstance(model.run, NerfRun) for model in self.models]
        if all(are_fields) or not any(are_fields):
            raise InputError("models: expected at least one of Gaussians and one radiance field, found one family")
        self._of_fields = [k for k, is_field in enumerate(are_fields) if is_field]
        self._of_splats = [k for k, is_field in enumerate(are_fields) if not is_field]
        self._fields = FieldComposition([self.models[k] for k in self._of_fields], self.config, path)
        self._splats = self._shaded(GaussianComposition([self.models[k] for k in self._of_splats], self.config, path))
        self._views = _SunViews()

    def _shaded(self, splats: GaussianComposition) -> GaussianComposition:
        return splats.shaded_by(FieldOccluder(self._fields))

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians."""
        return self._splats.gaussian_count

    @property
    def model_bytes(self) -> int:
        """Size of the models' files, each counted once."""
        return self._fields.model_bytes + self._splats.model_bytes

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self._shades or self._fields.relightable or self._splats.relightable

    @property
    def has_shadows(self) -> bool:
        """See `FieldScene`."""
        return self._shades or self._splats.has_shadows or self._fields.has_shadows

    @property
    def _shades(self) -> bool:
        return self.config.shadows != "none"

    @property
    def contents(self) -> list[str]:
        """A digest of what each model is made of, in their order."""
        return self._in_order(self._fields.contents, self._splats.contents)

    @property
    def places(self) -> list[np.ndarray]:
        """Where the middle of each model is, world, [3] metres."""
        return self._in_order([centre for centre, _ in self._fields.spheres], self._splats.places)

    @property
    def spheres(self) -> list[tuple[np.ndarray, float]]:
        """(centre [3], radius) of each model, metres, world."""
        return self._in_order(self._fields.spheres, self._splats.spheres)

    def field_alone(self, index: int) -> FieldComposition:
        """The scene of model `index`, a radiance field, alone."""
        return self._fields.field_alone(self._of_fields.index(index))

    @property
    def supersample(self) -> int:
        """Places on a side of each pixel of what is predicted: the most that a model was trained with."""
        return self._splats.supersample

    def _in_order(self, of_fields: Sequence[T], of_splats: Sequence[T]) -> list[T]:
        both = dict(zip(self._of_fields, of_fields, strict=True)) | dict(zip(self._of_splats, of_splats, strict=True))
        return [both[k] for k in range(len(self.models))]

    def posed(self, poses: Sequence[Pose]) -> "MixedComposition":
        """The scene with these poses, one of each model. What does not change with them is kept."""
        other: MixedComposition = object.__new__(MixedComposition)
        other.models = tuple(replace(model, pose=pose) for model, pose in zip(self.models, poses, strict=True))
        other.config, other.path, other._views = self.config, self.path, self._views
        other._of_fields, other._of_splats = self._of_fields, self._of_splats
        other._fields = self._fields.posed([poses[k] for k in self._of_fields])
        other._splats = other._shaded(self._splats.posed([poses[k] for k in self._of_splats]))
        return other

    @property
    def _order(self) -> list[int]:
        """Which model each share is of: Gaussians, then fields."""
        placed = {id(model): k for k, model in zip(self._of_splats, self._splats.models, strict=True)}
        return [*(placed[id(model)] for model in self._splats.placed), *self._of_fields]

    def _draw(
        self, camera: Camera, sun: Sun | None, normals: bool, median: bool, on_chunk: Callable[[], None] | None
    ) -> DrawnScene:
        times = self.supersample
        lit = self._splats.lit(camera, sun)
        wide = upsampled_camera(camera, times)
        views = self._views.of(self._splats, self._fields, lit, sun) if sun is not None and self._shades else []
        fields = self._fields.placed(wide, sun, views)
        draw = partial(self._draw_once, wide, lit, fields, normals, median, on_chunk)
        drawn = render_supersampled(draw, camera, times, 3)
        planes = drawn.image("features")
        shares = np.zeros((*planes.shape[:2], len(self.models)), np.float32)
        shares[..., self._order] = planes[..., COMMON:]  # models without Gaussians have none
        return DrawnScene(
            np.ascontiguousarray(planes[..., :3]),
            drawn.image("alpha"),
            drawn.image("depth"),
            drawn.image("median_depth") if median else None,
            planes[..., 3] if self.has_shadows else None,
            drawn.image("normal") if normals else None,
            shares,
        )

    def _draw_once(
        self,
        camera: Camera,
        lit: LitGaussians,
        fields: PlacedFields,
        normals: bool,
        median: bool,
        on_chunk: Callable[[], None] | None,
        pinhole: Pinhole,
    ) -> RenderOutput:
        """A picture with one ray a pixel. features: colour (3), visibility, the share of each model of `_order` in the
        opacity."""
        splats, planes = _blend_splats(lit, pinhole, self._splats.antialiased, normals, median)
        width, count = dr.opaque(ad.UInt32, camera.width), 3 * normals
        pixels = self._fields.crossing(fields, camera)
        pixels = pixels[np.argsort(_tiles(pixels, camera.width, splats.lists), kind="stable")]
        of_fields = np.zeros((len(fields.models) + count, camera.width * camera.height), np.float32)
        for part, padded in chunks(pixels, self._fields.chunk, on_chunk):
            segments = _segments(fields, padded, width, dr.width(padded), normals)
            made = blend_segments(splats, segments, padded, width, fields.segments, COMMON)
            rows = [made.transmittance, made.depth, made.median_depth, *made.common, *made.of_splats]
            planes[:, part] = [np.array(row)[: len(part)] for row in rows]
            of_fields[:, part] = [np.array(row)[: len(part)] for row in made.of_segments]
        shares, slopes = of_fields[count:], of_fields[:count]
        if normals:
            planes[3 + COMMON : 6 + COMMON] += shares.sum(axis=0) * unit_normals(slopes.T).T
        return _output(np.concatenate([planes, shares]), camera, normals, median)


@dataclass
class _SunViews:
    """`sun_views` of the last Sun and poses: a camera that moves leaves shadows as they are."""

    kept: list[tuple[bytes, list[SunView | None]]] = field(default_factory=list)

    def of(
        self, splats: GaussianComposition, fields: FieldComposition, lit: LitGaussians, sun: Sun
    ) -> list[SunView | None]:
        """One of each field."""
        key = b"".join([sun.direction.tobytes(), *(model.pose.key for model in (*splats.models, *fields.models))])
        if not self.kept or self.kept[0][0] != key:
            self.kept[:] = [(key, sun_views(lit.gaussians, fields, sun))]
        return self.kept[0][1]


def _blend_splats(
    lit: LitGaussians, camera: Pinhole, antialiased: Bool | bool, normals: bool, median: bool
) -> tuple[ListedSplats, np.ndarray]:
    """(the splats by tiles, planes [C, H W] of the picture without fields: transmittance, sum of depths, median depth,
    colour, visibility, normals where they are asked for, the share of each model)."""
    size, gaussians = camera.width * camera.height, lit.gaussians
    if gaussians.count == 0:
        none = ad.Float([])
        nowhere = Footprints(half_width=none, half_height=none, visible=ad.Bool([]), order=ad.UInt32([]))
        empty = Projected(x=none, y=none, a=none, b=none, c=none, opacity=none, depth=none)
        lists = bin_splats(empty, nowhere, camera.width, camera.height)
        planes = np.zeros((3 + COMMON + 3 * normals + len(lit.shares), size), np.float32)
        planes[0] = 1
        return ListedSplats(ListedRecords([], 0), lists, COMMON + 3 * normals + len(lit.shares)), planes
    outputs = ("depth", "normal") if normals else ("depth",)
    splats, footprints, groups = prepare(gaussians.rows(), camera, None, outputs, antialiased)
    seen = dr.full(ad.Float, 1, gaussians.count) if lit.visibility is None else lit.visibility
    features = [*lit.colors, seen, *groups.get("normal", []), *lit.shares]
    blended = blend(splats, footprints, [*groups["depth"], *features], camera)
    depth, *rest = blended.planes
    middle = median_depth(splats, blended.lists, camera) if median else dr.zeros(ad.Float, size)
    planes = np.stack([np.array(plane) for plane in (blended.transmittance, depth, middle, *rest)])
    return listed(splats, features, blended.lists), planes


@recorded(elements=None)
def _segments(fields: PlacedFields, pixel: UInt32, width: UInt32, count: int, normals: bool) -> Segments:
    """Of the rays through `count` pixels. features: colour (3), visibility, the density's gradient (3) where normals
    are asked for, the share of each model."""
    seen = partition(fields, pixel, width, count, normals)
    merged, index = seen.merged, dr.arange(ad.UInt32, count * fields.segments) // fields.segments
    across = dr.gather(ad.Float, seen.across, index)
    lit = dr.full(ad.Float, 1, count * fields.segments) if seen.visibility is None else seen.visibility
    features = [*merged.color, lit, *(seen.slopes if seen.slopes is not None else []), *seen.shares]
    return Segments(merged.low * across, merged.high * across, merged.density / across, features)


def _tiles(pixels: np.ndarray, width: int, lists: TileLists) -> np.ndarray:
    """The tile of each pixel: neighbours in a chunk walk one list."""
    row, column = np.divmod(pixels, width)
    return np.asarray(row // lists.shape.height * lists.tiles_x + column // lists.shape.width)


def _output(planes: np.ndarray, camera: Camera, normals: bool, median: bool) -> RenderOutput:
    """Of planes [C, H W] as `_blend_splats` orders them."""
    transmittance, depth, middle, *rest = (upload(plane) for plane in planes)
    alpha = 1 - transmittance
    normal = None
    if normals:
        lengths = np.linalg.norm(planes[3 + COMMON : 6 + COMMON], axis=0)
        units = planes[3 + COMMON : 6 + COMMON] / np.where(lengths > 1e-6, lengths, np.inf)
        normal = ad.Array3f(*(upload(unit) for unit in units))
        rest = rest[:COMMON] + rest[COMMON + 3 :]
    return RenderOutput(
        color=None,
        alpha=alpha,
        depth=over_alpha(depth, alpha),
        width=camera.width,
        height=camera.height,
        median_depth=middle if median else None,
        normal=normal,
        features=rest,
    )
