"""How light becomes colour: its configuration, and the kernels of `spacesim.splat.light.model`, forth and back.

Each kernel is recorded once for all Gaussians in columns of few sizes (`lanes`).
"""

from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError
from spacesim.data.tone import TONES
from spacesim.splat.light import cooperative, mlp
from spacesim.splat.light.bounce import MOST_EMITTERS, Scatterers, brightened, brightened_slopes, irradiance
from spacesim.splat.light.columns import Lanes, aligned
from spacesim.splat.light.field import (
    FieldConfig,
    FieldInputs,
    by_normals,
    facing,
    field_items,
    field_views,
    turned_over,
)
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.light_camera import towards_sun
from spacesim.splat.light.shadow.refine import RefineConfig, refine_inputs, refined, refined_slope
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.cameras import Projection

LARGEST_EV = 40  #: of an exposure, as large as a scene's camera can have; chosen


@dataclass(frozen=True)
class LightConfig:
    """How light becomes colour. shadow: None leaves shadows to the field (the method `relight`);  bounce: so many of
    the Gaussians scatter sunlight onto all (`bounce.irradiance`), 0 for none;  linear: colours are linear, shares of
    what is white, and blended as such, and pictures go through the tone curve afterwards; else they are sRGB values, as
    in the thesis (section 7.2 asks for the former);  tone: the curve, one of `spacesim.data.tone.TONES`;  exposure: EV
    of the pictures trained on; both of linear colours alone, by default the dataset's own, which `train` fills in
    ("srgb", 0 where it does not say)."""

    field: FieldConfig = field(default_factory=FieldConfig)
    shadow: ShadowConfig | None = None
    bounce: int = 0
    linear: bool = False
    tone: str | None = None
    exposure: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.bounce <= MOST_EMITTERS:
            raise InputError(f"--bounce: expected 0 to {MOST_EMITTERS}, found {self.bounce}")
        if self.bounce and not self.field.surface:
            raise InputError("--bounce: expected --field surface, whose normals it needs, found another")
        for name in ("tone", "exposure"):
            if getattr(self, name) is not None and not self.linear:
                raise InputError(f"--{name}: expected --linear beside it, found none")
        if self.tone not in (None, *TONES):
            raise InputError(f"--tone: expected one of {', '.join(TONES)}, found {self.tone!r}")
        if self.exposure is not None and not abs(self.exposure) <= LARGEST_EV:
            raise InputError(f"--exposure: expected -{LARGEST_EV} to {LARGEST_EV} EV, found {self.exposure}")

    @property
    def curve(self) -> tuple[str, float] | None:
        """Tone curve and exposure (EV) of linear colours, None of others."""
        return (self.tone or "srgb", self.exposure or 0.0) if self.linear else None

    @property
    def refine(self) -> RefineConfig | None:
        """The refinement of shadows, if there is one."""
        return self.shadow.refine if self.shadow else None

    @property
    def features(self) -> int:
        """F: numbers that each Gaussian has for the field, then for the refinement of shadows, then of its albedo."""
        return self.albedos + 3 * (self.bounce > 0)

    @property
    def albedos(self) -> int:
        """Which of these numbers are the logits of the albedo (RGB) that one bounce needs: this and the next two."""
        return self.field.stored + (self.refine.features if self.refine else 0)


@dataclass
class SunTerms:
    """A Sun as the kernels read it, Floats. light: [9], `light_rows`;  field, refine: what each network is told"""

    light: Any
    field: Any
    refine: Any


@dataclass
class Inputs:
    """What shading depends on beside weights. turns: quaternions and log scales;  logits: of opacities;  camera: None
    where the Sun's light alone is wanted;  raw: occlusion, normal alignment, light extent and bias, [N] each, or
    nothing;  place: Float [4], centre and scale of the training frame"""

    features: Any
    means: Any
    turns: tuple[Any, Any]
    logits: Any
    camera: Projection | None
    raw: list[Any]
    sun: SunTerms
    place: Any


