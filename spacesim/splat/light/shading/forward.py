"""Colours and visibility of Gaussians, in training and for pictures."""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, TensorXf
from spacesim.learning.networks import fused, mlp, network, tensor_cores
from spacesim.learning.networks.network import round_up_rows
from spacesim.splat.light import cooperative
from spacesim.splat.light.bounce import received_on_sides
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig, field_color, field_items, field_views, is_back_side_seen, sun_facing
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shading.scattering import (
    Shares,
    add_scattered,
    emitted_light,
    painted_items,
    received_light,
    scattered_light,
    scatterers_of,
    shares_of,
)
from spacesim.splat.light.shadow.refine import refine_occlusion
from spacesim.splat.light.sunlight import SunEncoding, Sunlight
from spacesim.splat.raster.seen import Chosen


@dataclass
class ShadingTape:
    """What the adjoint needs of the forward pass."""

    field: network.MlpTape  #: of the appearance field
    refine: network.MlpTape | None  #: of the shadow refinement network, if there is one
    colors: list[Float]  #: 3 arrays [M] before they are dimmed
    occlusion: list[Float]  #: the refined one [M] in a list, or nothing
    faces: list[Float]  #: of `sun_facing`, or nothing
    scattered: list[Float]  #: of `scattered_light`, [M] each, or nothing


_Read = tuple[TensorXf, network.InputLayer]
"""Items of a network, its first layer."""


@dataclass
class _NetworkInputs:
    """What networks read that are computed by launches."""

    field: _Read
    refinement: _Read | None  #: where there is one
    painted: TensorXf | None  #: of `painted_items`, where emitters are


@dataclass
class _Launched:
    """What launches have made of `_NetworkInputs`; None: the recording makes it."""

    field: network.Launched | None = None
    refinement: network.Launched | None = None
    painted: TensorXf | None = None  #: what the field says of it


