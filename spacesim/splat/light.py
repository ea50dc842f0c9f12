"""Sun direction in, colours and visibility of the Gaussians out: the appearance field (thesis 4.2) and the shadows
(4.3), and the adjoint of both.

`LightModel.shade` is the forward pass, `LightModel.adjoint` the way back to features and weights. View directions count
as given, and so do shadows, as in the literature, unless `ShadowConfig.gradients` takes them back to the Gaussians.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded, select
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.tone import TONES
from spacesim.splat import cooperative, mlp
from spacesim.splat.appearance import (
    FieldConfig,
    FieldInputs,
    by_normals,
    facing,
    field_items,
    field_views,
    turned_over,
)
from spacesim.splat.bounce import MOST_EMITTERS, Scatterers, brightened, brightened_slopes, irradiance
from spacesim.splat.cameras import Projection
from spacesim.splat.gaussians import Gaussians, uploaded
from spacesim.splat.lanes import Lanes, aligned
from spacesim.splat.shadow.cast import ShadowConfig, Shadows, cast_shadows, cast_shadows_adaptively
from spacesim.splat.shadow.refine import RefineConfig, refine_inputs, refined, refined_slope
from spacesim.splat.shadow.sunlight import SUNS, light_rows, towards_sun
from spacesim.splat.tiles import RECORDINGS

LARGEST_EV = 40  #: of an exposure, as large as a scene's camera can have; chosen
COOPERATIVE = ("cuda",)  #: backends on which the field of pictures is computed by `cooperative` where that works


@dataclass(frozen=True)
class LightConfig:
    """How light becomes colour. shadow: None leaves shadows to the field (the method `relight`);  bounce: so
    many of the Gaussians scatter sunlight onto all (`bounce.irradiance`), 0 for none;  linear: colours are
    linear, shares of what is white, and blended as such, and pictures go through the tone curve afterwards; else they
    are sRGB values, as in the thesis (section 7.2 asks for the former);  tone: the curve, one of
    `spacesim.data.tone.TONES`;  exposure: EV of the pictures trained on; both of linear colours alone, by default the
    dataset's own, which `train` fills in ("srgb", 0 where it does not say)."""

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


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """Where a model was when it was trained, metres. centre: [3], mu_model of 4.12;  scale: the unit of length of its
    networks;  distance: of the farthest training camera from the centre, dist_max of 4.5;  radius: of the Gaussians
    that training started from, about the centre"""

    centre: Array
    scale: float
    distance: float
    radius: float


@dataclass
class SunTerms:
    """A Sun as the kernels read it, Floats. light: [9], `light_rows`;  field, refine: what each network is told"""

    light: Any
    field: Any
    refine: Any


@dataclass
class _Inputs:
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
class _Tape:
    """What the adjoint needs of the forward pass. colours: 3 arrays [M] before they are dimmed;  occlusion: the refined
    one [M] in a list, or nothing;  faces: of `facing`, or nothing;  bounced: 3 arrays [M], light at the side that is
    seen, or nothing"""

    field: list[Any]
    refine: list[Any]
    colours: list[Any]
    occlusion: list[Any]
    faces: list[Any]
    bounced: list[Any]


@dataclass
class Sunlight:
    """What of a Sun's light no camera changes. visibility: Float [N], what dims colours (4.17), or None of a model
    without shadows;  bounced: of `bounce.irradiance`, Floats [N], or nothing"""

    visibility: Any
    bounced: list[Any]


@dataclass
class Shading:
    """colours: 3 arrays [N], display values that visibility has dimmed (4.17);  visibility: Float [N] in [0, 1] as
    pictures show it, so times `facing`, which colours do without, or None;  shadows: raw, or None;
    inputs, lanes, tape: what `LightModel.adjoint` wants"""

    colours: list[Any]
    visibility: Any
    shadows: Shadows | None
    inputs: _Inputs
    lanes: Lanes
    tape: _Tape


@dataclass
class _Kept:
    """What pictures of one model have in common. read: the arrays that it was made of;  known: what the field's first
    layer makes of the features;  packed: the field's network for `cooperative`. One of the two."""

    read: list[Any]
    known: mlp.Known | None
    packed: list[Any]