@dataclass
class Tape:
    """What the adjoint needs of the forward pass. colours: 3 arrays [M] before they are dimmed;  occlusion: the refined
    one [M] in a list, or nothing;  faces: of `facing`, or nothing;  bounced: 3 arrays [M], light at the side that is
    seen, or nothing"""

    field: list[Any]
    refine: list[Any]
    colours: list[Any]
    occlusion: list[Any]
    faces: list[Any]
    bounced: list[Any]


def _trace_shade(
    config: LightConfig, weights: list[Any], inputs: Inputs, lanes: Lanes
) -> tuple[list[Any], list[Any], Tape]:
    """(dimmed colours, [visibility] or [], tape)."""
    of_field, of_refine = split(config, weights)
    field_inputs = _field_inputs(inputs)
    views = field_views(config.field, field_inputs, lanes)
    items = field_items(config.field, inputs.features, views, lanes)
    output, field_tape = mlp.forward(config.field.shape, of_field, items, inputs.sun.field)
    colours = [mlp.sigmoid(lanes.row(output, i)) for i in range(3)]
    occlusion, refine_tape = _occluded(config, of_refine, inputs, lanes)
    faces = facing(config.field, field_inputs, views, lanes) if occlusion else []
    shown = _dimmed(colours, [1 - value for value in occlusion], faces)
    dr.eval(shown, colours, occlusion, faces)
    bounced = []
    if config.bounce:
        both = irradiance(_scatterers(config, inputs), config.bounce, [1 - value for value in occlusion], lanes)
        bounced = _on_seen_side(config, field_inputs, both, lanes)
        shown = _brightened(config, inputs, shown, bounced, lanes)
        dr.eval(shown, bounced)
    shown = lanes.narrowed(shown, inputs.means.x)
    return shown[:3], shown[3:], Tape(field_tape, refine_tape, colours, occlusion, faces, bounced)


def _trace_lit(
    config: LightConfig,
    of_field: list[Any],
    inputs: Inputs,
    lanes: Lanes,
    known: mlp.Known | None,
    packed: list[Any],
    visibility: list[Any],
    bounced: list[Any],
) -> list[Any]:
    """Dimmed colours, and visibility as it is shown. known, packed: see `model._Kept`;  visibility: [N] in a list, or
    nothing;  bounced: see `model.Sunlight`"""
    field, field_inputs = config.field, _field_inputs(inputs)
    views = field_views(field, field_inputs, lanes)
    if known:
        items = lanes.matrix(views, aligned(len(views)))
        output, _ = mlp.forward(field.shape, of_field, items, inputs.sun.field, known)
        outputs = [lanes.row(output, i) for i in range(3)]
    else:
        rows = lanes.block(inputs.features, 0, field.features) + views
        outputs = cooperative.forward(field.shape, packed, rows, inputs.sun.field)
    colours = [mlp.sigmoid(value) for value in outputs]
    shown = _dimmed(colours, [lanes.padded(value) for value in visibility], facing(field, field_inputs, views, lanes))
    if bounced:
        seen = _on_seen_side(config, field_inputs, [lanes.padded(light) for light in bounced], lanes)
        shown = _brightened(config, inputs, shown, seen, lanes)
    dr.eval(shown)
    return lanes.narrowed(shown, inputs.means.x)


def _trace_sunlit(
    config: LightConfig, of_refine: list[Any], inputs: Inputs, lanes: Lanes
) -> tuple[list[Any], list[Any]]:
    """([refined visibility [N]] or [], light that bounces, see `model.Sunlight`)."""
    visibility = [1 - value for value in _occluded(config, of_refine, inputs, lanes)[0]]
    dr.eval(visibility)
    bounced = irradiance(_scatterers(config, inputs), config.bounce, visibility, lanes) if config.bounce else []
    dr.eval(bounced)
    shown = lanes.narrowed([*visibility, *bounced], inputs.means.x)
    return shown[: len(visibility)], shown[len(visibility) :]


