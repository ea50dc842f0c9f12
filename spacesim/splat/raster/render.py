"""project -> bin -> rasterize -> RenderOutput: one differentiable picture of Gaussians (thesis 2.2).

What a picture shows beside colour is blended as features of the Gaussians: `blend` takes any number of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.splat.raster.bin import RECORDINGS, TileLists, bin_splats
from spacesim.splat.raster.blend import rasterize
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.surface import median_splat, normals, picked, unit

OUTPUTS = ("colour", "alpha", "depth", "median_depth", "normal")
CHANNELS = 16  #: features in one pass: fewer repeat the blending, more gain little (docs/rasterizer.md)


@dataclass
class RenderOutput:
    """What was asked for; the rest is None. Planes are [height * width], row by row; `image` gives them their shape.

    colour: Array3f, premultiplied (over black), sRGB values;  alpha: Float in [0, 1]
    depth: Float, expected depth: z of the centres averaged with the blending weights, metres; 0 where alpha is 0
    median_depth: Float, z of the Gaussian at which the transmittance falls below 1/2, metres; 0 where it does not
    normal: Array3f, world axes: direction of the blended normals, unit length; 0 where there are none
    features: the user's channels, blended like colour: sum of weight x value, so 0 where alpha is 0
    """

    colour: Any
    alpha: Any
    depth: Any
    width: int
    height: int
    median_depth: Any = None
    normal: Any = None
    features: Any = None

    def image(self, name: str) -> np.ndarray:
        """One output by name: [H, W], or [H, W, C] of colour, normal and features; float32.

        Raises ValueError for what was not asked for.
        """
        planes = getattr(self, name) if name in (*OUTPUTS, "features") else None
        if planes is None:
            had = [field.name for field in fields(self) if getattr(self, field.name) is not None]
            raise ValueError(f"name: expected one of the outputs asked for ({', '.join(had)}), found {name!r}")
        shape = (self.height, self.width)
        if name in ("alpha", "depth", "median_depth"):
            return np.array(planes, dtype=np.float32).reshape(shape)
        stacked = [np.array(plane, dtype=np.float32).reshape(shape) for plane in planes]
        return np.stack(stacked, axis=-1) if stacked else np.zeros((*shape, 0), np.float32)

    def to_numpy(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(colour [H, W, 3], alpha [H, W], depth [H, W]), float32."""
        return self.image("colour"), self.image("alpha"), self.image("depth")

    def over(self, background: Any) -> Any:
        """Array3f: the picture over a background colour (Array3f) or picture."""
        return self.colour + (1 - self.alpha) * background


def render(
    gaussians: Gaussians,
    camera: Projection,
    sh_degree: int | None = None,
    outputs: Sequence[str] = ("colour", "alpha", "depth"),
    features: Any = None,
    antialiased: Any = False,
) -> RenderOutput:
    """Render; differentiable with respect to every parameter of `gaussians`, `camera.values` (or `camera.moved`) and
    `features` that has gradients enabled.

    sh_degree: highest degree of spherical harmonics used, all that are stored by default
    outputs: of `OUTPUTS`, what to compute; alpha is always there
    features: C arrays [N] (a list, or an ArrayXf [C, N]) to blend beside them; values not finite count as 0
    antialiased: see `project`
    Raises ValueError for another output, or features of another length.
    """
    unknown = [name for name in outputs if name not in OUTPUTS]
    if unknown:
        raise ValueError(f"outputs: expected some of {', '.join(OUTPUTS)}, found {unknown[0]!r}")
    own = [] if features is None else [ad.Float(feature) for feature in features]
    strange = [dr.width(feature) for feature in own if dr.width(feature) not in (1, gaussians.count)]
    if strange:
        raise ValueError(f"features: expected arrays of {gaussians.count}, found one of {strange[0]}")
    if gaussians.count == 0:
        return _nothing(camera, outputs, None if features is None else len(own))

    rows = gaussians.rows()
    prepare = _trace_prepare if dr.grad_enabled(rows, camera.values) else _prepare
    splats, footprints, wanted = prepare(rows, camera, sh_degree, tuple(outputs), antialiased)
    if features is not None:
        wanted["features"] = _cleaned(own, gaussians.count)

    blended = blend(splats, footprints, [f for group in wanted.values() for f in group], camera)
    planes, found = iter(blended.planes), dict[str, list[Any]]()
    for name, group in wanted.items():
        found[name] = [next(planes) for _ in group]
    one_pixel = camera.width * camera.height == 1  # a recording gives a plane of one pixel another size
    finish = _trace_finish if one_pixel or dr.grad_enabled(blended.planes, blended.transmittance) else _finish
    alpha, depth, normal = finish(blended.transmittance, found.get("depth", []), found.get("normal", []))
    return RenderOutput(
        colour=ad.Array3f(found["colour"]) if "colour" in found else None,
        alpha=alpha,
        depth=depth,
        width=camera.width,
        height=camera.height,
        median_depth=median_depth(splats, blended.lists, camera) if "median_depth" in outputs else None,
        normal=normal,
        features=found.get("features"),
    )


