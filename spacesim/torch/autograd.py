"""The two operations that torch differentiates: Gaussians to splats, splats to pictures; each of all cameras at once.

Of small pictures the host's work takes longer than the kernels. So each pass, forward and backward, hands over one
array for each tensor, and no operation of torch's stands in between. On CUDA nothing waits for another stream:
Dr.Jit's own waits for torch's default one, and that for it, as CUDA has it of streams that are not created as
non-blocking.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.splat.raster.blend import backward, forward
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import BlendResult
from spacesim.splat.raster.render import FEATURES_PER_PASS
from spacesim.torch.convert import as_base, column, columns, rows, to_floats, to_table, to_tensor
from spacesim.torch.projection import (
    INTRINSICS,
    TABLE,
    LeafGradients,
    Leaves,
    NeededGradients,
    ProjectedSplats,
    project,
    project_back,
)

OPACITY, DEPTH = 3, 4  #: columns of the table
GAUSSIANS = 4  #: arguments of `Project` that all cameras share: those before the harmonics


@dataclass
class BlendInputs:
    """What is blended of splats that are projected."""

    projected: list[ProjectedSplats]  #: of each camera
    width: int  #: pixels
    height: int  #: pixels
    harmonic: bool  #: the harmonics' colours come first; else the tensor's, if any
    depth: bool  #: depth comes last
    visible: Tensor | None  #: of packed splats, which of C times N they are; else None, and means2d is [C, N, 2]
    target: Tensor | None  #: means2d, where it is to get `absgrad`


class Project(torch.autograd.Function):
    """Gaussians to splats of C cameras: (means2d [C, N, 2], table [C, N, TABLE], radii [C, N, 2] int32, a list of
    `ProjectedSplats`), see there."""

    @staticmethod
    def forward(ctx: FunctionCtx, *arguments: Any) -> tuple[Any, ...]:
        """means, quats, scales, opacities, harmonics [(C,) N, K, 3] or None, viewmats, Ks;  `RasterSettings`."""
        *tensors, settings = arguments
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)
        ctx.settings, ctx.leaves = settings, _leaves(tensors)
        count = len(tensors[0])
        capacity = round_capacity(count)
        projected: list[ProjectedSplats] = [project(leaves, settings, capacity) for leaves in ctx.leaves]
        means2d = _stack([to_table(one.means2d, count, 2) for one in projected])
        table = _stack([to_table(one.table, count, TABLE) for one in projected])
        radii = _stack([to_table(one.radii, count, 2) for one in projected])
        ctx.mark_non_differentiable(radii)
        return means2d, table, radii, projected

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Gradients of the tensors."""
        grad_means2d, grad_table = gradients[:2]
        tensors = ctx.saved_tensors
        if grad_means2d is None and grad_table is None:
            return (None,) * (len(tensors) + 1)
        wanted = NeededGradients(*ctx.needs_input_grad[: len(tensors)])
        capacity = round_capacity(len(tensors[0]))
        each = []
        for camera, leaves in enumerate(ctx.leaves):
            centres, rest = (None if one is None else to_floats(_of(one, camera)) for one in (grad_means2d, grad_table))
            leaf_gradients = project_back(leaves, ctx.settings, wanted, centres, rest, capacity)
            each.append(_gradient_tensors(leaf_gradients, tensors))
        harmonic = tensors[GAUSSIANS]
        shared = GAUSSIANS + (harmonic is None or harmonic.dim() == 3)
        results = [
            None if own[0] is None else sum(own[1:], own[0]) if i < shared else _stack(own)
            for i, own in enumerate(zip(*each, strict=True))
        ]
        return (*results, None)


def _leaves(tensors: Sequence[Tensor]) -> list[Leaves]:
    """Of each camera."""
    means, quats, scales, opacities = (to_floats(tensor) for tensor in tensors[:GAUSSIANS])
    harmonic, viewmats, intrinsics = tensors[GAUSSIANS:]
    own = harmonic is not None and harmonic.dim() == 4
    shared = None if harmonic is None or own else to_floats(harmonic)
    return [
        Leaves(
            means=means,
            quats=quats,
            scales=scales,
            opacities=opacities,
            harmonics=to_floats(_of(harmonic, camera)) if own else shared,
            viewmat=to_floats(_of(viewmats, camera)),
            intrinsics=to_floats(_of(intrinsics, camera)),
        )
        for camera in range(len(viewmats))
    ]


