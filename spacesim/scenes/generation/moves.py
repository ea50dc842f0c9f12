"""Objects that move within a dataset: the scene as one of its frames has it."""

import gc
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.scenes.build import FINEST
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene

Poses = Mapping[int, Array]  #: rigid world_from_object [4, 4] of those that move, by number

ASKED = 256
"""Vertices of an object, about, of which each is asked whether it lies within another object."""

_log = logging.getLogger(__name__)


def poses_in(scene: Scene, moves: Poses) -> list[Array]:
    """World_from_object [4, 4] of all objects of a frame, each as large as the scene has it.

    Raises InputError for an object that there is none of, and for one so far away that single precision loses it.
    """
    poses = [item.world_from_object for item in scene.objects]
    for number, pose in moves.items():
        name, last = f"target{number}", len(poses)
        if not 2 <= number <= last:
            known = {1: "target alone, its one object", 2: "target2, its other object"}
            expected = known.get(last, f"target2 to target{last}, its other objects")
            raise InputError(f"trajectory of {scene.name}: expected {expected}, found {name}")
        factor = np.cbrt(np.linalg.det(poses[number - 1][:3, :3]))
        vertices = np.concatenate([part.mesh.vertices for part in scene.objects[number - 1].spacecraft.parts])
        size, distance = factor * np.ptp(vertices, axis=0).max(), np.linalg.norm(pose[:3, 3])
        if not size >= FINEST * distance:
            raise InputError(
                f"{name}: expected at most {size / FINEST:.3g} m from the target, found {distance:.3g} m, too far for "
                f"single precision of an object of {size:.3g} m"
            )
        poses[number - 1] = pose @ np.diag([factor, factor, factor, 1.0])
    return poses


def moved(scene: Scene, moves: Poses) -> Scene:
    """The scene with its objects where a frame has them. Raises InputError as `poses_in`."""
    if not moves:
        return scene
    placed = zip(scene.objects, poses_in(scene, moves), strict=True)
    return replace(scene, objects=tuple(replace(item, world_from_object=pose) for item, pose in placed))


def as_moved(renderer: Renderer, moves: Poses) -> Renderer:
    """`renderer`, or one of its scene as a frame has it. Raises InputError as `poses_in`."""
    if not moves:
        return renderer
    gc.collect()  # those of frames before are held by cycles: 8 MB each
    return renderer.of(moved(renderer.scene, moves))


def cameras_inside(scene: Scene, renderer: Renderer, positions: Array, moves: Sequence[Poses]) -> np.ndarray:
    """[N] bool: which cameras at `positions` [N, 3] are within a part, where frames move objects by `moves` [N].

    renderer: of the scene. A camera is asked of each object that moves in that object's own axes.
    """
    numbers = sorted({number for some in moves for number in some})
    if not numbers:
        return renderer.inside(positions)
    inside = np.zeros(len(positions), bool)
    still = tuple(item for number, item in enumerate(scene.objects, start=1) if number not in numbers)
    for number in (0, *numbers):
        objects = (scene.objects[number - 1],) if number else still
        seen = positions.copy()
        for k, some in enumerate(moves):
            if number in some:
                seen[k] = _as_placed(scene, number, some[number]) @ [*positions[k], 1.0]
        if objects:
            alone = Renderer(replace(scene, objects=objects, earth=None), 1)
            inside |= alone.inside(seen)
    return inside


def warn_of_objects_inside(scene: Scene, moves: Poses) -> None:
    """Log one warning that names the objects of which most lies within parts of another, where a frame moves some by
    `moves`. Parts may overlap by design: it is no error."""
    scene = moved(scene, moves)
    names = [f"object {k} ({item.spacecraft.name})" for k, item in enumerate(scene.objects, start=1)]
    points = [np.asarray(replace(scene, objects=(item,)).mesh.vertices) for item in scene.objects]
    some = [every[:: max(1, len(every) // ASKED)] for every in points]
    found = []
    for outer, item in enumerate(scene.objects):
        least, most = points[outer].min(axis=0), points[outer].max(axis=0)
        others = [k for k in range(len(some)) if k != outer]
        near = [k for k in others if np.mean(((some[k] > least) & (some[k] < most)).all(axis=1)) > 0.5]
        if near:
            alone = Renderer(replace(scene, objects=(item,), earth=None), 1)
            inside = [k for k in near if alone.inside(some[k]).mean() > 0.5]
            found += [f"most of {names[k]} lies within {names[outer]}" for k in inside]
    if found:
        _log.warning("generate: %s%s", "; ".join(found), " in the first frame" if moves else "")


def _as_placed(scene: Scene, number: int, pose: Array) -> Array:
    """[3, 4] from the world of a frame that has the object at `pose` to that in which it is where the scene says."""
    placed = scene.objects[number - 1].world_from_object.copy()
    placed[:3, :3] /= np.cbrt(np.linalg.det(placed[:3, :3]))
    back: Array = placed @ np.linalg.inv(pose)
    return back[:3]
