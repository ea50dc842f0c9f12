"""Colours of vertices or faces as pictures: each face has a square of pixels, in which a colour is what it is between
the face's corners."""

from dataclasses import dataclass, replace

import numpy as np

from spacesim.backend.memory import check_memory
from spacesim.data.geometry import Array
from spacesim.data.images import srgb_from_linear
from spacesim.scenes.meshes.parts import RawPart
from spacesim.scenes.meshes.textures import MAX_TEXTURE_PIXELS, MAX_TEXTURE_SIDE, Notes

MAX_FACES = 1 << 20  #: of a part, so that each has `LEAST` pixels in a picture of `MAX_TEXTURE_SIDE`
PIXELS = 1 << 22  #: of a picture, about, where faces are few enough
LEAST, MOST = 3, 16  #: pixels of a side of a face's square
BYTES = 100  #: of memory that a pixel takes while it is made, at most
EVEN = 1 / 255  #: sRGB values this near to each other are one
MODES = {"clamp": "nearest", "mirror": "reflect"}  #: of scipy's; what is neither repeats
READ_AT_CORNERS = ("roughness", "metallic")  #: pictures that go with colours of vertices


def painted(part: RawPart, colors: Array, notes: Notes) -> RawPart:
    """`part`, which has a surface, in `colors` [F, 3, 3] of its faces' corners, linear, which multiply the surface's
    own. Where they vary they become a picture, and pictures of roughness and metal are read at the corners alone.
    Beside other pictures, of more than `MAX_FACES` faces or `MAX_TEXTURE_PIXELS` of a file, or where colours or
    vertices are missing, it is one colour for the part, their mean; notes say so. Raises MemoryError where it does not
    fit."""
    assert part.surface is not None, "what is painted has a surface"
    surface, colors = part.surface, np.clip(np.nan_to_num(colors), 0.0, 1.0)
    varies = len(colors) > 0 and float(np.ptp(srgb_from_linear(colors), axis=(0, 1)).max()) > EVEN
    layout = _Layout.of(len(colors), MAX_TEXTURE_PIXELS - notes.pixels) if varies and _is_whole(part, colors) else None
    if layout is None:
        if varies:
            notes.change("colours of vertices become one mean colour of the part", surface.name)
        mean = colors.mean(axis=(0, 1)) if len(colors) else np.ones(3)
        return replace(part, surface=surface.tinted(mean))
    check_memory(BYTES * layout.pixels, f"{surface.name}: its colours of vertices")
    notes.pixels += layout.pixels
    pictures = {"base_color": np.round(255 * srgb_from_linear(layout.picture(colors))).astype(np.uint8)}
    if part.uv is not None:
        if surface.pictures:
            notes.change("roughness and metal of textures are read at vertices, which have colours", surface.name)
        places = part.uv[part.faces]
        for name, picture in surface.pictures.items():
            values = _read(picture, places, surface.wrap) / 255
            pictures[name] = np.round(255 * layout.picture(values[..., None])[..., 0]).astype(np.uint8)
    corners = part.faces.ravel()
    return replace(
        part,
        vertices=part.vertices[corners],
        faces=np.arange(len(corners)).reshape(-1, 3),
        uv=layout.corners(len(colors)),
        surface=replace(surface, pictures=pictures, wrap="clamp"),
    )


def _is_whole(part: RawPart, colors: Array) -> bool:
    """Can a part be painted, each of its faces?"""
    assert part.surface is not None
    others = set(part.surface.pictures) - set(READ_AT_CORNERS)
    absent = (part.faces < 0) | (part.faces >= len(part.vertices))
    return not others and len(colors) == len(part.faces) <= MAX_FACES and not absent.any()


def at_corners(colors: Array, faces: np.ndarray) -> Array:
    """[F, 3, C] of colours [V, C], those of other vertices where one is not there."""
    return colors[np.clip(faces, 0, len(colors) - 1)] if len(colors) else np.ones((*faces.shape, 3))


@dataclass(frozen=True)
class _Layout:
    """Where in a picture the squares of the faces are."""

    across: int  #: squares
    down: int  #: squares
    side: int  #: pixels of a square, `LEAST` or more

    @staticmethod
    def of(faces: int, pixels: int) -> "_Layout | None":
        """As fine as so many pixels allow; None where they are too few."""
        across = int(np.ceil(np.sqrt(faces)))
        down = -(-faces // across)
        side = min(int(np.sqrt(max(min(pixels, PIXELS), 0) / (across * down))), MOST, MAX_TEXTURE_SIDE // across)
        if side < LEAST and LEAST**2 * across * down <= pixels:
            side = LEAST  # of many faces
        return _Layout(across, down, side) if side >= LEAST else None

    @property
    def pixels(self) -> int:
        """Of the picture."""
        return self.across * self.down * self.side**2

    def corners(self, faces: int) -> Array:
        """[3 F, 2] texture coordinates, v down, of the faces' corners: centres of three corner pixels of a square."""
        row, column = np.divmod(np.arange(faces), self.across)
        last = self.side - 1
        place = self.side * np.stack([column, row], axis=1)[:, None] + [
            (0.5, 0.5),
            (last + 0.5, 0.5),
            (0.5, last + 0.5),
        ]
        return np.asarray(place / (self.side * self.across, self.side * self.down)).reshape(-1, 2)

    def picture(self, values: Array) -> Array:
        """[H, W, C] of values [F, 3, C] at corners: on the plane through a face's, also just beyond its third side,
        where filters read, within the range of all. What is farther off is turned about the square's middle, and
        squares without a face repeat others, so that the picture's mean is about that of the faces."""
        last = self.side - 1
        column, row = np.meshgrid(np.arange(self.side), np.arange(self.side))
        beyond = column + row > last + 1
        along, below = (np.where(beyond, last - index, index)[..., None] / last for index in (column, row))
        filled = np.resize(values, (self.across * self.down, 3, values.shape[-1])).astype(np.float32)
        first, second, third = (filled[:, i, None, None] for i in range(3))
        squares = first + along.astype(np.float32) * (second - first) + below.astype(np.float32) * (third - first)
        rows = squares.reshape(self.down, self.across, self.side, self.side, -1).transpose(0, 2, 1, 3, 4)
        pixels = rows.reshape(self.down * self.side, self.across * self.side, -1)
        return np.clip(pixels, values.min(axis=(0, 1)), values.max(axis=(0, 1)))


def _read(picture: np.ndarray, uv: Array, wrap: str) -> Array:
    """Bilinear values of a picture [H, W] at texture coordinates [..., 2], v down."""
    from scipy.ndimage import map_coordinates  # a quarter of a second, that most meshes need not wait

    uv = np.nan_to_num(uv)
    uv = np.clip(uv, 0, 1) if wrap == "clamp" else np.mod(uv, 2)  # the same place, and no number too large for it
    height, width = picture.shape
    places = np.moveaxis(uv * (width, height) - 0.5, -1, 0)[::-1]
    return np.asarray(map_coordinates(picture, places, output=np.float64, order=1, mode=MODES.get(wrap, "grid-wrap")))