def _gradient_tensors(grads: LeafGradients, tensors: Sequence[Tensor]) -> list[Tensor | None]:
    """Gradients of one camera in the shapes of `Project`'s tensors, None of those that were not wanted."""
    means, quats, scales, opacities, harmonic, *_ = tensors
    results: list[Tensor | None] = []
    named = (grads.means, means), (grads.quats, quats), (grads.scales, scales), (grads.opacities, opacities)
    for flat, tensor in (*named, (grads.harmonics, harmonic)):
        if flat is None:
            results.append(None)
            continue
        shape = tensor.shape if tensor.dim() < 4 else tensor.shape[1:]
        strides = (1,) if len(shape) == 1 else (shape[1], 1) if len(shape) == 2 else (3 * shape[1], 3, 1)
        results.append(to_tensor(flat).as_strided(shape, strides))
    for numbers, places, size in ((grads.viewmat, range(16), 4), (grads.intrinsics, INTRINSICS, 3)):
        results.append(None if numbers is None else _matrix(numbers, places, size))
    return results


def _matrix(numbers: list[Float], places: Sequence[int], size: int) -> Tensor:
    """[size, size] with these numbers at these places, row by row, else 0."""
    flat = dr.zeros(ad.Float, size * size)
    for place, number in zip(places, numbers, strict=True):
        dr.scatter(flat, dr.detach(number), ad.UInt32(place))
    return to_table(flat, size, size)


