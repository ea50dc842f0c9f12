"""From what a scene file says to the scene that is rendered."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, rotation_from_quaternion
from spacesim.scenes.config import MaterialConfig, ObjectConfig, SceneConfig
from spacesim.scenes.materials.spectra import sun_rgb
from spacesim.scenes.materials.table import Material, customise, material
from spacesim.scenes.meshes.parts import is_closed_mesh
from spacesim.scenes.meshes.read import make_two_sided, read_mesh
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.spacecraft import Spacecraft, spacecraft

SIZES = (1e-6, 1e10)
"""Metres that the longest side of an object's box may have."""

FINEST = 1e-5
"""Least size of an object, over how far the scene reaches from the world's origin. Coordinates of meshes are written in
single precision, whose steps are 6e-8 of them: an object has 160 steps or more."""

_log = logging.getLogger(__name__)


def build(config: SceneConfig) -> Scene:
    """The scene of a configuration. Raises InputError where a spacecraft, mesh, part or material cannot be had, or an
    object's size is out of range."""
    objects = tuple(_object(item, config) for item in config.objects)
    red, green, blue = sun_rgb(config.camera.white_balance, total=1.0).tolist()
    scene = Scene(config.name, objects, replace(config.sun, color=(red, green, blue)), config.earth)
    _check_sizes(scene)
    return scene


def _object(item: ObjectConfig, config: SceneConfig) -> SceneObject:
    craft = _from_file(item, config) if item.mesh else spacecraft(item.spacecraft)
    changed = _with_materials(craft, item, config.materials)
    return SceneObject(replace(changed, name=item.name or changed.name), _pose(item))


def _from_file(item: ObjectConfig, config: SceneConfig) -> Spacecraft:
    """The object's mesh file, what was dropped or changed in it is logged."""
    path = (config.folder or Path()) / item.mesh
    craft, report = read_mesh(path, item.units, item.up, two_sided=item.two_sided, replaced=tuple(item.materials))
    for line in report.lines():
        _log.info("%s", line)
    return craft


def _pose(item: ObjectConfig) -> Array:
    pose = np.eye(4)
    turn = np.array(item.rotation_wxyz)
    pose[:3, :3] = item.scale * rotation_from_quaternion(turn / np.abs(turn).max())  # squares of any length are finite
    pose[:3, 3] = item.position
    return pose


def _check_sizes(scene: Scene) -> None:
    """Raises InputError for an object that is smaller or larger than single precision can hold beside the others."""
    least, most = SIZES
    sizes = [(item.spacecraft.name, _size(item)) for item in scene.objects]
    for name, size in sizes:
        if not least <= size <= most:
            raise InputError(f"object {name}: expected a size from {least:g} to {most:g} m, found {size:.3g} m")
    with np.errstate(all="ignore"):  # trimesh divides by the volume of a flat hull
        centre, radius = scene.bounding_sphere
    reach = float(np.linalg.norm(centre)) + radius
    for name, size in sizes:
        if size < FINEST * reach:
            ratio = f"{size:.3g} m in a scene that reaches {reach:.3g} m from the origin"
            raise InputError(f"object {name}: expected a size of at least {FINEST:g} of the scene's, found {ratio}")


def _size(item: SceneObject) -> float:
    """The longest side of the box around an object in world axes, metres."""
    turned = [np.asarray(part.mesh.vertices) @ item.world_from_object[:3, :3].T for part in item.spacecraft.parts]
    lowest, highest = (np.stack([ends(part, axis=0) for part in turned]) for ends in (np.min, np.max))
    return float((highest.max(axis=0) - lowest.min(axis=0)).max())


def _with_materials(craft: Spacecraft, item: ObjectConfig, custom: Mapping[str, MaterialConfig]) -> Spacecraft:
    """`craft` with the materials that the object's patterns name."""
    parts = list(craft.parts)
    for pattern, name in item.materials.items():
        fitting = [i for i, part in enumerate(parts) if fnmatchcase(part.name, pattern)]
        if not fitting:
            raise InputError(f"materials: expected a part of {craft.name}, found none that fits {pattern!r}")
        chosen = _material(name, custom)
        for i in fitting:
            wrap = item.two_sided is True and is_closed_mesh(parts[i].mesh)
            parts[i] = replace(parts[i], material=make_two_sided(chosen) if wrap else chosen)
    return replace(craft, parts=tuple(parts))


def _material(name: str, custom: Mapping[str, MaterialConfig]) -> Material:
    """A material of the scene file, else a preset."""
    if name not in custom:
        return material(name)
    change = custom[name]
    return customise(name, change.preset, albedo=change.albedo, roughness=change.roughness)
