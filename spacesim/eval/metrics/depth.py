"""How well depth is known: metres along the optical axis, over the object's pixels."""

import numpy as np

from spacesim.eval.metrics.image import Mask, mae, rmse
from spacesim.eval.metrics.shadow import Metrics


def depth_metrics(prediction: np.ndarray, truth: np.ndarray, mask: Mask) -> Metrics:
    """Of depths [H, W], metres, 0 where there is none, over `mask`, [H, W] bool, pixels that have a true one.

    mae, rmse: mean absolute and root mean squared error, metres, over those that have a predicted one (Eigen et al.
    2014, without a scale); missing: share of those that have none. None over no pixel.
    """
    found = mask & (prediction > 0)
    missing = 1 - float(found.sum() / mask.sum()) if mask.any() else None
    return {"mae": mae(prediction, truth, found), "rmse": rmse(prediction, truth, found), "missing": missing}
