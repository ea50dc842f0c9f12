"""The stages of a training step apart, each on the results of the stage before."""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.kernels.llvm import is_usable
from spacesim.data.records import Camera
from spacesim.splat.raster.blend import backward, forward
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.output import RenderOutput
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.loss.photometric import photometric_loss
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.optimizer.update import Update, ViewGradients
from spacesim.splat.train.stages import project_views

SSIM_WEIGHT = 0.2
DEGREE = 3  #: of spherical harmonics
RECORDINGS = 8  #: kept of a stage


class Pipeline:
    """Gaussians before a camera. Each method is a stage: it evaluates its results and leaves them for the next.

    Stages of fixed shape (project, loss, update) are recorded and replayed, as the trainer does; on a CPU the loss is
    not, whose kernel of text no recording takes in: the trainer has it between two, which compare the picture twice.
    """

    def __init__(self, arrays: dict[str, np.ndarray], camera: Camera) -> None:
        self.gaussians, self.camera = Gaussians.from_numpy(arrays), Pinhole.of(camera)
        self.size = camera.width, camera.height
        self.optimizer = Adam(self.gaussians.rows())
        noise = np.random.default_rng(0).uniform(size=(3, camera.width * camera.height)).astype(np.float32)
        self.truth = list(ad.Array3f(noise))
        self.factors = ad.Float([1.0, 1.0, *[0.0] * len(self.gaussians.rows())])
        dr.eval(self.gaussians.rows(), self.optimizer.arrays, self.truth, self.factors)
        self._project = recorded(project_views, limit=RECORDINGS)
        self._loss = _loss if is_usable() else recorded(_loss, limit=RECORDINGS)
        self._update = Update(antialiased=False, scale=1.0)
        for stage in (self.project, self.bin, self.forward, self.loss, self.backward, self.update):
            stage()

    def project(self) -> None:
        """Gaussians to ellipses on the screen and colours."""
        projected = self._project(self.gaussians.rows(), self.camera, DEGREE, False, (), 1.0)
        self.splats, self.footprints, self.color = *projected[:2], projected[2]["color"]

    def bin(self) -> None:
        """Ellipses to lists of tiles."""
        self.lists = bin_splats(self.splats, self.footprints, *self.size)

    def forward(self) -> None:
        """Lists to pixels."""
        self.blended = forward(self.splats, self.color, self.lists, *self.size, adjoint=True)
        dr.eval(self.blended)

    def loss(self) -> None:
        """L1 + D-SSIM and the gradients of the pixels."""
        self.grad_pixels = self._loss(self.blended.features, self.blended.transmittance, self.truth, self.size)

    def backward(self) -> None:
        """Gradients of the pixels to gradients of the ellipses and colours."""
        self.grad_splats = backward(self.splats, self.blended, self.lists, self.size, *self.grad_pixels)

    def update(self) -> None:
        """Gradients of the ellipses to those of the parameters, and an Adam step whose rates are 0."""
        gradients = ViewGradients(self.camera, self.grad_splats.splats, {"color": self.grad_splats.features})
        self._update(self.gaussians, self.optimizer, DEGREE, [gradients], self.factors, {})

    def frame(self) -> RenderOutput:
        """Parameters to picture, as a user asks for it: colour and alpha, without gradients."""
        output = render(self.gaussians, self.camera, outputs=("color",))
        dr.eval(output.color, output.alpha)
        return output

    @property
    def blended_pairs(self) -> int:
        """Pairs that the tiles walk before all their pixels are opaque, at least one pixel of each being blended."""
        state, start = self.blended.state, np.array(self.lists.start, np.int64)
        assert state is not None
        last = np.array(state.last, np.int64).reshape(len(start), -1).max(axis=1)
        return int(np.maximum(last - start, 0)[last > 0].sum())


def arguments_of(pipeline: Pipeline) -> dict[str, Any]:
    """Numbers that say how much work there is."""
    lists = pipeline.lists
    return {
        "pairs": lists.pairs,
        "blended pairs": pipeline.blended_pairs,
        "tile": f"{lists.shape.width}x{lists.shape.height}, {lists.shape.threads} threads",
    }


def _loss(color: list[Any], transmittance: Any, truth: list[Any], size: tuple[int, int]) -> tuple[list[Any], Any]:
    """Gradients of the loss over a grey background, by colour and transmittance."""
    planes, passed = ad.Array3f(color), ad.Float(transmittance)
    dr.enable_grad(planes, passed)
    dr.backward(photometric_loss(planes + 0.5 * passed, ad.Array3f(truth), *size, SSIM_WEIGHT))
    return list(dr.grad(planes)), dr.grad(passed)
