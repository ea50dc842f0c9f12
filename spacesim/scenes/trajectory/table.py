"""A trajectory as a table: CSV, JSON or Parquet. Each column's name says what it is, in which unit and direction.

    time_s | time_utc                                            seconds, or ISO 8601
    camera_x_m camera_y_m camera_z_m                             position, world frame; _km for kilometres
    camera_vx_m_s camera_vy_m_s camera_vz_m_s                    velocity; _km_s
    world_from_camera_qw world_from_camera_qx ..._qy ..._qz      attitude, a quaternion; or camera_from_world_qw ...
    target_...  world_from_target_q... | target_from_world_q...  the same of the target
    target2_...  world_from_target2_q... | target2_from_world_q...  of the scene's object 2, if it moves
    earth_x_m earth_y_m earth_z_m                                position of the Earth's centre; _km
    sun_x sun_y sun_z                                            direction towards the Sun, of any length
    exposure                                                     display value of a radiance of 1 W m^-2 sr^-1

Lines of CSV that begin with # are passed over. JSON is a list of rows, {"column": value, ...} each, or an object of
columns, {"column": [values], ...}.
"""

import csv
import io
import json
import logging
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, PARSED, read_bytes
from spacesim.data.geometry import Array, normalize
from spacesim.data.records import SUN_LENGTHS, SUN_WORDS
from spacesim.data.structure import did_you_mean
from spacesim.scenes.trajectory.epochs import read_epochs
from spacesim.scenes.trajectory.motion import Motion
from spacesim.scenes.trajectory.tracks import Attitude, Direction, Track

METRES = {"m": 1.0, "km": 1e3}
SUFFIXES = (".csv", ".json", ".parquet")
_BODIES = ("camera", "target", "earth")
_TURNS = ("world_from_camera", "camera_from_world", "world_from_target", "target_from_world")
_OURS = re.compile(r"(time|camera|target|earth|sun|exposure|world_from)(_|\d|$)")
_TARGETS = re.compile(r"(?:world_from_)?(target(\d+))_")
Columns = Mapping[str, Sequence[object]]  #: of a table, by name

_log = logging.getLogger(__name__)


def _groups(others: Sequence[str] = ()) -> dict[tuple[str, ...], str]:
    """{columns that belong together: what they are, in words}. others: objects beside the target, "target2", ..."""
    groups: dict[tuple[str, ...], str] = {("time_s",): "time", ("time_utc",): "time", ("exposure",): "exposure"}
    groups[("sun_x", "sun_y", "sun_z")] = "sun"
    for body in (*_BODIES, *others):
        for unit in METRES:
            groups[tuple(f"{body}_{axis}_{unit}" for axis in "xyz")] = f"{body} position"
            groups[tuple(f"{body}_v{axis}_{unit}_s" for axis in "xyz")] = f"{body} velocity"
    turns = (*_TURNS, *(turn for name in others for turn in (f"world_from_{name}", f"{name}_from_world")))
    return groups | {tuple(f"{turn}_q{part}" for part in "wxyz"): turn for turn in turns}


