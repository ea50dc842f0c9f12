"""Where the Suns and the cameras are: spherical Fibonacci lattices (thesis 4.3.6)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import expect
from spacesim.data.geometry import Array, fibonacci_sphere, look_at
from spacesim.data.records import Camera, Sun
from spacesim.scenes.camera import CameraConfig

SINGLE_SUN = (45.0, 35.0)
"""Azimuth and elevation, degrees, of the Sun where only one is asked for: the thesis's single-Sun
evaluation."""

MARGIN = 1.05
"""How much larger than the object's bounding sphere the frame is."""

_TRAIN, _TEST, _HELD_OUT = range(3)  # streams of random rotations


@dataclass(frozen=True, eq=False)
class View:
    """One frame to render."""

    camera: Camera
    sun: Sun


@dataclass(frozen=True, eq=False)
class Target:
    """What cameras look at: a sphere about `centre` [3] of `radius`, metres."""

    centre: Array
    radius: float


@dataclass(frozen=True)
class RigConfig:
    """Suns and views of every rig. Raises InputError for a value out of range.

    Every training Sun has `views` training views. Every test Sun has `test_views` test views; the test Suns
    are `test_suns` directions that training never sees or, where that is 0, the training Suns.
    sun: training Suns as (azimuth, elevation), degrees; () the rig's own arrangement of `suns`.
    """

    suns: int = 1
    views: int = 100
    test_suns: int = 0
    test_views: int = 20
    sun: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for name, lowest in {"suns": 1, "views": 1, "test_suns": 0, "test_views": 0}.items():
            expect(getattr(self, name) >= lowest, name, f"at least {lowest}", getattr(self, name))
        for azimuth, elevation in self.sun:
            possible = math.isfinite(azimuth) and -90 <= elevation <= 90
            wanted = "a finite azimuth and an elevation from -90 to 90 degrees"
            expect(possible, "sun", wanted, (azimuth, elevation))
        if self.sun:
            expect(self.suns in (1, len(self.sun)), "suns", f"{len(self.sun)} as in sun", self.suns)


@dataclass(frozen=True)
class FibonacciRig(RigConfig):
    """Cameras all around, that look at the target. distance: metres from its centre; None: the target just fits into the
    image. One Sun alone stands at SINGLE_SUN, several on a Fibonacci lattice (thesis 4.3.6)."""

    distance: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distance is not None:
            expect(0 < self.distance < math.inf, "distance", "metres above 0", self.distance)


RIGS: dict[str, type[RigConfig]] = {"fibonacci": FibonacciRig}
"""The kinds of rig, as scene files name them."""


def plan(rig: RigConfig, target: Target, camera: CameraConfig, seed: int) -> tuple[list[View], list[View]]:
    """The training and the test views of a rig. Random streams are derived from (seed, purpose, index)."""
    assert isinstance(rig, FibonacciRig)
    distance = rig.distance or fitting_distance(target.radius, camera)
    suns = training_suns(rig.suns, rig.sun)
    test_suns = held_out_suns(rig.test_suns, seed) if rig.test_suns else suns

    def around(suns: Sequence[Sun], count: int, stream: int) -> list[View]:
        """The lattice of cameras is turned at random for each Sun, so that no two sets coincide."""
        return [
            View(camera.at(look_at(target.centre + distance * direction, target.centre)), sun)
            for i, sun in enumerate(suns)
            for direction in fibonacci_sphere(count, seed=_stream(seed, stream, i))
        ]

    return around(suns, rig.views, _TRAIN), around(test_suns, rig.test_views, _TEST)


def training_suns(count: int, angles: Sequence[tuple[float, float]] = ()) -> list[Sun]:
    """The Suns of `angles` (azimuth and elevation, degrees); without any, `count` on a Fibonacci lattice, or
    SINGLE_SUN for a count of 1."""
    if not angles and count == 1:
        angles = [SINGLE_SUN]
    if angles:
        return [Sun.from_angles(azimuth, elevation) for azimuth, elevation in angles]
    return [Sun(direction) for direction in fibonacci_sphere(count)]


def held_out_suns(count: int, seed: int) -> list[Sun]:
    """`count` Suns on a Fibonacci lattice that is turned at random, so that they are none of the training
    Suns."""
    return [Sun(direction) for direction in fibonacci_sphere(count, seed=_stream(seed, _HELD_OUT, 0))]


def fitting_distance(radius: float, camera: CameraConfig) -> float:
    """Distance, metres, from which a sphere of `radius` metres fills the shorter side of the frame but for MARGIN."""
    return MARGIN * radius / math.sin(0.5 * camera.smallest_fov)


def _stream(seed: int, stream: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, stream, index]).generate_state(1)[0])
