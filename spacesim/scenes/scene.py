"""A scene: objects (a spacecraft and its pose each) and what shines on them, and their one way into Mitsuba."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping
from spacesim.data.geometry import Array, normalize
from spacesim.data.records import Sun
from spacesim.scenes.cameras.kernel_camera import Units
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.emitters import Source, earthshine, solar_disc
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.materials.table import Material
from spacesim.scenes.meshes.parts import is_closed_mesh
from spacesim.scenes.spacecraft import Part, Spacecraft

ONE_SIDED = ("diffuse", "principled", "roughconductor")  #: Mitsuba's BSDFs that show nothing on the side of -n
MAX_OBJECTS, MAX_PARTS = 84, 255  #: 170 + object id is a shadow class below 255, part ids are bytes


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A spacecraft in the world."""

    spacecraft: Spacecraft  #: its parts, in body axes
    world_from_object: Array = field(default_factory=lambda: np.eye(4))  #: [4, 4] rigid transform, metres


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part in the world. object_id and part_id count from 1 over the scene."""

    object_id: int  #: number of its object, from 1
    part_id: int  #: number over the whole scene, from 1
    part: Part  #: in the axes of its object
    mesh: trimesh.Trimesh  #: world frame, metres
    normals: Array | None = None  #: as of the part, world frame


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered: objects under the Sun and, perhaps, the Earth."""

    name: str  #: of the scene
    objects: tuple[SceneObject, ...]  #: in the order of their numbers
    sun: SunConfig = field(default_factory=SunConfig)  #: its shape, distance and colour
    earth: EarthConfig | None = None  #: None: there is none

    def __post_init__(self) -> None:
        parts = sum(len(item.spacecraft.parts) for item in self.objects)
        if len(self.objects) > MAX_OBJECTS or parts > MAX_PARTS:
            raise InputError(
                f"scene {self.name}: expected at most {MAX_OBJECTS} objects and {MAX_PARTS} parts, which "
                f"8-bit labels can tell apart, found {len(self.objects)} and {parts}"
            )

    @cached_property
    def parts(self) -> tuple[PlacedPart, ...]:
        """All parts of all objects, in the order of their part ids. Materials that differ have different names."""
        materials = _unique_materials(part.material for item in self.objects for part in item.spacecraft.parts)
        placed: list[PlacedPart] = []
        for object_id, item in enumerate(self.objects, start=1):
            for part in item.spacecraft.parts:
                mesh = part.mesh.copy().apply_transform(item.world_from_object)
                normals = None if part.normals is None else normalize(part.normals @ item.world_from_object[:3, :3].T)
                named = replace(part, material=materials[part.material])
                placed.append(PlacedPart(object_id, len(placed) + 1, named, mesh, normals))
        return tuple(placed)

    @property
    def materials(self) -> dict[str, Material]:
        """The materials in use, by name."""
        return {placed.part.material.name: placed.part.material for placed in self.parts}

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """All parts as one mesh, world frame, metres."""
        return trimesh.util.concatenate(
            [trimesh.Trimesh(p.mesh.vertices, p.mesh.faces, process=False) for p in self.parts]  # no uv: geometry alone
        )

    @cached_property
    def bounding_sphere(self) -> tuple[Array, float]:
        """(centre [3], radius) of the smallest sphere that holds every vertex, to about 1 %, metres.

        Badoiu and Clarkson, "Smaller core-sets for balls", 2003: step ever less towards the farthest point.
        """
        points = np.asarray(self.mesh.vertices)  # trimesh's own array looks after a cache at every operation
        with suppress(QhullError):  # all in a plane
            points = points[np.sort(ConvexHull(points, qhull_options="QbB Pp Qt").vertices)]
        centre = points.mean(axis=0)
        for i in range(1, 1000):
            centre = centre + (points[np.linalg.norm(points - centre, axis=1).argmax()] - centre) / (i + 1)
        return centre, float(np.linalg.norm(points - centre, axis=1).max())

    def describe(self) -> JsonDict:
        """Objects, parts and materials as plain JSON values."""
        return {
            "scene": self.name,
            "objects": [
                {"id": i, "name": item.spacecraft.name, "world_from_object": item.world_from_object.tolist()}
                for i, item in enumerate(self.objects, start=1)
            ],
            "parts": [
                {
                    "id": p.part_id,
                    "object": p.object_id,
                    "name": p.part.name,
                    "material": p.part.material.name,
                }
                for p in self.parts
            ],
            "materials": {name: _describe_material(material) for name, material in self.materials.items()},
            "sun_irradiance": self.sun.irradiance.tolist(),
            "sun_angular_radius_deg": float(np.degrees(self.sun.angular_radius)),
        }


