"""Files that appear complete or not at all: written aside, flushed, renamed."""

import errno
import json
import os
import uuid
from pathlib import Path
from typing import Any

from spacesim.data.errors import InputError, WorkError


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Write `content` to `path` so that a reader sees the old file or the new one, never a part.

    Several processes and machines may write the same file: the last one counts. durable: the content is on the disk
    before the file has its name; without that a process may die at any moment, but not the machine (a power cut can
    leave a file empty or cut off). Raises InputError where the folder cannot be written, WorkError where the disk is
    full.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{path.name}.{uuid.uuid4().hex}.part"
        with temporary.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise WorkError(
                f"{path}: the disk is full; free space and run again, with --resume if the command has it"
            ) from error
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed calls of `write_bytes` have left in and below `folder`, where nothing else writes now."""
    for leftover in Path(folder).glob("**/.*.part"):
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
    return folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON (no NaN: a missing number is null)."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file; InputError says what is wrong with it."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: expected a JSON file, found none") from None
    except (ValueError, RecursionError) as error:  # malformed, no UTF-8, endless numbers or brackets
        raise InputError(f"{path}: expected JSON, found text that breaks off or is malformed ({error})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