@dataclass
class LightGradients:
    """features: Float [F * N];  weights: as `LightModel.weights`;  geometry: of the first 11 rows of the Gaussians
    (`Gaussians.rows`), through their shadows, or nothing where shadows count as given"""

    features: Any
    weights: list[Any]
    geometry: list[Any]


class LightModel:
    """The networks of a relightable model.

    weights: Floats, the field's and then the refinement's, each as `mlp.initial_weights` orders them
    frame: of its training
    """

    def __init__(self, config: LightConfig, weights: list[Any], frame: TrainingFrame) -> None:
        self.config, self.weights, self.frame = config, weights, frame
        self._place = ad.Float([*np.asarray(frame.centre, np.float32), frame.scale])
        self._terms = lru_cache(maxsize=SUNS)(self._sun_terms)
        self._kept = _Kept([], None, [])

    @staticmethod
    def initial(config: LightConfig, frame: TrainingFrame, seed: int) -> "LightModel":
        """Fresh networks; the refinement's last layer starts at 0, so that raw shadows are where training starts."""
        rng = np.random.default_rng([seed, 4])
        weights = mlp.initial_weights(config.field.shape, rng)
        if config.refine:
            weights += mlp.initial_weights(config.refine.shape, rng, last=0.0)
        return LightModel(config, [ad.Float(weight) for weight in weights], frame)

    def sun_terms(self, sun: np.ndarray) -> SunTerms:
        """What kernels read of a Sun in the direction `sun` [3], unit, world axes."""
        terms: SunTerms = self._terms(*(float(value) for value in sun))
        return terms

    def shadows(self, gaussians: Gaussians, sun: np.ndarray, adaptive: bool = False) -> Shadows | None:
        """Raw occlusion of each Gaussian; None for a model without shadows. adaptive: several light cameras where one
        has less than half the pixels a metre that it had of the whole model in training (f_min of algorithm 3)."""
        config, frame = self.config.shadow, self.frame
        if config is None:
            return None
        if adaptive:
            least_scale = 0.25 * config.size / frame.radius
            return cast_shadows_adaptively(gaussians, sun, config, frame.distance, least_scale)
        return cast_shadows(gaussians, self.sun_terms(sun).light, config, frame.distance)

    def shade(self, gaussians: Gaussians, camera: Projection, sun: np.ndarray, adaptive: bool = False) -> Shading:
        """Colours of the Gaussians seen from `camera` with the Sun in the direction `sun` [3], unit, world axes.
        adaptive: see `shadows`."""
        shadows = self.shadows(gaussians, sun, adaptive)
        inputs = self._inputs(gaussians, camera, sun, shadows)
        lanes = Lanes.of(gaussians.count)
        colours, visibility, tape = _shade(self.config, self.weights, inputs, lanes)
        return Shading(colours, visibility[0] if visibility else None, shadows, inputs, lanes, tape)

    def sunlight(self, gaussians: Gaussians, sun: np.ndarray, adaptive: bool = False) -> Sunlight:
        """Visibility, and light that bounces, under one Sun, for any number of pictures. Arguments: see `shadows`."""
        shadows = self.shadows(gaussians, sun, adaptive)
        if shadows is None and not self.config.bounce:
            return Sunlight(None, [])
        lanes = Lanes.of(gaussians.count, still=True)
        _, of_refine = _split(self.config, self.weights)
        visibility, bounced = _sunlit(self.config, of_refine, self._inputs(gaussians, None, sun, shadows), lanes)
        return Sunlight(visibility[0] if visibility else None, bounced)

    def lit(
        self,
        gaussians: Gaussians,
        camera: Projection,
        sun: np.ndarray,
        adaptive: bool = False,
        known: Sunlight | None = None,
    ) -> tuple[list[Any], Any]:
        """(colours, visibility) of `shade`, for a picture: nothing is left for an adjoint. known: `sunlight` of this
        Sun, of an earlier picture. What the field's first layer makes of the features does not change with Sun or
        camera and stays for the next picture: as many numbers for each Gaussian as the layer has units."""
        light = self.sunlight(gaussians, sun, adaptive) if known is None else known
        of_any_size = replace(camera, width=1, height=1)  # directions do not depend on it: one recording for all sizes
        inputs = self._inputs(gaussians, of_any_size, sun, None)
        lanes = Lanes.of(gaussians.count, still=True)
        kept = self._kept_of(gaussians.features, lanes)
        of_field, _ = _split(self.config, self.weights)
        seen = [] if light.visibility is None else [light.visibility]
        shown = _lit(self.config, of_field, inputs, lanes, kept.known, kept.packed, seen, light.bounced)
        return shown[:3], shown[3] if seen else None

    def adjoint(self, shading: Shading, by_colour: list[Any], by_visibility: Any = None) -> "LightGradients":
        """From the gradients of the dimmed colours (3 arrays [N]) and, where visibility is seen on its own, of the
        visibility [N]."""
        more = [] if by_visibility is None else [by_visibility]
        arguments = self.config, self.weights, shading.inputs, shading.lanes, shading.tape, by_colour, more
        by_features, by_weights, by_raw = _adjoint(*arguments)
        by_geometry = shading.shadows.adjoint(by_raw[0]) if by_raw and shading.shadows else []
        return LightGradients(by_features, by_weights, by_geometry)

    def tensors(self) -> dict[str, np.ndarray]:
        """For a file: the weights, and the training frame."""
        weights = {f"light.weight.{i:02d}": np.array(weight) for i, weight in enumerate(self.weights)}
        frame = [*self.frame.centre, self.frame.scale, self.frame.distance, self.frame.radius]
        return {**weights, "light.frame": np.array(frame, dtype=np.float64)}

    @staticmethod
    def from_tensors(config: LightConfig, tensors: Mapping[str, np.ndarray]) -> "LightModel":
        """The inverse of `tensors`. Raises KeyError where one is missing, ValueError where its length does not fit."""
        *centre, scale, distance, radius = tensors["light.frame"].tolist()
        model = LightModel.initial(config, TrainingFrame(np.array(centre), scale, distance, radius), 0)
        for i, like in enumerate(model.weights):
            weight = tensors[f"light.weight.{i:02d}"]
            if np.shape(weight) != (dr.width(like),):
                raise ValueError(f"light.weight.{i:02d}: expected {dr.width(like)} numbers, found {np.shape(weight)}")
            model.weights[i] = uploaded(weight)
        return model

    def _inputs(
        self, gaussians: Gaussians, camera: Projection | None, sun: np.ndarray, shadows: Shadows | None
    ) -> _Inputs:
        raw = [shadows.occlusion, *shadows.info] if shadows else []
        turns = gaussians.quaternions, gaussians.log_scales
        logits = gaussians.logit_opacities
        return _Inputs(
            gaussians.features, gaussians.means, turns, logits, camera, raw, self.sun_terms(sun), self._place
        )

    def _kept_of(self, features: Any, lanes: Lanes) -> _Kept:
        """Made anew where features or weights have changed. Copies hold what was read: a number of Dr.Jit's that is in
        use is never another array's."""
        of_field, _ = _split(self.config, self.weights)
        by_vectors = select() in COOPERATIVE and cooperative.usable()
        read = of_field if by_vectors else [features, of_field[1]]
        if [array.index for array in read] != [array.index for array in self._kept.read]:
            self._kept = _Kept([], None, [])  # room for the next
            field = self.config.field
            packed = cooperative.pack(field.shape, of_field) if by_vectors else []
            known = None if by_vectors else _known(field, of_field, features, lanes)
            self._kept = _Kept([ad.Float(array) for array in read], known, packed)
        return self._kept

    def _sun_terms(self, *sun: float) -> SunTerms:
        refine = self.config.refine or self.config.field
        terms = SunTerms(light_rows(sun), self.config.field.sun.of_one(sun), refine.sun.of_one(sun))
        dr.eval(terms)
        return terms


