"""Raw shadows of a set of Gaussians under one Sun: light camera, bias and one of the two methods, in one call."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import drjit as dr
from numpy.typing import ArrayLike

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32, UInt64
from spacesim.backend.upload import held, held_float
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import check_fields
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shadow.bias import Bias, grazing_bias, offset_receivers, receiver_bias
from spacesim.splat.light.shadow.clusters import occlusion_in_clusters
from spacesim.splat.light.shadow.light_camera import fit_camera
from spacesim.splat.light.shadow.mapping import (
    LEAST_SOFTNESS,
    MappingConfig,
    MapReceivers,
    map_records,
    occlusion_by_mapping,
    occlusion_in_map,
    project_casters,
)
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig
from spacesim.splat.light.shadow.splatting import (
    BETA_MIN,
    LEAST_BETA,
    Receivers,
    make_events,
    occlusion_by_splatting,
    occlusion_in_events,
)
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import make_boxes, make_lists
from spacesim.splat.raster.lists.boxes import Boxes, Grid
from spacesim.splat.raster.lists.capacity import WAITING, Capacities, Extent, PairCounts
from spacesim.splat.raster.lists.counting import picture_lists
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Footprints, Splats

MAX_LIGHT_SIZE = 8192  #: pixels of a side of the light's picture
UNSEEN = -80.0  #: logit of an opacity that nothing draws


@dataclass(frozen=True)
class SplattingConfig:
    """Light is taken on its way through the Gaussians (4.3.2)."""

    kind: ClassVar[str] = "splatting"

    beta_min: float = BETA_MIN  #: beta at which a receiver's footprint ends; 4.10 names no end, pictures' is 0.004
    #: in a light as table 4.3 has it: names the method baseline-park, and changes no picture
    baseline: bool = field(default=False, metadata={"option": False})

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, beta_min=(LEAST_BETA, 0.5))


@dataclass(frozen=True)
class ShadowConfig:
    """How the Gaussians shadow each other."""

    method: MappingConfig | SplattingConfig = field(default_factory=MappingConfig)  #: shadow mapping or splatting (4.3)
    size: int = 512  #: pixels of each side of the Sun's picture, of which the thesis names none
    bias: float = 10.0  #: strength lambda_b of the receiver-depth bias (4.26), 0: none but that of `grazing`
    #: what holds at a grazing Sun, too, where the thesis's bias goes to 0: a bias by the depth that a splat spans in
    #: the Sun's picture, points that are tested off the surface, along its normals (lift), or both
    grazing: Literal["none", "bias", "lift", "both"] = "none"
    reach: float = 2.0  #: of that bias, standard deviations of a splat in the Sun's picture
    softness: float = 1e-6  #: epsilon_s of 4.5 as a share of the farthest training camera's distance
    #: the network that corrects raw shadows (4.3.3)
    refine: ShadowRefinementConfig | None = field(default_factory=ShadowRefinementConfig)
    #: the light camera holds at most four standard deviations of the whole to either side, so that a stray Gaussian
    #: does not take the others' pixels; false: all supports (4.32)
    crop: bool = True
    #: shadows of other models in a composed scene: "others", from these alone, or "ratio", light from all over light
    #: from its own Gaussians (4.15)
    between: Literal["others", "ratio"] = "others"

    def __post_init__(self) -> None:
        check_fields(self)
        if not 4 <= self.size <= MAX_LIGHT_SIZE:
            raise InputError(f"size: expected 4 to {MAX_LIGHT_SIZE} pixels, found {self.size}")
        if not 0 <= self.reach < math.inf:
            raise InputError(f"reach: expected 0 or more standard deviations, found {self.reach}")
        if not 0 <= self.bias < math.inf:
            raise InputError(f"bias: expected 0 or more, found {self.bias}")
        if not 0 < self.softness < math.inf:
            raise InputError(f"softness: expected a number above 0, found {self.softness}")


@dataclass
class Shadows:
    """Raw occlusion of Gaussians, and what it was computed with."""

    occlusion: Float  #: Float [N] in [0, 1], detached
    camera: Orthographic  #: the light camera
    bias: Bias  #: of each Gaussian
    points: Array3f | None  #: in place of the receivers' means, or None

    @property
    def info(self) -> list[Float]:
        """Normal alignment, light extent (metres), bias (metres): three arrays [N]."""
        return [self.bias.alignment, self.bias.thickness, self.bias.bias]


def cast_shadows(
    gaussians: Gaussians, light: Float, config: ShadowConfig, distance: float, pairs: PairCounts = WAITING
) -> Shadows:
    """Raw occlusion (4.6, 4.10) of N Gaussians by each other, with one light camera. light: Float [9] of `light_rows`;
    distance: metres, of the farthest training camera;  pairs: of the light's picture"""
    softness = held_float(max(config.softness * distance, LEAST_SOFTNESS), "softness")
    sunlit = _Sunlit(
        [dr.detach(row) for row in gaussians.shape_rows()],
        light,
        *_numbers(config),
        softness,
        PaddedBatch.of(gaussians.count),
        config.method,
        config.size,
        config.crop,
        config.grazing,
    )
    splats = gaussians.count if isinstance(config.method, MappingConfig) else 2 * sunlit.batch.capacity
    extent = Extent.of(splats, config.size, config.size)
    expected = pairs.expected(extent)
    if expected is not None:
        limit, capacities = held(expected, "pairs"), extent.capacities(expected)
        view, occlusion, pair_ends = _cast_at_once(sunlit, extent.live, limit, capacities, extent.grid)
        pairs.check(extent, pair_ends, expected)
    else:
        seen = _seen_by_sun(sunlit, extent.live, extent.most, extent.grid)
        view, capacity = seen.view, pairs.counted(extent, seen.boxes)
        if capacity:
            occlusion = _cast(sunlit, seen, held(capacity, "pairs"), extent.capacities(capacity), extent.grid)
        else:
            occlusion = dr.opaque(ad.Float, 0, gaussians.count)
    return Shadows(occlusion, view.camera, view.bias, view.points)


