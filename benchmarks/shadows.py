"""Trains the methods of light on one dataset and compares them under Suns that they know and Suns never seen.

    python benchmarks/shadows.py --data DATA --out RUNS [--preset fast] [--iterations N] [--seed N] [--rows thesis,ours]
    python benchmarks/shadows.py --out RUNS

Without DATA it makes one first: boxsat, 16 Suns x 40 views of 256 pixels, evaluated under these and under 8 never seen.
Prints, for each row, what tables 4.4 and 4.5 of the thesis have, and the errors of the predicted shadow masks. Rows
"thesis" are the methods as the thesis has them, with and without bias and refinement, in networks of the preset's size
(`spacesim reproduce` shows them in its own, beside its numbers); rows "ours" add the field that knows surfaces, the
bias that holds at grazing Suns, and one option each. What is done already is not done again: an interrupted call goes
on where it stopped. Every run's report is in RUNS/NAME/eval.
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
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig
from spacesim.splat.train.config import TrainConfig, preset, with_options, with_settings

SCENE = {"suns": 16, "views": 40, "resolution": 256, "test_spp": 1024, **common.KNOWN_AND_UNSEEN}
ROWS = ("thesis", "ours")
SUNS = {"known": "known_suns", "unseen": "unseen_suns"}
COLUMNS = (  # heading, group, metric, and what of it if not the mean
    ("MAE", "image", "mae"),
    ("RMSE", "image", "rmse"),
    ("PSNR", "image", "psnr"),
    ("SSIM", "image", "ssim"),
    ("LPIPS", "image", "lpips"),
    ("BER", "shadow", "ber"),
    ("bias", "shadow", "bias"),
    ("boundary MAE", "shadow", "boundary_mae"),
    ("sharpness", "shadow", "sharpness_ratio"),
    ("mask error", "shadow_mask", "error_rate"),
    ("pooled", "shadow_mask", "error_rate", "pooled"),
    ("facing away, pooled", "shadow_attached", "error_rate", "pooled"),
    ("balanced", "shadow_mask", "balanced_error_rate"),
    ("IoU", "shadow_mask", "iou"),
)
MATERIAL = (  # heading, metric: over all Suns
    ("albedo error", "albedo_error"),
    ("normals", "normals_deg"),
    ("learned normals", "learned_normals_deg"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--data", type=Path, help="a dataset with Suns; without it one is made in RUNS/data")
    parser.add_argument("--out", type=Path, required=True, metavar="RUNS")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--seed", type=int, help="of each training (0)")
    parser.add_argument("--rows", default=",".join(ROWS), help="of thesis,ours, or names of single rows")
    parser.add_argument("--no-geometry", action="store_true", help="do not evaluate shapes")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", nargs="?", const=Path("-"), type=Path, metavar="FILE")
    options = parser.parse_args()
    backend.select(options.backend)
    table = {name: (kind, config) for kind in ROWS for name, config in configurations(kind, options.preset)}
    wanted = common.row_names(options.rows)
    unknown = [name for name in wanted if name not in (*ROWS, *table)]
    if unknown:
        sys.exit(f"--rows: expected some of {', '.join((*ROWS, *table))}, found {unknown[0]!r}")
    dataset = read_dataset(options.data or make_data(options.out / "data"))
    evaluation = EvaluateConfig(geometry=None) if options.no_geometry else EvaluateConfig()
    results: dict[str, Any] = {}
    for name, (kind, config) in table.items():
        if kind in wanted or name in wanted:
            config = with_options(config, iterations=options.iterations, seed=options.seed)
            results[name] = common.measured(name, config, evaluation, dataset, options.out / name)
    evaluated = [options.out / name / "eval" for name, result in results.items() if "note" not in result]
    if evaluated:
        write_report(evaluated, options.out / "report.html")
    tables = {
        f"{label.capitalize()} Suns": [row(name, metrics, part) for name, metrics in results.items()]
        for label, part in SUNS.items()
        if any(metrics.get(part) for metrics in results.values())
    }
    if any(metrics.get("material") for metrics in results.values()):
        tables["Materials"] = [material_row(name, metrics) for name, metrics in results.items()]
    common.emit({"rows": tables, "data": str(dataset.root)}, tables, options)


def configurations(kind: str, size: str) -> Iterator[tuple[str, TrainConfig]]:
    """(name, configuration) of the rows of a kind."""
    if kind == "thesis":
        yield "vanilla", preset(size)
        yield "none", as_thesis(preset(size, "relight"))
        for name, method in (("map", "shadow-map"), ("splat", "shadow-splat")):
            whole = as_thesis(preset(size, method))
            yield name, whole
            yield f"{name}, no bias", with_shadow(whole, bias=0.0)
            yield f"{name}, no refinement", with_shadow(whole, refine=None)
        yield "baseline-park", replace(preset(size, "baseline-park"), antialiased=False, supersample=1)
        return
    relit, mapped, splatted = (as_ours(preset(size, method)) for method in ("relight", "shadow-map", "shadow-splat"))
    yield "none, surface", relit
    yield "map, surface", mapped
    yield "splat, surface", splatted
    yield "map, surface, thesis's shadows", with_shadow(mapped, bias=10.0, grazing="none", method=MappingConfig())
    yield "map, surface, bilinear", with_shadow(mapped, method=MappingConfig())
    yield "map, surface, offset receivers alone", with_shadow(mapped, grazing="lift")
    yield "splat, surface, offset receivers alone", with_shadow(splatted, grazing="lift")
    for name, config in (("map", mapped), ("splat", splatted)):
        has, other = shadow_of(config).refine, refine_of(splatted)
        yield f"{name}, surface, {'no ' if has else ''}refinement", with_shadow(config, refine=None if has else other)
    half = shadow_of(splatted).size // 2
    yield "splat, surface, light of half the size", with_shadow(splatted, size=half)
    yield "splat, surface, a quarter of the emitters", with_bounce(splatted, light_of(splatted).bounce // 4)
    yield "map, surface, percentage-closer", with_shadow(mapped, method=MappingConfig("percentage-closer"))
    blur = "median" if size == "fine" else "variance"
    yield f"map, surface, {blur}", with_settings(mapped, {"light.shadow.method": {"filter": blur}})
    yield "none, surface, unfiltered", replace(relit, antialiased=False)
    yield "map, surface, unfiltered", replace(mapped, antialiased=False)
    yield "splat, surface, unfiltered", replace(splatted, antialiased=False)
    yield "map, surface, supervised", replace(mapped, visibility_weight=0.1)
    yield "splat, surface, supervised", replace(splatted, visibility_weight=0.1)
    yield "map, surface, light of twice the size", with_shadow(mapped, size=2 * shadow_of(mapped).size)
    yield "map, surface, linear", replace(mapped, light=replace(light_of(mapped), linear=True))
    yield "map, surface, linear, filmic", replace(mapped, light=replace(light_of(mapped), linear=True, tone="filmic"))
    yield "none, surface, bounce", with_bounce(relit, light_of(splatted).bounce)
    yield "map, surface, no bounce", with_bounce(mapped, 0)
    yield "splat, surface, no bounce", with_bounce(splatted, 0)
    yield "map, surface, no discs", replace(mapped, surfels=False)
    yield "splat, surface, no discs", replace(splatted, surfels=False)
    yield "splat, surface, no gloss", with_settings(splatted, {"light.gloss": False})
    every = {"split_screen": "all", "split_screen_size": mapped.refinement.split_screen_size}
    yield "splat, surface, sizes not held", with_settings(splatted, {"refinement": every, "light.shadow.bias": 5.0})
    with_sun = ShadowRefinementConfig(width=refine_of(splatted).width)
    yield "splat, surface, refinement given the Sun", with_shadow(splatted, refine=with_sun)
    yield "splat, surface, no bounce, refinement given the Sun", with_bounce(with_shadow(splatted, refine=with_sun), 0)
    for name, config in (("none", relit), ("splat", splatted)):
        label, supersample = ("pixels of one", 1) if config.supersample > 1 else ("2x2 samples", 2)
        yield f"{name}, surface, {label}", replace(config, supersample=supersample)
    label, views = ("one view", 1) if splatted.views_per_step > 1 else ("two views", 2)
    yield f"splat, surface, {label} a step", replace(splatted, views_per_step=views)
    yield "none, surface, finer", finer(relit)


def finer(config: TrainConfig) -> TrainConfig:
    """More and smaller Gaussians: split at half of the size, and kept while they are faint."""
    size = 0.5 * config.refinement.split_screen_size
    return replace(config, refinement=replace(config.refinement, split_screen_size=size, prune_opacity=0.005))


def with_bounce(config: TrainConfig, emitters: int) -> TrainConfig:
    """`config` with one bounce of light from so many Gaussians."""
    return replace(config, light=replace(light_of(config), bounce=emitters))


def as_thesis(config: TrainConfig) -> TrainConfig:
    """The field, the shadows and the splats as the thesis has them, in networks of the preset's size."""
    config = with_settings(config, {"light.field.inputs": "directions", "light.bounce": 0})
    plain = preset(str(config.preset), "relight")  # what light with shadows has of its own
    schedule = {name: getattr(plain, name) for name in ("iterations", "init_count", "rates", "refinement")}
    config = replace(config, **schedule, views_per_step=1, antialiased=False, surfels=False, supersample=1)
    if config.light is None or config.light.shadow is None:
        return config
    printed = preset("thesis", config.method)
    ours = config.light.shadow.refine or refine_of(preset(str(config.preset), "shadow-splat"))
    refine = replace(refine_of(printed), width=ours.width)
    return with_shadow(config, **{**vars(shadow_of(printed)), "size": config.light.shadow.size, "refine": refine})


