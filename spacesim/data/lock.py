"""One run at a time in a folder: a lock that the kernel takes back, however the process ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from spacesim.data.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def lock_folder(folder: Path, shared: bool = False) -> Iterator[None]:
    """Make `folder` and keep every other `lock_folder` out of it, of this and other processes, within the `with` block.
    shared: others that are shared may be in it.

    Raises InputError where another one is in it. The lock is on the folder itself and leaves nothing there. Where the
    system or the file system cannot do that (Windows; NFS locks files alone) no process is kept out; where the folder
    cannot be made, the first write to it says why.
    """
    descriptor = None
    with suppress(OSError):
        Path(folder).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY) if fcntl else None
    try:
        if descriptor is not None:
            _lock(folder, descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock(folder: Path, descriptor: int, kind: int) -> None:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = _holder(os.fstat(descriptor).st_ino)
        who = f" (process {holder})" if holder else ""
        raise InputError(f"{folder}: expected no other run at work in the folder, found one{who}") from None
    except OSError:  # a file system without locks of folders
        return


def _holder(inode: int) -> int | None:
    """The process that has locked the file of this number, as Linux lists in /proc/locks; None where it does not.

    A line is: number, kind, ADVISORY, WRITE, process, device:inode, start, end (proc_locks(5)). Waiting ones have "->".
    """
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text().splitlines():
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].split(":")[-1] == str(inode):
                return int(fields[4]) or None
    return None
