"""Shadow mapping: is a Gaussian behind what the Sun sees first (thesis 4.3.1)? And filters that carry a penumbra.

The Sun's picture is the rasterizer's: the expected depth of every light pixel (4.4). Looking it up costs one thread a
Gaussian. Everything is detached.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.data.errors import InputError
from spacesim.data.structure import check_fields
from spacesim.splat.light.shadow.light_camera import drawable_mask
from spacesim.splat.raster.blend import blend_lists, blend_packed
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.records import pack_records
from spacesim.splat.raster.surface import NONE, depth_on_planes, depth_planes, walk

Filter = Literal["bilinear", "percentage-closer", "variance", "median"]
FILTERS: tuple[Filter, ...] = get_args(Filter)
LEAST_SOFTNESS = 1e-20  #: metres
MAX_WINDOW = 16  #: pixels to either side that a filter may read


@dataclass(frozen=True)
class MappingConfig:
    """How the light's picture is read.

    The filter "bilinear" is the thesis: one depth, interpolated, then one test (4.5). "percentage-closer" tests every
    pixel of a window, then averages (Reeves et al. 1987). "variance" averages depth and its square over the window and
    bounds the lit share by Chebyshev's inequality (Donnelly and Lauritzen 2006). "median" tests every pixel of the
    window as "percentage-closer" does, against where half of the light is gone: a pixel that a body covers by less than
    half shows what is behind it, and no depth is a mean of both (ours).
    """

    kind: ClassVar[str] = "mapping"

    #: one depth of the light's picture, or several tests or moments of a window of it
    filter: Filter = "bilinear"
    radius: float = 1.0  #: pixels, half the window's width, at least 1/2
    bleeding: float = 0.2  #: with variance: lit shares below it count as none (Lauritzen 2007)
    #: what is thinner than a light pixel fades in the picture, where it would else grow to a pixel: shadows end where
    #: bodies do, within two pixels; the thesis does not say
    antialiased: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0.5 <= self.radius <= MAX_WINDOW:
            raise InputError(f"radius: expected 0.5 to {MAX_WINDOW} pixels, found {self.radius}")
        if not 0 <= self.bleeding < 1:
            raise InputError(f"bleeding: expected a share from 0 to below 1, found {self.bleeding}")


@dataclass
class ShadowMap:
    """What the Sun sees, planes [height * width], row by row.

    For the filter "median" alpha is 1 where half of the light and more is gone, else 0, and depth is where.
    """

    alpha: Float  #: 1 - transmittance
    depth: Float  #: sum of weight x z, metres
    square: Float | None  #: of weight x z^2, metres^2, or None
    width: int  #: pixels
    height: int  #: pixels


def occlusion_by_mapping(
    gaussians: Gaussians,
    camera: Orthographic,
    bias: Float,
    softness: float,
    config: MappingConfig | None = None,
    points: Array3f | None = None,
    casters: Gaussians | None = None,
) -> Float:
    """Float [N] in [0, 1]: raw occlusion by the depth test (thesis 4.4 to 4.6), 0 = sees the Sun. Detached.

    camera: of `light_camera.fit_camera`;  bias: Float [N], metres (4.26; zeros for none);  softness: epsilon_s, metres
    points: Array3f [3, N], world, metres: where each Gaussian is tested, if not at its centre (`bias.offset_receivers`)
    casters: what the Sun's picture shows, if not the Gaussians themselves
    A Gaussian whose point is outside of the image, that cannot be drawn, or around whose point the image is empty
    counts as lit. Raises ValueError for a softness that is not positive.
    """
    config = config or MappingConfig()
    if not softness > 0:
        raise ValueError(f"softness: expected a positive number of metres, found {softness}")
    if gaussians.count == 0:
        return dr.zeros(ad.Float, 0)
    rows = [dr.detach(row) for row in gaussians.shape_rows()]
    casting = [] if casters is None else [dr.detach(row) for row in casters.shape_rows()]
    splats, footprints = project_casters(casting or rows, camera, config.antialiased)
    lists = bin_splats(splats, footprints, camera.width, camera.height)
    if lists.capacity == 0:
        return dr.opaque(ad.Float, 0, gaussians.count)
    points, bias = None if points is None else dr.detach(points), dr.detach(bias)
    receivers = MapReceivers(rows, points, bias, dr.opaque(ad.Float, max(softness, LEAST_SOFTNESS)))
    surfaces = casting if config.filter == "median" else []  # other filters read the splats alone
    capacity = round_capacity(dr.width(splats.x))
    return occlusion_in_map(receivers, surfaces, splats, lists, camera, config, capacity)


@dataclass
class MapReceivers:
    """N Gaussians that are tested in a shadow map."""

    rows: list[Float]  #: their shapes, detached
    points: Array3f | None  #: where they are tested, None for their centres
    bias: Float  #: [N], metres
    softness: Float  #: metres


@recorded
def occlusion_in_map(
    test: MapReceivers,
    casting: list[Float],
    splats: Splats | list[Float],
    lists: TileLists,
    camera: Orthographic,
    config: MappingConfig,
    capacity: int,
) -> Float:
    """[N]: draws the light's picture by its lists and looks the receivers up in it. casting: rows of what the splats
    are; none: those of the receivers;  splats: or `map_records` of them;  capacity: length of the splats' arrays"""
    if config.filter == "median":
        assert isinstance(splats, Splats), "they have no records"
        light = _median_shadow_map(Gaussians.from_rows(casting or test.rows), splats, lists, camera, capacity)
    else:
        light = _mean_shadow_map(splats, lists, camera, config, capacity)
    return _look_up(test, light, camera, config)


