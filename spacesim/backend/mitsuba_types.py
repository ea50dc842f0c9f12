"""Names of Mitsuba's types for annotations: `Scene` is `mi.Scene` of whichever variant runs.

A type checker and an editor read Mitsuba's own stubs, and Dr.Jit's of its vectors, of which Mitsuba's know no
arithmetic. At run time the names stand for anything, and Mitsuba is not imported for them: a process chooses its
variant late (`backend.mitsuba`). Its numbers, `Float`, `UInt32` and `Bool`, are Dr.Jit's
(`backend.arrays`).
"""

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from drjit.auto.ad import Array2f as Point2f
    from drjit.auto.ad import Array3f as Color3f
    from drjit.auto.ad import Array3f as Point3f
    from drjit.auto.ad import Array3f as Vector3f
    from mitsuba import (
        BSDF,
        DirectionSample3f,
        Interaction3f,
        Mesh,
        PreliminaryIntersection3f,
        Sampler,
        Scene,
        ShapePtr,
    )

    Integrator: TypeAlias = Any
    RayDifferential3f: TypeAlias = Any
    SurfaceInteraction3f: TypeAlias = Any
else:
    BSDF = Color3f = DirectionSample3f = Integrator = Interaction3f = Mesh = Point2f = Point3f = RayDifferential3f = Any
    PreliminaryIntersection3f = Sampler = Scene = ShapePtr = SurfaceInteraction3f = Vector3f = Any

__all__ = [
    "BSDF",
    "Color3f",
    "DirectionSample3f",
    "Integrator",
    "Interaction3f",
    "Mesh",
    "Point2f",
    "Point3f",
    "PreliminaryIntersection3f",
    "RayDifferential3f",
    "Sampler",
    "Scene",
    "ShapePtr",
    "SurfaceInteraction3f",
    "Vector3f",
]
