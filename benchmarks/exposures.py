"""High dynamic range: what learning light is worth, and what exposures are that differ from picture to picture.

    python benchmarks/exposures.py --out OUT [--preset fast] [--method shadow-splat] [--suns 16] [--views 40]
                                   [--resolution 256] [--samples 1024] [--iterations N] [--seeds 1] [--rows NAMES]

boxsat as in shadows.py, in three sets of pictures: "0 EV", where white is a white surface that faces the Sun; "3 EV",
eight times as bright, which clips what is well lit; "varied", where each training picture has its own exposure, within
1 EV of the first's (uniform, mean 0), developed from the path-traced light. Trained: sRGB values; `light.linear`; and
`light.radiance`, from EXR. Of varied pictures: as if they were alike, with exposures given, and fitted. PSNR of sRGB
values and of mu-law encoded light (to 4 EV above white), over the silhouette, BER, errors of the shadow masks: views
under Suns of training, and under 8 never seen, with the set's first exposure. With several seeds, of training: means
and deviations. What is done already is not done again.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from support import common, seeds

from spacesim import backend
from spacesim.data.files import read_json, write_json
from spacesim.data.images import write_png
from spacesim.data.records import Dataset
from spacesim.data.store import load_truth, read_dataset
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.exposure import record_image
from spacesim.scenes.lights.sun import EXPOSURE
from spacesim.splat.train.config import METHODS, with_settings

LINEAR, FITTED = {"light.linear": True}, {"exposure_per_picture": True}
RADIANCE = {**LINEAR, "light.radiance": True}
ROWS: dict[str, tuple[str, dict[str, Any]]] = {  # pictures and settings
    "0 EV, sRGB": ("0 EV", {}),
    "0 EV, linear": ("0 EV", LINEAR),
    "0 EV, radiance": ("0 EV", RADIANCE),
    "3 EV, sRGB": ("3 EV", {}),
    "3 EV, linear": ("3 EV", LINEAR),
    "3 EV, radiance": ("3 EV", RADIANCE),
    "varied, as if alike": ("varied, not named", {}),
    "varied, given, sRGB": ("varied", {}),
    "varied, given, linear": ("varied", LINEAR),
    "varied, fitted, sRGB": ("varied, not named", FITTED),
    "varied, fitted, linear": ("varied, not named", {**LINEAR, **FITTED}),
}
SUNS = {"known": "known_suns", "unseen": "unseen_suns"}
METRICS = {
    "PSNR": ("image", "psnr"),
    "PSNR-mu": ("image", "psnr_mu"),
    "BER": ("shadow", "ber"),
    "mask error": ("shadow_mask", "error_rate"),
}
COLUMNS = {
    f"{heading}, {label}": (part, *names, "mean") for label, part in SUNS.items() for heading, names in METRICS.items()
}
STOPS = 1.0  #: EV, the most by which varied exposures differ from the first


def main() -> None:
    parser = seeds.arguments(__doc__, METHODS[1:])
    seeds.add_rig(parser)
    parser.add_argument("--rows", default=",".join(ROWS), help=f"of {', '.join(map(repr, ROWS))} (all)")
    options = parser.parse_args()
    names = seeds.chosen(parser, "--rows", options.rows, ROWS)
    backend.select(options.backend)
    rows = list(rows_of(names, options))
    common.emit({"rows": rows}, {f"{options.method}, {options.preset}": rows}, options)


def rows_of(names: list[str], options: Any) -> Iterator[common.Row]:
    """A row for each name."""
    config = seeds.config_of(options)
    data: dict[str, Dataset] = {}
    for name in names:
        pictures, settings = ROWS[name]
        if pictures not in data:
            data[pictures] = pictures_of(pictures, options)
        row = with_settings(config, settings)
        results = seeds.trainings(name, row, data[pictures], options.out / name, options.seeds)
        yield {"pictures, trained on": name, **seeds.means(results, COLUMNS)}


def pictures_of(name: str, options: Any) -> Dataset:
    """One of the sets of pictures, made as far as it is not there."""
    scene = {"suns": options.suns, "views": options.views, "resolution": options.resolution, **common.KNOWN_AND_UNSEEN}
    scene["test_spp"] = options.samples
    if name == "3 EV":
        return read_dataset(common.generated("boxsat", options.out / name, **scene, exposure=8 * EXPOSURE))
    same = read_dataset(common.generated("boxsat", options.out / "0 EV", **scene))
    return same if name == "0 EV" else varied(same, options.out / name, named=name == "varied")


def varied(data: Dataset, out: Path, named: bool) -> Dataset:
    """`data` at `out`, each training picture with an exposure of its own; named: whether transforms.json says it."""
    if (out / "transforms.json").exists():
        return read_dataset(out)
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(data.root, out, copy_function=os.link, ignore=shutil.ignore_patterns("transforms.json"))
    meta = read_json(data.root / "transforms.json")
    entries = {entry["file_path"]: entry for entry in meta["frames"]}
    stops = np.random.default_rng(0).uniform(-STOPS, STOPS, len(data.train))
    for frame, stop in zip(data.train, (stops - stops.mean()).tolist(), strict=True):
        truth, exposure = load_truth(data, frame), EXPOSURE * 2**stop
        recording = record_image(truth.radiance, truth.alpha, CameraConfig(exposure=exposure), [0])
        write_png(out / frame.file_path, recording.image)
        if named:
            entries[frame.file_path]["exposure"] = exposure
    write_json(out / "transforms.json", meta)
    return read_dataset(out)


if __name__ == "__main__":
    common.run_main(main)
