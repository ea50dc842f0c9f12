"""What shadows are worth on one spacecraft and another: the same presets, untouched, under Suns never seen.

    python benchmarks/scenes.py --out OUT [--craft boxsat,telescope,upper-stage,cubesat,station,lander] [--preset fast]
                                [--suns 16] [--views 40] [--resolution 256] [--samples 1024] [--seeds 1] [--json]

Each craft stands alone among cameras all around, station and lander as mesh files that the benchmark writes. Beside the
method of --method stands the same without shadows, all else being equal. PSNR over the silhouette, BER by brightness,
"gap": by how much Suns of training are better. With several seeds, of training: means over them, and the deviation of
the gain. What is done already is not done again.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from support import common, craft, seeds

from spacesim import backend
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import METHODS, TrainConfig

CRAFT = "boxsat", "telescope", "upper-stage", "cubesat", *craft.NAMES


def main() -> None:
    parser = seeds.arguments(__doc__, METHODS[2:])
    seeds.add_rig(parser)
    parser.add_argument("--craft", default=",".join(CRAFT), help="commas between (all)")
    options = parser.parse_args()
    names = seeds.chosen(parser, "--craft", options.craft, CRAFT)
    backend.select(options.backend)
    rows = list(rows_of(names, options))
    common.emit({"rows": rows}, {f"{options.method}, {options.preset}": rows}, options)


def rows_of(names: list[str], options: Any) -> Iterator[common.Row]:
    """A row for each craft."""
    scene = {"suns": options.suns, "views": options.views, **common.KNOWN_AND_UNSEEN, "test_spp": options.samples}
    for name in names:
        folder = options.out / name
        path = craft.write(name, folder / "mesh") if name in craft.NAMES else alone(name, folder)
        data = read_dataset(common.generated(str(path), folder / "data", **scene, resolution=options.resolution))
        config = seeds.config_of(options)
        without, method = (
            seeds.trainings(f"{name}, {label}", row, data, folder / label, options.seeds)
            for label, row in (("no shadows", without_shadows(config)), (options.method, config))
        )
        yield {"craft": name, **summary(without, method)}


def alone(name: str, folder: Path) -> Path:
    """The scene file of a built-in spacecraft with nothing beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(f'[[objects]]\nspacecraft = "{name}"\n')
    return path


def without_shadows(config: TrainConfig) -> TrainConfig:
    """`relight` with all that `config` has beside shadows."""
    assert config.light is not None
    return replace(config, light=replace(config.light, shadow=None))


def summary(without: list[common.Row], method: list[common.Row]) -> common.Row:
    """Means over trainings without shadows and with them; {"note": why} where one has failed."""
    notes = [result["note"] for result in without + method if "note" in result]
    if notes:
        return {"note": notes[0]}
    base, ours = (values(results, "unseen_suns", "image", "psnr", "mean") for results in (without, method))
    known = values(method, "known_suns", "image", "psnr", "mean")
    cells: common.Row = {"no shadows": base.mean(), "PSNR": ours.mean(), "gain": (ours - base).mean()}
    if len(ours) > 1:
        cells["gain, deviation"] = (ours - base).std(ddof=1)
    cells["gap"] = (known - ours).mean()
    cells["BER, no shadows"] = values(without, "unseen_suns", "shadow", "ber", "mean").mean()
    cells["BER"] = values(method, "unseen_suns", "shadow", "ber", "mean").mean()
    cells["mask error"] = values(method, "unseen_suns", "shadow_mask", "error_rate", "mean").mean()
    cells["pooled"] = values(method, "unseen_suns", "shadow_mask", "error_rate", "pooled").mean()
    cells["facing away, pooled"] = values(method, "unseen_suns", "shadow_attached", "error_rate", "pooled").mean()
    cells["albedo"] = values(method, "material", "albedo_error", "mean").mean()
    cells["normals"] = values(method, "material", "normals_deg", "mean").mean()
    cells = {key: round(float(value), 4) for key, value in cells.items()}
    return cells | {"Gaussians": int(np.mean([result["model"]["gaussians"] for result in method]))}


def values(results: list[common.Row], *names: str) -> np.ndarray:
    """Of each training the number that stands under these names, see `common.number_in`; NaN where it has none."""
    return np.array([common.number_in(result, *names) for result in results], float)


if __name__ == "__main__":
    common.run_main(main)
