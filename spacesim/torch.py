"""gsplat's `rasterization` over Dr.Jit's kernels: for torch, on CUDA and on any CPU, without a compiler.

    from spacesim.torch import rasterization

It takes the arguments of gsplat 1.5.3's function of that name (V. Ye et al., "gsplat: An open-source library for
Gaussian splatting", 2025), in their order, and returns what it returns; what is not supported ends in one sentence.
Tensors on a CUDA device run on CUDA, others on the CPU, one of the two in a process. On a CPU torch's threads wait by
spinning and take cores from the kernels: `torch.set_num_threads(1)`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from spacesim import backend

try:
    import torch
    from torch import Tensor
except ImportError:
    raise ImportError("spacesim.torch: expected torch, found none; type: pip install torch") from None

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.splat.raster.bin import RECORDINGS, bin_splats
from spacesim.splat.raster.blend import backward, forward
from spacesim.splat.raster.cameras import LARGEST, Orthographic, Pinhole, Projection
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Footprints, Splats, project_ellipsoids
from spacesim.splat.raster.render import CHANNELS, harmonics, shown

Results = tuple[Tensor, Tensor, dict[str, Any]]

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
BORDER = 0.15  #: of the image beyond its border: splats are linearized no farther, as gsplat has it
MATRIX = 5  #: number of the leaf that is a view's matrix; its intrinsics follow
INTRINSICS = 0, 4, 2, 5  #: places of fx, fy, cx, cy in a matrix [9]
LEAST_ALPHA = 1e-10  #: by which "ED" divides at least, as gsplat


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> Results:
    """Render N Gaussians with C cameras, differentiable by every tensor that requires gradients.

    means: [N, 3] metres;  quats: [N, 4] (w, x, y, z), of any length;  scales: [N, 3] standard deviations, metres
    opacities: [N] in [0, 1]
    colors: [N, K, 3] or [C, N, K, 3] harmonics where `sh_degree` is given, else [N, D] or [C, N, D] of any D
    viewmats: [C, 4, 4] world to camera, OpenCV axes;  Ks: [C, 3, 3] pinhole intrinsics, pixels (of an "ortho" camera
        pixels per metre)
    near_plane, far_plane: metres;  radius_clip: pixels, splats no larger are not drawn
    eps2d: pixels^2 added to the screen-space covariance;  rasterize_mode: "classic", or "antialiased": what that adds
        to a splat's area is taken from its opacity
    backgrounds: [C, D] or None;  render_mode: "RGB", "D" (summed depth), "ED" (expected depth), "RGB+D", "RGB+ED"
    absgrad: means2d gets the attribute `absgrad` [C, N, 2] in the backward pass
    packed, tile_size, channel_chunk, segmented: taken and without effect; pictures are the same

    Returns (pictures [C, H, W, D], depth last; alphas [C, H, W, 1]; a dictionary with means2d [C, N, 2] (pixels, which
    `retain_grad` works on), conics [C, N, 3], opacities [C, N], depths [C, N], radii [C, N, 2] int32, width, height,
    n_cameras, tile_size). Raises ValueError for shapes that do not fit and for what is not supported.
    """
    unsupported = {
        "sparse_grad": sparse_grad,
        "distributed": distributed,
        "covars": covars is not None,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs is not None,
        "tangential_coeffs": tangential_coeffs is not None,
        "thin_prism_coeffs": thin_prism_coeffs is not None,
        "ftheta_coeffs": ftheta_coeffs is not None,
        "viewmats_rs": viewmats_rs is not None,
        "rolling_shutter": rolling_shutter is not None and getattr(rolling_shutter, "name", "GLOBAL") != "GLOBAL",
    }
    for name, asked in unsupported.items():
        if asked:
            raise ValueError(f"{name}: not supported by spacesim.torch.rasterization, leave it out")
    _check_choice("render_mode", render_mode, RENDER_MODES)
    _check_choice("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    _check_choice("camera_model", camera_model, ("pinhole", "ortho"))
    count, cameras = _check_shapes(means, quats, scales, opacities, viewmats, Ks, width, height)
    _check_colors(colors, backgrounds, sh_degree, render_mode, count, cameras)
    backend.select("cuda" if means.is_cuda else "llvm")
    kind = _Kind(
        width,
        height,
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        rasterize_mode == "antialiased",
        camera_model == "ortho",
    )
    views = []
    places = torch.linalg.inv(viewmats)[:, :3, 3]
    for index in range(cameras):
        own = colors[index] if colors.dim() == (4 if sh_degree is not None else 3) else colors
        harmonic = own if sh_degree is not None else None
        camera = (tensor[index].clone() for tensor in (viewmats, Ks, places))  # each where memory begins
        view = _Projected.apply(means, quats, scales, opacities, harmonic, *camera, kind, sh_degree)
        views.append((*view, _features(render_mode, view[4] if harmonic is not None else own, view[2])))
    means2d = _stacked([view[0] for view in views])  # one tensor for all cameras, which can retain its gradient
    blended = []
    for index, (_, conics, _, opacity, _, drawn, features) in enumerate(views):
        target = (means2d, index) if absgrad else None
        blended.append(_Blended.apply(means2d[index], conics, opacity, features, drawn, width, height, target))
    picture, alpha = (_stacked([one[k] for one in blended]) for k in range(2))
    picture = _finished(picture, alpha, backgrounds, render_mode)
    meta = {
        "means2d": means2d,
        "conics": _stacked([view[1] for view in views]),
        "opacities": _stacked([view[3] for view in views]),
        "depths": _stacked([view[2] for view in views]),
        "radii": _stacked([_radii(view[5].footprints, means.device) for view in views]),
        "width": width,
        "height": height,
        "n_cameras": cameras,
        "tile_size": tile_size,
        "camera_ids": None,
        "gaussian_ids": None,
    }
    return picture, alpha, meta


@dataclass(frozen=True)
class _Kind:
    """What of a call is no tensor. See `rasterization`."""

    width: int
    height: int
    near: float
    far: float
    radius_clip: float
    spread: float
    antialiased: bool
    ortho: bool


@dataclass
class _Between(Projection):
    """Between a near and a far plane, metres. place: three Floats; harmonics are asked for in directions from there,
    which gsplat does of orthographic cameras, too."""

    near: float = 0.0
    far: float = 0.0
    place: Any = None

    def in_reach(self, center: Any) -> Any:
        return (center.z > self.near) & (center.z < self.far) & (dr.max(dr.abs(center)) < LARGEST)

    def rays_to(self, points: Any) -> Any:
        return points - ad.Array3f(self.place)


@dataclass
class _Perspective(_Between, Pinhole):
    """A pinhole camera."""


@dataclass
class _Parallel(_Between, Orthographic):
    """An orthographic camera."""


@dataclass
class _Drawn:
    """What projecting found, as Dr.Jit's arrays without gradients."""

    splats: Splats
    footprints: Footprints


