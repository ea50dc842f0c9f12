"""Scenes by name, from a scene file (docs/scenes.md) or around a mesh file, and scenes as text."""

import os
from collections.abc import Collection, Mapping
from dataclasses import is_dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NoReturn

from spacesim.data import toml
from spacesim.data.errors import InputError
from spacesim.data.structure import Rules, keys_of, near, structure
from spacesim.scenes.config import ObjectConfig, SceneConfig, with_options
from spacesim.scenes.materials.table import changed, material_names
from spacesim.scenes.rig import RIGS, RigConfig
from spacesim.scenes.spacecraft import SPACECRAFT, spacecraft
from spacesim.scenes.sun import SunConfig

SCENES = Path(__file__).parents[1] / "assets" / "scenes"
BUILT_IN_SCENES = tuple(sorted(path.stem for path in SCENES.glob("*.toml")))

RULES = Rules(
    kinds={RigConfig: RIGS},
    hidden=((SceneConfig, "folder"), (SunConfig, "color")),  # the place of the file; what the white balance makes of it
    spread=("resolution", "albedo"),
)


def read_scene(source: str | Path, **options: Any) -> SceneConfig:
    """The scene that is built in under the name `source`, that the TOML file `source` describes, or that shows the mesh
    file `source` alone.

    options: fields of the scene, its rig, camera or quality by name (see `with_options`), e.g. views=40,
    sun=[(azimuth, elevation), ...] degrees, resolution=256 or (width, height); None changes nothing. For a mesh file
    also units, up and two_sided (see `ObjectConfig`). Raises InputError where there is no such scene, or for what it
    cannot be.
    """
    path = Path(source)
    given = {name: value for name, value in options.items() if value is not None}
    if str(source) in BUILT_IN_SCENES:
        path = SCENES / f"{source}.toml"
    reading: dict[str, Any] = {name: given.pop(name) for name in ("units", "up", "two_sided") if name in given}
    if path.suffix.lower() != ".toml":
        return with_options(_mesh_scene(path, str(source), reading), **given)
    for name in reading:
        raise InputError(f"{name}: expected a mesh file as the scene, found {source}, whose objects say it themselves")
    return with_options(_read_file(path), **given)


def scene_text(scene: SceneConfig) -> str:
    """The scene as a TOML file that `read_scene` reads; meshes are relative to the working directory where they lie
    below it."""
    folder = scene.folder or Path()
    objects = tuple(replace(one, mesh=_from_here(folder / one.mesh)) if one.mesh else one for one in scene.objects)
    return toml.dump(_plain(replace(scene, objects=objects)))


def _mesh_scene(path: Path, source: str, reading: Mapping[str, Any]) -> SceneConfig:
    """A mesh file alone, which `reading` says how to read."""
    if os.path.isfile(path):  # which, unlike Path.is_file, takes any name
        return SceneConfig(path.stem, (ObjectConfig(mesh=path.name, **reading),), folder=path.parent)
    wanted = f"scene: expected one of {', '.join(BUILT_IN_SCENES)}, a scene file (.toml) or a mesh file"
    if os.path.isdir(path):
        raise InputError(f"{wanted}, found the folder {source!r}")
    if path.suffix or len(path.parts) > 1:
        raise InputError(f"{wanted}, found no file {source!r}")
    raise InputError(f"{wanted}, found {source!r}{near(source, BUILT_IN_SCENES)}")


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

    def check(name: str, known: Collection[str], *keys: str | int) -> None:
        if name not in known:
            refuse(f"one of {', '.join(known)}", f"{name!r}{near(name, known)}", *keys)

    for name, custom in scene.materials.items():
        if name in presets:
            refuse("a name that no preset has", repr(name), "materials", name)
        check(custom.preset, presets, "materials", name, "preset")
        try:
            changed(name, custom.preset, custom.albedo, custom.roughness)
        except InputError as error:
            key, _, rest = str(error).removeprefix(f"material {name}: ").partition(": ")
            raise InputError(f"{document.label(('materials', name, key))}: {rest}") from None
    for index, one in enumerate(scene.objects):
        for pattern, name in one.materials.items():
            check(name, (*scene.materials, *presets), "objects", index, "materials", pattern)
        if one.mesh:
            if not os.path.isfile(folder / one.mesh):
                refuse("a mesh file", f"no file {str(folder / one.mesh)!r}", "objects", index, "mesh")
            continue
        check(one.spacecraft, SPACECRAFT, "objects", index, "spacecraft")
        parts = [part.name for part in spacecraft(one.spacecraft).parts] if one.materials else []
        for pattern in one.materials:
            if not any(fnmatchcase(part, pattern) for part in parts):
                found = f"none that fits{near(pattern, parts)}"
                refuse(f"a part of {one.spacecraft}, or a pattern", found, "objects", index, "materials", pattern)


def _from_here(mesh: Path) -> str:
    absolute = Path(os.path.abspath(mesh))
    return str(absolute.relative_to(Path.cwd()) if absolute.is_relative_to(Path.cwd()) else absolute)


def _plain(value: Any) -> Any:
    """Plain values of a dataclass, for TOML: what is None, "" or an empty table is left out."""
    if not is_dataclass(value):
        if isinstance(value, Mapping):
            return {key: _plain(one) for key, one in value.items()}
        return [_plain(one) for one in value] if isinstance(value, tuple) else value
    values = {name: getattr(value, name) for name in keys_of(type(value), RULES)}
    kinds = next((kinds for base, kinds in RULES.kinds.items() if isinstance(value, base)), {})
    kind = [name for name, cls in kinds.items() if type(value) is cls]
    plain = {name: _plain(one) for name, one in values.items() if one is not None and one not in ("", {})}
    return {"kind": kind[0], **plain} if kind else plain