def map_records(splats: Splats, config: MappingConfig, capacity: int) -> list[Float]:
    """Splats with the moments of depth that `_mean_shadow_map` blends, as `pack_records` packs them; nothing for the
    filter "median"."""
    return [] if config.filter == "median" else pack_records(splats, _moments(splats, config), capacity)


def _moments(splats: Splats, config: MappingConfig) -> list[Float]:
    return [splats.depth, splats.depth * splats.depth] if config.filter == "variance" else [splats.depth]


def _mean_shadow_map(
    splats: Splats | list[Float], lists: TileLists, camera: Orthographic, config: MappingConfig, capacity: int
) -> ShadowMap:
    """What the Sun sees of the Gaussians, with the second moments of depth for the filter "variance"."""
    size, squares = (camera.width, camera.height), config.filter == "variance"
    if isinstance(splats, Splats):
        blended = blend_lists(splats, _moments(splats, config), lists, *size, capacity)
    else:
        blended = blend_packed(splats, 1 + squares, lists, *size, capacity)
    depth, *square = blended.features
    alpha = 1 - blended.transmittance
    dr.eval(alpha, depth, square)
    return ShadowMap(alpha, depth, square[0] if squares else None, *size)


_drawn = recorded(_mean_shadow_map)


def _median_shadow_map(
    gaussians: Gaussians, splats: Splats, lists: TileLists, camera: Orthographic, capacity: int
) -> ShadowMap:
    """Where half of the light is gone: the surface of the Gaussian that takes it."""
    planes = depth_planes(gaussians, splats, camera, capacity)  # written in one kernel with what the walk reads
    splat = walk(splats, lists, camera.width, camera.height, capacity)
    depth = depth_on_planes(planes, splat, camera, capacity)
    alpha = dr.select(splat != NONE, ad.Float(1), 0)
    dr.eval(alpha, depth)
    return ShadowMap(alpha, depth, None, camera.width, camera.height)


@recorded
def project_casters(rows: list[Float], camera: Orthographic, antialiased: bool) -> tuple[Splats, Footprints]:
    """What the Sun's picture shows of Gaussians with these `shape_rows`."""
    return project(Gaussians.from_rows(rows), camera, antialiased)


