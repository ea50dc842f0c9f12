"""Colours of vertices or faces as pictures: each face has a square of pixels, in which a colour is what it is between
the face's corners."""

from dataclasses import dataclass, replace

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.images import srgb_from_linear
from spacesim.scenes.meshes.parts import RawPart
from spacesim.scenes.meshes.textures import MAX_TEXTURE_SIDE, Notes

MAX_FACES = (MAX_TEXTURE_SIDE // 2) ** 2
PIXELS = 1 << 22  #: of all faces, about
MOST = 16  #: pixels of a side of a face's square, where faces are few
EVEN = 1 / 255  #: colours this near to each other are one
READ_AT_CORNERS = ("roughness", "metallic")  #: pictures that go with colours of vertices


def painted(part: RawPart, colors: Array, notes: Notes) -> RawPart:
    """`part`, which has a surface, in `colors` [F, 3, 3] of its faces' corners, linear, which multiply the surface's
    own. Where they vary they become a picture, and pictures of roughness and metal are read at the corners alone.
    Beside other pictures, of more than `MAX_FACES` faces, or where vertices are not there, it is one colour for the
    part, their mean, and a note says so."""
    assert part.surface is not None, "what is painted has a surface"
    surface, colors = part.surface, np.clip(np.nan_to_num(colors), 0.0, 1.0)
    beside = [name for name in surface.pictures if name not in READ_AT_CORNERS]
    uneven = len(colors) > 0 and float(np.ptp(colors, axis=(0, 1)).max()) > EVEN
    absent = (part.faces < 0) | (part.faces >= len(part.vertices))
    if not uneven or beside or len(colors) > MAX_FACES or absent.any():
        if uneven:
            notes.change("colours of vertices become one mean colour of the part", surface.name)
        mean = colors.mean(axis=(0, 1)) if len(colors) else np.ones(3)
        return replace(part, surface=surface.tinted(mean))
    layout = _Layout.of(len(colors))
    pictures = {"base_color": np.round(255 * srgb_from_linear(layout.picture(colors))).astype(np.uint8)}
    if part.uv is not None:
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


def at_corners(colors: Array, faces: np.ndarray) -> Array:
    """[F, 3, C] of colours [V, C], those of other vertices where one is not there."""
    return colors[np.clip(faces, 0, len(colors) - 1)] if len(colors) else np.ones((*faces.shape, 3))


@dataclass(frozen=True)
class _Layout:
    """Where in a picture the squares of the faces are."""

    across: int  #: squares
    down: int  #: squares
    side: int  #: pixels of a square, 2 or more

    @staticmethod
    def of(faces: int) -> "_Layout":
        across = int(np.ceil(np.sqrt(faces)))
        side = min(max(int(np.sqrt(PIXELS / faces)), 2), MOST, MAX_TEXTURE_SIDE // across)
        return _Layout(across, -(-faces // across), side)

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
        """[H, W, C] of values [F, 3, C] at corners: on the plane through a face's, also beyond its third side, where
        filters read, but within the range of all."""
        share = np.arange(self.side) / (self.side - 1)
        squares = np.full((self.across * self.down, self.side, self.side, values.shape[-1]), values[0, 0], np.float32)
        first, along, below = values[:, 0], values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
        squares[: len(values)] = (
            first[:, None, None] + share[:, None] * along[:, None, None] + share[:, None, None] * below[:, None, None]
        )
        rows = squares.reshape(self.down, self.across, self.side, self.side, -1).transpose(0, 2, 1, 3, 4)
        return np.clip(rows.reshape(self.down * self.side, self.across * self.side, -1), values.min(), values.max())


def _read(picture: np.ndarray, uv: Array, wrap: str) -> Array:
    """Bilinear values of a picture [H, W] at texture coordinates [..., 2], v down."""
    height, width = picture.shape
    place = np.nan_to_num(uv) * (width, height) - 0.5
    low = np.floor(place).astype(np.int64)
    share = place - low
    total = np.zeros(uv.shape[:-1])
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = (_wrapped(low[..., i] + d, size, wrap) for i, d, size in ((0, dx, width), (1, dy, height)))
            weight = np.abs(1 - dx - share[..., 0]) * np.abs(1 - dy - share[..., 1])
            total += weight * picture[y, x]
    return total


def _wrapped(index: np.ndarray, size: int, wrap: str) -> np.ndarray:
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        index = index % (2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return index % size
