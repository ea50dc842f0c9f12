"""What is known at some times, and its values between them."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array

AMBIGUOUS_DEG = 120.0
"""Turn between two rows beyond which the shorter way may well be the wrong one."""

UNIT = 1e-3
"""By how much the length of a quaternion may differ from 1: rounding to three digits makes no more."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Track:
    """Numbers at times that grow, linear between them, or cubic where their rates are known (Hermite).

    name: as errors call it. Raises InputError for times that do not grow and for numbers that are not finite.
    """

    name: str
    times: Array  #: [N] seconds
    values: Array  #: [N, C]
    rates: Array | None = None  #: [N, C] a second
    lines: Sequence[int] = ()  #: [N] where they stand in a file, for errors; (): rows are counted

    def __post_init__(self) -> None:
        check_times(self)
        for values in (self.values, self.rates):
            if values is not None and not np.isfinite(values).all():
                row = int((~np.isfinite(values)).any(axis=1).argmax())
                found = f"{values[row].tolist()} in {place_of(row, self.lines)}"
                raise InputError(f"{self.name}: expected finite numbers, found {found}")

    def at(self, times: Array) -> Array:
        """[M, C] values at `times` [M]. Raises InputError for a time that is before the first or after the last."""
        check_covered(self, times)
        if len(self.times) == 1:
            return np.repeat(self.values, len(times), axis=0)
        if self.rates is not None:
            from scipy.interpolate import CubicHermiteSpline  # 0.2 s, that most commands need not wait for

            spline: Array = CubicHermiteSpline(self.times, self.values, self.rates)(times)
            return spline
        return np.stack([np.interp(times, self.times, column) for column in self.values.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Direction(Track):
    """Unit vectors at times that grow, at an even rate along a great circle, the shorter way, between them."""

    def at(self, times: Array) -> Array:
        """[M, 3] unit vectors at `times` [M]. Raises InputError for a time before the first or after the last."""
        check_covered(self, times)
        if len(self.times) == 1:
            return np.repeat(self.values, len(times), axis=0)
        start, end = self.values[:-1], self.values[1:]
        across = np.cross(start, end)
        sines, cosines = np.linalg.norm(across, axis=1), (start * end).sum(axis=1)
        angles = np.arctan2(sines, cosines)
        _warn_of_guesses(self, times, float(np.degrees(angles.max())))
        nearest = np.eye(3)[np.abs(start).argmin(axis=1)]  # an axis that is not along it: opposites have no plane
        axes = np.where((sines > 1e-9)[:, None], across, np.cross(start, nearest))
        ahead = np.cross(axes / np.linalg.norm(axes, axis=1, keepdims=True), start)
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(angles) - 1)
        turn = angles[k] * (times - self.times[k]) / (self.times[k + 1] - self.times[k])
        values: Array = np.cos(turn)[:, None] * start[k] + np.sin(turn)[:, None] * ahead[k]
        return values


@dataclass(frozen=True, eq=False)
class Attitude:
    """Rotations at times that grow, at an even rate about one axis, the shorter way, between them (slerp: K. Shoemake,
    "Animating rotation with quaternion curves", SIGGRAPH 1985).

    Raises InputError for times that do not grow and for quaternions whose length is not 1.
    """

    name: str  #: whose it is, for messages
    times: Array  #: [N] seconds
    quaternions: Array  #: [N, 4] (w, x, y, z), to the world's axes
    lines: Sequence[int] = ()  #: as a `Track`'s

    def __post_init__(self) -> None:
        check_times(self)
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(self.quaternions, axis=1)
        wrong = ~(np.abs(lengths - 1) <= UNIT)
        if wrong.any():
            row = int(wrong.argmax())
            found = f"one of {lengths[row]:.6g} in {place_of(row, self.lines)}"
            raise InputError(f"{self.name}: expected quaternions of length 1, found {found}")

    def at(self, times: Array) -> Array:
        """[M, 3, 3] rotations at `times` [M]. Raises InputError for a time before the first or after the last."""
        check_covered(self, times)
        from scipy.spatial.transform import Rotation, Slerp

        rotations = Rotation.from_quat(self.quaternions[:, [1, 2, 3, 0]])
        if len(self.times) == 1:
            return np.repeat(rotations.as_matrix(), len(times), axis=0)
        _warn_of_guesses(self, times, float(np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude().max())))
        turned: Array = Slerp(self.times, rotations)(times).as_matrix()
        return turned


def _warn_of_guesses(track: Track | Attitude, times: Array, largest: float) -> None:
    """Log where one of `times` [M] may lie on a turn whose shorter way may be the wrong one. largest: degrees"""
    if largest > AMBIGUOUS_DEG and not np.isin(times, track.times).all():
        _log.warning("%s: turns by %.0f degrees between two rows; which way is a guess", track.name, largest)


def place_of(row: int, lines: Sequence[int]) -> str:
    """What errors call a row, counted from 0: its line, where `lines` [N] are known, else its number from 1."""
    return f"line {lines[row]}" if lines else f"row {row + 1}"


def check_times(track: Track | Attitude) -> None:
    """Raise InputError unless its times are finite and grow."""
    times, name, lines = track.times, track.name, track.lines
    if not len(times):
        raise InputError(f"{name}: expected at least one time, found none")
    bad = ~np.isfinite(times)
    if bad.any():
        row = int(bad.argmax())
        raise InputError(f"{name}: expected finite times, found {times[row]} in {place_of(row, lines)}")
    steps = np.diff(times)
    if (steps <= 0).any():
        row = int((steps <= 0).argmax()) + 1
        how = "repeats that of" if steps[row - 1] == 0 else "is before"
        here, before = place_of(row, lines), place_of(row - 1, lines)
        raise InputError(f"{name}: expected times that grow, found in {here} one that {how} {before}")


def check_covered(track: Track | Attitude, times: Array) -> None:
    """Raise InputError where one of `times` [M] is before the track's first or after its last."""
    first, last = float(track.times[0]), float(track.times[-1])
    if len(times) and not (first <= times.min() and times.max() <= last):
        out = times.min() if times.min() < first else times.max()
        raise InputError(f"{track.name}: expected times from {first:.10g} to {last:.10g} s, found {out:.10g} s")
