"""Shadow mapping: is a Gaussian behind what the Sun sees first (thesis 4.3.1)? And filters that carry a penumbra.

The Sun's picture is the rasterizer's: the expected depth of every light pixel (4.4). Looking it up costs one lane a
Gaussian. Everything is detached.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError
from spacesim.splat.light.shadow.light_camera import drawable
from spacesim.splat.raster.bin import RECORDINGS, TileLists, bin_splats, room
from spacesim.splat.raster.blend import trace_forward
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.surface import NONE, surface_depth, trace_walk

FILTERS = ("bilinear", "percentage-closer", "variance", "median")
SUN_RADIUS_DEG = 0.2666  #: angular radius of the Sun's disc at 1 au
LARGEST_WINDOW = 16  #: pixels to either side that a filter may read; chosen


@dataclass(frozen=True)
class MappingConfig:
    """How the light's picture is read.

    filter: "bilinear" is the thesis: one depth, interpolated, then one test (4.5). "percentage-closer" tests every
        pixel of a window, then averages (Reeves et al. 1987). "variance" averages depth and its square over the window
        and bounds the lit share by Chebyshev's inequality (Donnelly and Lauritzen 2006). "median" tests every pixel of
        the window as "percentage-closer" does, against where half of the light is gone: a pixel that a body covers by
        less than half shows what is behind it, and no depth is a mean of both (ours).
    radius: pixels, half the window's width, at least 1/2; chosen
    sun_radius_deg: with "percentage-closer", widens the window to the penumbra that a disc of this angular radius
        throws across the mean gap to the blockers (Fernando 2005); 0 does not; `SUN_RADIUS_DEG` is the Sun's
    widest: pixels, half the width of the widest such window, and of that in which blockers are looked for; chosen
    bleeding: with "variance", lit shares below it count as none (Lauritzen 2007): what passes two blockers; chosen
    antialiased: what is thinner than a light pixel fades in the picture, where it would else grow to a pixel (see
        `project`): shadows end where bodies do, within two pixels. The thesis does not say
    """

    filter: str = "bilinear"
    radius: float = 1.0
    sun_radius_deg: float = 0.0
    widest: float = 8.0
    bleeding: float = 0.2
    antialiased: bool = True

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise InputError(f"filter: expected one of {', '.join(FILTERS)}, found {self.filter!r}")
        for name in ("radius", "widest"):
            if not 0.5 <= getattr(self, name) <= LARGEST_WINDOW:
                raise InputError(f"{name}: expected 0.5 to {LARGEST_WINDOW} pixels, found {getattr(self, name)}")
        if not 0 <= self.sun_radius_deg < 45:
            raise InputError(f"--sun-radius: expected 0 to 45 degrees, found {self.sun_radius_deg}")
        if not 0 <= self.bleeding < 1:
            raise InputError(f"bleeding: expected a share from 0 to below 1, found {self.bleeding}")


@dataclass
class LightMap:
    """What the Sun sees, planes [height * width], row by row.

    alpha: 1 - transmittance;  depth: sum of weight x z, metres;  square: of weight x z^2, metres^2, or None
    For the filter "median" alpha is 1 where half of the light and more is gone, else 0, and depth is where.
    """

    alpha: Any
    depth: Any
    square: Any
    width: int
    height: int


def occlusion_by_mapping(
    gaussians: Gaussians,
    camera: Orthographic,
    bias: Any,
    softness: float,
    config: MappingConfig | None = None,
    points: Any = None,
    casters: Gaussians | None = None,
) -> Any:
    """Float [N] in [0, 1]: raw occlusion by the depth test (thesis 4.4 to 4.6), 0 = sees the Sun. Detached.

    camera: of `light_camera.fit_camera`;  bias: Float [N], metres (4.26; zeros for none);  softness: epsilon_s, metres
    points: Array3f [3, N], world, metres: where each Gaussian is tested, if not at its centre (`bias.lifted`)
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
    splats, footprints = _prepare(casting or rows, camera, config.antialiased)
    lists = bin_splats(splats, footprints, camera.width, camera.height)
    if lists.capacity == 0:
        return dr.opaque(ad.Float, 0, gaussians.count)
    points, bias = None if points is None else dr.detach(points), dr.detach(bias)
    test = _Test(rows, points, bias, dr.opaque(ad.Float, max(softness, 1e-20)))
    surfaces = casting if config.filter == "median" else []  # other filters read the splats alone
    return _tested(test, surfaces, splats, lists, camera, config, room(dr.width(splats.x)))