def read_table(path: Path) -> Motion:
    """The motion in a table. Raises InputError, naming file, column and row, for what it cannot be."""
    columns = _read_columns(path)
    try:
        return _motion(path, columns)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _motion(path: Path, columns: Columns) -> Motion:
    others = _other_targets(columns)
    groups = _groups(others)
    _check_names(path, columns, groups)
    present = {what: names for names, what in groups.items() if any(name in columns for name in names)}
    count = len(next(iter(columns.values()), ()))
    day, times = None, np.arange(count, dtype=np.float64)
    if "time_utc" in columns:
        day, times = read_epochs(columns["time_utc"], "time_utc")
    elif "time_s" in columns:
        times = _numbers(columns, "time_s")
    tracks: dict[str, Track | Attitude] = {}
    for body in (*_BODIES, *others):
        if f"{body} position" in present:
            place = _vectors(columns, present[f"{body} position"])
            speed = present.get(f"{body} velocity")
            rates = None if speed is None else _vectors(columns, speed)
            tracks[body] = Track(f"{body} position", times, place, rates)
        elif f"{body} velocity" in present:
            raise InputError(f"{body}_x_m: expected a position beside the velocity, found none")
        for turn in (f"world_from_{body}", f"{body}_from_world"):
            if turn in present:
                q = np.stack([_numbers(columns, name) for name in present[turn]], axis=-1)
                q = q if turn.startswith("world") else q * (1, -1, -1, -1)
                tracks[f"{body}_turn"] = Attitude(turn, times, q)
        if body in others and body not in tracks:
            raise InputError(f"{body}_x_m: expected a position beside its attitude, found none")
    if "sun" in present:
        sun = np.stack([_numbers(columns, name) for name in present["sun"]], axis=-1)
        least, most = SUN_LENGTHS
        largest = np.abs(sun).max(axis=1)
        wrong = ~((largest >= least) & (largest <= most))  # which nan is not
        if wrong.any():
            row = int(wrong.argmax())
            raise InputError(f"sun_x: expected {SUN_WORDS}, found {sun[row].tolist()} in row {row + 1}")
        tracks["sun"] = Direction("sun direction", times, normalize(sun))
    if "exposure" in present:
        exposure = _numbers(columns, "exposure")
        if not (exposure > 0).all():
            row = int((~(exposure > 0)).argmax())
            raise InputError(f"exposure: expected a number above 0, found {exposure[row]:g} in row {row + 1}")
        tracks["exposure"] = Track("exposure", times, exposure[:, None])
    bodies = {name: tracks.pop(name) for name in list(tracks) if name.removesuffix("_turn") in others}
    timed = "time_s" in columns or "time_utc" in columns
    return Motion(day, timed=timed, bodies=bodies, **tracks)  # type: ignore[arg-type]


def _other_targets(columns: Columns) -> list[str]:
    """Objects beside the target that have columns, "target2" for the scene's second, in the order of their numbers.
    Raises InputError for a number below 2."""
    matches = {int(match[2]): match for name in columns if (match := _TARGETS.match(name))}
    for number, match in matches.items():
        if number < 2 or match[1] != f"target{number}":
            raise InputError(f"{match[0]}: expected target, or target2 for the scene's second object, found {match[1]}")
    return [f"target{number}" for number in sorted(matches)]


def _check_names(path: Path, columns: Columns, groups: Mapping[tuple[str, ...], str]) -> None:
    """Raise InputError for a column that looks like one of ours and is none, for a part of a vector, for two that say
    the same, and for columns of different lengths."""
    names = [name for group in groups for name in group]
    others = []
    for name in columns:
        if name in names:
            continue
        if unit := re.fullmatch(rf"((?:{'|'.join(_BODIES)}|target\d+)_v?[xyz])(?:_(\w+))?", name):
            units = "m or km" if "_v" not in unit[1] else "m_s or km_s"
            raise InputError(f"{name}: expected a unit of {units} at its end, found {unit[2] or 'none'}")
        if _OURS.match(name) or "_from_world" in name:
            raise InputError(f"{name}: expected a column that is known, found this{did_you_mean(name, names)}")
        others.append(name)
    first_column: dict[str, str] = {}
    for group, what in groups.items():
        present = [name for name in group if name in columns]
        if present and len(present) < len(group):
            missing = next(name for name in group if name not in columns)
            found = get_close_matches(missing, others, 1) or ["none"]
            raise InputError(f"{missing}: expected a column beside {present[0]}, found {found[0]}")
        meaning = f"attitude of the {what.replace('world', '').replace('_from_', '')}" if "_from_" in what else what
        if present and meaning in first_column:
            raise InputError(f"{present[0]}: expected one way to say the {meaning}, found {first_column[meaning]} too")
        if present:
            first_column[meaning] = present[0]
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise InputError(f"{path}: expected columns of one length, found {min(lengths)} and {max(lengths)}")
    if others:
        _log.info("%s: columns that mean nothing here: %s", path, ", ".join(others)[:200])


