"""How fast a relit and shadowed frame is, and a training step that learns one.

    python benchmarks/light.py [--methods relight,shadow-map] [--preset fast] [--sizes 31622x1024] [--markdown]

The scene is the sphere of random splats of the other benchmarks, with the preset's settings and untrained networks:
how long these take does not depend on what they have learned, but light that bounces and who is hidden are the
sphere's. A frame is what `spacesim render RUN --sun AZ,EL` draws, left on the device, each time under another Sun;
steps are timed 20 in a row on a GPU, as in training. "shadows" casts them, "field" is the networks, "draw" the picture,
both differences of medians, which a host that drifts may push below 0; "kernels" is what the device alone needs. The
thesis's frames (RTX 5000 Ada) stand beside ours.
"""

import sys
import tempfile
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from support import common, synthetic

from spacesim import backend
from spacesim.data.geometry import fibonacci_sphere
from spacesim.data.records import Sun
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.pictures import computed
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.supersample import render_supersampled, upsampled_camera
from spacesim.splat.run import draw_lit
from spacesim.splat.train.config import METHODS, preset

LIT = METHODS[1:]
DIRECTION = 4, 1, 1  #: of the camera from the sphere
SUNS = fibonacci_sphere(64)  #: of training steps
NEW_SUNS = cycle(np.random.default_rng(1).permutation(fibonacci_sphere(2**16)))  #: of frames: what one needs is kept
SIZES = {"cuda": "31622x1024,101958x1024,165495x1024", "llvm": "10000x256,30000x256"}
STEPS = {"cuda": "100000x512", "llvm": "10000x128"}
THESIS = {31622: 108, 101958: 77, 165495: 70}  #: frames per second (section 4.3.6, shadow mapping)


def lit_arrays(count: int, features: int) -> dict[str, np.ndarray]:
    """The sphere's splats with so many features each, and no harmonics."""
    learned = np.random.default_rng(0).normal(size=(count, features)).astype(np.float32)
    return {**common.sphere_arrays(count), "sh": np.zeros((count, 0, 3)), "features": learned}


class Frame:
    """A relightable sphere and the parts of its picture. Each call has another Sun."""

    def __init__(self, count: int, pixels: int, method: str, size: str) -> None:
        config = preset(size, method)
        assert config.light is not None
        self.gaussians = Gaussians.from_numpy(lit_arrays(count, config.light.features))
        self.light = LightModel.initial(config.light, TrainingFrame(np.zeros(3), 1.0, common.DISTANCE, 1.0), 0)
        camera = common.camera_from(DIRECTION, pixels)
        self.camera = Pinhole.of(upsampled_camera(camera, config.supersample))
        self.draw = partial(
            render_supersampled,
            camera=camera,
            times=config.supersample,
            colors=3,
            linear=config.light.curve is not None,
        )
        self.antialiased = config.antialiased
        dr.eval(self.gaussians.rows(), self.camera.values)

    def shadows(self) -> None:
        dr.eval(computed(partial(self.light.shadows, self.gaussians, next(NEW_SUNS))))

    def shade(self) -> None:
        """Shadows and field."""
        dr.eval(self.light.shade_picture(self.gaussians, self.camera, next(NEW_SUNS)))

    def frame(self) -> None:
        sun, antialiased = next(NEW_SUNS), self.antialiased
        output = self.draw(lambda camera: draw_lit(self.gaussians, self.light, camera, sun, antialiased=antialiased))
        dr.eval(output.features, output.alpha)


def main() -> None:
    parser = common.arguments(__doc__, "sizes", "repeats")
    parser.add_argument("--methods", default="relight,shadow-map,shadow-splat", help=f"of {', '.join(LIT)}")
    parser.add_argument(
        "--preset", default="thesis", help="whose networks, light images and supersampling (default thesis)"
    )
    parser.add_argument("--step-sizes", metavar="SIZES", help="of the training steps; 'none' leaves them out")
    options = parser.parse_args()
    name = backend.select(options.backend)
    methods = options.methods.split(",")
    unknown = [method for method in methods if method not in LIT]
    if unknown:
        sys.exit(f"--methods: expected some of {', '.join(LIT)}, found {unknown[0]!r}")
    frames = [
        measure_frame(count, pixels, method, options)
        for count, pixels in common.parse_sizes(options.sizes or SIZES[name])
        for method in methods
    ]
    steps = []
    if options.step_sizes != "none":
        sizes = common.parse_sizes(options.step_sizes or STEPS[name])
        steps = [measure_step(count, pixels, method, options) for count, pixels in sizes for method in methods]
    tables = {"Frames": frames, "Training steps, ms on the clock": steps}
    common.emit({"frames": frames, "steps": steps}, tables, options)


def measure_frame(count: int, pixels: int, method: str, options: Any) -> common.Row:
    frame = Frame(count, pixels, method, options.preset)
    works = {"frame": frame.frame, "shade": frame.shade}
    if method != "relight":
        works["shadows"] = frame.shadows
    clock = common.interleaved(works, options.repeats)
    kernels = common.kernels_in_turn(works)
    shadows = clock["shadows"].median if "shadows" in clock else 0.0
    row: common.Row = {"Gaussians": count, "pixels": pixels, "method": method, "ms (quartiles)": str(clock["frame"])}
    row |= {"frames/s": 1e3 / clock["frame"].median}
    if count in THESIS and pixels == 1024:
        row["of the thesis's"] = row["frames/s"] / THESIS[count]
    row |= {"shadows": shadows, "field": clock["shade"].median - shadows}
    row["draw"] = clock["frame"].median - clock["shade"].median
    return row | {f"{part}, kernels": times.milliseconds for part, times in kernels.items()}


def measure_step(count: int, pixels: int, method: str, options: Any) -> common.Row:
    with tempfile.TemporaryDirectory() as folder:
        data = synthetic.write_dataset(Path(folder) / "data", count, pixels)
        lit = [replace(frame, sun=Sun(SUNS[i])) for i, frame in enumerate(data.train)]
        config = preset(options.preset, method)
        assert config.light is not None
        arrays = lit_arrays(count, config.light.features)
        trainer = synthetic.still_trainer(replace(data, train=tuple(lit)), count, arrays, config)
        turn = common.IN_A_ROW if backend.select() == "cuda" else 1  # elsewhere the host has no time of its own
        clock = common.Timing.of(common.in_a_row({"": trainer.step}, options.repeats, turn, common.WARM_UP)[""])
        sums = common.kernels(lambda: dr.eval(trainer.step()))
    return {"Gaussians": count, "pixels": pixels, "method": method, "step (quartiles)": str(clock)} | {
        "kernels": sums.milliseconds,
        "launches": sums.launches,
    }


if __name__ == "__main__":
    common.run_main(main)
