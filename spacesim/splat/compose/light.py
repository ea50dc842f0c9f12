"""How models that stand in one scene are lit: each as its run has it, in the shadows of the others (thesis 3.2).

Each run's colours, and the shadows that it casts on itself, are computed in its own frame, with camera and Sun brought
into it: harmonics turn with the model, fields and refinement see the directions, places and lengths that they were
trained with. Shadows that other models cast on it (4.15) are computed there, too, and multiply its colours (4.16), but
for light that bounces, which comes from where they leave sunlight.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.geometry import Array, may_shade
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose.members import Ensemble
from spacesim.splat.compose.pose import Pose
from spacesim.splat.light.shadow.cast import CrossShadow, cast_cross_shadows
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Pinhole

MIN_SCALE_SHARE = 0.25  #: least light pixels over a model's extent as a share of the picture's size: half of training's
RATIO_EPSILON = 1e-3  #: epsilon of 4.15, for which the thesis names no number

Light = tuple[list[Float], Float | None]  #: (three colours, visibility or None of a run without shadows), [N] each
T = TypeVar("T")


class SunOccluder(Protocol):
    """What is no Gaussian and stands in the Sun's way."""

    @property
    def key(self) -> bytes:
        """Another one wherever it lets other light through."""

    def sun_visibility(self, points: Array, sun: Sun) -> Array:
        """[N] share of the Sun's light that comes through to points [N, 3] of the world, metres."""


class LightCache:
    """What the last picture has computed and the next may use again, each with what it depends on: where only a model
    moves, the light of the others; where only the camera moves, the shadows."""

    def __init__(self) -> None:
        self._values: dict[Hashable, tuple[Hashable, object]] = {}

    def get(self, name: Hashable, key: Hashable, make: Callable[[], T]) -> T:
        """The value of a name, made anew where the key is not that of the last time."""
        if name not in self._values or self._values[name][0] != key:
            self._values.pop(name, None)  # frees memory for the next
            self._values[name] = key, make()
        return cast("T", self._values[name][1])


