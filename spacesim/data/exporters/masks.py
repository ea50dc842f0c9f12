"""Masks in other forms: boxes, run lengths as COCO has them, outlines."""

from typing import TypedDict

import numpy as np
from scipy.spatial.distance import cdist

from spacesim.data.geometry import Array

NO_BOX = (-1, -1, -1, -1)


class Rle(TypedDict):
    """A mask as pycocotools reads it."""

    size: list[int]  #: height, width
    counts: str


def bounding_box(pixels: np.ndarray, origin: tuple[int, int] = (0, 0)) -> tuple[int, int, int, int]:
    """(x, y, width, height) of what is set in [H, W] bool whose first pixel is at `origin`; -1 each for none."""
    if not pixels.any():
        return NO_BOX
    columns, rows = np.flatnonzero(pixels.any(axis=0)), np.flatnonzero(pixels.any(axis=1))
    x, y = int(columns[0]), int(rows[0])
    return x + origin[0], y + origin[1], int(columns[-1]) - x + 1, int(rows[-1]) - y + 1


def run_lengths(mask: np.ndarray) -> Rle:
    """A mask [H, W] bool by the lengths of its runs, column after column, the first of what is not set. Each is
    written less the one before the last, five bits a character, as pycocotools has it."""
    flat = np.asarray(mask, bool).ravel(order="F")
    ends = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff(np.r_[0, ends, flat.size]).tolist()
    if flat[0]:
        counts.insert(0, 0)
    text = []
    for k, count in enumerate(counts):
        rest = count - (counts[k - 2] if k > 2 else 0)
        while True:
            bits, rest = rest & 0x1F, rest >> 5
            more = rest != (-1 if bits & 0x10 else 0)
            text.append(chr(48 + (bits | 0x20 if more else bits)))
            if not more:
                break
    return {"size": list(mask.shape), "counts": "".join(text)}


def outline(mask: np.ndarray) -> Array:
    """[P, 2] x, y of one closed polygon along the edges of the pixels set in [H, W] bool, of which there must be one.

    Parts and holes are joined by bridges, there and back: by even-odd and by its area it is the mask.
    """
    loops = sorted(_loops(mask), key=lambda loop: -abs(_area(loop)))
    chain = loops[0]
    for loop in loops[1:]:
        here, there = np.unravel_index(int(cdist(chain, loop).argmin()), (len(chain), len(loop)))
        detour = np.concatenate([loop[there:], loop[: there + 1], chain[here : here + 1]])
        chain = np.concatenate([chain[: here + 1], detour, chain[here + 1 :]])
    return chain


def _loops(mask: np.ndarray) -> list[Array]:
    """Corners of the closed lines between what is set and what is not, which lies to their left."""
    padded = np.pad(np.asarray(mask, np.int8), 1)
    onward: dict[tuple[int, int], list[tuple[int, int]]] = {}

    def add(where: np.ndarray, start: tuple[int, int], end: tuple[int, int]) -> None:
        for row, column in np.argwhere(where).tolist():
            onward.setdefault((column + start[0], row + start[1]), []).append((column + end[0], row + end[1]))

    down, right = np.diff(padded, axis=0)[:, 1:-1], np.diff(padded, axis=1)[1:-1]
    add(down == 1, (0, 0), (1, 0))
    add(down == -1, (1, 0), (0, 0))
    add(right == 1, (0, 1), (0, 0))
    add(right == -1, (0, 0), (0, 1))
    loops = []
    while onward:
        start = place = next(iter(onward))
        corners: list[tuple[int, int]] = []
        while True:
            ends = onward[place]
            following = ends.pop()
            if not ends:
                del onward[place]
            corners.append(place)
            place = following
            if place == start:
                break
        loop = np.array(corners, np.float64)
        turns = (np.roll(loop, -1, axis=0) - loop != loop - np.roll(loop, 1, axis=0)).any(axis=1)
        loops.append(loop[turns])
    return loops


def _area(loop: Array) -> float:
    x, y = loop.T
    return float(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
