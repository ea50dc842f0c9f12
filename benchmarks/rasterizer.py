"""How fast one frame is binned, blended and differentiated, and how that grows.

    python benchmarks/rasterizer.py [--sizes 31622x1024,165495x1024] [--peers gsplat] [--markdown] [--json FILE]
    python benchmarks/rasterizer.py --growth [--plot growth.svg]

The scene is a sphere of random splats that fills most of the picture, spherical harmonics of degree 3. Two times are
given. "On the clock": synchronised calls from Python, tracing and launching included; median and quartiles after
warm-up, ours and the peer's in turn. "Kernels": what the device alone needs, by Dr.Jit's kernel history and torch's
profiler. "frame" is parameters to picture without gradients; forward and backward are blending and its adjoint.
`--growth` measures 10,000 to 1,000,000 Gaussians and 128 to 2048 pixels, prints the slope of time against pairs of tile
and splat, and draws it with `--plot`.
"""

import importlib
import sys
from pathlib import Path
from typing import Any

from support import common, growth
from support.pipeline import Pipeline, arguments_of

from spacesim import backend
from spacesim.data.files import write_bytes

STAGES = ("project", "bin", "forward", "backward", "frame")
DIRECTION = 4, 1, 1  #: of the camera from the sphere
SHARED = ("bin", "forward", "backward")  #: what is compared with gsplat's kernels
SIZES = {"cuda": "31622x1024,101958x1024,165495x1024,1000000x1024", "llvm": "10000x256,30000x256,30000x512"}


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--peers", choices=["gsplat"], help="measured in turn with ours; needs CUDA, torch, gsplat")
    parser.add_argument("--growth", action="store_true", help="sizes that show how the time grows")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="draw time against pairs")
    options = parser.parse_args()
    name = backend.select(options.backend)
    sizes = common.parse_sizes(options.sizes or (growth.SIZES if options.growth else SIZES)[name])
    peer = load_peer(options.peers, name)
    results = [measure(count, pixels, options.repeats, peer) for count, pixels in sizes]
    if peer is not None:  # once all clocks are read: a profiler that was attached slows launches down
        for result in results:
            add_peer_kernels(result, peer)
    report: dict[str, Any] = {"rows": results}
    tables = {
        "On the clock, ms: median": [clock_row(r) for r in results],
        "Kernels, ms": [kernel_row(r) for r in results],
        "Beside gsplat, ms (ratio: ours / gsplat's)": [peer_row(r) for r in results if "gsplat" in r],
    }
    if options.growth or options.plot:
        points = [growth.Point(r["gaussians"], r["pixels"], r["pairs"], r["least kernels"]) for r in results]
        report["growth"] = growth.summary(points)
        tables["Growth of the kernels (project + bin + forward + backward, the least of several)"] = [report["growth"]]
    common.emit(report, tables, options)
    if options.plot:
        write_bytes(options.plot, growth.plot("project + bin + forward + backward, kernels", points).encode())


def load_peer(wanted: str | None, name: str, module: str = "support.peer_gsplat") -> Any:
    """The module, or None with a line that says why it is not measured."""
    if wanted is None:
        return None
    try:
        if name != "cuda":
            raise ImportError(f"{wanted} runs on CUDA alone")
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: compiled for another device
        print(f"{wanted}: not measured here ({error})", file=sys.stderr)
        return None


