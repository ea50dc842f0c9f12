"""Adam steps of a model's parameters from what some views have taught of its splats, in parts.

A part is a few rows and a recorded function. The rows and moments that it replaces go at once: a step holds all of them
once, and only those of a part twice. Many rows in one kernel were also slower on a CPU (docs/performance.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.splat.cameras import Pinhole
from spacesim.splat.gaussians import ROWS, Gaussians
from spacesim.splat.project import Splats, project
from spacesim.splat.render import harmonics, shown
from spacesim.splat.train.losses import penalty
from spacesim.splat.train.optimizer import Adam, adam_step
from spacesim.splat.train.stages import mean, shape_values

OWN = ROWS["sh"].start  #: rows of place, shape and opacity; harmonics or features come behind
PART = 4  #: coefficients of harmonics that are moved at once, each three rows
MOST_PARTS = 4  #: of degree 3


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

    antialiased: see `project`;  scale: metres, the unit of depth;  recordings: that are kept of a part
    """

    def __init__(self, antialiased: bool, scale: float, recordings: int) -> None:
        self.antialiased, self.scale = antialiased, scale
        self._own, self._features = recorded(_move_own, recordings), recorded(_move_features, recordings)
        self._harmonics = recorded(_move_harmonics, MOST_PARTS * recordings)

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

        factors: Float [2 + R], Adam's two corrections and the step size of each row;  penalties: weights by name.
        Harmonics of no degree up to `degree` have never had a gradient: they stay as they are.
        """
        how = degree, factors, penalties, self.antialiased, self.scale
        rows = [ad.Float(row) for row in gaussians.rows()]  # a row taken from an array keeps all of that array
        means = rows[:3]
        by_sums, *moved = self._own(rows, optimizer.part(slice(OWN)), [_without_features(view) for view in views], *how)
        _replace(gaussians, optimizer, rows, slice(OWN), moved)
        if gaussians.features is not None:
            by_features = [view.by_features for view in views]
            moved = self._features(rows[OWN:], optimizer.part(slice(OWN, None)), by_features, factors)
            _replace(gaussians, optimizer, rows, slice(OWN, None), moved)
            return
        cameras = [view.camera for view in views]
        for first in range(0, min((degree + 1) ** 2, len(gaussians.sh) // 3), PART):
            part = slice(OWN + 3 * first, min(OWN + 3 * (first + PART), len(rows)))
            moved = self._harmonics(rows[part], optimizer.part(part), first, degree, means, cameras, by_sums, factors)
            _replace(gaussians, optimizer, rows, part, moved)


def _without_features(view: ViewGradients) -> tuple[Pinhole, Splats, dict[str, list[Any]], list[Any]]:
    return view.camera, view.by_splats, view.by_value, view.by_rows


def _replace(gaussians: Gaussians, optimizer: Adam, rows: list[Any], part: slice, moved: Any) -> None:
    """Put a part's new rows and moments in the place of the old ones, which nobody holds any longer."""
    rows[part], optimizer.first[part], optimizer.second[part] = moved
    if part.start is None:
        own = Gaussians.from_rows(rows)
        gaussians.means, gaussians.log_scales, gaussians.quaternions = own.means, own.log_scales, own.quaternions
        gaussians.logit_opacities = own.logit_opacities
    elif gaussians.features is not None:
        gaussians.features = rows[-1]
    else:
        gaussians.sh = ad.ArrayXf(rows[OWN:])


def _move_own(
    rows: list[Any],
    moments: tuple[list[Any], list[Any]],
    views: list[tuple[Pinhole, Splats, dict[str, list[Any]], list[Any]]],
    degree: int,
    factors: Any,
    penalties: Mapping[str, Any],
    antialiased: bool,
    scale: float,
) -> tuple[list[list[Any]], list[Any], list[Any], list[Any]]:
    """A step of the rows that are not harmonics or features. rows: all of them.

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
    return by_sums, *_step(dr.detach(own), [dr.grad(row) for row in own], moments, factors, 0)


def _move_harmonics(
    rows: list[Any],
    moments: tuple[list[Any], list[Any]],
    first: int,
    degree: int,
    means: list[Any],
    cameras: list[Pinhole],
    by_sums: list[list[Any]],
    factors: Any,
) -> tuple[list[Any], list[Any], list[Any]]:
    """A step of the coefficients from number `first` on. means: those of which `by_sums` are the gradients."""
    by_row: list[list[Any]] = [[] for _ in rows]
    for camera, by_sum in zip(cameras, by_sums, strict=True):
        basis = dr.sh_eval(camera.directions_to(ad.Array3f(means)), degree)
        for i in range(len(rows)):
            k = first + i // 3
            by_row[i].append(basis[k] * by_sum[i % 3] if k < len(basis) else ad.Float(0))
    return _step(rows, [mean(gradients) for gradients in by_row], moments, factors, OWN + 3 * first)


def _move_features(
    rows: list[Any], moments: tuple[list[Any], list[Any]], by_features: list[Any], factors: Any
) -> tuple[list[Any], list[Any], list[Any]]:
    """A step of the features, one packed row."""
    return _step(rows, [mean(by_features)], moments, factors, OWN)


def _step(
    rows: list[Any], by_row: list[Any], moments: tuple[list[Any], list[Any]], factors: Any, first: int
) -> tuple[list[Any], list[Any], list[Any]]:
    """Adam over rows from number `first` on."""
    one, two, *rates = [
        dr.gather(ad.Float, factors, ad.UInt32(i)) for i in (0, 1, *range(2 + first, 2 + first + len(rows)))
    ]
    return adam_step(rows, by_row, moments, rates, (one, two))
