"""Light of the bounce and of the Earth, and what surfaces reflect of it."""

from collections.abc import Callable

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float, TensorXf, UInt32
from spacesim.learning.networks import mlp, network
from spacesim.learning.reflectance import surface_cosines
from spacesim.splat.light.bounce import (
    Parts,
    Rays,
    Scatterers,
    add_irradiance,
    add_irradiance_slopes,
    albedo_radiance,
    emission,
    grazing_reflectance,
    grazing_reflectance_slope,
    lit_normals,
    rays_on_seen,
    received_on_seen,
)
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import earthlight, field_color
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shadow.light_camera import towards_sun
from spacesim.splat.raster.surface import across
from spacesim.splat.raster.tone import decode_srgb

SIDES = 4  #: from which what bounces is seen where it comes from

Shares = Callable[[UInt32], list[Float]]
"""Emitters, by their places in `Surroundings.emitters`, to the share of the Sun that each sees: in a list, or nothing
for 1."""


def scatterers_of(config: LightConfig, inputs: ShadingInputs) -> Scatterers:
    return Scatterers(
        inputs.features,
        normals=config.field.features,
        albedos=config.albedos,
        sun=towards_sun(inputs.sun.light_axes),
    )


def _reflectances(config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch) -> list[Float]:
    """Floats [M] in (0, 1): the albedo, then, where surfaces mirror, the specular reflectance, RGB each."""
    return [network.sigmoid(row) for row in batch.block(inputs.features, config.albedos, 6 if config.mirrors else 3)]


def emitted_light(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    shares: Shares,
    batch: PaddedBatch,
    input_layer: network.InputLayer | None = None,
    painted: TensorXf | None = None,
) -> list[Float]:
    """What `emission` gives, or nothing. weights: of the field;  input_layer: of the field, if it is known;  painted:
    what the field says of `painted_items`, if that is"""
    surroundings = inputs.surroundings
    if surroundings is None:
        return []
    scatterers, emitters = scatterers_of(config, inputs), surroundings.emitters
    if config.mirrors:
        shape = config.field.shape
        if painted is None:
            items = painted_items(config, inputs, batch.count)
            output, _ = mlp.forward(shape, weights, items, inputs.sun.field_encoding, input_layer=input_layer)
        else:
            output = network.rows_of(painted)
        light = _painted(config, output, shares)
    else:
        light = albedo_radiance(scatterers, shares(dr.arange(ad.UInt32, config.bounce)), emitters, batch.count)
    return emission(scatterers, surroundings, config.bounce, light, batch.count)


def shares_of(inputs: ShadingInputs, visibility: list[Float]) -> Shares:
    """Of the visibility of all Gaussians, evaluated, in a list, or nothing for 1."""

    def shares(k: UInt32) -> list[Float]:
        assert inputs.surroundings is not None, "something is emitted"
        number = dr.gather(ad.UInt32, inputs.surroundings.emitters, k)
        return [dr.gather(ad.Float, array, number) for array in visibility]

    return shares


def received_light(
    config: LightConfig, inputs: ShadingInputs, emitted: list[Float], batch: PaddedBatch, parts: Parts
) -> list[Float]:
    """Of `received_on_seen`; nothing where nothing is emitted."""
    if not emitted or inputs.surroundings is None:
        return []
    scatterers, directions, around = scatterers_of(config, inputs), inputs.of_field().directions, inputs.surroundings
    return received_on_seen(scatterers, around, emitted, config.bounce, batch, directions, parts)


def seen_rays(config: LightConfig, inputs: ShadingInputs, batch: PaddedBatch) -> Rays:
    """Along which that light arrives."""
    assert inputs.surroundings is not None, "something is emitted"
    direction = inputs.of_field().directions(batch)
    return rays_on_seen(scatterers_of(config, inputs), inputs.surroundings, batch, direction)


def painted_items(config: LightConfig, inputs: ShadingInputs, gaussians: UInt32) -> TensorXf:
    """Items of the field, TensorXf [B, C, m]: emitters seen from `SIDES` sides at 45 degrees to their normals, all off
    the plane of Sun and normal, in which mirrors show the Sun. gaussians: N"""
    assert inputs.surroundings is not None, "something is emitted"
    field, count, emitters = config.field, config.bounce, inputs.surroundings.emitters
    columns = PaddedBatch.with_room_for(SIDES * count, gaussians)
    column = _painted_columns(count, columns.capacity)
    number, side = dr.gather(ad.UInt32, emitters, column // SIDES), column % SIDES
    normals = lit_normals(scatterers_of(config, inputs), number, gaussians)
    along = across(normals, towards_sun(inputs.sun.light_axes))
    sine, cosine = dr.sincos((ad.Float(side) + 0.5) * (2 * dr.pi / SIDES))
    direction = -(0.5**0.5) * (normals + cosine * along + sine * dr.cross(normals, along))
    rows = [dr.gather(ad.Float, inputs.features, i * gaussians + number) for i in range(field.features)]
    rows += [*field.view(direction), *surface_cosines(normals, direction, towards_sun(inputs.sun.light_axes))]
    return columns.matrix(rows, field.shape.rows)


def _painted_columns(count: int, capacity: int) -> UInt32:
    """Sides of emitters, `SIDES` each, the last repeated."""
    return dr.minimum(dr.arange(ad.UInt32, capacity), SIDES * count - 1)


def _painted(config: LightConfig, output: list[Float], shares: Shares) -> list[Float]:
    """The light of the emitters, three Floats, as the field paints them: mean of what is seen of their sides. output:
    of the field of `painted_items`"""
    colors, count = [field_color(config.decoding, value) for value in output], config.bounce
    for share in shares(_painted_columns(count, dr.width(output)) // SIDES):
        colors = [color * share for color in colors]
    light = colors if config.linear else [decode_srgb(color) for color in colors]
    dr.eval(light)
    index = SIDES * dr.arange(ad.UInt32, count)
    sums = [sum((dr.gather(ad.Float, values, index + i) for i in range(SIDES)), ad.Float(0)) for values in light]
    return [total / SIDES for total in sums]


def scattered_light(
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
    """Three Floats [M]: what surfaces reflect of `scattered_light`."""
    shares = reflectances + [grazing_reflectance(specular) for specular in reflectances[3:]]
    parts = [rho * light for rho, light in zip(shares, scattered, strict=False)]  # without emitters the albedo alone
    return [sum(parts[c + 3 :: 3], parts[c]) for c in range(3)]


def _reflected_slopes(reflectances: list[Float], scattered: list[Float]) -> list[Float]:
    """d `_reflected` by each reflectance."""
    rows = zip(reflectances[3:], scattered[3:6], scattered[6:], strict=True)
    slopes = [along + grazing_reflectance_slope(specular) * grazing for specular, along, grazing in rows]
    return scattered[:3] + slopes


def add_scattered(
    config: LightConfig, inputs: ShadingInputs, shown: list[Float], scattered: list[Float], batch: PaddedBatch
) -> list[Float]:
    """Dimmed colours [M] with the light of `scattered_light`, what else is in `shown` as it was."""
    reflected = _reflected(_reflectances(config, inputs, batch), scattered)
    rows = zip(shown[:3], reflected, strict=True)
    return [add_irradiance(color, light, config.linear) for color, light in rows] + shown[3:]


def scattered_adjoint(
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
