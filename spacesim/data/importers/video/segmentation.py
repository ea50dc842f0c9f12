"""The object in pictures from space, cut out without learned weights: black sky, stars, the Earth with limb and clouds.

Before a black sky the object is what is brighter than the sky and neither a star nor cut off by the picture's border.
Where the Earth is behind it, colours decide: mixtures of Gaussians of the object's colours and of what surrounds it,
and a random walk with these as priors (L. Grady, "Multilabel random walker image segmentation using prior models",
2005), which stops at edges. In a sequence, frames whose background is black sky come first; from these the object is
followed to their neighbours, where it is nearly at the same place and of the same colours, while what is behind it
passes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.cluster.vq import vq
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

WORKING = 640  #: pixels of the longer side at which the object is looked for
_DARK = 0.08  # sRGB value of the brightest sky
_SKY_SHARE = 0.02  # of a picture, for a sky to be seen in it
_STAR = 16  # pixels at the working size of the largest star
_COLORS = 6  # Gaussians of a mixture
_SAMPLES = 4000  # pixels that a mixture is fitted to
_REACH = 0.12  # of the object's size: how far its outline moves from frame to frame, at most
_CUT = 2.5  # times the median change from frame to frame: the film is cut there
_ODDS = 6.0  # largest log-odds of one pixel's colour
_SMOOTH = 12.0  # weight of an edge between equal neighbours, of one pixel's odds
_CONTRAST = 60.0  # how fast that falls with the squared difference of colours
_SEED = 7

Load = Callable[[], np.ndarray]
"""Gives a picture when it is asked for: uint8 [H, W] or [H, W, 3]."""


@dataclass(frozen=True, eq=False)
class _Guess:
    """What is known of a frame's object."""

    mask: np.ndarray  #: [h, w] bool at the working size
    sure: bool  #: nothing but sky around it


def segment(picture: np.ndarray) -> np.ndarray:
    """[H, W] bool: the object in one picture, uint8 [H, W] or [H, W, 3]; all False where there is none."""
    return segment_sequence([lambda: picture])[0]


def segment_sequence(pictures: Sequence[Load], progress: Callable[[int], None] | None = None) -> list[np.ndarray]:
    """[H, W] bool of each picture of a sequence in time order, in which the object moves little from one to the next.

    progress: called with how many are done. Equal pictures give equal bits.
    """
    sizes, small = [], []
    for load in pictures:
        picture = load()
        sizes.append(picture.shape[:2])
        small.append(_working(picture))
    guesses = [_before_sky(image) for image in small]
    masks: list[np.ndarray | None] = [guess.mask if guess.sure else None for guess in guesses]
    done = sum(mask is not None for mask in masks)
    if done == 0:  # the Earth is behind the object in all of them
        start = len(small) // 2
        masks[start] = _before_earth(small[start])
        done = 1
    changes = [0.0, *(_change(a, b) for a, b in pairwise(small))]
    limit = _CUT * max(float(np.median(changes)), 0.004)
    for index, neighbour in _outwards([mask is not None for mask in masks]):
        if changes[max(index, neighbour)] > limit:
            masks[index] = _before_earth(small[index])
        else:
            known = masks[neighbour]
            assert known is not None
            masks[index] = _follow(small[index], small[neighbour], known)
        done += 1
        if progress is not None:
            progress(done)
    if progress is not None:
        progress(len(pictures))
    return [_enlarge(mask, size) for mask, size in zip(masks, sizes, strict=True) if mask is not None]


def _outwards(known: Sequence[bool]) -> list[tuple[int, int]]:
    """(frame, its neighbour that is known by then), nearest to what is known first."""
    distance = np.where(known, 0, len(known) + 1)
    for k in range(1, len(known)):
        distance[k] = min(distance[k], distance[k - 1] + 1)
    for k in range(len(known) - 2, -1, -1):
        distance[k] = min(distance[k], distance[k + 1] + 1)
    order = [int(k) for k in np.argsort(distance, kind="stable") if distance[k] > 0]
    return [(k, k - 1 if k > 0 and distance[k - 1] < distance[k] else k + 1) for k in order]