def measure(count: int, pixels: int, repeats: int, peer: Any) -> dict[str, Any]:
    """Times of the stages for `count` Gaussians on pixels x pixels, and of the peer's in turn with them."""
    arrays, camera = common.sphere_arrays(count), common.camera_from(DIRECTION, pixels)
    ours = Pipeline(arrays, camera)
    works = {stage: getattr(ours, stage) for stage in STAGES}
    theirs: dict[str, Any] = {}
    if peer is not None:
        frame = peer.Frame(arrays, camera)
        theirs = {"frame": frame.whole} | {stage: getattr(frame, stage) for stage in SHARED}
    times: dict[str, common.Timing] = {}
    for stage, work in works.items():  # a stage of ours in turn with the same stage of the peer's
        turn = {stage: work} | ({f"gsplat {stage}": theirs[stage]} if stage in theirs else {})
        times |= common.interleaved(turn, repeats)
    kernels = common.kernels_in_turn(works)
    sums = {stage: kernel.milliseconds for stage, kernel in kernels.items()}
    result: dict[str, Any] = {"gaussians": count, "pixels": pixels, **arguments_of(ours)}
    result["clock"] = {stage: times[stage] for stage in STAGES}
    result["kernels"] = sums | {"sum": sum(sums[stage] for stage in STAGES if stage != "frame")}
    result["least kernels"] = sum(kernels[stage].least for stage in STAGES if stage != "frame")
    result["launches"] = {stage: kernel.launches for stage, kernel in kernels.items()}
    if theirs:
        clock = {stage: times[f"gsplat {stage}"] for stage in theirs}
        result["gsplat"] = {"pairs": frame.pairs, "clock": clock}
    return result


def add_peer_kernels(result: dict[str, Any], peer: Any) -> None:
    """What gsplat's kernels need for what `result` has measured on the clock, and the ratios of both."""
    frame = peer.Frame(common.sphere_arrays(result["gaussians"]), common.camera_from(DIRECTION, result["pixels"]))
    works = {"frame": frame.whole} | {stage: getattr(frame, stage) for stage in SHARED}
    result["gsplat"]["kernels"] = {stage: peer.device_milliseconds(work) for stage, work in works.items()}
    result["ratios"] = ratios(result)


def ratios(result: dict[str, Any]) -> dict[str, float | None]:
    """Ours over gsplat's: a frame on the clock and by kernels; binning, forward and backward likewise."""
    ours, theirs = result, result["gsplat"]
    quotients: dict[str, float | None] = {
        "frame, clock": ours["clock"]["frame"].median / theirs["clock"]["frame"].median,
        "bin + forward + backward, clock": sum(ours["clock"][s].median for s in SHARED)
        / sum(theirs["clock"][s].median for s in SHARED),
    }
    device = theirs["kernels"]
    if None not in device.values():
        quotients["frame, kernels"] = ours["kernels"]["frame"] / device["frame"]
        sums = sum(ours["kernels"][s] for s in SHARED), sum(device[s] for s in SHARED)
        quotients["bin + forward + backward, kernels"] = sums[0] / sums[1]
    return quotients


def clock_row(result: dict[str, Any]) -> common.Row:
    row: common.Row = {"Gaussians": result["gaussians"], "pixels": result["pixels"], "pairs": result["pairs"]}
    row |= {stage: result["clock"][stage].median for stage in STAGES[:-1]}
    return row | {"frame (quartiles)": result["clock"]["frame"]}


def kernel_row(result: dict[str, Any]) -> common.Row:
    row: common.Row = {"Gaussians": result["gaussians"], "pixels": result["pixels"], "pairs": result["pairs"]}
    row |= {stage: result["kernels"][stage] for stage in STAGES[:-1]}
    row |= {"sum": result["kernels"]["sum"], "ns a pair": 1e6 * result["kernels"]["sum"] / result["pairs"]}
    return row | {"frame": result["kernels"]["frame"]}


def peer_row(result: dict[str, Any]) -> common.Row:
    """A frame on the clock, then the kernels of the stages, each ours / gsplat's."""
    theirs = result["gsplat"]
    row: common.Row = {"Gaussians": result["gaussians"], "pixels": result["pixels"]}
    row["frame"] = f"{result['clock']['frame']} / {theirs['clock']['frame']}"
    row["frame, ratio"] = result["ratios"]["frame, clock"]
    for stage in (*SHARED, "frame"):
        other = theirs["kernels"][stage]
        text = "-" if other is None else f"{other:.2f}"
        row[f"{stage}, kernels"] = f"{result['kernels'][stage]:.2f} / {text}"
    row["b + f + b, kernels, ratio"] = result["ratios"].get("bin + forward + backward, kernels", "-")
    row["b + f + b, clock, ratio"] = result["ratios"]["bin + forward + backward, clock"]
    return row


if __name__ == "__main__":
    common.run_main(main)
