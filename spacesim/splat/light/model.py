"""Sun direction in, colours and visibility of the Gaussians out: the appearance field (thesis 4.2) and the shadows
(4.3), and the adjoint of both.

`LightModel.shade` is the forward pass, `LightModel.adjoint` the way back to features and weights. View directions count
as given, and so do shadows, as in the literature, unless `ShadowConfig.gradients` takes them back to the Gaussians.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, select
from spacesim.data.geometry import Array
from spacesim.splat.light import cooperative, mlp
from spacesim.splat.light import shading as kernels
from spacesim.splat.light.columns import Lanes
from spacesim.splat.light.shading import Inputs, LightConfig, SunTerms, Tape, split
from spacesim.splat.light.shadow.cast import Shadows, cast_shadows, cast_shadows_adaptively
from spacesim.splat.light.shadow.light_camera import SUNS, light_rows
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import Gaussians, uploaded

COOPERATIVE = ("cuda",)  #: backends on which the field of pictures is computed by `cooperative` where that works


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
    inputs: Inputs
    lanes: Lanes
    tape: Tape


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
        colours, visibility, tape = kernels.shade(self.config, self.weights, inputs, lanes)
        return Shading(colours, visibility[0] if visibility else None, shadows, inputs, lanes, tape)

    def sunlight(self, gaussians: Gaussians, sun: np.ndarray, adaptive: bool = False) -> Sunlight:
        """Visibility, and light that bounces, under one Sun, for any number of pictures. Arguments: see `shadows`."""
        shadows = self.shadows(gaussians, sun, adaptive)
        if shadows is None and not self.config.bounce:
            return Sunlight(None, [])
        lanes = Lanes.of(gaussians.count, still=True)
        _, of_refine = split(self.config, self.weights)
        visibility, bounced = kernels.sunlit(self.config, of_refine, self._inputs(gaussians, None, sun, shadows), lanes)
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
        of_field, _ = split(self.config, self.weights)
        seen = [] if light.visibility is None else [light.visibility]
        shown = kernels.lit(self.config, of_field, inputs, lanes, kept.known, kept.packed, seen, light.bounced)
        return shown[:3], shown[3] if seen else None

    def adjoint(self, shading: Shading, by_colour: list[Any], by_visibility: Any = None) -> "LightGradients":
        """From the gradients of the dimmed colours (3 arrays [N]) and, where visibility is seen on its own, of the
        visibility [N]."""
        more = [] if by_visibility is None else [by_visibility]
        arguments = self.config, self.weights, shading.inputs, shading.lanes, shading.tape, by_colour, more
        by_features, by_weights, by_raw = kernels.adjoint(*arguments)
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
        numbers = np.asarray(tensors["light.frame"], np.float64)
        if numbers.shape != (6,) or not np.isfinite(numbers).all() or numbers[3:].min() <= 0:
            raise ValueError("light.frame: expected a centre and three lengths above 0, found others")
        *centre, scale, distance, radius = numbers.tolist()
        model = LightModel.initial(config, TrainingFrame(np.array(centre), scale, distance, radius), 0)
        for i, like in enumerate(model.weights):
            weight = tensors[f"light.weight.{i:02d}"]
            if np.shape(weight) != (dr.width(like),):
                raise ValueError(f"light.weight.{i:02d}: expected {dr.width(like)} numbers, found {np.shape(weight)}")
            model.weights[i] = uploaded(weight)
        return model

    def _inputs(
        self, gaussians: Gaussians, camera: Projection | None, sun: np.ndarray, shadows: Shadows | None
    ) -> Inputs:
        raw = [shadows.occlusion, *shadows.info] if shadows else []
        turns = gaussians.quaternions, gaussians.log_scales
        logits = gaussians.logit_opacities
        return Inputs(gaussians.features, gaussians.means, turns, logits, camera, raw, self.sun_terms(sun), self._place)

    def _kept_of(self, features: Any, lanes: Lanes) -> _Kept:
        """Made anew where features or weights have changed. Copies hold what was read: a number of Dr.Jit's that is in
        use is never another array's."""
        of_field, _ = split(self.config, self.weights)
        by_vectors = select() in COOPERATIVE and cooperative.usable()
        read = of_field if by_vectors else [features, of_field[1]]
        if [array.index for array in read] != [array.index for array in self._kept.read]:
            self._kept = _Kept([], None, [])  # room for the next
            field = self.config.field
            packed = cooperative.pack(field.shape, of_field) if by_vectors else []
            known = None if by_vectors else kernels.known_layer(field, of_field, features, lanes)
            self._kept = _Kept([ad.Float(array) for array in read], known, packed)
        return self._kept

    def _sun_terms(self, *sun: float) -> SunTerms:
        refine = self.config.refine or self.config.field
        terms = SunTerms(light_rows(sun), self.config.field.sun.of_one(sun), refine.sun.of_one(sun))
        dr.eval(terms)
        return terms
