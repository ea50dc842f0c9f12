"""Trajectories of SPICE kernels, through spiceypy, which calls NAIF's toolkit."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict, open_regular
from spacesim.data.geometry import Array, quaternion_from_rotation
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.rig import Rig, TargetSphere, Views
from spacesim.scenes.trajectory.epochs import read_epochs
from spacesim.scenes.trajectory.motion import Motion
from spacesim.scenes.trajectory.rig import TrajectoryRig
from spacesim.scenes.trajectory.tracks import Attitude, Track

T = TypeVar("T")


@dataclass(frozen=True)
class SpiceRig(TrajectoryRig):
    """Camera, target, Sun and Earth where SPICE kernels say, at even epochs from start to stop; states are geometric,
    without light time and aberration. The Sun's distance is that of `[sun]`. Where there are neither views nor step_s:
    100 views."""

    kernels: tuple[str, ...] = ()  #: files, in the order in which they are loaded; relative to the scene file
    start: str = ""  #: epoch as SPICE reads it: "2030-03-01T12:00:00" is UTC
    stop: str = ""  #: as start
    camera: str = ""  #: name or number of the body that carries the camera
    camera_frame: str = ""  #: whose axes the camera's are; "": it looks at the target
    target: str = ""  #: name or number
    target_frame: str = ""  #: of the target's body, which the scene is in; "": frame
    frame: str = "J2000"  #: the world, in which stars stand still

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kernels or not all(self.kernels):
            raise InputError(f"kernels: expected names of files, found {list(self.kernels)}")
        for name in ("start", "stop", "camera", "target", "frame"):
            expect(bool(getattr(self, name)), name, "a name" if len(name) > 5 else "an epoch", getattr(self, name))

    def located(self, folder: Path) -> Rig:
        return replace(self, kernels=tuple(str(folder / name) for name in self.kernels))

    def files(self) -> tuple[Path, ...]:
        return tuple(Path(name) for name in self.kernels)

    def to_json(self) -> JsonDict:
        return {**asdict(self), "kernels": [Path(name).name for name in self.kernels]}

    def motion(self) -> Motion:
        """At the ends alone."""
        with _loaded(self.kernels) as spice:
            return self._motion(spice, np.empty(0))

    def views_of(self, target: TargetSphere, camera: CameraConfig, seed: int) -> Views:
        rig = self if self.views or self.step_s else replace(self, views=100)
        with _loaded(self.kernels) as spice:
            train, test = rig._times(self._motion(spice, np.empty(0)))
            motion = self._motion(spice, np.concatenate([train, test]))  # exactly there: nothing is interpolated
        return self._views_at(motion, (train, test), target, camera)

    def _motion(self, spice: ModuleType, times: Array) -> Motion:
        """What the kernels say at `times` [M] and at both ends, in seconds since midnight before the start."""
        first, last = (_answer(name, spice.str2et, getattr(self, name)) for name in ("start", "stop"))
        expect(last > first, "stop", f"an epoch after start, {self.start}", self.stop)
        day, (begin,) = read_epochs([spice.et2utc(first, "ISOC", 6)], "start")
        times = np.unique(np.concatenate([times, [begin, begin + last - first]]))
        epochs = first + (times - begin)

        def positions(name: str, body: str) -> Track:
            rows = [_answer(name, spice.spkpos, body, et, self.frame, "NONE", self.target)[0] for et in epochs]
            return Track(f"{name} {body}", times, 1e3 * np.array(rows))

        def turns(name: str, frame: str) -> Attitude | None:
            if not frame:
                return None
            rows = [_answer(name, spice.pxform, frame, self.frame, et) for et in epochs]
            return Attitude(f"{name} {frame}", times, np.stack([quaternion_from_rotation(turn) for turn in rows]))

        def tells_earth(et: float) -> bool:
            try:
                _answer("earth", spice.spkpos, "EARTH", et, self.frame, "NONE", self.target)
            except InputError:
                return False
            return True

        # Kernels of a mission to elsewhere may not have it. Those that have it at some epoch must have it at all.
        has_earth = any(tells_earth(et) for et in epochs)

        return Motion(
            day,
            camera=positions("camera", self.camera),
            camera_turn=turns("camera_frame", self.camera_frame),
            target_turn=turns("target_frame", self.target_frame),
            earth=positions("earth", "EARTH") if has_earth else None,
            sun=None if self.sun else positions("sun", "SUN"),
        )


@contextmanager
def _loaded(kernels: tuple[str, ...]) -> Iterator[ModuleType]:
    """spiceypy with these kernels, beside those that are loaded already. Raises InputError where the package or a
    file is missing or broken."""
    try:
        import spiceypy
    except ImportError:
        expected = "the package spiceypy, found none; type: pip install 'spacesim[spice]'"
        raise InputError(f"kernels: expected {expected}") from None
    with ExitStack() as stack:
        for name in kernels:
            open_regular(Path(name), "a SPICE kernel").close()
            _answer(f"kernels: {name}", spiceypy.furnsh, name)
            stack.callback(spiceypy.unload, name)
        yield spiceypy


def _answer(name: str, ask: Callable[..., T], *arguments: object) -> T:
    """What SPICE answers; its error as one sentence, in the name of a field."""
    from spiceypy.utils.exceptions import SpiceyError

    try:
        return ask(*arguments)
    except SpiceyError as error:
        long = " ".join(str(getattr(error, "long", "") or error).split())
        short = str(getattr(error, "short", "") or "SPICE(ERROR)").strip()
        raise InputError(f"{name}: expected kernels that contain it, found {short}: {long[:300]}") from None
