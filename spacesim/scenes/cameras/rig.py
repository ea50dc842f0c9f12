"""Where the Suns and the cameras are: lattices, random poses, approaches and fly-arounds."""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy.special import ndtr, ndtri

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array, fibonacci_sphere, look_at, normalize, rotation_from_quaternion
from spacesim.data.records import Camera, Sun
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.orbit import ORBIT_NORMAL, WORLD_FROM_LVLH, ellipse, mean_motion, star_direction
from spacesim.scenes.lights.earth import EarthConfig

SINGLE_SUN = (45.0, 35.0)
"""Azimuth and elevation, degrees, of the Sun where only one is asked for: the thesis's single-Sun
evaluation."""

MARGIN = 1.05
"""How much larger than the object's bounding sphere the frame is."""

FAR = 4.0
"""Farthest depth of random poses over the nearest where none is given (SPEED+ reaches 10 m, thesis 6.3.2)."""

START = 5.0
"""Where an approach begins over where it ends, if that is not given."""

APPROACHES = {
    "v-bar": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "-v-bar": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "r-bar": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),
    "-r-bar": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
}
"""Where the camera comes from, and what is up in its image, world frame (see orbit.py for V-bar and R-bar)."""

MIN_METRES, MAX_METRES = 1e-9, 1e12
"""Metres of distances."""

MAX_FRAMES = 10_000_000
"""Of a dataset: the plan of all frames is held in memory."""

SUN_MARGIN = math.radians(0.6)
"""Between the Earth's limb and the centre of Suns that it shall not hide: two of the Sun's radii at 1 au."""

TRIES = 1000
"""Poses that are drawn for one whose Sun the Earth does not hide."""

_TRAIN, _TEST, _HELD_OUT, _KNOWN = range(4)  # streams of random numbers


