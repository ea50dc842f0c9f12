"""Gaussians to splats of one camera, and the adjoint of that, as recorded calls on flat arrays.

Both write what torch gets row by row themselves: a direction is one call.
"""

from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float, Int32
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic, Pinhole, Projection, Self
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Footprints, Splats, project_ellipsoids
from spacesim.splat.raster.render import harmonics, is_unclamped
from spacesim.torch.arguments import RasterSettings
from spacesim.torch.convert import row_parts, rows

BORDER = 0.15  #: of the image beyond its border: splats are linearized no farther, as gsplat has it
TABLE = 8  #: numbers of a row of `ProjectedSplats.table`
INTRINSICS = (0, 4, 2, 5)  #: places, in an intrinsic matrix row by row, of fx, fy, cx, cy
WIDEST_SPLAT = 2**30  #: pixels: an int32 holds no more


@dataclass
class Leaves:
    """Flat arrays of a call: [N * size] of the Gaussians, and one camera's."""

    means: Float  #: metres, 3 numbers a Gaussian
    quats: Float  #: (w, x, y, z), of any length
    scales: Float  #: metres, 3 numbers a Gaussian
    opacities: Float  #: in [0, 1]
    harmonics: Float | None  #: three times K a Gaussian, K at least (degree + 1)^2; or None
    viewmat: Float  #: world to camera, row by row, 16 numbers
    intrinsics: Float  #: row by row, 9 numbers


@dataclass(frozen=True)
class NeededGradients:
    """Of which leaves gradients are asked for. Each number of a camera costs a sum over all Gaussians."""

    means: bool  #: whether of the centres
    quats: bool  #: whether of the rotations
    scales: bool  #: whether of the scales
    opacities: bool  #: whether of the opacities
    harmonics: bool  #: whether of the spherical harmonics
    viewmat: bool  #: whether of the camera's pose
    intrinsics: bool  #: whether of its focal lengths and principal point


@dataclass
class ProjectedSplats:
    """What projecting found, as Dr.Jit's arrays without gradients."""

    splats: Splats  #: ellipses on the screen, [N]
    footprints: Footprints  #: which can be seen, and where
    colors: list[Float]  #: of harmonics, three Floats [N]; else none
    means2d: Float  #: rows x, y, pixels; N rows at least
    table: Float  #: rows of `TABLE` numbers: a, b, c of `Splats`, opacity, depth, and colours or 0
    radii: Int32  #: rows of two, pixels, 0 of what is not drawn


@dataclass
class LeafGradients:
    """Gradients of `Leaves`, flat, of N Gaussians at least; None of those that were not wanted."""

    means: Float | None = None  #: three numbers a Gaussian
    quats: Float | None = None  #: four
    scales: Float | None = None  #: three
    opacities: Float | None = None  #: one
    harmonics: Float | None = None  #: as many as there are
    viewmat: list[Float] | None = None  #: 16 numbers
    intrinsics: list[Float] | None = None  #: fx, fy, cx, cy


@dataclass
class _NearFarPlanes(Projection):
    """Between a near and a far plane, metres. `values` stay unread: to put numbers that are computed side by side takes
    a kernel each."""

    numbers: list[Float] = field(default_factory=list)  #: those of `values`
    near: float = 0.0
    far: float = 0.0
    #: of the camera; harmonics are asked for in directions from there, which gsplat does of orthographic
    #: cameras, too
    place: Array3f = field(default_factory=lambda: ad.Array3f(0))

    def __getitem__(self, index: int) -> Float:
        return self.numbers[index]

    def evaluated(self: Self) -> Self:
        """The camera itself: its numbers are in no array."""
        return self

    def in_reach(self, center: Array3f) -> Bool:
        return (center.z > self.near) & (center.z < self.far) & (dr.max(dr.abs(center)) < MAX_MAGNITUDE)

    def rays_to(self, points: Array3f) -> Array3f:
        return points - self.place


@dataclass
class _NearFarPinhole(_NearFarPlanes, Pinhole):
    """A pinhole camera."""


@dataclass
class _NearFarOrthographic(_NearFarPlanes, Orthographic):
    """An orthographic camera."""


@dataclass
class _Inputs:
    """What a camera's splats depend on, as columns [N] and numbers of width 1."""

    means: list[Float]
    quats: list[Float]
    scales: list[Float]
    opacities: list[Float]  #: one
    harmonics: list[Float]  #: none, or three times (degree + 1)^2
    viewmat: list[Float]  #: 16 numbers, row by row
    intrinsics: list[Float]  #: fx, fy, cx, cy

    @staticmethod
    def of(leaves: Leaves, degree: int | None) -> "_Inputs":
        """degree: of the harmonics that are used."""
        count = dr.width(leaves.opacities)
        sh: list[Float] = []
        if leaves.harmonics is not None and degree is not None:
            stored = dr.width(leaves.harmonics) // count
            sh = row_parts(leaves.harmonics, 3 * (degree + 1) ** 2, stored, count)
        return _Inputs(
            means=row_parts(leaves.means, 3, 3, count),
            quats=row_parts(leaves.quats, 4, 4, count),
            scales=row_parts(leaves.scales, 3, 3, count),
            opacities=[ad.Float(leaves.opacities)],
            harmonics=sh,
            viewmat=[dr.gather(ad.Float, leaves.viewmat, ad.UInt32(i)) for i in range(16)],
            intrinsics=[dr.gather(ad.Float, leaves.intrinsics, ad.UInt32(i)) for i in INTRINSICS],
        )


