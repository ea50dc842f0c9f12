"""Contact sheets: many small pictures on one page, each with its label."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

GAP = 8  #: pixels between pictures
NAME, DETAIL = 14, 13  #: pixels of a label's lines, first and second


@dataclass(frozen=True)
class Page:
    """sRGB colours of the paper, of text and of text that matters less."""

    paper: Color  #: of what is written on
    ink: Color  #: of text
    faint: Color  #: of text that matters less


WHITE_PAGE = Page((255, 255, 255), (0, 0, 0), (110, 110, 110))
DARK_PAGE = Page((20, 22, 27), (236, 236, 232), (150, 154, 162))


@dataclass(frozen=True, eq=False)
class Tile:
    """A small picture and its label."""

    pixels: np.ndarray  #: [H, W], [H, W, 3] or [H, W, 4] uint8, or [H, W] uint16
    name: str = ""  #: lines below it, "" for none
    detail: str = ""  #: lines below it, "" for none
    mark: np.ndarray | None = None  #: [h, w, 3] uint8, h at most `LABEL_HEIGHT` - 4, to the right of these, or None


LABEL_HEIGHT = 40  #: pixels of a label's height
MIN_TILE_WIDTH = 110  #: pixels, so that a name fits


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font: the same on every machine."""
    return ImageFont.load_default(size)


def fit_picture(pixels: np.ndarray, wide: int, high: int) -> Image.Image:
    """A picture over black, as large as fits into wide x high pixels. pixels: as in `Tile`."""
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.uint16)
        pixels = ((pixels[..., :3] * alpha + 127) // 255).astype(np.uint8)
    picture = Image.fromarray(pixels).convert("RGB")
    scale = min(wide / picture.width, high / picture.height)
    size = max(1, round(scale * picture.width)), max(1, round(scale * picture.height))
    return picture.resize(size, Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST)


def columns_for(count: int) -> int:
    """How many pictures a row of `count` has: a page wider than high, at most ten."""
    return min(10, max(1, math.ceil(math.sqrt(1.6 * count))))


def contact_sheet(
    title: str,
    tiles: Iterable[Tile],
    count: int,
    aspect: float,
    columns: int | None = None,
    side: int = 176,
    page: Page = WHITE_PAGE,
    least: int = MIN_TILE_WIDTH,
) -> np.ndarray:
    """[H, W, 3] uint8: the title, and `count` tiles row by row, over black where a picture is smaller than its place.

    aspect: height of a place by its width;  columns: tiles a row, `columns_for` by default;  side: pixels of the longer
    side of a place;  least: pixels that a place is wide, at least, for its label
    """
    columns = columns or columns_for(count)
    head = 52
    wide, high = (side, max(1, round(side * aspect))) if aspect <= 1 else (max(1, round(side / aspect)), side)
    wide = max(wide, least)
    rows = math.ceil(count / columns)
    title_width = math.ceil(font(20).getlength(title)) + 2 * GAP
    size = max(GAP + columns * (wide + GAP), 560, title_width), head + rows * (high + LABEL_HEIGHT + GAP)
    picture = Image.new("RGB", size, page.paper)
    draw = ImageDraw.Draw(picture)
    draw.text((GAP, head / 2), title, page.ink, font(20), anchor="lm")
    for k, tile in enumerate(tiles):
        x, y = GAP + k % columns * (wide + GAP), head + k // columns * (high + LABEL_HEIGHT + GAP)
        draw.rectangle((x, y, x + wide - 1, y + high - 1), (0, 0, 0))
        shown = fit_picture(tile.pixels, wide, high)
        picture.paste(shown, (x + (wide - shown.width) // 2, y + (high - shown.height) // 2))
        draw.text((x, y + high + 4), tile.name, page.ink, font(NAME))
        draw.text((x, y + high + 21), tile.detail, page.faint, font(DETAIL))
        if tile.mark is not None:
            corner = x + wide - tile.mark.shape[1], y + high + 4
            picture.paste(Image.fromarray(tile.mark), corner)
    return np.asarray(picture)
