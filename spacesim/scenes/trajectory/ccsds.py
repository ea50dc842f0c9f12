"""Orbit and attitude ephemeris messages, KVN or XML: CCSDS 502.0-B-2 and B-3 (OEM), 504.0-B-1 and B-2 (AEM).

Of an OEM the state vectors are read (not covariances and accelerations), of an AEM quaternions. Between epochs
positions are cubic by their velocities and attitudes are slerped, whatever INTERPOLATION says (which is logged);
where segments meet in an epoch, the later one counts there.

A quaternion of an AEM takes coordinates from one frame into the other: of a rotation by phi about e, which turns the
axes of the first frame into those of the second, it is (e sin(phi/2), cos(phi/2)). As a matrix that turns vectors it
takes coordinates back, from the second frame into the first.
"""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, read_bytes
from spacesim.data.geometry import Array
from spacesim.scenes.trajectory.ephemeris import J2000_FRAMES, sun_direction
from spacesim.scenes.trajectory.epochs import read_epochs
from spacesim.scenes.trajectory.motion import DAY, Motion, merge
from spacesim.scenes.trajectory.tracks import Attitude, Direction, Track, place_of

QUATERNIONS = ("QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "QUATERNION/ANGVEL")
"""Attitude types whose lines begin with a quaternion."""

OURS = {"OEM": ("HERMITE", "3", "cubic by their velocities"), "AEM": ("LINEAR", "1", "slerped")}
"""Interpolation between epochs, its degree, and in words."""

EPOCH_ROUNDING = 1e-3  #: seconds
_log = logging.getLogger(__name__)
_VERSION = re.compile(r"CCSDS_(\w+)_VERS\s*=\s*(\S+)")
_BODY = re.compile(r"(SC_BODY|SC_BUS|INSTRUMENT|CAMERA|ACTUATOR|SENSOR)")  # frames of a spacecraft's own


@dataclass(frozen=True)
class Message:
    """An OEM or an AEM."""

    path: Path  #: the file
    kind: str  #: "OEM" or "AEM"
    frame: str  #: REF_FRAME, or the frame of an AEM that is not the spacecraft's
    time_system: str  #: TIME_SYSTEM: "UTC", "TDB", ...
    center: str  #: CENTER_NAME, "" of an AEM
    day: int  #: from whose midnight times count, a proleptic ordinal
    times: Array  #: [N] seconds
    values: Array  #: [N, 6] metres and metres a second, or [N, 4] quaternions (w, x, y, z), world_from_body
    lines: Sequence[int] = ()  #: [N] of the file, of KVN


@dataclass
class _Segment:
    meta: dict[str, str] = field(default_factory=dict)
    lines: list[list[str]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)  #: of the lines in the file, of KVN


def motion_of(messages: Mapping[str, Sequence[Path]], with_sun: bool = True) -> Motion:
    """The motion in the messages of each body, "camera" and "target". The Earth is in the centre where
    CENTER_NAME says so; with_sun: in axes of J2000 its Sun is where the Earth's orbit says.

    Raises InputError, naming the file, for what is no such message, where frames, centres or time systems differ, and
    with_sun for an orbit about another body or in other axes, and for attitudes alone.
    """
    every = [(body, read_message(path)) for body, paths in messages.items() for path in paths]
    orbits = [message for _, message in every if message.kind == "OEM"]
    first = orbits[0] if orbits else every[0][1]
    for _, other in every:
        alike = other.frame == first.frame or {other.frame, first.frame} <= set(J2000_FRAMES)
        for what, same in (
            ("frame", alike),
            ("time_system", other.time_system == first.time_system),
            ("center", other.kind == "AEM" or other.center == first.center),
        ):
            if not same:
                expected = f"the {what.replace('_', ' ')} {getattr(first, what)}, as in {first.path}"
                raise InputError(f"{other.path}: expected {expected}, found {getattr(other, what)}")
    parts = [_motion(message, body) for body, message in every]
    if orbits and first.center == "EARTH":
        day, ends = first.day, first.times[[0, -1]]
        earth = Track("position of the Earth", _distinct(ends), np.zeros((len(_distinct(ends)), 3)))
        parts.append(Motion(day, first.time_system, earth=earth))
    if with_sun:
        if not orbits or first.center != "EARTH" or first.frame not in J2000_FRAMES:
            known = f"an orbit about EARTH in {', '.join(J2000_FRAMES)}"
            content = f"an orbit about {first.center} in {first.frame}" if orbits else "attitudes alone"
            expected = f"a sun of the rig, or a table with a Sun, as it is computed for {known} only"
            raise InputError(f"{first.path}: expected {expected}, found {content}")
        day, times = first.day, first.times
        sun = Direction("direction of the Sun", times, sun_direction(day, times))
        parts.append(Motion(day, first.time_system, sun=sun))
    return merge(parts)


def _distinct(ends: Array) -> Array:
    return ends[:1] if ends[0] == ends[-1] else ends


def _motion(message: Message, body: str) -> Motion:
    if message.kind == "OEM":
        track = Track(str(message.path), message.times, message.values[:, :3], message.values[:, 3:], message.lines)
        return Motion(message.day, message.time_system, **{body: track})  # type: ignore[arg-type]
    turn = Attitude(str(message.path), message.times, message.values, message.lines)
    return Motion(message.day, message.time_system, **{f"{body}_turn": turn})  # type: ignore[arg-type]


def read_message(path: Path) -> Message:
    """The OEM or AEM in a file. Raises InputError, naming it, for anything else."""
    content = read_bytes(path, "an OEM or AEM message", MAX_LIST_BYTES)
    try:
        return _message(path, content.decode("utf-8"))
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected an OEM or AEM message in text, found something else") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _message(path: Path, text: str) -> Message:
    kind, segments = _read_xml(text) if text.lstrip("\ufeff \r\n\t").startswith("<") else _read_kvn(text)
    if not segments or not all(segment.lines for segment in segments):
        raise InputError("expected metadata and data in every segment, at least one, found none")
    is_orbit = kind == "OEM"
    known = [(_outer(one.meta)[0] if not is_orbit else _meta(one.meta, "REF_FRAME")).upper() for one in segments]
    systems = [_meta(segment.meta, "TIME_SYSTEM").upper() for segment in segments]
    centers = [_meta(segment.meta, "CENTER_NAME").upper() if is_orbit else "" for segment in segments]
    for what, names in (("frame", known), ("time system", systems), ("center", centers)):
        if len(set(names)) > 1:
            raise InputError(f"expected one {what} in all segments, found {' and '.join(sorted(set(names)))}")
    for segment in () if is_orbit else segments:  # lines of other types have other lengths
        attitude = _meta(segment.meta, "ATTITUDE_TYPE").upper()
        if attitude not in QUATERNIONS:
            raise InputError(f"ATTITUDE_TYPE: expected one of {', '.join(QUATERNIONS)}, found {attitude}")
    _tell_of_interpolation(path, kind, segments)
    day, times, values, lines = 0, np.empty(0), np.empty((0, 6 if is_orbit else 4)), list[int]()
    for number, segment in enumerate(segments):
        of_segment, seconds = read_epochs([line[0] for line in segment.lines], "epoch", segment.numbers)
        day = of_segment if number == 0 else day
        seconds = seconds + DAY * (of_segment - day)
        numbers = _numbers(segment, 7 if is_orbit else 5)
        numbers = 1e3 * numbers if is_orbit else _world_from_body(segment.meta, numbers)
        if number and seconds[0] != times[-1]:
            how = "overlap" if seconds[0] < times[-1] else "leave a gap"
            raise InputError(f"expected segments of which each begins where the last one ends, found two that {how}")
        keep = len(times) - bool(number)
        lines = [*lines[:keep], *segment.numbers]
        times, values = np.concatenate([times[:keep], seconds]), np.concatenate([values[:keep], numbers])
    _warn_of_missing_data(path, segments[-1].meta, day, times[-1])
    return Message(path, kind, known[0], systems[0], centers[0], day, times, values, lines)


def _tell_of_interpolation(path: Path, kind: str, segments: Sequence[_Segment]) -> None:
    """One warning where a message asks for another interpolation than ours."""
    method, degree, words = OURS[kind]
    for segment in segments:
        asked = segment.meta.get("INTERPOLATION" if kind == "OEM" else "INTERPOLATION_METHOD", "").upper()
        of_degree = segment.meta.get("INTERPOLATION_DEGREE", degree)
        if asked and (asked, of_degree) != (method, degree):
            _log.warning("%s: asks for %s of degree %s between epochs; they are %s", path, asked, of_degree, words)
            return


def _warn_of_missing_data(path: Path, meta: Mapping[str, str], day: int, last: float) -> None:
    """One warning where data end before the metadata say, as those of a file that was cut off do. last: seconds of the
    last epoch since midnight of `day`"""
    if stop := meta.get("STOP_TIME"):
        day_of_stop, seconds = read_epochs([stop], "STOP_TIME")
        early = DAY * (day_of_stop - day) + float(seconds[0]) - last
        if early > EPOCH_ROUNDING:
            _log.warning("%s: its data end %.3f s before its STOP_TIME, %s; is it whole?", path, early, stop)


def _read_xml(text: str) -> tuple[str, list[_Segment]]:
    """("OEM" or "AEM", segments) of a message in XML: data as KVN has them, quaternions with the scalar last."""
    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):  # entities could be without bounds
        raise InputError("expected XML without declarations of its own, found some")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"expected XML, found text that breaks off or is malformed ({error})") from None

    def leaves(item: ElementTree.Element) -> dict[str, str]:
        return {_local(leaf): (leaf.text or "").strip() for leaf in item.iter() if not len(leaf)}

    kinds = [_local(item).upper() for item in root.iter() if _local(item) in ("oem", "aem")]
    if len(kinds) != 1:
        raise InputError(f"expected one OEM or AEM in XML, found {len(kinds)}")
    of_state, names = {
        "OEM": ("stateVector", ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")),
        "AEM": ("attitudeState", ("EPOCH", "Q1", "Q2", "Q3", "QC")),
    }[kinds[0]]
    segments = []
    for item in (item for item in root.iter() if _local(item) == "segment"):
        meta = next((leaves(one) for one in item if _local(one) == "metadata"), {})
        states = [leaves(one) for one in item.iter() if _local(one) == of_state]
        lines = [[state[name] for name in names if name in state] for state in states]
        segments.append(_Segment({**meta, "QUATERNION_TYPE": "LAST"}, lines))
    return kinds[0], segments


def _local(item: ElementTree.Element) -> str:
    """The name of an element without its namespace."""
    return str(item.tag).rpartition("}")[2]


def _read_kvn(text: str) -> tuple[str, list[_Segment]]:
    version = _VERSION.search(text)
    if version is None or version[1] not in ("OEM", "AEM"):
        header = version[0] if version else "neither"
        raise InputError(f"expected CCSDS_OEM_VERS or CCSDS_AEM_VERS, found {header}")
    return version[1], list(_segments(text))


def _segments(text: str) -> Iterator[_Segment]:
    """Segments of a message in KVN; comments and covariances are passed over."""
    segment: _Segment | None = None
    place = "header"
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0] == "COMMENT":
            continue
        if words[0] == "META_START":
            if segment is not None:
                yield segment
            segment, place = _Segment(), "meta"
        elif words[0] in ("META_STOP", "DATA_START", "COVARIANCE_STOP"):
            place = "data"
        elif words[0] in ("DATA_STOP", "COVARIANCE_START"):
            place = "aside"
        elif place == "meta" and segment is not None and "=" in line:
            key, _, value = line.partition("=")
            segment.meta[key.strip()] = value.strip()
        elif place == "data" and segment is not None:
            segment.lines.append(words)
            segment.numbers.append(number)
    if segment is not None:
        yield segment


