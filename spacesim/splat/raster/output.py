"""What rendering gives: the planes of a picture, and what blended values are for its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float
from spacesim.data.records import planes_repr

OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal")


@dataclass
class RenderOutput:
    """What was asked for; the rest is None. Planes are [height * width], row by row; `image` gives them their shape."""

    color: Array3f | None  #: premultiplied (over black), sRGB values
    alpha: Float  #: in [0, 1]
    depth: Float | None  #: expected depth: mean z of the centres by blending weight, metres; 0 where alpha is 0
    width: int  #: pixels
    height: int  #: pixels
    median_depth: Float | None = None  #: z at which the transmittance falls below 1/2, metres; 0 where it does not
    normal: Array3f | None = None  #: world axes: direction of the blended normals, unit length; 0 where there are none
    features: list[Float] | None = (
        None  #: the user's channels, blended like colour: sum of weight x value, so 0 where alpha is 0
    )

    def __repr__(self) -> str:
        return planes_repr(self, self.width, self.height)

    def image(self, name: str) -> np.ndarray:
        """One output by name: [H, W], or [H, W, C] of colour, normal and features; float32.

        Raises ValueError for what was not asked for.
        """
        planes = getattr(self, name) if name in (*OUTPUTS, "features") else None
        if planes is None:
            available = [output for output in (*OUTPUTS, "features") if getattr(self, output) is not None]
            raise ValueError(f"name: expected one of the outputs asked for ({', '.join(available)}), found {name!r}")
        if name in ("alpha", "depth", "median_depth"):
            return planes_image([planes], self.width, self.height)[..., 0]
        return planes_image(list(planes), self.width, self.height)

    def to_numpy(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(colour [H, W, 3], alpha [H, W], depth [H, W] in metres), float32.

        Raises ValueError where `outputs` left colour or depth out; `image` gives what is there, one by one.
        """
        for name in ("color", "depth"):
            if getattr(self, name) is None:
                raise ValueError(f"outputs: expected color and depth for to_numpy, found no {name}")
        return self.image("color"), self.image("alpha"), self.image("depth")

    def over(self, background: Array3f) -> Array3f:
        """The picture over a background colour or picture.

        Raises ValueError where `outputs` left the colour out.
        """
        if self.color is None:
            raise ValueError("outputs: expected color for over, found none")
        return self.color + (1 - self.alpha) * background


def planes_image(planes: Sequence[Float], width: int, height: int) -> np.ndarray:
    """[H, W, C] float32 of C planes [H * W], put beside each other on the device and copied to the host at once."""
    flat = dr.ravel(ad.ArrayXf(planes)) if planes else ad.Float()
    return np.array(flat, dtype=np.float32).reshape(height, width, len(planes))


def over_alpha(weighted: Float, alpha: Float) -> Float:
    """Blended values divided by the alpha; 0 where that is 0."""
    covered = alpha > 0
    return dr.select(covered, weighted / dr.select(covered, alpha, 1), 0)
