"""Adam steps of a model's parameters from what some views have taught of its splats, in parts.

A part (`optimizer.parts`) is a few rows and a recorded function. The rows and moments that it replaces go at once: a
step holds all of them once, and only those of a part twice. Many rows in one kernel were also slower on a CPU
(docs/performance.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.project import Splats, project
from spacesim.splat.raster.render import harmonics, shown
from spacesim.splat.train.loss import penalty
from spacesim.splat.train.optimizer import OWN, Adam, adam_step
from spacesim.splat.train.packing import Pack, load, store
from spacesim.splat.train.stages import mean, shape_values

Packed = tuple[list[Any], tuple[Pack, ...]]  #: moments of a part and how they lie, see `packing`


@dataclass
class ViewGradients:
    """Gradients of a scalar by what one view shows: by its splats and by what was blended, by name, see
    `stages.project_views`.

    by_features: Float [F * N], of a method of light;  by_rows: of the first rows, beside what the splats give them
    """

    camera: Pinhole
    by_splats: Splats
    by_value: dict[str, list[Any]]
    by_features: Any = None
    by_rows: list[Any] = field(default_factory=list)


class Update:
    """Moves all parameters by the mean gradient of some views.

    antialiased: see `project`;  scale: metres, the unit of depth
    """

    def __init__(self, antialiased: bool, scale: float) -> None:
        self.antialiased, self.scale = antialiased, scale
        self._own, self._features = recorded(_move_own, RECORDINGS), recorded(_move_features, RECORDINGS)
        self._harmonics = recorded(_move_harmonics, RECORDINGS)

    def __call__(
        self,
        gaussians: Gaussians,
        optimizer: Adam,
        degree: int,
        views: list[ViewGradients],
        factors: Any,
        penalties: Mapping[str, Any],
    ) -> None:
        """Replace the parameters and their moments, part by part.

        views: emptied on the way, so that gradients go once they are read
        factors: Float [2 + R], Adam's two corrections and the step size of each row;  penalties: weights by name.
        Harmonics of no degree up to `degree` have never had a gradient: they stay as they are.
        """
        assert optimizer.count == gaussians.count, "moments of other Gaussians"
        how = degree, factors, penalties, self.antialiased, self.scale
        rows = [ad.Float(row) for row in gaussians.rows()]  # a row taken from an array keeps all of that array
        means, packed = rows[:3], (optimizer.arrays[0], optimizer.layouts[0])
        cameras, by_features = [view.camera for view in views], [view.by_features for view in views]
        of_own = [_without_features(view) for view in views]
        views.clear()
        by_sums, *moved = self._own(rows, optimizer.slices[0].stop, packed, of_own, *how)
        del packed, of_own
        _replace(gaussians, optimizer, rows, 0, *moved)
        if gaussians.features is not None:
            rows[-1], optimizer.features = self._features(rows[-1], optimizer.features, by_features, factors)
            gaussians.replace(rows)
            return
        for number, part in enumerate(optimizer.slices[1:], 1):
            first = (part.start - OWN) // 3
            if first >= (degree + 1) ** 2:
                break
            packed = optimizer.arrays[number], optimizer.layouts[number]
            moved = self._harmonics(rows[part], packed, first, degree, means, cameras, by_sums, factors)
            del packed
            _replace(gaussians, optimizer, rows, number, *moved)


def _without_features(view: ViewGradients) -> tuple[Pinhole, Splats, dict[str, list[Any]], list[Any]]:
    return view.camera, view.by_splats, view.by_value, view.by_rows


def _replace(
    gaussians: Gaussians, optimizer: Adam, rows: list[Any], number: int, moved: list[Any], moments: list[Any]
) -> None:
    """Put a part's new rows and moments in the place of the old ones, which nobody holds any longer."""
    rows[optimizer.slices[number]], optimizer.arrays[number] = moved, moments
    gaussians.replace(rows)