@dataclass
class _Test:
    """Receivers. rows: the shape of the Gaussians;  points: where they are tested, None for their centres;  bias, Float
    [N], and softness, metres"""

    rows: list[Any]
    points: Any
    bias: Any
    softness: Any


def _trace_tested(
    test: _Test,
    casting: list[Any],
    splats: Splats,
    lists: TileLists,
    camera: Orthographic,
    config: MappingConfig,
    capacity: int,
) -> Any:
    """Draws the light's picture and looks the receivers up in it. casting: rows of what the splats are; none: those of
    the receivers"""
    if config.filter == "median":
        light = _median_map(Gaussians.from_rows(casting or test.rows), splats, lists, camera, capacity)
    else:
        light = _light_map(splats, lists, camera, config.filter == "variance", capacity)
    return _look_up(test, light, camera, config)


def _light_map(splats: Splats, lists: TileLists, camera: Orthographic, squares: bool, capacity: int) -> LightMap:
    """What the Sun sees of the Gaussians, with the second moments of depth if `squares`."""
    moments = [splats.depth, splats.depth * splats.depth] if squares else [splats.depth]
    blended = trace_forward(splats, moments, lists, camera.width, camera.height, capacity, 0)
    depth, *square = blended.features
    alpha = 1 - blended.transmittance
    dr.eval(alpha, depth, square)
    return LightMap(alpha, depth, square[0] if squares else None, camera.width, camera.height)


def _median_map(
    gaussians: Gaussians, splats: Splats, lists: TileLists, camera: Orthographic, capacity: int
) -> LightMap:
    """Where half of the light is gone: the surface of the Gaussian that takes it."""
    found = trace_walk(splats, lists, camera.width, camera.height, capacity)
    dr.eval(found)
    depth = surface_depth(gaussians, splats, found, camera, capacity)
    alpha = dr.select(found != NONE, ad.Float(1), 0)
    dr.eval(alpha, depth)
    return LightMap(alpha, depth, None, camera.width, camera.height)


def _trace_prepare(rows: list[Any], camera: Orthographic, antialiased: bool) -> tuple[Splats, Footprints]:
    return project(Gaussians.from_rows(rows), camera, antialiased)


def _look_up(test: _Test, light: LightMap, camera: Orthographic, config: MappingConfig) -> Any:
    gaussians, bias, softness = Gaussians.from_rows(test.rows), test.bias, test.softness
    visible = drawable(gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logit_opacities)
    center = camera.transform(gaussians.means if test.points is None else test.points)
    screen = camera.screen(center)
    x, y = screen.x, screen.y
    seen = visible & camera.in_reach(center) & (x >= 0) & (x < light.width) & (y >= 0) & (y < light.height)
    window = _Window(dr.select(seen, x, 0), dr.select(seen, y, 0), light, seen)
    depth = dr.select(seen, center.z - dr.select(dr.isfinite(bias), bias, 0), 0)
    if config.filter == "bilinear":
        occlusion = _interpolated(window, depth, softness)
    elif config.filter == "variance":
        occlusion = _by_variance(window, depth, softness, config)
    else:
        occlusion = _percentage_closer(window, depth, softness, camera, config)
    return dr.select(seen, occlusion, 0)


def _interpolated(window: "_Window", depth: Any, softness: Any) -> Any:
    """Thesis 4.4 to 4.6: bilinear over covered pixels alone, whose depths are known; of none, lit."""

    def terms(alpha: Any, pixel: Any, active: Any) -> list[Any]:
        known = dr.select(alpha > 0, ad.Float(1), 0)
        return [known, known * _mean_depth(window.light, alpha, pixel, active)]

    share, sums = window.sums(0.5, 0.5, 0.5, terms)
    known = share > 0
    return dr.select(known, _shadowed(sums * dr.rcp(dr.select(known, share, 1)) - depth, softness), 0)


def _percentage_closer(
    window: "_Window", depth: Any, softness: Any, camera: Orthographic, config: MappingConfig
) -> Any:
    """Every pixel's own test, averaged over the window; what is uncovered lets light pass."""

    def terms(alpha: Any, pixel: Any, active: Any) -> list[Any]:
        gap = _mean_depth(window.light, alpha, pixel, active) - depth
        blocked = alpha * _shadowed(gap, softness)
        return [blocked, -blocked * gap]

    half_x = half_y = ad.Float(config.radius)
    widest = config.radius
    if config.sun_radius_deg > 0:
        widest = max(config.radius, config.widest)
        blocked, gaps = window.sums(widest, widest, widest, terms)
        some = blocked > 1e-6
        gap = dr.maximum(dr.select(some, gaps * dr.rcp(dr.select(some, blocked, 1)), 0), 0)
        penumbra = gap * math.tan(math.radians(config.sun_radius_deg))  # metres, half its width
        half_x, half_y = (dr.clip(penumbra * camera[i], config.radius, widest) for i in (12, 13))
    blocked, _ = window.sums(half_x, half_y, widest, terms)
    return dr.clip(blocked * dr.rcp(4 * half_x * half_y), 0, 1)


