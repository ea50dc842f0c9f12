"""How fast one frame is binned, blended and differentiated, and how that grows.

    python benchmarks/rasterizer.py [--sizes 31622x1024,165495x1024] [--peers gsplat,fastergs] [--markdown]
    python benchmarks/rasterizer.py --growth [--plot growth.svg]

The scene is a sphere of random splats that fills most of the picture, spherical harmonics of degree 3. Two times are
given. "On the clock": synchronised calls from Python, tracing and launching included; median and quartiles after
warm-up, ours and the peer's in turn. "Kernels": what the device alone needs, by Dr.Jit's kernel history; beside a peer
both by torch's profiler. "frame" is parameters to picture without gradients; forward and backward are blending and its
adjoint. `--growth` measures 10,000 to 1,000,000 Gaussians and 128 to 2048 pixels, prints the slope of time against
pairs of tile and splat, and draws it with `--plot`.
"""

import argparse
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from support import common, growth
from support.pipeline import Pipeline, arguments_of

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import write_bytes

STAGES = ("project", "bin", "forward", "backward", "frame")
DIRECTION = 4, 1, 1  #: of the camera from the sphere
SHARED = ("bin", "forward", "backward")  #: what is compared with gsplat's kernels
PEERS = ("gsplat", "fastergs")
SIZES = {"cuda": "31622x1024,101958x1024,165495x1024,1000000x1024", "llvm": "10000x256,30000x256,30000x512"}


def main() -> None:
    parser = common.arguments(__doc__, "sizes", "repeats")
    add_peers_option(parser)
    parser.add_argument("--growth", action="store_true", help="sizes that show how the time grows")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="draw time against pairs")
    options = parser.parse_args()
    name = backend.select(options.backend)
    sizes = common.parse_sizes(options.sizes or (growth.SIZES if options.growth else SIZES)[name])
    peers = load_peers(options.peers, name)
    results = [measure(count, pixels, options.repeats, peers) for count, pixels in sizes]
    for result in results if peers else []:  # once all clocks are read: an attached profiler slows launches down
        add_peer_kernels(result, peers)
    report: dict[str, Any] = {"rows": results}
    tables = {
        "On the clock, ms: median": [clock_row(r) for r in results],
        "Kernels, ms": [kernel_row(r) for r in results],
        "Beside peers, ms (ratio: ours / theirs)": [peer_row(r, name) for r in results for name in r["peers"]],
    }
    if options.growth or options.plot:
        points = [growth.Point(r["gaussians"], r["pixels"], r["pairs"], r["least kernels"]) for r in results]
        report["growth"] = growth.summary(points)
        tables["Growth of the kernels (project + bin + forward + backward, the least of several)"] = [report["growth"]]
    common.emit(report, tables, options)
    if options.plot:
        write_bytes(options.plot, growth.plot("project + bin + forward + backward, kernels", points).encode())


def add_peers_option(parser: argparse.ArgumentParser) -> None:
    """`--peers`, for `load_peers`."""
    parser.add_argument(
        "--peers", default="", help=f"of {', '.join(PEERS)}, commas between: measured in turn with ours"
    )


def load_peers(wanted: str, name: str) -> dict[str, Any]:
    """The modules by their names, without those that cannot be measured here. Raises InputError for no such peer."""
    names = [peer for peer in wanted.split(",") if peer]
    unknown = [peer for peer in names if peer not in PEERS]
    if unknown:
        raise InputError(f"--peers: expected some of {', '.join(PEERS)}, found {unknown[0]!r}")
    modules = {peer: load_peer(peer, name, f"support.peer_{peer}") for peer in names}
    return {peer: module for peer, module in modules.items() if module is not None}


def load_peer(wanted: str | None, name: str, module: str) -> Any:
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


