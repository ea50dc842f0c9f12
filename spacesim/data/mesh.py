"""Meshes as vertices and faces, point clouds, and the signed distance to a mesh, also where it is not watertight."""

import base64
import io
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue, read_bytes, write_bytes
from spacesim.data.geometry import Array
from spacesim.data.glb import TRIANGLES, write_glb
from spacesim.data.images.color import linear_from_srgb
from spacesim.data.images.png import png_bytes
from spacesim.data.integrity.outputs import SUFFIXES, check_output

LEVELS = 256  #: of roughness and of metallic that a glTF texture tells apart; what is between them is read between
READ = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
MAX_COORDINATE = 1e9  #: metres; corners beyond it are taken for damage (the Moon is at 3.8e8)
#: {axis of a file that points up: rotation [3, 3], file from world, where z does and x stays}
UPRIGHT = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
PARSED = 30  #: bytes of memory that a byte of a mesh file takes while it is read, at most; OBJ took 22


def read_mesh(path: Path) -> tuple[Array, np.ndarray]:
    """(vertices [V, 3] metres, faces [F, 3] int64) of a mesh file. Raises InputError where it holds none."""
    mesh = load_mesh(path)
    vertices, faces = mesh.vertices, drawable_faces(mesh.vertices, mesh.faces)
    if len(faces) == 0:
        raise InputError(
            f"{path}: expected a mesh, found no face with an area and corners within {MAX_COORDINATE:g} m in it"
        )
    return vertices, faces


@dataclass(frozen=True, eq=False)
class RawMesh:
    """What a mesh file holds, as it stands there."""

    vertices: Array  #: [V, 3]
    faces: np.ndarray  #: [F, 3] int64; [0, 3] of points alone
    colors: np.ndarray | None  #: [V, 3] uint8, where its vertices have colours


def load_mesh(path: Path, kind: str | None = None) -> RawMesh:
    """One of the READ formats by itself: files beside it, such as textures, are not opened. kind: one of READ, by
    default the suffix of the name. Raises InputError where it cannot be read, MemoryError where it does not fit into
    memory."""
    path = Path(path)
    content, kind = read_bytes(path, "a mesh"), kind or path.suffix.lower()
    if kind not in READ:
        raise InputError(f"{path}: expected a mesh in {', '.join(READ)}, found {kind or 'no extension'!r}")
    check_memory(PARSED * len(content), f"{path}: reading it")
    return (_plain_ply(content) if kind == ".ply" else None) or _load_trimesh(path, kind, content)


def _plain_ply(content: bytes) -> RawMesh | None:
    """A PLY file of corners, faces and colours alone, as datasets have. None where anything else is in it or it is not
    whole, which trimesh then reports: importing that takes half a second."""
    header = _PLAIN_PLY.match(content)
    if header is None:
        return None
    count, is_colored, face_count = int(header[1]), header[2] is not None, int(header[3] or 0)
    vertex = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3 if is_colored else 0)])
    face = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    start = header.end() + count * vertex.itemsize
    if count == 0 or start + face_count * face.itemsize != len(content):
        return None
    vertices = np.frombuffer(content, vertex, count, header.end())
    faces = np.frombuffer(content, face, face_count, start)
    corners = faces["corners"].astype(np.int64)
    if not ((faces["count"] == 3) & ((corners >= 0) & (corners < count)).all(axis=1)).all():
        return None
    return RawMesh(vertices["xyz"].astype(np.float64), corners, vertices["rgb"].copy() if is_colored else None)


_PLAIN_PLY = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n(?:comment [^\n]*\n)*element vertex (\d{1,12})\n"
    rb"property float x\nproperty float y\nproperty float z\n"
    rb"(property uchar red\nproperty uchar green\nproperty uchar blue\n)?"
    rb"(?:element face (\d{1,12})\nproperty list uchar int vertex_indices\n)?end_header\n"
)


def _load_trimesh(path: Path, kind: str, content: bytes) -> RawMesh:
    """What trimesh makes of it."""
    import trimesh  # here and below: importing takes half a second, wasted where no mesh is read

    try:
        check_header_counts(kind[1:], content)
        force = None if kind == ".ply" else "mesh"
        options = {"skip_materials": True} if kind in (".ply", ".obj") else {}
        beside = MeshFolderResolver(path.parent)
        loaded = trimesh.load(io.BytesIO(content), kind[1:], resolver=beside, force=force, process=False, **options)
        if not isinstance(loaded, trimesh.Trimesh | trimesh.PointCloud):
            empty = not getattr(loaded, "geometry", True)
            raise InputError("there is nothing in it" if empty else f"found {type(loaded).__name__}")
        count = len(np.asarray(loaded.vertices, np.float64).reshape(-1, 3))
        declared = next((n for name, n in _elements(content) if name == b"vertex"), count) if kind == ".ply" else count
        if count != declared:
            raise InputError(f"found {count:,} vertices, its header promises {declared:,}")
    except MemoryError:
        raise
    except Exception as error:  # trimesh documents none of what it raises
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a mesh, found a file that cannot be read as one ({reason})") from None
    faces = np.asarray(getattr(loaded, "faces", np.zeros((0, 3))), np.int64)
    colors = np.asarray(loaded.visual.vertex_colors) if loaded.visual.kind == "vertex" else np.empty(0)
    colored = colors.ndim == 2  # a cloud without colours claims to have none a vertex
    return RawMesh(np.asarray(loaded.vertices, np.float64), faces, colors[:, :3].astype(np.uint8) if colored else None)