def _trace_shade(
    config: LightConfig, weights: list[Any], inputs: _Inputs, lanes: Lanes
) -> tuple[list[Any], list[Any], _Tape]:
    """(dimmed colours, [visibility] or [], tape)."""
    of_field, of_refine = _split(config, weights)
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
    return shown[:3], shown[3:], _Tape(field_tape, refine_tape, colours, occlusion, faces, bounced)


def _trace_lit(
    config: LightConfig,
    of_field: list[Any],
    inputs: _Inputs,
    lanes: Lanes,
    known: mlp.Known | None,
    packed: list[Any],
    visibility: list[Any],
    bounced: list[Any],
) -> list[Any]:
    """Dimmed colours, and visibility as it is shown. known, packed: see `_Kept`;  visibility: [N] in a list, or
    nothing;  bounced: see `Sunlight`"""
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
    config: LightConfig, of_refine: list[Any], inputs: _Inputs, lanes: Lanes
) -> tuple[list[Any], list[Any]]:
    """([refined visibility [N]] or [], light that bounces, see `Sunlight`)."""
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


def _occluded(config: LightConfig, of_refine: list[Any], inputs: _Inputs, lanes: Lanes) -> tuple[list[Any], list[Any]]:
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
    inputs: _Inputs,
    lanes: Lanes,
    tape: _Tape,
    by_colour: list[Any],
    by_visibility: list[Any],
) -> tuple[Any, list[Any], list[Any]]:
    """(gradient of the features, gradients of the weights, [gradient of the raw occlusion] where it is asked for)."""
    of_field, of_refine = _split(config, weights)
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


