"""Prints docs/research/shadows.md's tables of shadows on a trained model.

python tests/splat/light/shadow/against_truth.py RUN DATA

RUN: a trained run (`spacesim train`), DATA: a dataset of the same object under many Suns, of which those are evaluated
that no training frame has, if there are such. Visibility is drawn, and evaluated where the model is there (alpha above
1/2); at least one half is lit. First raw shadows of many kinds; then, of a run with shadows, its own refined ones, and
these as pictures show them, without what faces away (`--own`: these alone).
"""

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.backend.upload import upload
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST, load_truth, read_dataset
from spacesim.eval.suns import known_suns
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig, cast_shadows
from spacesim.splat.light.shadow.light_camera import light_rows
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import preset

EDGES = (0, 5, 10, 20, 40, 90)  #: degrees of the Sun above the surface
VIEWS = 3  #: of each Sun

Visibility = Callable[[Frame], Any]
"""Of each Gaussian in a frame, Float [N]."""


METHODS = {"mapping": MappingConfig, "splatting": SplattingConfig}


def ways(size: int) -> dict[str, ShadowConfig]:
    """Shadows by name."""
    configs: dict[str, ShadowConfig] = {}
    for method in ("mapping", "splatting"):
        for bias, grazing in ((0.0, "none"), (3.0, "none"), (10.0, "none"), (30.0, "none"), (10.0, "bias")):
            what = {"none": "", "bias": ", grazing bias"}[grazing]
            configs[f"{method}, λ = {bias:g}{what}"] = ShadowConfig(METHODS[method](), size, bias, grazing)
        for bias, grazing in ((5.0, "lift"), (10.0, "lift"), (5.0, "both")):
            what = {"lift": "offset receivers", "both": "offset receivers, grazing bias"}[grazing]
            configs[f"{method}, λ = {bias:g}, {what}"] = ShadowConfig(METHODS[method](), size, bias, grazing)
        if method == "mapping":
            for name in ("percentage-closer", "variance", "median"):
                reading = MappingConfig(name)
                configs[f"{method}, λ = 5, offset receivers, {name}"] = ShadowConfig(reading, size, 5.0, "lift")
    for method, kind in (("mapping", "shadow-map"), ("splatting", "shadow-splat")):
        light = preset("fast", kind).light
        assert light is not None
        assert light.shadow is not None
        configs[f"{method}, as shipped"] = light.shadow
    return configs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--own", action="store_true")
    options = parser.parse_args()
    run, dataset = load_run(options.run), read_dataset(options.data)
    frames = unseen(dataset)
    print(f"{run.gaussians.count} Gaussians, {len(frames)} frames")
    grazing = " | ".join(f"{low}–{high}°" for low, high in itertools.pairwise(EDGES))
    classes = "lit, but dark | cast, but lit | attached, but lit | all of the model"
    print(f"| shadows | error | mean over frames | balanced | {classes} | dark at {grazing} |")
    raw = () if options.own else raw_shadows(run.gaussians, dataset, options.size)
    for name, visibility in itertools.chain(raw, own_shadows(run)):
        shares = mask_errors(run.gaussians, dataset, frames, visibility)
        print(f"| {name} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |", flush=True)


def raw_shadows(gaussians: Gaussians, dataset: Dataset, size: int) -> Iterator[tuple[str, Visibility]]:
    distance = max(float(np.linalg.norm(frame.camera.position)) for frame in dataset.train)
    for name, config in ways(size).items():
        known: dict[tuple[float, ...], Any] = {}

        def visibility(frame: Frame, config: ShadowConfig = config, known: dict = known) -> Any:
            sun = tuple(frame.sun.direction)
            if sun not in known:
                known[sun] = 1 - cast_shadows(gaussians, light_rows(sun), config, distance).occlusion
            return known[sun]

        yield name, visibility


def own_shadows(run: Run) -> Iterator[tuple[str, Visibility]]:
    light = run.light
    if light is None or light.config.shadow is None:
        return
    yield "raw", lambda frame: 1 - shadows_of(light, run, frame)
    yield "refined", lambda frame: light.sunlight(run.gaussians, frame.sun.direction).visibility
    yield "shown", lambda frame: light.shade_picture(run.gaussians, Pinhole.of(frame.camera), frame.sun.direction)[1]


def shadows_of(light: LightModel, run: Run, frame: Frame) -> Any:
    """Raw occlusion of each Gaussian, as the run's method casts it."""
    shadows = light.shadows(run.gaussians, frame.sun.direction)
    assert shadows is not None, "of a run with shadows"
    return shadows.occlusion


def unseen(dataset: Dataset) -> list[Frame]:
    """At most VIEWS frames of each Sun that training has not seen, of each that it has where there is no other."""
    known = known_suns(dataset.test, dataset.train)
    frames = [frame for frame, seen in zip(dataset.test, known, strict=True) if seen is False] or dataset.frames
    by_sun: dict[tuple[float, ...], list[Frame]] = {}
    for frame in frames:
        by_sun.setdefault(tuple(frame.sun.direction), []).append(frame)
    return [frame for of_sun in by_sun.values() for frame in of_sun[:VIEWS]]


def mask_errors(gaussians: Gaussians, dataset: Dataset, frames: Sequence[Frame], visibility: Visibility) -> list[float]:
    """Of lit and cast-shadow pixels the error rate, its mean over frames that have some, and the balanced one; share
    of lit pixels that are dark, of those in cast and in attached shadow that are lit, of all that are wrong; then the
    share of lit pixels that are dark, by the Sun's elevation over the surface (`EDGES`)."""
    counts, attached, rates = np.zeros((len(EDGES) - 1, 4)), np.zeros(2), list[float]()
    for frame in frames:
        truth = load_truth(dataset, frame)
        seen = render(gaussians, Pinhole.of(frame.camera), outputs=("alpha",), features=[upload(visibility(frame))])
        alpha = seen.image("alpha")
        bright = seen.image("features")[..., 0] >= 0.5 * alpha
        lit = (truth.shadow == SHADOW_LIT) & (alpha > 0.5)
        cast = (truth.shadow >= SHADOW_SELF_CAST) & (truth.shadow < SHADOW_LIT) & (alpha > 0.5)
        away = (truth.shadow == SHADOW_ATTACHED) & (alpha > 0.5)
        if (lit | cast).any():
            rates.append(np.count_nonzero((lit & ~bright) | (cast & bright)) / np.count_nonzero(lit | cast))
        attached += [np.count_nonzero(away), np.count_nonzero(away & bright)]
        above = np.degrees(np.arcsin(np.clip(truth.sun_cosine, -1, 1)))
        for i in range(len(EDGES) - 1):
            here = (above >= EDGES[i]) & (above < EDGES[i + 1] + (i == len(EDGES) - 2))
            counts[i] += [np.count_nonzero(part & here) for part in (lit, lit & ~bright, cast, cast & bright)]
    lit, lit_dark, cast, cast_lit = counts.sum(axis=0)
    dark, leaks = lit_dark / lit, cast_lit / cast
    error, through = (lit_dark + cast_lit) / (lit + cast), attached[1] / attached[0]
    wrong = (lit_dark + cast_lit + attached[1]) / (lit + cast + attached[0])
    return [
        error,
        float(np.mean(rates)),
        (dark + leaks) / 2,
        dark,
        leaks,
        through,
        wrong,
        *(counts[:, 1] / counts[:, 0]),
    ]


if __name__ == "__main__":
    main()
