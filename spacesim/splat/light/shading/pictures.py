"""Colours and visibility of Gaussians for pictures: what does not change from one to the next is computed once."""

import drjit as dr

from spacesim.backend import recorded
from spacesim.backend.arrays import Float, TensorXf
from spacesim.learning.networks import fused, mlp, network
from spacesim.learning.networks.network import round_up_rows
from spacesim.splat.light import cooperative
from spacesim.splat.light.bounce import BOTH_SIDES, Parts, Rays, rays_on_sides, received_on_sides
from spacesim.splat.light.bounce_text import gather_light
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig, field_color, field_views, is_back_side_seen, sun_facing
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.forward import (
    Read,
    dimmed,
    is_painted,
    items_of_refinement,
    occlusion_and_tape,
    raw_occlusion,
    refine_layer,
    split_weights,
)
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shading.scattering import (
    add_scattered,
    emitted_light,
    painted_items,
    received_light,
    scattered_light,
    scatterers_of,
    seen_rays,
    shares_of,
)
from spacesim.splat.light.shadow.refine import refine_occlusion
from spacesim.splat.light.sunlight import Sunlight

MIRRORED = Parts(mirrored=True)  #: of light that arrives, what depends on the viewer


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
    said, mirrored = None, None
    if first_layer and fused.takes(config.field.shape):
        is_mirroring = bool(sunlight.emitted) and inputs.surroundings is not None
        read, rays = _picture_inputs(config, field_weights, inputs, batch, first_layer.inputs, is_mirroring)
        said = _outputs(config.field.shape, field_weights, read, first_layer)
        if rays and inputs.surroundings and not dr.grad_enabled(rays, sunlight.emitted):
            mirrored = gather_light(inputs.surroundings, sunlight.emitted, config.bounce, rays, MIRRORED)
    return _shade_picture(config, field_weights, inputs, batch, first_layer, packed, said, mirrored, sunlight)


def _outputs(
    shape: network.MlpShape, weights: list[Float], read: Read, known: network.PartialLayer | None = None
) -> TensorXf | None:
    """By a launch; None where gradients are asked for, which it would not know of."""
    if dr.grad_enabled(read, weights, [known.values] if known else []):
        return None
    return fused.outputs(shape, weights, *read, known)


@recorded
def _picture_inputs(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    known: int,
    is_mirroring: bool,
) -> tuple[Read, Rays | None]:
    """Of the field's inputs but for so many first ones; rays along which light arrives to be mirrored, if any does."""
    views = field_views(config.field, inputs.of_field(), batch)
    layer = mlp.make_input_layer(config.field.shape, field_weights, inputs.sun.field_encoding, known)
    rays = seen_rays(config, inputs, batch) if is_mirroring else None
    return (batch.matrix(views, round_up_rows(len(views))), layer), rays


@recorded
def _shade_picture(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    first_layer: network.PartialLayer | None,
    packed: cooperative.PackedNetwork | None,
    said: TensorXf | None,
    mirrored: list[Float] | None,
    sunlight: Sunlight,
) -> list[Float]:
    """said: what the field says, if that is known;  mirrored: light that arrives to be mirrored, if that is"""
    field, field_inputs = config.field, inputs.of_field()
    views = field_views(field, field_inputs, batch)
    if said is not None:
        outputs = network.rows_of(said)
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
    shown = dimmed(inputs.sun, colors, visibility, faces)
    bounced = [batch.pad_zeros(light) for light in sunlight.bounced]
    if bounced:
        over = is_back_side_seen(field, field_inputs, batch)
        bounced = [dr.select(over, bounced[3 + c], bounced[c]) for c in range(3)]
    if mirrored is None:
        mirrored = received_light(config, inputs, sunlight.emitted, batch, MIRRORED)
    scattered = scattered_light(config, inputs, bounced, mirrored, batch)
    if scattered:
        shown = add_scattered(config, inputs, shown, scattered, batch)
    dr.eval(shown)
    return batch.unpad(shown, inputs.means.x)