class MeshFolderResolver:
    """The files that a mesh file names, in its own folder and below, as trimesh asks for them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def get(self, key: str) -> bytes:
        """The bytes of the file called `key`. Raises InputError where it is not there, or elsewhere."""
        path = (self.folder / key).resolve()
        if not path.is_relative_to(self.folder):
            raise InputError(f"{key[:80]!r} lies outside of the mesh's folder")
        return read_bytes(path, "a part of a mesh")

    def __getitem__(self, key: str) -> bytes:
        """As `get`."""
        return self.get(key)

    def keys(self) -> tuple[str, ...]:
        """No listing: files are asked for by name."""
        return ()

    def write(self, name: str, data: object) -> None:
        """Nothing is written."""
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> "MeshFolderResolver":
        """Folders below are reached by their relative names."""
        return self


def check_points(points: np.ndarray, path: Path, farthest: float = 1e15) -> None:
    """Raise InputError in the name of the file where there is no point [N, 3], or one that is not finite or beyond
    `farthest` metres, by default as far as squares in single precision reach."""
    with np.errstate(invalid="ignore"):
        if not len(points) or not (np.abs(points) <= farthest).all():
            which = "another one" if len(points) else "none"
            raise InputError(f"{path}: expected points within {farthest:g} m, found {which}")


def _elements(data: bytes) -> list[tuple[bytes, int]]:
    """(name, count) of the elements that a PLY header promises."""
    head = data.partition(b"end_header")[0]
    return [(name, int(count)) for name, count in re.findall(rb"(?m)^[ \t]*element[ \t]+(\S+)[ \t]+(\d+)", head)]


def check_header_counts(kind: str, data: bytes) -> None:
    """Raises InputError where the header of a "ply" or "stl" file promises more than the file holds, before memory
    is allocated for it. Other kinds pass."""
    is_text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1024].lower()
    if kind == "stl" and len(data) >= 84 and not is_text:
        count = struct.unpack_from("<I", data, 80)[0]
        if 84 + 50 * count != len(data):
            raise InputError(
                f"expected {84 + 50 * count:,} bytes for the {count:,} faces that its header promises, "
                f"found {len(data):,}"
            )
    if kind == "ply":
        _, end, body = data.partition(b"end_header")
        if not data.startswith(b"ply") or not end:
            raise InputError('expected a ply file, from "ply" to "end_header", found something else')
        for element, count in _elements(data):
            if count > len(body):
                raise InputError(
                    f"expected {count:,} elements {element.decode('ascii', 'replace')}, as its header promises, "
                    f"found {len(body):,} bytes"
                )


def vertex_normals(vertices: Array, faces: np.ndarray) -> Array:
    """[V, 3] unit vectors outwards: the sum of the faces' around each vertex, weighted by area; 0 where that is 0."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack([np.bincount(faces.ravel(), across[:, k].repeat(3), len(vertices)) for k in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


@dataclass(frozen=True, eq=False)
class VertexSurface:
    """What vertices are made of, beside their albedo."""

    roughness: np.ndarray  #: [V] alpha of GGX
    metallic: np.ndarray  #: [V] share of metals, in [0, 1]


