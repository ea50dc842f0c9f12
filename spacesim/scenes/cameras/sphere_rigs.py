"""Cameras all around the target: on lattices and an arc, and random poses."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from spacesim.data.errors import InputError, expect
from spacesim.data.geometry import Array, fibonacci_sphere, look_at, normalize, perpendicular, rotation_from_quaternion
from spacesim.data.records import Sun
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.rig import (
    PlannedView,
    RigConfig,
    Stream,
    TargetSphere,
    Views,
    check_phases,
    expect_metres,
    fitting_distance,
    intermediate_steps,
    seed_of,
)

FAR = 4.0
"""Farthest depth of random poses over the nearest where none is given (SPEED+ reaches 10 m, thesis 6.3.2)."""

SUN_MARGIN = math.radians(0.6)
"""Between the Earth's limb and the centre of Suns that it shall not hide: two of the Sun's radii at 1 au."""

TRIES = 1000
"""Poses that are drawn for one whose Sun the Earth does not hide."""


class _LatticeRig(RigConfig):
    """Cameras on a Fibonacci lattice, turned at random for each Sun, so that no two sets coincide."""

    distance: float | None  #: metres; None: it just fits into the image

    def __post_init__(self) -> None:
        super().__post_init__()
        expect_metres(distance=self.distance)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        metres = self.distance or fitting_distance(target.radius, camera)

        def around(sun: Sun, count: int, stream: Stream) -> list[PlannedView]:
            return [
                PlannedView(camera.at(look_at(target.centre + metres * direction, target.centre)), sun)
                for direction in fibonacci_sphere(count, seed=seed_of(seed, *stream))
            ]

        return self.all_views(self.sun_directions(seed), around)


@dataclass(frozen=True)
class FibonacciRig(_LatticeRig):
    """Cameras all around, that look at the target. One Sun alone stands at SINGLE_SUN, several on a Fibonacci lattice
    (thesis 4.3.6)."""

    distance: float | None = None  #: metres from the target's centre; None: it just fits into the image


@dataclass(frozen=True)
class PolarArcRig(_LatticeRig):
    """Cameras all around, Suns on an arc over the pole (+z), as of the thesis's Hubble dataset (6.2.2).

    Suns stand in the middles of as many equal pieces of the arc; test Suns stand on it halfway between them.
    """

    suns: int = 24
    views: int = 614
    arc_azimuth_deg: float = 0.0  #: of the side from which the Suns rise
    arc_deg: float = 180.0  #: its length, the pole its middle: 180 from horizon to horizon, 360 a whole circle
    distance: float | None = None  #: metres from the target's centre; None: it just fits into the image

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(math.isfinite(self.arc_azimuth_deg), "arc_azimuth_deg", "a finite angle", self.arc_azimuth_deg)
        expect(0 < self.arc_deg <= 360, "arc_deg", "an angle above 0, up to 360 degrees", self.arc_deg)

    def sun_directions(self, seed: int) -> tuple[list[Sun], list[Sun]]:
        if self.sun:
            return super().sun_directions(seed)
        closed = self.suns == 1 or self.arc_deg == 360
        suns = [self._sun(step) for step in range(self.suns)]
        return suns, [self._sun(float(step)) for step in intermediate_steps(self.suns, self.test_suns, closed)] or suns

    def _sun(self, step: float) -> Sun:
        angle = math.radians(self.arc_deg) * ((step + 0.5) / self.suns % 1 - 0.5)  # from the pole
        azimuth = math.radians(self.arc_azimuth_deg)
        across = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        return Sun(-math.sin(angle) * across + math.cos(angle) * np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class RandomRig(RigConfig):
    """Random poses, as pose-estimation datasets have them (SPEED+: Park et al. 2022): every attitude is as likely,
    and the target stands anywhere in the image."""

    #: depth of the target's centre along the optical axis, metres; None: near is where the target just fits into the
    #: image, far is FAR times that
    near: float | None = None
    far: float | None = None  #: as `near`
    #: metres, depths follow a normal law of this width about near, cut at near and far; None: all are as likely
    sigma: float | None = None
    #: the target's centre may be anywhere in the image, which may cut parts off; else all of its bounding sphere is in
    #: the image
    cropped: bool = False
    random_suns: bool = False  #: every frame has its own Sun, from anywhere
    #: least and greatest angle between Sun and camera as the target sees them; none: any. At 180 the Sun stands behind
    #: the target, and nothing that is seen is lit. With either, random Suns keep clear of the Earth's disc, too
    min_phase_deg: float | None = None
    max_phase_deg: float | None = None  #: as `min_phase_deg`

    def __post_init__(self) -> None:
        super().__post_init__()
        expect_metres(near=self.near, far=self.far, sigma=self.sigma)
        if self.near is not None and self.far is not None:
            expect(self.near <= self.far, "far", f"at least near, {self.near:g} m", self.far)
        check_phases(self.min_phase_deg, self.max_phase_deg)
        expect(not (self.random_suns and self.sun), "random_suns", "false where sun names the Suns", True)
        if self.random_suns and (self.suns, self.test_suns) != (1, 0):
            suns = f"{self.suns} suns and {self.test_suns} test_suns"
            raise InputError(f"random_suns: expected 1 suns and 0 test_suns, as every frame has its own, found {suns}")

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        near = self.near or min(fitting_distance(target.radius, camera), self.far or math.inf)
        far = self.far or FAR * near
        limited = (self.min_phase_deg, self.max_phase_deg) != (None, None)

        def some(sun: Sun, count: int, stream: Stream) -> list[PlannedView]:
            views = []
            for k in range(count):
                random = np.random.default_rng([seed, *stream, k])
                for _ in range(TRIES):
                    pose = self._pose(random, target, camera, (near, far))
                    view_sun = self._random_sun(random, pose, target) if self.random_suns else sun
                    if view_sun is not None:
                        break
                else:
                    expected = "phase angles at which the Earth does not hide the Sun"
                    raise InputError(f"max_phase_deg: expected {expected}, found none of some {TRIES} poses")
                if limited and not self.random_suns:
                    pose = self._turn_about_sun(random, pose, view_sun, target)
                views.append(PlannedView(camera.at(pose), view_sun))
            return views

        return self.all_views(self.sun_directions(seed), some)

    @property
    def _phase_cosines(self) -> tuple[float, float]:
        """Least and greatest cosine of the phase angle."""
        least = -1.0 if self.max_phase_deg is None else math.cos(math.radians(self.max_phase_deg))
        return least, 1.0 if self.min_phase_deg is None else math.cos(math.radians(self.min_phase_deg))

    def _random_sun(self, random: np.random.Generator, pose: Array, target: TargetSphere) -> Sun | None:
        """The first of Suns drawn from anywhere whose phase angle is in range; None where the Earth hides it."""
        towards = normalize(pose[:3, 3] - target.centre)
        least, most = self._phase_cosines
        while True:
            sun = Sun(random.normal(size=3))
            if least <= sun.direction @ towards and (most == 1 or sun.direction @ towards <= most):
                break
        if target.earth is None or (least, most) == (-1, 1):
            return sun
        hidden = sun.direction @ target.earth.direction > math.cos(target.earth.angular_radius + SUN_MARGIN)
        return None if hidden else sun

    def _turn_about_sun(self, random: np.random.Generator, pose: Array, sun: Sun, target: TargetSphere) -> Array:
        """`pose` turned about the target to a place that is drawn at random among those of a phase angle in range."""
        offset = pose[:3, 3] - target.centre
        cosine, angle = random.uniform(*self._phase_cosines), random.uniform(0, 2 * math.pi)
        sine = math.sqrt(max(1 - cosine * cosine, 0))
        wanted = _frame_about(sun.direction) @ [sine * math.cos(angle), sine * math.sin(angle), cosine]
        turn = _frame_about(wanted) @ _frame_about(normalize(offset)).T
        turned = np.eye(4)
        turned[:3, :3] = turn @ pose[:3, :3]
        turned[:3, 3] = target.centre + turn @ offset
        return turned

    def _pose(
        self, random: np.random.Generator, target: TargetSphere, camera: CameraConfig, depths: Array | tuple
    ) -> Array:
        """[4, 4] world_from_camera. In camera axes the centre is at z (u, v, 1), z between the two `depths`."""
        near, far = depths
        fraction = random.random()
        z = near + fraction * (far - near)
        if self.sigma is not None:  # the inverse of the law's distribution
            z = near + self.sigma * float(ndtri(0.5 + fraction * (ndtr((far - near) / self.sigma) - 0.5)))
        half = np.array(camera.half_tangents)
        margin = half  # of u and v: the sphere touches a side's plane where z u = z half - radius sqrt(1 + half^2)
        if not self.cropped:
            margin = np.maximum(half - target.radius / z * np.sqrt(1 + half**2), 0)
        u, v = margin * random.uniform(-1, 1, 2)
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quaternion(random.normal(size=4))  # uniform: a normal law has no direction
        pose[:3, 3] = target.centre - pose[:3, :3] @ (z * np.array([u, v, 1.0]))
        return pose


def _frame_about(axis: Array) -> Array:
    """[3, 3] a rotation whose third column is the unit `axis` [3]."""
    side = perpendicular(axis)
    return np.stack([side, np.cross(axis, side), axis], axis=1)
