"""Sun and Earth as two sources of the model: what the Earth in it is worth (`light.earth`).

    python benchmarks/earth.py --out OUT [--scene boxsat] [--suns 12] [--views 8] [--resolution 80] [--spp 64]
                               [--method shadow-map] [--preset demo] [--iterations 1500] [--seed 0] [--json]

500 km over the Earth; views of which less than a twentieth is sunlit are left out. Trained with the Earth in the
model and without. PSNR of sRGB values over the silhouette under Suns never seen, means over views: of the whole
picture; of sunlight alone, which a model without the Earth does not know from the whole; and of the Earth's light
alone, that model's black. Each against the path tracer's layer of it.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from support import common

from spacesim import backend
from spacesim.data.images import linear_from_srgb
from spacesim.data.images.tone import STANDARD_EXPOSURE, display_values
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import load_truth
from spacesim.eval.metrics.image import psnr
from spacesim.learning.lights import added_light
from spacesim.progress import show_progress
from spacesim.reproduce.perform import trained
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.scenefile import read_scene
from spacesim.splat.run import Run
from spacesim.splat.train.config import METHODS, preset, with_options, with_settings


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--scene", default="boxsat", help="a scene's name or file (boxsat)")
    parser.add_argument("--suns", type=common.positive, default=12, help="of training, and as many of testing (12)")
    parser.add_argument("--views", type=common.positive, default=8, help="of each Sun, half as many in testing (8)")
    parser.add_argument("--resolution", type=common.positive, default=80, metavar="PX", help="of the pictures (80)")
    parser.add_argument("--spp", type=common.positive, default=64)
    parser.add_argument("--method", choices=METHODS, default="shadow-map")
    parser.add_argument("--preset", default="demo")
    parser.add_argument("--iterations", type=common.positive, default=1500)
    parser.add_argument("--seed", type=common.natural, default=0, help="of training")
    options = parser.parse_args()
    backend.select(options.backend)
    rows = list(rows_of(earthlit(options), options))
    common.emit({"rows": rows}, {f"{options.scene} over the Earth, {options.method}, {options.preset}": rows}, options)


def earthlit(options: argparse.Namespace) -> Dataset:
    """The dataset, made as far as it is not there."""
    rig = {"suns": options.suns, "views": options.views, "test_suns": options.suns}
    rig |= {"test_views": (options.views + 1) // 2, "resolution": options.resolution, "spp": options.spp}
    scene = replace(read_scene(options.scene, min_sunlit=0.05, **rig), earth=EarthConfig())
    with show_progress("generate", "frames") as report:
        return generate(scene, options.out / "data", resume=True, progress=report)


def rows_of(data: Dataset, options: argparse.Namespace) -> Iterator[common.Row]:
    """Without the Earth in the model and with it."""
    config = with_options(preset(options.preset, options.method), iterations=options.iterations, seed=options.seed)
    for name, earth in (("without", False), ("with", True)):
        lit = with_settings(config, {"light.earth": earth})
        run = trained(options.out / name, data, lit, name, show_progress)
        assert isinstance(run, Run)
        layers = np.array([layers_of(run, data, frame) for frame in data.test]).mean(axis=0)
        columns = "PSNR, dB", "of sunlight", "of earthlight", "earthlight, true", "predicted"
        yield {"the Earth": name, **dict(zip(columns, layers.tolist(), strict=True)), "s": run.training["seconds"]}


def layers_of(run: Run, data: Dataset, frame: Frame) -> tuple[float, ...]:
    """PSNR of the whole picture, of the Sun's layer and of the Earth's, dB; the mean linear display value of the
    Earth's layer, in truth and as predicted."""
    truth = load_truth(data, frame)
    assert frame.sun is not None
    assert truth.radiance_earth is not None
    both, sun = (run.predict(frame.camera, light) for light in (frame.sun, replace(frame.sun, earth=None)))
    shown = both.rgb, sun.rgb, added_light(both, sun).rgb
    traced = truth.radiance, truth.radiance - truth.radiance_earth, truth.radiance_earth
    surface = truth.object_id > 0
    pictures = [display_values(np.clip(STANDARD_EXPOSURE * layer, 0, 1), "srgb") for layer in traced]
    pairs = zip(shown, pictures, strict=True)
    scores = [psnr(np.clip(one, 0, 1), other, surface) or math.nan for one, other in pairs]
    means = [float(linear_from_srgb(layer)[surface].mean()) for layer in (pictures[2], shown[2])]
    return (*scores, *means)


if __name__ == "__main__":
    common.run_main(main)