def write_mesh(
    path: Path,
    vertices: Array,
    faces: np.ndarray,
    colors: np.ndarray | None = None,
    up: str | None = None,
    surface: VertexSurface | None = None,
) -> None:
    """Write vertices [V, 3] metres and faces [F, 3] as PLY, OBJ, STL or glTF (.glb), by the file's name.

    colors: [V, 3] sRGB values of the vertices, which STL cannot hold; light is in them, so glTF says that they are to
    be shown unlit;  up: which axis of the file +z becomes, one of UPRIGHT; by default "y" in glTF, else "z"
    surface: of what has albedo as colours, to be lit: glTF has it
    Raises InputError for another name, for colours in STL and where it cannot be written.
    """
    import trimesh

    path, suffix = Path(path), Path(path).suffix.lower()
    check_output(path, "mesh")
    if suffix not in SUFFIXES["mesh"]:  # of a device, which may have any name
        raise InputError(f"{path}: expected a name that ends in {' or '.join(SUFFIXES['mesh'])}, which says the form")
    if colors is not None and suffix == ".stl":
        raise InputError(f"{path}: expected a .glb, .obj or .ply, which hold colours, found STL")
    vertices = vertices @ np.array(UPRIGHT[up or ("y" if suffix == ".glb" else "z")]).T
    if suffix == ".glb":
        _write_glb_mesh(path, vertices, faces, colors, surface)
        return
    bytes_of = None if colors is None else np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=bytes_of, process=False)
    content = mesh.export(file_type=suffix[1:])
    write_bytes(path, content.encode() if isinstance(content, str) else content)


def _write_glb_mesh(
    path: Path, vertices: Array, faces: np.ndarray, colors: np.ndarray | None, surface: VertexSurface | None
) -> None:
    """Colours are COLOR_0. What is lit has normals, without which its facets would be flat (3.7.2.1). glTF has no
    roughness a vertex, but textures: one of all pairs of roughness and metallic, in which a vertex's place says its
    own. Roughness is the square root of alpha, as in glTF (3.9.2, B.3)."""
    attributes = {"POSITION": vertices.astype(np.float32)}
    document: dict[str, JsonValue] = {}
    if colors is not None:
        opaque = np.ones((len(colors), 1))
        linear = linear_from_srgb(np.clip(colors, 0, 1))
        attributes["COLOR_0"] = np.concatenate([linear, opaque], axis=1).astype(np.float32)
    material: dict[str, JsonValue] = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    if surface is not None:
        pair = np.stack([np.sqrt(surface.roughness), surface.metallic], axis=1)
        attributes["TEXCOORD_0"] = ((0.5 + (LEVELS - 1) * np.clip(pair, 0, 1)) / LEVELS).astype(np.float32)
        material["pbrMetallicRoughness"] = {"metallicRoughnessTexture": {"index": 0}}
        document = _texture_of_surfaces()
    elif colors is not None:
        material["extensions"] = {"KHR_materials_unlit": {}}
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    if surface is not None or colors is None:
        normals = vertex_normals(vertices, faces)
        has_none = ~normals.any(axis=1, keepdims=True)  # glTF wants one of each vertex
        attributes["NORMAL"] = np.where(has_none, (0.0, 0.0, 1.0), normals).astype(np.float32)
    primitive = faces.ravel().astype(np.uint32), {"material": 0}
    write_glb(path, attributes, TRIANGLES, [primitive], {"materials": [material], **document})


def _texture_of_surfaces() -> dict[str, JsonValue]:
    """What a glTF document says of a texture whose roughness, green, grows along u and whose metallic, blue, along v:
    read between pixels, without smaller copies, which would mix what is far apart."""
    level = np.arange(LEVELS, dtype=np.uint8)
    pixels = np.zeros((LEVELS, LEVELS, 3), np.uint8)
    pixels[..., 1], pixels[..., 2] = level, level[:, None]
    uri = "data:image/png;base64," + base64.b64encode(png_bytes(pixels)).decode()
    linear, edge = 9729, 33071
    sampler: JsonValue = {"magFilter": linear, "minFilter": linear, "wrapS": edge, "wrapT": edge}
    return {"images": [{"uri": uri}], "samplers": [sampler], "textures": [{"sampler": 0, "source": 0}]}


