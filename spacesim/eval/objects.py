"""Each object of a scene evaluated on its own, over its pixels of the true picture (thesis 4.3.6, tables 4.6 and 4.7),
and by its shape."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.exporters.objects import labelled_objects
from spacesim.data.files import JsonDict
from spacesim.data.images import read_png
from spacesim.data.records import Dataset, Frame
from spacesim.eval.frame_metrics import FrameImages, FrameLight, depth_groups, image_groups, visibility_groups
from spacesim.eval.metrics import lpips
from spacesim.eval.metrics.geometry import GeometryConfig, compare_depths, compare_shape
from spacesim.splat.export.mesh import cameras_around

if TYPE_CHECKING:
    from spacesim.splat.run import Predictor

GROUPS = ("image", "shadow", "shadow_mask", "shadow_self_cast", "shadow_other_cast", "depth")
"""Of `labels.GROUPS`, those that have a meaning over one object's pixels."""


def object_names(dataset: Dataset, models: Sequence[str] = ()) -> dict[int, str]:
    """{number in the id images: name} of a dataset with more than one object; {} of others. models: names of as many
    models, used in place of the dataset's own."""
    objects = dataset.scene.get("objects")
    if not isinstance(objects, list) or len(objects) < 2:
        return {}
    if len(models) == len(objects):
        return {number: name for number, name in enumerate(models, start=1)}
    return {number: f"{entry.get('name', 'object')} {number}" for number, entry in enumerate(objects, start=1)}


def object_groups(
    dataset: Dataset,
    frame: Frame,
    names: Mapping[int, str],
    view: FrameImages,
    light: FrameLight,
    network: lpips.Lpips | None,
) -> dict[str, JsonDict]:
    """{name: {group: metrics}} of the objects that the frame shows; {} where it has no picture of their numbers."""
    ids = _ids(dataset, frame, light) if names else None
    if ids is None:
        return {}
    groups = {}
    for number, name in names.items():
        mask = (ids == number) & view.valid
        if mask.any():
            alone = replace(view, silhouette=mask, valid=mask)
            record: JsonDict = (
                image_groups(alone, network) | visibility_groups(light, alone) | depth_groups(light, alone)
            )
            groups[name] = {group: record[group] for group in GROUPS}
    return groups


def swapped_order(run: "Predictor", dataset: Dataset) -> list[int]:
    """Numbers of the objects that a scene's models stand nearest to, in the models' order, where that is not the
    objects' own, so that models are evaluated as other objects. [] of a run, and where all is in order or that is
    unknown."""
    if not run.parts:
        return []
    try:
        targets = labelled_objects(dataset)
    except InputError:
        return []
    if len(targets) < 2 or len(run.parts) != len(targets):
        return []
    bounds = [(target.vertices.min(axis=0), target.vertices.max(axis=0)) for target in targets]
    middles = [t.world_from_object[:3] @ [*(0.5 * (a + b)), 1] for t, (a, b) in zip(targets, bounds, strict=True)]
    nearest = [int(np.linalg.norm(middles - part.centre, axis=1).argmin()) for part in run.parts]
    order = list(range(len(targets)))
    return [targets[k].id for k in nearest] if nearest != order and sorted(nearest) == order else []


def compare_object_shapes(
    run: "Predictor", dataset: Dataset, names: Mapping[int, str], config: GeometryConfig | None
) -> dict[int, JsonDict | None]:
    """{number: "geometry" as metrics.json has it} of a composed scene's models, each alone against its object's part of
    the true mesh; {} of a run, whose Gaussians belong to no object, and where models or mesh cannot be separated.

    Raises InputError where the grid does not fit into memory.
    """
    if not run.parts or config is None or dataset.mesh_path is None or len(run.parts) != len(names):
        return {}
    try:
        targets = labelled_objects(dataset)
    except InputError:
        return {}
    shapes = {}
    for part, target in zip(run.parts, targets, strict=True):
        turn, shift = target.world_from_object[:3, :3], target.world_from_object[:3, 3]
        truth = target.vertices @ turn.T + shift, target.faces
        model = part.gaussians
        if model is None:
            shapes[target.id] = compare_depths(part, truth, config).values
            continue
        cameras = cameras_around(model, config.mesh.views)
        shapes[target.id] = compare_shape(model, part.antialiased, cameras, truth, config).values
    return shapes


def _ids(dataset: Dataset, frame: Frame, light: FrameLight) -> np.ndarray | None:
    """[H, W] numbers of objects, 0 for none."""
    if light.truth is not None:
        return light.truth.object_id
    if frame.id_path is not None and not any(frame.distortion):
        return read_png(dataset.root / frame.id_path)
    return None
