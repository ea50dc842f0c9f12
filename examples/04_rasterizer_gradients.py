"""4. Differentiate: fit Gaussians to a picture by gradient descent, without the training loop.

    python examples/04_rasterizer_gradients.py      5 to 15 seconds on two cores; writes out/examples/fit.png

`ss.render` is an ordinary Dr.Jit function: enable gradients on any of its parameters and go backward.
"""

from pathlib import Path

import numpy as np
from PIL import Image

import spacesim as ss

# isort: split
import drjit as dr
from drjit.opt import Adam


def main(out="out/examples/fit.png", count=300, size=128, steps=200):
    camera = ss.Camera.look_at([0, -4, 0], [0, 0, 0], size, size, fov_x_deg=40)
    x, y = np.meshgrid(*2 * [np.linspace(-1.25, 1.25, size)])
    truth = np.clip(np.sqrt(np.maximum(1 - x * x - y * y, 0)) * (0.8 * x - 0.6 * y + 0.4), 0, 1)  # a ball
    start = ss.Gaussians.random(count, radius=1.0, scale=0.08, seed=0)
    target = type(start.means)(np.repeat(truth.reshape(1, -1), 3, axis=0).astype(np.float32))
    optimizer, losses = Adam(lr=1e-2, params=start.parameters()), []
    for _ in range(steps):
        picture = ss.render(ss.Gaussians(**dict(optimizer.items())), camera)
        loss = dr.mean(dr.square(picture.color - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss[0]))
    print(f"mean squared error: {losses[0]:.5f} at first, {losses[-1]:.5f} after {steps} steps")
    both = np.hstack([truth, picture.image("color").mean(axis=-1)])
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(255 * np.clip(both, 0, 1)).astype(np.uint8)).save(out)
    return losses


if __name__ == "__main__":
    main()
