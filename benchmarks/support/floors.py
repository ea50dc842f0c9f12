"""Where a step's time goes: the kernels of each stage beside what no program could undercut on this device.

The floor of a stage is the larger of two times: the bytes that must move over the bandwidth of a large copy, and the
operations that must be done over the rate of a loop of multiply-adds (exponentials over their own). All are measured
in turn, and the least of several counts. Bytes are compulsory ones: every input read once, every output written once.
Operations are counted for the method as it is: every pixel of a tile looks at each pair that the tile walks.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr

from spacesim.backend import ad, select
from support import common
from support.pipeline import Pipeline
from support.synthetic import still_trainer, write_dataset

FLOAT = 4
ROWS = 3 + 3 + 4 + 1 + 48  #: parameters of a Gaussian at SH 3
SPLAT = 7 + 3  #: ellipse, depth, colour
BOX = 2  #: of Footprints, beside a byte
STAGES = ("project", "bin", "forward", "loss", "backward", "update")
CHAINS, TURNS = 8, 512  #: enough to hide latency, few enough for registers
REPEATS = 15


@dataclass(frozen=True)
class Device:
    """Rates measured here: bytes a second of a large copy; multiply-adds and exponentials a second."""

    bandwidth: float
    operations: float
    specials: float

    def floor(self, bytes_: float, operations: float, specials: float) -> tuple[float, float]:
        """(ms by bytes, ms by operations). A GPU does the special ones beside the others, a CPU among them."""
        one, other = 1e3 * operations / self.operations, 1e3 * specials / self.specials
        return 1e3 * bytes_ / self.bandwidth, max(one, other) if select() == "cuda" else one + other


class Yardsticks:
    """Work whose amount is known."""

    def __init__(self) -> None:
        cuda = select() == "cuda"
        self.count, self.threads = (2**28, 2**21) if cuda else (2**26, 2**16)
        self.source = dr.opaque(ad.Float, 1, self.count)

    def works(self) -> dict[str, common.Work]:
        """What to measure."""
        return {
            "copy": lambda: dr.eval(self.source + 1),
            "operations": lambda: _turns(self.threads, lambda x: dr.fma(x, 0.999, 0.001)),
            "specials": lambda: _turns(self.threads, lambda x: dr.exp2(x - 1)),
        }

    def device(self, measured: dict[str, common.Kernels]) -> Device:
        """Rates from the times of `works`."""
        done = 1e3 * self.threads * CHAINS * TURNS
        bandwidth = 2e3 * FLOAT * self.count / measured["copy"].least
        return Device(bandwidth, done / measured["operations"].least, done / measured["specials"].least)


def _turns(threads: int, function: Callable[[Any], Any]) -> None:
    """CHAINS independent chains of TURNS calls in each thread."""
    start = dr.opaque(ad.Float, 0.5, threads)

    def goes_on(i: Any, _values: list[Any]) -> Any:
        return i < TURNS

    def turn(i: Any, values: list[Any]) -> Any:
        return i + 1, [function(value) for value in values]

    values = [start + k for k in range(CHAINS)]
    _, values = dr.while_loop((ad.UInt32(0), values), goes_on, turn, mode="symbolic", label="turns")
    dr.eval(sum(values[1:], values[0]))


def work(pipeline: Pipeline, count: int, pixels: int) -> dict[str, tuple[float, float, float]]:
    """{stage: (bytes, operations, exponentials)} that cannot be done without.

    Operations (a multiply-add is one) are counted where they could matter: a pixel's visit to a pair takes 11 and an
    exponential, its adjoint 30 and one; SSIM takes seven separable blurs of 2 x 11 for each channel, and 30 beside.
    """
    plane = pixels * pixels
    lists = pipeline.lists
    visits = pipeline.blended_pairs * lists.shape.width * lists.shape.height
    listed = 2 * FLOAT * lists.pairs + 2 * FLOAT * lists.tiles_x * lists.tiles_y
    picture = 4 * FLOAT * plane
    return {
        "project": (count * (FLOAT * (ROWS + SPLAT + BOX) + 1), 0, 0),
        "bin": (count * (FLOAT * (7 + BOX) + 1) + listed, 0, 0),
        "forward": (count * FLOAT * 9 + FLOAT * lists.pairs + picture, 11 * visits, visits),
        "loss": (2 * picture + 3 * FLOAT * plane, 3 * plane * (7 * 22 + 30), 0),
        "backward": (count * FLOAT * (9 + 11) + FLOAT * lists.pairs + picture, 30 * visits, visits),
        "update": (count * FLOAT * (6 * ROWS + 9), 0, 0),
    }


def profiles(sizes: list[tuple[int, int]], repeats: int) -> tuple[dict[str, Any], dict[str, list[common.Row]]]:
    """(report, tables): one table for each size. repeats: of each work, REPEATS at most."""
    report, tables = [], {}
    for count, pixels in sizes:
        device, rows = profile(count, pixels, min(repeats, REPEATS))
        report.append({"gaussians": count, "pixels": pixels, "device": device, "rows": rows})
        speeds = f"{device.bandwidth / 1e9:.0f} GB/s, {device.operations / 1e9:.0f} G multiply-adds/s"
        speeds += f", {device.specials / 1e9:.0f} G exponentials/s"
        tables[f"{count:,} Gaussians, {pixels} x {pixels} pixels ({speeds})"] = rows
    return {"profiles": report}, tables


def profile(count: int, pixels: int, repeats: int) -> tuple[Device, list[common.Row]]:
    """Rates of the device; a row for each stage, one for the rest of the trainer's step, and the whole."""
    arrays, yardsticks = common.sphere_arrays(count), Yardsticks()
    with tempfile.TemporaryDirectory() as folder:
        dataset = write_dataset(Path(folder) / "data", count, pixels)
        trainer, pipeline = still_trainer(dataset, count, arrays), Pipeline(arrays, dataset.train[0].camera)
        for _ in range(20):
            trainer.step()
        works = yardsticks.works() | {"step": trainer.step} | {stage: getattr(pipeline, stage) for stage in STAGES}
        measured = common.kernels_in_turn(works, repeats)
        clock = common.interleaved({"step": trainer.step}, repeats)["step"]
    device, whole, needs = yardsticks.device(measured), measured["step"], work(pipeline, count, pixels)
    stages = [_row(stage, measured[stage], whole, *device.floor(*needs[stage])) for stage in STAGES]
    launches, total = (sum(row[key] for row in stages) for key in ("launches", "ms"))
    floor = sum(max(row["floor by bytes, ms"], row["floor by operations, ms"]) for row in stages)
    rest = {"stage": "rest", "launches": whole.launches - launches}
    rest |= {"ms": whole.least - total, "of the step": f"{1 - total / whole.least:.0%}"}
    step = {"stage": "trainer's step, kernels", "launches": whole.launches, "ms": whole.least}
    step |= {"of the step": "100%", "floor / time": f"{floor / whole.least:.0%}"}
    return device, [*stages, rest, step, {"stage": "trainer's step, on the clock (median)", "ms": clock.median}]


def _row(
    stage: str, kernels: common.Kernels, whole: common.Kernels, by_bytes: float, by_operations: float
) -> common.Row:
    return {
        "stage": stage,
        "launches": kernels.launches,
        "ms": kernels.least,
        "of the step": f"{kernels.least / whole.least:.0%}",
        "floor by bytes, ms": by_bytes,
        "floor by operations, ms": by_operations,
        "floor / time": f"{max(by_bytes, by_operations) / kernels.least:.0%}",
    }
