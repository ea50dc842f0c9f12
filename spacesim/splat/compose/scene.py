"""Trained runs in one scene: each posed, all drawn as one set of Gaussians under one Sun (thesis 3.2, algorithm 2).

`light` says how each is lit; then its Gaussians go to the world (3.11 to 3.13).
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images.tone import Curve
from spacesim.data.records import Camera, Sun
from spacesim.learning.prediction import ComposedPrediction, MaterialView, check_picture
from spacesim.splat.compose.light import EnsembleLight, LightCache, SunOccluder
from spacesim.splat.compose.members import Ensemble, Member, display_colors
from spacesim.splat.compose.pose import Pose
from spacesim.splat.light.material import FittedMaterial
from spacesim.splat.material import draw_material, no_material
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.output import RenderOutput, over_alpha, planes_image
from spacesim.splat.raster.render import render
from spacesim.splat.raster.supersample import render_supersampled
from spacesim.splat.raster.tone import adjust_exposure
from spacesim.splat.run import Run, display_light, stops

OUTPUTS = ("rgb", "alpha", "depth", "median_depth", "normal", "visibility", "id")
SHADOWS = ("trained", "others", "ratio", "none")
COVERED = 0.5  #: alpha from which on a pixel shows an object

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PlacedRun:
    """A run and where it stands."""

    run: Run  #: the trained model
    pose: Pose = field(default_factory=Pose)  #: of the model in the world
    name: str = ""  #: for messages and files


@dataclass(frozen=True)
class ComposeConfig:
    """How models of a scene are drawn together."""

    #: of models on each other. "others": from the other models alone, which is what 4.15 estimates. "ratio": 4.15
    #: itself, light from all over light from the model's own Gaussians; where a model's raw shadow of itself is wrongly
    #: dark, the ratio says nothing, and what refinement has mended is dark again. "trained": the one of these that the
    #: run of the model in the shadow was configured with (`ShadowConfig.between`). "none": no such shadows.
    shadows: str = "trained"

    def __post_init__(self) -> None:
        if self.shadows not in SHADOWS:
            raise InputError(f"shadows: expected one of {', '.join(SHADOWS)}, found {self.shadows!r}")


@dataclass
class DrawnView:
    """A view on the device."""

    #: alpha, depth, ... and `features`, of which `planes` says what they are: "rgb" (3, premultiplied, linear where
    #: there is a `curve`), "visibility" (1, premultiplied), "id" (one a model, in the order of `order`)
    output: RenderOutput
    planes: dict[str, list[Float]]  #: the features by what they are, as above
    order: list[int]  #: which model each plane of "id" is of
    curve: Curve | None  #: how linear colours are shown; None where they are sRGB values

    def light(self, stops: float = 0.0) -> np.ndarray | None:
        """See `Prediction.linear`. stops: as of `image`"""
        if self.curve is None or "rgb" not in self.planes:
            return None
        return display_light(self._rgb, self.curve, stops)

    @cached_property
    def _rgb(self) -> np.ndarray:
        """[H, W, 3] as blended, read back once."""
        return planes_image(self.planes["rgb"], self.output.width, self.output.height)

    def image(self, name: str, stops: float = 0.0) -> np.ndarray:
        """One of `OUTPUTS` that was asked for: rgb [H, W, 3] sRGB values over black, normal [H, W, 3], others [H, W];
        float32, id int32. stops: EV by which linear colours are exposed more than in training. Raises ValueError for
        what was not asked for."""
        if name not in ("rgb", "visibility", "id"):
            return self.output.image(name)
        if name not in self.planes:
            raise ValueError(f"name: expected one of the outputs asked for, found {name!r}")
        size, planes = (self.output.width, self.output.height), self.planes[name]
        if name == "rgb":
            return adjust_exposure(self._rgb, self.curve.tone, stops, self.curve.white) if self.curve else self._rgb
        if name == "visibility":
            return planes_image([over_alpha(planes[0], self.output.alpha)], *size)[..., 0]
        if not planes:
            return np.zeros(size[::-1], np.int32)
        numbers = np.array(self.order, np.int32) + 1
        shares = planes_image(planes, *size)
        return np.where(self.output.image("alpha") >= COVERED, numbers[np.argmax(shares, axis=-1)], 0)


@dataclass(frozen=True, eq=False)
class LitGaussians:
    """All Gaussians of a scene in the world, in the order of `GaussianComposition.placed`, as a camera sees them
    lit."""

    gaussians: Gaussians  #: colours left out
    colors: list[Float]  #: three [N], sRGB display values
    visibility: Float | None  #: [N] share of the Sun that each sees; None of a scene without shadows
    shares: list[Float]  #: [N] of each model: 1 for its Gaussians, else 0


class GaussianComposition:
    """Posed models under one Sun. What does not change with poses, Sun and camera is kept, also by what `moved` makes.

    models: at least one
    config: how they shade each other

    The same models in another order give the same picture to the bit, `id` apart. One model with no pose gives what its
    run gives alone, to the bit.
    """

    def __init__(
        self, models: Sequence[PlacedRun], config: ComposeConfig | None = None, path: Path | None = None
    ) -> None:
        if not models:
            raise InputError("models: expected at least one, found none")
        self.models, self.config, self.path = tuple(models), config or ComposeConfig(), path
        members: dict[int, Member] = {id(model.run): Member.of(model.run) for model in self.models}
        self._members = [members[id(model.run)] for model in self.models]
        self._ensemble = Ensemble(sorted((m for m in self._members if m.count), key=lambda member: member.key))
        self._cache = LightCache()
        self._beside: SunOccluder | None = None
        _log_choices(self.models, self._ensemble)

    # ---- what a run is asked for, too ----

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians."""
        return self._ensemble.count

    @property
    def model_bytes(self) -> int:
        """Size of the models' files, each counted once."""
        return sum(run.model_bytes for run in {id(model.run): model.run for model in self.models}.values())

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self._shades or any(model.run.relightable for model in self.models)

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return any(model.run.knows_earth for model in self.models)

    @property
    def curve(self) -> Curve | None:
        """How its linear colours are shown; None where not all models are linear, of one curve and exposure."""
        return self._ensemble.curve

    def stops(self, exposure: float | None) -> float:
        """By how many EV pictures are exposed more than those of training. exposure: EV, or None for theirs. Raises
        InputError where not all models are linear, of one tone curve and exposure, and for no such exposure."""
        curve = self.curve
        if exposure is not None and curve is None and any(member.curve for member in self._ensemble.members):
            raise InputError("exposure: expected models of one tone curve and exposure, found several")
        return stops(curve, exposure, str(self.path or self.models[0].run.path))

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> ComposedPrediction:
        """Render one view. exposure: see `stops`. Raises InputError where the Sun matters and none is given."""
        stops = self.stops(exposure)
        check_picture(camera)
        names = [name for name in OUTPUTS if name not in ("median_depth", "normal")]
        drawn = self.draw(camera, sun, [*names, *(("normal",) if normals else ())])
        visibility = drawn.image("visibility") if "visibility" in drawn.planes else None
        normal = drawn.image("normal") if normals else None
        rgb = drawn.image("rgb", stops)
        alpha, depth = drawn.image("alpha"), drawn.image("depth")
        seen = ComposedPrediction(rgb, alpha, depth, visibility, normal, drawn.image("id"), linear=drawn.light(stops))
        return replace(seen, tone=drawn.curve.tone) if drawn.curve else seen

    def draw_material(self, camera: Camera) -> MaterialView:
        """What one view shows of the models' materials. Raises InputError where one has none."""
        placed = self.placed
        if not placed:
            raise no_material(self.path or self.models[0].run.path, "no Gaussians")
        material = FittedMaterial.joined([model.run.material for model in placed])
        normals = np.concatenate([model.run.learned_normals @ model.pose.rotation.T for model in placed])
        return draw_material(self.in_world(), material, normals, camera, self.antialiased, self.supersample)

    @property
    def antialiased(self) -> Bool | bool:
        """Whether Gaussians are drawn with the anti-aliasing filter: one for all, or Bool [N] where runs differ."""
        return self._ensemble.antialiased

    @property
    def supersample(self) -> int:
        """Places on a side of each pixel of what is predicted: the most that a model was trained with."""
        return max(model.run.supersample for model in self.models)

    @property
    def has_shadows(self) -> bool:
        """Whether there is anything that casts them: one model on another, or on itself."""
        return self._shades or any(member.run.has_shadows for member in self._members)

    @property
    def contents(self) -> list[str]:
        """A digest of what each model is made of, in their order."""
        return [member.key for member in self._members]

    # ---- scenes ----

    def moved(self, index: int, pose: Pose) -> "GaussianComposition":
        """The scene with model `index` at another pose. Cheap: all that was loaded and computed of models is shared."""
        models = list(self.models)
        models[index] = replace(models[index], pose=pose)
        return self.posed([model.pose for model in models])

    def posed(self, poses: Sequence[Pose]) -> "GaussianComposition":
        """The scene with these poses, one of each model."""
        other: GaussianComposition = object.__new__(GaussianComposition)
        other.models = tuple(replace(m, pose=pose) for m, pose in zip(self.models, poses, strict=True))
        other.config, other.path = self.config, self.path
        other._members, other._ensemble, other._cache = self._members, self._ensemble, self._cache
        other._beside = self._beside
        return other

    def shaded(self, config: ComposeConfig) -> "GaussianComposition":
        """The scene with other shadows between its models."""
        other = self.posed([model.pose for model in self.models])
        other.config, other._cache = config, LightCache()
        return other

    def shaded_by(self, beside: SunOccluder) -> "GaussianComposition":
        """The scene in the shadow of something else, too."""
        other = self.posed([model.pose for model in self.models])
        other._beside = beside
        return other

    @property
    def places(self) -> list[Array]:
        """Where the middle of each model is, world, [3] metres."""
        return [placed.pose.points(m.centre) for placed, m in zip(self.models, self._members, strict=True)]

    @property
    def spheres(self) -> list[tuple[Array, float]]:
        """(centre [3], radius) of each model, metres, world: around its Gaussians to three standard deviations."""
        reaches = [model.pose.scale * m.radius for model, m in zip(self.models, self._members, strict=True)]
        return list(zip(self.places, reaches, strict=True))

    @property
    def placed(self) -> list[PlacedRun]:
        """The models that have Gaussians, in the order in which these stand in the set."""
        return [self.models[i] for i in self._order()]

    def in_world(self) -> Gaussians:
        """All Gaussians, colours left out, in the order of `placed`."""
        return self._ensemble.placed([model.pose for model in self.placed])

    def alone(self, index: int) -> Gaussians:
        """Model `index` where it stands, colours left out."""
        return Ensemble([self._members[index]]).placed([self.models[index].pose])

    def cross_visibility(self, sun: Sun | None) -> list[Float | None]:
        """Of each model, in the order of `placed`, the share of sunlight that the others let through, v_inter of 4.15:
        Float [N of it], or None where no other can be before the Sun."""
        return self._light([model.pose for model in self.placed], sun).cross_visibilities()

    def draw(
        self, camera: Camera, sun: Sun | None, outputs: Sequence[str] = ("rgb",), supersample: int | None = None
    ) -> DrawnView:
        """A view on the device: of `OUTPUTS` those asked for, and alpha. Visibility is left out where no model knows
        any. supersample: places on a side of each pixel, by default as many as the models were trained with. Raises
        ValueError for another output, InputError where the Sun matters and none is given."""
        unknown = [name for name in outputs if name not in OUTPUTS]
        if unknown:
            raise ValueError(f"outputs: expected some of {', '.join(OUTPUTS)}, found {unknown[0]!r}")
        poses = [model.pose for model in self.placed]
        planes: dict[str, list[Float]] = {}
        if "rgb" in outputs or "visibility" in outputs:
            colors, visibility = self._shade_members(poses, camera, sun)
            if "rgb" in outputs:
                planes["rgb"] = colors
            if "visibility" in outputs and visibility is not None:
                planes["visibility"] = [visibility]
        if "id" in outputs:
            planes["id"] = self._ensemble.shares
        names = [name for name in outputs if name in ("depth", "median_depth", "normal")]
        features = [plane for group in planes.values() for plane in group]
        ensemble, times = self._ensemble, self.supersample if supersample is None else supersample
        plain = partial(
            render,
            ensemble.placed(poses),
            outputs=("alpha", *names),
            features=features,
            antialiased=ensemble.antialiased,
        )
        linear = ensemble.curve is not None
        output = render_supersampled(plain, camera, times, len(planes.get("rgb", [])), linear)
        drawn = iter(output.features or [])
        images = {name: [next(drawn) for _ in group] for name, group in planes.items()}
        return DrawnView(output, images, self._order(), ensemble.curve)

    def lit_gaussians(self, camera: Camera, sun: Sun | None) -> tuple[Gaussians, list[Float]]:
        """(the set in the world, its colours seen from the camera: three Floats [N], sRGB display values), to draw it
        in another way. Raises InputError where the Sun matters and none is given."""
        lit = self.lit(camera, sun)
        return lit.gaussians, lit.colors

    def lit(self, camera: Camera, sun: Sun | None) -> LitGaussians:
        """`lit_gaussians` with visibility and shares of models."""
        poses = [model.pose for model in self.placed]
        colors, visibility = self._shade_members(poses, camera, sun)
        shown = display_colors(colors, self._ensemble.curve, None)
        return LitGaussians(self._ensemble.placed(poses), shown, visibility, self._ensemble.shares if poses else [])

    # ---- light ----

    @property
    def _shades(self) -> bool:
        """Whether models may shade each other."""
        return (len(self.models) > 1 or self._beside is not None) and self.config.shadows != "none"

    def _order(self) -> list[int]:
        """Which model is each member of the ensemble; models of one run stand in the order of their poses."""
        drawn = [i for i, member in enumerate(self._members) if member.count]
        return sorted(drawn, key=lambda i: (self._members[i].key, self.models[i].pose.key))

    def _shade_members(
        self, poses: Sequence[Pose], camera: Camera, sun: Sun | None
    ) -> tuple[list[Float], Float | None]:
        """(colours as blended, three Floats [N], visibility Float [N] or None)."""
        if sun is None and self.relightable:
            source = self.path or self.models[0].run.path
            raise InputError(f"{source}: expected the Sun's direction for a scene that it changes, found none")
        if not poses:
            return [ad.Float([]) for _ in range(3)], ad.Float([]) if self.has_shadows else None
        members, scene_curve = self._ensemble.members, self._ensemble.curve
        parts = self._light(poses, sun).shade(camera)
        pairs = zip(parts, members, strict=True)
        colors = [display_colors(part[0], member.curve, scene_curve) for part, member in pairs]
        joined = self._ensemble.joined(colors)
        if not self.has_shadows:
            return joined, None
        seen = [
            dr.opaque(ad.Float, 1, member.count) if part[1] is None else part[1]
            for member, part in zip(members, parts, strict=True)
        ]
        return joined, self._ensemble.joined([[plane] for plane in seen])[0]

    def _light(self, poses: Sequence[Pose], sun: Sun | None) -> EnsembleLight:
        direction, earth = (None, None) if sun is None else (sun.direction, sun.earth)
        shadows = self.config.shadows if self._shades else "none"
        return EnsembleLight(self._ensemble, poses, direction, earth, shadows, self._beside, self._cache)


def _log_choices(models: Sequence[PlacedRun], ensemble: Ensemble) -> None:
    """One sentence about each choice that the models leave open."""
    fixed = [model.name or str(model.run.path) for model in models if not model.run.relightable]
    if fixed:
        names = ", ".join(dict.fromkeys(fixed))
        log.info("%s: knows the light that it was trained under only and cannot be relit", names)
    if len({member.curve for member in ensemble.members}) > 1:
        log.info("colours in linear light stand beside others or sRGB values: all are blended as sRGB values")