class SignedDistance:
    """Distance from points to a surface, metres: negative inside, positive outside (thesis 5.1).

    Inside is where the generalised winding number (Jacobson et al. 2013; Barill et al. 2018 for its fast sum, as libigl
    has it) is at least one half, or at most minus one half: so holes close smoothly, parts may overlap or be open, and
    a mesh turned inside out counts like any other, as does one of which some faces are. A sheet has no inside.
    """

    def __init__(self, vertices: Array, faces: np.ndarray) -> None:
        """vertices [V, 3] metres, faces [F, 3]. Raises InputError where no face has finite corners."""
        import igl  # a third of a second, that readers of meshes need not wait

        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.faces = np.ascontiguousarray(drawable_faces(self.vertices, np.asarray(faces, np.int64).reshape(-1, 3)))
        if len(self.faces) == 0:
            raise InputError("signed distance: expected a mesh, found no face with an area and finite corners")
        self.faces = _orient_consistently(self.vertices, self.faces)
        used = self.vertices[self.faces.ravel()]
        self.lowest, self.highest = used.min(axis=0), used.max(axis=0)
        self._tree, self._winding = igl.AABB(), igl.FastWindingNumberBVH()
        self._tree.init(self.vertices, self.faces)
        self._centre = _area_median(self.vertices[self.faces])
        self._winding.init(self.vertices - self._centre, self.faces)  # which adds up in single precision

    @staticmethod
    def of(path: Path) -> "SignedDistance":
        """To the surface in a mesh file. Raises InputError where it holds none."""
        return SignedDistance(*read_mesh(path))

    def __call__(self, points: Array) -> Array:
        """[N] metres, for points [N, 3]; infinite for those that are not finite."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        finite = np.isfinite(points).all(axis=1)
        distances = np.full(len(points), np.inf)
        if not finite.any():
            return distances
        finite_points = points[finite]
        distances[finite] = np.where(self.inside(finite_points), -1, 1) * self.unsigned(finite_points)
        return distances

    def unsigned(self, points: Array) -> Array:
        """[N] metres, for finite points [N, 3]: how far they are from the surface, on whichever side."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        return np.asarray(np.sqrt(self._tree.squared_distance(self.vertices, self.faces, points)[0]), np.float64)

    def inside(self, points: Array) -> np.ndarray:
        """[N] bool, for points [N, 3]: whether they are inside. Cheaper than their distances."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        is_inside = np.zeros(len(points), bool)
        within = np.flatnonzero(((points >= self.lowest) & (points <= self.highest)).all(axis=1))
        if len(within):
            is_inside[within] = np.abs(self._winding.winding_number(points[within] - self._centre)) >= 0.5
        return is_inside


def _orient_consistently(vertices: Array, faces: np.ndarray) -> np.ndarray:
    """Faces [F, 3] of which neighbours turn the same way: across edges that are in two faces, the smaller part by area
    of what hangs together is turned. Corners in one place are one."""
    import igl

    corner = np.unique(vertices, axis=0, return_inverse=True)[1].ravel()[faces]
    oriented, piece = igl.bfs_orient(np.ascontiguousarray(corner, np.int64))
    turned = (oriented != corner).any(axis=1)
    if not turned.any():
        return faces
    area = _doubled_area(vertices[faces])
    mostly_turned = 2 * np.bincount(piece, area * turned) > np.bincount(piece, area)
    return np.ascontiguousarray(np.where((turned ^ mostly_turned[piece])[:, None], faces[:, ::-1], faces))


def _doubled_area(corners: Array) -> Array:
    """[F], of triangles [F, 3, 3]."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(np.linalg.norm(across, axis=1))


def _area_median(corners: Array) -> Array:
    """[3] with half of the area of triangles [F, 3, 3] below it along each axis, wherever some of them have strayed."""
    area = _doubled_area(corners)
    places = corners.mean(axis=1)
    order = np.argsort(places, axis=0)
    below = np.cumsum(area[order], axis=0)
    half = (below < 0.5 * below[-1]).sum(axis=0)
    return places[order[half, range(3)], range(3)]


def drawable_faces(vertices: Array, faces: np.ndarray) -> np.ndarray:
    """The faces [F, 3] whose corners, of vertices [V, 3], are there, within MAX_COORDINATE and not on a line."""
    if len(vertices) == 0 or faces.ndim != 2 or len(faces) == 0:
        return np.zeros((0, 3), np.int64)
    faces = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)]
    with np.errstate(invalid="ignore"):
        near = np.all(np.abs(vertices) <= MAX_COORDINATE, axis=1)
    faces = faces[near[faces].all(axis=1)]
    corners = vertices[faces]
    longest2 = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1, initial=0.0)
    size2 = (corners**2).sum(axis=2).max(axis=1, initial=0.0)
    return faces[np.flatnonzero((longest2 > 1e-24 * size2) & (_doubled_area(corners) > 1e-12 * longest2))]


def write_points(path: Path, points: ArrayLike, colors: ArrayLike) -> None:
    """Write points [N, 3] and colors [N, 3] uint8 as binary PLY with x y z red green blue alone."""
    points, colors = np.asarray(points, "<f4"), np.asarray(colors, np.uint8)
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise ValueError(f"points, colors: expected [N, 3] each, found {points.shape} and {colors.shape}")
    vertices = np.empty(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = points, colors
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in ("x", "y", "z")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    write_bytes(path, "\n".join([*header, "end_header", ""]).encode() + vertices.tobytes())


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(points [N, 3] float64, colors [N, 3] uint8) of an ascii or binary PLY file; grey 128 without colours.

    Raises InputError where the file is missing, cut off, no PLY, or holds positions that are not finite or
    beyond 1e9 m.
    """
    cloud = load_mesh(path, ".ply")
    check_points(cloud.vertices, path)
    grey = np.full(cloud.vertices.shape, 128, np.uint8)
    return cloud.vertices, grey if cloud.colors is None else cloud.colors
