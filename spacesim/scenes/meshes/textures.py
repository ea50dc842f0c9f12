"""What a mesh file says of a surface, its pictures and where they may lie, and the Material that becomes of it."""

import base64
import binascii
import io
import math
import unicodedata
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from PIL import Image

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, read_bytes
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.scenes.materials.table import SMOOTHEST, WHITEST, Color, Material, lambertian, material, principled

MAX_FILE_BYTES = 2 << 30  #: bytes of a file that is read
MAX_PICTURE_PIXELS = 1 << 26  #: pixels of a texture that is read (8192 x 8192)
MAX_TEXTURE_PIXELS = 1 << 27  #: of all textures of a file: eight of 4096 x 4096
DECODING = 20  #: bytes that a pixel takes while it is decoded, at most
MAX_TEXTURE_SIDE = 4096  #: pixels; wider or higher textures are reduced to it

NORMALS = "normals of vertices are not used, facets are flat"

_UNDECODED = "textures that cannot be decoded are not used"

DEFAULT_PRESET = "grey-paint"  #: preset of parts whose file says nothing of their surface


class Notes:
    """What a reader dropped, changed and made opaque, collected by kind: each kind becomes one sentence."""

    def __init__(self) -> None:
        self._kinds: dict[tuple[str, str], dict[str, None]] = {}
        self.pixels = 0  #: of the textures that have been decoded

    def drop(self, kind: str, subject: str = "") -> None:
        """Something in the file that is not used."""
        self._kinds.setdefault(("dropped", kind), {})[subject] = None

    def change(self, kind: str, subject: str = "") -> None:
        """Something that is not as in the file."""
        self._kinds.setdefault(("changed", kind), {})[subject] = None

    def make_opaque(self, subject: str) -> None:
        """A material that lets light through, which is rendered as if it did not."""
        self._kinds.setdefault(("opaque", "transparent surfaces"), {})[subject] = None

    def sentences(self, which: str) -> tuple[str, ...]:
        """One sentence a kind; at most 5 of its subjects are named. which: "dropped", "changed" or "opaque"."""
        return tuple(_sentence(kind, list(names)) for (group, kind), names in self._kinds.items() if group == which)


def _sentence(kind: str, subjects: list[str]) -> str:
    named = [name for name in subjects if name]
    if not named:
        return kind
    others = f" and {len(named) - 5} more" if len(named) > 5 else ""
    return f"{kind}: {', '.join(named[:5])}{others}"


def plain_name(name: object) -> str:
    """`name` in ASCII letters, digits and "_", "-": accents are taken off, all else becomes "_"; "" can result."""
    text = unicodedata.normalize("NFKD", str(name)[:200])
    text = "".join(c for c in text if not unicodedata.combining(c))
    text = "".join(c if c.isascii() and (c.isalnum() or c == "-") else "_" for c in text)
    return "_".join(piece for piece in text.split("_") if piece)[:80]


class Folder:
    """The files that a mesh file may name: those in its own folder and below."""

    def __init__(self, path: Path) -> None:
        self.root = path.resolve().parent

    def read(self, uri: str) -> bytes:
        """The bytes of the file called `uri` (relative; percent-encoded or plain). Raises InputError with one
        clause: not there, outside of the folder, an address, too large."""
        if "://" in uri[:32] or uri[:5].lower() in ("data:", "file:"):
            raise InputError(f"{uri[:80]!r} is an address, expected a file beside the mesh")
        for name in dict.fromkeys((uri, unquote(uri))):
            relative = PurePosixPath(name.strip().strip('"').replace("\\", "/"))
            try:
                target = (self.root / relative).resolve()
                if relative.is_absolute() or not target.is_relative_to(self.root):
                    raise InputError(f"{uri[:80]!r} lies outside of the mesh's folder")
                if target.is_file():
                    return read_bytes(target, "a file", MAX_FILE_BYTES)
            except (OSError, ValueError, RuntimeError) as error:  # a name with NUL, a loop of links, no permission
                if isinstance(error, InputError):
                    raise
                raise InputError(f"{uri[:80]!r} cannot be read ({type(error).__name__})") from None
        raise InputError(f"{uri[:80]!r} is {'no regular file' if target.exists() else 'not there'}")


