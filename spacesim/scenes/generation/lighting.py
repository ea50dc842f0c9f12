"""Frames that show hardly anything: how much of the object is in sunlight, before a frame is made and after, and a
warning that counts those without."""

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from spacesim.data.records import Camera
from spacesim.data.store import sunlit_share
from spacesim.scenes.generation.frames import FrameSpec, shadow_under
from spacesim.scenes.generation.moves import as_moved
from spacesim.scenes.render import Renderer

DARK = 0.01
"""Fraction of the object's pixels in sunlight below which a frame counts as dark."""

COARSE = 64
"""Pixels of the longer side of the smallest picture by which the light of a view is checked."""

CLEAR = 1.5
"""Over the square root of the object's pixels: how far from the limit the sunlit share of a coarse picture is where
that picture settles on which side the frame's share is. One share in a hundred was off by 0.9 over that root."""

_log = logging.getLogger(__name__)


def is_sunlit(renderer: Renderer, spec: FrameSpec, least: float) -> bool:
    """Whether the Sun lights at least this fraction, above 0, of the object's pixels in a frame that is to be made: by
    the labels of a small picture, by those of larger ones as long as these leave it open, and at last by the frame's.

    renderer: of the scene
    """
    renderer = as_moved(renderer, spec.objects)
    longest = max(spec.camera.width, spec.camera.height)
    size = min(COARSE, longest)
    while True:
        labels = renderer.labels(_resized(spec.camera, size / longest), spec.sun, spec.earth)
        share, seen = sunlit_share(shadow_under(np.float32(spec.sunlight) * labels["sun_visibility"], labels["shadow"]))
        if size == longest or (seen and abs(share - least) > CLEAR / seen**0.5):
            return share >= least
        size = min(2 * size, longest)


def _resized(camera: Camera, factor: float) -> Camera:
    """The camera whose picture shows the same in `factor` times as many pixels a side, about."""
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, width=width, height=height, fx=x * camera.fx, fy=y * camera.fy, cx=x * camera.cx, cy=y * camera.cy
    )


def warn_of_dark_frames(
    sunlit: Mapping[str, float | None], eclipsed: Mapping[str, bool], hint: str, looks_at_it: bool
) -> None:
    """Log one warning that counts the frames without an object or without sunlight on it.

    eclipsed: frames of which the Earth hides all of the Sun; hint: what avoids dark frames; looks_at_it: whether
    cameras are made to look at the object, not given
    """
    empty = [name for name, share in sunlit.items() if share is None]
    dark = [name for name, share in sunlit.items() if share is not None and share < DARK]
    words, hints = [], [hint] if dark and hint else []
    if dark:
        behind = sum(eclipsed.get(name, False) for name in dark)
        why = f", in {behind} of them the Earth hides the Sun" if behind else ""
        words.append(f"{len(dark)} of {len(sunlit)} frames show the object in the dark ({dark[0]} first{why})")
    if empty:
        words.append(f"{len(empty)} of {len(sunlit)} frames show no object ({empty[0]} first)")
    if len(empty) == len(sunlit):
        given = "check which way attitudes turn, and whether lengths are in m or km"
        hints = ["it is smaller than a pixel, most likely" if looks_at_it else given]
    if words:
        _log.warning("generate: %s", "; ".join([*words, *hints]))