@dataclass
class CrossShadow:
    """Shadows that some of a set of N Gaussians cast on M of it."""

    gaussians: Gaussians  #: the set
    casts: Bool  #: Bool [N]
    receivers: Gaussians  #: those that receive, as a set of their own
    receives: Bool  #: Bool [N], where they stand in the whole
    members: UInt32  #: UInt32 [M], their indices


def cast_cross_shadows(
    request: CrossShadow, direction: ArrayLike, config: ShadowConfig, distance: float, least_scale: float
) -> Float:
    """Float [M]: raw occlusion of the receivers by the casters, with light cameras fitted to the receivers, as many as
    it takes to see each at `least_scale` pixels a metre (4.3.5). direction: [3], towards the Sun;  distance: as in
    `cast_shadows`"""
    rows, numbers = request.gaussians.shape_rows(), _numbers(config)
    logit = dr.select(request.casts, rows[-1], UNSEEN)
    dr.eval(logit)
    blockers = Gaussians.from_rows([*rows[:-1], logit])

    method = config.method

    def by_mapping(receivers: Gaussians, camera: Orthographic) -> Float:
        assert isinstance(method, MappingConfig)
        bias, points = _receivers(receivers.shape_rows(), camera, *numbers, config.grazing)
        softness = config.softness * distance
        return occlusion_by_mapping(receivers, camera, bias.bias, softness, method, points, blockers)

    def by_splatting(_receiving: Gaussians, camera: Orthographic) -> Float:
        bias, points = _receivers(rows, camera, *numbers, config.grazing)
        ends = _beta_min(config)
        occlusion = occlusion_by_splatting(
            blockers, camera, bias.bias, points, receives=request.receives, beta_min=ends
        )
        return dr.gather(ad.Float, occlusion, request.members)

    by_method = by_mapping if isinstance(method, MappingConfig) else by_splatting
    return occlusion_in_clusters(request.receivers, direction, config.size, least_scale, by_method, crop=config.crop)


def _numbers(config: ShadowConfig) -> tuple[Float, Float]:
    """Bias and reach as kernels read them."""
    return held_float(config.bias, "bias"), held_float(config.reach, "reach")


def _beta_min(config: ShadowConfig) -> float:
    return config.method.beta_min if isinstance(config.method, SplattingConfig) else BETA_MIN


@dataclass
class _Sunlit:
    """N Gaussians under a Sun."""

    rows: list[Float]  #: `Gaussians.shape_rows`
    light: Float  #: of `light_rows`
    strength: Float  #: of the bias
    reach: Float  #: of the grazing bias
    softness: Float  #: metres
    batch: PaddedBatch  #: of N
    method: MappingConfig | SplattingConfig
    size: int  #: of the light's picture
    crop: bool
    grazing: str


