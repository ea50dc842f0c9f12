"""From what a client looks at to a picture: nothing here knows of servers or threads."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.records import Camera
from spacesim.viewer.drawing.paint import NEEDED, Bytes, Planes, depth_range, paint
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.state import DisplaySettings, SceneState, ViewerCamera

BUDGET = 1 / 15  #: seconds that a frame may take while the view moves: 15 frames a second
SHARES = (1.0, 0.75, 0.5, 0.375, 0.25)  #: of the full resolution, while the view moves
FIELD_BUDGET = 1 / 5  #: seconds, of radiance fields
FIELD_SHARES = (*SHARES, 0.1875, 0.125, 0.09375)  #: of these
STEPS = (0.25, 0.5, 1.0)  #: shares in which a picture of these comes at rest, beyond that while the view moves
STEP = 16  #: sides of pictures are multiples of this many pixels
STAIR = 128  #: and the longer one, in full resolution, of this many: few sizes occur, each of which compiles kernels
WARM = 3  #: frames of a size that compile kernels and are not timed
MIN_SIDE = 64  #: pixels of a side


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """A picture for a client."""

    picture: Bytes  #: [H, W, 3]
    planes: Planes | None  #: what it was painted from, or None
    seconds: float  #: that it took
    share: float  #: of the full resolution
    depths: tuple[float, float] | None  #: ends of the colour map in metres, or None
    note: str = ""  #: a sentence for the user, or ""


def picture_size(view: ViewerCamera, most: int, share: float = 1.0) -> tuple[int, int]:
    """(width, height) of the picture of a view, pixels: the window's shape and, in full resolution, its size rounded up
    to a STAIR, but at most `most` on the longer side; `share` of that. Pixels are not quite square then, and the camera
    knows that."""
    longer = max(view.width, view.height)
    scale = share * min(STAIR * -(-longer // STAIR), most) / longer
    width, height = (max(MIN_SIDE, STEP * round(scale * side / STEP)) for side in (view.width, view.height))
    return width, height


def draw_frame(
    renderer: SceneRenderer,
    state: SceneState,
    view: ViewerCamera,
    settings: DisplaySettings,
    share: float = 1.0,
    on_chunk: Callable[[], None] | None = None,
) -> ViewerFrame:
    """The picture of a view in the look's mode, without the truth; black, and a note that says why, of a scene that
    cannot be drawn. on_chunk: see `SceneRenderer.draw`"""
    start = time.perf_counter()
    camera = view.camera(*picture_size(view, settings.side, share))
    try:
        planes, picture, depths, note = draw_mode(renderer, state, camera, settings.mode, on_chunk, settings.stops)
    except InputError as error:
        planes = Planes(np.zeros((camera.height, camera.width)))
        picture, depths, note = _black(camera), None, f"no picture: {error}"
    return ViewerFrame(picture, planes, time.perf_counter() - start, share, depths, note)


def draw_mode(
    renderer: SceneRenderer,
    state: SceneState,
    camera: Camera,
    mode: str,
    on_chunk: Callable[[], None] | None = None,
    exposure: float = 0.0,
) -> tuple[Planes, Bytes, tuple[float, float] | None, str]:
    """(planes, picture, depths, note) of a camera in a mode; black, and a note that says why, where there is nothing of
    the mode to see. on_chunk, exposure: see `SceneRenderer.draw`"""
    if mode not in renderer.modes:
        planes = Planes(np.zeros((camera.height, camera.width)))
        return planes, _black(camera), None, f"no {mode} to be seen: scenes of Gaussians alone have such"
    planes = renderer.draw(state, camera, mode, on_chunk, exposure)
    depths = depth_range(planes) if mode == "depth" else None
    picture = paint(planes, mode, depths)
    if picture is not None:
        return planes, picture, depths, ""
    note = f"no {mode} to be seen: {renderer.why_missing(NEEDED[mode])}"
    return planes, _black(camera), None, note


def _black(camera: Camera) -> Bytes:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


@dataclass
class ResolutionControl:
    """Which share of the full resolution a moving view is drawn at, so that a frame takes `budget` seconds at most.

    One step down after a frame that took longer; one up where the larger picture, with that many more pixels, would
    still take 70 % of the budget at most. The first `warm` frames of a size, which compile kernels, do not count.
    """

    shares: tuple[float, ...] = SHARES  #: of the full resolution on a side, the first the largest
    budget: float = BUDGET
    warm: int = WARM
    level: int = 0  #: of `shares`
    _seen: dict[tuple[int, int], int] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Of the full resolution."""
        return self.shares[self.level]

    @staticmethod
    def of(renderer: SceneRenderer) -> "ResolutionControl":
        """That of a scene. Of radiance fields it begins with the fewest pixels, and one kernel draws any number."""
        if not renderer.progressive:
            return ResolutionControl()
        return ResolutionControl(FIELD_SHARES, FIELD_BUDGET, 0, len(FIELD_SHARES) - 1)

    def record_time(self, share: float, size: tuple[int, int], seconds: float) -> None:
        """Record how long a frame of `size` at `share` took."""
        if len(self._seen) > 256:
            self._seen.clear()
        self._seen[size] = self._seen.get(size, 0) + 1
        if self._seen[size] <= self.warm or share != self.share:
            return
        if seconds > self.budget:
            self.level = min(self.level + 1, len(self.shares) - 1)
        elif self.level > 0:
            larger = self.shares[self.level - 1]
            if seconds * (larger / share) ** 2 < 0.7 * self.budget:
                self.level -= 1
