"""The scene that the truth is path-traced from: the recorded scenes of the models' data, posed as the models are."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, JsonDict, read_json
from spacesim.data.structure import structure
from spacesim.data.toml import Document
from spacesim.scenes.config import ObjectConfig, SceneConfig
from spacesim.scenes.rigs import RIGS
from spacesim.scenes.scenefile import RULES
from spacesim.splat.compose.pose import Pose

SAME_PLACE = 1e-4  #: metres, or that share of a distance, of a scale and of axes, that count as none


def load_recorded_scene(data: Path) -> SceneConfig:
    """What scene.json of a dataset says of its scene; mesh files as absolute paths. Raises InputError where there is
    none, or a mesh file that it names is not to be found from the dataset or the working directory."""
    path = Path(data) / "scene.json"
    if not path.is_file():
        raise InputError(f"{path}: expected the scene that the data were made from, found none; the truth is not known")
    values = read_json(path, MAX_LIST_BYTES)
    config = values.get("config") if isinstance(values, dict) else None
    if not isinstance(config, dict):
        raise InputError(f"{path}: expected an object with the key config, found none")
    recorded = _without_nulls(config)
    if isinstance(recorded.get("sun"), dict):
        recorded["sun"].pop("color", None)  # what the white balance makes of it, again
    if isinstance(recorded.get("rig"), dict) and recorded["rig"].get("kind") not in RIGS:  # user-defined
        del recorded["rig"]
    scene = structure(SceneConfig, Document(str(path), recorded, {}), RULES)
    return replace(scene, objects=tuple(_with_absolute_mesh(item, path) for item in scene.objects))


def compose_scene(scenes: Sequence[SceneConfig], poses: Sequence[Pose]) -> SceneConfig:
    """All objects of the models' scenes, each scene moved, turned and scaled as its model is. Raises InputError where
    the scenes differ in the Sun, the Earth or in what makes a picture of light."""
    first = scenes[0]
    for other in scenes[1:]:
        for what in ("sun", "earth"):
            _expect_same(first, other, what, getattr(first, what), getattr(other, what))
        for what in ("exposure", "tone", "white_balance", "distortion"):
            _expect_same(first, other, what, getattr(first.camera, what), getattr(other.camera, what))
    objects: list[ObjectConfig] = []
    materials: JsonDict = {}
    for k, (scene, pose) in enumerate(zip(scenes, poses, strict=True)):
        renamed = {name: f"{name}@{k}" for name in scene.materials} if k else {name: name for name in scene.materials}
        materials |= {renamed[name]: material for name, material in scene.materials.items()}
        objects += [_pose_object(item, pose, renamed) for item in scene.objects]
    return replace(first, objects=tuple(objects), materials=materials)


def split_scene(scene: SceneConfig, poses: Sequence[Pose]) -> list[SceneConfig] | None:
    """The scene of each model alone, in its own frame, of one that shows them all, each as the object of its number;
    None where there are not as many. poses: of the models, where they stand as the objects do"""
    if len(scene.objects) != len(poses):
        return None
    pairs = zip(scene.objects, poses, strict=True)
    return [replace(scene, objects=(_pose_object(item, pose.inverse(), {}),)) for item, pose in pairs]


def pose_objects(scenes: Sequence[SceneConfig], poses: Sequence[Pose]) -> list[ObjectConfig]:
    """Where the objects of the models' scenes are; of what they are made stays as each scene names it."""
    return [_pose_object(item, pose, {}) for scene, pose in zip(scenes, poses, strict=True) for item in scene.objects]


def model_of_objects(scenes: Sequence[SceneConfig]) -> list[int]:
    """Of each object of a composed scene, in its order, the number of the model whose scene it is from, from 1."""
    return [number for number, scene in enumerate(scenes, start=1) for _ in scene.objects]


def match_objects(some: Sequence[ObjectConfig], others: Sequence[ObjectConfig]) -> list[int] | None:
    """Of each of `others`, which of `some` is the same thing in the same place; None where they are not the same."""
    left, matches = list(range(len(some))), []
    for other in others:
        place = next((k for k in left if _same_object(some[k], other)), None)
        if place is None:
            return None
        left.remove(place)
        matches.append(place)
    return None if left else matches


def _same_object(first: ObjectConfig, second: ObjectConfig) -> bool:
    kinds = [(each.spacecraft, Path(each.mesh).name, each.units) for each in (first, second)]
    if kinds[0] != kinds[1]:
        return False
    a, b = (Pose(np.array(each.rotation_wxyz), np.array(each.position), each.scale) for each in (first, second))
    reach = SAME_PLACE * max(1.0, float(np.abs(b.translation).max()))
    near = np.abs(a.translation - b.translation).max() <= reach and np.isclose(a.scale, b.scale, rtol=SAME_PLACE)
    return bool(near and np.allclose(a.rotation, b.rotation, rtol=0, atol=SAME_PLACE))


def _pose_object(item: ObjectConfig, pose: Pose, renamed: Mapping[str, str]) -> ObjectConfig:
    placed = pose.after(Pose(np.array(item.rotation_wxyz), np.array(item.position), item.scale))
    (x, y, z), (w, i, j, k) = placed.translation.tolist(), placed.quaternion.tolist()
    used = {pattern: renamed.get(name, name) for pattern, name in item.materials.items()}
    return replace(item, position=(x, y, z), rotation_wxyz=(w, i, j, k), scale=placed.scale, materials=used)


def _expect_same(first: SceneConfig, second: SceneConfig, what: str, value: object, other: object) -> None:
    if value != other:
        raise InputError(
            f"{second.name}: expected the {what} of {first.name} ({value}), found another ({other}); the truth of both "
            "together is not known"
        )


def _with_absolute_mesh(item: ObjectConfig, path: Path) -> ObjectConfig:
    """With the mesh file, if it has one, as an absolute path."""
    if not item.mesh:
        return item
    places = [path.parent / item.mesh, Path.cwd() / item.mesh]
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        raise InputError(
            f"{path}: expected the mesh file {item.mesh} beside it or in the working directory, found none; the truth "
            "is not known"
        )
    return replace(item, mesh=str(place.resolve()))


def _without_nulls(value: object) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nulls(item) for key, item in value.items() if item is not None}
    return [_without_nulls(item) for item in value] if isinstance(value, list) else value
