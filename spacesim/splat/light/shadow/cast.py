"""Raw shadows of a set of Gaussians under one Sun: light camera, bias and one of the two methods, in one call."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
from numpy.typing import ArrayLike

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError
from spacesim.splat.light.shadow.bias import Bias, grazing_bias, lifted, receiver_bias
from spacesim.splat.light.shadow.clusters import occlusion_in_clusters
from spacesim.splat.light.shadow.light_camera import fit_camera
from spacesim.splat.light.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.light.shadow.refine import RefineConfig
from spacesim.splat.light.shadow.splatting import differentiable_occlusion, occlusion_by_splatting
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.cameras import Orthographic
from spacesim.splat.raster.gaussians import Gaussians

METHODS = ("mapping", "splatting")
GRAZING = ("none", "bias", "lift", "both")
LARGEST = 8192  #: pixels of a side of the light's picture, chosen
UNSEEN = -80.0  #: logit of an opacity that nothing draws


@dataclass(frozen=True)
class ShadowConfig:
    """method: "mapping" (4.3.1) or "splatting" (4.3.2);  size: pixels of each side of the light image, of which the
    thesis names none;  bias: lambda_b of 4.26, 0 for none;  grazing: what holds at a grazing Sun, too, where the
    thesis's bias goes to 0: "bias" (`grazing_bias`), "lift" (`lifted`) or "both";  reach: of `grazing_bias`, standard
    deviations;  softness: epsilon_s of 4.5 as a share of the farthest training camera's distance;  mapping: how the
    light's picture is read;  gradients: of training pass through the shadows to the Gaussians, with splatting only;
    refine: the network of 4.3.3, or None."""

    method: str = "mapping"
    size: int = 512
    bias: float = 10.0
    grazing: str = "none"
    reach: float = 2.0
    softness: float = 1e-6
    mapping: MappingConfig = field(default_factory=MappingConfig)
    gradients: bool = False
    refine: RefineConfig | None = field(default_factory=RefineConfig)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"shadow method: expected {' or '.join(METHODS)}, found {self.method!r}")
        if self.gradients and self.method != "splatting":
            raise InputError(f"--shadow-gradients: expected shadow splatting, found {self.method}")
        if self.grazing not in GRAZING:
            raise InputError(f"grazing: expected one of {', '.join(GRAZING)}, found {self.grazing!r}")
        if not 4 <= self.size <= LARGEST:
            raise InputError(f"--light-size: expected 4 to {LARGEST} pixels, found {self.size}")
        if not 0 <= self.reach < math.inf:
            raise InputError(f"reach: expected 0 or more standard deviations, found {self.reach}")
        if not (0 <= self.bias < math.inf and 0 < self.softness < math.inf):
            raise InputError(
                f"--shadow-bias: expected 0 or more (and a softness above 0), found {self.bias} (and {self.softness})"
            )


@dataclass
class Shadows:
    """occlusion: Float [N] in [0, 1], detached;  the rest is what it was computed with: the Gaussians' rows but for
    colours (11 arrays [N]), the light camera, the bias [N], points in place of the receivers' means, or None"""

    occlusion: Any
    rows: list[Any]
    camera: Orthographic
    bias: Bias
    points: Any

    @property
    def info(self) -> list[Any]:
        """Normal alignment, light extent (metres), bias (metres): three arrays [N]."""
        return [self.bias.alignment, self.bias.thickness, self.bias.bias]

    def adjoint(self, by_occlusion: Any) -> list[Any]:
        """Gradients of `rows` from that of the occlusion [N], by shadow splatting's adjoint: of the blockers' alpha and
        the receivers' footprints; order, bias and light camera count as given."""
        rows = [ad.Float(row) for row in self.rows]
        dr.enable_grad(rows)
        occlusion = differentiable_occlusion(Gaussians.from_rows(rows), self.camera, self.bias.bias, self.points)
        dr.backward(occlusion * by_occlusion)
        return [dr.grad(row) for row in rows]


def cast_shadows(gaussians: Gaussians, light: Any, config: ShadowConfig, distance: float) -> Shadows:
    """Raw occlusion (4.6, 4.10) of N Gaussians by each other, with one light camera. light: Float [9] of `light_rows`;
    distance: metres, of the farthest training camera."""
    rows = gaussians.shape_rows()
    return _cast(gaussians, _fit(rows, light, config.size), config, distance)


