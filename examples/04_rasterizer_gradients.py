"""4. Differentiate: fit a few hundred Gaussians to a picture by gradient descent, without the training loop.

    python examples/04_rasterizer_gradients.py      5 to 15 seconds on two cores; writes out/examples/fit.png

`render` is an ordinary Dr.Jit function: enable gradients on any of its parameters and go backward.
"""

from pathlib import Path

import numpy as np

import spacesim  # noqa: F401  before drjit: it names a libLLVM that works

# isort: split
import drjit as dr
from drjit.opt import Adam

from spacesim.backend import ad
from spacesim.data.geometry import look_at
from spacesim.data.images import srgb_from_linear, write_png
from spacesim.data.records import Camera
from spacesim.splat.gaussians import NAMES, Gaussians
from spacesim.splat.project import Pinhole
from spacesim.splat.render import render

OUT = Path("out/examples/fit.png")
RATES = {"means": 5e-3, "log_scales": 2e-2, "quaternions": 1e-2, "logit_opacities": 5e-2, "sh": 1e-2}


def main(out: Path = OUT, count: int = 300, size: int = 128, steps: int = 200) -> list[float]:
    camera = Pinhole.of(Camera.from_fov(look_at([0, -4, 0], [0, 0, 0]), size, size, fov_x_deg=40))
    truth = half_moon(size)
    target = ad.Array3f(np.repeat(truth.reshape(1, -1), 3, axis=0).astype(np.float32))
    optimizer = Adam(lr=1e-2, params=random_gaussians(count).parameters())
    optimizer.set_learning_rate(RATES)
    losses = []
    for _ in range(steps):
        output = render(Gaussians(**{name: optimizer[name] for name in NAMES}), camera)
        loss = dr.mean(dr.square(output.over(ad.Array3f(0)) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss[0]))
    print(f"mean squared error: {losses[0]:.5f} at first, {losses[-1]:.5f} after {steps} steps")

    picture = np.array(output.colour).T.reshape(size, size, 3).mean(axis=-1)
    write_png(out, np.rint(255 * np.clip(np.hstack([truth, picture]), 0, 1)).astype(np.uint8))
    return losses


def half_moon(size: int) -> np.ndarray:
    """[size, size] sRGB values of a matt sphere that is lit from the upper right."""
    x, y = np.meshgrid(*2 * [np.linspace(-1.25, 1.25, size)])
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return srgb_from_linear((z > 0) * np.maximum(0.7 * x - 0.6 * y + 0.39 * z, 0))


def random_gaussians(count: int) -> Gaussians:
    rng = np.random.default_rng(0)
    return Gaussians.from_numpy(
        {
            "means": rng.uniform(-1, 1, (count, 3)),
            "log_scales": np.full((count, 3), np.log(0.08)),
            "quaternions": rng.normal(size=(count, 4)),
            "logit_opacities": np.zeros(count),
            "sh": np.zeros((count, 1, 3)),  # degree 0: grey
        }
    )


if __name__ == "__main__":
    main()
