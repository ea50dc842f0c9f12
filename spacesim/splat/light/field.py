"""The appearance field: colour of each Gaussian by its features, the Sun and the view (thesis 4.1, 4.2, table 4.1)."""

from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.data.errors import check_ranges
from spacesim.splat.light.columns import Lanes
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.mlp import MOST_FEATURES, MOST_LAYERS, MOST_WIDTH, MlpShape
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.surface import shortest_axis

LOBES = (8, 32, 128, 512)  #: exponents of n . h, from satin to mirror, chosen: each is the one before to the fourth
COSINES = 4 + len(LOBES)  #: numbers that `surface_cosines` gives
TURNED = 0.2  #: a surface with n . s of at most -TURNED is turned away from the Sun; chosen (docs/shadows.md)


@dataclass(frozen=True)
class FieldConfig:
    """Defaults: table 4.1. `layers` counts matrix products: 3 are two hidden layers of `width` units (the thesis says
    "depth 3", which can mean either).

    surface: each Gaussian learns a normal, too, and the field is told the cosines of a reflectance model about it
    (`surface_cosines`): what one side of a body has taught then serves the others, and Suns never seen. Ours.
    """

    features: int = 128
    width: int = 256
    layers: int = 3
    sun: Encoding = field(default_factory=Encoding)
    view: Encoding = field(default_factory=Encoding)
    surface: bool = False

    def __post_init__(self) -> None:
        check_ranges(self, features=(0, MOST_FEATURES), width=(1, MOST_WIDTH), layers=(1, MOST_LAYERS))

    @property
    def stored(self) -> int:
        """Numbers of each Gaussian: its features, then its normal (of any length), if it has one."""
        return self.features + 3 * self.surface

    @property
    def shape(self) -> MlpShape:
        """The network: features, view and cosines of each Gaussian, the Sun in common, three colours out."""
        inputs = self.features + self.view.size + COSINES * self.surface
        return MlpShape(inputs, self.sun.size, 3, self.width, self.layers)


@dataclass
class FieldInputs:
    """What the field reads of the world. features: Float, packed [F * N], `FieldConfig.stored` of them the field's;
    means: Array3f [3, N], metres;  turns: (quaternions, log scales) of the Gaussians;  sun: Array3f of width 1, unit,
    towards the Sun"""

    features: Any
    means: Any
    turns: tuple[Any, Any]
    camera: Projection
    sun: Any


def field_items(config: FieldConfig, features: Any, views: list[Any], lanes: Lanes) -> Any:
    """Items of the network (4.2): TensorXf [B, C, m]. features: packed;  views: of `field_views`"""
    return lanes.matrix([*lanes.block(features, 0, config.features), *views], config.shape.rows)


def field_views(config: FieldConfig, inputs: FieldInputs, lanes: Lanes) -> list[Any]:
    """What stands behind the features among the network's inputs, and changes with Sun and camera: Floats [M]."""
    direction = inputs.camera.directions_to(lanes.spread(inputs.means))
    rows: list[Any] = config.view(direction)
    if config.surface:
        rows += surface_cosines(_normals(config, inputs, lanes), direction, inputs.sun)
    return rows


def facing(config: FieldConfig, inputs: FieldInputs, views: list[Any], lanes: Lanes) -> list[Any]:
    """Float [M] in [0, 1] in a list: does the side that is seen face the Sun? 1 where its learned normal or the
    Gaussian's shortest axis does, 1/2 at n . s = -TURNED / 2, as neither is exact. Nothing of a field without normals.
    views: of `field_views`"""
    return [_faces(views[config.view.size], inputs, lanes)] if config.surface else []


def by_normals(config: FieldConfig, inputs: FieldInputs, by_items: Any, by_facing: list[Any], lanes: Lanes) -> Any:
    """TensorXf [B, 3, m]: gradient of the normals, from that of the network's items and, if any, of `facing`."""
    normals = _normals(config, inputs, lanes)
    dr.enable_grad(normals)
    direction = inputs.camera.directions_to(lanes.spread(inputs.means))
    cosines = surface_cosines(normals, direction, inputs.sun)
    first = config.features + config.view.size
    along = sum((cosine * lanes.row(by_items, first + i) for i, cosine in enumerate(cosines)), ad.Float(0))
    for gradient in by_facing:
        along += gradient * _faces(cosines[0], inputs, lanes)
    dr.backward(along)
    return lanes.matrix(list(dr.grad(normals)))


def turned_over(config: FieldConfig, inputs: FieldInputs, lanes: Lanes) -> Any:
    """Bool [M]: is the side seen to which the learned normal does not point?"""
    return _points_away(_normals(config, inputs, lanes), inputs.camera.directions_to(lanes.spread(inputs.means)))


def surface_cosines(normals: Any, direction: Any, sun: Any) -> list[Any]:
    """n . s, max(n . s, 0), n . v, n . h, and powers of the last: what a reflectance model of an isotropic surface
    depends on (Blinn 1977), [M] each. A network of few units makes no lobe as narrow as a glint out of n . h alone.

    normals: Array3f [3, M], of any length; the side that is seen counts, n . v >= 0;  direction: Array3f [3, M], unit,
    from the camera;  sun: Array3f, unit, towards the Sun;  h: halfway between the Sun and the viewer, v = -direction
    """
    seen = _seen(unit_normals(normals), direction)
    half = sun - direction
    half2 = dr.squared_norm(half)
    half *= dr.select(half2 > 1e-12, dr.rsqrt(dr.maximum(half2, 1e-12)), 0)
    lambert = dr.dot(seen, sun)
    halfway = dr.maximum(dr.dot(seen, half), 0)
    lobes = [dr.square(dr.square(dr.square(halfway)))]
    for _ in LOBES[1:]:
        lobes.append(dr.square(dr.square(lobes[-1])))
    return [lambert, dr.maximum(lambert, 0), -dr.dot(seen, direction), halfway, *lobes]


def unit_normals(normals: Any) -> Any:
    """Array3f [3, M] of unit length; (0, 0, 1) in place of what has no direction."""
    length2 = dr.squared_norm(normals)
    known = dr.detach(length2) > 1e-12
    return dr.select(known, normals, ad.Array3f(0, 0, 1)) * dr.rsqrt(dr.select(known, length2, 1))


def _faces(lambert: Any, inputs: FieldInputs, lanes: Lanes) -> Any:
    """Of n . s of the learned normals."""
    axis = shortest_axis(*(lanes.spread(dr.detach(turn)) for turn in inputs.turns))
    axis = _seen(axis, inputs.camera.directions_to(lanes.spread(inputs.means)))
    return dr.clip(1 + dr.maximum(lambert, dr.dot(axis, inputs.sun)) / TURNED, 0, 1)


def _seen(normals: Any, direction: Any) -> Any:
    """Normals of the side that is seen. direction: from the camera"""
    return dr.select(_points_away(normals, direction), -normals, normals)


def _points_away(normals: Any, direction: Any) -> Any:
    return dr.detach(dr.dot(normals, direction)) > 0


def _normals(config: FieldConfig, inputs: FieldInputs, lanes: Lanes) -> Any:
    """Array3f [3, M], of any length."""
    return ad.Array3f(lanes.block(inputs.features, config.features, 3))
