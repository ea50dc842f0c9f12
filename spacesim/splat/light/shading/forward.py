"""Colours and visibility of Gaussians in training."""

from dataclasses import dataclass, replace

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, TensorXf
from spacesim.learning.networks import fused, mlp, network, tensor_cores
from spacesim.splat.light.bounce import Parts, Rays
from spacesim.splat.light.bounce_text import gather_light
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import field_color, field_items, field_views, sun_facing
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shading.scattering import (
    Shares,
    add_scattered,
    emitted_light,
    painted_items,
    received_light,
    scattered_light,
    seen_rays,
    shares_of,
)
from spacesim.splat.light.shadow.refine import refine_occlusion
from spacesim.splat.light.sunlight import SunEncoding
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


Read = tuple[TensorXf, network.InputLayer]
"""Items of a network, its first layer."""


@dataclass
class _LaunchInputs:
    """What launches read."""

    field: Read
    refinement: Read | None  #: where there is one
    painted: TensorXf | None  #: of `painted_items`, where emitters are
    rays: Rays | None  #: of `seen_rays`, where there are some


@dataclass
class _Made:
    """What launches have made of `_LaunchInputs`; None: the recording makes it."""

    field: network.Launched | None = None
    refinement: network.Launched | None = None
    painted: TensorXf | None = None  #: what the field says of it