def _trace_prepare(
    rows: list[Any], camera: Projection, sh_degree: int | None, outputs: tuple[str, ...], antialiased: Any
) -> tuple[Splats, Footprints, dict[str, list[Any]]]:
    """(splats, footprints, features to blend by output) of the Gaussians with these `rows`."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera, antialiased)
    wanted: dict[str, list[Any]] = {}
    if "colour" in outputs:
        wanted["colour"] = list(view_colours(gaussians, camera, sh_degree))
    if "depth" in outputs:
        wanted["depth"] = [splats.depth]
    if "normal" in outputs:
        wanted["normal"] = list(normals(gaussians, camera))
    return splats, footprints, wanted


def _cleaned(features: list[Any], count: int) -> list[Any]:
    """The user's features as Floats [count], finite."""
    features = [feature if dr.width(feature) == count else feature + dr.zeros(ad.Float, count) for feature in features]
    alike = len({feature.index for feature in features}) < len(features)  # no array may stand twice in a recorded call
    clean = _trace_clean if not features or count == 1 or alike or dr.grad_enabled(features) else _clean
    cleaned: list[Any] = clean(features)
    return cleaned


def _trace_clean(features: list[Any]) -> list[Any]:
    return [_finite(feature) for feature in features]


def _trace_finish(transmittance: Any, depth: list[Any], normal: list[Any]) -> tuple[Any, Any, Any]:
    """(alpha, expected depth, unit normals) of blended planes, None for those that were not blended."""
    alpha = 1 - transmittance
    expected = over_alpha(depth[0], alpha) if depth else None
    return alpha, expected, unit(ad.Array3f(normal)) if normal else None


@dataclass
class Blend:
    """planes: of each feature, sum of weight x value, [height * width];  transmittance: plane;  lists: of the tiles"""

    planes: list[Any]
    transmittance: Any
    lists: TileLists


def blend(splats: Splats, footprints: Footprints, features: Sequence[Any], camera: Projection) -> Blend:
    """Stages 2 and 3 for any number of features (Floats [N]) and any sign of depth. Differentiable."""
    lists = bin_splats(splats, footprints, camera.width, camera.height, few_sizes=True)
    passes = [list(features[i : i + CHANNELS]) for i in range(0, len(features), CHANNELS)] or [[]]
    planes: list[Any] = []
    transmittance: Any = None
    for group in passes:
        more, passed = rasterize(splats, group, lists, camera.width, camera.height)
        planes += more
        transmittance = passed if transmittance is None else transmittance
    return Blend(planes, transmittance, lists)


def median_depth(splats: Splats, lists: TileLists, camera: Projection) -> Any:
    """Float [height * width], metres: depth of the splat at which less than half of the light passes, 0 where it
    always does. Differentiable by the depths; which splat it is, is taken as given."""
    return picked(splats.depth, median_splat(splats, lists, camera.width, camera.height))


def _nothing(camera: Projection, outputs: Sequence[str], channels: int | None) -> RenderOutput:
    """The picture of no Gaussians."""
    zero = dr.zeros(ad.Float, camera.width * camera.height)
    found: dict[str, Any] = {name: zero for name in ("depth", "median_depth") if name in outputs}
    found |= {name: ad.Array3f(zero, zero, zero) for name in ("colour", "normal") if name in outputs}
    features = None if channels is None else [zero] * channels
    return RenderOutput(
        colour=found.get("colour"),
        alpha=zero,
        depth=found.get("depth"),
        width=camera.width,
        height=camera.height,
        median_depth=found.get("median_depth"),
        normal=found.get("normal"),
        features=features,
    )


def over_alpha(weighted: Any, alpha: Any) -> Any:
    """Blended values divided by the alpha; 0 where that is 0."""
    covered = alpha > 0
    return dr.select(covered, weighted / dr.select(covered, alpha, 1), 0)


def _finite(values: Any) -> Any:
    """`values` with 0, and no gradient, in place of what is not finite: 0 times infinity would reach other pixels."""
    return dr.select(dr.detach(dr.isfinite(values)), values, 0)


def view_colours(gaussians: Gaussians, camera: Projection, sh_degree: int | None = None) -> Any:
    """Array3f [3, N]: colour of each Gaussian seen from the camera, sRGB values >= 0 (thesis 2.17).

    c(d) = max(sum_lm a_lm Y_lm(d) + 1/2, 0), d from the camera towards the Gaussian (along the axis of an
    orthographic camera); the offset is INRIA's.
    """
    sums = harmonics(gaussians, camera, gaussians.sh_degree if sh_degree is None else sh_degree)
    return ad.Array3f([dr.select(shown(total), total, 0) for total in sums])


def harmonics(gaussians: Gaussians, camera: Projection, sh_degree: int) -> list[Any]:
    """The sums of `view_colours` before they are cut off: 3 Floats [N]."""
    degree, sh = min(sh_degree, gaussians.sh_degree), gaussians.sh
    sums = [SH_C0 * sh[c] + 0.5 for c in range(3)]
    if degree > 0:
        basis = dr.sh_eval(camera.directions_to(gaussians.means), degree)
        for k in range(1, (degree + 1) ** 2):
            sums = [total + basis[k] * sh[3 * k + c] for c, total in enumerate(sums)]
    return sums


def shown(total: Any) -> Any:
    """Whether a sum of harmonics is a colour as it is: Bool [N]. Elsewhere the colour is 0 and has no gradient."""
    total = dr.detach(total)
    return (total > 0) & (total < 1e9)


_prepare = recorded(_trace_prepare, RECORDINGS)
_clean = recorded(_trace_clean, RECORDINGS)
_finish = recorded(_trace_finish, RECORDINGS)
