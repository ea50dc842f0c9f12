"""Reads glTF 2.0 (glb and gltf): parts in the file's axes and metres, with textures and metallic-roughness surfaces.

Section numbers are those of the glTF 2.0 specification (Khronos, ISO/IEC 12113:2022). We read it ourselves because
trimesh rounds colours to 8 bits and leaves out sets of texture coordinates, their transforms and wrap modes.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, read_bytes
from spacesim.scenes.meshes.gltf_surface import UV_SET, Surfaces
from spacesim.scenes.meshes.parts import RawPart
from spacesim.scenes.meshes.textures import MAX_FILE_BYTES, Folder, Notes, decode_data_uri
from spacesim.scenes.meshes.vertex_colors import at_corners, painted

MAX_IMPLIED_BYTES = 1 << 24  #: bytes of an accessor without a buffer view, all zeros but for what is sparse
MAX_CORNERS = 30_000_000  #: of what the nodes place: ten million faces of shared vertices
A_CORNER = 200  #: bytes of memory that a vertex, or a corner of a face, takes while it is read; 140 were seen

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SUPPORTED = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}
_COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"}


def read_gltf(path: Path, notes: Notes) -> list[RawPart]:
    """The triangles of the file's scene, a part for each primitive of each node. Raises InputError."""
    document, body = _document(path)
    file = _GltfFile(document, body, Folder(path))
    file.check(notes)
    surfaces = Surfaces(document, file.view, file.folder, notes)
    parts = []
    corners = 0
    for node, name, transform in _placed_nodes(document):
        mesh = document["meshes"][_index(node["mesh"])]
        for primitive in mesh["primitives"]:
            part = _part(file, surfaces, primitive, transform, notes)
            if part is not None:
                corners += len(part.vertices) + part.faces.size  # nodes may place one mesh any number of times
                if corners > MAX_CORNERS:
                    raise InputError(f"expected at most {MAX_CORNERS:,} vertices and corners, found more")
                check_memory(A_CORNER * corners, f"{path}: its mesh")
                part_name = name or str(mesh.get("name", ""))
                several = len(mesh["primitives"]) > 1 and part.surface is not None
                parts.append(part.named(f"{part_name}_{part.surface.name}" if several and part.surface else part_name))
    return parts


