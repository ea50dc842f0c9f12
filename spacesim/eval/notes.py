"""Why a value of metrics.json is null, and what stands in for missing truth: a sentence each."""

from collections.abc import Sequence
from typing import Any

from spacesim.eval.labels import GROUPS

_STAND_INS = {
    "alpha": "the silhouette is where the image's alpha is at least one half",
    "frame": "the silhouette is the whole frame, as the data has neither silhouette nor alpha",
}


def explain(records: Sequence[dict[str, Any]], sources: Sequence[str], no_lpips: str | None, method: str) -> list[str]:
    """Sentences about the frames `records`: {group: {metric: value or None} or None}.

    sources: where each silhouette is from ("truth", "alpha" or "frame");  no_lpips: why there is none at all
    """
    total = len(records)
    notes = ["Geometry is null: no mesh is extracted from this run yet."]
    if no_lpips:
        notes.append(f"LPIPS is null; {no_lpips}.")
    if all(record["shadow_mask"] is None for record in records):
        notes.append(f"Visibility is null: {method} predicts none, or the data has no path-traced one.")
    for source, sentence in _STAND_INS.items():
        if count := sources.count(source):
            notes.append(f"In {count} of {total} frames {sentence}.")
    unseen = sum(not _shows_object(record) for record in records)
    if unseen:
        notes.append(f"{unseen} of {total} frames show no object: what is taken over its silhouette is null there.")
    for group in GROUPS:
        notes += _explain_group(records, group, bool(no_lpips))
    return notes


def _explain_group(records: Sequence[dict[str, Any]], group: str, no_lpips: bool) -> list[str]:
    """A sentence for each metric that is null in frames which show the object."""
    where, metrics = GROUPS[group]
    values = [record[group] for record in records if record[group] is not None and _shows_object(record)]
    notes = []
    for metric in metrics:
        count = sum(value[metric.key] is None for value in values)
        if count and not (metric.key == "lpips" and no_lpips):
            reason = f"{metric.null}; its mean leaves them out"
            notes.append(f"{metric.label} {where} is null in {count} of {len(records)} frames: {reason}.")
    return notes


def _shows_object(record: dict[str, Any]) -> bool:
    return record["image"]["mae"] is not None