def refined_visibility(config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch) -> Float:
    """Of the Sun, refined, [N]."""
    _, refine_weights = split_weights(config, weights)
    said = None
    if config.refine and fused.takes(config.refine.shape):
        read = _refine_inputs(config, refine_weights, inputs, batch)
        said = _outputs(config.refine.shape, refine_weights, read)
    return _refined_visibility(config, refine_weights, inputs, batch, said)


@recorded
def _refine_inputs(config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch) -> Read:
    items = items_of_refinement(config, inputs, batch)
    assert items is not None, "there is a refinement"
    return items, refine_layer(config, refine_weights, inputs)


@recorded
def _refined_visibility(
    config: LightConfig,
    refine_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    said: TensorXf | None,
) -> Float:
    """said: what the refinement says, if that is known"""
    if said is None or config.refine is None:
        items = items_of_refinement(config, inputs, batch)
        (occlusion,), _ = occlusion_and_tape(config, refine_weights, inputs, batch, items)
    else:
        (raw,) = raw_occlusion(inputs, batch)
        occlusion = refine_occlusion(config.refine, raw, network.row_of(said, 0))
    visibility = 1 - occlusion
    dr.eval(visibility)
    return batch.unpad([visibility], inputs.means.x)[0]


def scatter_sunlight(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visibility: list[Float]
) -> tuple[list[Float], list[Float]]:
    """(light that bounces, what is emitted), see `Sunlight`. visibility: of the Sun, [N] in a list, or nothing for 1"""
    field_weights, _ = split_weights(config, weights)
    surroundings = inputs.surroundings
    has_gradients = dr.grad_enabled(inputs.features, inputs.means, weights, visibility)
    if surroundings is None or has_gradients or not fused.takes(config.field.shape):
        return _scatter_sunlight(config, field_weights, inputs, batch, visibility)
    rays, read = _scatter_inputs(config, field_weights, inputs, batch)
    painted = fused.outputs(config.field.shape, field_weights, *read) if read else None
    emitted = _emitted(config, field_weights, inputs, batch, visibility, painted)
    light = gather_light(surroundings, emitted, config.bounce, rays, BOTH_SIDES)
    return _of_all(inputs, batch, light), emitted if config.mirrors else []


@recorded
def _scatter_sunlight(
    config: LightConfig, field_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visibility: list[Float]
) -> tuple[list[Float], list[Float]]:
    """`scatter_sunlight`, all in one."""
    emitted, bounced = _emitted(config, field_weights, inputs, batch, visibility, None), []
    if emitted and inputs.surroundings:
        scatterers = scatterers_of(config, inputs)
        bounced = received_on_sides(scatterers, inputs.surroundings, emitted, config.bounce, batch)
    dr.eval(bounced)
    return _of_all(inputs, batch, bounced), emitted if config.mirrors else []


@recorded
def _scatter_inputs(
    config: LightConfig, field_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> tuple[Rays, Read | None]:
    """Rays along which light arrives; what the field reads of emitters, if these are as it paints them."""
    assert inputs.surroundings is not None, "something is emitted"
    rays = rays_on_sides(scatterers_of(config, inputs), inputs.surroundings, batch)
    if not is_painted(config, inputs):
        return rays, None
    first = mlp.make_input_layer(config.field.shape, field_weights, inputs.sun.field_encoding)
    return rays, (painted_items(config, inputs, batch.count), first)


@recorded
def _emitted(
    config: LightConfig,
    field_weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    visibility: list[Float],
    painted: TensorXf | None,
) -> list[Float]:
    """painted: what the field says of `painted_items`, if that is known"""
    shares = shares_of(inputs, visibility)
    return emitted_light(config, field_weights, inputs, shares, batch, painted=painted)


@recorded
def _of_all(inputs: ShadingInputs, batch: PaddedBatch, light: list[Float]) -> list[Float]:
    """Columns [M] to [N]."""
    return batch.unpad(light, inputs.means.x)


@recorded
def first_layer_of_features(
    field: FieldConfig, weights: list[Float], features: Float, batch: PaddedBatch
) -> network.PartialLayer:
    items = batch.matrix(batch.block(features, 0, field.features), round_up_rows(field.features))
    return mlp.first_layer_part(field.shape, weights, items, field.features)
