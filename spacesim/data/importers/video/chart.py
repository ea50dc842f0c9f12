"""A picture of where the cameras stand and what points they have found, from above and from the side."""

import numpy as np
from PIL import Image, ImageDraw

from spacesim.data.geometry import Array
from spacesim.data.images.sheet import GAP, WHITE_PAGE, font
from spacesim.data.importers.video.model import SfmModel

_SIDE, _TITLE, _LABEL = 460, 26, 22  # pixels
_CAMERA, _FIRST, _AXIS = (31, 119, 180), (214, 39, 40), (150, 190, 215)
_VIEWS = (("from above", (0, 1), ("x", "y")), ("from the side", (0, 2), ("x", "z")))


def draw_cameras(model: SfmModel) -> np.ndarray:
    """[H, W, 3] uint8: points in their colours, cameras as dots with their optical axes, the first one red."""
    width, height = 2 * _SIDE + 3 * GAP, _SIDE + _TITLE + _LABEL + 2 * GAP
    image = Image.new("RGB", (width, height), WHITE_PAGE.paper)
    draw = ImageDraw.Draw(image)
    title = f"{len(model.names)} cameras, {len(model.points)} points"
    draw.text((GAP, GAP), title, WHITE_PAGE.ink, font(15))
    everything = np.concatenate([model.points, model.positions])
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    scale = 0.94 * _SIDE / max(float(np.ptp(everything, axis=0).max()), 1e-9)  # the same in both
    reach = 0.25 * float(np.median(np.linalg.norm(model.positions, axis=1)))
    for k, (name, axes, letters) in enumerate(_VIEWS):
        left, top = GAP + k * (_SIDE + GAP), _TITLE + GAP

        def to_page(places: Array, axes=axes, left=left, top=top) -> Array:
            flat = scale * (places - middle)[:, axes]
            return np.stack([left + _SIDE / 2 + flat[:, 0], top + _SIDE / 2 - flat[:, 1]], axis=-1)

        draw.rectangle([left, top, left + _SIDE, top + _SIDE], outline=WHITE_PAGE.faint)
        for place, color in zip(to_page(model.points), model.colors, strict=True):
            # bright points are darkened, so that they show on white
            draw.point([tuple(place.tolist())], tuple(int(value) for value in np.minimum(color, 190)))
        places, ends = to_page(model.positions), to_page(model.positions + reach * model.world_from_camera[:, :3, 2])
        for place, end in zip(places, ends, strict=True):
            draw.line([tuple(place.tolist()), tuple(end.tolist())], _AXIS)
        for number, (x, y) in reversed(list(enumerate(places.tolist()))):
            draw.ellipse([x - 2.5, y - 2.5, x + 2.5, y + 2.5], _FIRST if number == 0 else _CAMERA)
        words = f"{name}: {letters[0]} to the right, {letters[1]} upwards"
        draw.text((left, top + _SIDE + 3), words, WHITE_PAGE.faint, font(13))
    return np.asarray(image)