class _Projected(torch.autograd.Function):
    """Gaussians to splats of one camera: (means2d [N, 2], conics [N, 3], depths [N], opacities [N], colours [N, 3] or
    [N, 0], `_Drawn`)."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        """means, quats, scales, opacities, harmonics or None, viewmat, K, camera's place;  `_Kind`, degree."""
        *tensors, kind, degree = arguments
        ctx.set_materialize_grads(False)
        device, count = tensors[0].device, len(tensors[0])
        leaves = [None if tensor is None else _floats(tensor) for tensor in tensors]
        run = _project if count > 1 else _trace_project  # a recording takes a column of one for a number
        splats, footprints, colours = run(leaves, kind, degree)
        ctx.leaves, ctx.told, ctx.tensors = leaves, (kind, degree), tensors
        groups = [splats.x, splats.y], [splats.a, splats.b, splats.c], [splats.depth], [splats.opacity], colours
        means2d, conics, depths, opacities, colour = (_joined(group, count, device) for group in groups)
        return means2d, conics, depths[:, 0], opacities[:, 0], colour, _Drawn(splats, footprints)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        """Gradients of the tensors."""
        count, device = len(ctx.tensors[0]), ctx.tensors[0].device
        sizes = 2, 3, 1, 1, 3
        columns = [
            [] if gradient is None or not gradient.numel() else _columns(gradient.reshape(count, size))
            for gradient, size in zip(gradients[:5], sizes, strict=True)
        ]
        dr.eval(columns)
        run = _project_back if count > 1 else _trace_project_back
        kind, degree = ctx.told
        found = run(ctx.leaves, kind, degree, columns)
        results: list[Tensor | None] = []
        for number, (tensor, group, needed) in enumerate(zip(ctx.tensors, found, ctx.needs_input_grad, strict=False)):
            known = tensor is not None and needed
            results.append(_gradient(number, group, tensor, device) if known else None)
        return (*results, None, None)


