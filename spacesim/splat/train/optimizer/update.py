"""Adam steps of a model's parameters from what some views have taught of its splats, in parts; and what else a step
changes, the networks of light and what densification watches.

A part (`adam.parts`) is a few rows and a recorded function. The rows and moments that it replaces go at once: a
step holds all of them once, and only those of a part twice (docs/research/memory.md). Many rows in one kernel were also
slower on a CPU. On CUDA, where kernels take less time than to ask for a function, all parts are one of few Gaussians
whose rows fill their memory, and of those with light, whose networks take more memory than that.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Float
from spacesim.backend.packet import numbers_at
from spacesim.learning.adam import adam_step
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import ROWS, SH_C0, Gaussians
from spacesim.splat.raster.project import Splats, project
from spacesim.splat.raster.render import harmonics, is_unclamped
from spacesim.splat.raster.surface import flattened
from spacesim.splat.train.loss.terms import penalty
from spacesim.splat.train.optimizer.adam import OWN, Adam
from spacesim.splat.train.optimizer.packing import Layout, load, store
from spacesim.splat.train.stages import NetworkStep, mean, shape_values, update_light

AT_ONCE = 2**15  #: Gaussians with harmonics, at most, all of whose parts are one recorded function on CUDA
FULL = 0.95  #: of the power of two to which Dr.Jit rounds rows, at least: all at once then take 1,530 bytes a Gaussian
Packed = tuple[list[Float], Layout]  #: moments of a part and how they lie, see `packing`
Learned = tuple[list[Float], list[Float], list[Float]]  #: of networks, see `update_light`
Observe = Callable[[dict[str, Float], list[Any]], dict[str, Float]]  #: see `Strategy.observe`


@dataclass
class ViewGradients:
    """Gradients of a scalar by what one view shows: by its splats and by what was blended, by name, see
    `stages.project_views`."""

    camera: Pinhole  #: that the view was drawn from
    grad_splats: Splats  #: by the splats, as `SplatGradients.splats`
    grad_values: dict[str, list[Float]]  #: by what was blended: {name: a Float [N] for each channel}
    grad_features: Float | None = None  #: [F * N], of a method of light
    grad_rows: list[Float] = field(default_factory=list)  #: of the first rows, beside what the splats give them
    seen: Any = None  #: the view's `strategy.OnScreen` where densification watches, else None


@dataclass
class _Taught:
    """What moves rows, as kernels read it."""

    #: of each view its camera, and gradients by its splats, by what was blended, and of the first rows
    views: list[tuple[Pinhole, Splats, dict[str, list[Float]], list[Float]]]
    grad_features: list[Float]  #: [F * N] of each view, or nothing
    degree: int  #: of the harmonics that were drawn
    factors: Float  #: [2 + R], Adam's two corrections and the step size of each row
    penalties: Mapping[str, Float]  #: weights by name
    largest: list[Float]  #: ln of metres, of width 1, or nothing
    antialiased: bool
    scale: float
    surfels: bool


class Update:
    """Moves all parameters by the mean gradient of some views.

    antialiased: whether splats are drawn with the anti-aliasing filter
    scale: metres, the unit of depth
    surfels: whether each step ends with discs, see `flattened`
    observe: `Strategy.observe` of the strategy that watches, if one does
    """

    def __init__(self, antialiased: bool, scale: float, surfels: bool = False, observe: Observe | None = None) -> None:
        self.antialiased, self.scale, self.surfels = antialiased, scale, surfels
        self._own, self._features = recorded(_move_own), recorded(_move_features)
        self._harmonics, self._all = recorded(_move_harmonics), recorded(_step_of_all(observe))
        self._beside = recorded(_step_beside(observe))

    def __call__(
        self,
        gaussians: Gaussians,
        optimizer: Adam,
        degree: int,
        views: list[ViewGradients],
        factors: Float,
        penalties: Mapping[str, Float],
        largest: Sequence[Float] = (),
        state: Mapping[str, Float] | None = None,
        networks: NetworkStep | None = None,
    ) -> tuple[dict[str, Float], Learned | None]:
        """Replace the parameters and their moments. Returns (`state` after what the views show, or nothing where none
        is watched; what `update_light` gives of the networks, or None).

        views: emptied, so that gradients go once they are read
        factors: Float [2 + R], Adam's two corrections and the step size of each row;  penalties: weights by name
        largest: ln of metres, no scale gets larger, a Float of width 1 in a list, or nothing
        state: `Strategy.observed_state`;  networks: those of light

        Harmonics of no degree up to `degree` have never had a gradient: they stay as they are.
        """
        assert optimizer.count == gaussians.count, "moments of other Gaussians"
        rows = [ad.Float(row) for row in gaussians.rows()]  # a row taken from an array keeps all of that array
        taught = _Taught(
            views=[(view.camera, view.grad_splats, view.grad_values, view.grad_rows) for view in views],
            grad_features=[view.grad_features for view in views if view.grad_features is not None],
            degree=degree,
            factors=factors,
            penalties=penalties,
            largest=list(largest),
            antialiased=self.antialiased,
            scale=self.scale,
            surfels=self.surfels,
        )
        beside = [dict(state or {}), [view.seen for view in views if view.seen is not None], networks]
        views.clear()
        stops = [part.stop for part in optimizer.slices if part.start < OWN + 3 * (degree + 1) ** 2]
        if moves_at_once(gaussians):
            packed = list(zip(optimizer.arrays, optimizer.layouts, strict=True))[: len(stops)]
            parts, features, others = self._all(rows, stops, packed, optimizer.features, taught, tuple(beside))
            for number, (moved, moments) in enumerate(parts):
                _replace(gaussians, optimizer, rows, number, moved, moments)
        else:
            others = self._beside(*beside)
            beside.clear()
            features = self._part_by_part(gaussians, optimizer, rows, stops, taught)
        if features:
            rows[-1], *optimizer.features = features
            gaussians.replace(rows)
        return others

    def _part_by_part(
        self, gaussians: Gaussians, optimizer: Adam, rows: list[Float], stops: list[int], taught: _Taught
    ) -> list[Float]:
        """Replaces all but the features, which are returned with their moments, or nothing."""
        means, cameras, factors = rows[:3], [camera for camera, *_ in taught.views], taught.factors
        packed = optimizer.arrays[0], optimizer.layouts[0]
        grad_sums, moved, moments = self._own(rows, stops[0], packed, taught)
        taught.views.clear()
        _replace(gaussians, optimizer, rows, 0, moved, moments)
        del packed, moved, moments
        if taught.grad_features:
            return self._features(rows[-1], optimizer.features, taught.grad_features, factors)
        for number, (start, stop) in enumerate(pairwise(stops), 1):
            packed, first = (optimizer.arrays[number], optimizer.layouts[number]), (start - OWN) // 3
            moved, moments = self._harmonics(
                rows[start:stop], packed, first, taught.degree, means, cameras, grad_sums, factors
            )
            _replace(gaussians, optimizer, rows, number, moved, moments)
            del packed, moved, moments
        return []


def moves_at_once(gaussians: Gaussians) -> bool:
    """Whether all parts are one recorded function."""
    count = gaussians.count
    fits = count <= AT_ONCE and count >= FULL * 2 ** (count - 1).bit_length()
    return select() == "cuda" and (gaussians.features is not None or fits)


def _replace(
    gaussians: Gaussians, optimizer: Adam, rows: list[Float], number: int, moved: list[Float], moments: list[Float]
) -> None:
    """Put a part's new rows and moments in the place of the old ones, which are released."""
    rows[optimizer.slices[number]], optimizer.arrays[number] = moved, moments
    if number == 0:
        gaussians.replace(rows)
    else:
        gaussians.sh = ad.ArrayXf(rows[ROWS["sh"]])