def _change(image: np.ndarray, other: np.ndarray) -> float:
    """Mean change of the pixels of the middle, where the object is."""
    if image.shape != other.shape:
        return math.inf
    height, width = image.shape[:2]
    middle = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return float(np.abs(image[middle] - other[middle]).mean())


def _working(picture: np.ndarray) -> np.ndarray:
    """[h, w, 3] float32: luma and two differences of colour, each about 0 to 1, at the working size."""
    image = Image.fromarray(picture).convert("RGB")
    scale = min(1.0, WORKING / max(image.size))
    if scale < 1:
        size = max(1, round(scale * image.width)), max(1, round(scale * image.height))
        image = image.resize(size, Image.Resampling.BOX)
    return luma_and_chroma(np.asarray(image))


def luma_and_chroma(pixels: np.ndarray) -> np.ndarray:
    """[h, w, 3] float32 of uint8 [h, w, 3]: luma and two differences of colour, each about 0 to 1."""
    red, green, blue = np.moveaxis(pixels.astype(np.float32) / 255, -1, 0)
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    return np.stack([luma, blue - luma, red - luma], axis=-1)


def _enlarge(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """`mask` at (height, width), its outline interpolated."""
    if mask.shape == size:
        return mask
    grey = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))
    return np.asarray(grey.resize((size[1], size[0]), Image.Resampling.BICUBIC)) >= 128


def _sky(image: np.ndarray) -> np.ndarray:
    """[h, w] bool: as dark as the sky, whose level and noise are those of the dark pixels; none where few are dark."""
    luma = image[..., 0]
    dark = luma[luma < _DARK]
    if dark.size < _SKY_SHARE * luma.size:
        return np.zeros(luma.shape, bool)
    level = float(np.median(dark))
    below = dark[dark <= level]  # above lie stars, limbs and what is in shadow
    noise = 1.4826 * float(np.median(level - below)) if below.size else 0.0
    return luma < level + max(5 * noise, 0.02)


def _before_sky(image: np.ndarray) -> _Guess:
    """What is brighter than the sky and larger than a star, without what the picture's border cuts off."""
    bright = ~_sky(image)
    labels, count = ndimage.label(bright, np.ones((3, 3)))
    if not count:
        return _Guess(bright, False)
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    at_border = np.isin(np.arange(count + 1), edge)
    small = areas <= _STAR
    small[0] = at_border[0] = True
    inner = ~small & ~at_border
    if not inner.any():
        return _Guess(np.zeros(bright.shape, bool), False)
    largest = int(np.argmax(np.where(inner, areas, 0)))
    mask = _whole(labels == largest, np.isin(labels, np.flatnonzero(inner)))
    around = ndimage.distance_transform_edt(~mask)
    around = (around > 2) & (around <= max(6.0, 0.5 * _REACH * _size_of(mask)))
    apart = np.count_nonzero(bright[around]) <= 0.02 * np.count_nonzero(around)
    return _Guess(mask, bool(apart and areas[largest] > 8 * _STAR and _is_middle(mask)))


def _without_stars(bright: np.ndarray) -> np.ndarray:
    labels, _ = ndimage.label(bright, np.ones((3, 3)))
    areas = np.bincount(labels.ravel())
    areas[0] = 0
    return areas[labels] > _STAR


def _is_middle(mask: np.ndarray) -> bool:
    """Whether its centre lies within the middle two thirds of the picture."""
    centre = np.array(ndimage.center_of_mass(mask)) / mask.shape
    return bool((np.abs(centre - 0.5) < 1 / 3).all())


def _size_of(mask: np.ndarray) -> float:
    """Pixels of a side of a square of the same area."""
    return math.sqrt(max(int(mask.sum()), 1))


