"""Scenes by name, from a scene file (docs/reference/scene-files.md) or around a mesh file, and scenes as text."""

import os
from collections.abc import Collection, Mapping
from dataclasses import is_dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NoReturn

from spacesim.data import toml
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping, as_path
from spacesim.data.structure import Rules, did_you_mean, keys_of, structure
from spacesim.scenes.cameras.rig import Rig
from spacesim.scenes.config import ObjectConfig, SceneConfig, with_options
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.materials.table import customise_preset, material_names
from spacesim.scenes.rigs import RIGS, rig_kind
from spacesim.scenes.spacecraft import SPACECRAFT, spacecraft

SCENES = Path(__file__).parents[1] / "assets" / "scenes"
BUILT_IN_SCENES = tuple(sorted(path.stem for path in SCENES.glob("*.toml")))

RULES = Rules(
    kinds={Rig: RIGS},
    hidden=((SceneConfig, "folder"), (SunConfig, "color")),  # the place of the file; what the white balance makes of it
    spread=("resolution", "albedo"),
)


def read_scene(source: str | Path, **options: object) -> SceneConfig:
    """The scene that is built in under the name `source`, that the TOML file `source` describes, or that shows the mesh
    file `source` alone.

    options: fields of the scene, its rig, camera or quality by name (see `with_options`), e.g. views=40,
    sun=[(azimuth, elevation), ...] degrees, resolution=256 or (width, height); None changes nothing. For a mesh file
    also units, up and two_sided (see `ObjectConfig`). Raises InputError where there is no such scene, or for what it
    cannot be.
    """
    path = as_path(source, "scene", "a name or a path")
    chosen = {name: value for name, value in options.items() if value is not None}
    if str(source) in BUILT_IN_SCENES:
        path = SCENES / f"{source}.toml"
    reading: JsonDict = {name: chosen.pop(name) for name in ("units", "up", "two_sided") if name in chosen}
    if path.suffix.lower() != ".toml":
        return with_options(_mesh_scene(path, str(source), reading), **chosen)
    for name in reading:
        raise InputError(f"{name}: expected a mesh file as the scene, found {source}, whose objects say it themselves")
    return with_options(_read_file(path), **chosen)


def scene_text(scene: SceneConfig) -> str:
    """The scene as a TOML file that `read_scene` reads; meshes are relative to the working directory where they lie
    below it. Raises InputError for a rig that scene files do not know."""
    if type(scene.rig) not in RIGS.values():
        raise InputError(f"rig: expected one that a scene file can say, found {rig_kind(scene.rig)}")
    folder = scene.folder or Path()
    objects = tuple(replace(item, mesh=_from_here(folder / item.mesh)) if item.mesh else item for item in scene.objects)
    values = _plain(replace(scene, objects=objects, rig=scene.rig.located(folder)))
    if scene.camera.focal is not None:
        del values["camera"]["fov_deg"]
    return toml.dump(values)


def _mesh_scene(path: Path, source: str, reading: JsonMapping) -> SceneConfig:
    """A mesh file alone, which `reading` says how to read."""
    if os.path.isfile(path):  # which, unlike Path.is_file, takes any name
        return SceneConfig(path.stem, (ObjectConfig(mesh=path.name, **reading),), folder=path.parent)
    expected = f"scene: expected one of {', '.join(BUILT_IN_SCENES)}, a scene file (.toml) or a mesh file"
    if os.path.isdir(path):
        raise InputError(f"{expected}, found the folder {source!r}")
    if path.suffix or len(path.parts) > 1:
        raise InputError(f"{expected}, found no file {source!r}")
    raise InputError(f"{expected}, found {source!r}{did_you_mean(source, BUILT_IN_SCENES)}")


def _read_file(path: Path) -> SceneConfig:
    document = toml.read_document(path)
    scene = structure(SceneConfig, document, RULES, {"name": path.stem, "folder": path.parent})
    _check_names(scene, document)
    return scene


def _check_names(scene: SceneConfig, document: toml.Document) -> None:
    """Raises InputError, with file and line, for a spacecraft, part, material or mesh file that there is none of."""
    presets, folder = material_names(), scene.folder or Path()

    def refuse(expected: str, found: str, *keys: str | int) -> NoReturn:
        raise InputError(f"{document.label(keys)}: expected {expected}, found {found}")

    def check(name: str, names: Collection[str], *keys: str | int) -> None:
        if name not in names:
            refuse(f"one of {', '.join(names)}", f"{name!r}{did_you_mean(name, names)}", *keys)

    for name, custom in scene.materials.items():
        if name in presets:
            refuse("a name that no preset has", repr(name), "materials", name)
        check(custom.preset, presets, "materials", name, "preset")
        try:
            customise_preset(name, custom.preset, custom.albedo, custom.roughness)
        except InputError as error:
            key, _, rest = str(error).removeprefix(f"material {name}: ").partition(": ")
            raise InputError(f"{document.label(('materials', name, key))}: {rest}") from None
    for index, item in enumerate(scene.objects):
        for pattern, name in item.materials.items():
            check(name, (*scene.materials, *presets), "objects", index, "materials", pattern)
        if item.mesh:
            if not os.path.isfile(folder / item.mesh):
                refuse("a mesh file", f"no file {str(folder / item.mesh)!r}", "objects", index, "mesh")
            continue
        check(item.spacecraft, SPACECRAFT, "objects", index, "spacecraft")
        parts = [part.name for part in spacecraft(item.spacecraft).parts] if item.materials else []
        for pattern in item.materials:
            if not any(fnmatchcase(part, pattern) for part in parts):
                none = f"none that fits{did_you_mean(pattern, parts)}"
                refuse(f"a part of {item.spacecraft}, or a pattern", none, "objects", index, "materials", pattern)


def _from_here(mesh: Path) -> str:
    absolute = Path(os.path.abspath(mesh))
    return str(absolute.relative_to(Path.cwd()) if absolute.is_relative_to(Path.cwd()) else absolute)


def _plain(value: object) -> Any:
    """Plain values of a dataclass, for TOML: what is None, "" or an empty table is left out."""
    if not is_dataclass(value):
        if isinstance(value, Mapping):
            return {key: _plain(item) for key, item in value.items()}
        return [_plain(item) for item in value] if isinstance(value, tuple) else value
    values = {name: getattr(value, name) for name in keys_of(type(value), RULES)}
    kinds = next((kinds for base, kinds in RULES.kinds.items() if isinstance(value, base)), {})
    kind = [name for name, cls in kinds.items() if type(value) is cls]
    plain = {name: _plain(item) for name, item in values.items() if item is not None and item not in ("", {})}
    return {"kind": kind[0], **plain} if kind else plain
