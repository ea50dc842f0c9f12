"""The stages of a training step that Dr.Jit differentiates, as they are recorded and replayed."""

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32, UInt64
from spacesim.backend.packet import numbers_at
from spacesim.data.images.tone import PEAK
from spacesim.learning.adam import adam_step
from spacesim.learning.networks.joined import Joined
from spacesim.splat.raster.blend import blend_lists, bucket_pairs
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import make_boxes, make_lists
from spacesim.splat.raster.lists.boxes import Boxes, Grid
from spacesim.splat.raster.lists.capacity import Capacities
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.records import BlendResult
from spacesim.splat.raster.render import view_colors
from spacesim.splat.raster.supersample import pixel_means
from spacesim.splat.raster.surface import normals
from spacesim.splat.raster.tone import decode_srgb, encode_radiance, inverse_tone_map, tone_map
from spacesim.splat.train.downscale import covered_color, truth_of_squares, valid_squares
from spacesim.splat.train.loss.photometric import photometric_loss
from spacesim.splat.train.loss.terms import TruthPlanes, depth_loss, normal_loss, visibility_loss
from spacesim.splat.train.start import RADIUS
from spacesim.splat.train.warm_start import foreground_loss


def project_views(
    rows: list[Float],
    camera: Pinhole,
    degree: int,
    antialiased: bool,
    shape: tuple[str, ...],
    scale: float,
    watched: bool = False,
) -> tuple[Splats, Footprints, dict[str, list[Float]], Float | None]:
    """Splats, footprints, what is blended, Floats [N] by name, without gradients: "color", none where it comes from a
    field, and of `shape` "depth", in units of `scale` metres, and "normal"; and, if `watched`, `screen_radii`."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera, antialiased)
    color = [] if gaussians.features is not None else list(view_colors(gaussians, camera, degree))
    values = {"color": color, **shape_values(gaussians, splats, camera, shape, scale)}
    return splats, footprints, values, screen_radii(gaussians, splats, camera) if watched else None


@dataclass
class ViewRequest:
    """What `project_views` takes, and how many splats that is."""

    rows: list[Float]  #: of the Gaussians
    camera: Pinhole  #: with as many pixels as are blended
    degree: int  #: of the harmonics
    antialiased: bool  #: see `project`
    shape: tuple[str, ...]  #: what is blended for the sake of the shape
    scale: float  #: metres
    watched: bool  #: whether `screen_radii` are wanted
    count: UInt32  #: splats, of width 1


@dataclass
class ViewSplats:
    """A view's Gaussians, as far as they do not depend on its light."""

    splats: Splats  #: on the screen
    footprints: Footprints  #: of the splats
    values: dict[str, list[Float]]  #: what is blended, by name
    radii: Float | None  #: of `screen_radii`
    boxes: Boxes  #: of the splats


def find_view_boxes(view: ViewRequest, capacity: int, grid: Grid) -> ViewSplats:
    """`project_views`, and the tiles of the splats, `capacity` at most."""
    splats, footprints, values, radii = project_views(
        view.rows, view.camera, view.degree, view.antialiased, view.shape, view.scale, view.watched
    )
    dr.schedule(splats, footprints, values, radii)
    return ViewSplats(splats, footprints, values, radii, make_boxes(splats, footprints, view.count, capacity, grid))


def list_view(
    view: ViewRequest, limit: UInt32, capacities: Capacities, grid: Grid
) -> tuple[Splats, dict[str, list[Float]], Float | None, TileLists, UInt32 | UInt64]:
    """Of `find_view_boxes` the splats, what is blended, and radii; lists of these capacities; the boxes' `pair_ends`.
    The lists are empty where there are more pairs than `limit`."""
    drawn = find_view_boxes(view, capacities.splats, grid)
    assert drawn.boxes.pair_ends is not None
    lists = make_lists(drawn.footprints, drawn.boxes, limit, capacities, grid)
    return drawn.splats, drawn.values, drawn.radii, lists, drawn.boxes.pair_ends


@dataclass
class ListedView:
    """A view's splats in lists, to be blended."""

    splats: Splats  #: on the screen
    lists: TileLists  #: which splats each tile has
    values: list[Float]  #: what is blended, [N] each
    capacity: int  #: `round_capacity` of N: a recording that took it from an array would keep it for every N

    def blend(self, size: tuple[int, int]) -> "BlendTape":
        """Width and height, pixels."""
        bucket = bucket_pairs(self.lists, len(self.values))
        blended = blend_lists(self.splats, self.values, self.lists, *size, self.capacity, bucket)
        return BlendTape(self.splats, self.lists, blended)


@dataclass
class BlendTape:
    """What blending a view leaves behind for its way back."""

    splats: Splats  #: what was blended
    lists: TileLists  #: which splats each tile has
    blended: BlendResult  #: of the splats


@dataclass
class DrawnView:
    """A view that was listed and blended at once, without light."""

    radii: Float | None  #: of `screen_radii`
    pair_ends: UInt32 | UInt64  #: of the boxes
    tape: BlendTape  #: what its way back reads
    channels: dict[str, int]  #: how many planes each name has