def _trace_known(field: FieldConfig, weights: list[Any], features: Any, lanes: Lanes) -> mlp.Known:
    items = lanes.matrix(lanes.block(features, 0, field.features), aligned(field.features))
    return mlp.known(field.shape, weights, items, field.features)


def _dimmed(colours: list[Any], visibility: list[Any], faces: list[Any]) -> list[Any]:
    """Colours [M] dimmed by visibility ([M] in a list, or nothing), then that as it is shown. faces: of `facing`"""
    if not visibility:
        return colours
    return [colour * visibility[0] for colour in colours] + [_shown(visibility[0], faces)]


def _shown(visibility: Any, faces: list[Any]) -> Any:
    """A picture's: what is turned away from the Sun does not see it."""
    return visibility * faces[0] if faces else visibility


def _occluded(config: LightConfig, of_refine: list[Any], inputs: Inputs, lanes: Lanes) -> tuple[list[Any], list[Any]]:
    """([refined occlusion [M]] or [], tape of the refinement)."""
    occlusion = [lanes.padded(row) for row in inputs.raw[:1]]
    if not config.refine:
        return occlusion, []
    items = _refine_items(config, config.refine, inputs, lanes)
    output, tape = mlp.forward(config.refine.shape, of_refine, items, inputs.sun.refine)
    return [refined(occlusion[0], lanes.row(output, 0))], tape


def _trace_adjoint(
    config: LightConfig,
    weights: list[Any],
    inputs: Inputs,
    lanes: Lanes,
    tape: Tape,
    by_colour: list[Any],
    by_visibility: list[Any],
) -> tuple[Any, list[Any], list[Any]]:
    """(gradient of the features, gradients of the weights, [gradient of the raw occlusion] where it is asked for)."""
    of_field, of_refine = split(config, weights)
    visibility = 1 - tape.occlusion[0] if tape.occlusion else 1
    gradients = [lanes.padded(gradient) for gradient in by_colour]
    by_albedo: list[Any] = []
    if tape.bounced:
        dimmed = [colour * visibility for colour in tape.colours]
        gradients, by_albedo = _before_bounce(config, inputs, gradients, dimmed, tape.bounced, lanes)
    pairs = list(zip(gradients, tape.colours, strict=True))
    by_output = lanes.matrix([g * visibility * c * (1 - c) for g, c in pairs])
    by_weights, by_items = mlp.backward(config.field.shape, of_field, tape.field, inputs.sun.field, by_output)
    parts = [(by_items, 0, config.field.features)]
    by_shown = [lanes.padded(gradient) for gradient in by_visibility]
    if config.field.surface:
        by_facing = [gradient * visibility for gradient in by_shown]
        parts.append((by_normals(config.field, _field_inputs(inputs), by_items, by_facing, lanes), 0, 3))
    by_raw: Any = -sum((g * c for g, c in pairs), sum((_shown(g, tape.faces) for g in by_shown), ad.Float(0)))
    if config.refine:
        occlusion = tape.occlusion[0]
        by_logit = by_raw * occlusion * (1 - occlusion)
        by_output = lanes.matrix([by_logit])
        more, by_items = mlp.backward(config.refine.shape, of_refine, tape.refine, inputs.sun.refine, by_output)
        by_weights += more
        parts.append((by_items, 1, config.refine.features))  # the raw occlusion stands before them
        by_raw = by_logit * refined_slope(lanes.padded(inputs.raw[0])) + lanes.row(by_items, 0)
        if config.refine.bias_info:  # it is told 1 - occlusion, too, before the other three
            by_raw -= lanes.row(by_items, config.refine.shape.inputs - 4)
    if by_albedo:
        parts.append((lanes.matrix(by_albedo), 0, 3))
    wanted = [by_raw] if config.shadow and config.shadow.gradients else []
    dr.eval(wanted)
    return lanes.packed(parts, inputs.features), by_weights, lanes.narrowed(wanted, inputs.means.x)


