"""Sun direction in, colours and visibility of the Gaussians out: the appearance field (thesis 4.2) and the shadows
(4.3), and the adjoint of both.

`LightModel.shade` is the forward pass, `LightModel.adjoint` the way back to features and weights. View directions count
as given, and so do shadows, as in the literature.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import drjit as dr
import numpy as np

from spacesim.backend import ad, select
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.last_made import LastMade
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.geometry import Array
from spacesim.learning.networks import network
from spacesim.learning.reflectance import eclipse_numbers
from spacesim.splat.light import cooperative
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading import backward, forward, pictures
from spacesim.splat.light.shading.forward import ShadingTape, split_weights
from spacesim.splat.light.shading.inputs import ShadingInputs
from spacesim.splat.light.shadow.cast import Shadows, cast_shadows
from spacesim.splat.light.shadow.light_camera import SUNS, light_rows
from spacesim.splat.light.sunlight import SunEncoding, Sunlight
from spacesim.splat.light.surroundings import HeldSurroundings, Surfaces, Surroundings, look_around, ray_count
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.capacity import WAITING, PairCounts
from spacesim.splat.raster.lists.pictures import computed

log = logging.getLogger(__name__)
Made = TypeVar("Made")

ANY_SUN = np.array([0.0, 0.0, 1.0])  #: stands for an unknown Sun, in a model that does not take it
MANY_RAYS = 1e7  #: which take seconds on a CPU
GEOMETRY = 11  #: rows of Gaussians that say where they are, how large, how turned and how opaque
COOPERATIVE = ("cuda",)  #: backends on which the field of pictures is computed by `cooperative` where that works


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """Where a model was when it was trained, metres."""

    centre: Array  #: [3], mu_model of 4.12
    scale: float  #: the unit of length of its networks
    distance: float  #: of the farthest training camera from the centre, dist_max of 4.5
    radius: float  #: `robust_radius` of the Gaussians that training started from


@dataclass
class Shading:
    """Colours and visibility of Gaussians, and what their adjoint needs."""

    colors: list[Float]  #: 3 arrays [N], display values that visibility has dimmed (4.17)
    #: Float [N] in [0, 1] as pictures show it, so times `sun_facing`, which colours do without, or None
    visibility: Float | None
    inputs: ShadingInputs  #: what `LightModel.adjoint` wants
    batch: PaddedBatch  #: what `LightModel.adjoint` wants
    tape: ShadingTape  #: what `LightModel.adjoint` wants
    picture: int | None  #: number of the training picture whose embedding the field has read; None: the mean one


@dataclass
class _PictureCache:
    """What pictures of one model have in common."""

    first_layer: network.PartialLayer | None  #: what the field's first layer makes of the features
    packed: cooperative.PackedNetwork | None  #: the field's network for `cooperative`, None where `first_layer` serves
    embedding: list[Float]  #: the mean one, Float [E] in a list, or nothing


@dataclass
class LightGradients:
    """Gradients of a loss by what light depends on."""

    features: Float  #: Float [F * N]
    weights: list[Float]  #: as `LightModel.weights`
    embeddings: list[Float]  #: as `LightModel.embeddings`
    #: of the Sun's direction through the field, Float [3] in a list, shadows as given, or nothing where not asked for
    sun: list[Float]


class LightModel:
    """The networks of a relightable model.

    weights: Floats, the field's and then the refinement's, each as `network.initial_weights` orders them
    frame: of its training
    embeddings: those of all training pictures, Float [V * E], in a list, or nothing where pictures have none
    """

    def __init__(
        self, config: LightConfig, weights: list[Float], frame: TrainingFrame, embeddings: list[Float]
    ) -> None:
        self.config, self.weights, self.frame, self.embeddings = config, weights, frame, embeddings
        self._training_frame = ad.Float([*np.asarray(frame.centre, np.float32), frame.scale])
        self._encodings = lru_cache(maxsize=SUNS)(self._encode_sun)
        self._of_pictures: LastMade[_PictureCache] = LastMade()
        self._around: LastMade[Surroundings] = LastMade()  # light changes more often than Gaussians do
        self._sunlight: LastMade[Sunlight] = LastMade()  # cameras move more often than the Sun does
        self._held: HeldSurroundings | None = None
        self._told = False  # that rays take long in training

    @staticmethod
    def initial(config: LightConfig, frame: TrainingFrame, seed: int, pictures: int = 0) -> "LightModel":
        """Fresh networks; the last layer of a refinement that corrects raw shadows starts at 0, so that these are where
        training starts, and so do the embeddings of `pictures` training pictures."""
        rng = np.random.default_rng([seed, 4])
        weights = network.initial_weights(config.field.shape, rng)
        if config.refine:
            weights += network.initial_weights(config.refine.shape, rng, last=0.0 if config.refine.residual else 1.0)
        numbers = pictures * config.field.embeddings
        embeddings = [upload(np.zeros(numbers))] if config.field.embeddings else []
        return LightModel(config, [upload(weight) for weight in weights], frame, embeddings)

    def encode_sun(self, sun: np.ndarray | None, earth: Earth | None = None) -> SunEncoding:
        """What kernels read of a Sun in the direction `sun` [3], unit, world axes; None: the field does not take it.
        earth: that it lights, if there is one, and that may hide it; light of it has a model that has learned it"""
        earth = earth if self.config.field.knows_sun and sun is not None else None
        terms: SunEncoding = self._encodings(earth, *(float(value) for value in (ANY_SUN if sun is None else sun)))
        return terms

    def shadows(self, gaussians: Gaussians, sun: np.ndarray | None, pairs: PairCounts = WAITING) -> Shadows | None:
        """Raw occlusion of each Gaussian, by one light camera in training and in pictures: the refinement corrects what
        it was trained on. None for a model without shadows. pairs: of the Sun's picture"""
        config = self.config.shadow
        if config is None:
            return None
        assert sun is not None, "shadows need the Sun"
        return cast_shadows(gaussians, light_rows(sun), config, self.frame.distance, pairs)

    def shade(
        self,
        gaussians: Gaussians,
        camera: Projection,
        sun: np.ndarray | None,
        picture: int | None = None,
        pairs: PairCounts = WAITING,
        earth: Earth | None = None,
        batch: PaddedBatch | None = None,
    ) -> Shading:
        """Colours of the Gaussians seen from `camera` with the Sun in the direction `sun` [3], unit, world axes; None:
        the field does not take it. picture: number of the training picture whose embedding the field reads; None: it
        reads the mean one. pairs: of the Sun's picture;  earth: see `encode_sun`;  batch: of the Gaussians that are
        lit, others are black and in shadow; None: all"""
        shadows = self.shadows(gaussians, sun, pairs)
        embedding = self._mean_embedding() if picture is None else self._embedding(picture)
        terms = self._with_embedding(self.encode_sun(sun, earth), embedding)
        inputs = self._inputs(gaussians, camera, terms, shadows, self.surroundings(gaussians))
        batch = batch or PaddedBatch.of(gaussians.count)
        colors, visibility, tape = forward.shade(self.config, self.weights, inputs, batch)
        return Shading(colors, visibility[0] if visibility else None, inputs, batch, tape, picture)

    def surroundings(self, gaussians: Gaussians) -> Surroundings | None:
        """What these see around them, or saw at the last `hold_surroundings`; None for a model without a bounce."""
        if not self.config.bounce or gaussians.count == 0:
            return None
        if self._held:
            if not self._told:
                self._told = self._tell_of_rays(gaussians.count, "now and then in training")
            return self._held.surroundings(self.config.bounce, self.frame.radius, gaussians.count)
        read = [*gaussians.rows()[:GEOMETRY], _features(gaussians)]
        around = self._around.find(read)
        if around is None:
            self._tell_of_rays(gaussians.count, "once for all pictures")
            surfaces = Surfaces.of(gaussians, self.config.field.features)
            around = look_around(surfaces, self.config.bounce, self.frame.radius)
            self._around.keep(around, read)
        return around

    def _tell_of_rays(self, count: int, when: str) -> bool:
        """Of so many Gaussians, where they take long. Returns whether they do."""
        rays = count * ray_count(self.config.bounce)
        takes_long = select() == "llvm" and rays > MANY_RAYS
        if takes_long:
            log.info("light that bounces: %.0f million rays are traced, %s", rays / 1e6, when)
        return takes_long

    def hold_surroundings(self, of: Gaussians | HeldSurroundings) -> None:
        """In training Gaussians move in each step, and come and go (`follow`): light bounces as if they stood where
        these do, or those of a checkpoint, until this is called again."""
        if isinstance(of, Gaussians):
            of = HeldSurroundings(Surfaces.of(of, self.config.field.features))
        self._held = of
        self._around.forget()
        self._sunlight.forget()  # its emitters have other numbers

    def follow(self, source: UInt32) -> None:
        """Each Gaussian was `source` [N] of those before: it sees what that one saw."""
        if self._held:
            self._held.follow(source)
            self._sunlight.forget()

    @property
    def held_surroundings(self) -> HeldSurroundings | None:
        """Of the last `hold_surroundings`."""
        return self._held

    def sunlight(self, gaussians: Gaussians, sun: np.ndarray | None, embedding: np.ndarray | None = None) -> Sunlight:
        """Visibility, and light that bounces, under one Sun, for any number of pictures; at once where it was asked for
        last and nothing has changed. embedding: as `shade_picture` takes it"""
        return self._with_sunlight(gaussians, sun, embedding, lambda light: light)

    def _with_sunlight(
        self,
        gaussians: Gaussians,
        sun: np.ndarray | None,
        embedding: np.ndarray | None,
        use: Callable[[Sunlight], Made],
    ) -> Made:
        """What `use` makes of the light of `sunlight`."""
        if self.config.shadow is None and not self.config.bounce:
            return use(Sunlight(None, []))
        read = [*gaussians.rows(), *self.weights, *self.embeddings]
        asked = tuple(None if numbers is None else np.asarray(numbers).tobytes() for numbers in (sun, embedding))
        changes = dr.grad_enabled(read)
        last = None if changes else self._sunlight.find(read, asked)
        if last is not None:
            return use(last)

        def under_sun(pairs: PairCounts) -> tuple[Sunlight, Made]:
            light = self.arriving(gaussians, sun, self._visibility(gaussians, sun, pairs), embedding)
            return light, use(light)

        light, made = computed(under_sun)
        if not changes:
            self._sunlight.keep(light, read, asked)
        return made

    def visibility(self, gaussians: Gaussians, sun: np.ndarray | None) -> Float | None:
        """Of `sunlight`, without what bounces."""
        return computed(lambda pairs: self._visibility(gaussians, sun, pairs))

    def _visibility(self, gaussians: Gaussians, sun: np.ndarray | None, pairs: PairCounts) -> Float | None:
        shadows = self.shadows(gaussians, sun, pairs)
        if shadows is None:
            return None
        inputs = self._inputs(gaussians, None, self.encode_sun(sun), shadows, None)
        batch = PaddedBatch.of(gaussians.count, still=True)
        return pictures.refined_visibility(self.config, self.weights, inputs, batch)

    def arriving(
        self,
        gaussians: Gaussians,
        sun: np.ndarray | None,
        visibility: Float | None,
        embedding: np.ndarray | None = None,
    ) -> Sunlight:
        """`sunlight` of which so much arrives at each Gaussian, Float [N], None for all: what others shade scatters
        none, too."""
        if not self.config.bounce:
            return Sunlight(visibility, [])
        of_picture = self._mean_embedding() if embedding is None else [upload(np.asarray(embedding, np.float64))]
        terms = self._with_embedding(self.encode_sun(sun), of_picture)
        inputs = self._inputs(gaussians, None, terms, None, self.surroundings(gaussians))
        batch = PaddedBatch.of(gaussians.count, still=True)
        shares = [] if visibility is None else [visibility]
        return Sunlight(visibility, *pictures.scatter_sunlight(self.config, self.weights, inputs, batch, shares))

    def shade_picture(
        self,
        gaussians: Gaussians,
        camera: Projection,
        sun: np.ndarray | None,
        sunlight: Sunlight | None = None,
        embedding: np.ndarray | None = None,
        earth: Earth | None = None,
    ) -> tuple[list[Float], Float | None]:
        """(colours, visibility) of `shade`, for a picture: nothing is left for an adjoint. sunlight: of this Sun, of
        `sunlight` or `arriving`;  embedding: [E] of the picture, None: the mean one;  earth: see `encode_sun`. What
        the field's first layer makes of the features does not change with Sun or camera and stays for the next
        picture: as many numbers for each Gaussian as the layer has units."""

        def shown(light: Sunlight) -> tuple[list[Float], Float | None]:
            return self._shown(gaussians, camera, sun, light, embedding, earth)

        return self._with_sunlight(gaussians, sun, embedding, shown) if sunlight is None else shown(sunlight)

    def _shown(
        self,
        gaussians: Gaussians,
        camera: Projection,
        sun: np.ndarray | None,
        light: Sunlight,
        embedding: np.ndarray | None,
        earth: Earth | None,
    ) -> tuple[list[Float], Float | None]:
        """`shade_picture` by this light."""
        of_any_size = replace(camera, width=1, height=1)  # directions do not depend on it: one recording for all sizes
        batch = PaddedBatch.of(gaussians.count, still=True)
        cache = self._picture_cache(_features(gaussians), batch)
        of_picture = cache.embedding if embedding is None else [upload(np.asarray(embedding, np.float64))]
        terms = self._with_embedding(self.encode_sun(sun, earth), of_picture)
        around = self.surroundings(gaussians) if light.emitted else None  # what is not read is not traced
        inputs = self._inputs(gaussians, of_any_size, terms, None, around)
        of_field, _ = split_weights(self.config, self.weights)
        shown = pictures.shade_picture(self.config, of_field, inputs, batch, cache.first_layer, cache.packed, light)
        return shown[:3], None if light.visibility is None else shown[3]

    def adjoint(
        self, shading: Shading, grad_color: list[Float], grad_visibility: Float | None = None, by_sun: bool = False
    ) -> "LightGradients":
        """From the gradients of the dimmed colours (3 arrays [N]) and, where visibility is seen on its own, of the
        visibility [N]. by_sun: also the gradient of the Sun's direction"""
        grad_visibilities = [] if grad_visibility is None else [grad_visibility]
        grad_features, grad_weights, by_encoding, grad_sun = backward.adjoint(
            self.config,
            self.weights,
            shading.inputs,
            shading.batch,
            shading.tape,
            grad_color,
            grad_visibilities,
            by_sun,
        )
        by_embeddings = [self._embedding_gradient(gradient, shading.picture) for gradient in by_encoding]
        return LightGradients(grad_features, grad_weights, by_embeddings, grad_sun)

    def tensors(self) -> dict[str, np.ndarray]:
        """For a file: the weights, the embeddings [V, E] where pictures have some, and the training frame."""
        weights = {f"light.weight.{i:02d}": np.array(weight) for i, weight in enumerate(self.weights)}
        if self.embeddings:
            weights["light.embeddings"] = np.array(self.embeddings[0]).reshape(-1, self.config.field.embeddings)
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
            model.weights[i] = upload(weight)
        if size := config.field.embeddings:
            embeddings = tensors["light.embeddings"]
            if embeddings.ndim != 2 or embeddings.shape[1] != size or not len(embeddings):
                raise ValueError(f"light.embeddings: expected {size} numbers a picture, found {embeddings.shape}")
            model.embeddings = [upload(embeddings)]
        return model

    @staticmethod
    def _with_embedding(terms: SunEncoding, embedding: list[Float]) -> SunEncoding:
        """`encode_sun` with an embedding in a list, or nothing."""
        if not embedding:
            return terms
        with_embedding = dr.concat([terms.field_encoding, *embedding])
        return replace(terms, field_encoding=with_embedding, refine_encoding=[terms.of_refinement])

    def _embedding(self, picture: int) -> list[Float]:
        """Float [E] of a training picture in a list, or nothing."""
        return [dr.gather(ad.Float, every, self._embedding_index(picture)) for every in self.embeddings]

    def _mean_embedding(self) -> list[Float]:
        """Float [E] in a list, or nothing."""
        size = self.config.field.embeddings
        return [upload(np.array(every, np.float64).reshape(-1, size).mean(axis=0)) for every in self.embeddings]

    def _embedding_gradient(self, by_encoding: Float, picture: int | None) -> Float:
        """Float [V * E], 0 but where the picture's embedding stands. by_encoding: gradient of the field's encoding"""
        assert picture is not None, "the mean embedding is not trained"
        size, first = self.config.field.embeddings, self.config.field.sun.size
        gradient = dr.zeros(ad.Float, dr.width(self.embeddings[0]))
        own = dr.gather(ad.Float, by_encoding, first + dr.arange(ad.UInt32, size))
        dr.scatter(gradient, own, self._embedding_index(picture))
        return gradient

    def _embedding_index(self, picture: int) -> UInt32:
        """UInt32 [E]; its number is no constant of a kernel: others compile nothing."""
        size = self.config.field.embeddings
        return dr.opaque(ad.UInt32, picture * size) + dr.arange(ad.UInt32, size)

    def _inputs(
        self,
        gaussians: Gaussians,
        camera: Projection | None,
        sun: SunEncoding,
        shadows: Shadows | None,
        surroundings: Surroundings | None,
    ) -> ShadingInputs:
        raw_shadows = [shadows.occlusion, *shadows.info] if shadows else []
        rotations_and_scales = gaussians.quaternions, gaussians.log_scales
        logits = gaussians.logit_opacities
        return ShadingInputs(
            _features(gaussians),
            gaussians.means,
            rotations_and_scales,
            logits,
            camera,
            raw_shadows,
            sun,
            self._training_frame,
            surroundings,
        )

    def _picture_cache(self, features: Float, batch: PaddedBatch) -> _PictureCache:
        """Made anew where features or weights have changed."""
        of_field, _ = split_weights(self.config, self.weights)
        is_cooperative = select() in COOPERATIVE and cooperative.is_usable()
        read = [*(of_field if is_cooperative else [features, of_field[1]]), *self.embeddings]
        cache = self._of_pictures.find(read)
        if cache is None:
            field = self.config.field
            packed = cooperative.pack(field.shape, of_field) if is_cooperative else None
            first_layer = None if is_cooperative else pictures.first_layer_of_features(field, of_field, features, batch)
            cache = _PictureCache(first_layer, packed, self._mean_embedding())
            self._of_pictures.keep(cache, read)
        return cache

    def _encode_sun(self, earth: Earth | None, *sun: float) -> SunEncoding:
        field, refine = self.config.field, self.config.refine
        beams, eclipse = [], []
        if earth and earth.albedo > 0 and self.config.earth:
            beams = [upload(earth.beams(np.array(sun)))]
        if earth and (share := earth.visible_sun(np.array(sun))) < 1:
            eclipse = [upload(eclipse_numbers(share, self.config.linear))]
        of_refinement = [refine.sun.of_one(sun)] if refine and refine.sun != field.sun else []
        return SunEncoding(light_rows(sun), field.sun.of_one(sun), of_refinement, beams, eclipse)


def _features(gaussians: Gaussians) -> Float:
    """Float [F * N], which Gaussians of a model of light have."""
    assert gaussians.features is not None, "a model of light reads features"
    return gaussians.features
