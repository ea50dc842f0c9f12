"""Trains with every strategy on one dataset and compares pictures, shapes and sizes; follows where random starts go.

    python benchmarks/strategies.py --out RUNS [--data DATA] [--method shadow-map] [--preset fast] [--iterations N]
                                    [--rows thesis,field,ours,start,figure] [--plot FILE.svg] [--json]

Without DATA it makes one first: boxsat, 8 Suns x 40 views of 256 pixels, judged under them. Prints what tables 5.4 to
5.6 of the thesis have, with its own figures beside (its boxsat, 100,000 pictures, 200,000 iterations), and the share of
the training time that refinement takes. Rows:

    thesis   default, mesh-aware, support-aware
    field    mcmc
    ours     default that prunes below an opacity of 0.005 only, with discs, with depth and normals of the truth or of
             the mesh; other margins and thresholds
    start    support-aware from the mesh, at random in a box of ten times the object's size, and there with a warm start
    figure   figure 5.5: the share of Gaussians inside the true mesh over the first steps, without refinement

or the names of single rows. What is trained already is not trained again: an interrupted call goes on where it stopped.
Every run's report is in RUNS/NAME/eval, the figure's numbers are in RUNS/figure.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np

from spacesim import backend
from spacesim.data.errors import WorkError
from spacesim.data.files import read_json, write_bytes, write_json
from spacesim.data.mesh import SignedDistance
from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import evaluate
from spacesim.eval.report.charts import line_chart
from spacesim.eval.report.write import write_report
from spacesim.progress import reporting, tell_training
from spacesim.splat.train.config import METHODS, TrainConfig, preset, with_options
from spacesim.splat.train.config import warm_start as warm_start_of
from spacesim.splat.train.prior import known_mesh
from spacesim.splat.train.strategies.default import DefaultStrategyConfig
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.warm_start import WarmStartConfig

SCENE = {"views": 40, "test_suns": 0, "test_views": 5, "spp": 64, "test_spp": 1024}
KINDS = ("thesis", "field", "ours", "start", "figure")
BOX = 10.0  #: sizes of the object
NEVER = 10**9
SCHEDULE = 200_000  #: iterations of the thesis, over which the figure's step sizes fall
CURVES = ("nominal", "warm start", "warm start, as the thesis")
COLOURS = ("#5a6472", "#b9560f", "#2a66ad")

THESIS: dict[str, dict[str, float]] = {
    "default": {"MAE": 0.0071, "PSNR": 36.3851, "SSIM": 0.9833, "LPIPS": 0.0451}
    | {"Chamfer": 1.0391e-3, "Hausdorff": 0.0500, "IoU": 0.8643, "Gaussians": 31_622, "MB": 66.26, "FPS": 108},
    "mesh-aware": {"MAE": 0.0068, "PSNR": 36.8452, "SSIM": 0.9840, "LPIPS": 0.0438}
    | {"Chamfer": 1.0941e-3, "Hausdorff": 0.0433, "IoU": 0.8611, "Gaussians": 101_958, "MB": 189.69, "FPS": 77},
    "support-aware": {"MAE": 0.0068, "PSNR": 36.8906, "SSIM": 0.9840, "LPIPS": 0.0432}
    | {"Chamfer": 1.1112e-3, "Hausdorff": 0.0472, "IoU": 0.8627, "Gaussians": 165_495, "MB": 301.18, "FPS": 70},
}
"""Tables 5.4, 5.5 and 5.6."""

PICTURES = {"MAE": "mae", "PSNR": "psnr", "SSIM": "ssim", "LPIPS": "lpips"}
DIGITS = {"PSNR": 2, "Chamfer": 6, "normals [deg]": 1}


def main() -> None:
    options = arguments().parse_args()
    backend.select(options.backend)
    table = {name: (kind, config) for kind in KINDS[:-1] for name, config in configurations(kind, options)}
    wanted = common.row_names(options.rows)
    unknown = [name for name in wanted if name not in (*KINDS, *table)]
    if unknown:
        sys.exit(f"--rows: expected some of {'; '.join((*KINDS, *table))}, found {unknown[0]!r}")
    dataset = read_dataset(options.data or make_data(options))
    chosen = {name: config for name, (kind, config) in table.items() if kind in wanted or name in wanted}
    results = {name: measure(name, config, dataset, options.out) for name, config in chosen.items()}
    judged = [options.out / folder_of(name) / "eval" for name, found in results.items() if "note" not in found]
    if judged:
        write_report(judged, options.out / "report.html")
    curves = figure(dataset, options) if "figure" in wanted else {}
    if options.plot and curves:
        write_bytes(options.plot, plot(curves).encode())
    tables = tables_of(results, curves)
    common.emit({"rows": tables, "curves": curves, "data": str(dataset.root)}, tables, options)


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--data", type=Path, help="a dataset with mesh.ply; without it one is made in RUNS/data")
    parser.add_argument("--suns", type=int, default=8, help="of the dataset that is made (8)")
    parser.add_argument("--resolution", type=int, default=256, metavar="PX", help="of the dataset that is made (256)")
    parser.add_argument("--out", type=Path, required=True, metavar="RUNS")
    parser.add_argument("--method", choices=METHODS, default="shadow-map")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, metavar="N", help="of the rows (the preset's)")
    parser.add_argument("--mcmc-gaussians", type=int, default=60_000, metavar="N", help="most of mcmc (60,000)")
    parser.add_argument("--start-gaussians", type=int, default=100_000, metavar="N", help="of random starts (100,000)")
    parser.add_argument("--figure-steps", type=int, default=5_000, metavar="N", help="of figure 5.5 (5,000)")
    parser.add_argument("--rows", default=",".join(KINDS), help=f"of {','.join(KINDS)}, or names of single rows")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="figure 5.5")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", nargs="?", const=Path("-"), type=Path, metavar="FILE")
    return parser


def configurations(kind: str, options: argparse.Namespace) -> Iterator[tuple[str, TrainConfig]]:
    """(name, configuration) of the rows of a kind."""

    def made(strategy: str = "default", **changes: Any) -> TrainConfig:
        config = preset(options.preset, options.method, strategy)
        return with_options(config, iterations=options.iterations, **changes)

    if kind == "thesis":
        for strategy in ("default", "mesh-aware", "support-aware"):
            yield strategy, made(strategy)
    if kind == "field":
        most = made().refinement
        yield "mcmc", made("mcmc", refinement=replace(most, max_gaussians=options.mcmc_gaussians))
    if kind == "ours":
        yield "default, faint kept", made(refinement=replace(made().refinement, prune_opacity=0.005))
        yield "default, discs", made(flatten_weight=1.0)
        yield "default, depth and normals", made(depth_weight=3.0, normal_weight=0.05)
        yield "default, mesh prior", made(depth_weight=3.0, normal_weight=0.05, prior="mesh")
        mesh_aware, support = made("mesh-aware").mesh_aware, made("support-aware").support_aware
        yield "mesh-aware, narrow margin", made("mesh-aware", mesh_aware=replace(mesh_aware, exterior_margin=1e-4))
        yield "mesh-aware, wide margin", made("mesh-aware", mesh_aware=replace(mesh_aware, exterior_margin=2e-3))
        yield "support-aware, eased", made("support-aware", support_aware=replace(support, ease_support=0.75))
        yield "mesh-aware, mesh prior", made("mesh-aware", depth_weight=3.0, normal_weight=0.05, prior="mesh")
    if kind == "start":
        yield "from the mesh", made("support-aware", init="mesh")
        random = {"init": "random", "init_box": BOX, "init_count": options.start_gaussians}
        yield "random", made("support-aware", **random)
        yield "random, warm start", made("support-aware", **random, warm_start=warm_start_of(options.preset))


def make_data(options: argparse.Namespace) -> Path:
    from spacesim.scenes import generate, read_scene

    out: Path = options.out / "data"
    scene = read_scene("boxsat", **SCENE, suns=options.suns, resolution=options.resolution)
    with reporting("generate", "frames") as report:
        generate(scene, out, resume=True, progress=report)
    return out


def measure(name: str, config: TrainConfig, dataset: Dataset, out: Path) -> dict[str, Any]:
    """metrics.json of a configuration, trained and judged, with "training"; {"note": why} where training fails."""
    folder = out / folder_of(name)
    try:
        with reporting(f"train {name}", "iterations") as report:
            run = train(dataset, folder / "run", config, resume=True, on_progress=tell_training(report))
    except WorkError as error:
        return {"note": str(error)}
    done = folder / "eval" / "metrics.json"
    if done.exists():
        metrics: dict[str, Any] = read_json(done)
    else:
        with reporting(f"evaluate {name}", "frames") as report:
            metrics = evaluate(run, dataset, folder / "eval", progress=report)
        write_report([folder / "eval"], folder / "eval" / "report.html")
    return {**metrics, "training": run.training}


def folder_of(name: str) -> str:
    return name.replace(", ", "_").replace(" ", "-")


def tables_of(results: dict[str, Any], curves: dict[str, Any]) -> dict[str, list[common.Row]]:
    """The tables by title; a figure of the thesis follows ours where it has one."""
    titles = {
        "Pictures (table 5.4)": pictures,
        "Shape (table 5.5), metres": shape,
        "Size and speed (table 5.6)": size,
    }
    tables = {
        title: [{"strategy": name, **beside(name, columns(found))} for name, found in results.items()]
        for title, columns in titles.items()
    }
    rows = [
        {"start": name, "step": step, "inside [%]": 100 * share, "Gaussians inside": round(share * curve["gaussians"])}
        for name, curve in curves.items()
        for step, share in (curve["inside"][0], curve["inside"][len(curve["inside"]) // 2], curve["inside"][-1])
    ]
    return {**tables, "Inside the true mesh (figure 5.5)": rows}


def beside(name: str, values: common.Row) -> common.Row:
    """Figures of the thesis beside ours, "-" where it has none."""
    row: common.Row = {}
    for key, value in values.items():
        row[key] = f"{value:.{DIGITS.get(key, 4)}f}" if isinstance(value, float) else "-" if value is None else value
        if any(key in known for known in THESIS.values()):
            row[f"thesis {key}"] = str(THESIS.get(name, {}).get(key, "-"))
    return row


def pictures(found: dict[str, Any]) -> common.Row:
    image = found.get("image") or {}
    return {heading: (image.get(name) or {}).get("mean") for heading, name in PICTURES.items()}


def shape(found: dict[str, Any]) -> common.Row:
    """Chamfer in square metres, Hausdorff distance in metres, and what the thesis does not have."""
    geometry = found.get("geometry") or {}
    overlap, floaters = geometry.get("precision_recall") or {}, geometry.get("floaters") or {}
    return {
        "Chamfer": geometry.get("chamfer"),
        "Hausdorff": geometry.get("hausdorff99"),
        "IoU": geometry.get("iou"),
        "F": overlap.get("f"),
        "normals [deg]": geometry.get("normals_deg"),
        "floaters": floaters.get("outside"),
        "inside": floaters.get("inside"),
    }


def size(found: dict[str, Any]) -> common.Row:
    if "note" in found:
        return {"Gaussians": found["note"]}
    model, training = found["model"], found["training"]
    return {
        "Gaussians": model["gaussians"],
        "MB": f"{model['bytes'] / 1e6:.1f}",
        "FPS": round(1e3 / model["render_ms"]) if model["render_ms"] else None,
        "training [s]": f"{training['seconds']:.1f}",
        "refinement [%]": f"{100 * training['refinement_seconds'] / max(training['seconds'], 1e-9):.1f}",
    }


def figure(dataset: Dataset, options: argparse.Namespace) -> dict[str, Any]:
    """{name: {"gaussians": N, "inside": [(step, share)]}} of figure 5.5; without culling and densification, too."""
    surface = SignedDistance.of(dataset.root / known_mesh(dataset, "--rows figure"))
    base = preset(options.preset, options.method, "support-aware")
    still = DefaultStrategyConfig(refine_start=NEVER - 1, refine_stop=NEVER)
    base = replace(base, iterations=max(SCHEDULE, options.figure_steps), refinement=still)
    base = replace(base, init="random", init_box=BOX, init_count=options.start_gaussians)
    table = WarmStartConfig()
    shorter = min(1.0, options.figure_steps / 5_000)
    table = replace(table, steps=int(shorter * table.steps), decay=int(shorter * table.decay))
    plain = replace(table, travel=0.0, gather=False, spacing=0.0, revive=0.0)
    starts = dict(zip(CURVES, (None, table, plain), strict=True))
    found = {}
    for name, warm_start in starts.items():
        config, path = replace(base, warm_start=warm_start), options.out / "figure" / f"{folder_of(name)}.json"
        told = {"config": config.to_json(), "steps": options.figure_steps, "data": str(dataset.root.resolve())}
        if not path.exists() or read_json(path).get("told") != told:
            curve = follow(name, Trainer(dataset, config), surface, options.figure_steps)
            write_json(path, {"told": told, "curve": curve})
        found[name] = read_json(path)["curve"]
    return found


def follow(name: str, trainer: Trainer, surface: SignedDistance, steps: int) -> dict[str, Any]:
    """The share of Gaussians whose centre is inside, 20 times over `steps`."""
    inside = []
    with reporting(f"figure {name}", "steps") as report:
        for step in range(steps + 1):
            if step % max(steps // 20, 1) == 0:
                share = surface.inside(np.array(trainer.gaussians.means, np.float64).T).mean()
                inside.append((step, float(share)))
                report(step, steps, f"{100 * share:.2f} % inside")
            if step < steps:
                trainer.step()
    return {"gaussians": trainer.gaussians.count, "inside": inside}


def plot(curves: dict[str, Any]) -> str:
    """Figure 5.5 as SVG that stands alone."""
    title = "Gaussians inside the true mesh, %"
    series = [[(step, 100 * share) for step, share in curve["inside"]] for curve in curves.values()]
    chart = line_chart(title, "step", series)
    start = chart.index(">") + 1
    lines = "".join(f".s{i}{{stroke:{colour}}}" for i, colour in enumerate(COLOURS))
    style = f".line{{fill:none;stroke-width:2}}.axis{{stroke:#e2e3de}}text{{font:12px sans-serif;fill:#1b2027}}{lines}"
    legend = "".join(
        f'<text x="64" y="{44 + 16 * i}" style="fill:{COLOURS[i]}">{name}</text>' for i, name in enumerate(curves)
    )
    head = chart[:start].replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    return f'{head}<style>{style}</style><rect width="100%" height="100%" fill="#fff"/>{legend}{chart[start:]}\n'


if __name__ == "__main__":
    common.told(main)
