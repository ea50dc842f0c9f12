"""How long a training step takes, beside gsplat or OpenSplat; where its time goes; what it holds and records.

    python benchmarks/training.py [--sizes 31622x1024] [--peers gsplat,fastergs] [--opensplat PATH] [--markdown]
    python benchmarks/training.py --growth [--plot step.svg]
    python benchmarks/training.py --profile [--sizes 31622x1024]
    python benchmarks/training.py --memory
    python benchmarks/training.py --steps 10000

A step is the trainer's own: rasterization with spherical harmonics of degree 3, L1 + D-SSIM, gradients,
Adam over all parameters, statistics; refinement is off and step sizes are 1e-12, so that every step has the same work.
Ours and the peers' take turns, 20 steps in a row each, as in training; medians and quartiles of a step after warm-up.
gsplat's is its rasterizer, SSIM by torch's conv2d (and by fused_ssim where that is installed), torch's Adam (plain and
fused); Faster-GS's its rasterizer, fused_ssim and its Adam; their pictures are on the device already. OpenSplat is a
binary given by path, run on the same pictures from the same points, as ours in that row.

`--profile`: time of each stage's kernels beside the physical floor. `--memory`: bytes a Gaussian, by Dr.Jit's own
count of what it has allocated at most. `--steps N`: training with refinement; recordings, kernels, memory at ten marks.
"""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rasterizer import add_peers_option, load_peers
from support import common, counters, floors, growth, peer_opensplat
from support.pipeline import SSIM_WEIGHT, Pipeline
from support.synthetic import NEVER, STILL, still_trainer, write_dataset

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import write_bytes
from spacesim.data.images import load_image

MEMORY_SIZES = "16384x64,16385x64,20000x64,21846x64,30000x64,32769x64,43691x64,65537x64,87382x64,131073x64,200000x64"
"""A power of two; just above one and above 4/3 of one, where a Gaussian takes most; others."""
SIZES = {"cuda": "31622x1024,101958x1024,165495x1024,1000000x1024", "llvm": "30000x256"}
ROUNDS = 3  #: of ours and OpenSplat in turn
RATES = dict.fromkeys(("means", "log_scales", "quaternions", "logit_opacities", "sh0", "shN"), STILL.means)


def main() -> None:
    parser = common.arguments(__doc__, "sizes", "repeats")
    add_peers_option(parser)
    parser.add_argument("--opensplat", type=Path, metavar="PATH", help="OpenSplat's binary, run on the CPU")
    parser.add_argument("--growth", action="store_true", help="sizes that show how the time grows")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="draw time against pairs")
    parser.add_argument("--profile", action="store_true", help="stages beside the physical floor")
    parser.add_argument("--memory", action="store_true", help="bytes a Gaussian")
    parser.add_argument("--steps", type=int, metavar="N", help="counters over N steps with refinement")
    options = parser.parse_args()
    if options.steps is not None and options.steps < counters.MIN_STEPS:
        raise InputError(f"--steps: expected at least {counters.MIN_STEPS}, found {options.steps}")
    if options.opensplat and not options.opensplat.is_file():
        raise InputError(f"--opensplat: expected OpenSplat's binary, found no file {options.opensplat}")
    name = backend.select(options.backend)
    usual = MEMORY_SIZES if options.memory else (growth.SIZES if options.growth else SIZES)[name]
    sizes = common.parse_sizes(options.sizes or usual)
    if options.steps is not None:
        rows = counters.over_steps(options.steps)
        return common.emit({"steps": rows}, {"Training with refinement, 64 x 64 pixels": rows}, options)
    if options.memory:
        rows = [counters.memory(count, pixels) for count, pixels in sizes]
        return common.emit({"memory": rows}, {"Memory of training at SH 3": rows}, options)
    if options.profile:
        report, tables = floors.profiles(sizes, options.repeats)
        return common.emit(report, tables, options)
    peers = load_peers(options.peers, name)
    results = [measure(count, pixels, options.repeats, peers) for count, pixels in sizes]
    report = {"rows": results}
    tables = {"A training step, ms: median (quartiles)": [row for result in results for row in describe(result)]}
    if options.opensplat or (name == "llvm" and not options.growth):
        rows = [beside_opensplat(*size, options.repeats, options.opensplat) for size in sizes[:1]]
        report["opensplat"] = rows
        tables["Beside OpenSplat's CPU mode, from the same points, ms a step"] = rows
    if options.growth or options.plot:
        points = [growth.Point(r["gaussians"], r["pixels"], r["pairs"], r["clock"]["spacesim"].least) for r in results]
        report["growth"] = growth.summary(points)
        tables["Growth of the step on the clock, the least of several"] = [report["growth"]]
    common.emit(report, tables, options)
    if options.plot:
        write_bytes(options.plot, growth.plot("training step on the clock", points).encode())