def as_ours(config: TrainConfig) -> TrainConfig:
    """The field, the shadows and the splats as `fast` has them, in networks of the preset's size: all but `thesis` have
    their own."""
    assert config.light is not None
    if config.preset != "thesis":
        return config
    config = with_settings(config, {"light.field.inputs": "surface"})
    fast = preset("fast", config.method)
    config = replace(config, antialiased=fast.antialiased, surfels=fast.surfels)
    if config.light is None or config.light.shadow is None:
        return config
    ours, refine = shadow_of(fast), replace(refine_of(fast), width=refine_of(config).width)
    config = with_settings(with_bounce(config, light_of(fast).bounce), {"light.gloss": light_of(fast).gloss})
    return with_shadow(config, bias=ours.bias, grazing=ours.grazing, method=ours.method, refine=refine)


def with_shadow(config: TrainConfig, **changes: Any) -> TrainConfig:
    """`config` with another configuration of its shadows."""
    return replace(config, light=replace(light_of(config), shadow=replace(shadow_of(config), **changes)))


def light_of(config: TrainConfig) -> LightConfig:
    assert config.light is not None
    return config.light


def shadow_of(config: TrainConfig) -> ShadowConfig:
    shadow = light_of(config).shadow
    assert shadow is not None
    return shadow


def refine_of(config: TrainConfig) -> ShadowRefinementConfig:
    refine = shadow_of(config).refine
    assert refine is not None
    return refine


def make_data(out: Path, **changes: Any) -> Path:
    """One boxsat under many Suns."""
    return common.generated("boxsat", out, **{**SCENE, **changes})


def row(name: str, metrics: dict[str, Any], part: str) -> common.Row:
    """Means over the frames of known or unseen Suns."""
    if "note" in metrics:
        return {"method": name, "Gaussians": metrics["note"]}
    cells: common.Row = {"method": name, "Gaussians": metrics["model"]["gaussians"]}
    for heading, group, metric, *what in COLUMNS:
        number = common.number_in(metrics, part, group, metric, what[0] if what else "mean")
        cells[heading] = "" if number is None else f"{number:.{2 if metric == 'psnr' else 4}f}"
    return cells


def material_row(name: str, metrics: dict[str, Any]) -> common.Row:
    """Means over all test frames."""
    numbers = {heading: common.number_in(metrics, "material", metric, "mean") for heading, metric in MATERIAL}
    return {"method": name, **{key: "" if value is None else f"{value:.4g}" for key, value in numbers.items()}}


if __name__ == "__main__":
    common.run_main(main)
