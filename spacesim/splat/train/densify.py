"""The moves that refinement is made of: duplicate, split, prune, reset. Numpy decides, Dr.Jit moves the rows."""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.data.errors import WorkError
from spacesim.data.geometry import rotation_from_quaternion
from spacesim.splat.gaussians import NAMES, ROWS, Gaussians, entries
from spacesim.splat.train.optimizer import Adam

SPLIT_SHRINK = 1.6  #: halves of a split are this much smaller (Kerbl et al. 2023, section 5.2)
SPLIT_COUNT = 2


@dataclass(frozen=True)
class Refinement:
    """What a refinement did, in numbers of Gaussians."""

    duplicated: int = 0
    split: int = 0
    pruned: int = 0


def rearrange(gaussians: Gaussians, optimizer: Adam, index: np.ndarray, fresh: np.ndarray) -> None:
    """Gaussian i becomes a copy of Gaussian index[i]; its moments come along unless fresh[i]. index, fresh: [M]."""
    device_index = ad.UInt32(index.astype(np.uint32))
    rows = [entries(row, device_index, gaussians.count) for row in gaussians.rows()]
    dr.eval(rows)
    moved = Gaussians.from_rows(rows)
    for name in (*NAMES, "features"):
        setattr(gaussians, name, getattr(moved, name))
    optimizer.select(device_index, ad.Bool(fresh))


def grow(
    gaussians: Gaussians, optimizer: Adam, duplicate: np.ndarray, split: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Duplicate and split the marked Gaussians ([N] bool each, disjoint). Returns the source of each one [M].

    The halves of a split are drawn from the Gaussian that they replace and are 1.6 times smaller; they and the
    duplicates start without moments. Order: those that stay, the duplicates, first halves, second halves.
    """
    splitting = np.flatnonzero(split)
    index = np.concatenate([np.flatnonzero(~split), np.flatnonzero(duplicate), *[splitting] * SPLIT_COUNT])
    stay = len(split) - len(splitting)
    fresh = np.arange(len(index)) >= stay
    if not fresh.any():
        return index
    arrays = gaussians.to_numpy()
    rearrange(gaussians, optimizer, index, fresh)
    if len(splitting) == 0:
        return index

    parents = np.tile(splitting, SPLIT_COUNT)
    scales = np.exp(arrays["log_scales"][parents].astype(np.float64))
    axes = rotation_from_quaternion(arrays["quaternions"][parents])
    offsets = np.einsum("nij,nj->ni", axes, scales * rng.standard_normal((len(parents), 3)))
    means = np.concatenate([arrays["means"][index[: -len(parents)]], arrays["means"][parents] + offsets])
    log_scales = arrays["log_scales"][index]
    log_scales[-len(parents) :] -= np.float32(np.log(SPLIT_SHRINK))
    gaussians.means = ad.Array3f(np.ascontiguousarray(means.T.astype(np.float32)))
    gaussians.log_scales = ad.Array3f(np.ascontiguousarray(log_scales.T))
    return index


def prune(gaussians: Gaussians, optimizer: Adam, remove: np.ndarray) -> np.ndarray:
    """Take the marked Gaussians out ([N] bool). Returns the index of each that stays; WorkError where none does."""
    index = np.flatnonzero(~remove)
    if len(index) == 0:
        raise WorkError("training: refinement would prune every Gaussian; lower prune_opacity or the learning rates")
    if remove.any():
        rearrange(gaussians, optimizer, index, np.zeros(len(index), bool))
    return index


def limit_opacities(gaussians: Gaussians, optimizer: Adam, highest: float) -> None:
    """Lower every opacity to at most `highest` and forget its moments (opacity reset)."""
    gaussians.logit_opacities = dr.minimum(gaussians.logit_opacities, float(np.log(highest / (1 - highest))))
    dr.eval(gaussians.logit_opacities)
    optimizer.forget(ROWS["logit_opacities"])
