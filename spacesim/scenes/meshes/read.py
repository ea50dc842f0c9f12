"""Any mesh file as a spacecraft: glb, gltf, obj, stl, ply and off, with a report of what was left out or changed."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.mesh import MAX_COORDINATE
from spacesim.scenes.config import UNITS, UP_AXES
from spacesim.scenes.materials.table import Material
from spacesim.scenes.meshes.gltf import read_gltf
from spacesim.scenes.meshes.parts import RawPart, clean_part, corner_ids, is_closed, is_closed_mesh, merge_parts
from spacesim.scenes.meshes.table import read_table
from spacesim.scenes.meshes.textures import DEFAULT_PRESET, MAX_FILE_BYTES, Notes, Surface, material_of, plain_name
from spacesim.scenes.spacecraft import Part, Spacecraft

MAX_PARTS = 255  #: part ids are bytes

_READERS: dict[str, Callable[[Path, Notes], list[RawPart]]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_table,
    ".stl": read_table,
    ".ply": read_table,
    ".off": read_table,
}
SUFFIXES = tuple(_READERS)
"""Names of the formats that are read."""

_TURNS = {
    "x": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
"""Rotations [3, 3] that bring the file's up axis to z: about y from x, about x from y."""


@dataclass(frozen=True, eq=False)
class MeshReport:
    """What was read from a mesh file, and what was left out."""

    file: str  #: its name, without the folder
    parts: int  #: how many there are
    faces: int  #: triangles of all parts
    watertight: bool  #: all parts together close all edges
    bounds: np.ndarray  #: [2, 3] least and greatest corner, metres, z up
    materials: tuple[str, ...]  #: their names, each once
    textures: int  #: how many pictures they have
    dropped: tuple[str, ...]  #: sentences: in the file, not used
    changed: tuple[str, ...]  #: sentences: used, not as in the file
    opaque: tuple[str, ...]  #: sentences: rendered opaque, transparent in the file

    def lines(self) -> list[str]:
        """The report, a line each."""
        size = " x ".join(f"{side:.4g}" for side in np.ptp(self.bounds, axis=0))
        closed = "watertight" if self.watertight else "not watertight"
        counts = f"{self.parts} parts, {self.faces:,} faces, {len(self.materials)} materials, {self.textures} textures"
        return [
            f"{self.file}: {counts}, {size} m, {closed}",
            *(f"dropped: {sentence}" for sentence in self.dropped),
            *(f"changed: {sentence}" for sentence in self.changed),
            *(f"rendered opaque: {sentence}" for sentence in self.opaque),
        ]


def read_mesh(
    path: Path | str,
    units: str = "m",
    up: str | None = None,
    scale: float = 1.0,
    two_sided: bool | None = None,
    replaced: Sequence[str] = (),
) -> tuple[Spacecraft, MeshReport]:
    """The parts of a mesh file in metres, z up, and a report.

    units: of the file, one of UNITS; up: its axis that becomes z, "x", "y" or "z" (None or "": y for glb and gltf, as
    their standard says, else z), (x, y, z) becomes (-z, y, x) or (x, -z, y); scale: a factor on top.
    two_sided: closed parts show their outside alone and open ones both sides; True shows both sides of all, False also
    makes the winding of open parts consistent.
    replaced: patterns of the parts ("panel_*") whose materials the caller replaces: here they get
    DEFAULT_PRESET, and the report does not name the materials that they would have had.
    Raises InputError, one sentence, for whatever is wrong with the file or an option.
    """
    path = Path(path)
    reader = _reader(path)
    factor = _factor(units, scale)
    axis = up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    if axis not in UP_AXES:
        raise InputError(f"up: expected one of {', '.join(UP_AXES)}, found {up!r}")
    notes = Notes()
    try:
        with np.errstate(all="ignore"):
            raw = reader(path, notes)
            raw = [_convert_axes(part, factor, _TURNS[axis]) for part in raw]
            parts = _clean_parts(path, raw, notes, two_sided)
            keep = [None if _is_replaced(part, replaced) else part.surface for part in parts]
            if any(part.surface is None and not _is_replaced(part, replaced) for part in parts):
                notes.change(f"parts without a material get the preset {DEFAULT_PRESET}")
            return _spacecraft(path, parts, keep, notes, two_sided is True)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except MemoryError:
        raise InputError(f"{path}: expected a mesh that fits into memory, found a larger one") from None
    except Exception as error:  # trimesh and damaged documents raise what they like
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: expected a sound {path.suffix.lower()} file, found damage ({reason})") from None


def _reader(path: Path) -> Callable[[Path, Notes], list[RawPart]]:
    reader = _READERS.get(path.suffix.lower())
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected a mesh file, found a folder")
        if not path.exists():
            raise InputError(f"{path}: expected a mesh file, found nothing there")
        if reader is None:
            raise InputError(f"{path}: expected one of {', '.join(SUFFIXES)}, found {path.suffix or 'no suffix'!r}")
        if not path.is_file():
            raise InputError(f"{path}: expected a mesh file, found no regular file")
        size = path.stat().st_size
        with path.open("rb") as file:
            file.read(1)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a mesh file, found {getattr(error, 'strerror', None) or error}") from None
    if not size:
        raise InputError(f"{path}: expected a mesh file, found an empty one")
    if size > MAX_FILE_BYTES:
        raise InputError(f"{path}: expected at most {MAX_FILE_BYTES:,} bytes, found {size:,}")
    return reader


