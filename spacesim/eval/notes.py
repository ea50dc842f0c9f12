"""Why a value of metrics.json is null, and what stands in for missing truth: a sentence each."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from spacesim.data.files import JsonDict, JsonMapping
from spacesim.eval.labels import GROUPS
from spacesim.splat.fit import Unknown

MODELS_OF_A_SCENE = "the models of a scene were trained on other data"

NO_LIGHT = "psnr_mu is null: the data has no radiance (gt_path), or scene.json does not say the exposure."
WHOLE_PICTURES = "image is over whole pictures, as image_full: no silhouette is known, nor alpha."
_STAND_INS = {
    "alpha": "the silhouette is where the image's alpha is at least one half",
    "frame": "the silhouette is the whole frame, as the data has neither silhouette nor alpha",
}


def explain(records: Sequence[JsonDict], sources: Sequence[str], no_lpips: str | None, method: str) -> list[str]:
    """Sentences about the frames `records`: {group: {metric: value or None} or None}.

    sources: where each silhouette is from ("truth", "alpha" or "frame");  no_lpips: why there is none at all
    """
    total = len(records)
    notes = []
    if no_lpips:
        notes.append(f"LPIPS is null; {no_lpips}.")
    no_light = all(record["image_full"].get("psnr_mu") is None for record in records)
    if no_light:
        notes.append(NO_LIGHT)
    photographs = sum(record["shadow"] is None for record in records)
    if photographs:
        notes.append(
            f"shadow and shadow_full are null{'' if photographs == total else f' in {photographs} of {total} frames'}: "
            f"the pictures say neither what is object nor where the Sun is, so dark pixels say nothing of shadow."
        )
    if photographs < total and all(record["shadow_mask"] is None for record in records):
        notes.append(f"Visibility is null: {method} predicts none, or the data has no path-traced one.")
    if sources.count("frame") == total:
        notes.append(WHOLE_PICTURES)
    for source, sentence in _STAND_INS.items():
        if (count := sources.count(source)) and not (source == "frame" and count == total):
            notes.append(f"In {count} of {total} frames {sentence}.")
    unseen = sum(not _shows_object(record) for record in records)
    if unseen:
        notes.append(f"{unseen} of {total} frames show no object: what is taken over its silhouette is null there.")
    explained = [key for key, known in (("lpips", no_lpips), ("psnr_mu", no_light)) if known]
    for group in GROUPS:
        notes += _explain_group(records, group, explained)
    return notes + _explain_kinds(records)


def explain_fit(unknowns: Sequence[Unknown], records: Sequence[JsonDict], whole: bool = False) -> list[str]:
    """Sentences about what was fitted to the pictures. whole: no silhouette is known"""
    if not unknowns:
        return []
    what = "; ".join(f"{unknown.name} ({unknown.how})" for unknown in unknowns)
    of_what = "it" if whole else "the object in it"
    notes = [
        f"Fitted to each evaluated picture: {what}. On the left half of {of_what}, scored on the right half, and "
        "the other way round: no pixel is scored with numbers that were fitted on it."
    ]
    if missing := sum(record["fitted"] is None for record in records):
        why = "a half has no pixel that counts" if whole else "a half shows no object"
        notes.append(f"In {missing} of {len(records)} frames nothing was fitted: {why}.")
    return notes


def explain_ignored(share: float) -> list[str]:
    """A sentence about pixels that count nowhere. share: of all"""
    if share <= 0:
        return []
    return [f"{100 * share:.3g} % of the pixels count nowhere, not in image_full either: nothing is known of them."]


def explain_sensor(scene: JsonMapping) -> list[str]:
    """A sentence where scene.json has a sensor with noise."""
    try:
        sensor = scene["config"]["camera"]["sensor"]
        shot = [f"shot noise of a full well of {sensor['full_well_e']:g} electrons"] if sensor["shot_noise"] else []
        read = [f"read noise of {sensor['read_noise_e']:g} electrons"] if sensor["read_noise_e"] > 0 else []
    except (KeyError, TypeError, ValueError):
        return []
    noise = " and ".join(shot + read)
    return [f"The true pictures have a sensor's noise, which no model predicts: {noise}."] if noise else []


def explain_other_data(trained: Path | None, aligned: Path | None) -> list[str]:
    """A sentence where a run is evaluated in axes that may not be its own. trained: the data that it was trained on,
    where it is evaluated on, or aligned by, others;  aligned: what it is aligned by"""
    if trained is None:
        return []
    if aligned is not None:
        return [f"The run was moved as one in the axes and scale of {aligned}, but was trained on {trained}."]
    return [f"The run was trained on other data, {trained}, and is taken to be in the axes and scale of these."]


def explain_light(
    known_suns: Sequence[bool | None], by_grazing_angle: bool, no_sweep: str, why_unknown: str = ""
) -> list[str]:
    """Sentences where what is said of the light is null.

    known_suns: of each frame, whether training has seen its Sun, or None; by_grazing_angle: whether there are numbers;
    no_sweep: why one view under many Suns is null, "" where it is not;  why_unknown: why it is not known what
    training has seen, "" where it is
    """
    notes = _explain_suns(known_suns, why_unknown)
    if not by_grazing_angle:
        notes.append("depth and by_grazing_angle are null: the data has no path-traced truth.")
    return [*notes, no_sweep] if no_sweep else notes


def explain_objects(
    names: Mapping[int, str],
    records: Sequence[JsonDict],
    models: Sequence[str] | None,
    nearest: Sequence[int] = (),
) -> list[str]:
    """Sentences about objects that are evaluated on their own. names: of the data's objects, {} where it has one;
    models: names of a composed scene's, None for a run;  nearest: objects that its models stand nearest to,
    where they are evaluated as others"""
    if not names:
        return ["objects is null: the data does not say of more than one object."]
    notes = []
    if models is not None and len(models) != len(names):
        have = f"The scene has {len(models)} models, the data {len(names)} objects"
        notes.append(f"{have}: objects have the data's names.")
    if models is not None and nearest:
        order, in_order = ", ".join(map(str, nearest)), ", ".join(map(str, names))
        mismatch = f"{', '.join(models)} stand where objects {order} of the data are"
        notes.append(f"{mismatch} and are evaluated as objects {in_order}: put the models in the objects' order.")
    counts = {name: sum(name in record["objects"] for record in records) for name in names.values()}
    return notes + [
        f"{name} is in {count} of {len(records)} frames; its numbers are over these."
        for name, count in counts.items()
        if count < len(records)
    ]


def _explain_suns(known_suns: Sequence[bool | None], why_unknown: str) -> list[str]:
    definite = [is_known for is_known in known_suns if is_known is not None]
    if not definite:
        reason = why_unknown or "no evaluated frame or no training frame says where its Sun is"
        return [f"known_suns and unseen_suns are null: {reason}."]
    notes = []
    if len(definite) < len(known_suns):
        missing = len(known_suns) - len(definite)
        notes.append(f"{missing} of {len(known_suns)} frames say nothing of their Sun and are in neither split.")
    if not any(definite):
        notes.append("known_suns is null: no evaluated frame is lit by a Sun of a training frame.")
    if all(definite):
        notes.append("unseen_suns is null: every evaluated frame is lit by a Sun of a training frame.")
    return notes


def _explain_kinds(records: Sequence[JsonDict]) -> list[str]:
    """A sentence for each kind of shadow that no frame shows, where visibility is evaluated at all."""
    if all(record["shadow_mask"] is None for record in records):
        return []
    kinds = {
        "shadow_attached": "faces away from the Sun",
        "shadow_self_cast": "lies in a shadow that the object casts on itself",
        "shadow_other_cast": "lies in another object's shadow",
    }
    return [
        f"{kind} is null: no pixel of the evaluated frames {what}."
        for kind, what in kinds.items()
        if all(record[kind] is None for record in records)
    ]


def _explain_group(records: Sequence[JsonDict], group: str, explained: Collection[str]) -> list[str]:
    """A sentence for each metric that is null in frames which show the object, but for those `explained` already."""
    where, metrics = GROUPS[group]
    values = [record[group] for record in records if record[group] is not None and _shows_object(record)]
    notes = []
    for metric in metrics:
        count = sum(value.get(metric.key) is None for value in values)
        if count and metric.key not in explained:
            reason = f"{metric.null}; its mean leaves them out"
            notes.append(f"{metric.label} {where} is null in {count} of {len(records)} frames: {reason}.")
    return notes


def _shows_object(record: JsonDict) -> bool:
    return record["image"]["mae"] is not None