@dataclass
class _LightView:
    """How the Sun sees N Gaussians."""

    camera: Orthographic
    bias: Bias
    points: Array3f | None  #: where receivers are tested, None for their centres


@dataclass
class _SunPicture:
    """What the Sun's picture is drawn of."""

    view: _LightView
    splats: Splats  #: of `project_casters`, or of `make_events`
    footprints: Footprints  #: of the splats
    boxes: Boxes  #: of the splats


@recorded
def _seen_by_sun(sunlit: _Sunlit, live: UInt32, most: int, grid: Grid) -> _SunPicture:
    """live: how many splats there are, `most` at most"""
    rows, method, view = sunlit.rows, sunlit.method, _view_of(sunlit)
    if isinstance(method, MappingConfig):
        splats, footprints = project_casters(rows, view.camera, method.antialiased)
        dr.schedule(view, splats, footprints)
    else:
        dr.eval(view)
        receivers = Receivers(view.bias.bias, view.points, method.beta_min)
        splats, footprints = make_events(rows, receivers, view.camera, False, sunlit.batch)
        dr.schedule(splats, footprints)
    return _SunPicture(view, splats, footprints, make_boxes(splats, footprints, live, most, grid))


def _view_of(sunlit: _Sunlit) -> _LightView:
    rows = sunlit.rows
    camera = fit_camera(Gaussians.from_rows(rows), sunlit.light, sunlit.size, sunlit.crop, sunlit.batch)
    return _LightView(camera, *_receivers(rows, camera, sunlit.strength, sunlit.reach, sunlit.grazing))


def _cast(sunlit: _Sunlit, seen: _SunPicture, limit: UInt32, capacities: Capacities, grid: Grid) -> Float:
    """Occlusion [N] by lists of these capacities: 0 where there are more pairs than `limit`."""
    lists = make_lists(seen.footprints, seen.boxes, limit, capacities, grid)
    return _occlusion(sunlit, seen.view, seen.splats, lists, capacities.splats)


@recorded
def _occlusion(
    sunlit: _Sunlit, view: _LightView, splats: Splats | list[Float], lists: TileLists, capacity: int
) -> Float:
    """Occlusion [N] by the lists of the Sun's picture. splats: or, for mapping, `map_records`;  capacity: length of the
    splats' arrays"""
    rows, method = sunlit.rows, sunlit.method
    if isinstance(method, MappingConfig):
        receivers = MapReceivers(rows, view.points, view.bias.bias, sunlit.softness)
        return occlusion_in_map(receivers, [], splats, lists, view.camera, method, capacity)
    assert isinstance(splats, Splats), "events are their splats"
    return occlusion_in_events(splats, lists, (sunlit.size, sunlit.size), sunlit.batch, rows[0])


@recorded
def _cast_at_once(
    sunlit: _Sunlit, live: UInt32, limit: UInt32, capacities: Capacities, grid: Grid
) -> tuple[_LightView, Float, UInt32 | UInt64]:
    """`_seen_by_sun` and `_cast`; sums whose last says how many pairs there are. A map's lists have no slots, as those
    of pictures."""
    if isinstance(sunlit.method, MappingConfig):
        view = _view_of(sunlit)
        splats, footprints = project_casters(sunlit.rows, view.camera, sunlit.method.antialiased)
        drawn = map_records(splats, sunlit.method, capacities.splats) or splats
        dr.schedule(view, drawn)
        lists, sums = picture_lists(splats, footprints, live, limit, capacities, grid)
        return view, _occlusion(sunlit, view, drawn, lists, capacities.splats), sums
    seen = _seen_by_sun(sunlit, live, capacities.splats, grid)
    assert seen.boxes.pair_ends is not None
    return seen.view, _cast(sunlit, seen, limit, capacities, grid), seen.boxes.pair_ends


@recorded
def _receivers(
    rows: list[Float], camera: Orthographic, strength: Float, reach: Float, grazing: str
) -> tuple[Bias, Array3f | None]:
    """(bias, points to test or None for the centres)."""
    gaussians, sun = Gaussians.from_rows(rows), -camera.row(2)
    bias = receiver_bias(gaussians, sun, strength)
    if grazing in ("bias", "both"):
        bias = bias.at_least(grazing_bias(gaussians, camera, reach))
    return bias, offset_receivers(gaussians, sun) if grazing in ("lift", "both") else None