def _refine_items(config: LightConfig, refine: RefineConfig, inputs: Inputs, lanes: Lanes) -> Any:
    """Items of the refinement, TensorXf [B, C, m]: 4.11, lengths in training scale."""
    x, y, z, scale = (dr.gather(ad.Float, inputs.place, ad.UInt32(i)) for i in range(4))
    per_metre = dr.rcp(scale)
    positions = (lanes.spread(inputs.means) - ad.Array3f(x, y, z)) * per_metre
    if refine.positions == "light":
        axes = [[dr.gather(ad.Float, inputs.sun.light, ad.UInt32(3 * i + j)) for j in range(3)] for i in range(3)]
        positions = ad.Array3f([dr.dot(ad.Array3f(axis), positions) for axis in axes])
    occlusion, alignment, thickness, bias = (lanes.spread(value) for value in inputs.raw)
    features = lanes.block(inputs.features, config.field.stored, refine.features)
    info = [alignment, thickness * per_metre, bias * per_metre]
    return lanes.matrix(refine_inputs(refine, occlusion, features, positions, info), refine.shape.rows)


def _field_inputs(inputs: Inputs) -> FieldInputs:
    assert inputs.camera is not None
    return FieldInputs(inputs.features, inputs.means, inputs.turns, inputs.camera, towards_sun(inputs.sun.light))


def _scatterers(config: LightConfig, inputs: Inputs) -> Scatterers:
    rows = inputs.features, config.field.features, config.albedos
    return Scatterers(*rows, inputs.means, inputs.turns[1], inputs.logits, towards_sun(inputs.sun.light))


def _albedo(config: LightConfig, inputs: Inputs, lanes: Lanes) -> list[Any]:
    """Three Floats [M] in (0, 1)."""
    return [mlp.sigmoid(row) for row in lanes.block(inputs.features, config.albedos, 3)]


def _on_seen_side(config: LightConfig, inputs: FieldInputs, bounced: list[Any], lanes: Lanes) -> list[Any]:
    """Three Floats [M] of the six of `irradiance`."""
    over = turned_over(config.field, inputs, lanes)
    return [dr.select(over, bounced[3 + c], bounced[c]) for c in range(3)]


def _brightened(config: LightConfig, inputs: Inputs, shown: list[Any], bounced: list[Any], lanes: Lanes) -> list[Any]:
    """Dimmed colours [M] with the light that bounces, what else is in `shown` as it was."""
    rows = zip(shown[:3], _albedo(config, inputs, lanes), bounced, strict=True)
    return [brightened(colour, rho * light, config.linear) for colour, rho, light in rows] + shown[3:]


def _before_bounce(
    config: LightConfig, inputs: Inputs, gradients: list[Any], dimmed: list[Any], bounced: list[Any], lanes: Lanes
) -> tuple[list[Any], list[Any]]:
    """Gradients [M] of the dimmed colours and of the albedos' logits. What bounces counts as given, as it is small."""
    by_dimmed, by_albedo = [], []
    rows = zip(gradients, dimmed, _albedo(config, inputs, lanes), bounced, strict=True)
    for gradient, colour, rho, light in rows:
        of_colour, of_light = brightened_slopes(colour, rho * light, config.linear)
        by_dimmed.append(gradient * of_colour)
        by_albedo.append(gradient * of_light * light * rho * (1 - rho))
    return by_dimmed, by_albedo


def split(config: LightConfig, weights: list[Any]) -> tuple[list[Any], list[Any]]:
    """Weights of the field, of the refinement."""
    count = 1 + 2 * config.field.layers
    return weights[:count], weights[count:]


shade = recorded(_trace_shade, RECORDINGS)
lit = recorded(_trace_lit, RECORDINGS)
sunlit = recorded(_trace_sunlit, RECORDINGS)
known_layer = recorded(_trace_known, RECORDINGS)
adjoint = recorded(_trace_adjoint, RECORDINGS)
