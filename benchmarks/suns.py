"""Of so many training pictures, how many Suns should there be?

    python benchmarks/suns.py --out OUT [--pictures 640] [--suns 4,16,64,320,640] [--resolution 256] [--samples 1024]
                              [--method shadow-splat] [--preset fast] [--iterations N] [--seeds 1] [--json]

boxsat. Every row has as many training pictures, of few Suns with many views each or of many with few, and is evaluated
on the same views under 8 Suns that no row has seen: PSNR over the silhouette, BER by brightness, errors of the
predicted shadow masks. With several seeds, of training: mean and standard deviation. What is done already is not done
again.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from support import common

from spacesim import backend
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.splat.train.config import METHODS, preset, with_options

SCENE = {"spp": 64, "test_views": 5}
COLUMNS = {
    "PSNR": ("image", "psnr", "mean"),
    "BER": ("shadow", "ber", "mean"),
    "mask error": ("shadow_mask", "error_rate", "mean"),
}
GAUSSIANS = {"Gaussians": ("model", "gaussians")}
TEST_SUNS = 8


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--pictures", type=common.positive, default=640, help="for training, in each row (640)")
    parser.add_argument("--suns", default="4,16,64,320,640", help="of the rows, commas between (4,16,64,320,640)")
    parser.add_argument("--resolution", type=common.positive, default=256, metavar="PX", help="of the pictures (256)")
    parser.add_argument("--samples", type=common.positive, default=1024, metavar="N", help="of test pictures (1024)")
    parser.add_argument("--method", choices=METHODS, default="shadow-splat")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=common.positive, help="default: the preset's")
    parser.add_argument("--seeds", type=common.positive, default=1, help="trainings a row (1)")
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
    config = with_options(preset(options.preset, options.method), iterations=options.iterations)
    for count in counts:
        each = options.pictures // count
        scene = {"suns": count, "views": each, **SCENE, "test_views": 0, "resolution": options.resolution}
        data = read_dataset(common.generated("boxsat", options.out / f"data-{count}", **scene))
        results = [
            common.measured(
                f"{count} Suns",
                replace(config, seed=seed),
                EvaluateConfig(geometry=None),
                data,
                options.out / f"{count}-{seed}",
                truth,
            )
            for seed in range(options.seeds)
        ]
        yield {"Suns": count, "views of each": each, **summary(results)}


def summary(results: list[common.Row]) -> common.Row:
    """Means over trainings, and how many Gaussians there are."""
    cells = common.means(results, COLUMNS)
    return cells if "note" in cells else cells | {"Gaussians": int(common.means(results, GAUSSIANS)["Gaussians"])}


if __name__ == "__main__":
    common.run_main(main)