def draw_view(view: ViewRequest, limit: UInt32, capacities: Capacities, grid: Grid) -> DrawnView:
    """`list_view`, and what it lists blended."""
    splats, values, radii, lists, pair_ends = list_view(view, limit, capacities, grid)
    planes, channels = in_order(values)
    tape = ListedView(splats, lists, planes, capacities.splats).blend((view.camera.width, view.camera.height))
    return DrawnView(radii, pair_ends, tape, channels)


def in_order(values: dict[str, list[Float]]) -> tuple[list[Float], dict[str, int]]:
    """Values one after another; how many each name has."""
    return [value for group in values.values() for value in group], {name: len(group) for name, group in values.items()}


def by_name(values: list[Float], counts: dict[str, int]) -> dict[str, list[Float]]:
    """The inverse of `in_order`."""
    rest = iter(values)
    return {name: [next(rest) for _ in range(count)] for name, count in counts.items()}


def screen_radii(gaussians: Gaussians, splats: Splats, camera: Pinhole) -> Float:
    """Float [N], whole pixels: `RADIUS` standard deviations along the longer axis on the screen (rho of thesis 5.4), 0
    for what is out of the picture. A Gaussian counts as seen where this is above 0, however faint it is: the `radii` of
    gsplat 1.4. What the rasterizer skips is another matter (`Footprints.visible`)."""
    product = splats.a * splats.c
    determinant = dr.rcp(dr.maximum(product - dr.square(splats.b), 1e-7 * product))  # needles cancel
    xx, yy, xy = splats.c * determinant, splats.a * determinant, -splats.b * determinant
    longest = 0.5 * (xx + yy) + dr.sqrt(dr.square(0.5 * (xx - yy)) + dr.square(xy))
    radius = dr.ceil(RADIUS * dr.sqrt(longest))
    seen = camera.in_reach(camera.transform(gaussians.means)) & (radius < MAX_MAGNITUDE)
    seen &= (splats.x + radius > 0) & (splats.x - radius < camera.width)
    seen &= (splats.y + radius > 0) & (splats.y - radius < camera.height)
    return dr.select(seen, radius, 0)


def shape_values(
    gaussians: Gaussians, splats: Splats, camera: Pinhole, shape: Iterable[str], scale: float
) -> dict[str, list[Float]]:
    """What is blended for the sake of the shape, see `project_views`, of the names in `shape`."""
    values = {}
    if "depth" in shape:
        values["depth"] = [splats.depth / scale]
    if "normal" in shape:
        values["normal"] = list(normals(gaussians, camera))
    return values


@dataclass
class TargetImage:
    """What a picture is compared with."""

    rgba: UInt32  #: UInt32 [H * W]
    background: Float  #: Float [3]
    valid: Bool  #: Bool [H * W] or of width 1
    #: Floats [H * W] by name, see `TrainingView`, and "foreground": Bool [H * W] and its weight, Float
    truth: TruthPlanes
    gains: Float | None = None  #: Float [3], of the channels of what is drawn


@dataclass(frozen=True)
class LossSettings:
    """Weights of the terms."""

    ssim: float  #: share of D-SSIM beside L1
    visibility: float  #: of the error of the blended visibility
    depth: float  #: of the error of the depth
    normal: float  #: of one less the cosine between normals
    scale: float  #: metres, the unit of depth
    tone: str | None  #: curve of colours that are blended, with the background, in linear light, or None
    supersample: int = 1  #: places on a side of each pixel, see `pixel_means`
    #: shares of PEAK of a radiance of 1 W m^-2 sr^-1: radiance is compared (`encode_radiance`); None: 8-bit pictures
    radiance: float | None = None
    downscale: int = 1  #: pixels of the target on a side of each pixel that is compared


@dataclass
class _Compared:
    """A picture and its target at the pixels that are compared."""

    picture: Array3f  #: over the target's background, with its curve
    truth: Array3f  #: likewise
    planes: dict[str, list[Float]]  #: what was blended
    transmittance: Float  #: plane
    valid: Bool  #: pixels that count
    truths: TruthPlanes  #: of `TargetImage.truth`
    size: tuple[int, int]  #: width and height


def _compare(
    planes: dict[str, list[Float]],
    transmittance: Float,
    gains: Float | None,
    target: TargetImage,
    size: tuple[int, int],
    config: LossSettings,
) -> _Compared:
    """See `picture_loss`."""
    times = config.downscale
    covered, alpha = covered_color(target.rgba, size, times, config.tone, light=config.supersample > 1)
    valid, truths = valid_squares(target.valid, size, times), truth_of_squares(target.truth, size, times)
    size = size[0] // times, size[1] // times
    below = ad.Array3f(numbers_at(target.background, range(3)))
    if config.radiance is not None:
        covered, below = config.radiance * ad.Array3f(truths["radiance"]), decode_srgb(below) / PEAK
    elif config.tone:
        below = inverse_tone_map(below, config.tone)
    if config.tone:
        dr.eval(below)  # three numbers, which each pixel would compute
    truth = covered + (1 - alpha) * below
    if config.supersample > 1:
        planes, transmittance = pixel_means(planes, transmittance, size, config.supersample, config.tone is not None)
    color = ad.Array3f(planes["color"])
    if gains is not None:
        color *= ad.Array3f(numbers_at(gains, range(3)))
    picture = dr.select(valid, color + transmittance * below, truth)
    if config.radiance is not None:
        picture, truth = encode_radiance(picture), encode_radiance(truth)
    elif config.tone:
        picture, truth = tone_map(picture, config.tone), tone_map(truth, config.tone)
    return _Compared(picture, truth, planes, transmittance, valid, truths, size)


