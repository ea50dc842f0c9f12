"""4. Differentiate: fit Gaussians to a picture by gradient descent, without the training loop.

    python examples/04_rasterizer_gradients.py      5 to 15 seconds on two cores; writes fit.pgm

`ss.render` is an ordinary Dr.Jit function: enable gradients on any of its parameters and go backward.
"""

import numpy as np

import spacesim as ss

# isort: split
from drjit import backward, mean, opt, square


def main(out="fit.pgm", count=300, size=128, steps=200):
    camera = ss.Camera.look_at([0, -4, 0], [0, 0, 0], size, size, fov_x_deg=40)
    y, x = np.mgrid[-1.25 : 1.25 : size * 1j, -1.25 : 1.25 : size * 1j]
    truth = np.clip(np.sqrt(np.maximum(1 - x * x - y * y, 0)) * (0.8 * x - 0.6 * y + 0.4), 0, 1)  # a ball
    start = ss.Gaussians.random(count, radius=1.0, scale=0.08, seed=0)
    target = type(start.means)(np.repeat(truth.reshape(1, -1), 3, axis=0).astype(np.float32))
    optimizer, losses = opt.Adam(lr=1e-2, params=start.parameters()), []
    for _ in range(steps):
        picture = ss.render(ss.Gaussians(**dict(optimizer.items())), camera)
        losses.append(mean(square(picture.color - target), axis=None))
        backward(losses[-1])
        optimizer.step()
    pixels = np.uint8(255 * np.hstack([truth, picture.image("color")[..., 0].clip(0, 1)]))
    np.savetxt(out, pixels, "%d", header=f"P2 {2 * size} {size} 255", comments="")  # a plain PGM picture
    return float(losses[0][0]), float(losses[-1][0])


if __name__ == "__main__":
    print("mean squared error at first and at last:", *main())
