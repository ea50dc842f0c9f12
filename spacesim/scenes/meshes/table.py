"""Reads obj, stl, ply and off through trimesh: parts with the colours and textures that these formats know."""

import io
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, read_bytes
from spacesim.data.images import linear_from_srgb
from spacesim.data.mesh import MeshFolderResolver, check_header_counts
from spacesim.scenes.materials.table import Color
from spacesim.scenes.meshes.parts import ABSENT, RawPart
from spacesim.scenes.meshes.textures import NORMALS, Folder, Notes, Surface, check_picture, clip_to_unit, decode_image
from spacesim.scenes.meshes.vertex_colors import at_corners, painted

_UNUSED = ("ke", "map_ke", "map_ks", "map_ka", "map_bump", "bump", "map_d", "disp", "norm", "map_ns", "refl")


def read_table(path: Path, notes: Notes) -> list[RawPart]:
    """The triangles of an obj, stl, ply or off file. Raises InputError, or whatever trimesh raises on damaged data."""
    kind = path.suffix.lower().lstrip(".")
    data = read_bytes(path)
    check_header_counts(kind, data)
    smooth = (kind == "obj" and b"\nvn " in data) or (kind == "ply" and b" nx" in data[: data.find(b"end_header")])
    if not data.isascii():
        data = _as_utf8(kind, data)
    if kind == "obj" and _ODD_INDEX.search(data):
        data = _with_plain_indices(data, path.stem, notes)
    resolver = _Files(path, notes)
    try:
        scene = _load(data, kind, resolver)
    except IndexError:
        if kind != "obj":
            raise
        scene = _load(_with_plain_indices(data, path.stem, notes), kind, resolver)
    parts = []
    for name, mesh in scene.geometry.items():
        if not isinstance(mesh, trimesh.Trimesh):
            notes.drop("points and lines are not rendered")
        elif len(mesh.faces):
            part_name = name if len(scene.geometry) > 1 else path.stem
            surface = _surface(mesh, resolver, notes)
            uv = _uv(mesh) if surface is not None and surface.pictures else None
            if surface is not None and surface.pictures and uv is None:
                notes.drop("textures of parts without texture coordinates are not used", surface.name)
                surface = surface.bare()
            normals = _normals(mesh, notes) if smooth else None
            part = RawPart(part_name, np.array(mesh.vertices), np.array(mesh.faces), uv, surface, normals)
            colors = _colors(mesh)
            parts.append(part if surface is None or colors is None else painted(part, colors, notes))
    return parts


def _load(data: bytes, kind: str, resolver: "_Files") -> trimesh.Scene:
    options = {"split_objects": True} if kind == "obj" else {}
    # `load` with force="scene": its successor load_scene is not in trimesh 4.5
    return trimesh.load(io.BytesIO(data), kind, resolver=resolver, force="scene", process=False, **options)


class _Files(MeshFolderResolver):
    """What trimesh may open while it reads a file: what `Folder` allows; the rest is noted."""

    def __init__(self, path: Path, notes: Notes) -> None:
        super().__init__(path.parent)
        self.allowed, self.notes, self.file_name = Folder(path), notes, path.name
        self.pictures: dict[int, np.ndarray | None] = {}

    def get(self, key: str) -> bytes:
        """The bytes of the file called `key`; FileNotFoundError (and a note) where it cannot be had."""
        try:
            data = self.allowed.read(str(key))
        except InputError as error:
            self.notes.drop("files that cannot be had are not used", str(error))
            raise FileNotFoundError(str(error)) from None
        if str(key).strip().lower().endswith(".mtl"):
            return _as_utf8("mtl", data)
        check_picture(data, str(key)[:80], self.notes)
        return data


def _as_utf8(kind: str, data: bytes) -> bytes:
    """A text file as UTF-8, from that or else from Latin-1, and the header of a ply as ASCII; else `data` as it is."""
    if kind == "ply":
        head, end, body = data.partition(b"end_header")
        return head.decode("ascii", "replace").encode("ascii", "replace") + end + body
    if kind == "stl" and not data.lstrip().startswith(b"solid"):
        return data
    try:
        data.decode("utf-8")
        return data
    except UnicodeDecodeError:
        return data.decode("latin-1").encode("utf-8")


_ODD_INDEX = re.compile(rb"^[ \t]*f[^\n]*[ /\t](?:-\d|0+(?:[ /\t\r\n]|\Z))", re.MULTILINE)
"""A face of an obj file with a negative index or with 0, which counts nothing."""


def _with_plain_indices(data: bytes, name: str, notes: Notes) -> bytes:
    """An obj file whose negative indices, which count from the last vertex so far, are turned into plain ones, without
    the faces whose vertices are not there (`name` stands in their note); where texture coordinates or normals are not
    there, the face has none."""
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = data.replace(b"\\\n", b" ").splitlines()
    faces: dict[int, list[list[int | None]]] = {}  # corners by line
    for i, line in enumerate(lines):
        words = line.split(b"#", 1)[0].split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == b"f":
            faces[i] = [_plain(corner, tuple(counts.values())) for corner in words[1:]]
    totals = tuple(counts.values())
    missing = 0
    for i, corners in faces.items():
        columns = list(zip(*corners, strict=False))  # of vertices, texture coordinates, normals
        there = [
            all(index is not None and 1 <= index <= total for index in column)
            for column, total in zip(columns, totals, strict=False)
        ]
        texts = (
            b"/".join(
                b"%d" % index if present and index else b"" for index, present in zip(corner, there, strict=False)
            )
            for corner in corners
        )
        keeps_index = any(there[:1])
        missing += not keeps_index
        lines[i] = b"f " + b" ".join(text.rstrip(b"/") for text in texts) if keeps_index else b""
    if missing:
        notes.drop(ABSENT, f"{missing:,} of {name}")
    return b"\n".join(lines) + b"\n"