def _unique_materials(materials: Iterable[Material]) -> dict[Material, Material]:
    """What each of `materials` becomes: those that are alike one, others of the same name numbered from 2, as two mesh
    files may both have a material "hull/paint"."""
    distinct = list(dict.fromkeys(materials))
    taken = {material.name for material in distinct}
    namesakes: dict[str, list[Material]] = {}
    result: dict[Material, Material] = {}
    for material in distinct:
        others = namesakes.setdefault(material.name, [])
        like = next((other for other in others if _is_same_material(other, material)), None)
        if like is None:
            name, number = material.name, len(others) + 1
            while others and name in taken:
                name, number = f"{material.name}_{number}", number + 1
            taken.add(name)
            like = material if name == material.name else replace(material, name=name)
            others.append(like)
        result[material] = like
    return result


def _is_same_material(first: Material, second: Material) -> bool:
    return first.tile == second.tile and _describe_material(first) == _describe_material(second)


_described: WeakKeyDictionary[Material, JsonDict] = WeakKeyDictionary()


def _describe_material(material: Material) -> JsonDict:
    if material not in _described:
        _described[material] = _description(material)
    return _described[material]


def _description(material: Material) -> JsonDict:
    digests = {name: hashlib.sha256(image.tobytes()).hexdigest() for name, image in material.images.items()}
    described = {"albedo": list(material.albedo), "bsdf": material.bsdf, "source": material.source}
    return {**described, "images": digests} if digests else described


@dataclass(frozen=True, eq=False)
class MitsubaScene:
    """A scene in Mitsuba. sunlit and earthlit (None without an Earth) hold the same shapes, and one emitter each."""

    units: Units  #: of all three
    parts_of: Mapping[str, np.ndarray]  #: of each shape, by its name: uint32, the number of each face's part
    labelled: mt.Scene  #: the shapes without light, and no ray slips between two triangles of them
    sunlit: mt.Scene  #: the shapes under the Sun
    sun: Source  #: the emitter of `sunlit`, which can be moved
    earthlit: mt.Scene | None = None  #: the shapes under the Earth; None without one
    earth: Source | None = None  #: the emitter of `earthlit`, which can be moved

    def point(self, sun: Sun, earth: EarthConfig | None = None) -> None:
        """Move the Sun and, where one is given to a scene that has one, the Earth; the Earth's phase follows."""
        self.sun.point(sun)
        if self.earth is not None:
            if earth is not None:
                self.sun.place(earth)
                self.earth.place(earth)
            self.earth.point(sun)


_Look = tuple[Material, bool, bool]
"""What the parts of one mesh have in common: material, whether they are open, whether they are flat-shaded."""


def load(scene: Scene) -> MitsubaScene:
    """`scene` in Mitsuba, flat-shaded but for parts with normals of their own. Parts that look alike are one mesh: each
    shape takes the host 10 to 20 us whenever a recorded kernel is replayed."""
    mi = backend.mitsuba()
    alike: dict[_Look, list[_Surface]] = {}
    for placed in scene.parts:
        surface = _Surface.of(placed)
        look = placed.part.material, not is_closed_mesh(placed.part.mesh), surface.normals is None
        alike.setdefault(look, []).append(surface)
    bsdfs = {key: _mitsuba_bsdf(*key) for key in dict.fromkeys(look[:2] for look in alike)}
    units = Units.of(scene.bounding_sphere)
    named = {f"parts_{i:03d}": look for i, look in enumerate(alike)}
    shapes = {name: _mitsuba_mesh(name, alike[look], units, bsdfs[look[:2]]) for name, look in named.items()}
    parts_of = {
        name: np.concatenate([np.full(len(surface.faces), surface.part_id, np.uint32) for surface in alike[look]])
        for name, look in named.items()
    }
    watertight = {"embree_use_robust_intersections": True} if backend.select() == "llvm" else {}  # OptiX always is
    labelled = mi.load_dict({"type": "scene", **watertight, **shapes})
    outside = all(flat and not both_sides and _is_one_sided(material.bsdf) for material, both_sides, flat in alike)
    sun = solar_disc(scene.sun, scene.earth, outside)
    sunlit = mi.load_dict({"type": "scene", "sun": sun, **shapes})
    if scene.earth is None:
        return MitsubaScene(units, parts_of, labelled, sunlit, sun)
    earth = earthshine(scene.earth, scene.sun, outside)
    earthlit = mi.load_dict({"type": "scene", "earth": earth, **shapes})
    return MitsubaScene(units, parts_of, labelled, sunlit, sun, earthlit, earth)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A part as Mitsuba's meshes have it."""

    part_id: int
    vertices: Array  #: [V, 3] world frame, metres
    faces: np.ndarray  #: [F, 3]
    normals: Array | None  #: [V, 3]
    uv: Array | None  #: [V, 2], None where the material has no images

    @classmethod
    def of(cls, placed: PlacedPart) -> "_Surface":
        vertices, faces, normals = np.asarray(placed.mesh.vertices), placed.mesh.faces, placed.normals
        uv, at_corners = _texture_coordinates(placed)
        if at_corners or normals is not None:  # corners of faces stand alone
            uv = uv if at_corners or uv is None else uv[faces.ravel()]
            vertices, faces = vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3)
        return cls(placed.part_id, vertices, faces, normals, uv)


