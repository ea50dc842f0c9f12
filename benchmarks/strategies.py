"""Trains with every strategy on one dataset and compares pictures, shapes and sizes.

    python benchmarks/strategies.py --out RUNS [--data DATA] [--method shadow-map] [--preset fast] [--iterations N]
                                    [--rows thesis,field,ours,start] [--json]

Without DATA it makes one first: boxsat, 8 Suns x 40 views of 256 pixels, evaluated under them. Prints what tables 5.4
to 5.6 of the thesis have (`spacesim reproduce` shows its numbers, and figure 5.5, beside ours), and the share of the
training time that refinement takes. Rows:

    thesis   default, mesh-aware, support-aware
    field    mcmc
    ours     default that prunes below an opacity of 0.005 only, without discs, with depth and normals of the truth or
             of the mesh; other margins and thresholds
    start    support-aware from the mesh, at random in a box of ten times the object's size, and there with a warm start

or the names of single rows. What is done already is not done again: an interrupted call goes on where it stopped. Every
run's report is in RUNS/NAME/eval.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from support import common

from spacesim import backend
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.eval.report.write import write_report
from spacesim.splat.train.config import METHODS, TrainConfig, preset, with_options, with_settings
from spacesim.splat.train.config import warm_start as warm_start_of
from spacesim.splat.train.strategies.control import DensificationConfig

SCENE = {"views": 40, "test_suns": 0, "test_views": 5, "spp": 64, "test_spp": 1024}
KINDS = ("thesis", "field", "ours", "start")
BOX = 10.0  #: sizes of the object

PICTURES = {"MAE": "mae", "PSNR": "psnr", "SSIM": "ssim", "LPIPS": "lpips"}
DIGITS = {"PSNR": 2, "Chamfer": 6, "normals [deg]": 1}


def main() -> None:
    options = arguments().parse_args()
    backend.select(options.backend)
    table = {name: (kind, config) for kind in KINDS for name, config in configurations(kind, options)}
    wanted = common.row_names(options.rows)
    unknown = [name for name in wanted if name not in (*KINDS, *table)]
    if unknown:
        sys.exit(f"--rows: expected some of {'; '.join((*KINDS, *table))}, found {unknown[0]!r}")
    size = {"suns": options.suns, "resolution": options.resolution}
    dataset = read_dataset(options.data or common.generated("boxsat", options.out / "data", **SCENE, **size))
    chosen = {name: config for name, (kind, config) in table.items() if kind in wanted or name in wanted}
    results = {
        name: common.measured(name, config, EvaluateConfig(), dataset, options.out / folder_of(name))
        for name, config in chosen.items()
    }
    evaluated = [options.out / folder_of(name) / "eval" for name, metrics in results.items() if "note" not in metrics]
    if evaluated:
        write_report(evaluated, options.out / "report.html")
    tables = tables_of(results)
    common.emit({"rows": tables, "data": str(dataset.root)}, tables, options)


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
    parser.add_argument("--rows", default=",".join(KINDS), help=f"of {','.join(KINDS)}, or names of single rows")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", nargs="?", const=Path("-"), type=Path, metavar="FILE")
    return parser


def configurations(kind: str, options: argparse.Namespace) -> Iterator[tuple[str, TrainConfig]]:
    """(name, configuration) of the rows of a kind."""

    def made(strategy: str = "default", **changes: Any) -> TrainConfig:
        config = preset(options.preset, options.method, strategy)
        unbound = {"refinement.max_gaussians": DensificationConfig().max_gaussians}  # at the preset's all would end
        config = with_settings(config, unbound)
        return with_options(config, iterations=options.iterations, **changes)

    if kind == "thesis":
        for strategy in ("default", "mesh-aware", "support-aware"):
            yield strategy, made(strategy)
    if kind == "field":
        most = made().refinement
        yield "mcmc", made("mcmc", refinement=replace(most, max_gaussians=options.mcmc_gaussians))
    if kind == "ours":
        yield "default, prune_opacity 0.005", made(refinement=replace(made().refinement, prune_opacity=0.005))
        yield "default, no discs", made(surfels=False)
        yield "default, depth and normals", made(depth_weight=3.0, normal_weight=0.05)
        yield "default, mesh prior", made(depth_weight=3.0, normal_weight=0.05, prior="mesh")
        yield "mesh-aware, narrow margin", with_settings(made("mesh-aware"), {"strategy.exterior_margin": 1e-4})
        yield "mesh-aware, wide margin", with_settings(made("mesh-aware"), {"strategy.exterior_margin": 2e-3})
        yield "support-aware, eased", with_settings(made("support-aware"), {"strategy.ease_support": 0.75})
        yield "mesh-aware, mesh prior", made("mesh-aware", depth_weight=3.0, normal_weight=0.05, prior="mesh")
    if kind == "start":
        yield "from the mesh", made("support-aware", init="mesh")
        random = {"init": "random", "init_box": BOX, "init_count": options.start_gaussians}
        yield "random", made("support-aware", **random)
        yield "random, warm start", made("support-aware", **random, warm_start=warm_start_of(options.preset))


def folder_of(name: str) -> str:
    return name.replace(", ", "_").replace(" ", "-")


def tables_of(results: dict[str, Any]) -> dict[str, list[common.Row]]:
    """The tables by title."""
    titles = {
        "Pictures (table 5.4)": pictures,
        "Shape (table 5.5), metres": shape,
        "Size and speed (table 5.6)": size,
    }
    return {
        title: [{"strategy": name, **printed(columns(metrics))} for name, metrics in results.items()]
        for title, columns in titles.items()
    }


def printed(values: common.Row) -> common.Row:
    return {
        key: f"{value:.{DIGITS.get(key, 4)}f}" if isinstance(value, float) else "-" if value is None else value
        for key, value in values.items()
    }


def pictures(metrics: dict[str, Any]) -> common.Row:
    image = metrics.get("image") or {}
    return {heading: (image.get(name) or {}).get("mean") for heading, name in PICTURES.items()}


def shape(metrics: dict[str, Any]) -> common.Row:
    """Chamfer in square metres, Hausdorff distance in metres, and what the thesis does not have."""
    geometry = metrics.get("geometry") or {}
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


def size(metrics: dict[str, Any]) -> common.Row:
    if "note" in metrics:
        return {"Gaussians": metrics["note"]}
    model, training = metrics["model"], metrics["training"]
    return {
        "Gaussians": model["gaussians"],
        "MB": f"{model['bytes'] / 1e6:.1f}",
        "FPS": round(1e3 / model["render_ms"]) if model["render_ms"] else None,
        "training [s]": f"{training['seconds']:.1f}",
        "refinement [%]": f"{100 * training['refinement_seconds'] / max(training['seconds'], 1e-9):.1f}",
    }


if __name__ == "__main__":
    common.run_main(main)
