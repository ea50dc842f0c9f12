"""Where the Suns and the cameras are: spherical Fibonacci lattices (thesis 4.3.6)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from spacesim.data.geometry import Array, fibonacci_sphere, look_at
from spacesim.data.records import Camera, Sun

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


@dataclass(frozen=True, eq=False)
class Lens:
    """Cameras all alike on a sphere. target: [3] metres, what they look at; distance: metres from it;
    resolution: pixels of each side; fov_deg: full angle that a side covers."""

    target: Array
    distance: float
    resolution: int
    fov_deg: float

    def camera(self, direction: Array) -> Camera:
        """The camera that stands in `direction` [3] from the target and looks at it."""
        pose = look_at(self.target + self.distance * direction, self.target)
        return Camera.from_fov(pose, self.resolution, self.resolution, self.fov_deg)


def fitting_distance(radius: float, fov_deg: float) -> float:
    """Distance, metres, from which a sphere of `radius` metres fills the frame but for MARGIN."""
    return MARGIN * radius / float(np.sin(0.5 * np.radians(fov_deg)))


def views_around(suns: Sequence[Sun], lens: Lens, count: int, seed: int, split: Literal["train", "test"]) -> list[View]:
    """`count` cameras for each Sun, all around the target. The lattice is turned at random for each Sun and
    split, so that no two sets of cameras coincide."""
    stream = _TRAIN if split == "train" else _TEST
    return [
        View(lens.camera(direction), sun)
        for i, sun in enumerate(suns)
        for direction in fibonacci_sphere(count, seed=_stream(seed, stream, i))
    ]


def _stream(seed: int, stream: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, stream, index]).generate_state(1)[0])
