"""How camera, target, Sun and Earth move in a world, and the part of it that a scene needs, seen from the target.

The world is whatever frame the file is in. The scene's own frame is that of the target: its body axes, with the origin
where the target is. So a dataset shows a target that stands still, which is what it is trained on, whatever it does in
the world. Where nothing is said of the target, the scene's frame is the world. Other objects of the scene move in it
where their own poses are given.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import date, timedelta

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, look_at, normalize
from spacesim.scenes.trajectory.tracks import Attitude, Track, place_of

_log = logging.getLogger(__name__)

DAY = 86_400.0
"""Seconds."""

MAX_PLACE, MAX_SPEED = 1e15, 299_792_458.0
"""Metres of a coordinate, 6,700 times the Earth's distance from the Sun, and metres a second of one, light's."""

_OTHERS = ("day", "time_system", "timed", "bodies")  # fields of a motion that are no tracks


@dataclass(frozen=True, eq=False)
class Motion:
    """What is known of a motion; None: nothing. All in one world frame, metres, seconds.

    Raises InputError for positions and velocities that nothing has."""

    day: int | None = None  #: from whose midnight times count (a proleptic ordinal), None: a clock of its own
    time_system: str = "UTC"  #: of the calendar: "UTC", "TDB", ...; means nothing to a clock of its own
    timed: bool = True  #: False: times are numbers of rows, and there is nothing between them
    camera: Track | None = None  #: position
    camera_turn: Attitude | None = None  #: world_from_camera, or of the body that carries it
    target: Track | None = None  #: position
    target_turn: Attitude | None = None  #: world_from_target
    earth: Track | None = None  #: position of the Earth's centre
    sun: Track | None = None  #: direction towards the Sun
    exposure: Track | None = None  #: display value of a radiance of 1 W m^-2 sr^-1
    #: of other objects of the scene, by their numbers K: positions as "targetK", world_from_object as "targetK_turn"
    bodies: Mapping[str, Track | Attitude] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for track in (self.camera, self.target, self.earth, *self.bodies.values()):
            if isinstance(track, Track):
                _check_size(track, track.values, MAX_PLACE, "m")
                _check_size(track, track.values[:0] if track.rates is None else track.rates, MAX_SPEED, "m/s")

    @property
    def tracks(self) -> dict[str, Track | Attitude]:
        """All that is known."""
        tracks: dict[str, Track | Attitude | None]
        tracks = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _OTHERS}
        return {name: track for name, track in tracks.items() if track is not None} | dict(self.bodies)

    def times(self) -> Array:
        """[N] the times of the camera's track, else the target's, that all tracks cover; logs how many that leaves out.
        Raises InputError where there is none, or no pose."""
        main = (
            self.camera or self.camera_turn or self.target or self.target_turn or next(iter(self.bodies.values()), None)
        )
        if main is None:
            raise InputError("rig: expected a pose of the camera or of the target, found none")
        first = max(self.tracks.values(), key=lambda track: float(track.times[0]))
        last = min(self.tracks.values(), key=lambda track: float(track.times[-1]))
        common = main.times[(main.times >= first.times[0]) & (main.times <= last.times[-1])]
        if not len(common):
            raise InputError(
                f"rig: expected a time that all of it covers, found that {last.name} ends before {first.name} begins"
            )
        if len(common) < len(main.times):
            shorter = last.name if last.times[-1] < main.times[-1] else first.name
            lost, span = len(main.times) - len(common), f"{common[0]:.10g} to {common[-1]:.10g} s"
            _log.warning(
                "%s: %d of %d rows are left out, as %s does not cover them; what is left is from %s",
                main.name,
                lost,
                len(main.times),
                shorter,
                span,
            )
        return common

    def epoch(self, seconds: float) -> str | None:
        """A time as the calendar says it, of its own time system; None of a clock of its own."""
        if self.day is None:
            return None
        days, rest = divmod(round(seconds * 1e6), round(DAY * 1e6))
        minutes, micro = divmod(rest, 60_000_000)
        day = date.fromordinal(self.day) + timedelta(days)
        return f"{day.isoformat()}T{minutes // 60:02d}:{minutes % 60:02d}:{micro / 1e6:09.6f}"


def _check_size(track: Track, values: Array, most: float, unit: str) -> None:
    """Raise InputError where one of its `values` [N, 3] is beyond `most`."""
    beyond = (np.abs(values) > most).any(axis=1)
    if beyond.any():
        row = int(beyond.argmax())
        expected = f"up to {most:g} {unit} along an axis"
        found = f"{values[row].tolist()} in {place_of(row, track.lines)}"
        raise InputError(f"{track.name}: expected {expected}, found {found}")


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """A motion at N times, as the scene sees it: in the target's frame, metres."""

    times: Array  #: [N] seconds
    world_from_camera: Array  #: [N, 4, 4] of the scene's world, OpenCV axes
    turn: Array  #: [N, 3, 3] from the scene's axes to those of the motion's world
    sun: Array | None  #: [N, 3] unit, towards the Sun
    earth: Array | None  #: [N, 3] to the Earth's centre
    exposure: Array | None  #: [N]
    objects: Mapping[int, Array] = field(default_factory=dict)  #: [N, 4, 4] rigid, of objects that move, by number