def cast_shadows_adaptively(
    gaussians: Gaussians, direction: ArrayLike, config: ShadowConfig, distance: float, least_scale: float
) -> Shadows:
    """The same with as many light cameras as it takes to see every Gaussian at `least_scale` pixels a metre (4.3.5), so
    that models far apart get the shadows of each alone. direction: [3], towards the Sun."""
    casts: list[Shadows] = []

    def occlude(gaussians: Gaussians, camera: Orthographic) -> Any:
        casts.append(_cast(gaussians, camera, config, distance))
        return casts[-1].occlusion

    occlusion = occlusion_in_clusters(gaussians, direction, config.size, least_scale, occlude)
    primary, *_ = casts[1:] or casts  # the one camera of a compact set is tried first
    return replace(primary, occlusion=occlusion)


@dataclass
class Between:
    """Shadows that some of a set of N Gaussians cast on M of it. whole: the set;  casts: Bool [N];  own: those that
    receive, as a set of their own;  receives: Bool [N], where they stand in the whole;  members: UInt32 [M], their
    indices"""

    whole: Gaussians
    casts: Any
    own: Gaussians
    receives: Any
    members: Any


def cast_between(
    between: Between, direction: ArrayLike, config: ShadowConfig, distance: float, least_scale: float
) -> Any:
    """Float [M]: raw occlusion of the receivers by the casters, with light cameras fitted to the receivers, as many as
    it takes (4.3.5). direction: [3], towards the Sun;  distance, least_scale: as in `cast_shadows_adaptively`"""
    rows, numbers = between.whole.shape_rows(), _numbers(config)
    logit = dr.select(between.casts, rows[-1], UNSEEN)
    dr.eval(logit)
    blockers = Gaussians.from_rows([*rows[:-1], logit])

    def by_mapping(receivers: Gaussians, camera: Orthographic) -> Any:
        bias, points = _receivers(receivers.shape_rows(), camera, *numbers, config.grazing)
        softness = config.softness * distance
        return occlusion_by_mapping(receivers, camera, bias.bias, softness, config.mapping, points, blockers)

    def by_splatting(_receiving: Gaussians, camera: Orthographic) -> Any:
        bias, points = _receivers(rows, camera, *numbers, config.grazing)
        occlusion = occlusion_by_splatting(blockers, camera, bias.bias, points, receives=between.receives)
        return dr.gather(ad.Float, occlusion, between.members)

    occlude = by_mapping if config.method == "mapping" else by_splatting
    return occlusion_in_clusters(between.own, direction, config.size, least_scale, occlude)


def _cast(gaussians: Gaussians, camera: Orthographic, config: ShadowConfig, distance: float) -> Shadows:
    rows = gaussians.shape_rows()
    bias, points = _receivers(rows, camera, *_numbers(config), config.grazing)
    if config.method == "mapping":
        softness = config.softness * distance
        occlusion = occlusion_by_mapping(gaussians, camera, bias.bias, softness, config.mapping, points)
    else:
        occlusion = occlusion_by_splatting(gaussians, camera, bias.bias, points)
    return Shadows(occlusion, rows, camera, bias, points)


def _numbers(config: ShadowConfig) -> tuple[Any, Any]:
    """Bias and reach as kernels read them."""
    return dr.opaque(ad.Float, config.bias), dr.opaque(ad.Float, config.reach)


def _trace_fit(rows: list[Any], light: Any, size: int) -> Orthographic:
    return fit_camera(Gaussians.from_rows(rows), light, size)


def _trace_receivers(
    rows: list[Any], camera: Orthographic, strength: Any, reach: Any, grazing: str
) -> tuple[Bias, Any]:
    """(bias, points to test or None for the centres)."""
    gaussians, sun = Gaussians.from_rows(rows), -camera.row(2)
    bias = receiver_bias(gaussians, sun, strength)
    if grazing in ("bias", "both"):
        bias = bias.at_least(grazing_bias(gaussians, camera, reach))
    return bias, lifted(gaussians, sun) if grazing in ("lift", "both") else None


_fit = recorded(_trace_fit, RECORDINGS)
_receivers = recorded(_trace_receivers, RECORDINGS)