def measure(count: int, pixels: int, repeats: int, peers: Mapping[str, Any]) -> dict[str, Any]:
    """Times of a step of ours and of the peers' ways to make one."""
    arrays = common.sphere_arrays(count)
    with tempfile.TemporaryDirectory() as folder:
        dataset = write_dataset(Path(folder) / "data", count, pixels)
        trainer = still_trainer(dataset, count, arrays)
        works: dict[str, Callable[[], Any]] = {"spacesim": trainer.step}
        views = [(frame.camera, load_image(dataset, frame).rgb) for frame in dataset.train] if peers else []
        for name, peer in peers.items():
            steps = peer.steps((arrays, views, RATES, SSIM_WEIGHT))
            works |= {f"{name}, {label}": step for label, step in steps.items()}
        times = {label: common.Timing.of(seconds) for label, seconds in common.in_a_row(works, repeats).items()}
        kernels = common.kernels(trainer.step)
    if trainer.gaussians.count != count or trainer.iteration >= NEVER:
        raise AssertionError("a step of the benchmark has refined")
    pairs = Pipeline(arrays, dataset.train[0].camera).lists.pairs
    result: dict[str, Any] = {"gaussians": count, "pixels": pixels, "pairs": pairs, "clock": times}
    result |= {"kernels": kernels.milliseconds, "launches": kernels.launches}
    result["ratios"] = {k: times["spacesim"].median / t.median for k, t in times.items() if k != "spacesim"}
    return result


def describe(result: dict[str, Any]) -> list[common.Row]:
    """A line for each program."""
    rows: list[common.Row] = []
    for program, timing in result["clock"].items():
        row: common.Row = {"Gaussians": result["gaussians"], "pixels": result["pixels"], "program": program}
        row["a step"] = timing
        row["kernels"] = result["kernels"] if program == "spacesim" else ""
        row["ours / theirs"] = result["ratios"].get(program, "")
        rows.append(row)
    return rows


def beside_opensplat(count: int, pixels: int, repeats: int, binary: Path | None) -> common.Row:
    """Our step from points, as OpenSplat starts, and OpenSplat's in turn with it, where its binary is given."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = write_dataset(Path(folder) / "data", count, pixels)
        trainer = still_trainer(dataset, count)
        ours, pairs = list[float](), list[tuple[float, float]]()
        for _ in range(ROUNDS):
            ours += common.in_a_row({"spacesim": trainer.step}, -(-repeats // ROUNDS))["spacesim"]
            if binary is not None:
                pairs.append(peer_opensplat.run_pair(binary, dataset))
    row: common.Row = {"Gaussians": count, "pixels": pixels, "spacesim": common.Timing.of(ours)}
    if binary is None:
        return row | {"OpenSplat": "not measured here: needs the binary", "ours / theirs": "-"}
    peer = common.Timing.of(peer_opensplat.seconds_a_step(pairs))
    return row | {"OpenSplat": peer, "ours / theirs": row["spacesim"].median / peer.median}


if __name__ == "__main__":
    common.run_main(main)
