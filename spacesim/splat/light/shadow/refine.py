"""The refinement network's inputs: a raw occlusion to a corrected one (thesis 4.3.3, table 4.2)."""

from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.data.errors import InputError, check_ranges
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.mlp import MOST_FEATURES, MOST_LAYERS, MOST_WIDTH, MlpShape

POSITIONS = ("light", "world")
SURE = 0.02  #: a raw occlusion nearer to 0 or 1 counts as this near: the network can still change it (chosen)


@dataclass(frozen=True)
class RefineConfig:
    """Defaults: table 4.2 and the inputs of 4.11. positions: axes of the model-centred means, those of the canonical
    light frame (4.12) or of the world;  positional: octaves of their encoding, 0 for the bare coordinates;
    bias_info: raw visibility, normal alignment, light extent and applied bias (4.3.4) are read, too."""

    features: int = 6
    width: int = 64
    layers: int = 3
    sun: Encoding = field(default_factory=Encoding)
    positions: str = "light"
    positional: int = 0
    bias_info: bool = True

    def __post_init__(self) -> None:
        check_ranges(
            self, features=(0, MOST_FEATURES), width=(1, MOST_WIDTH), layers=(1, MOST_LAYERS), positional=(0, 9)
        )
        if self.positions not in POSITIONS:
            raise InputError(f"refinement: expected positions in {' or '.join(POSITIONS)}, found {self.positions!r}")

    @property
    def shape(self) -> MlpShape:
        """The network: what is told of each Gaussian, the Sun in common, one correction out."""
        inputs = 1 + self.features + 3 + 6 * self.positional + 4 * self.bias_info
        return MlpShape(inputs, self.sun.size, 1, self.width, self.layers)


def refine_inputs(
    config: RefineConfig, occlusion: Any, features: list[Any], positions: Any, info: list[Any]
) -> list[Any]:
    """The inputs of 4.11 but for the Sun, arrays [M]. positions: Array3f [3, M], model-centred, in training scale
    (4.12);  info: normal alignment, light extent and bias, those in training scale."""
    inputs = [occlusion, *features, *Encoding("positional", config.positional)(positions)]
    return [*inputs, 1 - occlusion, *info] if config.bias_info else inputs


def refined(occlusion: Any, correction: Any) -> Any:
    """sigma(logit(occ) + g): what the network gives is a correction in logits, so that one that says 0 changes nothing
    but occlusions within `SURE` of 0 and 1 (our reading of 4.13, which leaves the output's form open)."""
    sure = dr.clip(occlusion, SURE, 1 - SURE)
    return dr.rcp(1 + (1 - sure) / sure * dr.exp(-correction))


def refined_slope(occlusion: Any) -> Any:
    """d logit(occ) / d occ, 0 where the occlusion is held at `SURE`."""
    inside = (occlusion > SURE) & (occlusion < 1 - SURE)
    return dr.select(inside, dr.rcp(dr.maximum(occlusion * (1 - occlusion), 1e-6)), 0)
