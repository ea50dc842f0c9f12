"""From gradients of colours and visibility back to features and weights."""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, TensorXf
from spacesim.learning.networks import fused, mlp, network, tensor_cores, warps
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import field_color_slope, normals_adjoint, sun_adjoint
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.forward import ShadingTape, picture_visibility, split_weights
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shading.scattering import scattered_adjoint


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
    shape, of_field = config.field.shape, split_weights(config, weights)[0]
    if any(fused.has_made(made) for made in (tape.field, tape.refine) if made):
        gradients = _output_gradients(config, inputs, batch, tape, grad_color, grad_visibility)
        by_networks = [fused.backward(way) for way in _ways(config, weights, inputs, tape, gradients, by_sun)]
        return _gathered(config, weights, inputs, batch, gradients, by_networks, by_sun)
    if not tensor_cores.takes(shape, batch.capacity):
        return _adjoint(config, weights, inputs, batch, tape, grad_color, grad_visibility, by_sun)
    gradients, last = _until_hidden(config, weights, inputs, batch, tape, grad_color, grad_visibility, by_sun)
    hidden = tensor_cores.back_through_hidden(shape, of_field, tape.field.values, last)
    return _after_hidden(config, weights, inputs, batch, tape, gradients, hidden, by_sun)


@dataclass
class _OutputGradients:
    """By what networks say, and by what does not come from these."""

    field: TensorXf  #: [B, 3, m]
    refine: list[TensorXf]  #: [B, 1, m] in a list, or nothing
    facing: list[Float]  #: of `sun_facing`, or nothing
    albedo: list[Float]  #: [M] each, or nothing
    earth: list[Float]  #: of `earthlight`, or nothing


@recorded
def _adjoint(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    tape: ShadingTape,
    grad_color: list[Float],
    grad_visibility: list[Float],
    by_sun: bool,
) -> tuple[Float, list[Float], list[Float], list[Float]]:
    """`adjoint`, all in one."""
    gradients = _output_gradients(config, inputs, batch, tape, grad_color, grad_visibility)
    by_networks = mlp.backward_together(_ways(config, weights, inputs, tape, gradients, by_sun))
    return _gathered(config, weights, inputs, batch, gradients, by_networks, by_sun)


@recorded
def _until_hidden(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    tape: ShadingTape,
    grad_color: list[Float],
    grad_visibility: list[Float],
    by_sun: bool,
) -> tuple[_OutputGradients, warps.LastGradient]:
    gradients = _output_gradients(config, inputs, batch, tape, grad_color, grad_visibility)
    last = warps.through_last(_ways(config, weights, inputs, tape, gradients, by_sun)[0])
    dr.eval(gradients, last)
    return gradients, last


@recorded
def _after_hidden(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    tape: ShadingTape,
    gradients: _OutputGradients,
    hidden: warps.HiddenGradients,
    by_sun: bool,
) -> tuple[Float, list[Float], list[Float], list[Float]]:
    by_networks = mlp.backward_together(_ways(config, weights, inputs, tape, gradients, by_sun), hidden)
    return _gathered(config, weights, inputs, batch, gradients, by_networks, by_sun)


@recorded
def _output_gradients(
    config: LightConfig,
    inputs: ShadingInputs,
    batch: PaddedBatch,
    tape: ShadingTape,
    grad_color: list[Float],
    grad_visibility: list[Float],
) -> _OutputGradients:
    visibility = 1 - tape.occlusion[0] if tape.occlusion else 1
    gradients = [batch.pad_zeros(gradient) for gradient in grad_color]
    grad_albedo: list[Float] = []
    grad_earth: list[Float] = []
    dimmed, slopes = inputs.sun.colors_left([color * visibility for color in tape.colors])
    if tape.scattered:
        gradients, grad_albedo, grad_earth = scattered_adjoint(config, inputs, gradients, dimmed, tape.scattered, batch)
    gradients = [gradient * slope for gradient, slope in zip(gradients, slopes, strict=True)]
    pairs = list(zip(gradients, tape.colors, strict=True))
    grad_shown = inputs.sun.left([batch.pad_zeros(gradient) for gradient in grad_visibility])
    grad_output = batch.matrix([g * visibility * field_color_slope(config.decoding, c) for g, c in pairs])
    grad_logits = []
    if config.refine:
        grad_occlusion = -sum(
            (g * c for g, c in pairs), sum((picture_visibility(g, tape.faces) for g in grad_shown), ad.Float(0))
        )
        occlusion = tape.occlusion[0]
        grad_logits = [batch.matrix([grad_occlusion * occlusion * (1 - occlusion)])]
    grad_facing = [gradient * visibility for gradient in grad_shown] if config.field.surface else []
    return _OutputGradients(grad_output, grad_logits, grad_facing, grad_albedo, grad_earth)


def _ways(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    tape: ShadingTape,
    gradients: _OutputGradients,
    by_sun: bool,
) -> list[network.WayBack]:
    """Of the field, then of the refinement, if there is one."""
    field_weights, refine_weights = split_weights(config, weights)
    encoding = inputs.sun.field_encoding
    wanted = None if config.field.surface or by_sun else config.field.features
    ways = [network.WayBack(config.field.shape, field_weights, tape.field, encoding, gradients.field, wanted)]
    for grad_logit in gradients.refine:
        assert config.refine is not None, "it was refined"
        assert tape.refine is not None, "it was refined"
        encoding = inputs.sun.of_refinement
        ways.append(network.WayBack(config.refine.shape, refine_weights, tape.refine, encoding, grad_logit))
    return ways


@recorded
def _gathered(
    config: LightConfig,
    weights: list[Float],
    inputs: ShadingInputs,
    batch: PaddedBatch,
    gradients: _OutputGradients,
    by_networks: list[tuple[list[Float], TensorXf]],
    by_sun: bool,
) -> tuple[Float, list[Float], list[Float], list[Float]]:
    """What `adjoint` gives, of what `mlp.backward_together` does."""
    field_weights, _ = split_weights(config, weights)
    (grad_weights, grad_items), *of_refinement = by_networks
    by_encoding = []
    if config.field.embeddings or by_sun:
        by_encoding = [mlp.shared_gradient(config.field.shape, field_weights, grad_weights)]
    parts = [(grad_items, 0, config.field.features)]
    grad_sun = []
    if by_sun:
        grad_sun = [sun_adjoint(config.field, inputs.of_field(), grad_items, gradients.facing, by_encoding[0], batch)]
    if config.field.surface:
        of_normals = normals_adjoint(
            config.field, inputs.of_field(), grad_items, gradients.facing, gradients.earth, batch
        )
        parts.append((of_normals, 0, 3))
    for of_weights, of_items in of_refinement:
        assert config.refine is not None
        grad_weights += of_weights
        parts.append((of_items, 1, config.refine.features))  # the raw occlusion stands before them
    if gradients.albedo:
        parts.append((batch.matrix(gradients.albedo), 0, len(gradients.albedo)))
    by_encoding = by_encoding if config.field.embeddings else []
    return batch.pack(parts, inputs.features), grad_weights, by_encoding, grad_sun