def _move_own(
    rows: list[Any],
    count: int,
    packed: Packed,
    views: list[tuple[Pinhole, Splats, dict[str, list[Any]], list[Any]]],
    degree: int,
    factors: Any,
    penalties: Mapping[str, Any],
    antialiased: bool,
    scale: float,
) -> tuple[list[list[Any]], list[Any], list[Any]]:
    """A step of the first `count` rows. rows: all of them.

    Also, of each view, the gradients of the sums of harmonics: 3 Floats [N], none where colours come from a field.
    """
    own = [ad.Float(row) for row in rows[:OWN]]
    dr.enable_grad(own)
    gaussians = Gaussians.from_rows([*own, *rows[OWN:]])
    along: Any = ad.Float(0)
    by_sums: list[list[Any]] = []
    for camera, by_splat, by_value, by_rows in views:
        splats, _ = project(gaussians, camera, antialiased)
        for name in ("opacity", "x", "y", "a", "b", "c"):
            along += getattr(splats, name) * getattr(by_splat, name)
        for row, gradient in zip(own, by_rows, strict=False):
            along += row * gradient
        for name, group in shape_values(gaussians, splats, camera, by_value, scale).items():
            for value, gradient in zip(group, by_value[name], strict=True):
                along += value * gradient
        by_sums.append([])
        if gaussians.features is None:
            sums = harmonics(gaussians, camera, degree)
            for total, gradient in zip(sums, by_value["colour"], strict=True):
                by_sums[-1].append(dr.select(shown(total), gradient, 0))
                along += total * by_sums[-1][-1]
    for name, weight in penalties.items():
        along += len(views) * weight * penalty(name, gaussians)
    dr.backward(along if len(views) == 1 else along / len(views))
    by_row = [dr.grad(row) for row in own]
    by_row += [mean([SH_C0 * by_sum[c] for by_sum in by_sums]) for c in range(count - OWN)]
    moved, moments = _step([*dr.detach(own), *rows[OWN:count]], by_row, packed, factors, 0)
    dr.eval(by_sums, moved, moments)
    return by_sums, moved, moments


def _move_harmonics(
    rows: list[Any],
    packed: Packed,
    first: int,
    degree: int,
    means: list[Any],
    cameras: list[Pinhole],
    by_sums: list[list[Any]],
    factors: Any,
) -> tuple[list[Any], list[Any]]:
    """A step of the coefficients from number `first` on. means: those of which `by_sums` are the gradients."""
    by_row: list[list[Any]] = [[] for _ in rows]
    for camera, by_sum in zip(cameras, by_sums, strict=True):
        basis = dr.sh_eval(camera.directions_to(ad.Array3f(means)), degree)
        for i in range(len(rows)):
            k = first + i // 3
            by_row[i].append(basis[k] * by_sum[i % 3] if k < len(basis) else ad.Float(0))
    moved, moments = _step(rows, [mean(gradients) for gradients in by_row], packed, factors, OWN + 3 * first)
    dr.eval(moved, moments)
    return moved, moments


def _move_features(row: Any, moments: list[Any], by_features: list[Any], factors: Any) -> tuple[Any, list[Any]]:
    """A step of the features, one packed row."""
    first, second = moments
    corrections, rates = _numbers(factors, OWN, 1)
    moved, [first], [second] = adam_step([row], [mean(by_features)], ([first], [second]), rates, corrections)
    return moved[0], [first, second]


def _step(rows: list[Any], by_row: list[Any], packed: Packed, factors: Any, first: int) -> tuple[list[Any], list[Any]]:
    """(rows, moments) after a step of Adam over rows from number `first` on."""
    arrays, layout = packed
    moments = load(arrays, layout, dr.arange(ad.UInt32, dr.width(rows[0])))
    corrections, rates = _numbers(factors, first, len(rows))
    moved, one, two = adam_step(rows, by_row, moments, rates, corrections)
    return moved, store(one, two, layout)


def _numbers(factors: Any, first: int, count: int) -> tuple[tuple[Any, Any], list[Any]]:
    """Adam's two corrections, and the step sizes of `count` rows from number `first` on."""
    indices = 0, 1, *range(2 + first, 2 + first + count)
    one, two, *rates = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in indices]
    return (one, two), rates
