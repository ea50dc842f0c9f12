"""What a training step gains where the host does not wait for the length of the tile lists.

    python benchmarks/async_lists.py [--sizes 31622x1024] [--methods vanilla,shadow-map] [--preset thesis] [--markdown]

The same trainer takes steps with tile lists made asynchronously and with a wait in each, in turn. "in a row": as
training does, 20 steps between two waits of the benchmark's own; "alone": one. "host": until the host has launched a
step's work, in a row. Steps move and refine nothing. "again" counts steps whose lists were too small.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from light import SUNS
from support import common
from support.synthetic import still_trainer, write_dataset

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.records import Sun
from spacesim.splat.train.async_lists import TrainingPairs
from spacesim.splat.train.config import METHODS, preset
from spacesim.splat.train.trainer import Trainer

IN_A_ROW = 20  #: steps
WARM_UP = 4  #: times as many: every view has been seen twice, and most again
SIZES = {"cuda": "31622x1024,101958x1024,165495x1024", "llvm": "3000x64"}


class Counted(TrainingPairs):
    """Counts steps whose lists were too small."""

    again = 0

    def all_fit(self) -> bool:
        fits = super().all_fit()
        self.again += not fits
        return fits


def main() -> None:
    parser = common.arguments(__doc__, "sizes", "repeats")
    parser.add_argument("--methods", default="vanilla", help=f"of {', '.join(METHODS)}")
    parser.add_argument("--preset", default="thesis", help="whose networks and light images (default thesis)")
    options = parser.parse_args()
    name, methods = backend.select(options.backend), options.methods.split(",")
    unknown = [method for method in methods if method not in METHODS]
    if unknown:
        raise InputError(f"--methods: expected some of {', '.join(METHODS)}, found {unknown[0]!r}")
    sizes = common.parse_sizes(options.sizes or SIZES[name])
    rows = [measure(*size, method, name, options) for size in sizes for method in methods]
    common.emit({"rows": rows}, {"A training step, ms: median (quartiles)": rows}, options)


def measure(count: int, pixels: int, method: str, name: str, options: Any) -> common.Row:
    """Of both ways."""
    ways = {"wait": Counted(()), "async": Counted((name,))}
    if not ways["async"].is_async:
        raise InputError("this Dr.Jit cannot copy numbers to the host while the device goes on")
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder), count, pixels, method, options.preset)
        for lists in ways.values():
            steps(trainer, lists, WARM_UP * IN_A_ROW)
        seconds: dict[str, list[tuple[float, float, float]]] = {way: [] for way in ways}
        for turn in range(options.repeats):
            for way in list(ways)[:: 1 if turn % 2 else -1]:
                in_a_row, host = steps(trainer, ways[way], IN_A_ROW)
                seconds[way].append((in_a_row, host, steps(trainer, ways[way], 1)[0]))
        kernels = common.kernels(trainer.step)
    row: common.Row = {"Gaussians": count, "pixels": pixels, "method": method}
    for number, what in enumerate(("in a row", "host", "alone")):
        timings = {way: common.Timing.of(values[number] for values in seconds[way]) for way in ways}
        row |= {f"{what}, {way}": str(timing) for way, timing in timings.items()}
        row[f"{what}, async / wait"] = timings["async"].median / timings["wait"].median
    return row | {"kernels": kernels.milliseconds, "launches": kernels.launches, "again": ways["async"].again}


def steps(trainer: Trainer, lists: TrainingPairs, count: int) -> tuple[float, float]:
    """Seconds a step, all in all and of the host."""
    trainer._view_pass.pairs = lists
    common.synchronise()
    start = time.perf_counter()
    for _ in range(count):
        trainer.step()
    launched = time.perf_counter()
    common.synchronise()
    return (time.perf_counter() - start) / count, (launched - start) / count


def make_trainer(folder: Path, count: int, pixels: int, method: str, size: str) -> Trainer:
    """On a sphere of splats, each view under a Sun of its own."""
    data = write_dataset(folder / "data", count, pixels)
    if method == "vanilla":
        return still_trainer(data, count, common.sphere_arrays(count))
    lit = [replace(frame, sun=Sun(SUNS[i])) for i, frame in enumerate(data.train)]
    return still_trainer(replace(data, train=tuple(lit)), count, base=preset(size, method))


if __name__ == "__main__":
    common.run_main(main)