def _step_beside(observe: Observe | None) -> Callable[..., tuple[dict[str, Float], Learned | None]]:
    """What a step changes beside Gaussians: a function of the strategy's state, what views show, and the networks."""

    def step_beside(
        state: dict[str, Float], seen: list[Any], networks: NetworkStep | None
    ) -> tuple[dict[str, Float], Learned | None]:
        state = observe(state, seen) if observe and seen else {}
        return state, update_light(*networks) if networks else None

    return step_beside


def _step_of_all(observe: Observe | None) -> Callable[..., Any]:
    """What a step changes, in one function."""
    step_beside = _step_beside(observe)

    def step_all(
        rows: list[Float],
        stops: list[int],
        packed: list[Packed],
        of_features: list[Float],
        taught: _Taught,
        beside: tuple[Any, ...],
    ) -> tuple[list[tuple[list[Float], list[Float]]], list[Float], tuple[dict[str, Float], Learned | None]]:
        """(rows and moments of each part; the features and their moments, or nothing; what stands beside). stops: where
        parts end;  of_features: their moments, or nothing;  beside: what `step_beside` takes"""
        others = step_beside(*beside)
        dr.schedule(others)
        grad_sums, moved, moments = _move_own(rows, stops[0], packed[0], taught)
        steps, factors = [(moved, moments)], taught.factors
        if taught.grad_features:
            return steps, _move_features(rows[-1], of_features, taught.grad_features, factors), others
        cameras = [camera for camera, *_ in taught.views]
        for (start, stop), of_part in zip(pairwise(stops), packed[1:], strict=True):
            first = (start - OWN) // 3
            steps.append(
                _move_harmonics(rows[start:stop], of_part, first, taught.degree, rows[:3], cameras, grad_sums, factors)
            )
        return steps, [], others

    return step_all


