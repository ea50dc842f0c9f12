"""Cameras that move: approaches along an axis, and fly-arounds by relative orbits."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import expect
from spacesim.data.geometry import look_at
from spacesim.data.records import Sun
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.orbit import ORBIT_NORMAL, WORLD_FROM_LVLH, ellipse, mean_motion, star_direction
from spacesim.scenes.cameras.rig import (
    TRAIN,
    PlannedView,
    RigConfig,
    Stream,
    TargetSphere,
    Views,
    expect_metres,
    fitting_distance,
    intermediate_steps,
)

START = 5.0
"""Where an approach begins over where it ends, if that is not given."""

APPROACHES = {
    "v-bar": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "-v-bar": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "r-bar": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),
    "-r-bar": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
}
"""Where the camera comes from, and what is up in its image, world frame (see orbit.py for V-bar and R-bar)."""


@dataclass(frozen=True)
class ApproachRig(RigConfig):
    """A straight approach, at constant speed, of a camera that looks at the target. Test frames lie halfway between
    training frames."""

    axis: str = "v-bar"  #: "v-bar" from ahead, "-v-bar" from behind, "r-bar" from below, "-r-bar" from above
    start: float | None = None  #: metres from the target's centre; None: START times as far as the end
    end: float | None = None  #: metres from the target's centre; None: where it just fits into the image
    jitter: float = 0.0  #: standard deviation of the position across the line, metres

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self.axis in APPROACHES, "axis", f"one of {', '.join(APPROACHES)}", self.axis)
        expect_metres(start=self.start, end=self.end)
        expect_metres(0, jitter=self.jitter)
        if self.start is not None and self.end is not None:
            expect(self.end < self.start, "end", f"less than start, {self.start:g} m", self.end)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        end = self.end or fitting_distance(target.radius, camera)
        start = self.start or START * end
        expect(end < start, "start", f"more than end, {end:.3g} m", start)
        away, up = (np.array(axis) for axis in APPROACHES[self.axis])
        lateral = np.stack([up, np.cross(away, up)])

        def at(step: float, sun: Sun, stream: Sequence[int]) -> PlannedView:
            distance = start + (end - start) * step / max(self.views - 1, 1)
            offset = self.jitter * np.random.default_rng([seed, *stream]).normal(size=2)
            pose = look_at(target.centre + distance * away + offset @ lateral, target.centre, up)
            return PlannedView(camera.at(pose), sun)

        return _views_on_path(self, self.sun_directions(seed), at, closed=False)


@dataclass(frozen=True)
class FlyAroundRig(RigConfig):
    """A free relative orbit around the target (Clohessy and Wiltshire, see orbit.py); the camera looks at the
    target, with the orbit's normal upwards in the image. Test frames lie halfway between training frames."""

    #: half the radial extent, metres, and a quarter of that along V-bar; None: the target just fits into the image
    #: where it is nearest
    size: float | None = None
    across: float = 0.0  #: amplitude out of the orbit's plane, metres
    across_phase_deg: float = 0.0  #: how far that motion is ahead
    phase_deg: float = 0.0  #: where the first frame is, 0 below the target, 90 ahead of it
    altitude_km: float = 500.0  #: of the target's circular orbit
    duration_s: float | None = None  #: seconds that the frames cover; None: one revolution
    #: the Sun stands still among the stars, and so turns in the world frame; `sun` is where it is in the first frame
    sun_moves: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        expect_metres(size=self.size)
        expect_metres(0, across=self.across)
        for name in ("across_phase_deg", "phase_deg"):
            expect(math.isfinite(getattr(self, name)), name, "a finite angle", getattr(self, name))
        expect(100 <= self.altitude_km <= 1e5, "altitude_km", "an altitude from 100 to 100,000 km", self.altitude_km)
        if self.duration_s is not None:
            limit = 2 * math.pi / mean_motion(self.altitude_km)
            expected = f"seconds above 0, up to one revolution of {limit:.1f}"
            expect(0 < self.duration_s <= limit, "duration_s", expected, self.duration_s)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        size = self.size or fitting_distance(target.radius, camera)
        n = mean_motion(self.altitude_km)
        closed = self.duration_s is None
        angle = 2 * math.pi if self.duration_s is None else n * self.duration_s
        steps = self.views if closed else max(self.views - 1, 1)
        first, ahead = math.radians(self.phase_deg), math.radians(self.across_phase_deg)

        def at(step: float, sun: Sun, _: Sequence[int]) -> PlannedView:
            phase = angle * step / steps
            state = ellipse(np.array(first + phase), n, size, self.across, ahead)
            pose = look_at(target.centre + WORLD_FROM_LVLH @ state[:3], target.centre, ORBIT_NORMAL)
            turned = Sun(star_direction(sun.direction, phase)) if self.sun_moves else sun
            return PlannedView(camera.at(pose), turned)

        return _views_on_path(self, self.sun_directions(seed), at, closed)


def _views_on_path(
    rig: RigConfig,
    suns: tuple[list[Sun], list[Sun]],
    at: Callable[[float, Sun, Sequence[int]], PlannedView],
    closed: bool,
) -> Views:
    """Views at the steps of a trajectory, for each Sun; at: (step, Sun, random stream) to a view."""

    def along(sun: Sun, count: int, stream: Stream) -> list[PlannedView]:
        steps = range(rig.views) if stream[0] == TRAIN else intermediate_steps(rig.views, count, closed).tolist()
        return [at(step, sun, (*stream, k)) for k, step in enumerate(steps)]

    return rig.all_views(suns, along)