def shade(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> tuple[list[Float], list[Float], ShadingTape]:
    """(dimmed colours, [visibility] or [], tape)."""
    shape, refine, (of_field, of_refinement) = config.field.shape, config.refine, split_weights(config, weights)
    is_fused = fused.takes(shape) and (refine is None or fused.takes(refine.shape))
    launched = _Launched()
    if is_fused or tensor_cores.takes(shape, batch.capacity):
        read = _network_inputs(config, weights, inputs, batch, is_fused)
        if dr.grad_enabled(read, weights):  # which a launch would not know of
            return _shade(config, weights, inputs, batch, launched)
        forward = fused.forward if is_fused else tensor_cores.forward
        launched.field = forward(shape, of_field, *read.field)
        if read.refinement and refine:
            launched.refinement = forward(refine.shape, of_refinement, *read.refinement)
        if read.painted is not None:
            launched.painted = fused.outputs(shape, of_field, read.painted, read.field[1]).outputs
    return _shade(config, weights, inputs, batch, launched)


@recorded
def _network_inputs(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, of_all: bool
) -> _NetworkInputs:
    """of_all: for all networks, or for the field's pass over the batch alone"""
    of_field, of_refinement = split_weights(config, weights)
    items = field_items(config.field, inputs.features, field_views(config.field, inputs.of_field(), batch), batch)
    refine_items = _refine_items(config, inputs, batch) if of_all else None
    painted = painted_items(config, inputs, batch.count) if of_all and _is_painted(config, inputs) else None
    first = mlp.make_input_layer(config.field.shape, of_field, inputs.sun.field_encoding)
    of_refine = None if refine_items is None else (refine_items, _refine_layer(config, of_refinement, inputs))
    return _NetworkInputs((items, first), of_refine, painted)


def _is_painted(config: LightConfig, inputs: ShadingInputs) -> bool:
    """Whether emitters are as the field paints them."""
    return config.mirrors and inputs.surroundings is not None


def _refine_layer(config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs) -> network.InputLayer:
    """First layer of the refinement."""
    assert config.refine is not None, "there is one"
    return mlp.make_input_layer(config.refine.shape, refine_weights, inputs.sun.refine_encoding)


@recorded
def _shade(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    launched: _Launched,
) -> tuple[list[Float], list[Float], ShadingTape]:
    """`shade`, with what launches have made."""
    field_weights, refine_weights = split_weights(config, weights)
    field_inputs = inputs.of_field()
    views = field_views(config.field, field_inputs, batch)
    # written in one kernel with the field's, if any are
    refine_items = launched.refinement.tape.values[0] if launched.refinement else _refine_items(config, inputs, batch)
    by_field, encoding = launched.field, inputs.sun.field_encoding
    items = by_field.tape.values[0] if by_field else field_items(config.field, inputs.features, views, batch)
    output, field_tape = mlp.forward(config.field.shape, field_weights, items, encoding, launched=by_field)
    colors = [field_color(config.decoding, value) for value in output]
    occlusion, refine_tape = _refine_occlusion(config, refine_weights, inputs, batch, refine_items, launched.refinement)
    faces = sun_facing(config.field, field_inputs, views, batch) if occlusion else []
    visibility = [1 - value for value in occlusion]
    outputs = _dimmed(inputs.sun, colors, visibility, faces)
    dr.eval(outputs, colors, occlusion, visibility, faces)
    shares = _emitters_shares(config, refine_weights, inputs, batch, visibility)
    first, painted = field_tape.input_layer, launched.painted
    emitted = emitted_light(config, field_weights, inputs, shares, batch, first, painted)
    light = received_light(config, inputs, emitted, batch, diffuse=True, mirrors=config.mirrors)
    scattered = scattered_light(config, inputs, light[:3], light[3:], batch)
    if scattered:
        outputs = add_scattered(config, inputs, outputs, scattered, batch)
        dr.eval(outputs, scattered)
    outputs = batch.unpad(outputs, inputs.means.x)
    return outputs[:3], outputs[3:], ShadingTape(field_tape, refine_tape, colors, occlusion, faces, scattered)


def shade_picture(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    first_layer: network.PartialLayer | None,
    packed: cooperative.PackedNetwork | None,
    sunlight: Sunlight,
) -> list[Float]:
    """Dimmed colours, and visibility as it is shown. first_layer, packed: see `model._PictureCache`"""
    launched = None
    if first_layer and fused.takes(config.field.shape):
        read = _picture_inputs(config, field_weights, inputs, batch, first_layer.inputs)
        launched = _outputs(config.field.shape, field_weights, read, first_layer)
    return _shade_picture(config, field_weights, inputs, batch, first_layer, packed, launched, sunlight)


def _outputs(
    shape: network.MlpShape, weights: list[Float], read: _Read, known: network.PartialLayer | None = None
) -> TensorXf | None:
    """By a launch; None where gradients are asked for, which it would not know of."""
    if dr.grad_enabled(read, weights, [known.values] if known else []):
        return None
    return fused.outputs(shape, weights, *read, known).outputs


@recorded
def _picture_inputs(
    config: LightConfig, field_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, known: int
) -> _Read:
    """Of the field's inputs but for so many first ones."""
    views = field_views(config.field, inputs.of_field(), batch)
    layer = mlp.make_input_layer(config.field.shape, field_weights, inputs.sun.field_encoding, known)
    return batch.matrix(views, round_up_rows(len(views))), layer


@recorded
def _shade_picture(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    first_layer: network.PartialLayer | None,
    packed: cooperative.PackedNetwork | None,
    launched: TensorXf | None,
    sunlight: Sunlight,
) -> list[Float]:
    """launched: what the field says, if that is known"""
    field, field_inputs = config.field, inputs.of_field()
    views = field_views(field, field_inputs, batch)
    if launched is not None:
        outputs = [network.row_of(launched, i) for i in range(field.shape.outputs)]
    elif packed is None:
        assert first_layer is not None, "one of the two"
        items = batch.matrix(views, round_up_rows(len(views)))
        outputs, _ = mlp.forward(field.shape, field_weights, items, inputs.sun.field_encoding, first_layer)
    else:
        rows = batch.block(inputs.features, 0, field.features) + views
        outputs = cooperative.forward(field.shape, packed, rows, inputs.sun.field_encoding)
    colors = [field_color(config.decoding, value) for value in outputs]
    faces = sun_facing(field, field_inputs, views, batch)
    visibility = [] if sunlight.visibility is None else [batch.pad_zeros(sunlight.visibility)]
    shown = _dimmed(inputs.sun, colors, visibility, faces)
    bounced = [batch.pad_zeros(light) for light in sunlight.bounced]
    if bounced:
        over = is_back_side_seen(field, field_inputs, batch)
        bounced = [dr.select(over, bounced[3 + c], bounced[c]) for c in range(3)]
    mirrored = received_light(config, inputs, sunlight.emitted, batch, diffuse=False, mirrors=True)
    scattered = scattered_light(config, inputs, bounced, mirrored, batch)
    if scattered:
        shown = add_scattered(config, inputs, shown, scattered, batch)
    dr.eval(shown)
    return batch.unpad(shown, inputs.means.x)


def refined_visibility(config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch) -> Float:
    """Of the Sun, refined, [N]."""
    _, refine_weights = split_weights(config, weights)
    launched = None
    if config.refine and fused.takes(config.refine.shape):
        read = _refine_inputs(config, refine_weights, inputs, batch)
        launched = _outputs(config.refine.shape, refine_weights, read)
    return _refined_visibility(config, refine_weights, inputs, batch, launched)


@recorded
def _refine_inputs(
    config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> _Read:
    items = _refine_items(config, inputs, batch)
    assert items is not None, "there is a refinement"
    return items, _refine_layer(config, refine_weights, inputs)


@recorded
def _refined_visibility(
    config: LightConfig,
    refine_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    launched: TensorXf | None,
) -> Float:
    """launched: what the refinement says, if that is known"""
    if launched is None or config.refine is None:
        items = _refine_items(config, inputs, batch)
        (occlusion,), _ = _refine_occlusion(config, refine_weights, inputs, batch, items)
    else:
        (raw,) = _raw_occlusion(inputs, batch)
        occlusion = refine_occlusion(config.refine, raw, network.row_of(launched, 0))
    visibility = 1 - occlusion
    dr.eval(visibility)
    return batch.unpad([visibility], inputs.means.x)[0]


def scatter_sunlight(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visibility: list[Float]
) -> tuple[list[Float], list[Float]]:
    """(light that bounces, what is emitted), see `Sunlight`. visibility: of the Sun, [N] in a list, or nothing for 1"""
    field_weights, _ = split_weights(config, weights)
    painted = None
    if _is_painted(config, inputs) and fused.takes(config.field.shape):
        painted = _outputs(config.field.shape, field_weights, _painted_inputs(config, field_weights, inputs, batch))
    return _scatter_sunlight(config, field_weights, inputs, batch, visibility, painted)


@recorded
def _painted_inputs(
    config: LightConfig, field_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> _Read:
    first = mlp.make_input_layer(config.field.shape, field_weights, inputs.sun.field_encoding)
    return painted_items(config, inputs, batch.count), first


@recorded
def _scatter_sunlight(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    visibility: list[Float],
    painted: TensorXf | None,
) -> tuple[list[Float], list[Float]]:
    """painted: what the field says of `painted_items`, if that is known"""
    shares = shares_of(inputs, visibility)
    emitted = emitted_light(config, field_weights, inputs, shares, batch, painted=painted)
    bounced: list[Float] = []
    if emitted and inputs.surroundings:
        scatterers = scatterers_of(config, inputs)
        bounced = received_on_sides(scatterers, inputs.surroundings, emitted, config.bounce, batch)
    dr.eval(bounced)
    return batch.unpad(bounced, inputs.means.x), emitted if config.mirrors else []


@recorded
def first_layer_of_features(
    field: FieldConfig, weights: list[Float], features: Float, batch: PaddedBatch
) -> network.PartialLayer:
    items = batch.matrix(batch.block(features, 0, field.features), round_up_rows(field.features))
    return mlp.first_layer_part(field.shape, weights, items, field.features)


def _dimmed(sun: SunEncoding, colors: list[Float], visibility: list[Float], faces: list[Float]) -> list[Float]:
    """Colours [M] dimmed by the Earth and by visibility ([M] in a list, or nothing), then that as it is shown. faces:
    of `sun_facing`"""
    if not visibility:
        return sun.colors_left(colors)[0]
    dimmed, _ = sun.colors_left([color * visibility[0] for color in colors])
    return dimmed + sun.left([picture_visibility(visibility[0], faces)])


def picture_visibility(visibility: Float, faces: list[Float]) -> Float:
    """A picture's: what is turned away from the Sun does not see it."""
    return visibility * faces[0] if faces else visibility


def _refine_items(config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch) -> TensorXf | None:
    """Inputs of the refinement, TensorXf [B, C, m], where there is one."""
    return inputs.refine_items(config.refine, config.field.stored, batch) if config.refine else None


def _refine_occlusion(
    config: LightConfig,
    refine_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    items: TensorXf | None,
    launched: network.Launched | None = None,
) -> tuple[list[Float], network.MlpTape | None]:
    """([refined occlusion [M]] or [], tape of the refinement). items: of `_refine_items`;  launched: of these"""
    occlusion = _raw_occlusion(inputs, batch)
    if not config.refine:
        return occlusion, None
    assert items is not None, "the refinement has inputs"
    encoding = inputs.sun.refine_encoding
    (logit,), tape = mlp.forward(config.refine.shape, refine_weights, items, encoding, launched=launched)
    return [refine_occlusion(config.refine, occlusion[0], logit)], tape


def _raw_occlusion(inputs: ShadingInputs, batch: PaddedBatch) -> list[Float]:
    """[M] in a list, or nothing."""
    return [batch.pad_zeros(row) for row in inputs.raw_shadows[:1]]


def _emitters_shares(
    config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visible: list[Float]
) -> Shares:
    """Of the Sun that each emitter sees. visible: of the batch, evaluated, in which emitters may be missing"""
    if batch.chosen is None or inputs.surroundings is None:
        return shares_of(inputs, visible)
    emitters = Chosen(ad.UInt32(config.bounce), inputs.surroundings.emitters, None)
    columns = PaddedBatch.with_room_for(config.bounce, batch.count, emitters)
    items = _refine_items(config, inputs, columns)
    occlusion, _ = _refine_occlusion(config, refine_weights, inputs, columns, items)
    dr.eval(occlusion)
    return lambda k: [1 - dr.gather(ad.Float, value, k) for value in occlusion]


def split_weights(config: LightConfig, weights: list[Float]) -> tuple[list[Float], list[Float]]:
    """Weights of the field, of the refinement."""
    count = 1 + 2 * config.field.layers
    return weights[:count], weights[count:]