def shade(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> tuple[list[Float], list[Float], ShadingTape]:
    """(dimmed colours, [visibility] or [], tape)."""
    shape, refine, (of_field, of_refinement) = config.field.shape, config.refine, split_weights(config, weights)
    is_fused = fused.takes(shape) and (refine is None or fused.takes(refine.shape))
    made = _Made()
    if is_fused or tensor_cores.takes(shape, batch.capacity):
        read = _launch_inputs(config, weights, inputs, batch, is_fused)
        if dr.grad_enabled(read, weights, inputs.raw_shadows):  # which a launch would not know of
            return _shade(config, weights, inputs, batch, made)
        forward = fused.forward if is_fused else tensor_cores.forward
        made.field = forward(shape, of_field, *read.field)
        if read.refinement and refine:
            made.refinement = forward(refine.shape, of_refinement, *read.refinement)
        if read.painted is not None:
            made.painted = fused.outputs(shape, of_field, read.painted, read.field[1])
        if read.rays and inputs.surroundings:
            lit = _in_sunlight(config, weights, inputs, batch, made)
            light = gather_light(inputs.surroundings, lit.emitted, config.bounce, read.rays, _arriving(config))
            return _shaded(lit, *_with_scattered(config, inputs, batch, lit.outputs, light))
    return _shade(config, weights, inputs, batch, made)


def _arriving(config: LightConfig) -> Parts:
    """Of the light that bounces, what Gaussians reflect."""
    return Parts(front=True, mirrored=config.mirrors)


@recorded
def _launch_inputs(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, of_all: bool
) -> _LaunchInputs:
    """of_all: all of it, or of the field alone"""
    of_field, of_refinement = split_weights(config, weights)
    items = field_items(config.field, inputs.features, field_views(config.field, inputs.of_field(), batch), batch)
    refine_items = items_of_refinement(config, inputs, batch) if of_all else None
    painted = painted_items(config, inputs, batch.count) if of_all and is_painted(config, inputs) else None
    first = mlp.make_input_layer(config.field.shape, of_field, inputs.sun.field_encoding)
    of_refine = None if refine_items is None else (refine_items, refine_layer(config, of_refinement, inputs))
    rays = seen_rays(config, inputs, batch) if of_all and inputs.surroundings else None
    return _LaunchInputs((items, first), of_refine, painted, rays)


def is_painted(config: LightConfig, inputs: ShadingInputs) -> bool:
    """Whether emitters are as the field paints them."""
    return config.mirrors and inputs.surroundings is not None


def refine_layer(config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs) -> network.InputLayer:
    """First layer of the refinement."""
    assert config.refine is not None, "there is one"
    return mlp.make_input_layer(config.refine.shape, refine_weights, inputs.sun.of_refinement)


@recorded
def _shade(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    made: _Made,
) -> tuple[list[Float], list[Float], ShadingTape]:
    """`shade`, with what launches have made."""
    lit = _in_sunlight(config, weights, inputs, batch, made)
    light = received_light(config, inputs, lit.emitted, batch, _arriving(config))
    return _shaded(lit, *_with_scattered(config, inputs, batch, lit.outputs, light))


@dataclass
class _Lit:
    """Gaussians as the Sun alone lights them."""

    outputs: list[Float]  #: dimmed colours, then visibility, if there is one, [M] each
    emitted: list[Float]  #: of `emitted_light`
    tape: ShadingTape  #: with no scattered light


@recorded
def _in_sunlight(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, made: _Made
) -> _Lit:
    field_weights, refine_weights = split_weights(config, weights)
    field_inputs = inputs.of_field()
    views = field_views(config.field, field_inputs, batch)
    # written in one kernel with the field's, if any are
    refine_items = made.refinement.tape.values[0] if made.refinement else items_of_refinement(config, inputs, batch)
    by_field, encoding = made.field, inputs.sun.field_encoding
    items = by_field.tape.values[0] if by_field else field_items(config.field, inputs.features, views, batch)
    output, field_tape = mlp.forward(config.field.shape, field_weights, items, encoding, launched=by_field)
    colors = [field_color(config.decoding, value) for value in output]
    occlusion, refine_tape = occlusion_and_tape(config, refine_weights, inputs, batch, refine_items, made.refinement)
    faces = sun_facing(config.field, field_inputs, views, batch) if occlusion else []
    visibility = [1 - value for value in occlusion]
    outputs = dimmed(inputs.sun, colors, visibility, faces)
    dr.eval(outputs, colors, occlusion, visibility, faces)
    shares = _emitters_shares(config, refine_weights, inputs, batch, visibility)
    first, painted = field_tape.input_layer, made.painted
    emitted = emitted_light(config, field_weights, inputs, shares, batch, first, painted)
    return _Lit(outputs, emitted, ShadingTape(field_tape, refine_tape, colors, occlusion, faces, []))


@recorded
def _with_scattered(
    config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch, outputs: list[Float], light: list[Float]
) -> tuple[list[Float], list[Float]]:
    """(outputs [N] each, what is scattered). outputs: of `_Lit`;  light: of `received_light`"""
    scattered = scattered_light(config, inputs, light[:3], light[3:], batch)
    if scattered:
        outputs = add_scattered(config, inputs, outputs, scattered, batch)
        dr.eval(outputs, scattered)
    return batch.unpad(outputs, inputs.means.x), scattered


def _shaded(lit: _Lit, outputs: list[Float], scattered: list[Float]) -> tuple[list[Float], list[Float], ShadingTape]:
    """What `shade` gives, of `_with_scattered`."""
    return outputs[:3], outputs[3:], replace(lit.tape, scattered=scattered)


def dimmed(sun: SunEncoding, colors: list[Float], visibility: list[Float], faces: list[Float]) -> list[Float]:
    """Colours [M] dimmed by the Earth and by visibility ([M] in a list, or nothing), then that as it is shown. faces:
    of `sun_facing`"""
    if not visibility:
        return sun.colors_left(colors)[0]
    dimmed, _ = sun.colors_left([color * visibility[0] for color in colors])
    return dimmed + sun.left([picture_visibility(visibility[0], faces)])


def picture_visibility(visibility: Float, faces: list[Float]) -> Float:
    """A picture's: what is turned away from the Sun does not see it."""
    return visibility * faces[0] if faces else visibility


def items_of_refinement(config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch) -> TensorXf | None:
    """Inputs of the refinement, TensorXf [B, C, m], where there is one."""
    return inputs.refine_items(config.refine, config.field.stored, batch) if config.refine else None


def occlusion_and_tape(
    config: LightConfig,
    refine_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    items: TensorXf | None,
    made: network.Launched | None = None,
) -> tuple[list[Float], network.MlpTape | None]:
    """([refined occlusion [M]] or [], tape of the refinement). items: of `refine_items`;  made: of these"""
    occlusion = raw_occlusion(inputs, batch)
    if not config.refine:
        return occlusion, None
    assert items is not None, "the refinement has inputs"
    encoding = inputs.sun.of_refinement
    (logit,), tape = mlp.forward(config.refine.shape, refine_weights, items, encoding, launched=made)
    return [refine_occlusion(config.refine, occlusion[0], logit)], tape


def raw_occlusion(inputs: ShadingInputs, batch: PaddedBatch) -> list[Float]:
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
    items = items_of_refinement(config, inputs, columns)
    occlusion, _ = occlusion_and_tape(config, refine_weights, inputs, columns, items)
    dr.eval(occlusion)
    return lambda k: [1 - dr.gather(ad.Float, value, k) for value in occlusion]


def split_weights(config: LightConfig, weights: list[Float]) -> tuple[list[Float], list[Float]]:
    """Weights of the field, of the refinement."""
    count = 1 + 2 * config.field.layers
    return weights[:count], weights[count:]
