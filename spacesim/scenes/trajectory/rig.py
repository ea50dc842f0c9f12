"""Rigs that follow a trajectory: of files, or of arrays from Python."""

import hashlib
import logging
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array, normalize, rotation_from_quaternion
from spacesim.data.records import Sun
from spacesim.scenes.cameras.camera import EXPOSURES, CameraConfig
from spacesim.scenes.cameras.rig import (
    MAX_FRAMES,
    SINGLE_SUN,
    PlannedView,
    Rig,
    TargetSphere,
    Views,
    check_phases,
    intermediate_steps,
)
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM
from spacesim.scenes.lights.eclipse import visible_fraction
from spacesim.scenes.trajectory.ccsds import motion_of
from spacesim.scenes.trajectory.motion import Motion, MotionSamples, merge, seen_from_target
from spacesim.scenes.trajectory.table import read_table

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrajectoryRig(Rig):
    """Camera and target move as a trajectory says. The dataset is in the target's frame: cameras, Sun and Earth move
    about a target that stands still, and so do objects of the scene whose own poses are given. Where no attitude of the
    camera is given it looks at the target, the world's z upwards; where no Sun is given, `sun` says it. Test frames lie
    halfway between training frames; of a trajectory without times they are some of its rows, held out. Raises
    InputError for a value out of range."""

    views: int = 0  #: training frames, evenly over the time that is covered; 0: at the trajectory's own times
    step_s: float | None = None  #: seconds between training frames, in place of views
    test_views: int = 0  #: frames kept for testing
    #: the Sun as (azimuth, elevation), degrees, in the trajectory's world frame, where it says nothing of the Sun; ()
    #: SINGLE_SUN, of tables alone
    sun: tuple[tuple[float, float], ...] = ()
    #: quaternion that turns OpenCV camera axes (x right, y down, z forward) into those whose attitude is given, such as
    #: the body's that carries the camera; [0, 1, 0, 0]: those of OpenGL and Blender
    body_from_camera_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    #: least and greatest angle between Sun and camera as the target sees them; none: any. With either, frames beyond,
    #: and those whose Sun has its centre behind the Earth, are left out
    min_phase_deg: float | None = None
    max_phase_deg: float | None = None  #: as `min_phase_deg`

    def __post_init__(self) -> None:
        for name in ("views", "test_views"):
            expect(0 <= getattr(self, name) <= MAX_FRAMES, name, f"0 to {MAX_FRAMES:,}", getattr(self, name))
        if self.step_s is not None:
            expect(self.step_s > 0, "step_s", "seconds above 0", self.step_s)
            expect(not self.views, "views", "none beside step_s", self.views)
        expect(len(self.sun) <= 1, "sun", "one Sun at most", len(self.sun))
        for azimuth, elevation in self.sun:
            possible = math.isfinite(azimuth) and -90 <= elevation <= 90
            expect(possible, "sun", "a finite azimuth and an elevation from -90 to 90 degrees", (azimuth, elevation))
        check_phases(self.min_phase_deg, self.max_phase_deg)
        length = math.hypot(*self.body_from_camera_wxyz)
        expect(abs(length - 1) < 1e-3, "body_from_camera_wxyz", "a quaternion of length 1", length)

    @abstractmethod
    def motion(self) -> Motion:
        """What the trajectory says. Raises InputError for what it cannot be."""

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        motion = self.motion()
        if motion.sun is not None and self.sun:
            raise InputError(f"sun: expected none beside the trajectory's own, found {list(self.sun[0])}")
        if motion.sun is None and not self.sun:
            _tell_of_default_sun("the trajectory's world frame")
        return self._views_at(motion, self._times(motion), target, camera)

    def _times(self, motion: Motion) -> tuple[Array, Array]:
        """Of training and of testing."""
        own = motion.times()
        first, last = float(own[0]), float(own[-1])
        if not motion.timed:
            if self.views or self.step_s:
                name = "views" if self.views else "step_s"
                raise InputError(f"{name}: expected a trajectory with times to sample it, found one without")
            held = np.floor((np.arange(self.test_views) + 0.5) * len(own) / max(self.test_views, 1)).astype(np.int64)
            expect(self.test_views < len(own), "test_views", f"fewer than its {len(own)} rows", self.test_views)
            return np.delete(own, held), own[held]
        if self.step_s is not None:
            count = math.floor((last - first) / self.step_s * (1 + 1e-12)) + 1
            expect(count <= MAX_FRAMES, "step_s", f"a step that gives {MAX_FRAMES:,} frames at most", self.step_s)
            own = np.minimum(first + self.step_s * np.arange(count), last)
        elif self.views:
            own = np.linspace(first, last, self.views)
        if self.test_views and len(own) < 2:
            raise InputError(f"test_views: expected 0 of a trajectory of one frame, found {self.test_views}")
        between = intermediate_steps(len(own), self.test_views, closed=False)
        return own, np.interp(between, np.arange(len(own)), own)

    def _views_at(
        self, motion: Motion, times: tuple[Array, Array], target: TargetSphere, camera: CameraConfig
    ) -> Views:
        """At the times of training and of testing, without those that the limits leave out."""
        train, test = (self._views(motion, some, target, camera) for some in times)
        if (self.min_phase_deg, self.max_phase_deg) == (None, None):
            return train, test
        centre = np.zeros(3) if motion.bodies else target.centre
        kept, kept_test = ([view for view in some if self._is_kept(view, centre, target)] for some in (train, test))
        count, left = len(train) + len(test), len(kept) + len(kept_test)
        if not kept:
            field = "min_phase_deg" if self.max_phase_deg is None else "max_phase_deg"
            expected = "a training frame in range whose Sun the Earth does not hide"
            raise InputError(f"{field}: expected {expected}, found none of {len(train)}")
        if left < count:
            _log.warning(
                "trajectory: %d of %d frames are left out, by their phase angle or as the Earth hides the Sun",
                count - left,
                count,
            )
        return kept, kept_test

    def _is_kept(self, view: PlannedView, centre: Array, target: TargetSphere) -> bool:
        towards = normalize(view.camera.position - centre)
        cosine = min(max(float(view.sun.direction @ towards), -1.0), 1.0)
        most = 180.0 if self.max_phase_deg is None else self.max_phase_deg
        earth = view.earth
        if earth is None and target.earth is not None:
            earth = 1e3 * EARTH_RADIUS_KM * target.earth.distance * target.earth.direction
        lit = earth is None or visible_fraction(view.sun.direction, earth, 0.0) > 0
        return lit and (self.min_phase_deg or 0.0) <= math.degrees(math.acos(cosine)) <= most

    def _views(self, motion: Motion, times: Array, target: TargetSphere, camera: CameraConfig) -> list[PlannedView]:
        mount = rotation_from_quaternion(self.body_from_camera_wxyz)
        return planned_views(motion, seen_from_target(motion, times, mount, target.centre), camera, self.sun)