def _document(path: Path) -> tuple[JsonDict, bytes | None]:
    """(JSON document, binary chunk or None) of a glb (4.4) or gltf file."""
    data = read_bytes(path)
    body = None
    text = data
    if path.suffix.lower() == ".glb":
        text, body = _chunks(data)
    document = json.loads(text.decode("utf-8-sig"))
    if not isinstance(document, dict) or "asset" not in document:
        raise InputError("expected a glTF document with asset, found other JSON")
    version = str(document["asset"].get("version", "?"))
    if not version.startswith("2."):
        raise InputError(f"expected glTF 2.0, found version {version[:20]}")
    return document, body


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    if data[:4] != b"glTF" or len(data) < 20:
        raise InputError('expected a glb file, which begins with "glTF", found something else')
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"expected glb version 2, found {version}")
    if length > len(data):
        raise InputError(f"expected {length:,} bytes, as its header says, found {len(data):,}: the file is cut off")
    chunks: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, start)
        if start + 8 + size > length:
            raise InputError(f"expected a chunk of {size:,} bytes, found {length - start - 8:,}")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size + (-size) % 4
    if b"JSON" not in chunks:
        raise InputError("expected a JSON chunk, found none")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def _index(value: object) -> int:
    """A non-negative integer: Python's negative indices would read from the end."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"expected an index, found {str(value)[:40]!r}")
    return value


class _GltfFile:
    """Buffers, views and accessors (3.6) of a document."""

    def __init__(self, document: JsonDict, body: bytes | None, folder: Folder) -> None:
        self.document, self.folder = document, folder
        self._body = body
        self._buffers: dict[int, bytes] = {}

    def check(self, notes: Notes) -> None:
        """Raises InputError for an extension that the file requires and that is not read; notes what is left out."""
        used = {str(name) for name in self.document.get("extensionsUsed", [])}
        required = {str(name) for name in self.document.get("extensionsRequired", [])} - _SUPPORTED
        if required & _COMPRESSIONS:
            names = ", ".join(sorted(required & _COMPRESSIONS))
            raise InputError(f"expected uncompressed meshes, found {names}; export it without compression")
        for name in sorted((used | required) - _SUPPORTED):
            notes.drop("glTF extensions are not used", name)
        if self.document.get("animations"):
            notes.drop("animations are not used, the parts stay where their nodes are")

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            entry = self.document["buffers"][index]
            if "uri" not in entry:
                data = self._body if index == 0 and self._body is not None else b""
            elif str(entry["uri"])[:5] == "data:":
                data = decode_data_uri(str(entry["uri"]))
            else:
                data = self.folder.read(str(entry["uri"]))
            if len(data) < _index(entry["byteLength"]):
                raise InputError(f"buffer {index}: expected {entry['byteLength']:,} bytes, found {len(data):,}")
            self._buffers[index] = data
        return self._buffers[index]

    def view(self, index: object) -> bytes:
        """The bytes of buffer view `index`."""
        entry = self.document["bufferViews"][_index(index)]
        if _COMPRESSIONS & set(entry.get("extensions", {})):
            raise InputError("expected uncompressed meshes, found compressed buffers; export it without compression")
        start, size = _index(entry.get("byteOffset", 0)), _index(entry["byteLength"])
        data = self._buffer(_index(entry["buffer"]))[start : start + size]
        if len(data) < size:
            raise InputError(f"buffer view {index}: expected {size:,} bytes, found {len(data):,}")
        return data

    def accessor(self, index: object, widths: tuple[int, ...]) -> np.ndarray:
        """[count, width] values of accessor `index`, normalised integers as float; InputError for other widths."""
        entry = self.document["accessors"][_index(index)]
        dtype, width = np.dtype(_DTYPES[entry["componentType"]]), _WIDTHS.get(entry["type"], 0)
        if width not in widths:
            raise InputError(f"accessor {index}: expected {widths} components, found {str(entry['type'])[:20]}")
        count = _index(entry["count"])
        most = MAX_FILE_BYTES if "bufferView" in entry else MAX_IMPLIED_BYTES
        if count * width * dtype.itemsize > most:
            raise InputError(f"accessor {index}: expected at most {most:,} bytes, found {count:,} elements")
        if "bufferView" in entry:
            stride = _index(self.document["bufferViews"][entry["bufferView"]].get("byteStride", 0))
            data = self.view(entry["bufferView"])
            values = _strided(data, _index(entry.get("byteOffset", 0)), stride, count, width, dtype).copy()
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in entry:
            self._fill_sparse(values, entry["sparse"])
        if entry.get("normalized") and dtype.kind in "iu":  # 3.6.2.2
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def _fill_sparse(self, values: np.ndarray, sparse: JsonDict) -> None:
        count, where, what = _index(sparse["count"]), sparse["indices"], sparse["values"]
        kind = np.dtype(_DTYPES[where["componentType"]])
        rows = _strided(self.view(where["bufferView"]), _index(where.get("byteOffset", 0)), 0, count, 1, kind)
        start, width = _index(what.get("byteOffset", 0)), values.shape[1]
        values[rows[:, 0]] = _strided(self.view(what["bufferView"]), start, 0, count, width, values.dtype)


def _strided(data: bytes, start: int, stride: int, count: int, width: int, dtype: np.dtype) -> np.ndarray:
    row = width * dtype.itemsize
    stride = stride or row
    if count and start + (count - 1) * stride + row > len(data):
        raise InputError(f"accessor: expected {count:,} elements, found a buffer view of {len(data):,} bytes")
    if not count:
        return np.zeros((0, width), dtype)
    return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))


def _placed_nodes(document: JsonDict) -> Iterator[tuple[JsonDict, str, np.ndarray]]:
    """(node, name, scene_from_node [4, 4]) of the scene's nodes that have a mesh, in the file's order (3.5)."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes", [])
    if scenes:
        roots = scenes[_index(document.get("scene", 0))].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    waiting = [(_index(i), np.eye(4)) for i in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, parent = waiting.pop()
        if index in seen:
            raise InputError(f"expected a tree of nodes, found node {index} in two places")
        seen.add(index)
        node = nodes[index]
        transform = parent @ _local(node)
        waiting += [(_index(child), transform) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            yield node, str(node.get("name", "")), transform


def _local(node: JsonDict) -> np.ndarray:
    """parent_from_node [4, 4]: a matrix (column by column) or translation, rotation (x, y, z, w) and scale (3.5.3)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64) / max(
        float(np.linalg.norm(node.get("rotation", (0, 0, 0, 1)))), 1e-30
    )
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = np.eye(4)
    local[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64).reshape(1, 3)
    local[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=np.float64).reshape(3)
    return local


def _part(
    file: _GltfFile, surfaces: Surfaces, primitive: JsonDict, transform: np.ndarray, notes: Notes
) -> RawPart | None:
    """A primitive in the scene's axes; None (and a note) for points and lines."""
    mode = primitive.get("mode", 4)
    if mode not in (4, 5, 6):
        notes.drop("points and lines are not rendered")
        return None
    if _COMPRESSIONS & set(primitive.get("extensions", {})):
        raise InputError("expected uncompressed meshes, found Draco compression; export it without")
    attributes = primitive["attributes"]
    if primitive.get("targets"):
        notes.drop("morph targets are not used, the base shape is taken")
    if "JOINTS_0" in attributes:
        notes.drop("skins are not used, the mesh is taken as it is modelled")
    positions = file.accessor(attributes["POSITION"], (3,)).astype(np.float64)
    if "indices" in primitive:
        corners = file.accessor(primitive["indices"], (1,))[:, 0].astype(np.int64)
    else:
        corners = np.arange(len(positions))
    faces = _triangles(corners, mode)
    normals = _normals(file, attributes, transform, faces) if "NORMAL" in attributes else None
    with np.errstate(all="ignore"):
        vertices = positions @ transform[:3, :3].T + transform[:3, 3]
        mirrored = np.linalg.det(transform[:3, :3]) < 0
    surface = surfaces.of(primitive.get("material"))
    uv = None
    if surface is not None and surface.pictures:
        choice = surfaces.uv_set(primitive["material"])
        if UV_SET.format(choice.index) in attributes:
            uv = choice.apply(file.accessor(attributes[UV_SET.format(choice.index)], (2,)))
        else:
            notes.drop("textures of parts without texture coordinates are not used", surface.name)
            surface = surface.bare()
    if mirrored:
        faces, normals = faces[:, ::-1], None if normals is None else normals[:, ::-1]
    part = RawPart("", vertices, faces, uv, surface, normals)
    if "COLOR_0" not in attributes:
        return part
    if surface is None:
        notes.drop("colours of vertices of parts without a material are not used")
        return part
    colors = file.accessor(attributes["COLOR_0"], (3, 4))[:, :3]
    scale = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1.0
    return painted(part, at_corners(colors.astype(np.float64) / scale, faces), notes)


def _normals(file: _GltfFile, attributes: JsonDict, transform: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """[F, 3, 3] normals at the corners of faces in the scene's axes, None where not every vertex has one."""
    stored = file.accessor(attributes["NORMAL"], (3,)).astype(np.float64)
    if faces.max(initial=-1) >= len(stored):
        return None
    with np.errstate(all="ignore"):
        cofactor = np.cross(np.roll(transform[:3, :3], -1, 0), np.roll(transform[:3, :3], -2, 0))
        return (stored @ (cofactor * np.sign(np.linalg.det(transform[:3, :3]))).T)[faces]


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """[F, 3] of a list of corners: triangles (4), a strip (5) or a fan (6), wound as 3.7.2.1 says."""
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == 6:
        first = np.broadcast_to(corners[:1], len(corners) - 2)
        return np.stack([corners[1:-1], corners[2:], first], axis=-1)
    odd = np.arange(len(corners) - 2) % 2 == 1
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=-1)
    faces[odd] = faces[odd][:, [0, 2, 1]]
    return faces
