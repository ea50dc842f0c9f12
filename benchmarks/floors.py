"""Where a step's time goes: the kernels of each stage beside what no program could undercut on this device.

The floor of a stage is the larger of two times: the bytes that must move over the bandwidth of a large copy, and the
operations that must be done over the rate of a loop of multiply-adds (exponentials over their own), all measured in
the same run, the best of several. Bytes are compulsory ones: every input read once, every output written once.
Operations are counted for the method as it is: every pixel of a tile looks at each pair that the tile walks.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import drjit as dr
from pipeline import Pipeline
from synthetic import still_trainer, write_dataset

from spacesim.backend import ad, select

FLOAT = 4
ROWS = 3 + 3 + 4 + 1 + 48  #: parameters of a Gaussian at SH 3
SPLAT = 7 + 3  #: ellipse, depth, colour
BOX = 2  #: of Footprints, beside a byte
STAGES = ("project", "bin", "forward", "loss", "backward", "update")
CHAINS, TURNS = 8, 512  #: chosen: enough to hide latency, few enough for registers
REPEATS = 15


@dataclass(frozen=True)
class Device:
    """Rates measured here: bytes a second of a large copy; multiply-adds and exponentials a second."""

    bandwidth: float
    operations: float
    specials: float

    @staticmethod
    def measured() -> "Device":
        cuda = select() == "cuda"
        count = 2**28 if cuda else 2**26
        source = dr.opaque(ad.Float, 1, count)
        copy = common.kernels(lambda: dr.eval(source + 1), REPEATS).least
        lanes = 2**21 if cuda else 2**16
        done = lanes * CHAINS * TURNS
        fma = common.kernels(lambda: _turns(lanes, lambda x: dr.fma(x, 0.999, 0.001)), REPEATS).least
        exp = common.kernels(lambda: _turns(lanes, lambda x: dr.exp2(x - 1)), REPEATS).least
        return Device(2e3 * FLOAT * count / copy, 1e3 * done / fma, 1e3 * done / exp)

    def floor(self, bytes_: float, operations: float, specials: float) -> tuple[float, float]:
        """(ms by bytes, ms by operations). A GPU does the special ones beside the others, a CPU among them."""
        one, other = 1e3 * operations / self.operations, 1e3 * specials / self.specials
        return 1e3 * bytes_ / self.bandwidth, max(one, other) if select() == "cuda" else one + other


def _turns(lanes: int, function: Callable[[Any], Any]) -> None:
    """CHAINS independent chains of TURNS calls in each lane."""
    start = dr.opaque(ad.Float, 0.5, lanes)

    def turn(i: Any, values: list[Any]) -> Any:
        return i + 1, [function(value) for value in values]

    values = [start + k for k in range(CHAINS)]
    _, values = dr.while_loop((ad.UInt32(0), values), lambda i, _: i < TURNS, turn, mode="symbolic", label="turns")
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


def profiles(sizes: list[tuple[int, int]]) -> tuple[dict[str, Any], dict[str, list[common.Row]]]:
    """(report, tables): one table for each size."""
    device = Device.measured()
    told = f"{device.bandwidth / 1e9:.0f} GB/s, {device.operations / 1e9:.0f} G multiply-adds/s"
    told += f", {device.specials / 1e9:.0f} G exponentials/s"
    tables, rows = {}, {}
    for count, pixels in sizes:
        found = profile(count, pixels, device)
        rows[f"{count}x{pixels}"] = found
        tables[f"{count:,} Gaussians, {pixels} x {pixels} pixels ({told})"] = found
    return {"device": device, "profiles": rows}, tables


def profile(count: int, pixels: int, device: Device) -> list[common.Row]:
    """A row for each stage, the rest of the trainer's step, and the whole."""
    arrays = common.sphere_arrays(count)
    with tempfile.TemporaryDirectory() as folder:
        dataset = write_dataset(Path(folder) / "data", count, pixels)
        trainer = still_trainer(dataset, arrays)
        for _ in range(20):
            trainer.step()
        whole = common.kernels(trainer.step)
        clock = common.interleaved({"step": trainer.step}, 15)["step"]
    pipeline = Pipeline(arrays, dataset.train[0].camera)
    needs = work(pipeline, count, pixels)
    rows, launches, total, floors = [], 0, 0.0, 0.0
    for stage in STAGES:
        found = common.kernels(getattr(pipeline, stage))
        by_bytes, by_operations = device.floor(*needs[stage])
        floor = max(by_bytes, by_operations)
        launches, total, floors = launches + found.launches, total + found.milliseconds, floors + floor
        rows.append(
            {
                "stage": stage,
                "launches": found.launches,
                "ms": found.milliseconds,
                "of the step": f"{found.milliseconds / whole.milliseconds:.0%}",
                "floor by bytes, ms": by_bytes,
                "floor by operations, ms": by_operations,
                "floor / time": f"{floor / found.milliseconds:.0%}",
            }
        )
    rest = {"stage": "rest (upload, statistics)", "launches": whole.launches - launches}
    rest |= {"ms": whole.milliseconds - total, "of the step": f"{1 - total / whole.milliseconds:.0%}"}
    step = {"stage": "trainer's step, kernels", "launches": whole.launches, "ms": whole.milliseconds}
    step |= {"of the step": "100%", "floor / time": f"{floors / whole.milliseconds:.0%}"}
    return [*rows, rest, step, {"stage": "trainer's step, on the clock", "ms": clock.median}]
