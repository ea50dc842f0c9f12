"""Each object of a scene judged on its own, over its pixels of the true picture (thesis 4.3.6, tables 4.6 and 4.7)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from spacesim.data.images import read_png
from spacesim.data.records import Dataset, Frame
from spacesim.eval import lpips
from spacesim.eval.judge import Light, View, judge_picture, judge_visibility

GROUPS = ("image", "shadow", "shadow_mask", "shadow_self_cast", "shadow_other_cast")
"""Of `labels.GROUPS`, those that have a meaning over one object's pixels."""


def object_names(dataset: Dataset, models: Sequence[str] = ()) -> dict[int, str]:
    """{number in the id images: name} of a dataset with more than one object; {} of others. models: names of as many
    models, which are told instead of the dataset's own."""
    told = dataset.scene.get("objects")
    if not isinstance(told, list) or len(told) < 2:
        return {}
    if len(models) == len(told):
        return {number: name for number, name in enumerate(models, start=1)}
    return {number: f"{one.get('name', 'object')} {number}" for number, one in enumerate(told, start=1)}


def judge_objects(
    dataset: Dataset, frame: Frame, names: Mapping[int, str], view: View, light: Light, network: lpips.Lpips | None
) -> dict[str, dict[str, Any]]:
    """{name: {group: metrics}} of the objects that the frame shows; {} where it has no picture of their numbers."""
    ids = _ids(dataset, frame, light) if names else None
    if ids is None:
        return {}
    found = {}
    for number, name in names.items():
        mask = (ids == number) & view.valid
        if mask.any():
            alone = replace(view, silhouette=mask, valid=mask)
            record: dict[str, Any] = {**judge_picture(alone, network), **judge_visibility(light, alone)}
            found[name] = {group: record[group] for group in GROUPS}
    return found


def _ids(dataset: Dataset, frame: Frame, light: Light) -> np.ndarray | None:
    """[H, W] numbers of objects, 0 for none."""
    if light.truth is not None:
        return light.truth.object_id
    if frame.id_path is not None and not any(frame.distortion):
        return read_png(dataset.root / frame.id_path)
    return None
