"""The stages of a training step apart, each on the results of the stage before."""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.data.records import Camera
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Pinhole, project
from spacesim.splat.rasterize import backward, forward
from spacesim.splat.render import render, view_colours
from spacesim.splat.tiles import bin_splats
from spacesim.splat.train.losses import photometric_loss
from spacesim.splat.train.optimizer import Adam, adam_step

SSIM_WEIGHT = 0.2


class Pipeline:
    """Gaussians before a camera. Each method is a stage: it evaluates its results and leaves them for the next."""

    def __init__(self, arrays: dict[str, np.ndarray], camera: Camera) -> None:
        self.gaussians, self.camera = Gaussians.from_numpy(arrays), Pinhole.of(camera)
        self.size = camera.width, camera.height
        self.optimizer = Adam(self.gaussians.rows())
        noise = np.random.default_rng(0).uniform(size=(3, camera.width * camera.height)).astype(np.float32)
        self.truth = ad.Array3f(noise)
        self.factors = ad.Float([1.0, 1.0, *[0.0] * len(self.gaussians.rows())])
        dr.eval(self.gaussians.rows(), self.truth, self.factors)
        for stage in (self.project, self.bin, self.forward, self.loss, self.backward, self.update):
            stage()

    def project(self) -> None:
        """Gaussians to ellipses on the screen and colours."""
        self.splats, self.footprints = project(self.gaussians, self.camera)
        self.colour = list(view_colours(self.gaussians, self.camera))
        dr.eval(self.splats, self.footprints, self.colour)

    def bin(self) -> None:
        """Ellipses to lists of tiles."""
        self.lists = bin_splats(self.splats, self.footprints, *self.size)

    def forward(self) -> None:
        """Lists to pixels."""
        self.blended = forward(self.splats, self.colour, self.lists, *self.size)
        dr.eval(self.blended.features, self.blended.transmittance, self.blended.tile_last)

    def loss(self) -> None:
        """L1 + D-SSIM and the gradients of the pixels."""
        colour, transmittance = ad.Array3f(self.blended.features), ad.Float(self.blended.transmittance)
        dr.enable_grad(colour, transmittance)
        dr.backward(photometric_loss(colour + 0.5 * transmittance, self.truth, *self.size, SSIM_WEIGHT))
        self.by_pixel = list(dr.grad(colour)), dr.grad(transmittance)
        dr.eval(self.by_pixel)

    def backward(self) -> None:
        """Gradients of the pixels to gradients of the ellipses and colours."""
        self.by_splat = backward(self.splats, self.blended, self.lists, self.size, *self.by_pixel)

    def update(self) -> None:
        """Gradients of the ellipses to those of the parameters, and an Adam step whose rates are 0."""
        rows = [ad.Float(row) for row in self.gaussians.rows()]
        dr.enable_grad(rows)
        gaussians = Gaussians.from_rows(rows)
        splats, _ = project(gaussians, self.camera)
        pairs = [(getattr(splats, name), getattr(self.by_splat.splats, name)) for name in ("x", "y", "a", "b", "c")]
        pairs += [(splats.opacity, self.by_splat.splats.opacity)]
        pairs += list(zip(view_colours(gaussians, self.camera), self.by_splat.features, strict=True))
        dr.backward(sum((value * gradient for value, gradient in pairs[1:]), pairs[0][0] * pairs[0][1]))
        numbers = [dr.gather(ad.Float, self.factors, ad.UInt32(i)) for i in range(2 + len(rows))]
        moments, gradients = (self.optimizer.first, self.optimizer.second), [dr.grad(row) for row in rows]
        moved, first, second = adam_step(dr.detach(rows), gradients, moments, numbers[2:], (numbers[0], numbers[1]))
        dr.eval(moved, first, second)

    def frame(self) -> None:
        """Parameters to picture, as a user asks for it: colour and alpha, without gradients."""
        output = render(self.gaussians, self.camera, outputs=("colour",))
        dr.eval(output.colour, output.alpha)

    @property
    def blended_pairs(self) -> int:
        """Pairs that the tiles walk before all their pixels are opaque, at least one pixel of each being blended."""
        last, start = np.array(self.blended.tile_last, np.int64), np.array(self.lists.start, np.int64)
        return int(np.maximum(last - start, 0)[last > 0].sum())


def arguments_of(pipeline: Pipeline) -> dict[str, Any]:
    """Numbers that say how much work there is."""
    lists = pipeline.lists
    return {
        "pairs": lists.pairs,
        "blended pairs": pipeline.blended_pairs,
        "tile": f"{lists.shape.width}x{lists.shape.height}, {lists.shape.lanes} lanes",
    }
