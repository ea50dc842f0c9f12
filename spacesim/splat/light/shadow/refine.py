"""The refinement network's inputs: a raw occlusion to a corrected one (thesis 4.3.3, table 4.2)."""

from dataclasses import dataclass, field
from typing import Literal

import drjit as dr

from spacesim.backend.arrays import Array3f, Float
from spacesim.data.errors import check_ranges
from spacesim.data.structure import check_fields
from spacesim.learning.networks.network import MAX_FEATURES, MAX_LAYERS, MAX_WIDTH, MlpShape, sigmoid
from spacesim.splat.light.encoding import Encoding

SURE = 0.02  #: a raw occlusion nearer to 0 or 1 counts as this near: the network can still change it


@dataclass(frozen=True)
class ShadowRefinementConfig:
    """Defaults: table 4.2 and the inputs of 4.11."""

    features: int = 6  #: learned numbers that each Gaussian has for this network
    width: int = 64  #: units of a hidden layer
    layers: int = 3  #: matrix products: 3 are two hidden layers
    sun: Encoding = field(default_factory=Encoding)  #: encoding of the Sun's direction
    positions: Literal["light", "world"] = "light"  #: axes of the model-centred means: the light's (4.12) or world
    positional: int = 0  #: octaves of the encoding of positions, 0 for the bare coordinates
    bias_info: bool = True  #: raw visibility, normal alignment, light extent and applied bias (4.3.4) are inputs, too
    #: the network corrects the raw occlusion, which is where training starts; false: it gives the refined occlusion,
    #: through a sigmoid (4.13)
    residual: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, features=(0, MAX_FEATURES), width=(1, MAX_WIDTH), layers=(1, MAX_LAYERS), positional=(0, 9))

    @property
    def shape(self) -> MlpShape:
        """The network: inputs of each Gaussian, the Sun in common, one number out."""
        inputs = 1 + self.features + 3 + 6 * self.positional + 4 * self.bias_info
        return MlpShape(inputs, self.sun.size, 1, self.width, self.layers)


def refine_inputs(
    config: ShadowRefinementConfig, occlusion: Float, features: list[Float], positions: Array3f, info: list[Float]
) -> list[Float]:
    """The inputs of 4.11 but for the Sun, arrays [M]. positions: Array3f [3, M], model-centred, in training scale
    (4.12);  info: normal alignment, light extent and bias, those in training scale."""
    inputs = [occlusion, *features, *Encoding("positional", config.positional)(positions)]
    return [*inputs, 1 - occlusion, *info] if config.bias_info else inputs


def refine_occlusion(config: ShadowRefinementConfig, occlusion: Float, output: Float) -> Float:
    """sigma(g), 4.13, which leaves open how the network's output g comes to lie in [0, 1]; or with `residual`
    sigma(logit(occ) + g): a correction in logits, so that one that says 0 changes nothing but occlusions within `SURE`
    of 0 and 1 (ours)."""
    if not config.residual:
        return sigmoid(output)
    sure = dr.clip(occlusion, SURE, 1 - SURE)
    return dr.rcp(1 + (1 - sure) / sure * dr.exp(-output))
