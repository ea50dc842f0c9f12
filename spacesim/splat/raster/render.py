"""project -> bin -> rasterize -> RenderOutput: one differentiable picture of Gaussians (thesis 2.2).

What a picture shows beside colour is blended as features of the Gaussians: `blend` takes any number of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, ArrayXf, Bool, Float, UInt32, UInt64
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.backend.upload import held
from spacesim.data.errors import InputError
from spacesim.data.structure import checked
from spacesim.splat.raster.blend import blend_planes, rasterize
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.lists.bin import bin_splats, make_boxes, make_lists
from spacesim.splat.raster.lists.boxes import Boxes, Grid
from spacesim.splat.raster.lists.capacity import Capacities, Extent, list_capacity
from spacesim.splat.raster.lists.counting import picture_lists
from spacesim.splat.raster.lists.pictures import expected_capacity, observe
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.output import OUTPUTS, RenderOutput, over_alpha
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.records import ListedRecords, list_records, pack_records
from spacesim.splat.raster.surface import gather_or_zero, median_splat, normals, unit

PLANES = {"color": 3, "depth": 1, "normal": 3}  #: that are blended for an output
FEATURES_PER_PASS = 16  #: features in one pass: fewer repeat the blending, more gain little
MANY_PIXELS = 2**19  #: from which on a picture on CUDA takes longer than to ask for it


@checked
def render(
    gaussians: Gaussians,
    camera: Projection,
    sh_degree: int | None = None,
    outputs: str | Sequence[str] = ("color", "alpha", "depth"),
    features: ArrayXf | Sequence[Float] | None = None,
    antialiased: Bool | bool = False,
) -> RenderOutput:
    """Render; differentiable with respect to every parameter of `gaussians`, `camera.values` (or `camera.moved`) and
    `features` that has gradients enabled.

    sh_degree: highest degree of spherical harmonics used, all that are stored by default
    outputs: of `OUTPUTS`, what to compute, one or several; alpha is always there
    features: C arrays [N] (a list, or an ArrayXf [C, N]) to blend beside them; values not finite count as 0
    antialiased: see `project`
    Raises InputError for another output or degree, or features of another length.
    """
    try:
        names: tuple[Any, ...] = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    except TypeError:
        names = (outputs,)
    unknown = [name for name in names if name not in OUTPUTS]
    if unknown:
        raise InputError(f"outputs: expected some of {', '.join(OUTPUTS)}, found {unknown[0]!r}")
    if not isinstance(antialiased, bool | dr.ArrayBase):
        raise InputError(f"antialiased: expected true or false, found {antialiased!r}")
    try:
        feature_list = [] if features is None else [ad.Float(feature) for feature in features]
    except TypeError:
        raise InputError(f"features: expected arrays of {gaussians.count}, found {features!r:.60}") from None
    wrong_widths = [dr.width(feature) for feature in feature_list if dr.width(feature) not in (1, gaussians.count)]
    if wrong_widths:
        raise InputError(f"features: expected arrays of {gaussians.count}, found one of {wrong_widths[0]}")
    if sh_degree is not None and not 0 <= sh_degree <= max(gaussians.sh_degree, 0):
        raise InputError(f"sh_degree: expected 0 to {gaussians.sh_degree}, as stored, found {sh_degree}")
    if gaussians.count == 0:
        return _empty_output(camera, names, None if features is None else len(feature_list))

    inputs = gaussians.rows(), camera, sh_degree, names, antialiased  # of `prepare`
    more = {} if features is None else {"features": _whole_features(feature_list, gaussians.count)}
    blended = sum(PLANES.get(name, 0) for name in names) + len(feature_list)
    splats: Splats | None
    if blended > FEATURES_PER_PASS or dr.grad_enabled(inputs[0], camera.values, feature_list):
        splats, footprints, groups = _prepare_all(inputs, more)
        lists, planes = _draw_in_stages(splats, footprints, groups, camera)
    else:
        splats, lists, planes = _draw(inputs, more, "median_depth" in names)
    return RenderOutput(
        color=ad.Array3f(planes["color"]) if "color" in planes else None,
        alpha=planes["alpha"][0],
        depth=planes["depth"][0] if "depth" in planes else None,
        width=camera.width,
        height=camera.height,
        median_depth=median_depth(splats, lists, camera) if splats and lists and "median_depth" in names else None,
        normal=ad.Array3f(planes["normal"]) if "normal" in planes else None,
        features=planes.get("features"),
    )


Planes = dict[str, list[Float]]
"""Planes of a picture, or what is blended to them, Floats [N], by the name of an output."""


Counts = tuple[tuple[str, int], ...]
"""Names of outputs, and how many planes each has."""


Inputs = tuple[list[Float], Projection, int | None, tuple[str, ...], Bool | bool]
"""What `prepare` takes."""


def _draw_in_stages(
    splats: Splats, footprints: Footprints, groups: Planes, camera: Projection
) -> tuple[TileLists | None, Planes]:
    """(the tiles' lists, planes) of what is blended in any number of passes, differentiable."""
    blended = blend(splats, footprints, _features(groups), camera)
    return blended.lists, _finish(blended.planes, blended.transmittance, _counts(groups))


def _draw(inputs: Inputs, more: Planes, keeps_splats: bool) -> tuple[Splats | None, TileLists | None, Planes]:
    """(splats, if they are wanted; the tiles' lists; planes) without gradients and in one pass; more would hold the
    memory of all.

    Where the number of pairs is expected, the host reads it when all is asked for: of a large picture while that is
    blended, which takes a second recording, and that as long as some kernels. Where it is not, the host waits for it
    between two recordings, on a CPU of more parts. more: blended beside the outputs"""
    rows, camera, *_ = inputs
    size, count = (camera.width, camera.height), dr.width(rows[0])
    extent = Extent.of(count, *size, few_sizes=True)
    grid, most = extent.grid, extent.most
    counts = tuple((name, PLANES[name]) for name in PLANES if name in inputs[3]) + _counts(more)
    expected = expected_capacity(extent)
    if expected is not None:
        listing = extent.live, held(expected, "pairs"), extent.capacities(expected), grid
        if size[0] * size[1] >= MANY_PIXELS and can_read_async():
            listed = _list_splats(inputs, more, keeps_splats, *listing)
            number = AsyncNumber(listed.sums)
            planes = _blend_packed(listed.records, listed.lists, counts, size, most)
            pairs = number.wait()
        else:
            listed, planes = _draw_at_once(inputs, more, keeps_splats, counts, *listing)
            pairs = int(listed.sums[grid.tiles - 1])
        observe(extent, pairs)
        if 0 < pairs <= expected:
            return listed.splats, listed.lists, planes
        del listed, planes  # frees memory for the next
    prepared = _prepare_boxes(inputs, more, extent.live, most, grid)
    pairs = prepared.boxes.pairs
    capacity = list_capacity(pairs, extent)
    observe(extent, pairs)
    if capacity == 0:
        return prepared.splats, *_draw_in_stages(prepared.splats, prepared.footprints, prepared.groups, camera)
    draw = _draw_boxes if is_usable() else _draw_boxes_at_once  # kernels of text stand between recordings
    return prepared.splats, *draw(prepared, counts, size, held(capacity, "pairs"), extent.capacities(capacity), grid)


@dataclass
class _Prepared:
    """What is drawn of a picture's Gaussians, but for the lists."""

    splats: Splats
    footprints: Footprints
    groups: Planes  #: to blend
    records: list[Float]  #: `pack_records` of all that is blended
    boxes: Boxes


@dataclass
class _Listed:
    """A picture's Gaussians in lists."""

    splats: Splats | None  #: where they are wanted
    records: list[Float]  #: `pack_records` of all that is blended
    lists: TileLists
    sums: UInt32 | UInt64  #: of the lists' lengths


@recorded
def _list_splats(
    inputs: Inputs,
    more: Planes,
    keeps_splats: bool,
    count: UInt32,
    limit: UInt32,
    capacities: Capacities,
    grid: Grid,
) -> _Listed:
    """Lists of `count` splats, of these capacities. more: blended beside the outputs"""
    splats, footprints, groups = _prepare_all(inputs, more)
    records, kept = pack_records(splats, _features(groups), capacities.splats), splats if keeps_splats else None
    dr.schedule(records, kept)
    return _Listed(kept, records, *picture_lists(splats, footprints, count, limit, capacities, grid))


@recorded(elements=lambda arrays, inputs, *_: min(dr.width(arrays[0]), inputs[1].width * inputs[1].height))
def _draw_at_once(
    inputs: Inputs,
    more: Planes,
    keeps_splats: bool,
    counts: Counts,
    count: UInt32,
    limit: UInt32,
    capacities: Capacities,
    grid: Grid,
) -> tuple[_Listed, Planes]:
    """`_list_splats`, and the planes."""
    listed = _list_splats(inputs, more, keeps_splats, count, limit, capacities, grid)
    size = inputs[1].width, inputs[1].height
    return listed, _blend_packed(listed.records, listed.lists, counts, size, capacities.splats)


@recorded
def _prepare_boxes(inputs: Inputs, more: Planes, count: UInt32, capacity: int, grid: Grid) -> _Prepared:
    """Of `count` splats [capacity]. more: blended beside the outputs"""
    splats, footprints, groups = _prepare_all(inputs, more)
    records = pack_records(splats, _features(groups), capacity)
    dr.eval(splats, footprints, groups, records)
    return _Prepared(splats, footprints, groups, records, make_boxes(splats, footprints, count, capacity, grid))


def _draw_boxes(
    prepared: _Prepared,
    counts: Counts,
    size: tuple[int, int],
    limit: UInt32,
    capacities: Capacities,
    grid: Grid,
) -> tuple[TileLists, Planes]:
    """(the lists; planes)."""
    lists = make_lists(prepared.footprints, prepared.boxes, limit, capacities, grid)
    records = list_records(prepared.records, lists, capacities.splats)
    return lists, _blend_records(records, lists, counts, size, capacities.splats)


_draw_boxes_at_once = recorded(_draw_boxes, elements=lambda _, _prepared, _counts, size, *_rest: size[0] * size[1])


@recorded(elements=lambda _, _records, _lists, _counts, size, *_rest: size[0] * size[1])
def _blend_packed(
    packed: list[Float], lists: TileLists, counts: Counts, size: tuple[int, int], capacity: int
) -> Planes:
    """Planes of `packed`, `pack_records` of all that is blended, with this capacity."""
    return _blend_records(list_records(packed, lists, capacity), lists, counts, size, capacity)


@recorded(elements=lambda _, _records, _lists, _counts, size, *_rest: size[0] * size[1])
def _blend_records(
    records: ListedRecords, lists: TileLists, counts: Counts, size: tuple[int, int], capacity: int
) -> Planes:
    """Planes of `records` of all that is blended. capacity: of the splats"""

    def finish(transmittance: Float, sums: list[Float]) -> list[Float]:
        return _features(_finish(sums, transmittance, counts))

    channels = sum(count for _, count in counts)
    planes, _ = blend_planes(records, channels, lists, size, capacity, finish)
    return _by_name(planes[:-1], counts) | {"alpha": planes[-1:]}


def _features(groups: Planes) -> list[Float]:
    return [feature for group in groups.values() for feature in group]


@recorded
def prepare(
    rows: list[Float], camera: Projection, sh_degree: int | None, outputs: tuple[str, ...], antialiased: Bool | bool
) -> tuple[Splats, Footprints, Planes]:
    """(splats, footprints, features to blend by output) of the Gaussians with these `rows`."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera, antialiased)
    groups: Planes = {}
    if "color" in outputs:
        groups["color"] = list(view_colors(gaussians, camera, sh_degree))
    if "depth" in outputs:
        groups["depth"] = [splats.depth]
    if "normal" in outputs:
        groups["normal"] = list(normals(gaussians, camera))
    return splats, footprints, groups


@recorded
def _prepare_all(inputs: Inputs, more: Planes) -> tuple[Splats, Footprints, Planes]:
    """`prepare`, and the user's features, finite."""
    splats, footprints, groups = prepare(*inputs)
    return splats, footprints, groups | {name: [_finite(one) for one in group] for name, group in more.items()}


def _whole_features(features: list[Float], count: int) -> list[Float]:
    """The user's features as Floats [count]."""
    return [feature if dr.width(feature) == count else feature + dr.zeros(ad.Float, count) for feature in features]


def _counts(groups: Planes) -> Counts:
    return tuple((name, len(group)) for name, group in groups.items())


def _by_name(planes: list[Float], counts: Counts) -> Planes:
    """Planes, one after another, by the names of what was blended."""
    rest = iter(planes)
    return {name: [next(rest) for _ in range(count)] for name, count in counts}


def _finish(planes: list[Float], transmittance: Float, counts: Counts) -> Planes:
    """Planes of what was blended by its names, with expected depth, unit normals and, last, "alpha"."""
    finished = _by_name(planes, counts)
    finished["alpha"] = [1 - transmittance]
    if "depth" in finished:
        finished["depth"] = [over_alpha(finished["depth"][0], finished["alpha"][0])]
    if "normal" in finished:
        finished["normal"] = list(unit(ad.Array3f(finished["normal"])))
    return finished


@dataclass
class BlendedPlanes:
    """Blended features of a picture."""

    planes: list[Float]  #: of each feature, sum of weight x value, [height * width]
    transmittance: Float  #: plane
    lists: TileLists  #: of the tiles


def blend(splats: Splats, footprints: Footprints, features: Sequence[Float], camera: Projection) -> BlendedPlanes:
    """Stages 2 and 3 for any number of features (Floats [N]) and any sign of depth. Differentiable."""
    lists = bin_splats(splats, footprints, camera.width, camera.height, few_sizes=True)
    passes = [list(features[i : i + FEATURES_PER_PASS]) for i in range(0, len(features), FEATURES_PER_PASS)] or [[]]
    planes: list[Float] = []
    passed: list[Float] = []
    for group in passes:
        group_planes, transmittance = rasterize(splats, group, lists, camera.width, camera.height)
        planes += group_planes
        passed.append(transmittance)
    return BlendedPlanes(planes, passed[0], lists)


def median_depth(splats: Splats, lists: TileLists, camera: Projection) -> Float:
    """Float [height * width], metres: depth of the splat at which less than half of the light passes, 0 where it
    always does. Differentiable by the depths; which splat it is, is taken as given."""
    return gather_or_zero(splats.depth, median_splat(splats, lists, camera.width, camera.height))


def _empty_output(camera: Projection, outputs: Sequence[str], channels: int | None) -> RenderOutput:
    """The picture of no Gaussians."""
    zero = dr.zeros(ad.Float, camera.width * camera.height)
    empty: dict[str, Float] = {name: zero for name in ("depth", "median_depth") if name in outputs}
    colors = {name: ad.Array3f(zero, zero, zero) for name in ("color", "normal") if name in outputs}
    features = None if channels is None else [zero] * channels
    return RenderOutput(
        color=colors.get("color"),
        alpha=zero,
        depth=empty.get("depth"),
        width=camera.width,
        height=camera.height,
        median_depth=empty.get("median_depth"),
        normal=colors.get("normal"),
        features=features,
    )


def _finite(values: Float) -> Float:
    """`values` with 0, and no gradient, in place of what is not finite: 0 times infinity would reach other pixels."""
    return dr.select(dr.detach(dr.isfinite(values)), values, 0)


def view_colors(gaussians: Gaussians, camera: Projection, sh_degree: int | None = None) -> Array3f:
    """Array3f [3, N]: colour of each Gaussian seen from the camera, sRGB values >= 0 (thesis 2.17).

    c(d) = max(sum_lm a_lm Y_lm(d) + 1/2, 0), d from the camera towards the Gaussian (along the axis of an
    orthographic camera); the offset is INRIA's.
    """
    sums = harmonics(gaussians, camera, gaussians.sh_degree if sh_degree is None else sh_degree)
    return ad.Array3f([dr.select(is_unclamped(total), total, 0) for total in sums])


def harmonics(gaussians: Gaussians, camera: Projection, sh_degree: int) -> list[Float]:
    """The sums of `view_colors` before they are cut off: 3 Floats [N]."""
    degree, sh = min(sh_degree, gaussians.sh_degree), gaussians.sh
    sums = [SH_C0 * sh[c] + 0.5 for c in range(3)]
    if degree > 0:
        basis = dr.sh_eval(camera.directions_to(gaussians.means), degree)
        for k in range(1, (degree + 1) ** 2):
            sums = [total + basis[k] * sh[3 * k + c] for c, total in enumerate(sums)]
    return sums


def is_unclamped(total: Float) -> Bool:
    """Whether a sum of harmonics is a colour as it is: Bool [N]. Elsewhere the colour is 0 and has no gradient."""
    total = dr.detach(total)
    return (total > 0) & (total < 1e9)