def _convert_axes(part: RawPart, factor: float, turn: np.ndarray) -> RawPart:
    normals = None if part.normals is None else part.normals @ turn.T
    return replace(part, vertices=factor * part.vertices @ turn.T, normals=normals)


def _factor(units: str, scale: float) -> float:
    if units not in UNITS:
        raise InputError(f"units: expected one of {', '.join(UNITS)}, found {units!r}")
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"scale: expected a number above 0, found {scale}")
    return UNITS[units] * float(scale)


def _clean_parts(path: Path, raw: list[RawPart], notes: Notes, two_sided: bool | None) -> list[RawPart]:
    """Parts with faces, under plain and different names, at most MAX_PARTS."""
    if not any(len(part.faces) for part in raw):
        raise _none_left("faces", notes)
    named = [part.named(plain_name(part.name) or "part") for part in raw if len(part.faces)]
    cleaned = [clean_part(part, notes, two_sided is False) for part in named]
    parts = [part for part in cleaned if part is not None]
    if not parts:
        raise _none_left(f"faces with an area and finite vertices within {MAX_COORDINATE:g} m", notes)
    if len(parts) > MAX_PARTS:
        parts = _merge_by_material(parts, notes)
    taken: set[str] = set()
    for part in parts:
        _note_mirrored(part, notes)
    return [part.named(_free_name(part.name, taken)) for part in parts]


def _none_left(expected: str, notes: Notes) -> InputError:
    """Of a file without any, with what was said of faces that were dropped."""
    dropped = [sentence for sentence in notes.sentences("dropped") if sentence.startswith("faces")]
    return InputError("; ".join([f"expected {expected}, found none", *dropped]))


def _note_mirrored(part: RawPart, notes: Notes) -> None:
    """Mitsuba's second tangent is the normal times the first one: on mirrored faces it points down the picture."""
    if part.uv is None or part.surface is None or "normal" not in part.surface.pictures:
        return
    u, v = np.moveaxis(part.uv[part.faces], -1, 0)  # [F, 3] each, v down
    mirrored = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) > (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    if mirrored.any():
        kind = "normal maps bend light the wrong way up and down where their texture coordinates are mirrored"
        notes.change(kind, f"{mirrored.sum():,} faces of {part.name}")


def _merge_by_material(parts: list[RawPart], notes: Notes) -> list[RawPart]:
    """Parts of the same material as one."""
    groups: dict[tuple[int, bool], list[RawPart]] = {}
    for part in parts:
        groups.setdefault((id(part.surface), part.uv is None), []).append(part)
    if len(groups) > MAX_PARTS:
        raise InputError(f"expected at most {MAX_PARTS} materials in {len(parts):,} parts, found {len(groups):,}")
    notes.change(f"{len(parts):,} parts are more than {MAX_PARTS}: those of one material become one part")
    joined = [merge_parts(group) for group in groups.values()]
    names = [plain_name(part.surface.name) if part.surface is not None else DEFAULT_PRESET for part in joined]
    return [part.named(name or "part") for part, name in zip(joined, names, strict=True)]


def _free_name(name: str, taken: set[str]) -> str:
    free, count = name, 1
    while free in taken:
        count += 1
        free = f"{name}_{count}"
    taken.add(free)
    return free


def _is_replaced(part: RawPart, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(part.name, pattern) for pattern in patterns)


def _spacecraft(
    path: Path, raw: list[RawPart], surfaces: list[Surface | None], notes: Notes, both_sides: bool
) -> tuple[Spacecraft, MeshReport]:
    """The parts `raw` with the materials of `surfaces`, one each, None: DEFAULT_PRESET."""
    name = plain_name(path.stem) or "mesh"
    materials: dict[tuple[int, bool], Material] = {}
    parts = []
    for part, surface in zip(raw, surfaces, strict=True):
        mesh = _trimesh(part)
        wrap = both_sides and is_closed_mesh(mesh)
        key = (id(surface), wrap)
        if key not in materials:
            material = material_of(surface, name, path.name, notes)
            materials[key] = make_two_sided(material) if wrap else material
        normals = None if part.normals is None else part.normals.reshape(-1, 3)
        parts.append(Part(part.name, mesh, materials[key], normals=normals))
    vertices = np.concatenate([part.vertices for part in raw])
    merged = merge_parts([replace(part, uv=None) for part in raw])
    report = MeshReport(
        file=path.name,
        parts=len(parts),
        faces=sum(len(part.faces) for part in raw),
        watertight=is_closed(corner_ids(merged.vertices)[merged.faces]),
        bounds=np.stack([vertices.min(axis=0), vertices.max(axis=0)]),
        materials=tuple(dict.fromkeys(part.material.name for part in parts)),
        textures=len({id(picture) for surface in surfaces if surface for picture in surface.pictures.values()}),
        dropped=notes.sentences("dropped"),
        changed=notes.sentences("changed"),
        opaque=notes.sentences("opaque"),
    )
    return Spacecraft(name, tuple(parts)), report


def make_two_sided(material: Material) -> Material:
    """`material` that is the same from behind."""
    if material.bsdf["type"] == "twosided":
        return material
    return replace(material, name=f"{material.name}/two-sided", bsdf={"type": "twosided", "bsdf": dict(material.bsdf)})


def _trimesh(part: RawPart) -> trimesh.Trimesh:
    visual = None if part.uv is None else trimesh.visual.TextureVisuals(uv=part.uv)
    return trimesh.Trimesh(part.vertices, part.faces, process=False, visual=visual)