def decode_data_uri(uri: str) -> bytes:
    """The bytes in a data URI; InputError where they are not base64."""
    head, _, payload = uri.partition(",")
    try:
        if not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(payload, validate=False)
    except (ValueError, binascii.Error):
        raise InputError("expected base64 data in a data URI, found something else") from None


def decode_image(data: bytes, what: str, notes: Notes) -> np.ndarray | None:
    """[H, W, 3] uint8 picture of an encoded image, None (and a note) where it cannot be had.

    Alpha is left out, 16 bits are cut to 8, and what is wider than MAX_TEXTURE_SIDE is reduced.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(data))
            if image.width * image.height <= MAX_PICTURE_PIXELS and notes.pixels < MAX_TEXTURE_PIXELS:
                check_memory(DECODING * image.width * image.height, f"{what}: decoding it")
                notes.pixels += image.width * image.height
                return _rgb_picture(image, what, notes)
    except MemoryError:
        raise
    except Exception:  # Pillow raises what it likes on damaged data
        notes.drop(_UNDECODED, what)
        return None
    limit = f"{MAX_PICTURE_PIXELS:,} pixels, or {MAX_TEXTURE_PIXELS:,} in all"
    notes.drop(f"textures of more than {limit} are not used", what)
    return None


def check_picture(data: bytes, what: str, notes: Notes) -> None:
    """FileNotFoundError (and a note) where `data` does not begin as an image does."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            Image.open(io.BytesIO(data))
    except Exception:
        notes.drop(_UNDECODED, what)
        raise FileNotFoundError(what) from None


def _rgb_picture(image: Image.Image, what: str, notes: Notes) -> np.ndarray:
    if image.mode.startswith(("I", "F")):  # 16-bit grey; Pillow's own conversion would clip it
        values = np.asarray(image, dtype=np.float64)
        grey = np.clip(values / (257.0 if image.mode.startswith("I") else 1.0 / 255.0), 0, 255)
        image = Image.fromarray(np.round(grey).astype(np.uint8))
    if max(image.size) > MAX_TEXTURE_SIDE:
        factor = MAX_TEXTURE_SIDE / max(image.size)
        size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
        notes.change(
            "textures are reduced in size", f"{what} from {image.width} x {image.height} to {size[0]} x {size[1]}"
        )
        image = image.convert("RGBA" if "A" in image.getbands() else "RGB").resize(size, Image.Resampling.BOX)
    if image.mode == "P" or "transparency" in image.info:
        image = image.convert("RGBA")  # keeps the colours below what is transparent
    if image.mode in ("RGBA", "LA", "RGBX"):
        return np.array(image.convert("RGBA"))[..., :3].copy()
    return np.array(image.convert("RGB"))


@dataclass(frozen=True, eq=False)
class Surface:
    """A material as its file gives it, already free of what cannot be had."""

    name: str  #: as the file has it
    base_color: Color = (1.0, 1.0, 1.0)  #: linear RGB
    metallic: float = 0.0  #: share of metal, 0 to 1
    roughness: float = 1.0  #: 0 to 1, as glTF has it: GGX alpha is its square
    #: "base_color" [H, W, 3] sRGB-encoded, "metallic" and "roughness" [H, W], "normal" [H, W, 3], all uint8; the
    #: numbers multiply the pictures
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    wrap: str = "repeat"  #: "repeat", "clamp" or "mirror"
    matt: bool = False  #: without gloss and metal, an ideally diffuse surface

    def tinted(self, tint: Iterable[float]) -> "Surface":
        """The same under a factor [3] on its colour."""
        red, green, blue = (float(a) * clip_to_unit(b) for a, b in zip(self.base_color, tint, strict=True))
        return replace(self, base_color=(red, green, blue))

    def bare(self) -> "Surface":
        """The same without pictures."""
        return replace(self, pictures={})


