"""Parts as mesh files give them, and what makes them sound: broken faces out, shared corners joined, faces outward."""

import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from spacesim.data.mesh import MAX_COORDINATE
from spacesim.scenes.meshes.textures import Notes, Surface

ABSENT = "faces that name vertices which are not there are dropped"
FLAT = math.radians(0.5)  #: normals of vertices this near to their faces' are theirs
MAX_SOLID_ANGLES = 20_000_000  #: solid angles worth computing to distinguish cavities from inverted surfaces


@dataclass(frozen=True, eq=False)
class RawPart:
    """A part of a mesh file, as it stands there."""

    name: str  #: as the file has it
    vertices: np.ndarray  #: [V, 3]
    faces: np.ndarray  #: [F, 3] int
    uv: np.ndarray | None = None  #: [V, 2], v down from the picture's top row, or None
    surface: Surface | None = None  #: None where the file says nothing of it
    normals: np.ndarray | None = None  #: [F, 3, 3] at the corners of each face, of any length, or None

    def named(self, name: str) -> "RawPart":
        """The same under another name."""
        return replace(self, name=name)

    def with_faces(self, chosen: np.ndarray) -> "RawPart":
        """The faces that are `chosen`: [F] bool, or numbers."""
        normals = None if self.normals is None else self.normals[chosen]
        return replace(self, faces=self.faces[chosen], normals=normals)


def clean_part(part: RawPart, notes: Notes, open_too: bool = False) -> RawPart | None:
    """`part` (metres) without broken faces, equal corners joined, wound outward where it is closed; None where no face
    is left. open_too: also makes the winding of open surfaces consistent."""
    part = _without_broken_faces(part, notes)
    if not len(part.faces):
        return None
    part = _merge_vertices(part)
    part = _without_repeated_faces(part, notes)
    return _smooth(_orient_faces(part, notes, open_too))


def merge_parts(parts: list[RawPart]) -> RawPart:
    """Parts of one surface as one part, under the first one's name."""
    shifts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    uvs = [part.uv for part in parts if part.uv is not None]
    normals = [_facets(part) if part.normals is None else part.normals for part in parts]
    return replace(
        parts[0],
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + shift for part, shift in zip(parts, shifts, strict=False)]),
        uv=np.concatenate(uvs) if uvs else None,
        normals=np.concatenate(normals) if any(part.normals is not None for part in parts) else None,
    )


def corner_ids(vertices: np.ndarray) -> np.ndarray:
    """[V] numbers that are equal where positions are."""
    return np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].reshape(-1)  # + 0.0: -0.0 is 0.0


def is_closed(faces: np.ndarray) -> bool:
    """Each edge of faces [F, 3] lies between exactly two of them."""
    return bool(len(faces)) and bool((np.unique(_edges(faces), return_counts=True)[1] == 2).all())


def is_closed_mesh(mesh: trimesh.Trimesh) -> bool:
    """Whether a part's mesh is closed: with texture coordinates, one place may have several vertices."""
    if mesh.is_watertight:
        return True
    return mesh.visual.kind == "texture" and is_closed(corner_ids(np.asarray(mesh.vertices))[mesh.faces])