def _mitsuba_mesh(name: str, surfaces: Sequence[_Surface], units: Units, bsdf: mt.BSDF) -> mt.Mesh:
    """Surfaces that are alike, one after another."""
    mi = backend.mitsuba()
    vertices = np.concatenate([surface.vertices for surface in surfaces])
    firsts = np.cumsum([0, *[len(surface.vertices) for surface in surfaces]])
    faces = np.concatenate([first + surface.faces for first, surface in zip(firsts, surfaces, strict=False)])
    normals, uv = (_joined([getattr(surface, each) for surface in surfaces]) for each in ("normals", "uv"))
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    has = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uv is not None}
    result = mi.Mesh(name, len(vertices), len(faces), props=properties, **has)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = upload(units.points(vertices))
    parameters["faces"] = upload(faces, mi.UInt32)
    if uv is not None:
        parameters["vertex_texcoords"] = upload(uv)
    parameters.update()
    if normals is not None:  # only now: with new positions Mitsuba makes normals of its own
        parameters["vertex_normals"] = upload(normals)
        parameters.update()
    return result


def _joined(rows: Sequence[Array | None]) -> Array | None:
    """Those of all surfaces, None where none has any: alike surfaces have all or none."""
    some = [each for each in rows if each is not None]
    assert len(some) in (0, len(rows)), "surfaces of one mesh are alike"
    return np.concatenate(some) if some else None


def _texture_coordinates(placed: PlacedPart) -> tuple[Array | None, bool]:
    """([V, 2] of vertices or [3 F, 2] of the corners of faces, None where the material has no images; which it is)."""
    part, material = placed.part, placed.part.material
    if not material.images:
        return None, False
    mesh_uv = None if material.tile else getattr(part.mesh.visual, "uv", None)
    if mesh_uv is not None:
        return np.asarray(mesh_uv), False
    return (box_projection(part.mesh) if part.flat is None else part.flat) / (material.tile or 1.0), True


def box_projection(mesh: trimesh.Trimesh) -> Array:
    """[3 F, 2] metres: the corners of each face [F, 3], seen along the axis that its normal is nearest to."""
    axis = np.abs(mesh.face_normals).argmax(axis=1)
    across = np.array([[1, 2], [0, 2], [0, 1]])[axis]  # [F, 2]
    return np.take_along_axis(mesh.triangles, across[:, None, :], axis=2).reshape(-1, 2)


def _is_one_sided(bsdf: JsonMapping) -> bool:
    """Whether it reflects on the side of its normals alone, and lets nothing through."""
    if bsdf["type"] == "normalmap":
        below = [value for name, value in bsdf.items() if name != "normalmap" and isinstance(value, Mapping)]
        return all(map(_is_one_sided, below))
    return bsdf["type"] in ONE_SIDED and "spec_trans" not in bsdf


def _mitsuba_bsdf(material: Material, both_sides: bool) -> mt.BSDF:
    """A closed part shows its outside alone; an open one is the same on both sides."""
    mi = backend.mitsuba()

    def resolved(value: object) -> object:
        if not isinstance(value, Mapping):
            return value
        if "image" not in value:
            return {key: resolved(item) for key, item in value.items()}
        bitmap = mi.Bitmap(np.ascontiguousarray(material.images[value["image"]]))
        bitmap.set_srgb_gamma(not value.get("raw", False))
        return {**{key: item for key, item in value.items() if key != "image"}, "bitmap": bitmap}

    bsdf = resolved(material.bsdf)
    return mi.load_dict({"type": "twosided", "bsdf": bsdf} if both_sides else bsdf)
