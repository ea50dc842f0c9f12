"""Times of the calendar: ISO 8601, as tables and CCSDS messages write them."""

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.scenes.trajectory.tracks import place_of

_EPOCH = re.compile(r"(\d{4})-(?:(\d{2})-(\d{2})|(\d{3}))[T ](\d{2}):(\d{2}):(\d{2}(?:\.\d*)?)(?:Z|\+00:00)?")


def read_epochs(texts: Sequence[object], name: str, lines: Sequence[int] = ()) -> tuple[int, Array]:
    """(day of the first, a proleptic ordinal; seconds [N] since its midnight) of epochs such as 2030-03-01T12:00:00.25
    or 2030-060T12:00:00.

    A day has 86,400 seconds: a leap second between two epochs is not counted. name: for errors; lines: [N] where the
    texts stand in a file, for errors. Raises InputError for a text that is no epoch.
    """
    parsed = [_read_epoch(str(text).strip(), name, row, lines) for row, text in enumerate(texts)]
    if not parsed:
        raise InputError(f"{name}: expected at least one epoch, found none")
    day = parsed[0][0]
    return day, np.array([86_400.0 * (days - day) + seconds for days, seconds in parsed])


def _read_epoch(text: str, name: str, row: int, lines: Sequence[int]) -> tuple[int, float]:
    """(day, seconds since its midnight)."""
    match = _EPOCH.fullmatch(text)
    try:
        if match is None:
            raise ValueError
        year, month, day, of_year, hours, minutes, seconds = match.groups()
        if of_year is None:
            ordinal = date(int(year), int(month), int(day)).toordinal()
        else:
            ordinal = date(int(year), 1, 1).toordinal() + int(of_year) - 1
            if date.fromordinal(ordinal).year != int(year):
                raise ValueError
        if int(hours) > 23 or int(minutes) > 59 or float(seconds) >= 61:  # 60: within a leap second
            raise ValueError
    except (ValueError, OverflowError):
        expected = "an epoch such as 2030-03-01T12:00:00.000"
        raise InputError(f"{name}: expected {expected}, found {text[:60]!r} in {place_of(row, lines)}") from None
    return ordinal, 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds)