def planned_views(
    motion: Motion, moments: MotionSamples, camera: CameraConfig, sun: Sequence[tuple[float, float]]
) -> list[PlannedView]:
    """A view for each of `moments`. sun: (azimuth, elevation) in the motion's world, where it says no Sun"""
    fixed = Sun.from_angles(*(sun[0] if sun else SINGLE_SUN)).direction
    suns = moments.sun if moments.sun is not None else np.einsum("nji,j->ni", moments.turn, fixed)
    check_exposures(moments.exposure)
    return [
        PlannedView(
            camera.at(moments.world_from_camera[k]),
            Sun(suns[k]),
            float(moments.times[k]) if motion.timed else None,
            motion.epoch(float(moments.times[k])),
            None if moments.exposure is None else float(moments.exposure[k]),
            None if moments.earth is None else moments.earth[k],
            moments.turn[k],
            {number: poses[k] for number, poses in moments.objects.items()},
        )
        for k in range(len(moments.times))
    ]


def _tell_of_default_sun(frame: str) -> None:
    _log.warning("rig: no sun is given; it stands at azimuth %g, elevation %g degrees in %s", *SINGLE_SUN, frame)


def check_exposures(exposures: Array | None) -> None:
    """Raise InputError where one of them [N] is out of range."""
    least, most = EXPOSURES
    if exposures is not None and not ((exposures >= least) & (exposures <= most)).all():
        wrong = exposures[int((~((exposures >= least) & (exposures <= most))).argmax())]
        raise InputError(f"exposure: expected numbers from {least:g} to {most:g}, found {wrong:g}")