def _meta(meta: Mapping[str, str], key: str) -> str:
    if not meta.get(key):
        raise InputError(f"{key}: expected it in the metadata of every segment, found none")
    return meta[key]


def _outer(meta: Mapping[str, str]) -> tuple[str, bool]:
    """(the frame that is not the spacecraft's own, whether it is REF_FRAME_B)."""
    a, b = _meta(meta, "REF_FRAME_A"), _meta(meta, "REF_FRAME_B")
    is_b = bool(_BODY.match(a.upper())) and not _BODY.match(b.upper())
    return (b if is_b else a), is_b


def _world_from_body(meta: Mapping[str, str], numbers: Array) -> Array:
    """[N, 4] quaternions (w, x, y, z) of an AEM's [N, 4]. Version 2 has A2B and LAST for all."""
    order, direction = meta.get("QUATERNION_TYPE", "LAST").upper(), meta.get("ATTITUDE_DIR", "A2B").upper()
    for key, value, allowed in (
        ("QUATERNION_TYPE", order, ("FIRST", "LAST")),
        ("ATTITUDE_DIR", direction, ("A2B", "B2A")),
    ):
        if value not in allowed:
            raise InputError(f"{key}: expected {' or '.join(allowed)}, found {value}")
    q = numbers if order == "FIRST" else np.roll(numbers, 1, axis=1)
    _, outer_is_b = _outer(meta)
    return q * (1, -1, -1, -1) if (direction == "B2A") != outer_is_b else q


def _numbers(segment: _Segment, count: int) -> Array:
    """[N, count - 1] of the data lines, whose first word is the epoch."""
    rows = []
    for row, line in enumerate(segment.lines):
        if len(line) < count:
            found = f"{' '.join(line)[:80]!r} in {place_of(row, segment.numbers)}"
            raise InputError(f"expected an epoch and {count - 1} numbers, found {found}")
        try:
            rows.append([float(word) for word in line[1:count]])
        except ValueError as error:
            place = place_of(row, segment.numbers)
            raise InputError(f"expected numbers in {place}, found another word ({error})") from None
    return np.array(rows)