def _plain(corner: bytes, counts: tuple[int, ...]) -> list[int | None]:
    """Indices of the vertex, the texture coordinate and the normal in "1/-2/3", counted from 1; None where left out."""
    indices = [int(text) if text else None for text in corner.split(b"/")]
    return [
        index if index is None or index >= 0 else count + 1 + index
        for index, count in zip(indices, counts, strict=False)
    ]


def _uv(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """[V, 2], v down (trimesh's points up), None where there is none."""
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv) != (len(mesh.vertices), 2):
        return None
    return np.array(uv, dtype=np.float64) * [1.0, -1.0] + [0.0, 1.0]


def _normals(mesh: trimesh.Trimesh, notes: Notes) -> np.ndarray | None:
    """[F, 3, 3] normals at the corners of faces, as the file has them; None (and a note) where trimesh did not keep
    them. Its `vertex_normals` would make up others."""
    normals = mesh._cache["vertex_normals"]  # None where there is nothing
    if np.shape(normals) != np.shape(mesh.vertices):
        notes.drop(NORMALS)
        return None
    return np.asarray(normals, dtype=np.float64)[mesh.faces]


def _colors(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """[F, 3, 3] linear, at the corners of faces, None where neither these nor vertices have colours."""
    visual = mesh.visual
    if visual.kind == "vertex":
        corners = at_corners(np.asarray(visual.vertex_colors), mesh.faces)
    elif visual.kind == "face":
        corners = np.asarray(visual.face_colors)[:, None].repeat(3, axis=1)
    else:
        return None
    return np.asarray(linear_from_srgb(corners[..., :3] / 255.0))


def _surface(mesh: trimesh.Trimesh, files: _Files, notes: Notes) -> Surface | None:
    visual = mesh.visual
    if visual.kind in ("vertex", "face"):
        notes.change("colours of vertices or faces are taken as sRGB and matt")
        return Surface("colour", matt=True)
    material = getattr(visual, "material", None)
    if material is None or type(material).__name__ != "SimpleMaterial":
        return None
    values = {str(key).lower(): value for key, value in (material.kwargs or {}).items()}
    image = material.image if getattr(material.image, "fp", None) is not None else None  # else trimesh's own stand-in
    if image is None and not values:
        return None  # texture coordinates alone
    name = str(values.get("name") or getattr(material, "name", None) or "texture")[:80]
    return _obj_surface(name, values, image, files, notes)


def _obj_surface(name: str, values: JsonMapping, image: object, files: _Files, notes: Notes) -> Surface:
    """A material of an mtl file. Kd is taken as linear; gloss: refractive index 1.5, its roughness from Ns as Walter et
    al. 2007 compare Blinn-Phong with microfacets, alpha^2 = 2 / (Ns + 2), or Pr where that is given."""
    for key in sorted(set(values) & set(_UNUSED)):
        if key != "ke" or max(_numbers(values[key], 0.0)) > 0:
            notes.drop(f"{key} of materials is not used", name)
    opacity = min(_numbers(values.get("d"), 1.0)[0], 1.0 - _numbers(values.get("tr"), 0.0)[0])
    if opacity < 1.0:
        notes.make_opaque(name)
    pictures = {}
    if image is not None:
        picture = _picture(image, name, files, notes)
        if picture is not None:
            pictures["base_color"] = picture
    default = 1.0 if pictures else 0.8
    color = _color((_numbers(values.get("kd"), default) * 3)[:3])
    metallic = clip_to_unit(_numbers(values.get("pm"), 0.0)[0])
    glossy = metallic > 0 or "pr" in values or max(_numbers(values.get("ks"), 0.0)) > 0
    exponent = max(_numbers(values.get("ns"), 0.0)[0], 0.0)
    roughness = math.sqrt(math.sqrt(2.0 / (exponent + 2.0)))
    if "pr" in values:
        roughness = clip_to_unit(_numbers(values["pr"], 1.0)[0])
    return Surface(name, color, metallic, roughness, pictures, matt=not glossy)


def _picture(image: Any, name: str, files: _Files, notes: Notes) -> np.ndarray | None:
    """trimesh has opened the image; its pixels are read here, where damage and size are looked after."""
    if id(image) not in files.pictures:
        image.fp.seek(0)
        files.pictures[id(image)] = decode_image(image.fp.read(), str(image.info.get("file_path", name))[:80], notes)
    return files.pictures[id(image)]


def _numbers(value: Any, default: float) -> list[float]:
    """The finite numbers at the front of an mtl entry; [default] where there is none."""
    numbers: list[float] = []
    for item in value if isinstance(value, (list, tuple)) else [value]:
        try:
            numbers.append(float(item))
        except (TypeError, ValueError):
            break
    return numbers if numbers and all(map(math.isfinite, numbers)) else [default]


def _color(values: Iterable[float]) -> Color:
    red, green, blue = (clip_to_unit(float(v)) for v in values)
    return red, green, blue
