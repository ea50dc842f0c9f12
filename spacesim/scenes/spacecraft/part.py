"""A spacecraft: named parts that together make one rigid object."""

from dataclasses import dataclass

import trimesh

from spacesim.scenes.materials import Material


@dataclass(frozen=True, eq=False)
class Part:
    """A named solid. mesh: body frame, metres, faces outward, watertight in all that is built in; it may carry
    texture coordinates `mesh.visual.uv` [V, 2]."""

    name: str
    mesh: trimesh.Trimesh
    material: Material


@dataclass(frozen=True, eq=False)
class Spacecraft:
    """Parts that together make one rigid object."""

    name: str
    parts: tuple[Part, ...]