def _by_variance(window: "_Window", depth: Any, softness: Any, config: MappingConfig) -> Any:
    """At least 1 - p of the covered share blocks, p = var / (var + (z - mean)^2) where the mean is nearer."""
    light = window.light

    def terms(alpha: Any, pixel: Any, active: Any) -> list[Any]:
        return [alpha, *(dr.gather(ad.Float, plane, pixel, active) for plane in (light.depth, light.square))]

    alpha, first, second = window.sums(config.radius, config.radius, config.radius, terms)
    known = alpha > 0
    inverse = dr.rcp(dr.select(known, alpha, 1))
    mean = first * inverse
    variance = dr.maximum(second * inverse - mean * mean, softness * softness)
    behind = dr.maximum(depth - mean, 0)
    passes = variance * dr.rcp(dr.fma(behind, behind, variance))
    passes = dr.clip((passes - config.bleeding) / (1 - config.bleeding), 0, 1)
    covered = dr.clip(alpha / (4 * config.radius * config.radius), 0, 1)
    return dr.select(known, (1 - passes) * covered, 0)


def _shadowed(gap: Any, softness: Any) -> Any:
    """1 - v of thesis 4.5 and 4.6: gap = z_ref - (z - b), metres."""
    return dr.rcp(1 + dr.exp(dr.clip(gap / softness, -60, 60)))


def _mean_depth(light: LightMap, alpha: Any, pixel: Any, active: Any) -> Any:
    """D of thesis 4.4, metres; 0 where nothing covers the pixel."""
    covered = alpha > 0
    depth = dr.gather(ad.Float, light.depth, pixel, active)
    return dr.select(covered, depth * dr.rcp(dr.select(covered, alpha, 1)), 0)


@dataclass
class _Window:
    """Pixels of the light's picture around the receivers' centres (x, y), Floats [N], pixels."""

    x: Any
    y: Any
    light: LightMap
    active: Any

    def sums(self, half_x: Any, half_y: Any, widest: float, terms: Callable[..., list[Any]]) -> list[Any]:
        """Sums of share x term over the pixels that the box (x +- half_x, y +- half_y) touches; the share is how much
        of a pixel the box covers, so the sums are continuous in x and y. half_x, half_y: pixels, at most `widest`.

        terms: (alpha, flat index of a pixel, Bool: is it in the image and the box) to Floats [N]; only there they
        count.
        """
        side = math.ceil(2 * widest) + 1  # pixels that such a box can touch
        left, top = dr.floor(self.x - half_x), dr.floor(self.y - half_y)
        light = self.light

        def more(k: Any, _sums: Any) -> Any:
            return k < side * side

        def add(k: Any, sums: list[Any]) -> Any:
            column, row = left + ad.Float(k % side), top + ad.Float(k // side)
            share = _overlap(column, self.x, half_x) * _overlap(row, self.y, half_y)
            active = self.active & (share > 0)
            active &= (column >= 0) & (column < light.width) & (row >= 0) & (row < light.height)
            pixel = ad.UInt32(dr.select(active, row, 0)) * light.width + ad.UInt32(dr.select(active, column, 0))
            alpha = dr.gather(ad.Float, light.alpha, pixel, active)
            weight = dr.select(active, share, 0)
            values = terms(alpha, pixel, active)
            return k + 1, [dr.fma(weight, v, s) for v, s in zip(values, sums, strict=True)]

        count = len(terms(ad.Float(0), ad.UInt32(0), ad.Bool(False)))
        state = ad.UInt32(0), [ad.Float(0) for _ in range(count)]
        _, sums = dr.while_loop(state, more, add, mode="symbolic", label="window")
        return list(sums)


def _overlap(pixel: Any, centre: Any, half: Any) -> Any:
    """Length of [pixel, pixel + 1] within [centre - half, centre + half]."""
    return dr.maximum(dr.minimum(pixel + 1, centre + half) - dr.maximum(pixel, centre - half), 0)


_prepare = recorded(_trace_prepare, RECORDINGS)
_tested = recorded(_trace_tested, RECORDINGS)