@dataclass(frozen=True, eq=False)
class PlannedView:
    """One frame to render. What a rig does not know, the scene says."""

    camera: Camera  #: pose and intrinsics
    sun: Sun  #: that lights it
    time: float | None = None  #: seconds
    epoch: str | None = None  #: the same as the calendar says it
    exposure: float | None = None  #: display value of a radiance of 1 W m^-2 sr^-1
    earth: Array | None = None  #: [3] from the world's origin to the Earth's centre, metres
    sky_from_world: Array | None = None  #: [3, 3] to the axes in which stars stand still; None: the world's
    #: [4, 4] rigid world_from_object of those moved, by number
    objects: Mapping[int, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class TargetSphere:
    """What cameras look at: a sphere about `centre` [3] of `radius`, metres."""

    centre: Array
    radius: float
    earth: EarthConfig | None = None  #: of the scene


Views = tuple[list[PlannedView], list[PlannedView]]  #: of training and of testing
Stream = tuple[int, int]  #: of random numbers: purpose, number of the Sun
ViewsOf = Callable[[Sun, int, Stream], Sequence[PlannedView]]  #: so many views of a Sun


@dataclass(frozen=True)
class Rig(ABC):
    """Where Suns and cameras are. For one of your own that `PoseRig` cannot be, subclass it as a frozen dataclass."""

    @abstractmethod
    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        """The training and the test views of `target`. Raises InputError where the rig does not suit it."""

    def located(self, folder: Path) -> "Rig":
        """The same with paths of files that begin in `folder`, where they are relative."""
        return self

    def files(self) -> tuple[Path, ...]:
        """What it reads."""
        return ()

    def to_json(self) -> JsonDict:
        """What scene.json says of it: plain values. Raises InputError for others."""
        values = asdict(self)
        try:
            json.dumps(values, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InputError(f"rig: expected fields that JSON has, or a to_json of its own, found {error}") from None
        return values


@dataclass(frozen=True)
class RigConfig(Rig):
    """Suns and views of rigs that arrange them. Raises InputError for a value out of range.

    Every training Sun has `views` training views. Every test Sun has `test_views` test views; the test Suns are
    `test_suns` directions that training never sees or, where that is 0, the training Suns.
    """

    suns: int = 1  #: of training, where `sun` names none
    views: int = 100
    test_suns: int = 0
    test_views: int = 20
    #: with test Suns of their own, test views of every training Sun beside these, listed after them
    known_test_views: int = 0
    #: every Sun has the same test cameras, so that pictures differ by their light alone
    shared_test_views: bool = False
    #: training Suns as (azimuth, elevation), degrees; () the rig's own arrangement of `suns`
    sun: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for name, lowest in {"suns": 1, "views": 1, "test_suns": 0, "test_views": 0, "known_test_views": 0}.items():
            expect(getattr(self, name) >= lowest, name, f"at least {lowest}", getattr(self, name))
            expect(getattr(self, name) <= MAX_FRAMES, name, f"at most {MAX_FRAMES:,}", getattr(self, name))
        for azimuth, elevation in self.sun:
            possible = math.isfinite(azimuth) and -90 <= elevation <= 90
            expected = "a finite azimuth and an elevation from -90 to 90 degrees"
            expect(possible, "sun", expected, (azimuth, elevation))
        if self.sun:
            fits = self.suns in (type(self).suns, len(self.sun))
            expect(fits, "suns", f"{len(self.sun)}, one for each direction given", self.suns)
        if self.known_test_views and not self.test_suns:
            expected = "0 without test_suns, where test_views are of the training Suns"
            expect(False, "known_test_views", expected, self.known_test_views)
        suns = len(self.sun) or self.suns
        frames = suns * (self.views + self.known_test_views) + (self.test_suns or suns) * self.test_views
        expect(frames <= MAX_FRAMES, "views", f"at most {MAX_FRAMES:,} frames of all Suns", frames)

    def sun_directions(self, seed: int) -> tuple[list[Sun], list[Sun]]:
        """The training and the test Suns: lattices, unless the rig arranges them."""
        suns = training_suns(self.suns, self.sun)
        return suns, held_out_suns(self.test_suns, seed) if self.test_suns else suns

    def all_views(self, suns: tuple[list[Sun], list[Sun]], views: ViewsOf) -> Views:
        """The training and the test views; views: (Sun, views of it, stream of random numbers), whichever set it is.

        suns: of training and of testing. Views of known Suns stand last, so that asking for them changes no other.
        """
        sets = [
            (_TRAIN, suns[0], self.views),
            (_TEST, suns[1], self.test_views),
            (_KNOWN, suns[0], self.known_test_views),
        ]
        view_sets = []
        for purpose, some, count in sets:
            shared = self.shared_test_views and purpose != _TRAIN
            streams = [(_TEST, 0) if shared else (purpose, i) for i in range(len(some))]
            view_sets.append(
                [view for sun, stream in zip(some, streams, strict=True) for view in views(sun, count, stream)]
            )
        return view_sets[0], view_sets[1] + view_sets[2]


@dataclass(frozen=True)
class FibonacciRig(RigConfig):
    """Cameras all around, that look at the target. One Sun alone stands at SINGLE_SUN, several on a Fibonacci lattice
    (thesis 4.3.6)."""

    distance: float | None = None  #: metres from the target's centre; None: it just fits into the image

    def __post_init__(self) -> None:
        super().__post_init__()
        _expect_metres(distance=self.distance)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        return _views_on_sphere(self.sun_directions(seed), self, self.distance, target, camera, seed)


@dataclass(frozen=True)
class PolarArcRig(RigConfig):
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
        _expect_metres(distance=self.distance)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        return _views_on_sphere(self.sun_directions(seed), self, self.distance, target, camera, seed)

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
        _expect_metres(near=self.near, far=self.far, sigma=self.sigma)
        if self.near is not None and self.far is not None:
            expect(self.near <= self.far, "far", f"at least near, {self.near:g} m", self.far)
        check_phases(self.min_phase_deg, self.max_phase_deg)
        expect(not (self.random_suns and self.sun), "random_suns", "false where sun names the Suns", True)
        if self.random_suns and (self.suns, self.test_suns) != (1, 0):
            found = f"{self.suns} suns and {self.test_suns} test_suns"
            raise InputError(f"random_suns: expected 1 suns and 0 test_suns, as every frame has its own, found {found}")

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
        _expect_metres(start=self.start, end=self.end)
        _expect_metres(0, jitter=self.jitter)
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
        _expect_metres(size=self.size)
        _expect_metres(0, across=self.across)
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


def check_phases(least: float | None, most: float | None) -> None:
    """Raise InputError unless `min_phase_deg` and `max_phase_deg`, None for no limit, leave a range of a degree."""
    if most is not None:
        expect(1 <= most <= 180, "max_phase_deg", "an angle from 1 to 180 degrees", most)
    if least is not None:
        below = (180.0 if most is None else most) - 1
        expect(0 <= least <= below, "min_phase_deg", f"an angle from 0 to {below:g} degrees", least)


def plan(rig: Rig, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
    """The training and the test views of a rig. Random streams are derived from (seed, purpose, index)."""
    return rig.views_of(target, camera, seed)


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
    return [Sun(direction) for direction in fibonacci_sphere(count, seed=_seed_of(seed, _HELD_OUT, 0))]


def fitting_distance(radius: float, camera: CameraConfig) -> float:
    """Distance, metres, from which a sphere of `radius` metres fills the shorter side of the frame but for MARGIN."""
    return MARGIN * radius / float(np.sin(0.5 * camera.smallest_fov))


def intermediate_steps(count: int, number: int, closed: bool) -> Array:
    """[wanted] places between the steps 0, 1, ..., count - 1, spread evenly, that are none of these steps: middles,
    where there are enough gaps. closed: there is a gap after the last step, too."""
    gaps = max(count if closed else count - 1, 1)
    in_each = max(-(-number // gaps), 1)
    place = np.floor((np.arange(number) + 0.5) / max(number, 1) * gaps * in_each)
    return place // in_each + (place % in_each + 1) / (in_each + 1)


def _views_on_sphere(
    suns: tuple[list[Sun], list[Sun]],
    rig: RigConfig,
    distance: float | None,
    target: TargetSphere,
    camera: CameraConfig,
    seed: int,
) -> Views:
    """Cameras on a Fibonacci lattice, turned at random for each Sun, so that no two sets coincide."""
    metres = distance or fitting_distance(target.radius, camera)

    def around(sun: Sun, count: int, stream: Stream) -> list[PlannedView]:
        return [
            PlannedView(camera.at(look_at(target.centre + metres * direction, target.centre)), sun)
            for direction in fibonacci_sphere(count, seed=_seed_of(seed, *stream))
        ]

    return rig.all_views(suns, around)


def _views_on_path(
    rig: RigConfig,
    suns: tuple[list[Sun], list[Sun]],
    at: Callable[[float, Sun, Sequence[int]], PlannedView],
    closed: bool,
) -> Views:
    """Views at the steps of a trajectory, for each Sun; at: (step, Sun, random stream) to a view."""

    def along(sun: Sun, count: int, stream: Stream) -> list[PlannedView]:
        steps = range(rig.views) if stream[0] == _TRAIN else intermediate_steps(rig.views, count, closed).tolist()
        return [at(step, sun, (*stream, k)) for k, step in enumerate(steps)]

    return rig.all_views(suns, along)


def _frame_about(axis: Array) -> Array:
    """[3, 3] a rotation whose third column is the unit `axis` [3]."""
    side = normalize(np.cross(np.eye(3)[np.abs(axis).argmin()], axis))
    return np.stack([side, np.cross(axis, side), axis], axis=1)


def _expect_metres(least: float = MIN_METRES, **lengths: float | None) -> None:
    for name, metres in lengths.items():
        fits = metres is None or least <= metres <= MAX_METRES
        expect(fits, name, f"metres from {least:g} to {MAX_METRES:g}", metres)


def _seed_of(seed: int, purpose: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, purpose, index]).generate_state(1)[0])
