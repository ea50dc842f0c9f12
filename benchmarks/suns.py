"""Of so many training pictures, how many Suns should there be?

    python benchmarks/suns.py --out OUT [--pictures 640] [--suns 4,16,64,320,640] [--resolution 256] [--samples 1024]
                              [--method shadow-splat] [--preset fast] [--iterations N] [--seeds 1] [--json]

boxsat. Every row has as many training pictures, of few Suns with many views each or of many with few, and is evaluated
on the same views under 8 Suns that no row has seen: PSNR over the silhouette, BER by brightness, errors of the
predicted shadow masks. With several seeds, of training: mean and standard deviation. What is done already is not done
again.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from support import common, seeds

from spacesim import backend
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import METHODS

SCENE = {"spp": 64, "test_views": 5}
COLUMNS = {
    "PSNR": ("image", "psnr", "mean"),
    "BER": ("shadow", "ber", "mean"),
    "mask error": ("shadow_mask", "error_rate", "mean"),
}
TEST_SUNS = 8


def main() -> None:
    parser = seeds.arguments(__doc__, METHODS)
    parser.add_argument("--pictures", type=common.positive, default=640, help="for training, in each row (640)")
    parser.add_argument("--suns", default="4,16,64,320,640", help="of the rows, commas between (4,16,64,320,640)")
    options = parser.parse_args()
    words = options.suns.split(",")
    counts = [int(word) if word.isdigit() else 0 for word in words]
    if any(count < 1 or options.pictures % count for count in counts):
        parser.error(f"--suns: expected numbers that divide {options.pictures} pictures, found {options.suns!r}")
    backend.select(options.backend)
    rows = list(rows_of(counts, options))
    common.emit({"rows": rows}, {f"{options.pictures} pictures, {options.method}, {options.preset}": rows}, options)


def rows_of(counts: list[int], options: Any) -> Iterator[common.Row]:
    """A row for each number of Suns."""
    unseen = {"suns": 1, "views": 1, "test_suns": TEST_SUNS, **SCENE, "test_spp": options.samples}
    unseen["resolution"] = options.resolution
    truth = read_dataset(common.generated("boxsat", options.out / "unseen", **unseen))
    config = seeds.config_of(options)
    for count in counts:
        each = options.pictures // count
        scene = {"suns": count, "views": each, **SCENE, "test_views": 0, "resolution": options.resolution}
        data = read_dataset(common.generated("boxsat", options.out / f"data-{count}", **scene))
        results = seeds.trainings(f"{count} Suns", config, data, options.out / str(count), options.seeds, truth)
        yield {"Suns": count, "views of each": each, **summary(results)}


def summary(results: list[common.Row]) -> common.Row:
    """Means over trainings, and how many Gaussians there are."""
    cells = seeds.means(results, COLUMNS)
    if "note" not in cells:
        cells["Gaussians"] = int(np.mean([result["model"]["gaussians"] for result in results]))
    return cells


if __name__ == "__main__":
    common.run_main(main)
