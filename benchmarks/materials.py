"""What materials read out of a run say of the true ones, part by part of a dataset of `spacesim generate`.

    python benchmarks/materials.py RUN [--data DATA]

Over the pixels of test frames that show a part, where at least 20 do: the median of the roughness, the mean luminance
of the albedo and the share of metal, beside the scene's. True roughness is alpha of GGX, of parts that have a gloss.
Rank correlations (Spearman's) are over parts; "told" is the share of pixels said to be what they are.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr
from support import common

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.images import luminance
from spacesim.data.records import Dataset
from spacesim.data.store import load_truth, read_dataset
from spacesim.splat.run import Run, load_run

LEAST_PIXELS = 20


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--data", type=Path, metavar="DATA", help="with truth (the run's own)")
    options = parser.parse_args()
    backend.select(options.backend)
    run = load_run(options.run)
    dataset = read_dataset(options.data or Path(run.config["data"]["path"]))
    rows = parts(run, dataset)
    glossy = [row for row in rows if row["true roughness"] is not None]
    correlations = {
        "albedo": rank(rows, "albedo"),
        "roughness, glossy parts": rank(glossy, "roughness"),
    }
    told = {"metals": share_told(rows, 1), "others": share_told(rows, 0)}
    tables = {"Parts": rows, "Rank correlation": [correlations], "Told": [told]}
    common.emit({"parts": rows, "rank": correlations, "told": told}, tables, options)


def parts(run: Run, dataset: Dataset) -> list[common.Row]:
    """Of each part that enough pixels of the test frames show."""
    materials: Any = dataset.scene.get("materials")
    if not isinstance(materials, Mapping):
        raise InputError(f"{dataset.root}: expected a dataset of `spacesim generate`, found no materials in scene.json")
    seen = [pixels(run, dataset, index) for index in range(len(dataset.test))]
    number, albedo, metal, roughness, true = (np.concatenate(values) for values in zip(*seen, strict=True))
    rows: list[common.Row] = []
    for part in dataset.scene["parts"]:
        mine = number == part["id"]
        if mine.sum() < LEAST_PIXELS:
            continue
        material = materials[part["material"]]
        alpha, is_metal = alpha_of(material["bsdf"]), holds(material["bsdf"], "type", "roughconductor")
        row = {"part": part["name"], "material": part["material"], "pixels": int(mine.sum())}
        row |= {"albedo": albedo[mine].mean(), "true albedo": true[mine].mean()}
        row |= {"metal": metal[mine].mean(), "true metal": int(is_metal)}
        rows.append(row | {"roughness": np.median(roughness[mine]), "true roughness": alpha})
    return [{key: round(float(v), 3) if isinstance(v, float) else v for key, v in row.items()} for row in rows]


def pixels(run: Run, dataset: Dataset, index: int) -> list[np.ndarray]:
    """Of a test frame's pixels that show a part: its number, albedo, metal, roughness, true albedo, [P] each."""
    frame = dataset.test[index]
    truth, view = load_truth(dataset, frame), run.draw_material(frame.camera)
    mask = truth.part_id > 0
    planes = luminance(view.albedo), view.metallic, view.roughness, luminance(truth.albedo)
    return [truth.part_id[mask], *(plane[mask].astype(np.float64) for plane in planes)]


def alpha_of(bsdf: Mapping[str, Any]) -> float | None:
    """Alpha of GGX of one of Mitsuba's descriptions; None of a dull surface."""
    if "alpha" in bsdf:
        return float(bsdf["alpha"])
    if bsdf.get("type") == "principled":
        return float(bsdf["roughness"]) ** 2
    inner = (alpha_of(value) for value in bsdf.values() if isinstance(value, Mapping))
    return next((alpha for alpha in inner if alpha is not None), None)


def holds(bsdf: Mapping[str, Any], key: str, value: str) -> bool:
    """Whether one of Mitsuba's descriptions, or one within it, says so."""
    return bsdf.get(key) == value or any(holds(v, key, value) for v in bsdf.values() if isinstance(v, Mapping))


def rank(rows: list[common.Row], key: str) -> float | None:
    """Spearman's correlation of a number with the true one; None where either is the same everywhere."""
    pairs = np.array([(row[key], row[f"true {key}"]) for row in rows], float).reshape(-1, 2)
    if len(pairs) < 3 or (np.ptp(pairs, axis=0) == 0).any():
        return None
    return round(float(spearmanr(*pairs.T).statistic), 2)


def share_told(rows: list[common.Row], metal: int) -> float | None:
    """Of the pixels of metals, or of other parts, the mean share that is said to be that."""
    of_kind = [row for row in rows if row["true metal"] == metal]
    right = sum(row["pixels"] * abs(1 - metal - row["metal"]) for row in of_kind)
    return round(right / sum(row["pixels"] for row in of_kind), 2) if of_kind else None


if __name__ == "__main__":
    common.run_main(main)
