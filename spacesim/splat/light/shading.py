"""How light becomes colour: the kernels of `spacesim.splat.light.model`, forward and backward.

Each kernel is recorded once for all Gaussians in columns of few sizes (`PaddedBatch`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, TensorXf, UInt32
from spacesim.learning.networks import mlp, network
from spacesim.learning.networks.network import round_up_rows
from spacesim.learning.reflectance import surface_cosines
from spacesim.splat.light import cooperative
from spacesim.splat.light.bounce import (
    Scatterers,
    add_irradiance,
    add_irradiance_slopes,
    albedo_radiance,
    emission,
    grazing_reflectance,
    grazing_reflectance_slope,
    lit_normals,
    received_on_seen,
    received_on_sides,
)
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import (
    FieldConfig,
    earthlight,
    field_color,
    field_color_slope,
    field_items,
    field_views,
    is_back_side_seen,
    normals_adjoint,
    sun_adjoint,
    sun_facing,
)
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading_inputs import ShadingInputs
from spacesim.splat.light.shadow.light_camera import towards_sun
from spacesim.splat.light.shadow.refine import refine_occlusion
from spacesim.splat.light.sunlight import SunEncoding, Sunlight
from spacesim.splat.raster.seen import Chosen
from spacesim.splat.raster.surface import across
from spacesim.splat.raster.tone import decode_srgb

SIDES = 4  #: from which what bounces is seen where it comes from

_Shares = Callable[[UInt32], list[Float]]
"""Emitters, by their places in `Surroundings.emitters`, to the share of the Sun that each sees: in a list, or nothing
for 1."""


@dataclass
class ShadingTape:
    """What the adjoint needs of the forward pass."""

    field: network.MlpTape  #: of the appearance field
    refine: network.MlpTape | None  #: of the shadow refinement network, if there is one
    colors: list[Float]  #: 3 arrays [M] before they are dimmed
    occlusion: list[Float]  #: the refined one [M] in a list, or nothing
    faces: list[Float]  #: of `sun_facing`, or nothing
    scattered: list[Float]  #: of `_scattered`, [M] each, or nothing


@recorded
def shade(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch
) -> tuple[list[Float], list[Float], ShadingTape]:
    """(dimmed colours, [visibility] or [], tape)."""
    field_weights, refine_weights = split_weights(config, weights)
    field_inputs = inputs.of_field()
    views = field_views(config.field, field_inputs, batch)
    of_refinement = _refine_items(config, inputs, batch)  # written in one kernel with the field's
    items = field_items(config.field, inputs.features, views, batch)
    output, field_tape = mlp.forward(config.field.shape, field_weights, items, inputs.sun.field_encoding)
    colors = [field_color(config.decoding, value) for value in output]
    occlusion, refine_tape = _refine_occlusion(config, refine_weights, inputs, batch, of_refinement)
    faces = sun_facing(config.field, field_inputs, views, batch) if occlusion else []
    visibility = [1 - value for value in occlusion]
    outputs = _dimmed(inputs.sun, colors, visibility, faces)
    dr.eval(outputs, colors, occlusion, visibility, faces)
    shares = _emitters_shares(config, refine_weights, inputs, batch, visibility)
    emitted = _emitted(config, field_weights, inputs, shares, batch, field_tape.input_layer)
    light = _received(config, inputs, emitted, batch, diffuse=True, mirrors=config.mirrors)
    scattered = _scattered(config, inputs, light[:3], light[3:], batch)
    if scattered:
        outputs = _add_scattered(config, inputs, outputs, scattered, batch)
        dr.eval(outputs, scattered)
    outputs = batch.unpad(outputs, inputs.means.x)
    return outputs[:3], outputs[3:], ShadingTape(field_tape, refine_tape, colors, occlusion, faces, scattered)


@recorded
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
    field, field_inputs = config.field, inputs.of_field()
    views = field_views(field, field_inputs, batch)
    if packed is None:
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
    mirrored = _received(config, inputs, sunlight.emitted, batch, diffuse=False, mirrors=True)
    scattered = _scattered(config, inputs, bounced, mirrored, batch)
    if scattered:
        shown = _add_scattered(config, inputs, shown, scattered, batch)
    dr.eval(shown)
    return batch.unpad(shown, inputs.means.x)


@recorded
def refined_visibility(config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch) -> Float:
    """Of the Sun, refined, [N]."""
    _, refine_weights = split_weights(config, weights)
    occlusion, _ = _refine_occlusion(config, refine_weights, inputs, batch, _refine_items(config, inputs, batch))
    visibility = 1 - occlusion[0]
    dr.eval(visibility)
    return batch.unpad([visibility], inputs.means.x)[0]


@recorded
def scatter_sunlight(
    config: LightConfig, weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visibility: list[Float]
) -> tuple[list[Float], list[Float]]:
    """(light that bounces, what is emitted), see `Sunlight`. visibility: of the Sun, [N] in a list, or nothing for 1"""
    field_weights, _ = split_weights(config, weights)
    emitted = _emitted(config, field_weights, inputs, _shares_of(inputs, visibility), batch)
    bounced: list[Float] = []
    if emitted and inputs.surroundings:
        scatterers = _scatterers(config, inputs)
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
    return dimmed + sun.left([_picture_visibility(visibility[0], faces)])


def _picture_visibility(visibility: Float, faces: list[Float]) -> Float:
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
) -> tuple[list[Float], network.MlpTape | None]:
    """([refined occlusion [M]] or [], tape of the refinement). items: of `_refine_items`"""
    occlusion = [batch.pad_zeros(row) for row in inputs.raw_shadows[:1]]
    if not config.refine:
        return occlusion, None
    assert items is not None, "the refinement has inputs"
    (logit,), tape = mlp.forward(config.refine.shape, refine_weights, items, inputs.sun.refine_encoding)
    return [refine_occlusion(config.refine, occlusion[0], logit)], tape


@recorded
def adjoint(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    tape: ShadingTape,
    grad_color: list[Float],
    grad_visibility: list[Float],
    by_sun: bool,
) -> tuple[Float, list[Float], list[Float], list[Float]]:
    """(gradient of the features, gradients of the weights, [gradient of `SunEncoding.field_encoding`] where pictures
    have embeddings, [gradient of the Sun's direction, Float [3]] where `by_sun` asks for it)."""
    field_weights, refine_weights = split_weights(config, weights)
    visibility = 1 - tape.occlusion[0] if tape.occlusion else 1
    gradients = [batch.pad_zeros(gradient) for gradient in grad_color]
    grad_albedo: list[Float] = []
    grad_earth: list[Float] = []
    dimmed, slopes = inputs.sun.colors_left([color * visibility for color in tape.colors])
    if tape.scattered:
        gradients, grad_albedo, grad_earth = _scattered_adjoint(
            config, inputs, gradients, dimmed, tape.scattered, batch
        )
    gradients = [gradient * slope for gradient, slope in zip(gradients, slopes, strict=True)]
    pairs = list(zip(gradients, tape.colors, strict=True))
    grad_shown = inputs.sun.left([batch.pad_zeros(gradient) for gradient in grad_visibility])
    grad_output = batch.matrix([g * visibility * field_color_slope(config.decoding, c) for g, c in pairs])
    encoding = inputs.sun.field_encoding
    wanted = None if config.field.surface or by_sun else config.field.features
    ways = [network.WayBack(config.field.shape, field_weights, tape.field, encoding, grad_output, wanted)]
    if config.refine:
        assert tape.refine is not None, "it was refined"
        grad_occlusion = -sum(
            (g * c for g, c in pairs), sum((_picture_visibility(g, tape.faces) for g in grad_shown), ad.Float(0))
        )
        occlusion = tape.occlusion[0]
        grad_logit = batch.matrix([grad_occlusion * occlusion * (1 - occlusion)])
        encoding = inputs.sun.refine_encoding
        ways.append(network.WayBack(config.refine.shape, refine_weights, tape.refine, encoding, grad_logit))
    (grad_weights, grad_items), *of_refinement = mlp.backward_together(ways)
    by_encoding = []
    if config.field.embeddings or by_sun:
        by_encoding = [mlp.shared_gradient(config.field.shape, field_weights, grad_weights)]
    parts = [(grad_items, 0, config.field.features)]
    grad_facing = [gradient * visibility for gradient in grad_shown] if config.field.surface else []
    grad_sun = []
    if by_sun:
        grad_sun = [sun_adjoint(config.field, inputs.of_field(), grad_items, grad_facing, by_encoding[0], batch)]
    if config.field.surface:
        field_inputs = inputs.of_field()
        parts.append((normals_adjoint(config.field, field_inputs, grad_items, grad_facing, grad_earth, batch), 0, 3))
    for of_weights, of_items in of_refinement:
        assert config.refine is not None
        grad_weights += of_weights
        parts.append((of_items, 1, config.refine.features))  # the raw occlusion stands before them
    if grad_albedo:
        parts.append((batch.matrix(grad_albedo), 0, len(grad_albedo)))
    by_encoding = by_encoding if config.field.embeddings else []
    return batch.pack(parts, inputs.features), grad_weights, by_encoding, grad_sun


def _scatterers(config: LightConfig, inputs: ShadingInputs) -> Scatterers:
    return Scatterers(
        inputs.features,
        normals=config.field.features,
        albedos=config.albedos,
        sun=towards_sun(inputs.sun.light_axes),
    )


def _reflectances(config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch) -> list[Float]:
    """Floats [M] in (0, 1): the albedo, then, where surfaces mirror, the specular reflectance, RGB each."""
    return [network.sigmoid(row) for row in batch.block(inputs.features, config.albedos, 6 if config.mirrors else 3)]


def _emitted(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    shares: _Shares,
    batch: PaddedBatch,
    input_layer: network.InputLayer | None = None,
) -> list[Float]:
    """What `emission` gives, or nothing. weights: of the field;  input_layer: of the field, if it is known"""
    surroundings = inputs.surroundings
    if surroundings is None:
        return []
    scatterers, emitters = _scatterers(config, inputs), surroundings.emitters
    if config.mirrors:
        light = _painted(config, weights, inputs, shares, emitters, batch.count, input_layer)
    else:
        light = albedo_radiance(scatterers, shares(dr.arange(ad.UInt32, config.bounce)), emitters, batch.count)
    return emission(scatterers, surroundings, config.bounce, light, batch.count)


def _shares_of(inputs: ShadingInputs, visibility: list[Float]) -> _Shares:
    """Of the visibility of all Gaussians, evaluated, in a list, or nothing for 1."""

    def shares(k: UInt32) -> list[Float]:
        assert inputs.surroundings is not None, "something is emitted"
        number = dr.gather(ad.UInt32, inputs.surroundings.emitters, k)
        return [dr.gather(ad.Float, array, number) for array in visibility]

    return shares


def _emitters_shares(
    config: LightConfig, refine_weights: list[Float], inputs: ShadingInputs, batch: PaddedBatch, visible: list[Float]
) -> _Shares:
    """Of the Sun that each emitter sees. visible: of the batch, evaluated, in which emitters may be missing"""
    if batch.chosen is None or inputs.surroundings is None:
        return _shares_of(inputs, visible)
    emitters = Chosen(ad.UInt32(config.bounce), inputs.surroundings.emitters, None)
    columns = PaddedBatch.with_room_for(config.bounce, batch.count, emitters)
    items = _refine_items(config, inputs, columns)
    occlusion, _ = _refine_occlusion(config, refine_weights, inputs, columns, items)
    dr.eval(occlusion)
    return lambda k: [1 - dr.gather(ad.Float, value, k) for value in occlusion]


def _received(
    config: LightConfig, inputs: ShadingInputs, emitted: list[Float], batch: PaddedBatch, diffuse: bool, mirrors: bool
) -> list[Float]:
    """Of `received_on_seen`; nothing where nothing is emitted."""
    if not emitted or inputs.surroundings is None:
        return []
    scatterers, directions, around = _scatterers(config, inputs), inputs.of_field().directions, inputs.surroundings
    return received_on_seen(scatterers, around, emitted, config.bounce, batch, directions, diffuse, mirrors)


def _painted(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    shares: _Shares,
    emitters: UInt32,
    gaussians: UInt32,
    input_layer: network.InputLayer | None,
) -> list[Float]:
    """The light of the Gaussians that are `emitters`, three Floats, as the field paints them: mean of what is seen of
    each from four sides at 45 degrees to its normal, all off the plane of Sun and normal, in which mirrors show the
    Sun.

    weights, input_layer: as in `_emitted`
    """
    field, count = config.field, config.bounce
    columns = PaddedBatch.with_room_for(SIDES * count, gaussians)
    column = dr.minimum(dr.arange(ad.UInt32, columns.capacity), SIDES * count - 1)
    number, side = dr.gather(ad.UInt32, emitters, column // SIDES), column % SIDES
    normals = lit_normals(_scatterers(config, inputs), number, gaussians)
    along = across(normals, towards_sun(inputs.sun.light_axes))
    sine, cosine = dr.sincos((ad.Float(side) + 0.5) * (2 * dr.pi / SIDES))
    direction = -(0.5**0.5) * (normals + cosine * along + sine * dr.cross(normals, along))
    rows = [dr.gather(ad.Float, inputs.features, i * gaussians + number) for i in range(field.features)]
    rows += [*field.view(direction), *surface_cosines(normals, direction, towards_sun(inputs.sun.light_axes))]
    items = columns.matrix(rows, field.shape.rows)
    output, _ = mlp.forward(field.shape, weights, items, inputs.sun.field_encoding, input_layer=input_layer)
    colors = [field_color(config.decoding, value) for value in output]
    for share in shares(column // SIDES):
        colors = [color * share for color in colors]
    light = colors if config.linear else [decode_srgb(color) for color in colors]
    dr.eval(light)
    index = SIDES * dr.arange(ad.UInt32, count)
    sums = [sum((dr.gather(ad.Float, values, index + i) for i in range(SIDES)), ad.Float(0)) for values in light]
    return [total / SIDES for total in sums]


def _scattered(
    config: LightConfig, inputs: ShadingInputs, bounced: list[Float], mirrored: list[Float], batch: PaddedBatch
) -> list[Float]:
    """Three Floats [M]: light of the bounce and the Earth that arrives at the side that is seen, or nothing where there
    is neither; where surfaces mirror, six more. bounced, mirrored: of `received_on_seen`, three and six Floats [M], or
    nothing, before the Earth takes of them"""
    light, mirrored = inputs.sun.left(bounced), inputs.sun.left(mirrored)
    for earth in earthlight(config.field, inputs.of_field(), batch):
        light = [channel + config.sunlit_white * earth for channel in light or [ad.Float(0)] * 3]
    return light + mirrored


def _reflected(reflectances: list[Float], scattered: list[Float]) -> list[Float]:
    """Three Floats [M]: what surfaces reflect of `_scattered`."""
    shares = reflectances + [grazing_reflectance(specular) for specular in reflectances[3:]]
    parts = [rho * light for rho, light in zip(shares, scattered, strict=False)]  # without emitters the albedo alone
    return [sum(parts[c + 3 :: 3], parts[c]) for c in range(3)]


def _reflected_slopes(reflectances: list[Float], scattered: list[Float]) -> list[Float]:
    """d `_reflected` by each reflectance."""
    rows = zip(reflectances[3:], scattered[3:6], scattered[6:], strict=True)
    slopes = [along + grazing_reflectance_slope(specular) * grazing for specular, along, grazing in rows]
    return scattered[:3] + slopes


def _add_scattered(
    config: LightConfig, inputs: ShadingInputs, shown: list[Float], scattered: list[Float], batch: PaddedBatch
) -> list[Float]:
    """Dimmed colours [M] with the light of `_scattered`, what else is in `shown` as it was."""
    reflected = _reflected(_reflectances(config, inputs, batch), scattered)
    rows = zip(shown[:3], reflected, strict=True)
    return [add_irradiance(color, light, config.linear) for color, light in rows] + shown[3:]


def _scattered_adjoint(
    config: LightConfig,
    inputs: ShadingInputs,
    gradients: list[Float],
    dimmed: list[Float],
    scattered: list[Float],
    batch: PaddedBatch,
) -> tuple[list[Float], list[Float], list[Float]]:
    """Gradients [M] of the dimmed colours, of the logits of reflectances and, in a list, of the Earth's light, where
    there is any. What bounces counts as given, as it is small."""
    reflectances = _reflectances(config, inputs, batch)
    grad_dimmed, by_light, grad_light = [], [], ad.Float(0)
    for gradient, color, light in zip(gradients, dimmed, _reflected(reflectances, scattered), strict=True):
        of_color, of_light = add_irradiance_slopes(color, light, config.linear)
        grad_dimmed.append(gradient * of_color)
        by_light.append(gradient * of_light)
    for gradient, rho in zip(by_light, reflectances, strict=False):  # the albedo alone
        grad_light += gradient * rho
    rows = zip(by_light * 2, reflectances, _reflected_slopes(reflectances, scattered), strict=False)
    grad_logits = [gradient * slope * rho * (1 - rho) for gradient, rho, slope in rows]
    return grad_dimmed, grad_logits, [config.sunlit_white * grad_light for _ in inputs.sun.beams]


def split_weights(config: LightConfig, weights: list[Float]) -> tuple[list[Float], list[Float]]:
    """Weights of the field, of the refinement."""
    count = 1 + 2 * config.field.layers
    return weights[:count], weights[count:]