def _edges(faces: np.ndarray) -> np.ndarray:
    """[3 F] a number for the ends of each edge, in either order: edge k of face f is item 3 f + k."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return ends.min(axis=1) * (int(faces.max(initial=0)) + 1) + ends.max(axis=1)


def _without_broken_faces(part: RawPart, notes: Notes) -> RawPart:
    faces = part.faces
    in_range = ((faces >= 0) & (faces < len(part.vertices))).all(axis=1)
    if not in_range.all():
        notes.drop(ABSENT, f"{(~in_range).sum():,} of {part.name}")
        part = part.with_faces(np.flatnonzero(in_range))
    with np.errstate(invalid="ignore"):
        fine = (np.abs(part.vertices) <= MAX_COORDINATE).all(axis=1)
    uv = part.uv
    if uv is not None:
        with np.errstate(invalid="ignore"):
            uv = np.where(np.abs(uv) <= 1e6, uv, 0.0)
    finite = fine[part.faces].all(axis=1)
    if not finite.all():
        kind = f"faces with a vertex that is not finite or beyond {MAX_COORDINATE:g} m are dropped"
        notes.drop(kind, f"{(~finite).sum():,} of {part.name}")
        part = part.with_faces(finite)
    corners = np.where(fine[:, None], part.vertices, 0.0)[part.faces]
    sides = corners - np.roll(corners, 1, axis=1)
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    flat = doubled <= 1e-12 * (sides**2).sum(axis=-1).max(axis=1, initial=0.0)
    if flat.any():
        notes.drop("faces without area are dropped", f"{flat.sum():,} of {part.name}")
        part = part.with_faces(~flat)
    return replace(part, uv=uv)


def _merge_vertices(part: RawPart) -> RawPart:
    """Equal vertices as one, where their texture coordinates are equal, too; no vertex without a face."""
    used, faces = np.unique(part.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = part.vertices[used] + 0.0
    uv = None if part.uv is None else part.uv[used] + 0.0
    rows = vertices if uv is None else np.concatenate([vertices, uv], axis=1)
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # the file's order
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    representatives = first[order]
    faces = rank[inverse.reshape(-1)][faces]
    return replace(
        part, vertices=vertices[representatives], faces=faces, uv=None if uv is None else uv[representatives]
    )


def _without_repeated_faces(part: RawPart, notes: Notes) -> RawPart:
    corners = np.sort(corner_ids(part.vertices)[part.faces], axis=1)
    first = np.sort(np.unique(corners, axis=0, return_index=True)[1])
    if len(first) == len(part.faces):
        return part
    notes.drop(
        "faces that lie on others of the same part are dropped", f"{len(part.faces) - len(first):,} of {part.name}"
    )
    return part.with_faces(first)


def _orient_faces(part: RawPart, notes: Notes, open_too: bool) -> RawPart:
    """Consistent winding on each connected piece that is closed, and outward (open_too: on open ones, consistent)."""
    faces = corner_ids(part.vertices)[part.faces]
    _, edge_of, uses = np.unique(_edges(faces), return_inverse=True, return_counts=True)
    edge_of = edge_of.reshape(-1)
    turned, piece = _consistent_winding(faces, edge_of, uses)
    pieces = int(piece.max()) + 1
    is_open = np.zeros(pieces, dtype=bool)
    np.logical_or.at(is_open, np.repeat(piece, 3), uses[edge_of] != 2)
    mixed = np.zeros(pieces, dtype=bool)
    np.logical_or.at(mixed, piece, turned)
    if (mixed & is_open).any() and not open_too:
        notes.change("open surfaces with mixed winding are left as they are, both sides are rendered", part.name)
    flip = turned & (~is_open[piece] | open_too)
    if (mixed & (~is_open | open_too)).any():
        notes.change("faces wound against their neighbours are turned", f"{flip.sum():,} of {part.name}")
    inverted = _inverted(part.vertices, np.where(flip[:, None], part.faces[:, ::-1], part.faces), piece, is_open)
    if inverted.any():
        notes.change(
            "closed surfaces that were inside out are turned", f"{inverted[piece].sum():,} faces of {part.name}"
        )
    flip = flip ^ inverted[piece]
    normals = part.normals
    if normals is not None:
        normals = np.where(flip[:, None, None], normals[:, ::-1], normals)
    return replace(part, faces=np.where(flip[:, None], part.faces[:, ::-1], part.faces), normals=normals)


def _facets(part: RawPart) -> np.ndarray:
    """[F, 3, 3] the unit normal of each face, once for each of its corners."""
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.repeat((normal / np.maximum(length, 1e-300))[:, None], 3, axis=1)


def _smooth(part: RawPart) -> RawPart:
    """`part` with unit normals on the side that its faces face; those that cannot be had, or are more than 90 degrees
    off, are the face's own. None at all where all are within FLAT of their faces."""
    if part.normals is None:
        return part
    facets = _facets(part)
    with np.errstate(all="ignore"):
        normals = part.normals / np.linalg.norm(part.normals, axis=-1, keepdims=True)
        along = np.einsum("fci,fci->fc", normals, facets)
        side = np.where(np.nansum(along, axis=1) < 0, -1.0, 1.0)[:, None]
        fine = side * along > 0
    if not (fine & (side * along < math.cos(FLAT))).any():
        return replace(part, normals=None)
    return replace(part, normals=np.where(fine[..., None], side[..., None] * normals, facets))


def _consistent_winding(faces: np.ndarray, edge_of: np.ndarray, uses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([F] bool: to be turned, so that neighbours agree; [F] connected piece).

    Faces with a common edge of two agree where they run along it in opposite senses. Each face stands twice in a graph,
    as it is and turned; agreement joins likes, disagreement unlikes, and each piece keeps the half in which fewer turn.
    """
    count = len(faces)
    start = faces[:, [0, 1, 2]].reshape(-1)
    forward = start < faces[:, [1, 2, 0]].reshape(-1)
    halves = np.flatnonzero(uses[edge_of] == 2)
    rows = halves[np.argsort(edge_of[halves], kind="stable")].reshape(-1, 2)
    a, b = rows[:, 0] // 3, rows[:, 1] // 3
    unlike = (forward[rows[:, 0]] == forward[rows[:, 1]]).astype(np.int64) * count
    ends = np.concatenate([b + unlike, b + (count - unlike)])
    graph = coo_matrix(
        (np.ones(2 * len(a), dtype=bool), (np.concatenate([a, a + count]), ends)), (2 * count, 2 * count)
    )
    label = connected_components(graph, directed=False)[1]
    plain, other = label[:count], label[count:]
    piece = np.unique(np.minimum(plain, other), return_inverse=True)[1].reshape(-1)
    turned = plain > other  # the half with the lower label, for now
    turned &= plain != other  # a Moebius strip has no sides
    often = np.bincount(piece, turned) > 0.5 * np.bincount(piece)
    onesided = plain == other
    return (turned ^ often[piece]) & ~onesided, piece


def _inverted(vertices: np.ndarray, faces: np.ndarray, piece: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """[pieces] bool: closed, of negative volume, and no cavity of another closed piece."""
    corners = vertices[faces] - vertices.mean(axis=0)
    volumes = np.bincount(piece, np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0
    inverted = ~is_open & (volumes < 0)
    outer = ~is_open & (volumes > 0)
    if not outer.any() or inverted.sum() * outer[piece].sum() > MAX_SOLID_ANGLES:
        return inverted
    shell = corners[outer[piece]]
    for index in np.flatnonzero(inverted):
        point = corners[np.flatnonzero(piece == index)[0]].mean(axis=0)
        inverted[index] = _winding_number(point, shell) < 0.5
    return inverted


def _winding_number(point: np.ndarray, triangles: np.ndarray) -> float:
    """How often closed triangles [F, 3, 3] go around a point: their solid angles (Van Oosterom and Strackee 1983)."""
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.einsum("fi,fi->f", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("fi,fi->f", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return float(np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2.0 * np.pi))