def _vectors(columns: Columns, names: Sequence[str]) -> Array:
    """[N, 3] metres, or metres a second."""
    unit = names[0].removesuffix("_s").rpartition("_")[2]
    return METRES[unit] * np.stack([_numbers(columns, name) for name in names], axis=-1)


def _numbers(columns: Columns, name: str) -> Array:
    """[N] of a column."""
    values = columns[name]
    try:
        numbers = np.asarray(values, dtype=np.float64)
        if numbers.shape == (len(values),) and not any(isinstance(value, bool) for value in values):
            return numbers
    except (TypeError, ValueError, OverflowError):
        pass
    row = next((i for i, value in enumerate(values) if not _is_number(value)), 0)
    raise InputError(f"{name}: expected a number, found {str(values[row])[:40]!r} in row {row + 1}")


def _is_number(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False
    return not isinstance(value, bool)


def _read_columns(path: Path) -> Columns:
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise InputError(f"{path}: expected a table, {', '.join(SUFFIXES)}, found {kind or 'no suffix'}")
    content = read_bytes(path, "a trajectory", MAX_LIST_BYTES)
    check_memory(PARSED * len(content), f"{path}: reading it")
    columns = {".csv": _csv, ".json": _json, ".parquet": _parquet}[kind](path, content)
    if not columns or not len(next(iter(columns.values()))):
        raise InputError(f"{path}: expected a header and at least one row, found {'no row' if columns else 'nothing'}")
    return columns


def _csv(path: Path, content: bytes) -> Columns:
    try:
        text = content.decode("utf-8-sig")
        lines = [line for line in io.StringIO(text, newline="") if line.strip() and not line.lstrip().startswith("#")]
        first = lines[0] if lines else ""
        other = max(";|\t", key=first.count)
        if first.count(other) > first.count(","):
            raise InputError(f"{path}: expected commas between columns, found {other!r}")
        rows = list(csv.reader(lines, skipinitialspace=True, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected CSV in UTF-8, found something else ({error})") from None
    header = [name.strip() for name in rows[0]] if rows else []
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: expected each column once, found {twice!r} twice")
    for number, row in enumerate(rows[1:], start=1):
        if len(row) != len(header):
            raise InputError(f"{path}: expected {len(header)} values in row {number}, found {len(row)}")
    return (
        dict(zip(header, zip(*rows[1:], strict=True), strict=True)) if len(rows) > 1 else {name: () for name in header}
    )


def _json(path: Path, content: bytes) -> Columns:
    def once(pairs: list[tuple[str, object]]) -> dict[str, object]:
        columns: dict[str, object] = {}
        for name, value in pairs:
            if name in columns:
                raise InputError(f"{path}: expected each column once, found {name!r} twice")
            columns[name] = value
        return columns

    try:
        value = json.loads(content.decode("utf-8"), object_pairs_hook=once)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON, found text that breaks off or is malformed ({error})") from None
    if isinstance(value, list) and all(isinstance(row, dict) for row in value):
        names = list(value[0]) if value else []
        for number, row in enumerate(value, start=1):
            if row.keys() != set(names):
                odd = sorted(row.keys() ^ set(names))[0]
                raise InputError(f"{path}: expected the same columns in every row, found {odd!r} not in all ({number})")
        return {name: [row[name] for row in value] for name in names}
    if isinstance(value, dict) and all(isinstance(values, list) for values in value.values()):
        return value
    raise InputError(f"{path}: expected a list of rows or an object of columns, found something else")


def _parquet(path: Path, content: bytes) -> Columns:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            f"{path}: expected the package pyarrow for Parquet, found none; type: pip install 'spacesim[parquet]'"
        ) from None
    try:
        table = pyarrow.parquet.read_table(pyarrow.BufferReader(content))
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        why = str(error).splitlines()[0][:100]
        raise InputError(f"{path}: expected Parquet, found something else ({why})") from None
    return {name: table.column(name).to_pylist() for name in table.column_names}