def _move_own(
    rows: list[Float], count: int, packed: Packed, taught: _Taught
) -> tuple[list[list[Float]], list[Float], list[Float]]:
    """A step of the first `count` rows. rows: all of them.

    Also, of each view, the gradients of the sums of harmonics: 3 Floats [N], none where colours come from a field.
    """
    views, degree = taught.views, taught.degree
    shape_rows = [ad.Float(row) for row in rows[:OWN]]
    dr.enable_grad(shape_rows)
    gaussians = Gaussians.from_rows([*shape_rows, *rows[OWN:]])
    along = ad.Float(0)
    grad_sums: list[list[Float]] = []
    for camera, grad_splats, grad_values, grad_rows in views:
        splats, _ = project(gaussians, camera, taught.antialiased)
        for name in ("opacity", "x", "y", "a", "b", "c"):
            along += getattr(splats, name) * getattr(grad_splats, name)
        for row, gradient in zip(shape_rows, grad_rows, strict=False):
            along += row * gradient
        for name, group in shape_values(gaussians, splats, camera, grad_values, taught.scale).items():
            for value, gradient in zip(group, grad_values[name], strict=True):
                along += value * gradient
        grad_sums.append([])
        if gaussians.features is None:
            sums = harmonics(gaussians, camera, degree)
            for total, gradient in zip(sums, grad_values["color"], strict=True):
                grad_sums[-1].append(dr.select(is_unclamped(total), gradient, 0))
                along += total * grad_sums[-1][-1]
    for name, weight in taught.penalties.items():
        along += len(views) * weight * penalty(name, gaussians)
    dr.backward(along if len(views) == 1 else along / len(views))
    grad_rows = [dr.grad(row) for row in shape_rows]
    grad_rows += [mean([SH_C0 * grad_sum[c] for grad_sum in grad_sums]) for c in range(count - OWN)]
    moved, moments = _step([*dr.detach(shape_rows), *rows[OWN:count]], grad_rows, packed, taught.factors, 0)
    for bound in taught.largest:
        moved[ROWS["log_scales"]] = [dr.minimum(row, bound) for row in moved[ROWS["log_scales"]]]
    if taught.surfels:
        moved[ROWS["log_scales"]] = flattened(moved[ROWS["log_scales"]])
    dr.eval(grad_sums, moved, moments)
    return grad_sums, moved, moments


def _move_harmonics(
    rows: list[Float],
    packed: Packed,
    first: int,
    degree: int,
    means: list[Float],
    cameras: list[Pinhole],
    grad_sums: list[list[Float]],
    factors: Float,
) -> tuple[list[Float], list[Float]]:
    """A step of the coefficients from number `first` on. means: those of which `grad_sums` are the gradients."""
    grad_rows: list[list[Float]] = [[] for _ in rows]
    for camera, grad_sum in zip(cameras, grad_sums, strict=True):
        basis = dr.sh_eval(camera.directions_to(ad.Array3f(means)), degree)
        for i in range(len(rows)):
            k = first + i // 3
            grad_rows[i].append(basis[k] * grad_sum[i % 3] if k < len(basis) else ad.Float(0))
    moved, moments = _step(rows, [mean(gradients) for gradients in grad_rows], packed, factors, OWN + 3 * first)
    dr.eval(moved, moments)
    return moved, moments


def _move_features(row: Float, moments: list[Float], grad_features: list[Float], factors: Float) -> list[Float]:
    """A step of the features, one packed row: that and its moments."""
    first, second = moments
    corrections, rates = _numbers(factors, OWN, 1)
    moved, [first], [second] = adam_step([row], [mean(grad_features)], ([first], [second]), rates, corrections)
    dr.eval(moved, first, second)
    return [moved[0], first, second]


def _step(
    rows: list[Float], grad_rows: list[Float], packed: Packed, factors: Float, first: int
) -> tuple[list[Float], list[Float]]:
    """(rows, moments) after a step of Adam over rows from number `first` on."""
    arrays, layout = packed
    moments = load(arrays, layout, dr.arange(ad.UInt32, dr.width(rows[0])))
    corrections, rates = _numbers(factors, first, len(rows))
    moved, first_moments, second_moments = adam_step(rows, grad_rows, moments, rates, corrections)
    return moved, store(first_moments, second_moments, layout)


def _numbers(factors: Float, first: int, count: int) -> tuple[tuple[Float, Float], list[Float]]:
    """Adam's two corrections, and the step sizes of `count` rows from number `first` on."""
    indices = 0, 1, *range(2 + first, 2 + first + count)
    first_correction, second_correction, *rates = numbers_at(factors, indices)
    return (first_correction, second_correction), rates