@dataclass(frozen=True, eq=False)
class EnsembleLight:
    """Members of an ensemble where they stand, under one Sun."""

    ensemble: Ensemble  #: the members
    poses: Sequence[Pose]  #: one of each
    sun: Array | None  #: [3] towards it, world; None where none is given, and no shadows are asked for
    earth: Earth | None  #: that it lights, world; its light reaches into all shadows of members on each other
    shadows: str  #: of members on each other, as `ComposeConfig.shadows`
    beside: SunOccluder | None  #: what else stands in the Sun's way
    cache: LightCache  #: of this ensemble

    def shade(self, camera: Camera) -> list[Light]:
        """Of each member, in the shadows of the others."""
        between = self.cross_visibilities()
        return [self._lit(k, camera, share) for k, share in enumerate(between)]

    def cross_visibilities(self) -> list[Float | None]:
        """Of each member v_inter of 4.15, Float [N of it], or None where no other can be before the Sun."""
        if self.shadows == "none":
            return [None] * len(self.poses)
        assert self.sun is not None, "a scene with such shadows asks for a Sun first"
        sun = self.sun

        def compute() -> list[Float | None]:
            between = [self._cross_visibility(sun, k) for k in range(len(self.poses))]
            return between if self.beside is None else self._behind(self.beside, sun, between)

        return self.cache.get("between", self._key_between, compute)

    @property
    def _key_between(self) -> Hashable:
        """Of all that `cross_visibilities` depends on."""
        towards = None if self.sun is None else self.sun.tobytes()
        others = b"" if self.beside is None else self.beside.key
        return b"".join(pose.key for pose in self.poses), towards, self.shadows, others

    def _lit(self, k: int, camera: Camera, share: Float | None) -> Light:
        """Of member k behind others that let a share of sunlight through, Float [N of it] or None for all."""
        member, pose = self.ensemble.members[k], self.poses[k]
        near, towards = pose.camera_in_model(camera), None if self.sun is None else pose.direction_in_model(self.sun)
        direction = b"" if towards is None else towards.tobytes()
        earth = pose.earth_in_model(self.earth) if member.run.light else None
        # where sunlight bounces, or the Earth shines, too, colours are no multiple of the share
        inner = share if earth is not None or member.bounces else None
        arrives = direction, None if inner is None else self._key_between
        sunlight = self.cache.get(("sunlight", k), arrives, lambda: self._arriving(k, towards, direction, inner))
        key = near.world_from_camera.tobytes(), arrives, earth
        part = self.cache.get(("light", k), key, lambda: member.shade(Pinhole.of(near), towards, sunlight, earth))
        colors, visibility = _dim(part, share) if inner is None else part
        return colors, visibility if member.run.has_shadows else self._past_earth(share, member.count)

    def _arriving(self, k: int, towards: Array | None, direction: bytes, share: Float | None) -> Sunlight | None:
        """At member k, of a share as `_lit` takes it. towards, direction: the Sun's, in the model's frame"""
        member = self.ensemble.members[k]
        if share is None:
            return member.sunlight(towards)
        own = self.cache.get(("visibility", k), direction, lambda: member.visibility(towards))
        return member.arriving(towards, share if own is None else own * share)

    def _past_earth(self, share: Float | None, count: int) -> Float | None:
        """The share of sunlight that reaches a member without shadows of its own, as `_lit` takes it."""
        left = 1.0 if self.sun is None or self.earth is None else self.earth.visible_sun(self.sun)
        if left == 1:
            return share
        return dr.opaque(ad.Float, left, count) if share is None else share * dr.opaque(ad.Float, left)

    def _cross_visibility(self, sun: Array, k: int) -> Float | None:
        """v_inter of 4.15 for member k, in its own frame: what is seen of the Sun depends neither on where all stands
        nor on how it is turned, and softness, bias and pixels are those of its training."""
        ensemble, members, poses = self.ensemble, self.ensemble.members, self.poses
        spheres = [(pose.points(one.centre), one.radius * pose.scale) for one, pose in zip(members, poses, strict=True)]
        if not any(may_shade(spheres[j], spheres[k], sun) for j in range(len(poses)) if j != k):
            return None
        member, back = members[k], poses[k].inverse()
        scene = ensemble.placed([Pose() if j == k else back.after(pose) for j, pose in enumerate(poses)])
        direction, least = poses[k].direction_in_model(sun), MIN_SCALE_SHARE * member.shadow.size / member.extent

        alone = (member.shadow.between if self.shadows == "trained" else self.shadows) == "others"
        shadow = member.cross_shadow_config if alone else member.shadow

        def seen(casts: Bool) -> Float:
            between = CrossShadow(scene, casts, member.run.gaussians, ensemble.own[k], ensemble.indices[k])
            return 1 - cast_cross_shadows(between, direction, shadow, member.distance, least)

        if alone:
            visible = seen(ensemble.others[k])
        else:
            everything = dr.opaque(ad.Bool, True, ensemble.count)
            visible = dr.clip(seen(everything) / (seen(ensemble.own[k]) + RATIO_EPSILON), 0, 1)  # 4.15
        dr.eval(visible)
        return visible

    def _behind(self, beside: SunOccluder, sun: Array, between: list[Float | None]) -> list[Float | None]:
        """v_inter `between` with what `beside` lets through to the Gaussians' centres: light that comes through both is
        the product, so that the ratio of 4.15 is what the others let through."""
        means = np.array(self.ensemble.placed(self.poses).means, np.float64).T
        seen = beside.sun_visibility(means, Sun(sun))
        result = []
        for member, start, share in zip(self.ensemble.members, self.ensemble.starts, between, strict=True):
            own = upload(seen[start : start + member.count])
            result.append(own if share is None else own * share)
        dr.eval(result)
        return result


def _dim(part: Light, share: Float | None) -> Light:
    """Colours and visibility in the shadows of others (4.16, 4.17). share: v_inter, or None where there are none"""
    colors, visibility = part
    if share is None:
        return part
    return [color * share for color in colors], share if visibility is None else visibility * share
