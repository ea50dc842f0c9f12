"""Error by grazing angle: by how high the Sun stands over the surface that it lights.

The grazing angle of a pixel is the angle between the Sun and the surface's tangent plane, asin(n . s): 0 where light
only brushes the surface. Counted are pixels whose surface faces the Sun, lit or in cast shadow. Pixels of all frames
are pooled: a mean over frames would weigh a bin's few pixels in one frame as its many in another.
"""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array
from spacesim.data.records import Truth
from spacesim.data.store import SHADOW_SELF_CAST
from spacesim.eval.metrics.image import Mask

EDGES_DEG = (0, 5, 10, 20, 40, 90)
"""Of the bins, degrees (finest where shadow tests are hardest)."""

_ROWS = ("pixels", "luminance_error", "predicted", "visibility_error", "lit", "false", "shadowed", "missed")


def tally(
    truth: Truth, predicted_luminance: np.ndarray, true_luminance: np.ndarray, visibility: np.ndarray | None, mask: Mask
) -> Array:
    """[8, bins] sums over the pixels of `mask` that face the Sun; those of several frames may be added up.

    Luminances and predicted visibility: [H, W] in [0, 1]; visibility None: the method predicts none.
    """
    chosen = mask & (truth.shadow >= SHADOW_SELF_CAST)
    angles = np.degrees(np.arcsin(np.clip(truth.sun_cosine[chosen].astype(np.float64), 0, 1)))
    bins = np.digitize(angles, EDGES_DEG[1:-1])
    ones = np.ones(len(bins))
    error = np.abs(np.asarray(predicted_luminance, np.float64) - true_luminance)[chosen]
    weights = [ones, error] + [np.zeros(len(bins))] * 6
    if visibility is not None:
        predicted, true = np.asarray(visibility, np.float64)[chosen], truth.sun_visibility[chosen]
        dark, lit = predicted < 0.5, true >= 0.5
        weights[2:] = [ones, np.abs(predicted - true), lit, lit & dark, ~lit, ~lit & ~dark]
    return np.stack([np.bincount(bins, row, len(EDGES_DEG) - 1) for row in weights])


def summary(tallies: Iterable[Array | None]) -> list[dict[str, JsonValue]] | None:
    """A record for each bin, None where no frame has a tally.

    from_deg, to_deg; pixels; luminance_mae; visibility_mae; error_rate: share of pixels on the wrong side of one half;
    false_shadow: share of lit pixels predicted dark; missed_shadow: share of cast shadow predicted lit. None for a mean
    over no pixel.
    """
    present = [tally for tally in tallies if tally is not None]
    if not present:
        return None
    sums = dict(zip(_ROWS, np.sum(present, axis=0), strict=True))

    def mean(total: Array, count: str, index: int) -> float | None:
        return float(total[index] / sums[count][index]) if sums[count][index] else None

    return [
        {
            "from_deg": low,
            "to_deg": high,
            "pixels": int(sums["pixels"][i]),
            "luminance_mae": mean(sums["luminance_error"], "pixels", i),
            "visibility_mae": mean(sums["visibility_error"], "predicted", i),
            "error_rate": mean(sums["false"] + sums["missed"], "predicted", i),
            "false_shadow": mean(sums["false"], "lit", i),
            "missed_shadow": mean(sums["missed"], "shadowed", i),
        }
        for i, (low, high) in enumerate(pairwise(EDGES_DEG))
    ]