def merge(motions: Sequence[Motion]) -> Motion:
    """The motion in several files together. Raises InputError where two have the same, or their clocks differ."""
    whole = motions[0]
    for other in motions[1:]:
        if (whole.day is None) != (other.day is None):
            raise InputError(
                "rig: expected calendar times in all of its files (time_utc in a table), or in none, found both"
            )
        if whole.day is not None and whole.time_system != other.time_system:
            systems = f"{whole.time_system} and {other.time_system}"
            raise InputError(f"rig: expected one time system in all of its files (a table's is UTC), found {systems}")
        both = sorted(whole.tracks.keys() & other.tracks.keys())
        if both:
            names = f"{whole.tracks[both[0]].name} and {other.tracks[both[0]].name}"
            raise InputError(f"rig: expected one source of each track, found {names}")
        later = DAY * ((other.day or 0) - (whole.day or 0))
        moved = {name: replace(track, times=track.times + later) for name, track in other.tracks.items()}
        bodies = {**whole.bodies, **{name: moved.pop(name) for name in other.bodies}}
        whole = replace(whole, timed=whole.timed and other.timed, bodies=bodies, **moved)  # type: ignore[arg-type]
    return whole


def seen_from_target(motion: Motion, times: Array, camera_from_optics: Array, centre: Array) -> MotionSamples:
    """`motion` at `times` [N] in the target's frame.

    camera_from_optics: [3, 3] OpenCV camera axes to those whose attitude is given; centre: [3] of the objects, scene
    frame, which a camera looks at, the world's z upwards, where its attitude is not given; the target's origin where
    others move. Raises InputError for a time that is not covered.
    """
    centre = np.zeros(3) if motion.bodies else centre
    count = len(times)
    still, unturned = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    place = motion.target.at(times) if motion.target else still
    world_from_target = motion.target_turn.at(times) if motion.target_turn else unturned
    target_from_world = np.swapaxes(world_from_target, 1, 2)

    def to_target(vectors: Array) -> Array:
        return np.einsum("nij,nj->ni", target_from_world, vectors)

    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = to_target((motion.camera.at(times) if motion.camera else still) - place)
    if motion.camera_turn or not motion.camera:
        turn = motion.camera_turn.at(times) if motion.camera_turn else unturned
        poses[:, :3, :3] = target_from_world @ turn @ camera_from_optics
    else:
        up = to_target(np.tile([0.0, 0.0, 1.0], (count, 1)))
        for k in range(count):
            if np.linalg.norm(poses[k, :3, 3] - centre) > 0:
                poses[k] = look_at(poses[k, :3, 3], centre, up[k])
    objects = {}
    for name in motion.bodies:
        if not name.endswith("_turn"):
            pose, turned = np.tile(np.eye(4), (count, 1, 1)), motion.bodies.get(f"{name}_turn")
            pose[:, :3, 3] = to_target(motion.bodies[name].at(times) - place)
            pose[:, :3, :3] = target_from_world @ (turned.at(times) if turned else unturned)
            objects[int(name.removeprefix("target"))] = pose
    return MotionSamples(
        times,
        poses,
        world_from_target,
        normalize(to_target(motion.sun.at(times))) if motion.sun else None,
        to_target(motion.earth.at(times) - place) if motion.earth else None,
        motion.exposure.at(times)[:, 0] if motion.exposure else None,
        objects,
    )
