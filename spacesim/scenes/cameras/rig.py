"""Where the Suns and the cameras are: what rigs share, and the plan of a dataset."""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.data.records import Camera, Sun
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.lights.earth import EarthConfig

SINGLE_SUN = (45.0, 35.0)
"""Azimuth and elevation, degrees, of the Sun where only one is asked for: the thesis's single-Sun
evaluation."""

MARGIN = 1.05
"""How much larger than the object's bounding sphere the frame is."""

NEAR_BORDER = 0.25
"""Of `CameraConfig.nearest_border`: nearer to it than that, framing by the axis makes the object small."""

MIN_METRES, MAX_METRES = 1e-9, 1e12
"""Metres of distances."""

MAX_FRAMES = 10_000_000
"""Of a dataset: the plan of all frames is held in memory."""

TRAIN, TEST, HELD_OUT, KNOWN = range(4)  # streams of random numbers


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

    @property
    def shared_cameras(self) -> int | None:
        """Of how many test cameras some Suns have a part alone; None: each has all of them, or cameras of its own."""
        return None

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
    #: every Sun has the same test cameras, so that pictures differ by their light alone; where `test_views` and
    #: `known_test_views` differ, the fewer are some of the more, evenly spread
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

    @property
    def shared_cameras(self) -> int | None:
        counts = self.test_views, self.known_test_views
        return max(counts) if self.shared_test_views and 0 < min(counts) < max(counts) else None

    def all_views(self, suns: tuple[list[Sun], list[Sun]], views: ViewsOf) -> Views:
        """The training and the test views; views: (Sun, views of it, stream of random numbers), whichever set it is.

        suns: of training and of testing. Views of known Suns stand last, so that asking for them changes no other.
        """
        sets = [
            (TRAIN, suns[0], self.views),
            (TEST, suns[1], self.test_views),
            (KNOWN, suns[0], self.known_test_views),
        ]
        view_sets = []
        for purpose, some, count in sets:
            shared = self.shared_test_views and purpose != TRAIN
            among = (shared and self.shared_cameras) or count
            streams = [(TEST, 0) if shared else (purpose, i) for i in range(len(some))]
            planned = [views(sun, among, stream) for sun, stream in zip(some, streams, strict=True)]
            chosen = [(2 * i + 1) * among // (2 * count) for i in range(count)]
            view_sets.append([of_sun[i] for of_sun in planned for i in chosen])
        return view_sets[0], view_sets[1] + view_sets[2]


def check_phases(least: float | None, most: float | None) -> None:
    """Raise InputError unless `min_phase_deg` and `max_phase_deg`, None for no limit, leave a range of a degree."""
    if most is not None:
        expect(1 <= most <= 180, "max_phase_deg", "an angle from 1 to 180 degrees", most)
    if least is not None:
        below = (180.0 if most is None else most) - 1
        expect(0 <= least <= below, "min_phase_deg", f"an angle from 0 to {below:g} degrees", least)


def plan(rig: Rig, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
    """The training and the test views of a rig. Random streams are derived from (seed, purpose, index). Raises
    InputError where a user-defined rig gives something else, or no training view."""
    views = rig.views_of(target, camera, seed)
    if not (
        isinstance(views, tuple | list) and len(views) == 2 and all(isinstance(some, list | tuple) for some in views)
    ):
        raise InputError(f"rig: expected two lists, of training and test views, found {type(views).__name__}")
    wrong = next((view for some in views for view in some if not isinstance(view, PlannedView)), None)
    if wrong is not None:
        raise InputError(f"rig: expected a PlannedView for each frame, found {type(wrong).__name__}")
    for view in (*views[0], *views[1]):
        for kind, value in ((Camera, view.camera), (Sun, view.sun)):
            if not isinstance(value, kind):
                raise InputError(f"rig: expected a {kind.__name__} in each PlannedView, found {type(value).__name__}")
    if not views[0]:
        raise InputError("rig: expected at least one training view, found none")
    return list(views[0]), list(views[1])


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
    return [Sun(direction) for direction in fibonacci_sphere(count, seed=seed_of(seed, HELD_OUT, 0))]


def fitting_distance(radius: float, camera: CameraConfig) -> float:
    """Distance, metres, from which a sphere of `radius` metres fills the shorter side of the frame but for MARGIN.
    Raises InputError for a camera whose axis is so near a border that it would be a dot."""
    if camera.nearest_border < NEAR_BORDER:
        raise InputError("principal: expected a point nearer to the middle where the rig is to choose the distance")
    return MARGIN * radius / float(np.sin(0.5 * camera.smallest_fov))


def intermediate_steps(count: int, number: int, closed: bool) -> Array:
    """[wanted] places between the steps 0, 1, ..., count - 1, spread evenly, that are none of these steps: middles,
    where there are enough gaps. closed: there is a gap after the last step, too."""
    gaps = max(count if closed else count - 1, 1)
    in_each = max(-(-number // gaps), 1)
    place = np.floor((np.arange(number) + 0.5) / max(number, 1) * gaps * in_each)
    return place // in_each + (place % in_each + 1) / (in_each + 1)


def expect_metres(least: float = MIN_METRES, **lengths: float | None) -> None:
    for name, metres in lengths.items():
        fits = metres is None or least <= metres <= MAX_METRES
        expect(fits, name, f"metres from {least:g} to {MAX_METRES:g}", metres)


def seed_of(seed: int, purpose: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, purpose, index]).generate_state(1)[0])
