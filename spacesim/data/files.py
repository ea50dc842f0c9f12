"""Files in and out: read only where they are plain files that fit into memory, written whole or not at all."""

import errno
import json
import os
import stat
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Union

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError, WorkError

JsonValue = Union[None, bool, int, float, str, Sequence["JsonValue"], Mapping[str, "JsonValue"]]  # noqa: UP007
"""What JSON can hold: what is written is checked against it."""
JsonDict = dict[str, Any]
"""An object of JSON as `read_json` gives it: its values are whatever the file holds, until a reader has looked."""
JsonMapping = Mapping[str, Any]
"""The same, only read."""

MAX_JSON_BYTES = 1 << 25  #: bytes of a record
MAX_LIST_BYTES = 1 << 30  #: bytes of a record with an entry for each frame, of a million of them
PARSED = 30  #: bytes of memory that a byte of JSON takes while it is read, at most; 26 were seen

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a disk"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
)


def as_path(value: object, name: str, expected: str = "a path") -> Path:
    """The path that an argument is, by its name. Raises InputError for what is none."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name}: expected {expected}, found {value!r:.60}")
    if "\0" in os.fspath(value):
        raise InputError(f"{name}: expected a path without a null character, found {value!r:.60}")
    return Path(value)


def open_regular(path: Path, expected: str = "a file") -> BinaryIO:
    """Open a plain file for reading; links are followed.

    expected: what should be there, for the message. Raises InputError where there is none, where it cannot be read, and
    for devices, pipes and the like, which may never end.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: expected {expected}, found none") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null in it
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: expected {expected}, found one that cannot be read ({reason})") from None
    kind = _kind_of(os.fstat(descriptor).st_mode)
    if kind is not None:
        os.close(descriptor)
        raise InputError(f"{path}: expected {expected}, found {kind}")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, expected: str = "a file", most: int | None = None) -> bytes:
    """Content of a plain file of at most `most` bytes. Raises InputError as `open_regular` does and for a larger one,
    MemoryError for one that does not fit into memory."""
    with open_regular(path, expected) as file:
        size = os.fstat(file.fileno()).st_size
        if most is not None and size > most:
            raise InputError(f"{path}: expected {expected} of at most {most:,} bytes, found {size:,}")
        check_memory(size, f"{path}: reading it")
        try:
            # files of the system claim to be empty
            return file.read(size) if size else file.read(most or MAX_LIST_BYTES)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Write `content` to `path` so that a reader sees the old file or the new one, never a part.

    Several processes and machines may write the same file: the last one counts. A link stays and the file that it leads
    to is replaced; devices such as /dev/null and pipes that have a reader are written into. durable: the content is on
    the disk before the file has its name; without that a process may die at any moment, but not the machine (a power
    cut can leave a file empty or cut off). Raises InputError where `path` cannot be written or is a folder, a disk or a
    socket, WorkError where the disk is full.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        mode = _mode_of(path)
        if mode is not None and not stat.S_ISREG(mode):
            _write_into(path, mode, content)
            return
        target = Path(os.path.realpath(path))
        temporary = target.parent / f".{uuid.uuid4().hex}.part"
        with temporary.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        if mode is not None:
            os.chmod(temporary, stat.S_IMODE(mode))
        os.replace(temporary, target)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise WorkError(
                f"{path}: the disk is full; free space and run again, resuming what can be resumed"
            ) from error
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        if temporary is not None:
            with suppress(OSError):  # of a file system that is read-only: what was raised says so
                temporary.unlink(missing_ok=True)


def _write_into(path: Path, mode: int, content: bytes) -> None:
    """Write into a device of characters or a pipe, which stay what they are."""
    if not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):
        raise InputError(f"{path}: expected a file to write, found {_kind_of(mode)}")
    try:  # a pipe without a reader would block
        descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise InputError(f"{path}: expected a pipe with a reader, found none") from None
    if hasattr(os, "set_blocking"):
        os.set_blocking(descriptor, True)
    with os.fdopen(descriptor, "wb", buffering=0) as file:
        rest = memoryview(content)
        while rest:
            rest = rest[file.write(rest) or 0 :]


def _mode_of(path: Path) -> int | None:
    """Type and permissions of what is at `path`, links followed; None of nothing."""
    try:
        return os.stat(path).st_mode
    except FileNotFoundError:
        return None


def _kind_of(mode: int) -> str | None:
    """What is no plain file, in words; None of one."""
    if stat.S_ISREG(mode):
        return None
    return next((words for check, words in _KINDS if check(mode)), "something else")


def remove_leftovers(folder: Path) -> None:
    """Remove what killed calls of `write_bytes` have left in and below `folder`, where nothing else writes now."""
    for leftover in Path(folder).glob("**/.*.part"):
        with suppress(OSError):
            leftover.unlink(missing_ok=True)


def flush_disks() -> None:
    """Wait until the disks hold all that was written, where the system can do that."""
    if hasattr(os, "sync"):
        os.sync()


def existing_parent(path: Path) -> Path:
    """The folder that `path` is, or the nearest one above that exists."""
    path = Path(path).absolute()
    return next(folder for folder in (path, *path.parents) if folder.is_dir())


def holds_files(folder: Path) -> bool:
    """There is something visible in a folder; what an interrupted `write_bytes` leaves behind is hidden."""
    try:
        return folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error})") from None


def write_json(path: Path, value: JsonValue) -> None:
    """Write `value` as indented JSON (no NaN: a missing number is null)."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: JsonValue) -> bytes:
    """What `write_json` writes."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def read_json(path: Path, most: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file of at most `most` bytes; InputError says what is wrong with it. Raises MemoryError where its
    values do not fit into memory."""
    path = Path(path)
    content = read_bytes(path, "a JSON file", most)
    check_memory(PARSED * len(content), f"{path}: reading it")
    try:
        return json.loads(content.decode("utf-8-sig"))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # malformed, no UTF-8, endless numbers or brackets
        raise InputError(f"{path}: expected JSON, found text that breaks off or is malformed ({error})") from None


def first_difference(old: JsonDict, new: JsonDict, within: str = "") -> tuple[str, object, object] | None:
    """(key, old value, new value) of the first key that one has otherwise; "light.field.width" within others."""
    for key in {**new, **old}:
        was, value = old.get(key), new.get(key)
        if isinstance(was, dict) and isinstance(value, dict):
            difference = first_difference(was, value, f"{within}{key}.")
            if difference is not None:
                return difference
        elif was != value:
            return f"{within}{key}", was, value
    return None
