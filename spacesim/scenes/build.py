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
from spacesim.scenes.materials import Material, customised, material
from spacesim.scenes.meshfile import read_mesh
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.spacecraft import Spacecraft, spacecraft
from spacesim.scenes.spectra import sun_rgb

_log = logging.getLogger(__name__)


def build(config: SceneConfig) -> Scene:
    """The scene of a configuration. Raises InputError where a spacecraft, mesh, part or material cannot be had."""
    objects = tuple(_object(item, config) for item in config.objects)
    red, green, blue = sun_rgb(config.camera.white_balance, total=1.0).tolist()
    return Scene(config.name, objects, replace(config.sun, color=(red, green, blue)), config.earth)


def _object(item: ObjectConfig, config: SceneConfig) -> SceneObject:
    craft = _from_file(item, config) if item.mesh else spacecraft(item.spacecraft)
    changed = _with_materials(craft, item, config.materials)
    return SceneObject(replace(changed, name=item.name or changed.name), _pose(item))


def _from_file(item: ObjectConfig, config: SceneConfig) -> Spacecraft:
    """The object's mesh file, what was dropped or changed in it told in the log."""
    craft, report = read_mesh((config.folder or Path()) / item.mesh, item.units, item.up)
    for line in report.lines():
        _log.info("%s", line)
    return craft


def _pose(item: ObjectConfig) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = item.scale * rotation_from_quaternion(item.rotation_wxyz)
    pose[:3, 3] = item.position
    return pose


def _with_materials(craft: Spacecraft, item: ObjectConfig, custom: Mapping[str, MaterialConfig]) -> Spacecraft:
    """`craft` with the materials that the object's patterns name."""
    parts = list(craft.parts)
    for pattern, name in item.materials.items():
        fitting = [i for i, part in enumerate(parts) if fnmatchcase(part.name, pattern)]
        if not fitting:
            raise InputError(f"materials: expected a part of {craft.name}, found none that fits {pattern!r}")
        chosen = _material(name, custom)
        for i in fitting:
            parts[i] = replace(parts[i], material=chosen)
    return replace(craft, parts=tuple(parts))


def _material(name: str, custom: Mapping[str, MaterialConfig]) -> Material:
    """A material of the scene file, else a preset."""
    if name not in custom:
        return material(name)
    change = custom[name]
    return customised(name, change.preset, albedo=change.albedo, roughness=change.roughness)
