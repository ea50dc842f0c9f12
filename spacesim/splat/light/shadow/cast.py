"""Raw shadows of a set of Gaussians under one Sun: light camera, bias and one of the two methods, in one call."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import drjit as dr
from numpy.typing import ArrayLike

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import check_fields
from spacesim.splat.light.shadow.bias import Bias, grazing_bias, offset_receivers, receiver_bias
from spacesim.splat.light.shadow.clusters import occlusion_in_clusters
from spacesim.splat.light.shadow.light_camera import fit_camera
from spacesim.splat.light.shadow.mapping import (
    MappingConfig,
    MapReceivers,
    occlusion_by_mapping,
    occlusion_in_picture,
    project_casters,
)
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig
from spacesim.splat.light.shadow.splatting import (
    BETA_MIN,
    LEAST_BETA,
    Receivers,
    make_events,
    occlude,
    occlusion_by_splatting,
)
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import MakeLists, bin_splats
from spacesim.splat.raster.lists.tiles import round_capacity
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
    gaussians: Gaussians, light: Float, config: ShadowConfig, distance: float, make_lists: MakeLists = bin_splats
) -> Shadows:
    """Raw occlusion (4.6, 4.10) of N Gaussians by each other, with one light camera. light: Float [9] of `light_rows`;
    distance: metres, of the farthest training camera;  make_lists: of the light's picture"""
    rows = [dr.detach(row) for row in gaussians.shape_rows()]
    capacity = round_capacity(gaussians.count)
    sunlit = _Sunlit(rows, light, *_numbers(config), config.size, config.crop, config.grazing, capacity)
    if isinstance(config.method, MappingConfig):
        view, splats, boxes = _light_splats(sunlit, config.method.antialiased)
        receivers = MapReceivers.of(rows, view.points, view.bias.bias, config.softness * distance)
        occlusion = occlusion_in_picture(receivers, (splats, boxes), view.camera, config.method, [], make_lists)
    else:
        view, events, boxes = _light_events(sunlit, _beta_min(config), dr.opaque(ad.UInt32, gaussians.count))
        occlusion = occlude(events, boxes, view.camera, gaussians.count, make_lists)
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
    return dr.opaque(ad.Float, config.bias), dr.opaque(ad.Float, config.reach)


def _beta_min(config: ShadowConfig) -> float:
    return config.method.beta_min if isinstance(config.method, SplattingConfig) else BETA_MIN


@dataclass
class _Sunlit:
    """N Gaussians under a Sun."""

    rows: list[Float]  #: `Gaussians.shape_rows`
    light: Float  #: of `light_rows`
    strength: Float  #: of the bias
    reach: Float  #: of the grazing bias
    size: int  #: of the light's picture
    crop: bool
    grazing: str
    capacity: int  #: `round_capacity` of N


@dataclass
class _LightView:
    """How the Sun sees N Gaussians."""

    camera: Orthographic
    bias: Bias
    points: Array3f | None  #: where receivers are tested, None for their centres


@recorded
def _light_view(sunlit: _Sunlit) -> _LightView:
    rows = sunlit.rows
    camera = fit_camera(Gaussians.from_rows(rows), sunlit.light, sunlit.size, sunlit.crop, sunlit.capacity)
    return _LightView(camera, *_receivers(rows, camera, sunlit.strength, sunlit.reach, sunlit.grazing))


@recorded
def _light_splats(sunlit: _Sunlit, antialiased: bool) -> tuple[_LightView, Splats, Footprints]:
    """`_light_view` and `project_casters`."""
    view = _light_view(sunlit)
    return view, *project_casters(sunlit.rows, view.camera, antialiased)


@recorded
def _light_events(sunlit: _Sunlit, beta_min: float, count: UInt32) -> tuple[_LightView, Splats, Footprints]:
    """`_light_view` and `make_events`. count: N"""
    view = _light_view(sunlit)
    dr.eval(view)
    receivers = Receivers(view.bias.bias, view.points, beta_min)
    return view, *make_events(sunlit.rows, receivers, view.camera, False, count, sunlit.capacity)


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
