"""Prints the tables in docs/shadows.md's section on splatting: python tests/splat/shadow/acne_splatting.py [RUN DATA]

20 seconds; with RUN and DATA, see against_truth.py, half a minute more.

Acne is the mean occlusion of a bare plate's discs, which should be 0; recession, how far the shadow of a screen that
stands on the plate has withdrawn from its foot, and tip, how much too far it reaches.
"""

import sys
from pathlib import Path

import numpy as np
from against_truth import judged
from walls import SCREEN, plate

from spacesim.backend import ad
from spacesim.data.store import read_dataset
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.shadow.bias import grazing_bias, lifted, receiver_bias
from spacesim.splat.shadow.splatting import occlusion_by_splatting
from spacesim.splat.shadow.sunlight import fit_camera, light_rows, towards_sun
from spacesim.splat.train.checkpoint import read_tensors

COUNT, SIZE = 20_000, 512
WAYS = {"none": (), "thesis": (), "grazing bias": (), "lifted, 0.2": (3.0, 0.2), "lifted, 0.6": (3.0, 0.6)}


#: name: (lambda_b, way of `WAYS`)
TRUTH = {
    "no bias": (10.0, "none"),
    "thesis, λ = 3": (3.0, "thesis"),
    "thesis, λ = 10": (10.0, "thesis"),
    "thesis, λ = 30": (30.0, "thesis"),
    "λ = 10, grazing bias": (10.0, "grazing bias"),
    "λ = 3, lifted, 0.2": (3.0, "lifted, 0.2"),
    "λ = 5, lifted, 0.2": (5.0, "lifted, 0.2"),
    "λ = 10, lifted, 0.2": (10.0, "lifted, 0.2"),
    "λ = 5, lifted, 0.6": (5.0, "lifted, 0.6"),
}


def under(gaussians: Gaussians, direction: np.ndarray, way: str, strength: float = 10.0) -> np.ndarray:
    """[N] occlusion by a Sun in `direction` [3]; way: of `WAYS`. What is lifted has the thesis's bias as well."""
    light = light_rows(direction)
    camera, sun = fit_camera(gaussians, light, SIZE), towards_sun(light)
    bias = receiver_bias(gaussians, sun, strength)
    if way == "grazing bias":
        bias = bias.at_least(grazing_bias(gaussians, camera))
    points = lifted(gaussians, sun, *WAYS[way]) if WAYS[way] else None
    return np.array(occlusion_by_splatting(gaussians, camera, ad.Float(0) if way == "none" else bias.bias, points))


def occlusion(arrays: dict[str, np.ndarray], elevation: float, way: str) -> np.ndarray:
    """[N], the Sun `elevation` degrees above the plate, towards -x."""
    sun = np.array([-np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))])
    return under(Gaussians.from_numpy(arrays), sun, way)


def acne(elevation: float, way: str, count: int = COUNT) -> float:
    """Mean occlusion of the bare plate; a border of 5 cm is left out."""
    arrays = plate(count)
    return float(occlusion(arrays, elevation, way)[np.all(np.abs(arrays["means"][:, :2]) < 0.95, axis=1)].mean())


def screen_shadow(elevation: float, way: str, count: int = COUNT) -> tuple[float, float]:
    """Metres by which the screen's shadow recedes from its foot, and by which its tip is too far (nan where it is not
    on the plate)."""
    arrays = plate(count, screen=True)
    x, y = arrays["means"][:count, :2].T
    dark = occlusion(arrays, elevation, way)[:count] > 0.5
    strip, tip = np.abs(y) < 0.4, SCREEN / np.tan(np.radians(elevation))
    end, near, far = min(0.5 * tip, 0.5), max(tip - 0.1, 0.5 * tip), tip + 0.1
    recedes = float((~dark[strip & (x > 0) & (x < end)]).mean() * end)
    if far > 0.95:
        return recedes, float("nan")
    return recedes, float(near + dark[strip & (x > near) & (x < far)].mean() * (far - near) - tip)


def main() -> None:
    print(f"| Sun [deg] | {' | '.join(WAYS)} |")
    for elevation in (2, 5, 10, 15, 20, 30, 45, 60, 90):
        cells = []
        for way in WAYS:
            recedes, tip = (1000 * v for v in screen_shadow(elevation, way)) if elevation < 90 else (np.nan, np.nan)
            cells.append(f"{100 * acne(elevation, way):.1f} · {recedes:.0f} · {tip:.0f}".replace("nan", "–"))
        print(f"| {elevation} | {' | '.join(cells)} |", flush=True)
    if len(sys.argv) == 3:
        gaussians = Gaussians.from_numpy(read_tensors(Path(sys.argv[1]) / "model.safetensors")[0])
        dataset = read_dataset(Path(sys.argv[2]))
        for name, (strength, way) in TRUTH.items():
            shares = judged(gaussians, dataset, lambda sun, s=strength, w=way: under(gaussians, sun, w, s))
            print(f"| {name} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |", flush=True)


if __name__ == "__main__":
    main()