class _Blended(torch.autograd.Function):
    """Splats to (features [H, W, D], alpha [H, W, 1])."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        """means2d, conics, opacities, as `_Projected` gave them, features [N, D];  `_Drawn`, width, height;  the tensor
        and its camera whose `absgrad` is wanted, or None."""
        *_, features, drawn, width, height, target = arguments
        splats, channels = drawn.splats, features.shape[-1]
        planes = _columns(features)
        dr.eval(planes)
        lists = bin_splats(splats, drawn.footprints, width, height, few_sizes=True)
        needed = any(ctx.needs_input_grad)
        groups = [planes[i : i + CHANNELS] for i in range(0, channels, CHANNELS)] or [[]]
        blended = [forward(splats, group, lists, width, height, adjoint=needed) for group in groups]
        ctx.splats, ctx.lists, ctx.size, ctx.target = splats, lists, (width, height), target
        ctx.parts = list(zip(blended, map(len, groups), strict=True)) if needed else []
        picture = _joined([plane for one in blended for plane in one.features], width * height, features.device)
        alpha = 1 - _tensor(blended[0].transmittance, features.device)
        return picture.reshape(height, width, channels), alpha.reshape(height, width, 1)

    @staticmethod
    def backward(ctx: Any, by_picture: Tensor, by_alpha: Tensor) -> Any:
        """Gradients of means2d, conics, opacities and features."""
        width, height = ctx.size
        columns = _columns(by_picture.reshape(width * height, -1))
        (passed,) = _columns(-by_alpha.reshape(-1, 1))
        rows: list[Any] = []
        by_features: list[Any] = []
        for blended, size in ctx.parts:
            own, columns = columns[:size], columns[size:]
            dr.eval(own, passed)
            found = backward(ctx.splats, blended, ctx.lists, ctx.size, own, passed, ctx.target is not None)
            s = found.splats
            parts = [s.x, s.y, s.a, s.b, s.c, s.opacity, *([found.absolute_x, found.absolute_y] if ctx.target else [])]
            rows = [old + new for old, new in zip(rows, parts, strict=True)] if rows else parts
            by_features += found.features
            passed = dr.opaque(ad.Float, 0, width * height)  # light that passes counts once
        count, device = dr.width(ctx.splats.x), by_picture.device
        if ctx.target is not None:
            means2d, index = ctx.target
            _add_absolute(means2d, index, _joined(rows[6:], count, device))
        splats = _joined(rows[:2], count, device), _joined(rows[2:5], count, device), _tensor(rows[5], device)
        return (*splats, _joined(by_features, count, device), None, None, None, None)


@dataclass
class _Parts:
    """What a camera's splats depend on, as columns [N] and numbers of width 1. harmonic: none, or three times K;
    pose: 12, row by row;  matrix: fx, fy, cx, cy;  place: of the camera"""

    means: list[Any]
    quats: list[Any]
    scales: list[Any]
    opacity: list[Any]
    harmonic: list[Any]
    pose: list[Any]
    matrix: list[Any]
    place: list[Any]

    def groups(self) -> list[list[Any]]:
        """In the order of the leaves."""
        gaussian = [self.means, self.quats, self.scales, self.opacity, self.harmonic]
        return [*gaussian, self.pose, self.matrix, self.place]


def _parts(leaves: list[Any], degree: int | None) -> _Parts:
    """Of flat arrays: means, quats, scales, opacities, harmonics or None, viewmat [16], K [9], place [3]."""
    means, quats, scales, opacity, harmonic, viewmat, matrix, place = leaves
    count = dr.width(opacity)
    sh: list[Any] = []
    if harmonic is not None and degree is not None:
        terms = dr.width(harmonic) // count
        sh = [_column(harmonic, i, terms, count) for i in range(3 * (degree + 1) ** 2)]
    columns = [
        [_column(flat, i, size, count) for i in range(size)] for flat, size in ((means, 3), (quats, 4), (scales, 3))
    ]
    numbers = [
        [dr.gather(ad.Float, flat, ad.UInt32(i)) for i in places]
        for flat, places in ((viewmat, range(12)), (matrix, INTRINSICS), (place, range(3)))
    ]
    pose, intrinsics, stands = numbers
    return _Parts(columns[0], columns[1], columns[2], [ad.Float(opacity)], sh, pose, intrinsics, stands)


def _trace_project(leaves: list[Any], kind: _Kind, degree: int | None) -> tuple[Splats, Footprints, list[Any]]:
    """(splats, footprints, colours or nothing)."""
    return _splats_of(_parts(leaves, degree), kind, degree)


def _splats_of(parts: _Parts, kind: _Kind, degree: int | None) -> tuple[Splats, Footprints, list[Any]]:
    (opacity,) = parts.opacity
    camera = _camera(parts, kind)
    sane = dr.isfinite(opacity) & (opacity > 0)
    for row in (*parts.means, *parts.quats, *parts.scales):
        sane &= dr.isfinite(row) & (dr.abs(row) < LARGEST)
    sane = dr.detach(sane)
    centre, turn, size = ([dr.select(sane, row, 0) for row in group] for group in parts.groups()[:3])
    splats, footprints = project_ellipsoids(
        ad.Array3f(centre),
        ad.Array3f(size),
        ad.Array4f(turn),
        dr.select(sane, opacity, 0),
        sane,
        camera,
        kind.spread,
        kind.antialiased,
    )
    if kind.radius_clip > 0:
        small = dr.maximum(footprints.half_width, footprints.half_height) <= kind.radius_clip
        footprints.visible &= ~small
    if degree is None or not parts.harmonic:
        return splats, footprints, []
    model = Gaussians(ad.Array3f(centre), None, None, opacity, ad.ArrayXf(parts.harmonic))
    sums = harmonics(model, camera, degree)
    return splats, footprints, [dr.select(shown(total), total, 0) for total in sums]


def _trace_project_back(
    leaves: list[Any], kind: _Kind, degree: int | None, gradients: list[list[Any]]
) -> list[list[Any]]:
    """Gradients of the parts, from those of means2d, conics, depths, opacities and colours by column; none: 0."""
    parts = _parts(leaves, degree)
    for group in parts.groups():
        for value in group:
            dr.enable_grad(value)
    splats, _, colours = _splats_of(parts, kind, degree)
    groups = [splats.x, splats.y], [splats.a, splats.b, splats.c], [splats.depth], [splats.opacity], colours
    total = ad.Float(0)
    for group, columns in zip(groups, gradients, strict=True):
        for value, gradient in zip(group, columns, strict=False):
            total += value * gradient
    dr.backward(total)
    return [[dr.grad(value) for value in group] for group in parts.groups()]


_project = recorded(_trace_project, RECORDINGS)
_project_back = recorded(_trace_project_back, RECORDINGS)


def _camera(parts: _Parts, kind: _Kind) -> Projection:
    """The camera, differentiable by its pose, its intrinsics and its place."""
    fx, fy, cx, cy = parts.matrix
    zero = ad.Float(0)
    numbers = [*parts.pose, fx, fy, cx, cy, zero, zero]
    if kind.ortho:
        return _Parallel(dr.concat(numbers), kind.width, kind.height, kind.near, kind.far, parts.place)
    (f, g), (x, y) = dr.detach([fx, fy]), dr.detach([cx, cy])
    sides = [
        *((edge * kind.width - x) / f for edge in (-BORDER, 1 + BORDER)),
        *((edge * kind.height - y) / g for edge in (-BORDER, 1 + BORDER)),
    ]
    return _Perspective(dr.concat([*numbers, *sides]), kind.width, kind.height, kind.near, kind.far, parts.place)


def _gradient(number: int, group: list[Any], tensor: Tensor, device: Any) -> Tensor:
    """Of leaf `number` in the shape of its tensor: from columns, or from the numbers of a matrix that count."""
    if number < MATRIX:  # of the Gaussians
        count = len(tensor)
        found = _joined(group, count, device)
        missing = tensor.numel() // count - len(group)  # harmonics of higher degrees
        if missing:
            found = torch.cat([found, torch.zeros((count, missing), device=device)], dim=-1)
    else:
        values = _tensor(dr.concat(group), device)
        found = torch.zeros(tensor.numel(), device=device)
        if number == MATRIX + 1:
            found[torch.tensor(INTRINSICS, device=device)] = values
        else:
            found[: len(values)] = values
    return found.reshape(tensor.shape).to(tensor.dtype)


def _features(render_mode: str, colors: Tensor, depths: Tensor) -> Tensor:
    """[N, D]: what is blended."""
    if render_mode in ("D", "ED"):
        return depths[:, None]
    return torch.cat([colors, depths[:, None]], dim=-1) if "D" in render_mode else colors


def _finished(picture: Tensor, alpha: Tensor, backgrounds: Tensor | None, render_mode: str) -> Tensor:
    """Over the background, expected depth last where that is asked for."""
    colour, depth = (picture[..., :-1], picture[..., -1:]) if "D" in render_mode else (picture, None)
    if backgrounds is not None and colour.shape[-1]:
        colour = colour + (1 - alpha) * backgrounds[:, None, None, :]
    if depth is None:
        return colour
    depth = depth / alpha.clamp(min=LEAST_ALPHA) if "ED" in render_mode else depth
    return torch.cat([colour, depth], dim=-1)


def _stacked(tensors: Sequence[Tensor]) -> Tensor:
    """[C, ...]; of one camera without a copy."""
    return tensors[0][None] if len(tensors) == 1 else torch.stack(list(tensors))


def _radii(footprints: Footprints, device: Any) -> Tensor:
    """[N, 2] int32, pixels, 0 of what is not drawn."""
    halves = footprints.half_width, footprints.half_height
    found = [dr.select(footprints.visible, dr.ceil(half), 0) for half in halves]
    return _joined(found, dr.width(footprints.half_width), device).to(torch.int32)


def _add_absolute(means2d: Tensor, index: int, found: Tensor) -> None:
    known = getattr(means2d, "absgrad", None)
    if known is None:
        known = torch.zeros_like(means2d)
        means2d.absgrad = known
    known[index] += found


def _check_choice(name: str, found: str, known: Sequence[str]) -> None:
    if found not in known:
        raise ValueError(f"{name}: expected one of {', '.join(known)}, found {found!r}")


def _check_shapes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
) -> tuple[int, int]:
    """(N, C). Raises ValueError naming the argument that does not fit."""
    count, cameras = len(means), len(viewmats)
    expected = {
        "means": (means, (count, 3)),
        "quats": (quats, (count, 4)),
        "scales": (scales, (count, 3)),
        "opacities": (opacities, (count,)),
        "viewmats": (viewmats, (cameras, 4, 4)),
        "Ks": (Ks, (cameras, 3, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name}: expected {list(shape)}, found {list(tensor.shape)}; batches are not supported")
        if tensor.device != means.device:
            raise ValueError(f"{name}: expected a tensor on {means.device}, found one on {tensor.device}")
    if count < 1 or cameras < 1 or width < 1 or height < 1:
        raise ValueError(f"means, viewmats: expected at least one each and a picture, found {count} and {cameras}")
    return count, cameras


def _check_colors(
    colors: Tensor, backgrounds: Tensor | None, sh_degree: int | None, render_mode: str, count: int, cameras: int
) -> None:
    """Raises ValueError where colours do not fit the harmonics, the Gaussians or the background."""
    shape = tuple(colors.shape)
    if sh_degree is None:
        if shape[:-1] not in ((count,), (cameras, count)):
            raise ValueError(f"colors: expected [{count}, D] or [{cameras}, {count}, D], found {list(shape)}")
    else:
        if not 0 <= sh_degree <= 3:
            raise ValueError(f"sh_degree: expected 0 to 3, found {sh_degree}")
        if shape[:-2] not in ((count,), (cameras, count)) or shape[-1] != 3 or shape[-2] < (sh_degree + 1) ** 2:
            raise ValueError(f"colors: expected harmonics [{count}, K, 3] of degree {sh_degree}, found {list(shape)}")
    channels = 3 if sh_degree is not None else shape[-1]
    if backgrounds is not None and tuple(backgrounds.shape) != (cameras, channels):
        raise ValueError(f"backgrounds: expected [{cameras}, {channels}], found {list(backgrounds.shape)}")
    if render_mode == "D" and shape[-1] == 0:
        raise ValueError("colors: expected at least one channel, found none")


def _floats(tensor: Tensor) -> Any:
    """A tensor as one flat Float, without a copy where the two libraries can share memory."""
    return ad.Float(tensor.detach().to(torch.float32).contiguous().reshape(-1))


def _column(flat: Any, index: int, size: int, count: int) -> Any:
    """Column `index` of a flat array [count * size], in memory of Dr.Jit's own: what torch has may lie otherwise, and
    each way to lie is recorded anew."""
    rows = dr.arange(ad.UInt32, count)
    return dr.gather(ad.Float, flat, rows * size + index, mode=dr.ReduceMode.Permute)


def _columns(tensor: Tensor) -> list[Any]:
    """The columns of a tensor [N, size], Floats."""
    flat, size = _floats(tensor), tensor.shape[-1]
    return [_column(flat, i, size, len(tensor)) for i in range(size)]


def _tensor(array: Any, device: Any) -> Tensor:
    """A Float [N] as a tensor."""
    found: Tensor = dr.detach(array).torch()
    return found.to(device)


def _joined(arrays: Sequence[Any], count: int, device: Any) -> Tensor:
    """[N, size] of Floats [N]; the numbers lie column by column."""
    if not arrays:
        return torch.zeros((count, 0), device=device)
    return _tensor(dr.concat([dr.detach(array) for array in arrays]), device).reshape(len(arrays), count).T


__all__ = ["rasterization"]