@dataclass(frozen=True)
class FileRig(TrajectoryRig):
    """A trajectory of files: a table (docs/how-to/trajectory.md), CCSDS messages, or both, which then add up."""

    path: str = ""  #: a table, .csv, .json or .parquet; this and the others are relative to the scene file
    #: CCSDS messages of what carries the camera: an OEM, an AEM or both. Quaternions of an AEM turn the axes of its
    #: REF_FRAME_A into those of REF_FRAME_B (ATTITUDE_DIR B2A: back), scalar last unless QUATERNION_TYPE is FIRST
    camera: tuple[str, ...] = ()
    target: tuple[str, ...] = ()  #: CCSDS messages of the target

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.files() or not all((*self.camera, *self.target)):
            raise InputError("path: expected a file with a trajectory, or messages of camera or target, found none")

    def located(self, folder: Path) -> Rig:
        camera, target = (tuple(str(folder / name) for name in names) for names in (self.camera, self.target))
        return replace(self, path=str(folder / self.path) if self.path else "", camera=camera, target=target)

    def files(self) -> tuple[Path, ...]:
        return tuple(Path(name) for name in (self.path, *self.camera, *self.target) if name)

    def to_json(self) -> JsonDict:
        names = {key: [Path(name).name for name in getattr(self, key)] for key in ("camera", "target")}
        return {**asdict(self), "path": Path(self.path).name, **names}

    def motion(self) -> Motion:
        parts = [read_table(Path(self.path))] if self.path else []
        if self.camera or self.target:
            of = {"camera": [Path(name) for name in self.camera], "target": [Path(name) for name in self.target]}
            has_sun = bool(self.sun) or any(part.sun is not None for part in parts)
            parts.append(motion_of(of, with_sun=not has_sun))
        motion = merge(parts)
        if not (motion.tracks.keys() & {"camera", "camera_turn", "target", "target_turn"} or motion.bodies):
            raise InputError(f"{self.path}: expected a pose of the camera or of the target, found no column of either")
        return motion