class Blend(torch.autograd.Function):
    """Splats to (pictures [C, H, W, D], alphas [C, H, W, 1])."""

    @staticmethod
    def forward(ctx: FunctionCtx, *arguments: Any) -> tuple[Any, ...]:
        """means2d and table of `Project`, colours [(C,) N, D] or None;  `BlendInputs`, in which the same splats are."""
        _, _, colors, drawing = arguments
        ctx.set_materialize_grads(False)
        needed = any(ctx.needs_input_grad)
        width, height = drawing.width, drawing.height
        shared = columns(colors) if colors is not None and colors.dim() == 2 else []
        ctx.drawing, ctx.passes, ctx.colors = drawing, [], None if colors is None else colors.shape
        pictures, alphas = [], []
        for camera, one in enumerate(drawing.projected):
            splats, count = one.splats, dr.width(one.splats.x)
            own = (
                columns(_of(colors, camera).reshape(colors.shape[1:]))
                if colors is not None and colors.dim() == 3
                else shared
            )
            features = [*(one.colors if drawing.harmonic else own)]
            if drawing.depth:
                features.append(column(one.table, DEPTH, TABLE, count))
            dr.eval(features)
            lists = bin_splats(splats, one.footprints, width, height, few_sizes=True)
            groups = [features[i : i + FEATURES_PER_PASS] for i in range(0, len(features), FEATURES_PER_PASS)] or [[]]
            blended = [forward(splats, group, lists, width, height, adjoint=needed) for group in groups]
            if needed:
                ctx.passes.append((splats, lists, list(zip(blended, map(len, groups), strict=True))))
            planes = [plane for part in blended for plane in part.features]
            alpha = 1 - blended[0].transmittance
            picture = rows(planes, len(planes), width * height) if planes else ad.Float([])
            dr.eval(picture, alpha)
            channels = len(planes)
            pictures.append(to_tensor(picture).view(height, width, channels))
            alphas.append(to_tensor(alpha).view(height, width, 1))
        return _stack(pictures), _stack(alphas)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Gradients of means2d, table and colours."""
        grad_pictures, grad_alphas = gradients
        if grad_pictures is None and grad_alphas is None:
            return (None,) * 4
        drawing: BlendInputs = ctx.drawing
        grad_means2d, grad_table, grad_colors, absolute = [], [], [], []
        for camera, (splats, lists, passes) in enumerate(ctx.passes):
            grad_planes, grad_light = _plane_gradients(
                grad_pictures, grad_alphas, drawing, camera, sum(size for _, size in passes)
            )
            numbers, features = _blend_back(splats, lists, passes, grad_planes, grad_light, drawing)
            x, y, a, b, c, opacity, *absolutes = numbers
            grad_depth = features.pop() if drawing.depth else ad.Float(0)
            color_rows = features if drawing.harmonic else []
            count = dr.width(x)
            tables = [rows([x, y], 2, count), rows([a, b, c, opacity, grad_depth, *color_rows], TABLE, count)]
            tables += [rows(absolutes, 2, count)] if absolutes else []
            dr.eval(tables)
            grad_means2d.append(to_table(tables[0], count, 2))
            grad_table.append(to_table(tables[1], count, TABLE))
            absolute += [to_table(table, count, 2) for table in tables[2:]]
            if ctx.colors is not None:
                grad_colors.append(features)
        if drawing.target is not None:
            drawing.target.absgrad = pack(_stack(absolute), drawing.visible)
        colors = _color_gradients(grad_colors, ctx.colors) if grad_colors and ctx.colors[-1] else None
        return pack(_stack(grad_means2d), drawing.visible), _stack(grad_table), colors, None


def _plane_gradients(
    grad_pictures: Tensor | None, grad_alphas: Tensor | None, drawing: BlendInputs, camera: int, channels: int
) -> tuple[list[Float], Float]:
    """(gradients by the picture's planes, by the light that passes) of one camera, Floats [H * W]."""
    pixels = drawing.width * drawing.height
    if grad_pictures is None:
        grad_planes = [_zeros(pixels) for _ in range(channels)]
    else:
        grad_planes = columns(_of(grad_pictures, camera).reshape(pixels, channels))
    grad_light = _zeros(pixels) if grad_alphas is None else -column(to_floats(_of(grad_alphas, camera)), 0, 1, pixels)
    dr.eval(grad_planes, grad_light)
    return grad_planes, grad_light


def _zeros(count: int) -> Float:
    """No literal: it would fold gradients away."""
    return dr.opaque(ad.Float, 0, count)


def _blend_back(
    splats: Splats,
    lists: TileLists,
    passes: Sequence[tuple[BlendResult, int]],
    grad_planes: list[Float],
    grad_light: Float,
    drawing: BlendInputs,
) -> tuple[list[Float], list[Float]]:
    """(gradients by x, y, a, b, c, opacity, and where they are wanted the absolute ones by x and y; by the features)
    of all passes of one camera. passes: (what blending keeps, its channels) of each."""
    size, absolute = (drawing.width, drawing.height), drawing.target is not None
    sums: list[Float] = []
    features: list[Float] = []
    for blended, channels in passes:
        own, grad_planes = grad_planes[:channels], grad_planes[channels:]
        if sums:
            grad_light = _zeros(drawing.width * drawing.height)  # light that passes counts once
        grads = backward(splats, blended, lists, size, own, grad_light, absolute)
        s = grads.splats
        numbers = [s.x, s.y, s.a, s.b, s.c, s.opacity, *([grads.absolute_x, grads.absolute_y] if absolute else [])]
        sums = [one + other for one, other in zip(sums, numbers, strict=True)] if sums else numbers
        features += grads.features
    return sums, features


def _color_gradients(by_camera: list[list[Float]], shape: torch.Size) -> Tensor:
    """In the shape of the colours; of those that all cameras share the sum."""
    count, channels = shape[-2:]
    if len(shape) == 2:
        by_camera = [[sum(each[1:], each[0]) for each in zip(*by_camera, strict=True)]]
    flat = [rows(each, channels, count) for each in by_camera]
    dr.eval(flat)
    each = [to_table(one, count, channels) for one in flat]
    return each[0] if len(shape) == 2 else _stack(each)


def pack(tensor: Tensor, visible: Tensor | None) -> Tensor:
    """[C, N, ...], or of visible splats [M, ...] alone."""
    return tensor if visible is None else tensor.flatten(0, 1)[visible]


def _of(tensor: Tensor, camera: int) -> Tensor:
    """A camera's numbers of a tensor [C, ...], in any shape."""
    return tensor if len(tensor) == 1 else tensor[camera]


def _stack(tensors: Sequence[Tensor]) -> Tensor:
    """[C, ...]; of one camera without a copy."""
    return as_base(tensors[0][None]) if len(tensors) == 1 else torch.stack(list(tensors))