def _whole(main: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """`main` with the `pieces` near it, gaps between them and holes closed: what lies in shadow is black as the sky."""
    size = _size_of(main)
    near = ndimage.distance_transform_edt(~main) <= 0.15 * size
    labels, _ = ndimage.label(pieces, np.ones((3, 3)))
    kept = np.isin(labels, np.setdiff1d(np.unique(labels[near]), 0)) | main
    radius = max(1, round(0.04 * size))
    padded = np.pad(kept, radius)
    grown = ndimage.distance_transform_edt(~padded) <= radius
    closed = ndimage.distance_transform_edt(grown) > radius
    return ndimage.binary_fill_holes(closed[radius:-radius, radius:-radius] | kept)


def _follow(image: np.ndarray, other: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The object in `image`, near where it is in `other`, a neighbour in time, and of the same colours."""
    if not mask.any():
        return _before_earth(image)
    reach = max(5.0, _REACH * _size_of(mask))
    inside = ndimage.distance_transform_edt(mask)
    outside = ndimage.distance_transform_edt(~mask)
    sure = inside > 0.8 * reach
    if not sure.any():
        sure = inside > 0.5 * inside.max()
    box = _box(outside <= 3 * reach)
    image, other, mask, outside, sure = image[box], other[box], mask[box], outside[box], sure[box]
    surroundings = outside > reach
    if not surroundings.any():
        return _placed(mask, box, inside.shape)
    signed = np.where(mask, inside[box], -outside)
    prior = 2.0 * np.clip(signed / reach, -1, 1)  # log-odds
    odds = prior + color_odds(image, other[mask], image[surroundings])
    odds = np.where(sure, 2 * _ODDS, np.where(surroundings, -2 * _ODDS, odds))
    object_mask = _walk(image, odds)
    main = _largest(object_mask & ~surroundings)
    if not main.any():
        return _placed(mask, box, inside.shape)
    return _placed(_whole(main, object_mask & ~surroundings), box, inside.shape)


def _before_earth(image: np.ndarray) -> np.ndarray:
    """The object in one picture alone: what is near the middle and of other colours than what is at the border."""
    if not _without_stars(~_sky(image)).any():
        return np.zeros(image.shape[:2], bool)
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    off = np.hypot((x + 0.5) / width - 0.5, (y + 0.5) / height - 0.5)  # 0 in the middle, 0.5 at the sides' middles
    border = np.minimum.reduce([x, width - 1 - x, y, height - 1 - y]) < 0.08 * min(height, width)
    rarity = -_Mixture(image[border]).log_density(image)
    rarity = ndimage.gaussian_filter(rarity, 2.0) - np.median(rarity[border])
    score = np.clip(rarity, 0, 30) * np.exp(-((off / 0.3) ** 2))
    mask = score > max(0.4 * float(np.quantile(score, 0.995)), 1e-3)
    mask = ndimage.binary_fill_holes(_largest(ndimage.binary_opening(mask, iterations=2)))
    for _ in range(4):  # as GrabCut does: colours of what was found, found anew
        if not mask.any():
            return mask
        outside = ndimage.distance_transform_edt(~mask)
        far = outside > max(5.0, 2 * _REACH * _size_of(mask))
        if not far.any():
            return mask
        prior = np.clip(2.0 - outside / max(3.0, 0.1 * _size_of(mask)), -4, 1)
        odds = prior + color_odds(image, image[mask], image[far])
        object_mask = _walk(image, np.where(border | far, -2 * _ODDS, odds))
        main = _largest(object_mask)
        mask = _whole(main, object_mask) if main.any() else main
    return mask


def rarity(image: np.ndarray, among: np.ndarray) -> np.ndarray:
    """[h, w] 0 to 30: how much rarer than their median colours [h, w, 3] are among others [N, 3], in log-densities."""
    common = _Mixture(among)
    middle = np.median(common.log_density(among[None, :: max(1, len(among) // _SAMPLES)]))
    return np.clip(middle - common.log_density(image), 0, 30)


def color_odds(image: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """[h, w] log-odds that pixels have the colours `inside` [N, 3] rather than those `outside` [M, 3]."""
    odds = _Mixture(inside).log_density(image) - _Mixture(outside).log_density(image)
    return np.clip(odds, -_ODDS, _ODDS)


class _Mixture:
    """Gaussians of clustered colours [N, 3] (C. Rother et al., "GrabCut", 2004, has them of clusters, too)."""

    def __init__(self, colors: np.ndarray) -> None:
        rng = np.random.default_rng(_SEED)
        chosen = colors if len(colors) <= _SAMPLES else colors[rng.choice(len(colors), _SAMPLES, replace=False)]
        chosen = chosen.astype(np.float64)
        spread = np.linalg.eigh(np.cov(chosen.T) if len(chosen) > 1 else np.eye(3))[1][:, -1]
        ordered = chosen[np.argsort(chosen @ spread, kind="stable")]
        centres = np.unique(ordered[((np.arange(_COLORS) + 0.5) / _COLORS * len(chosen)).astype(int)], axis=0)
        for _ in range(10):
            labels = vq(chosen, centres)[0]
            kept = [chosen[labels == k].mean(axis=0) for k in range(len(centres)) if (labels == k).any()]
            centres = np.array(kept)
        labels = vq(chosen, centres)[0]
        self.parts = []
        for k in range(len(centres)):
            members = chosen[labels == k]
            if len(members):
                covariance = np.eye(3) * 2e-4 + (np.cov(members.T) if len(members) > 3 else 0)
                inverse = np.linalg.inv(covariance)
                constant = math.log(len(members) / len(chosen)) + 0.5 * math.log(np.linalg.det(inverse))
                self.parts.append((members.mean(axis=0), inverse, constant))

    def log_density(self, image: np.ndarray) -> np.ndarray:
        """[h, w] of colours [h, w, 3], up to a constant; nowhere less than that of a colour far from all."""
        total = np.full(image.shape[:2], math.exp(-30.0))
        for mean, inverse, constant in self.parts:
            offset = image - mean
            total += np.exp(constant - 0.5 * np.einsum("...i,ij,...j->...", offset, inverse, offset))
        return np.log(total)


def _walk(image: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """[h, w] bool: where a random walker, who crosses no edges, would rather end inside than outside."""
    height, width = odds.shape
    index = np.arange(height * width).reshape(height, width)
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    weights: list[np.ndarray] = []
    for a, b in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        difference = ((image[a] - image[b]) ** 2).sum(axis=-1)
        length = 1.0 if len(pairs) < 2 else math.sqrt(0.5)
        weights.append(_SMOOTH * length * (np.exp(-_CONTRAST * difference) + 1e-3).ravel())
        pairs.append((index[a].ravel(), index[b].ravel()))
    rows, columns = (np.concatenate(part) for part in zip(*pairs, strict=True))
    weight = np.concatenate(weights).astype(np.float64)
    size = height * width
    adjacency = coo_matrix((weight, (rows, columns)), (size, size))
    adjacency = (adjacency + adjacency.T).tocsr()
    strength = np.abs(odds).ravel() + 1e-3
    degree = np.asarray(adjacency.sum(axis=1)).ravel() + strength
    system = diags(degree) - adjacency
    solution, _ = cg(
        system, strength * np.tanh(odds.ravel()), rtol=1e-3, maxiter=300, M=diags(1 / degree), x0=np.tanh(odds.ravel())
    )
    return (solution > 0).reshape(height, width)


def _largest(mask: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(mask)
    if count < 2:
        return mask
    areas = np.bincount(labels.ravel())
    areas[0] = 0
    return labels == int(np.argmax(areas))


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    rows, columns = ndimage.find_objects(mask.astype(np.uint8))[0]
    return rows, columns


def _placed(mask: np.ndarray, box: tuple[slice, slice], shape: tuple[int, ...]) -> np.ndarray:
    placed = np.zeros(shape, bool)
    placed[box] = mask
    return placed