def measure(count: int, pixels: int, repeats: int, peers: Mapping[str, Any]) -> dict[str, Any]:
    """Times of the stages for `count` Gaussians on pixels x pixels, and of the peers' in turn with them."""
    arrays, camera = common.sphere_arrays(count), common.camera_from(DIRECTION, pixels)
    ours = Pipeline(arrays, camera)
    works = {stage: getattr(ours, stage) for stage in STAGES}
    frames = {name: peer.Frame(arrays, camera) for name, peer in peers.items()}
    theirs = {name: stages_of(frame) for name, frame in frames.items()}
    times: dict[str, common.Timing] = {}
    for stage, work in works.items():  # a stage of ours in turn with the same stage of the peers'
        turn = {f"{name} {stage}": stages[stage] for name, stages in theirs.items() if stage in stages}
        times |= common.interleaved({stage: work, **turn}, repeats)
    kernels = common.kernels_in_turn(works)
    sums = {stage: kernel.milliseconds for stage, kernel in kernels.items()}
    result: dict[str, Any] = {"gaussians": count, "pixels": pixels, **arguments_of(ours)}
    result["clock"] = {stage: times[stage] for stage in STAGES}
    result["kernels"] = sums | {"sum": sum(sums[stage] for stage in STAGES if stage != "frame")}
    result["least kernels"] = sum(kernels[stage].least for stage in STAGES if stage != "frame")
    result["launches"] = {stage: kernel.launches for stage, kernel in kernels.items()}
    result["peers"] = {
        name: {"pairs": frame.pairs, "clock": {stage: times[f"{name} {stage}"] for stage in theirs[name]}}
        for name, frame in frames.items()
    }
    return result


def stages_of(frame: Any) -> dict[str, Any]:
    """What a peer's frame has of our stages."""
    return {"frame": frame.whole} | {stage: getattr(frame, stage) for stage in SHARED if hasattr(frame, stage)}


def add_peer_kernels(result: dict[str, Any], peers: Mapping[str, Any]) -> None:
    """What the peers' kernels and ours need for what `result` has measured on the clock, by one profiler, and the
    ratios of both. Dr.Jit's own times, in `result`, have the events about each launch in them."""
    from support.peer_torch import device_milliseconds

    inputs = common.sphere_arrays(result["gaussians"]), common.camera_from(DIRECTION, result["pixels"])
    ours = Pipeline(*inputs)
    for name, peer in peers.items():
        frame = peer.Frame(*inputs)
        theirs, works = result["peers"][name], stages_of(frame)
        theirs["kernels"] = {stage: device_milliseconds(work) for stage, work in works.items()}
        theirs["our kernels"] = {stage: device_milliseconds(getattr(ours, stage)) for stage in works}
        theirs["ratios"] = ratios(result, theirs)
        theirs["apart"] = apart(np.moveaxis(ours.frame().image("color"), -1, 0), frame.whole().cpu().numpy())


def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    """How far two pictures are apart [3, H, W], in 99.9 of 100 pixels at most: splats of all but one depth may change
    places in the others."""
    return float(np.quantile(np.abs(ours - theirs).max(axis=0), 0.999))


def ratios(ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, float]:
    """Ours over a peer's: a frame on the clock and by kernels; binning, forward and backward likewise."""
    quotients: dict[str, float] = {}
    for name, stages in (("frame", ("frame",)), ("bin + forward + backward", SHARED)):
        if not theirs["clock"].keys() >= set(stages):
            continue
        clocks = (sum(one["clock"][stage].median for stage in stages) for one in (ours, theirs))
        quotients[f"{name}, clock"] = next(clocks) / next(clocks)
        both = theirs["our kernels"], theirs["kernels"]
        if all(None not in kernels.values() for kernels in both):
            sums = (sum(kernels[stage] for stage in stages) for kernels in both)
            quotients[f"{name}, kernels"] = next(sums) / next(sums)
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


def peer_row(result: dict[str, Any], name: str) -> common.Row:
    """A frame on the clock, then the kernels of the stages, each ours / the peer's, and the ratios."""
    theirs = result["peers"][name]
    row: common.Row = {"Gaussians": result["gaussians"], "pixels": result["pixels"], "peer": name}
    row["frame"] = f"{result['clock']['frame']} / {theirs['clock']['frame']}"
    for stage in theirs["kernels"]:
        both = theirs["our kernels"][stage], theirs["kernels"][stage]
        row[f"{stage}, kernels"] = " / ".join("-" if time is None else f"{time:.2f}" for time in both)
    row |= {f"{what}, ratio": ratio for what, ratio in theirs["ratios"].items()}
    return row | {"pictures apart (99.9 %)": f"{theirs['apart']:.1g}"}


if __name__ == "__main__":
    common.run_main(main)