def clip_to_unit(value: object, default: float = 1.0) -> float:
    """`value` clipped to [0, 1]; `default` where it is no finite number."""
    number = float(value) if isinstance(value, (int, float, np.number)) else math.nan
    return min(max(number, 0.0), 1.0) if math.isfinite(number) else default


def material_of(surface: Surface | None, prefix: str, file: str, notes: Notes) -> Material:
    """The Material of a surface (None: DEFAULT_PRESET). Its name begins with `prefix`, its source names `file`."""
    if surface is None:
        return material(DEFAULT_PRESET)
    name = f"{prefix}/{plain_name(surface.name) or 'material'}"
    source = f"material {surface.name!r} of {file}: its maker's numbers, not measured"
    result = _matt(surface, name, source) if surface.matt else _glossy(surface, name, source, notes)
    return replace(result, bsdf=_with_wrap_mode(result.bsdf, surface.wrap))


def _matt(surface: Surface, name: str, source: str) -> Material:
    if "base_color" not in surface.pictures:
        return lambertian(name, surface.base_color, source)
    picture, mean = _tinted_picture(surface.pictures["base_color"], surface.base_color, 1.0)
    reflectance = {"type": "bitmap", "image": "base_color", "raw": False}
    return Material(name, mean, {"type": "diffuse", "reflectance": reflectance}, source, {"base_color": picture})


def _glossy(surface: Surface, name: str, source: str, notes: Notes) -> Material:
    """glTF's metallic-roughness model. The pictures get their factors here, so that limits see the product."""
    pictures = dict(surface.pictures)
    metallic, roughness = surface.metallic, surface.roughness
    least_metal, least_rough = metallic, roughness
    if "metallic" in pictures:
        least_metal *= float(pictures["metallic"].min()) / 255.0
    if "roughness" in pictures:
        least_rough *= float(pictures["roughness"].min()) / 255.0
    if least_rough < SMOOTHEST:
        notes.change(
            f"roughness below {SMOOTHEST:g} is taken as {SMOOTHEST:g}, a mirror never meets the Sun", surface.name
        )
    most = 1.0 - (1.0 - WHITEST) * (1.0 - least_metal)
    color, brightest = surface.base_color, max(surface.base_color)
    if "base_color" in pictures:
        picture = pictures["base_color"]
        brightest = max(c * float(linear_from_srgb(picture[..., i].max() / 255.0)) for i, c in enumerate(color))
        pictures["base_color"], _ = _tinted_picture(picture, color, most)
        color = (1.0, 1.0, 1.0)
    else:
        red, green, blue = (min(c, most) for c in color)
        color = (red, green, blue)
    if brightest > most:
        notes.change(
            f"base colours above {WHITEST:g} (less of metals) are taken as {WHITEST:g}, else the surface would "
            "give out more light than it gets",
            surface.name,
        )
    return principled(name, color, metallic, roughness, source, pictures)


def _tinted_picture(picture: np.ndarray, factor: Color, most: float) -> tuple[np.ndarray, Color]:
    """([H, W, 3] sRGB picture times the linear factor, at most `most`; its mean linear colour)."""
    table = np.minimum(linear_from_srgb(np.arange(256) / 255.0)[:, None] * np.asarray(factor), most)  # [256, 3]
    encoded = np.round(255.0 * srgb_from_linear(table)).astype(np.uint8)
    tinted = np.stack([encoded[picture[..., c], c] for c in range(3)], axis=-1)
    mean = [float(np.bincount(picture[..., c].ravel(), minlength=256) @ table[:, c]) for c in range(3)]
    pixels = picture.shape[0] * picture.shape[1]
    return tinted, (mean[0] / pixels, mean[1] / pixels, mean[2] / pixels)


def _with_wrap_mode(bsdf: JsonMapping, wrap: str) -> JsonMapping:
    """`bsdf` with the wrap mode of its bitmaps, where it is not Mitsuba's own, "repeat"."""
    if wrap == "repeat":
        return bsdf
    nested = {key: _with_wrap_mode(value, wrap) if isinstance(value, Mapping) else value for key, value in bsdf.items()}
    return {**nested, "wrap_mode": wrap} if nested.get("type") == "bitmap" else nested