@recorded(elements=lambda arrays, *_rest, **_named: dr.width(arrays[0]) // 3)
def project(leaves: Leaves, settings: RasterSettings, capacity: int) -> ProjectedSplats:
    """Splats of one camera. capacity: rows of the arrays, N at least, by `round_capacity`."""
    splats, footprints, colors = _splats_of(_Inputs.of(leaves, settings.degree), settings)
    s, count = splats, dr.width(leaves.opacities)
    halves = footprints.half_width, footprints.half_height
    radii = [ad.Int32(dr.select(footprints.visible, dr.minimum(dr.ceil(half), WIDEST_SPLAT), 0)) for half in halves]
    return ProjectedSplats(
        splats=splats,
        footprints=footprints,
        colors=colors,
        means2d=rows([s.x, s.y], 2, count, capacity),
        table=rows([s.a, s.b, s.c, s.opacity, s.depth, *colors], TABLE, count, capacity),
        radii=rows(radii, 2, count, capacity),
    )


@recorded(elements=lambda arrays, *_rest, **_named: dr.width(arrays[0]) // 3)
def project_back(
    leaves: Leaves,
    settings: RasterSettings,
    wanted: NeededGradients,
    grad_means2d: Float | None,
    grad_table: Float | None,
    capacity: int,
) -> LeafGradients:
    """The adjoint of `project`. grad_means2d [N * 2], grad_table [N * TABLE]: gradients of these, None of one that is
    all zeros;  capacity: as there"""
    inputs = _Inputs.of(leaves, settings.degree)
    known = {name: getattr(inputs, name) for name, one in vars(wanted).items() if one}
    for group in known.values():
        for value in group:
            dr.enable_grad(value)
    splats, _, colors = _splats_of(inputs, settings)
    s = splats
    total, count = ad.Float(0), dr.width(leaves.opacities)
    for given, values in ((grad_means2d, [s.x, s.y]), (grad_table, [s.a, s.b, s.c, s.opacity, s.depth, *colors])):
        if given is not None:
            slopes = row_parts(given, len(values), dr.width(given) // count, count)
            for value, slope in zip(values, slopes, strict=True):
                total += value * slope
    if dr.grad_enabled(total):
        dr.backward(total)
    gradients: dict[str, Any] = {name: [dr.grad(value) for value in group] for name, group in known.items()}
    for name, size in (("means", 3), ("quats", 4), ("scales", 3), ("opacities", 1)):
        if name in gradients:
            gradients[name] = rows(gradients[name], size, count, capacity)
    if "harmonics" in gradients:
        gradients["harmonics"] = rows(gradients["harmonics"], dr.width(leaves.harmonics) // count, count, capacity)
    return LeafGradients(**gradients)


def _splats_of(inputs: _Inputs, settings: RasterSettings) -> tuple[Splats, Footprints, list[Float]]:
    """(splats, footprints, colours of harmonics or none)."""
    (opacity,) = inputs.opacities
    camera = _camera(inputs, settings)
    sane = dr.isfinite(opacity) & (opacity > 0)
    for row in (*inputs.means, *inputs.quats, *inputs.scales):
        sane &= dr.isfinite(row) & (dr.abs(row) < MAX_MAGNITUDE)
    sane = dr.detach(sane)
    centre, turn, size = (
        [dr.select(sane, row, 0) for row in group] for group in (inputs.means, inputs.quats, inputs.scales)
    )
    splats, footprints = project_ellipsoids(
        ad.Array3f(centre),
        ad.Array3f(size),
        ad.Array4f(turn),
        dr.select(sane, opacity, 0),
        sane,
        camera,
        settings.eps2d,
        settings.antialiased,
    )
    if settings.radius_clip > 0:
        small = dr.ceil(dr.maximum(footprints.half_width, footprints.half_height)) <= settings.radius_clip
        footprints.visible &= ~small
    if settings.degree is None or not inputs.harmonics:
        return splats, footprints, []
    model = Gaussians(ad.Array3f(centre), ad.Array3f(), ad.Array4f(), opacity, ad.ArrayXf(inputs.harmonics))
    sums = harmonics(model, camera, settings.degree)
    return splats, footprints, [dr.select(is_unclamped(total), total, 0) for total in sums]


def _camera(inputs: _Inputs, settings: RasterSettings) -> Projection:
    """The camera, differentiable by its pose, its intrinsics and its place."""
    matrix, (fx, fy, cx, cy) = inputs.viewmat, inputs.intrinsics
    zero = ad.Float(0)
    numbers = [*matrix[:12], fx, fy, cx, cy, zero, zero]
    kind: Any = _NearFarOrthographic
    if not settings.ortho:
        kind = _NearFarPinhole
        (f, g), (x, y) = dr.detach([fx, fy]), dr.detach([cx, cy])
        numbers += [(edge * settings.width - x) / f for edge in (-BORDER, 1 + BORDER)]
        numbers += [(edge * settings.height - y) / g for edge in (-BORDER, 1 + BORDER)]
    camera: Projection = kind(
        values=None,
        width=settings.width,
        height=settings.height,
        numbers=numbers,
        near=settings.near,
        far=settings.far,
        place=_camera_position(matrix),
    )
    return camera


def _camera_position(matrix: list[Float]) -> Array3f:
    """Where the camera stands: what the inverse of a matrix [16] makes of the origin, three numbers over the fourth, so
    that it depends on the last row as the inverse does."""
    rotation = [ad.Array3f(matrix[i : i + 3]) for i in (0, 4, 8)]
    adjugate = [
        dr.cross(rotation[1], rotation[2]),
        dr.cross(rotation[2], rotation[0]),
        dr.cross(rotation[0], rotation[1]),
    ]
    total = adjugate[0] * matrix[3] + adjugate[1] * matrix[7] + adjugate[2] * matrix[11]
    place = -total / dr.dot(rotation[0], adjugate[0])
    return place / (dr.dot(ad.Array3f(matrix[12:15]), place) + matrix[15])
