"""The Sun goes round a model while the camera stands still: a contact sheet and a video (thesis figure 4.2).

OUT/sweep.png   pictures evenly chosen, each with its Sun in numbers and on a map of the sky
OUT/sweep.mp4   all pictures, where there is an encoder
OUT/frames/*    each picture as it was rendered, where asked for; of runs in linear light an EXR, too
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from spacesim.data.errors import InputError
from spacesim.data.files import write_bytes
from spacesim.data.geometry import direction_from_angles
from spacesim.data.images import write_exr, write_png
from spacesim.data.images.sheet import (
    DARK_PAGE,
    DETAIL,
    LABEL_HEIGHT,
    MIN_TILE_WIDTH,
    Tile,
    contact_sheet,
    fit_picture,
    font,
)
from spacesim.data.images.tone import as_bytes
from spacesim.data.integrity.outputs import check_sweep_folder, clear_sweep, replaced_content
from spacesim.data.records import MAX_SIDE, Camera, Sun, check_size
from spacesim.learning.pictures import shadow_colors
from spacesim.splat.export.video import INSTALL, Video, encoder
from spacesim.splat.run import Predictor

KINDS = ("rgb", "shadow")
FRAMES, MAX_FRAMES = 72, 3600  #: by default: 5 degrees from one to the next, three seconds; and at most
ELEVATION_DEG = 30.0  #: of the Sun where nothing is said
RATE = 24  #: pictures a second
SHEET_NAME, VIDEO_NAME, FRAMES_NAME = "sweep.png", "sweep.mp4", "frames"

MAX_TILES, COLUMNS, SIDE = 24, 6, 224  #: of the sheet; pixels of a tile's longer side
MIN_VIDEO_SIDE = 320  #: pixels of a video's longer side: smaller pictures are enlarged by a whole number
SUN = (255, 190, 60)
_STRIP = 28  #: pixels of the video's caption


@dataclass(frozen=True)
class SweepFiles:
    """What a sweep has left on the disk."""

    sheet: Path  #: the contact sheet
    video: Path | None  #: None where none could be made
    note: str | None  #: why there is no video, or None


def suns_around(count: int = FRAMES, elevation_deg: float | None = None, azimuth_deg: float | None = None) -> list[Sun]:
    """`count` Suns evenly around a circle, degrees.

    At one elevation (ELEVATION_DEG by default): azimuth 0, 360 / count, ... Or at one azimuth: from the horizon there
    over the zenith to the horizon opposite, and back below. Raises InputError for numbers out of range.
    """
    if not 1 <= count <= MAX_FRAMES:
        raise InputError(f"frames: expected 1 to {MAX_FRAMES}, found {count}")
    turns = 360 * np.arange(count) / count
    if azimuth_deg is None:
        elevation = ELEVATION_DEG if elevation_deg is None else elevation_deg
        if not -90 <= elevation <= 90:
            raise InputError(f"elevation: expected degrees from -90 to 90, found {elevation:g}")
        return [Sun.from_angles(turn, elevation) for turn in turns]
    if elevation_deg is not None:
        raise InputError("azimuth: expected without elevation, found both; one of them changes from frame to frame")
    if not math.isfinite(azimuth_deg):
        raise InputError(f"azimuth: expected finite degrees, found {azimuth_deg:g}")
    ahead, up = direction_from_angles(azimuth_deg, 0), np.array([0.0, 0, 1])
    return [Sun(np.cos(angle) * ahead + np.sin(angle) * up) for angle in np.radians(turns)]


def resize_camera(camera: Camera, size: int | tuple[int, int]) -> Camera:
    """The camera with an image of another size, pixels: its longer side, or (width, height). All that it saw stays in
    the picture; where the shape differs, it sees more on two sides. Raises InputError for another size."""
    sides = size if isinstance(size, tuple) else (size, size)
    if len(sides) != 2 or not all(isinstance(side, int) for side in sides):
        raise InputError(f"size: expected whole pixels, or (width, height), found {size!r}")
    if min(sides) < 1:
        raise InputError(f"size: expected at least 1 pixel a side, found {'x'.join(map(str, sides))}")
    scale = min(sides[0] / camera.width, sides[1] / camera.height)
    width, height = sides
    if not isinstance(size, tuple):
        width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    check_size(width, height, "size")
    cx = 0.5 * width + scale * (camera.cx - 0.5 * camera.width)
    cy = 0.5 * height + scale * (camera.cy - 0.5 * camera.height)
    return Camera(camera.world_from_camera, width, height, scale * camera.fx, scale * camera.fy, cx, cy)


def sweep(
    run: Predictor,
    camera: Camera,
    suns: Sequence[Sun],
    out: Path,
    kind: str = "rgb",
    keep_frames: bool = False,
    report: Callable[[int, int], None] | None = None,
    exposure: float | None = None,
) -> SweepFiles:
    """Render `run` from `camera` under each of `suns` and write the files named above.

    kind: "rgb", over black, or "shadow": how much of the Sun is seen, from SHADOWED to LIT;  keep_frames: write every
    picture, too;  report: called with (pictures done, of all);  exposure: EV, see `Run.predict`
    Raises InputError for another kind, a run that no Sun relights, a run without shadows where these are asked for, an
    exposure of one whose colours are sRGB values, a folder that cannot be made or holds other files. The files of an
    earlier sweep go when these are complete.
    """
    out = Path(out)
    if kind not in KINDS:
        raise InputError(f"kind: expected {' or '.join(KINDS)}, found {kind!r}")
    if not suns:
        raise InputError("suns: expected at least one, found none")
    if not run.relightable:
        raise InputError(
            f"{run.path}: expected a run that the Sun relights, found one of the method {run.config['method']} that "
            "knows one light only; train with the method relight, nerf-relight, or one with shadows, on frames that "
            "name their Sun"
        )
    check_sweep_folder(out)
    video = _SweepVideo(camera) if encoder() else None
    first = _picture(run, camera, suns[0], kind, exposure)  # what does not fit the run shows before there is a folder
    count = min(MAX_TILES, len(suns))
    shown = {k * len(suns) // count for k in range(count)}
    tiles = []
    with replaced_content(out, clear_sweep) as part:
        for k, sun in enumerate(suns):
            picture, light = first if k == 0 else _picture(run, camera, sun, kind, exposure)
            if keep_frames:
                write_png(part / FRAMES_NAME / f"{k:04d}.png", picture, durable=False)
                if light is not None:
                    write_exr(part / FRAMES_NAME / f"{k:04d}.exr", {"linear": light}, durable=False)
            if video is not None:
                video.add(picture, sun)
            if k in shown:
                tiles.append(_tile(picture, sun))
            if report is not None:
                report(k + 1, len(suns))
        write_png(part / SHEET_NAME, _sheet(run, camera, suns, kind, tiles))
        if video is not None:
            write_bytes(part / VIDEO_NAME, video.video.content())
    if video is None:
        return SweepFiles(
            out / SHEET_NAME, None, f"{out / VIDEO_NAME}: not written, PyAV is not installed; type: {INSTALL}"
        )
    return SweepFiles(out / SHEET_NAME, out / VIDEO_NAME, None)


def sky_mark(sun: Sun, side: int = LABEL_HEIGHT - 4) -> np.ndarray:
    """[side, side, 3] uint8 on the dark page: the Sun on the sky seen from above, +x to the right, +y up, the zenith in
    the middle, the horizon at the rim. A ring instead of a disc: the Sun is below, mirrored at the horizon."""
    fine = 4 * side
    picture = Image.new("RGB", (fine, fine), DARK_PAGE.paper)
    draw = ImageDraw.Draw(picture)
    middle, rim, dot = 0.5 * fine, 0.40 * fine, 0.11 * fine
    draw.ellipse([middle - rim, middle - rim, middle + rim, middle + rim], outline=DARK_PAGE.faint, width=4)
    draw.line([middle - 6, middle, middle + 6, middle], DARK_PAGE.faint, 4)
    draw.line([middle, middle - 6, middle, middle + 6], DARK_PAGE.faint, 4)
    azimuth, elevation = sun.angles
    away = rim * (1 - abs(elevation) / 90)
    x, y = middle + away * math.cos(math.radians(azimuth)), middle - away * math.sin(math.radians(azimuth))
    box = [x - dot, y - dot, x + dot, y + dot]
    draw.ellipse(box, SUN if elevation >= 0 else DARK_PAGE.paper, SUN, width=10)
    return np.asarray(picture.resize((side, side), Image.Resampling.BOX))


def _picture(
    run: Predictor, camera: Camera, sun: Sun, kind: str, exposure: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """([H, W, 3] uint8, `Prediction.linear` of the kind rgb)."""
    prediction = run.predict(camera, sun, exposure=exposure)
    if kind == "rgb":
        return as_bytes(np.clip(np.nan_to_num(prediction.rgb), 0, 1)), prediction.linear
    if prediction.visibility is None:
        method = run.config["method"]
        raise InputError(f"{run.path}: expected a run of a method with shadows for the kind shadow, found {method}")
    return as_bytes(shadow_colors(prediction)), None


def _tile(picture: np.ndarray, sun: Sun) -> Tile:
    azimuth, elevation = (_degrees(angle) for angle in sun.angles)
    small = np.asarray(fit_picture(picture, SIDE, SIDE))
    return Tile(small, f"azimuth {azimuth}", f"elevation {elevation}", sky_mark(sun))


def _sheet(run: Predictor, camera: Camera, suns: Sequence[Sun], kind: str, tiles: Sequence[Tile]) -> np.ndarray:
    what = {"rgb": "relit", "shadow": "shadows (bright: the Sun is seen)"}[kind]
    parts = [f"{run.path.resolve().name}, {what} under {len(suns)} Sun{'s' if len(suns) > 1 else ''}"]
    parts += [f"{run.config['method']}, {camera.width} x {camera.height} px"]
    if len(tiles) < len(suns):
        parts += [f"{len(tiles)} shown"]
    columns = math.ceil(len(tiles) / math.ceil(len(tiles) / COLUMNS))
    aspect = camera.height / camera.width
    return contact_sheet(
        "; ".join(parts), tiles, len(tiles), aspect, columns, SIDE, DARK_PAGE, MIN_TILE_WIDTH + LABEL_HEIGHT
    )


def _degrees(angle: float) -> str:
    """At most one decimal, and none where it is 0."""
    return f"{round(angle, 1) + 0.0:g}°"


class _SweepVideo:
    """The video: each picture, enlarged by a whole number where it is small, over a strip that names its Sun."""

    def __init__(self, camera: Camera) -> None:
        self.times = -(-MIN_VIDEO_SIDE // max(camera.width, camera.height))
        width, height = self.times * camera.width, self.times * camera.height
        self.width, self.height = max(width, MIN_VIDEO_SIDE // 2), height
        if height + _STRIP > MAX_SIDE:
            limit = f"at most {MAX_SIDE - _STRIP:,} rows, below which the video has a strip of {_STRIP}"
            raise InputError(f"size: expected {limit}, found {camera.height:,}")
        self.video = Video(self.width, height + _STRIP, RATE)

    def add(self, picture: np.ndarray, sun: Sun) -> None:
        large = picture.repeat(self.times, axis=0).repeat(self.times, axis=1)
        page = Image.new("RGB", (self.width, self.height + _STRIP), DARK_PAGE.paper)
        ImageDraw.Draw(page).rectangle((0, 0, self.width - 1, self.height - 1), (0, 0, 0))
        page.paste(Image.fromarray(large), ((self.width - large.shape[1]) // 2, 0))
        azimuth, elevation = (_degrees(angle) for angle in sun.angles)
        draw, margin = ImageDraw.Draw(page), self.width - 2 * _STRIP
        text = f"Sun at azimuth {azimuth}, elevation {elevation}"
        if draw.textlength(text, font(DETAIL)) > margin:
            text = f"Sun {azimuth}, {elevation}"
        draw.text((8, self.height + _STRIP / 2), text, DARK_PAGE.ink, font(DETAIL), anchor="lm")
        mark = sky_mark(sun, _STRIP - 2)
        page.paste(Image.fromarray(mark), (self.width - mark.shape[1] - 4, self.height + 1))
        self.video.add(np.asarray(page))
