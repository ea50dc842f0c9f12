"""Frames that show hardly anything: how much of the object is in sunlight, and a warning that counts those without."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from spacesim.data.images import read_png
from spacesim.data.store import SHADOW_LIT, SHADOW_NONE

DARK = 0.01
"""Fraction of the object's pixels in sunlight below which a frame counts as dark."""

_log = logging.getLogger(__name__)


def sunlit_fractions(root: Path, names: Sequence[str]) -> dict[str, float | None]:
    """{frame: the fraction of its object's pixels that the Sun lights, None where it shows no object}, read from
    shadow/*.png. Raises InputError where one cannot be read."""

    def fraction(name: str) -> float | None:
        counts = np.bincount(read_png(root / "shadow" / f"{name}.png").ravel(), minlength=256)
        seen = int(counts.sum() - counts[SHADOW_NONE])
        return int(counts[SHADOW_LIT]) / seen if seen else None

    with ThreadPoolExecutor() as pool:
        return dict(zip(names, pool.map(fraction, names), strict=True))


def warn_of_dark_frames(sunlit: Mapping[str, float | None], eclipsed: Mapping[str, bool], hint: str) -> None:
    """Log one warning that counts the frames without an object or without sunlight on it.

    eclipsed: frames of which the Earth hides all of the Sun; hint: what avoids dark frames
    """
    empty = [name for name, share in sunlit.items() if share is None]
    dark = [name for name, share in sunlit.items() if share is not None and share < DARK]
    words = []
    if dark:
        behind = sum(eclipsed.get(name, False) for name in dark)
        why = f", in {behind} of them the Earth hides the Sun" if behind else ""
        words.append(f"{len(dark)} of {len(sunlit)} frames show the object in the dark ({dark[0]} first{why})")
    if empty:
        words.append(f"{len(empty)} of {len(sunlit)} frames show no object ({empty[0]} first)")
    if words:
        _log.warning("generate: %s", "; ".join([*words, *([hint] if dark and hint else [])]))
