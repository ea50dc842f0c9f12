"""A spacecraft: named parts that together make one rigid object."""

from dataclasses import dataclass

import trimesh

from spacesim.data.geometry import Array
from spacesim.scenes.materials.table import Material


@dataclass(frozen=True, eq=False)
class Part:
    """A named solid."""

    name: str  #: unlike those of the other parts
    #: body frame, metres, faces outward, watertight in all that is built in; it may carry texture coordinates
    #: `mesh.visual.uv` [V, 2]
    mesh: trimesh.Trimesh
    material: Material  #: of its whole surface
    #: [3 F, 2] metres, the corners of its faces laid out in the plane where materials with a `tile` repeat; None: each
    #: face as seen along the axis that it is nearest to
    flat: Array | None = None
    #: [3 F, 3] unit, body frame, at the same corners: of the smooth surface that facets stand for in shading; None:
    #: facets are flat
    normals: Array | None = None


@dataclass(frozen=True, eq=False)
class Spacecraft:
    """Parts that together make one rigid object."""

    name: str  #: of the model
    parts: tuple[Part, ...]  #: all that can be seen of it
