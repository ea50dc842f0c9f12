"""What a run predicts of a view."""

from dataclasses import dataclass, field

import numpy as np

from spacesim import backend
from spacesim.backend.memory import check_memory
from spacesim.data.images.tone import Tone
from spacesim.data.records import Camera, planes_repr

A_PIXEL = {"cuda": 80, "llvm": 225}
"""Bytes of main memory that a predicted pixel takes at most, by measured peaks: on LLVM 160 until it is rendered and 65
more until it is written."""


KINDS = ("rgb", "alpha", "depth", "normal", "shadow")  #: of pictures of a prediction
MATERIAL_KINDS = ("albedo", "specular", "roughness", "metallic")  #: of a `MaterialView`, which no Sun changes


@dataclass(frozen=True, eq=False)
class Prediction:
    """A rendered view, float32."""

    rgb: np.ndarray  #: [H, W, 3] sRGB values over black, beyond 1 where what bounces makes them brighter than white
    alpha: np.ndarray  #: [H, W]
    depth: np.ndarray  #: [H, W] expected depth in metres, 0 where alpha is 0
    visibility: np.ndarray | None  #: [H, W], or None from a method without
    #: [H, W, 3] unit vectors in world axes, 0 where there is no surface, or None where not asked for
    normal: np.ndarray | None = None
    #: [H, W, 3] linear display values over black, not clipped; None of a run whose colours are sRGB values
    linear: np.ndarray | None = field(default=None, kw_only=True)
    tone: Tone = field(default="srgb", kw_only=True)  #: the curve by which linear light is shown in `rgb`

    def __repr__(self) -> str:
        return planes_repr(self, self.alpha.shape[1], self.alpha.shape[0])


@dataclass(frozen=True, eq=False, repr=False)
class ComposedPrediction(Prediction):
    """A view of a scene. visibility: of models without shadows of their own 1 where no other model is before the
    Sun."""

    #: [H, W] int32, number of the object with the largest share of the pixel, counted from 1 in the order of the
    #: models; 0 where less than half of the pixel is covered
    id: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class MaterialView:
    """What a camera sees of the materials that were read out of a model, float32, straight: not weighted by alpha."""

    albedo: np.ndarray  #: [H, W, 3] linear reflectance, of metals the specular one; 0 where alpha is 0, as all here
    roughness: np.ndarray  #: [H, W] alpha of GGX, 1 where no gloss is seen
    metallic: np.ndarray  #: [H, W] share of metals, in [0, 1]
    normal: np.ndarray  #: [H, W, 3] unit vectors in world axes, of the learned normals
    alpha: np.ndarray  #: [H, W]
    specular: np.ndarray  #: [H, W, 3] linear reflectance of facets at normal incidence, 0 where none are seen

    def __repr__(self) -> str:
        return planes_repr(self, self.alpha.shape[1], self.alpha.shape[0])


def check_picture(camera: Camera) -> None:
    """Raise MemoryError, before it is drawn, where a camera's picture does not fit into memory."""
    needed = A_PIXEL[backend.select()] * camera.width * camera.height
    check_memory(needed, f"a picture of {camera.width} x {camera.height} pixels")