def _look_up(test: MapReceivers, light: ShadowMap, camera: Orthographic, config: MappingConfig) -> Float:
    gaussians = Gaussians.from_rows(test.rows)
    visible = drawable_mask(gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logit_opacities)
    center = camera.transform(gaussians.means if test.points is None else test.points)
    return _occlusion_at(center, visible, test.bias, test.softness, light, camera, config)


def _occlusion_at(
    center: Array3f,
    visible: Bool | bool,
    bias: Float,
    softness: Float,
    light: ShadowMap,
    camera: Orthographic,
    config: MappingConfig,
) -> Float:
    """[N] of points in the light camera's axes."""
    screen = camera.screen(center)
    x, y = screen.x, screen.y
    seen = camera.in_reach(center) & visible & (x >= 0) & (x < light.width) & (y >= 0) & (y < light.height)
    window = _Window(dr.select(seen, x, 0), dr.select(seen, y, 0), light, seen)
    depth = dr.select(seen, center.z - dr.select(dr.isfinite(bias), bias, 0), 0)
    if config.filter == "bilinear":
        occlusion = _interpolate(window, depth, softness)
    elif config.filter == "variance":
        occlusion = _by_variance(window, depth, softness, config)
    else:
        occlusion = _percentage_closer(window, depth, softness, config.radius)
    return dr.select(seen, occlusion, 0)


@dataclass
class SunView:
    """What the Sun sees of some Gaussians, to be asked of points that are none."""

    light: ShadowMap  #: depth and alpha from the Sun
    camera: Orthographic  #: the light camera
    softness: Float  #: epsilon_s of 4.5, metres
    config: MappingConfig  #: how the map is filtered

    @staticmethod
    def of(casters: Gaussians, camera: Orthographic, softness: float, config: MappingConfig) -> "SunView | None":
        """Of `casters`, as `occlusion_by_mapping` draws them; None where the image shows none. config: of another
        filter than `median`"""
        rows = [dr.detach(row) for row in casters.shape_rows()]
        if casters.count == 0:
            return None
        splats, footprints = project_casters(rows, camera, config.antialiased)
        lists = bin_splats(splats, footprints, camera.width, camera.height)
        if lists.capacity == 0:
            return None
        light = _drawn(splats, lists, camera, config, round_capacity(dr.width(splats.x)))
        return SunView(light, camera, dr.opaque(ad.Float, max(softness, LEAST_SOFTNESS)), config)

    def visibility(self, points: Array3f) -> Float:
        """[N] share of the Sun's light that reaches points [3, N], world, metres; 1 outside of the image."""
        center = self.camera.transform(points)
        return 1 - _occlusion_at(center, True, ad.Float(0), self.softness, self.light, self.camera, self.config)


def _interpolate(window: "_Window", depth: Float, softness: Float) -> Float:
    """Thesis 4.4 to 4.6: bilinear over covered pixels alone, whose depths are known; of none, lit."""

    def terms(alpha: Float, pixel: UInt32, active: Bool | bool) -> list[Float]:
        is_covered = dr.select(alpha > 0, ad.Float(1), 0)
        return [is_covered, is_covered * _mean_depth(window.light, alpha, pixel, active)]

    share, sums = window.sums(0.5, terms)
    is_covered = share > 0
    return dr.select(is_covered, _shadow_amount(sums * dr.rcp(dr.select(is_covered, share, 1)) - depth, softness), 0)


def _percentage_closer(window: "_Window", depth: Float, softness: Float, radius: float) -> Float:
    """Every pixel's own test, averaged over the window; what is uncovered lets light pass."""

    def terms(alpha: Float, pixel: UInt32, active: Bool | bool) -> list[Float]:
        gap = _mean_depth(window.light, alpha, pixel, active) - depth
        return [alpha * _shadow_amount(gap, softness)]

    (blocked,) = window.sums(radius, terms)
    return dr.clip(blocked / (4 * radius * radius), 0, 1)


