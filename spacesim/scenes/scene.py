"""A scene: objects (a spacecraft and its pose each), and its one way into Mitsuba."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import trimesh

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.scenes.materials import Material
from spacesim.scenes.spacecraft import Part, Spacecraft, boxsat
from spacesim.scenes.sun import SOLAR_IRRADIANCE, directional

MOST_OBJECTS, MOST_PARTS = 84, 255  #: 170 + object id is a shadow class below 255, part ids are bytes


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A spacecraft in the world. world_from_object: [4, 4] rigid transform, metres."""

    spacecraft: Spacecraft
    world_from_object: Array = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part in the world. object_id and part_id count from 1 over the scene; mesh: world frame, metres."""

    object_id: int
    part_id: int
    part: Part
    mesh: trimesh.Trimesh

    @property
    def shape_id(self) -> str:
        """The name of the part's shape in Mitsuba."""
        return f"part_{self.part_id:03d}"


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered: objects under the Sun, nothing else."""

    name: str
    objects: tuple[SceneObject, ...]
    irradiance: float = SOLAR_IRRADIANCE  #: of the Sun, W m^-2 in each of R, G and B

    def __post_init__(self) -> None:
        parts = sum(len(item.spacecraft.parts) for item in self.objects)
        if len(self.objects) > MOST_OBJECTS or parts > MOST_PARTS:
            raise InputError(
                f"scene {self.name}: expected at most {MOST_OBJECTS} objects and {MOST_PARTS} parts, which "
                f"8-bit labels can tell apart, found {len(self.objects)} and {parts}"
            )

    @cached_property
    def parts(self) -> tuple[PlacedPart, ...]:
        """All parts of all objects, in the order of their part ids."""
        placed: list[PlacedPart] = []
        for object_id, item in enumerate(self.objects, start=1):
            for part in item.spacecraft.parts:
                mesh = part.mesh.copy().apply_transform(item.world_from_object)
                placed.append(PlacedPart(object_id, len(placed) + 1, part, mesh))
        return tuple(placed)

    @property
    def materials(self) -> dict[str, Material]:
        """The materials in use, by name."""
        return {placed.part.material.name: placed.part.material for placed in self.parts}

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """All parts as one mesh, world frame, metres."""
        return trimesh.util.concatenate([placed.mesh for placed in self.parts])

    @cached_property
    def bounding_sphere(self) -> tuple[Array, float]:
        """(centre [3], radius) of the smallest sphere that holds every vertex, to about 1 %, metres.

        Badoiu and Clarkson, "Smaller core-sets for balls", 2003: step ever less towards the farthest point.
        """
        points = self.mesh.convex_hull.vertices
        centre = points.mean(axis=0)
        for i in range(1, 1000):
            centre = centre + (points[np.linalg.norm(points - centre, axis=1).argmax()] - centre) / (i + 1)
        return centre, float(np.linalg.norm(points - centre, axis=1).max())

    def describe(self) -> dict[str, Any]:
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
            "materials": {
                name: {"albedo": list(material.albedo), "bsdf": material.bsdf, "source": material.source}
                for name, material in self.materials.items()
            },
            "sun_irradiance": self.irradiance,
        }


def _boxsat_scene() -> Scene:
    return Scene("boxsat", (SceneObject(boxsat()),))


def _boxsat_pair_scene() -> Scene:
    """Two boxsats, the second at [-3, -3, -3] m (thesis 4.3.6)."""
    second = np.eye(4)
    second[:3, 3] = -3.0
    return Scene("boxsat-pair", (SceneObject(boxsat()), SceneObject(boxsat(), second)))


_BUILT_IN: dict[str, Callable[[], Scene]] = {"boxsat": _boxsat_scene, "boxsat-pair": _boxsat_pair_scene}
BUILT_IN_SCENES = tuple(_BUILT_IN)


def built_in_scene(name: str) -> Scene:
    """The built-in scene called `name`; InputError lists the names where there is none."""
    if name not in _BUILT_IN:
        raise InputError(f"scene: expected one of {', '.join(BUILT_IN_SCENES)}, found {name!r}")
    return _BUILT_IN[name]()


def load(scene: Scene, sun: Sun | None = None) -> Any:
    """`scene` as a mitsuba.Scene: one flat-shaded mesh a part, and the emitter "sun" (along +x if not
    given)."""
    mi = backend.mitsuba()
    bsdfs = {name: mi.load_dict(dict(material.bsdf)) for name, material in scene.materials.items()}
    shapes = {p.shape_id: _mitsuba_mesh(p.shape_id, p.mesh, bsdfs[p.part.material.name]) for p in scene.parts}
    sun = sun or Sun(np.array([1.0, 0.0, 0.0]))
    return mi.load_dict({"type": "scene", "sun": directional(sun, scene.irradiance), **shapes})


def _mitsuba_mesh(name: str, mesh: trimesh.Trimesh, bsdf: Any) -> Any:
    mi = backend.mitsuba()
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    result = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), props=properties)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mi.Float(np.asarray(mesh.vertices, dtype=np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.asarray(mesh.faces, dtype=np.uint32).ravel())
    parameters.update()
    return result
