"""Prints docs/shadows.md's table of raw shadows on a trained model: python tests/splat/shadow/against_truth.py RUN DATA

RUN: a trained run (`spacesim train`), DATA: a dataset of the same object under many Suns. Visibility is drawn, and
judged where the truth is lit or in cast shadow and the model is there (alpha above 1/2); at least one half is lit.
"""

import argparse
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spacesim.backend import ad
from spacesim.data.records import Dataset
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST, load_truth, read_dataset
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Pinhole
from spacesim.splat.render import render
from spacesim.splat.shadow.bias import grazing_bias, lifted, receiver_bias
from spacesim.splat.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.shadow.sunlight import fit_camera, light_rows, towards_sun
from spacesim.splat.train.checkpoint import read_tensors

EDGES = (0, 5, 10, 20, 40, 90)  #: degrees of the Sun above the surface
VARIANCE = MappingConfig("variance")
CLOSER = MappingConfig("percentage-closer", radius=1.0)
#: name: (lambda_b, what else, filter)
WAYS: dict[str, tuple[float, str, MappingConfig | None]] = {
    "no bias": (0, "", None),
    "thesis, λ = 3": (3, "", None),
    "thesis, λ = 10": (10, "", None),
    "thesis, λ = 30": (30, "", None),
    "λ = 10, grazing bias": (10, "bias", None),
    "λ = 5, lifted": (5, "lift", None),
    "λ = 10, lifted": (10, "lift", None),
    "λ = 10, percentage-closer": (10, "", CLOSER),
    "λ = 10, variance": (10, "", VARIANCE),
    "λ = 3, lifted, variance": (3, "lift", VARIANCE),
    "λ = 10, lifted, variance": (10, "lift", VARIANCE),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--size", type=int, default=512)
    options = parser.parse_args()
    gaussians = Gaussians.from_numpy(read_tensors(options.run / "model.safetensors")[0])
    dataset = read_dataset(options.data)
    grazing = " | ".join(f"{low}–{high}°" for low, high in itertools.pairwise(EDGES))
    print(f"| raw shadows | error | balanced | lit, but dark | cast, but lit | attached, but lit | dark at {grazing} |")
    for name, way in WAYS.items():
        shares = judged(gaussians, dataset, lambda sun, way=way: occlusion(gaussians, sun, options.size, *way))
        print(f"| {name} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |", flush=True)


def occlusion(
    gaussians: Gaussians, sun: np.ndarray, size: int, strength: float, more: str, config: MappingConfig | None
) -> np.ndarray:
    """[N] raw occlusion for a Sun in the direction `sun` [3]."""
    light = light_rows(sun)
    camera = fit_camera(gaussians, light, size)
    bias = receiver_bias(gaussians, towards_sun(light), strength)
    if more == "bias":
        bias = bias.at_least(grazing_bias(gaussians, camera))
    points = lifted(gaussians, towards_sun(light)) if more == "lift" else None
    return np.array(occlusion_by_mapping(gaussians, camera, bias.bias, 1e-5, config, points))


def judged(gaussians: Gaussians, dataset: Dataset, occlude: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """Error rate, balanced error rate, share of lit pixels that are dark, of those in cast and in attached shadow that
    are lit; then the share of lit pixels that are dark, by the Sun's elevation over the surface (`EDGES`)."""
    known: dict[tuple[float, ...], np.ndarray] = {}
    counts, attached = np.zeros((len(EDGES) - 1, 4)), np.zeros(2)
    for frame in dataset.frames:
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