def _by_variance(window: "_Window", depth: Float, softness: Float, config: MappingConfig) -> Float:
    """At least 1 - p of the covered share blocks, p = var / (var + (z - mean)^2) where the mean is nearer."""
    light = window.light

    def terms(alpha: Float, pixel: UInt32, active: Bool | bool) -> list[Float]:
        return [alpha, *(dr.gather(ad.Float, plane, pixel, active) for plane in (light.depth, light.square))]

    alpha, first, second = window.sums(config.radius, terms)
    is_covered = alpha > 0
    inverse = dr.rcp(dr.select(is_covered, alpha, 1))
    mean = first * inverse
    variance = dr.maximum(second * inverse - mean * mean, softness * softness)
    behind = dr.maximum(depth - mean, 0)
    passes = variance * dr.rcp(dr.fma(behind, behind, variance))
    passes = dr.clip((passes - config.bleeding) / (1 - config.bleeding), 0, 1)
    covered = dr.clip(alpha / (4 * config.radius * config.radius), 0, 1)
    return dr.select(is_covered, (1 - passes) * covered, 0)


def _shadow_amount(gap: Float, softness: Float) -> Float:
    """1 - v of thesis 4.5 and 4.6: gap = z_ref - (z - b), metres."""
    return dr.rcp(1 + dr.exp(dr.clip(gap / softness, -60, 60)))


def _mean_depth(light: ShadowMap, alpha: Float, pixel: UInt32, active: Bool | bool) -> Float:
    """D of thesis 4.4, metres; 0 where nothing covers the pixel."""
    covered = alpha > 0
    depth = dr.gather(ad.Float, light.depth, pixel, active)
    return dr.select(covered, depth * dr.rcp(dr.select(covered, alpha, 1)), 0)


@dataclass
class _Window:
    """Pixels of the light's picture around the receivers' centres (x, y), Floats [N], pixels."""

    x: Float
    y: Float
    light: ShadowMap
    active: Bool | bool

    def sums(self, half: float, terms: Callable[..., list[Float]]) -> list[Float]:
        """Sums of share x term over the pixels that the box (x +- half, y +- half) touches; the share is how much of a
        pixel the box covers, so the sums are continuous in x and y. half: pixels

        terms: (alpha, flat index of a pixel, Bool: is it in the image and the box) to Floats [N]; only there they
        count.
        """
        side = math.ceil(2 * half) + 1  # pixels that such a box can touch
        left, top = dr.floor(self.x - half), dr.floor(self.y - half)
        light = self.light

        def has_more(k: UInt32, _sums: object) -> Bool:
            return k < side * side

        def add(k: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
            column, row = left + ad.Float(k % side), top + ad.Float(k // side)
            share = _overlap(column, self.x, half) * _overlap(row, self.y, half)
            active = self.active & (share > 0)
            active &= (column >= 0) & (column < light.width) & (row >= 0) & (row < light.height)
            pixel = ad.UInt32(dr.select(active, row, 0)) * light.width + ad.UInt32(dr.select(active, column, 0))
            alpha = dr.gather(ad.Float, light.alpha, pixel, active)
            weight = dr.select(active, share, 0)
            values = terms(alpha, pixel, active)
            return k + 1, [dr.fma(weight, v, s) for v, s in zip(values, sums, strict=True)]

        count = len(terms(ad.Float(0), ad.UInt32(0), ad.Bool(False)))
        state = ad.UInt32(0), [ad.Float(0) for _ in range(count)]
        _, sums = dr.while_loop(state, has_more, add, mode="symbolic", label="window")
        return list(sums)


def _overlap(pixel: Float, centre: Float, half: float) -> Float:
    """Length of [pixel, pixel + 1] within [centre - half, centre + half]."""
    return dr.maximum(dr.minimum(pixel + 1, centre + half) - dr.maximum(pixel, centre - half), 0)