@dataclass(frozen=True, eq=False)
class PoseRig(Rig):
    """Cameras of your own, as arrays: `ss.generate("boxsat", "data", rig=ss.PoseRig(poses, sun=(40, 25)))`.

    world_from_camera: [N, 4, 4], OpenCV axes, metres
    sun: (azimuth, elevation) in degrees [2], a direction [3] or a `Sun`; or one for each pose, N of a form; None:
        (45, 35), which is logged
    test: world_from_camera [M, 4, 4] of testing
    test_sun: as `sun`, of these; None: as `sun`
    time: [N] seconds, written with the frames
    exposure: [N] display values of a radiance of 1 W m^-2 sr^-1, written with the frames

    Raises InputError for arrays of other shapes and for what no pose or Sun can be.
    """

    world_from_camera: "ArrayLike"  #: [N, 4, 4]
    sun: "ArrayLike | Sun | Sequence[Sun] | None" = None  #: one, or one for each pose
    test: "ArrayLike" = ()  #: [M, 4, 4]
    test_sun: "ArrayLike | Sun | Sequence[Sun] | None" = None  #: as `sun`
    time: "ArrayLike | None" = None  #: [N] seconds
    exposure: "ArrayLike | None" = None  #: [N]

    def __post_init__(self) -> None:
        if not len(self._poses("world_from_camera", self.world_from_camera)):
            raise InputError("world_from_camera: expected at least one pose, found none")
        for name in ("world_from_camera", "test"):
            for k, pose in enumerate(self._poses(name, getattr(self, name))):
                try:
                    CameraConfig().at(pose)
                except InputError as error:
                    raise InputError(f"{name}[{k}]: {str(error).partition(': ')[2]}") from None
        self._suns(False)
        self._suns(True)
        check_exposures(self._numbers("exposure", self.exposure))
        self._numbers("time", self.time)

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        poses, suns = self._poses("world_from_camera", self.world_from_camera), self._suns(False)
        if self.sun is None:
            _tell_of_default_sun("the world frame")
        times, exposures = self._numbers("time", self.time), self._numbers("exposure", self.exposure)
        views = [
            PlannedView(
                camera.at(pose),
                suns[k],
                None if times is None else float(times[k]),
                exposure=None if exposures is None else float(exposures[k]),
            )
            for k, pose in enumerate(poses)
        ]
        tests = zip(self._poses("test", self.test), self._suns(True), strict=True)
        return views, [PlannedView(camera.at(pose), sun) for pose, sun in tests]

    def to_json(self) -> JsonDict:
        """How many frames, and a digest of all numbers."""
        train, test = (self._poses(name, getattr(self, name)) for name in ("world_from_camera", "test"))
        suns = [sun.direction for sun in (*self._suns(False), *self._suns(True))]
        others = [self._numbers(name, getattr(self, name)) for name in ("time", "exposure")]
        arrays = [train, test, np.array(suns), *(np.array([]) if other is None else other for other in others)]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(array, "<f8").tobytes() for array in arrays))
        return {"views": len(train), "test_views": len(test), "sha256": digest.hexdigest()}

    def _poses(self, name: str, value: ArrayLike) -> Array:
        poses = _array(name, value)
        if not poses.size:
            return np.empty((0, 4, 4))
        if poses.shape == (4, 4):
            poses = poses[None]
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise InputError(f"{name}: expected an array [N, 4, 4], found one of shape {list(poses.shape)}")
        return poses

    def _suns(self, test: bool) -> list[Sun]:
        name, value = "sun", SINGLE_SUN if self.sun is None else self.sun
        count = len(self._poses("test", self.test)) if test else len(self._poses("", self.world_from_camera))
        if test and self.test_sun is not None:
            name, value = "test_sun", self.test_sun
        suns = _array(name, _directions(value))
        if suns.ndim == 1:
            sun = Sun.of(suns.tolist())
            return [sun] * count if sun is not None else []
        if test and self.test_sun is None and count:
            raise InputError("test_sun: expected Suns of the test poses, as every pose has its own, found none")
        if test and self.test_sun is None:
            return []
        if suns.ndim != 2 or suns.shape[0] != count:
            raise InputError(f"{name}: expected one Sun, or {count}, one for each pose, found {list(suns.shape)}")
        return [sun for row in suns if (sun := Sun.of(row.tolist())) is not None]

    def _numbers(self, name: str, value: ArrayLike | None) -> Array | None:
        if value is None:
            return None
        numbers = _array(name, value)
        count = len(self._poses("", self.world_from_camera))
        if numbers.shape != (count,) or not np.isfinite(numbers).all():
            raise InputError(f"{name}: expected {count} finite numbers, one for each pose, found {list(numbers.shape)}")
        return numbers


def _directions(suns: Any) -> Any:
    """Suns, where there are some, as their directions."""
    if isinstance(suns, Sun):
        return suns.direction
    if isinstance(suns, list | tuple):
        return [sun.direction if isinstance(sun, Sun) else sun for sun in suns]
    return suns


def _array(name: str, value: ArrayLike) -> Array:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of numbers, found {str(value)[:60]!r}") from None