def _refine_items(config: LightConfig, refine: RefineConfig, inputs: _Inputs, lanes: Lanes) -> Any:
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


def _field_inputs(inputs: _Inputs) -> FieldInputs:
    assert inputs.camera is not None
    return FieldInputs(inputs.features, inputs.means, inputs.turns, inputs.camera, towards_sun(inputs.sun.light))


def _scatterers(config: LightConfig, inputs: _Inputs) -> Scatterers:
    rows = inputs.features, config.field.features, config.albedos
    return Scatterers(*rows, inputs.means, inputs.turns[1], inputs.logits, towards_sun(inputs.sun.light))


def _albedo(config: LightConfig, inputs: _Inputs, lanes: Lanes) -> list[Any]:
    """Three Floats [M] in (0, 1)."""
    return [mlp.sigmoid(row) for row in lanes.block(inputs.features, config.albedos, 3)]


def _on_seen_side(config: LightConfig, inputs: FieldInputs, bounced: list[Any], lanes: Lanes) -> list[Any]:
    """Three Floats [M] of the six of `irradiance`."""
    over = turned_over(config.field, inputs, lanes)
    return [dr.select(over, bounced[3 + c], bounced[c]) for c in range(3)]


def _brightened(config: LightConfig, inputs: _Inputs, shown: list[Any], bounced: list[Any], lanes: Lanes) -> list[Any]:
    """Dimmed colours [M] with the light that bounces, what else is in `shown` as it was."""
    rows = zip(shown[:3], _albedo(config, inputs, lanes), bounced, strict=True)
    return [brightened(colour, rho * light, config.linear) for colour, rho, light in rows] + shown[3:]


def _before_bounce(
    config: LightConfig, inputs: _Inputs, gradients: list[Any], dimmed: list[Any], bounced: list[Any], lanes: Lanes
) -> tuple[list[Any], list[Any]]:
    """Gradients [M] of the dimmed colours and of the albedos' logits. What bounces counts as given, as it is small."""
    by_dimmed, by_albedo = [], []
    rows = zip(gradients, dimmed, _albedo(config, inputs, lanes), bounced, strict=True)
    for gradient, colour, rho, light in rows:
        of_colour, of_light = brightened_slopes(colour, rho * light, config.linear)
        by_dimmed.append(gradient * of_colour)
        by_albedo.append(gradient * of_light * light * rho * (1 - rho))
    return by_dimmed, by_albedo


def _split(config: LightConfig, weights: list[Any]) -> tuple[list[Any], list[Any]]:
    """Weights of the field, of the refinement."""
    count = 1 + 2 * config.field.layers
    return weights[:count], weights[count:]


_shade = recorded(_trace_shade, RECORDINGS)
_lit = recorded(_trace_lit, RECORDINGS)
_sunlit = recorded(_trace_sunlit, RECORDINGS)
_known = recorded(_trace_known, RECORDINGS)
_adjoint = recorded(_trace_adjoint, RECORDINGS)
