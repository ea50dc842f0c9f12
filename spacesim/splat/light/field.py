"""The appearance field: colour of each Gaussian by its features, the Sun and the view (thesis 4.1, 4.2, table 4.1)."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Array4f, Bool, Float, TensorXf
from spacesim.data.errors import check_ranges
from spacesim.data.structure import check_fields
from spacesim.learning.networks.network import MAX_FEATURES, MAX_LAYERS, MAX_WIDTH, MlpShape, row_of, sigmoid
from spacesim.learning.reflectance import COSINES, points_away, seen_side_normals, surface_cosines
from spacesim.splat.light.earthlight import earth_irradiance
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.surface import shortest_axis
from spacesim.splat.raster.tone import (
    ENCODED_PEAK,
    decode_radiance,
    decode_radiance_slope,
    decode_srgb,
    decode_srgb_slope,
    encode_radiance,
    encode_srgb_unclipped,
)

Decoding = Literal["srgb", "radiance"]
"""How linear colours are decoded from what the field's network gives: as sRGB values, or by `decode_radiance`."""

TURNED = 0.15  #: a surface with n . s of at most -TURNED is turned away from the Sun


@dataclass(frozen=True)
class DirectionsConfig:
    """The field takes the directions of Sun and view, as in the thesis."""

    kind: ClassVar[str] = "directions"

    sun: Encoding = field(default_factory=Encoding)  #: how the Sun's direction is encoded
    view: Encoding = field(default_factory=Encoding)  #: how the view's direction is encoded


@dataclass(frozen=True)
class SurfaceConfig:
    """Each Gaussian learns a normal, too, and the field takes the cosines of a reflectance model about it
    (`surface_cosines`): what one side of a body has taught then serves the others, and Suns never seen. Ours.

    With directions beside the cosines it memorises the Suns of training: by default they say nothing (one constant).
    """

    kind: ClassVar[str] = "surface"

    sun: Encoding = field(default_factory=lambda: Encoding("harmonics", 0))  #: of the Sun's direction, beside cosines
    view: Encoding = field(default_factory=lambda: Encoding("harmonics", 0))  #: of the view's direction, beside cosines


@dataclass(frozen=True)
class ViewAloneConfig:
    """The field takes the view's direction alone: 4.2 without s, for pictures that do not name their Sun."""

    kind: ClassVar[str] = "view"

    view: Encoding = field(default_factory=Encoding)  #: how the view's direction is encoded


NO_SUN = Encoding("harmonics", 0)  #: in its place: one constant, as there is no product of nothing


@dataclass(frozen=True)
class FieldConfig:
    """Defaults: table 4.1."""

    features: int = 128  #: learned numbers that each Gaussian has for the network
    width: int = 256  #: units of a hidden layer
    layers: int = 3  #: matrix products: 3 are two hidden layers (the thesis says "depth 3", which can mean either)
    #: what the network is given of Sun and view: their directions (thesis), cosines about a learned normal, or the view
    #: alone, for pictures that do not name their Sun
    inputs: DirectionsConfig | SurfaceConfig | ViewAloneConfig = field(default_factory=DirectionsConfig)
    #: learned numbers that each training picture has for the network, 0 for none; other pictures are drawn with their
    #: mean. NeRF-W (Martin-Brualla et al. 2021) and Splatfacto-W take 48
    embeddings: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, features=(1, MAX_FEATURES), width=(1, MAX_WIDTH), layers=(1, MAX_LAYERS))
        check_ranges(self, embeddings=(0, MAX_FEATURES))

    @property
    def sun(self) -> Encoding:
        """Of the Sun's direction."""
        return NO_SUN if isinstance(self.inputs, ViewAloneConfig) else self.inputs.sun

    @property
    def view(self) -> Encoding:
        """Of the view's direction."""
        return self.inputs.view

    @property
    def knows_sun(self) -> bool:
        """Whether the Sun's direction changes what the network says."""
        return not isinstance(self.inputs, ViewAloneConfig)

    @property
    def surface(self) -> bool:
        """Whether each Gaussian has a normal, and the network takes the cosines about it."""
        return isinstance(self.inputs, SurfaceConfig)

    @property
    def stored(self) -> int:
        """Numbers of each Gaussian: its features, then its normal (of any length), if it has one."""
        return self.features + 3 * self.surface

    @property
    def shape(self) -> MlpShape:
        """The network: features, view and cosines of each Gaussian, Sun and picture in common, three colours out."""
        inputs = self.features + self.view.size + COSINES * self.surface
        return MlpShape(inputs, self.sun.size + self.embeddings, 3, self.width, self.layers)


@dataclass
class FieldInputs:
    """What the field reads of the world."""

    features: Float  #: Float, packed [F * N], `FieldConfig.stored` of them the field's
    means: Array3f  #: Array3f [3, N], metres
    rotations_and_scales: tuple[Array4f, Array3f]  #: (quaternions, log scales) of the Gaussians
    camera: Projection  #: from where the Gaussians are seen
    sun: Array3f  #: Array3f of width 1, unit, towards the Sun
    beams: list[Float]  #: the Earth's, Float [4 * BEAMS] in a list, or nothing

    def directions(self, batch: PaddedBatch) -> Array3f:
        """Array3f [3, M], unit, from the camera to the batch's Gaussians."""
        return self.camera.directions_to(batch.repeat_last(self.means))


def field_items(config: FieldConfig, features: Float, views: list[Float], batch: PaddedBatch) -> TensorXf:
    """Items of the network (4.2): TensorXf [B, C, m]. features: packed;  views: of `field_views`"""
    return batch.matrix([*batch.block(features, 0, config.features), *views], config.shape.rows)


