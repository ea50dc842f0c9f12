"""Materials and textures of a glTF document (3.8, 3.9 of the specification) as surfaces."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.scenes.meshes.textures import Folder, Notes, Surface, clip_to_unit, decode_data_uri, decode_image

UV_SET = "TEXCOORD_{}"
_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


@dataclass(frozen=True, eq=False)
class UvSet:
    """Which texture coordinates a material takes, and how: uv' = matrix [2, 3] (u, v, 1)."""

    index: int  #: number of the set: TEXCOORD_0, TEXCOORD_1, ...
    matrix: np.ndarray  #: [2, 3], as above

    def apply(self, uv: np.ndarray) -> np.ndarray:
        """[V, 2] transformed coordinates, v down; integers count as normalised."""
        scale = np.iinfo(uv.dtype).max if uv.dtype.kind in "iu" else 1.0
        return uv / scale @ self.matrix[:, :2].T + self.matrix[:, 2]

    def same(self, other: "UvSet") -> bool:
        """Both lead to the same coordinates."""
        return self.index == other.index and np.allclose(self.matrix, other.matrix)


class Surfaces:
    """The materials of a document, each read once. view: reads a buffer view."""

    def __init__(self, document: JsonDict, view: Callable[[Any], bytes], folder: Folder, notes: Notes) -> None:
        self._document, self._view, self._folder, self._notes = document, view, folder, notes
        self._known: dict[int, tuple[Surface, UvSet]] = {}
        self._pictures: dict[int, np.ndarray | None] = {}

    def of(self, index: object) -> Surface | None:
        """The surface of material `index`; None where there is none."""
        return None if index is None else self._read(index)[0]

    def uv_set(self, index: object) -> UvSet:
        """The texture coordinates of material `index`."""
        return self._read(index)[1]

    def _read(self, index: object) -> tuple[Surface, UvSet]:
        if isinstance(index, bool) or not isinstance(index, int) or index < 0:
            raise InputError(f"expected the index of a material, found {str(index)[:40]!r}")
        if index not in self._known:
            entry = self._document["materials"][index]
            name = str(entry.get("name") or f"material {index}")[:80]
            self._note_the_unused(entry, name)
            self._known[index] = self._surface(entry, name)
        return self._known[index]

    def _note_the_unused(self, entry: JsonDict, name: str) -> None:
        if any(clip_to_unit(c, 0.0) > 0 for c in entry.get("emissiveFactor", ())):
            self._notes.drop("surfaces do not glow, emission is not used", name)
        if "occlusionTexture" in entry:
            self._notes.drop("baked occlusion is not used, the path tracer finds it", name)
        if entry.get("alphaMode", "OPAQUE") != "OPAQUE":
            self._notes.make_opaque(name)
        for extension in entry.get("extensions", {}):
            if extension != "KHR_materials_pbrSpecularGlossiness":
                self._notes.drop(f"{str(extension)[:60]} is not used", name)

    def _surface(self, entry: JsonDict, name: str) -> tuple[Surface, UvSet]:
        plain = entry.get("pbrMetallicRoughness", {})
        old = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if old is not None and "pbrMetallicRoughness" not in entry:
            self._notes.change("specular-glossiness materials become dielectrics of their diffuse colour", name)
            color, color_texture = old.get("diffuseFactor", (1, 1, 1)), old.get("diffuseTexture")
            metallic, roughness, other = 0.0, 1.0 - clip_to_unit(old.get("glossinessFactor", 1.0)), None
        else:
            color, color_texture = plain.get("baseColorFactor", (1, 1, 1)), plain.get("baseColorTexture")
            metallic, roughness = (
                clip_to_unit(plain.get("metallicFactor", 1.0)),
                clip_to_unit(plain.get("roughnessFactor", 1.0)),
            )
            other = plain.get("metallicRoughnessTexture")
        used = _MaterialTextures(self, name)
        base = used.take(color_texture, "base colour")
        combined = used.take(other, "metallic and roughness")
        normal = used.take(entry.get("normalTexture"), "normals")
        pictures: dict[str, np.ndarray] = {}
        if base is not None:
            pictures["base_color"] = base
        if combined is not None:  # 3.9.2: green is roughness, blue is metalness
            pictures["roughness"], pictures["metallic"] = combined[..., 1].copy(), combined[..., 2].copy()
        if normal is not None:
            pictures["normal"] = _scaled_normals(normal, entry["normalTexture"].get("scale", 1.0))
        red, green, blue = (clip_to_unit(c) for c in list(color)[:3])
        surface = Surface(name, (red, green, blue), metallic, roughness, pictures, used.wrap)
        return surface, used.uv or UvSet(0, np.eye(2, 3))

    def picture(self, texture: JsonDict, name: str) -> np.ndarray | None:
        """[H, W, 3] uint8 of a texture, None (and a note) where it cannot be had."""
        source = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
        if source is None:
            self._notes.drop("textures in formats that are not read are not used", name)
            return None
        if source not in self._pictures:
            self._pictures[source] = self._picture(self._document["images"][source], source)
        return self._pictures[source]

    def _picture(self, image: JsonDict, source: int) -> np.ndarray | None:
        uri = str(image.get("uri", ""))
        file = "" if uri.startswith("data:") else uri
        what = str(file or image.get("name") or f"image {source}")[:80]
        try:
            if "bufferView" in image:
                data = self._view(image["bufferView"])
            else:
                data = decode_data_uri(uri) if uri.startswith("data:") else self._folder.read(uri)
        except InputError as error:
            self._notes.drop("textures that cannot be had are not used", str(error))
            return None
        return decode_image(data, what, self._notes)

    def wrap(self, texture: JsonDict) -> str:
        """How a texture continues outside of [0, 1]: "repeat", "clamp" or "mirror"."""
        if "sampler" not in texture:
            return "repeat"
        sampler = self._document["samplers"][texture["sampler"]]
        modes = {_WRAPS.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT")}
        if len(modes) > 1:
            self._notes.change("textures that continue in two ways in u and v repeat in both")
            return "repeat"
        return modes.pop()

    def texture(self, info: JsonDict) -> JsonDict:
        """The texture that a material refers to."""
        return self._document["textures"][info["index"]]

    def note_left_out(self, what: str, name: str) -> None:
        """A texture with other coordinates than the material's first."""
        self._notes.drop(f"textures with other coordinates than the material's first are not used ({what})", name)


class _MaterialTextures:
    """The textures that one material takes: all with the coordinates of the first."""

    def __init__(self, surfaces: Surfaces, name: str) -> None:
        self._surfaces, self._name = surfaces, name
        self.uv: UvSet | None = None
        self.wrap = "repeat"

    def take(self, info: JsonDict | None, what: str) -> np.ndarray | None:
        """The picture of a texture reference, None without one or where it cannot be had."""
        if info is None:
            return None
        texture = self._surfaces.texture(info)
        uv = _uv_of(info)
        if self.uv is not None and not self.uv.same(uv):
            self._surfaces.note_left_out(what, self._name)
            return None
        picture = self._surfaces.picture(texture, self._name)
        if picture is not None and self.uv is None:
            self.uv, self.wrap = uv, self._surfaces.wrap(texture)
        return picture


def _uv_of(info: JsonDict) -> UvSet:
    """Set and transform of a texture reference. KHR_texture_transform: scale, then turn, then shift; the turn's sign is
    that of the extension's example (its matrix, read as rows)."""
    extension = info.get("extensions", {}).get("KHR_texture_transform", {})
    angle = float(extension.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.zeros((2, 3))
    matrix[:, :2] = np.array([[c, s], [-s, c]]) * np.array(extension.get("scale", (1, 1)), dtype=np.float64).reshape(
        1, 2
    )
    matrix[:, 2] = np.array(extension.get("offset", (0, 0)), dtype=np.float64).reshape(2)
    if not np.isfinite(matrix).all():
        raise InputError("expected finite numbers in KHR_texture_transform, found others")
    return UvSet(int(extension.get("texCoord", info.get("texCoord", 0))), matrix)


def _scaled_normals(picture: np.ndarray, scale: Any) -> np.ndarray:
    """A normal map whose x and y are multiplied by `scale` (3.9.3)."""
    factor = float(scale)
    if factor == 1.0 or not np.isfinite(factor):
        return picture
    normals = picture.astype(np.float32) / 127.5 - 1.0
    normals[..., :2] *= np.float32(factor)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return np.round((normals + 1.0) * 127.5).astype(np.uint8)