def compared_pictures(
    planes: dict[str, list[Float]],
    transmittance: Float,
    target: TargetImage,
    size: tuple[int, int],
    config: LossSettings,
) -> tuple[Array3f, Array3f]:
    """(picture, truth), as `picture_loss` compares them."""
    compared = _compare({"color": planes["color"]}, transmittance, target.gains, target, size, config)
    return compared.picture, compared.truth


def picture_loss(
    planes: dict[str, list[Float]],
    transmittance: Float,
    target: TargetImage,
    size: tuple[int, int],
    config: LossSettings,
    known: tuple[Float, Array3f] | None = None,
) -> tuple[Float, dict[str, list[Float]], Float]:
    """Loss of a picture over the target's background, and its gradients by its planes (by name), with those by "gains"
    where the target has some, and transmittance. size: width and height of the target, pixels, before downscaling;
    known: the photometric term of `compared_pictures`, and its gradient, if they are"""
    planes = {name: [ad.Float(plane) for plane in group] for name, group in planes.items()}
    transmittance = ad.Float(transmittance)
    gains = None if target.gains is None else ad.Float(target.gains)
    dr.enable_grad(planes, transmittance, gains)
    compared = _compare(planes, transmittance, gains, target, size, config)
    valid, truths, shown = compared.valid, compared.truths, compared.planes
    terms = []
    if "visibility" in shown:
        terms.append(config.visibility * visibility_loss(shown["visibility"][0], truths["visibility"][0], valid))
    if "depth" in shown:
        depth = truths["depth"][0] / config.scale
        terms.append(config.depth * depth_loss(shown["depth"][0], compared.transmittance, depth, valid))
    if "normal" in shown:
        normal = ad.Array3f(shown["normal"]), compared.transmittance, ad.Array3f(truths["normal"])
        terms.append(config.normal * normal_loss(*normal, valid))
    if "foreground" in truths:
        mask, weight = truths["foreground"]
        terms.append(weight * foreground_loss(compared.transmittance, mask))
    if known is None:
        loss = photometric_loss(compared.picture, compared.truth, *compared.size, ssim_weight=config.ssim)
        value = dr.detach(loss)
    else:
        sums, gradient = known
        loss, value = dr.sum(compared.picture * gradient), dr.sum(sums)
        # that "loss", a number for each pixel, is no loss, but has its gradient
    for term in terms:
        value += dr.detach(term)
    for root in (loss, *terms):
        dr.set_grad(root, 1)
        dr.enqueue(dr.ADMode.Backward, root)
    dr.traverse(dr.ADMode.Backward)
    grad_planes = {name: [dr.grad(plane) for plane in group] for name, group in planes.items()}
    if gains is not None:
        grad_planes["gains"] = [dr.grad(gains)]
    return value, grad_planes, dr.grad(transmittance)


NetworkStep = tuple[list[Float], tuple[list[Float], list[Float]], list[list[Float]], Float]
"""What `update_light` takes: weights and embeddings, their first and second moments, gradients by them of each view,
factors."""


def update_light(
    weights: list[Float], moments: tuple[list[Float], list[Float]], gradients: list[list[Float]], factors: Float
) -> tuple[list[Float], list[Float], list[Float]]:
    """An Adam step of the networks by their mean gradient, and of the pictures' embeddings, which stand behind their
    weights. factors: Float [3] or, with embeddings, [4]: two corrections, the networks' step size, the embeddings'"""
    count = dr.width(factors)
    numbers = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in range(count)]
    rates, corrections = [numbers[2]] * (len(weights) - count + 3) + numbers[3:], (numbers[0], numbers[1])
    if select() == "llvm":
        means = [mean(list(of_views)) for of_views in zip(*gradients, strict=True)]
        return adam_step(weights, means, moments, rates, corrections)
    joined = Joined([dr.width(weight) for weight in weights])
    gradient = mean([joined.load(of_view) for of_view in gradients])
    first, second = (joined.load(arrays) for arrays in moments)
    rows, of_all = [joined.load(weights)], [joined.repeat(rates)]
    moved, first_moments, second_moments = adam_step(rows, [gradient], ([first], [second]), of_all, corrections)
    return joined.split(moved[0]), joined.split(first_moments[0]), joined.split(second_moments[0])


def mean(values: list[Float]) -> Float:
    """Of some views' gradients."""
    return values[0] if len(values) == 1 else sum(values[1:], values[0]) / len(values)