def field_views(config: FieldConfig, inputs: FieldInputs, batch: PaddedBatch) -> list[Float]:
    """What stands behind the features among the network's inputs, and changes with Sun and camera: Floats [M]."""
    direction = inputs.directions(batch)
    rows: list[Float] = config.view(direction)
    if config.surface:
        rows += surface_cosines(_normals(config, inputs, batch), direction, inputs.sun)
    return rows


def sun_facing(config: FieldConfig, inputs: FieldInputs, views: list[Float], batch: PaddedBatch) -> list[Float]:
    """Float [M] in [0, 1] in a list: does the side that is seen face the Sun? 1 where its learned normal or the
    Gaussian's shortest axis does, 1/2 at n . s = -TURNED / 2, as neither is exact. Nothing of a field without normals.
    views: of `field_views`"""
    return [_faces(views[config.view.size], inputs, batch)] if config.surface else []


def earthlight(config: FieldConfig, inputs: FieldInputs, batch: PaddedBatch) -> list[Float]:
    """[M] of `earth_irradiance` in a list; nothing where there is no Earth."""
    direction = inputs.directions(batch)
    return [earth_irradiance(_normals(config, inputs, batch), direction, beams) for beams in inputs.beams]


def normals_adjoint(
    config: FieldConfig,
    inputs: FieldInputs,
    grad_items: TensorXf,
    grad_facing: list[Float],
    grad_earth: list[Float],
    batch: PaddedBatch,
) -> TensorXf:
    """[B, 3, m]: gradient of the normals, from that of the network's items and, if any, of `sun_facing` and of
    `earthlight`."""
    normals = _normals(config, inputs, batch)
    dr.enable_grad(normals)
    direction = inputs.directions(batch)
    cosines = surface_cosines(normals, direction, inputs.sun)
    first = config.features + config.view.size
    along = sum((cosine * row_of(grad_items, first + i) for i, cosine in enumerate(cosines)), ad.Float(0))
    for gradient in grad_facing:
        along += gradient * _faces(cosines[0], inputs, batch)
    for gradient, beams in zip(grad_earth, inputs.beams, strict=True):
        along += gradient * earth_irradiance(normals, direction, beams)
    dr.backward(along)
    return batch.matrix(list(dr.grad(normals)))


def sun_adjoint(
    config: FieldConfig,
    inputs: FieldInputs,
    grad_items: TensorXf,
    grad_facing: list[Float],
    grad_encoding: Float,
    batch: PaddedBatch,
) -> Float:
    """Float [3]: gradient of the Sun's direction through what the network is given of it; shadows count as given.
    grad_items, grad_facing: as in `normals_adjoint`;  grad_encoding: of what `FieldConfig.sun` says, then of whatever
    """
    sun = ad.Array3f(inputs.sun)
    dr.enable_grad(sun)
    along = ad.Float(0)
    if config.surface:
        direction = inputs.directions(batch)
        cosines = surface_cosines(_normals(config, inputs, batch), direction, sun)
        first = config.features + config.view.size
        for i, cosine in enumerate(cosines):
            along += dr.sum(cosine * row_of(grad_items, first + i))
        facing = replace(inputs, sun=sun)
        for gradient in grad_facing:
            along += dr.sum(gradient * _faces(cosines[0], facing, batch))
    for i, term in enumerate(config.sun(sun)):
        along += term * dr.gather(ad.Float, grad_encoding, ad.UInt32(i))
    dr.backward(along)
    return dr.concat(list(dr.grad(sun)))


def is_back_side_seen(config: FieldConfig, inputs: FieldInputs, batch: PaddedBatch) -> Bool:
    """Bool [M]: is the side seen to which the learned normal does not point?"""
    return points_away(_normals(config, inputs, batch), inputs.directions(batch))


def _faces(lambert: Float, inputs: FieldInputs, batch: PaddedBatch) -> Float:
    """Of n . s of the learned normals."""
    axis = shortest_axis(*(batch.repeat_last(dr.detach(turn)) for turn in inputs.rotations_and_scales))
    axis = seen_side_normals(axis, inputs.directions(batch))
    return dr.clip(1 + dr.maximum(lambert, dr.dot(axis, inputs.sun)) / TURNED, 0, 1)


def _normals(config: FieldConfig, inputs: FieldInputs, batch: PaddedBatch) -> Array3f:
    """Array3f [3, M], of any length."""
    return ad.Array3f(batch.block(inputs.features, config.features, 3))


def field_color(decoding: Decoding | None, output: Float) -> Float:
    """A channel [M] of a colour of what the field's network gives: its sigmoid, decoded where that is asked for. Loss
    and eye tell dark colours apart by ratios, for which a sigmoid is too flat."""
    value = sigmoid(output)
    if decoding is None:
        return value
    return decode_radiance(ENCODED_PEAK * value) if decoding == "radiance" else decode_srgb(value)


def field_color_slope(decoding: Decoding | None, color: Float) -> Float:
    """d `field_color` by the output, of what it gives."""
    if decoding is None:
        return color * (1 - color)
    if decoding == "radiance":
        value = encode_radiance(color)
        return value * (1 - value / ENCODED_PEAK) * decode_radiance_slope(value)
    value = dr.select(color < 1, encode_srgb_unclipped(color), 1)  # which rounding leaves short of 1
    return value * (1 - value) * decode_srgb_slope(value)
