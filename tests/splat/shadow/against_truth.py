"""Prints docs/shadows.md's table of raw shadows on a trained model: python tests/splat/shadow/against_truth.py RUN DATA

RUN: a trained run (`spacesim train`), DATA: a dataset of the same object under many Suns, of which those are judged
that no training frame has, if there are such. Visibility is drawn, and judged where the truth is lit or in cast shadow
and the model is there (alpha above 1/2); at least one half is lit.
"""

import argparse
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from spacesim.backend import ad
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST, load_truth, read_dataset
from spacesim.eval.suns import known_suns
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Pinhole
from spacesim.splat.render import render
from spacesim.splat.shadow.cast import ShadowConfig, cast_shadows
from spacesim.splat.shadow.mapping import MappingConfig
from spacesim.splat.shadow.sunlight import light_rows
from spacesim.splat.train.checkpoint import read_tensors
from spacesim.splat.train.config import preset

EDGES = (0, 5, 10, 20, 40, 90)  #: degrees of the Sun above the surface
VIEWS = 3  #: of each Sun


def ways(size: int) -> dict[str, ShadowConfig]:
    """Shadows by name."""
    found: dict[str, ShadowConfig] = {}
    for method in ("mapping", "splatting"):
        for bias, grazing in ((0.0, "none"), (3.0, "none"), (10.0, "none"), (30.0, "none"), (10.0, "bias")):
            what = {"none": "", "bias": ", grazing bias"}[grazing]
            found[f"{method}, λ = {bias:g}{what}"] = ShadowConfig(method, size, bias, grazing)
        for bias, grazing in ((5.0, "lift"), (10.0, "lift"), (5.0, "both")):
            what = {"lift": "lifted", "both": "lifted, grazing bias"}[grazing]
            found[f"{method}, λ = {bias:g}, {what}"] = ShadowConfig(method, size, bias, grazing)
        if method == "mapping":
            for name in ("percentage-closer", "variance", "median"):
                reading = MappingConfig(name)
                found[f"{method}, λ = 5, lifted, {name}"] = ShadowConfig(method, size, 5.0, "lift", mapping=reading)
    for method, kind in (("mapping", "shadow-map"), ("splatting", "shadow-splat")):
        light = preset("fast", kind).light
        assert light is not None
        assert light.shadow is not None
        found[f"{method}, as shipped"] = light.shadow
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--size", type=int, default=512)
    options = parser.parse_args()
    gaussians = Gaussians.from_numpy(read_tensors(options.run / "model.safetensors")[0])
    dataset = read_dataset(options.data)
    frames = unseen(dataset)
    distance = max(float(np.linalg.norm(frame.camera.position)) for frame in dataset.train)
    print(f"{gaussians.count} Gaussians, {len(frames)} frames")
    grazing = " | ".join(f"{low}–{high}°" for low, high in itertools.pairwise(EDGES))
    print(f"| raw shadows | error | balanced | lit, but dark | cast, but lit | attached, but lit | dark at {grazing} |")
    for name, config in ways(options.size).items():

        def occlude(sun: np.ndarray, config: ShadowConfig = config) -> np.ndarray:
            return np.array(cast_shadows(gaussians, light_rows(sun), config, distance).occlusion)

        shares = judged(gaussians, dataset, frames, occlude)
        print(f"| {name} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |", flush=True)


def unseen(dataset: Dataset) -> list[Frame]:
    """At most VIEWS frames of each Sun that training has not seen, of each that it has where there is no other."""
    known = known_suns(dataset.test, dataset.train)
    frames = [frame for frame, seen in zip(dataset.test, known, strict=True) if seen is False] or dataset.frames
    found: dict[tuple[float, ...], list[Frame]] = {}
    for frame in frames:
        found.setdefault(tuple(frame.sun.direction), []).append(frame)
    return [frame for of_sun in found.values() for frame in of_sun[:VIEWS]]


def judged(
    gaussians: Gaussians, dataset: Dataset, frames: Sequence[Frame], occlude: Callable[[np.ndarray], np.ndarray]
) -> list[float]:
    """Error rate, balanced error rate, share of lit pixels that are dark, of those in cast and in attached shadow that
    are lit; then the share of lit pixels that are dark, by the Sun's elevation over the surface (`EDGES`)."""
    known: dict[tuple[float, ...], np.ndarray] = {}
    counts, attached = np.zeros((len(EDGES) - 1, 4)), np.zeros(2)
    for frame in frames:
        truth = load_truth(dataset, frame)
        sun = tuple(frame.sun.direction)
        if sun not in known:
            known[sun] = occlude(np.array(sun))
        seen = render(gaussians, Pinhole.of(frame.camera), outputs=("alpha",), features=[1 - ad.Float(known[sun])])
        alpha = seen.image("alpha")
        bright = seen.image("features")[..., 0] >= 0.5 * alpha
        lit = (truth.shadow == SHADOW_LIT) & (alpha > 0.5)
        cast = (truth.shadow >= SHADOW_SELF_CAST) & (truth.shadow < SHADOW_LIT) & (alpha > 0.5)
        away = (truth.shadow == SHADOW_ATTACHED) & (alpha > 0.5)
        attached += [np.count_nonzero(away), np.count_nonzero(away & bright)]
        above = np.degrees(np.arcsin(np.clip(truth.sun_cosine, -1, 1)))
        for i in range(len(EDGES) - 1):
            here = (above >= EDGES[i]) & (above < EDGES[i + 1] + (i == len(EDGES) - 2))
            counts[i] += [np.count_nonzero(part & here) for part in (lit, lit & ~bright, cast, cast & bright)]
    lit, lit_dark, cast, cast_lit = counts.sum(axis=0)
    dark, leaks = lit_dark / lit, cast_lit / cast
    error, through = (lit_dark + cast_lit) / (lit + cast), attached[1] / attached[0]
    return [error, (dark + leaks) / 2, dark, leaks, through, *(counts[:, 1] / counts[:, 0])]


if __name__ == "__main__":
    main()
