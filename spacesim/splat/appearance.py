"""The appearance field: colour of each Gaussian by its features, the Sun and the view (thesis 4.1, 4.2, table 4.1)."""

from dataclasses import dataclass, field
from typing import Any

from spacesim.splat.cameras import Projection
from spacesim.splat.encoding import Encoding
from spacesim.splat.lanes import Lanes
from spacesim.splat.mlp import MlpShape


@dataclass(frozen=True)
class FieldConfig:
    """Defaults: table 4.1. `layers` counts matrix products: 3 are two hidden layers of `width` units (the thesis says
    "depth 3", which can mean either)."""

    features: int = 128
    width: int = 256
    layers: int = 3
    sun: Encoding = field(default_factory=Encoding)
    view: Encoding = field(default_factory=Encoding)

    @property
    def shape(self) -> MlpShape:
        """The network: features and view of each Gaussian, the Sun in common, three colours out."""
        return MlpShape(self.features + self.view.size, self.sun.size, 3, self.width, self.layers)


def field_items(config: FieldConfig, features: Any, means: Any, camera: Projection, lanes: Lanes) -> Any:
    """TensorXf [features + view terms, M]: what the field reads of each Gaussian (4.2).

    features: Float, packed [F * N] with F >= `config.features`;  means: Array3f [3, N]
    """
    view = config.view(camera.directions_to(lanes.spread(means)))
    return lanes.matrix([lanes.block(features, 0, config.features), *view])
