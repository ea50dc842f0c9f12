"""The moves that densification is made of: duplicate, split, prune, reset. Numpy decides, Dr.Jit moves the rows."""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload, upload_rows
from spacesim.data.errors import WorkError
from spacesim.data.geometry import rotation_from_quaternion
from spacesim.splat.raster.gaussians import ROWS, Gaussians, gather_entries, stack_rows
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.optimizer.packing import release

SPLIT_SHRINK = 1.6  #: halves of a split are this much smaller (Kerbl et al. 2023, section 5.2)
SPLIT_COUNT = 2


@dataclass(frozen=True)
class DensificationCounts:
    """What a densification step did, in numbers of Gaussians."""

    duplicated: int = 0  #: small ones that got a copy
    split: int = 0  #: large ones that became two
    pruned: int = 0  #: taken away
    added: int = 0  #: copies beside these, so that there are enough of them
    relocated: int = 0  #: dead ones that moved to live ones (`mcmc`)


def rearrange(gaussians: Gaussians, optimizer: Adam, index: np.ndarray, fresh: np.ndarray) -> None:
    """Gaussian i becomes a copy of Gaussian index[i]; its moments come along unless fresh[i]. index, fresh: [M]."""
    device_index = upload(index, ad.UInt32)
    count, rows = gaussians.count, [ad.Float(row) for row in gaussians.rows()]
    for part in (*optimizer.slices, slice(optimizer.slices[-1].stop, None)):  # so that old ones go as new ones come
        rows[part] = [gather_entries(row, device_index, count) for row in rows[part]]
        dr.eval(rows[part])
        gaussians.replace(rows)
        release(count, len(index))
    optimizer.select(device_index, upload(fresh, ad.Bool))


def grow(
    gaussians: Gaussians, optimizer: Adam, duplicate: np.ndarray, split: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Duplicate and split the marked Gaussians ([N] bool each; both for one that is split and keeps a copy of itself).
    Returns the source of each one [M].

    The halves of a split are drawn from the Gaussian that they replace and are 1.6 times smaller; they and the
    duplicates start without moments. Order: those that stay, the duplicates, first halves, second halves.
    """
    splitting = np.flatnonzero(split)
    index = np.concatenate([np.flatnonzero(~split), np.flatnonzero(duplicate), *[splitting] * SPLIT_COUNT])
    stay = len(split) - len(splitting)
    fresh = np.arange(len(index)) >= stay
    if not fresh.any():
        return index
    rearrange(gaussians, optimizer, index, fresh)
    if len(splitting):
        scatter_copies(gaussians, SPLIT_COUNT * len(splitting), rng)
        shrink = np.zeros(len(index), np.float32)
        shrink[-SPLIT_COUNT * len(splitting) :] = np.log(SPLIT_SHRINK)
        gaussians.log_scales -= upload(shrink)
        dr.eval(gaussians.log_scales)
    return index


def append_copies(gaussians: Gaussians, optimizer: Adam, parents: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add a copy of each of the Gaussians `parents` [K], which may repeat, at a point drawn from its parent; without
    moments. Returns the source of each Gaussian [N + K].

    Copies in one place and without moments would get the same gradients, and stay together for good."""
    index = np.concatenate([np.arange(gaussians.count), parents]).astype(np.int64)
    if len(parents):
        rearrange(gaussians, optimizer, index, np.arange(len(index)) >= gaussians.count)
        scatter_copies(gaussians, len(parents), rng)
    return index


def scatter_copies(gaussians: Gaussians, count: int, rng: np.random.Generator) -> None:
    """Move each of the last `count` Gaussians to a point drawn from itself."""
    scales = np.exp(stack_rows(gaussians.log_scales)[:, -count:].astype(np.float64))
    axes = rotation_from_quaternion(stack_rows(gaussians.quaternions)[:, -count:].T)
    offsets = np.zeros((3, gaussians.count), np.float32)
    offsets[:, -count:] = np.einsum("nij,nj->in", axes, scales.T * rng.standard_normal((count, 3)))
    gaussians.means += upload_rows(offsets)
    dr.eval(gaussians.means)


def prune(gaussians: Gaussians, optimizer: Adam, remove: np.ndarray) -> np.ndarray:
    """Take the marked Gaussians out ([N] bool). Returns the index of each that stays; WorkError where none does."""
    index = np.flatnonzero(~remove)
    if len(index) == 0:
        raise WorkError(
            "training: expected Gaussians that pictures need, found none: refinement would prune every Gaussian, too "
            "faint or too wide; take more or larger pictures, of objects cut out, or lower refinement.prune_opacity"
        )
    if remove.any():
        rearrange(gaussians, optimizer, index, np.zeros(len(index), bool))
    return index


def limit_opacities(gaussians: Gaussians, optimizer: Adam, highest: float) -> None:
    """Lower every opacity to at most `highest` and forget its moments (opacity reset)."""
    _set_opacities(gaussians, optimizer, dr.minimum(gaussians.logit_opacities, _logit(highest)))


def raise_opacities(gaussians: Gaussians, optimizer: Adam, lowest: float) -> None:
    """Raise every opacity to at least `lowest` and forget its moments."""
    _set_opacities(gaussians, optimizer, dr.maximum(gaussians.logit_opacities, _logit(lowest)))


def _set_opacities(gaussians: Gaussians, optimizer: Adam, logits: Float) -> None:
    gaussians.logit_opacities = logits
    dr.eval(logits)
    optimizer.forget(ROWS["logit_opacities"].start)


def _logit(opacity: float) -> float:
    return float(np.log(opacity / (1 - opacity)))
