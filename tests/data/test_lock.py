"""A lock of a folder: which processes are kept out, and where none can be."""

import errno
import os
import subprocess
import sys

import pytest

from spacesim.data.errors import InputError
from spacesim.data.lock import lock_folder

fcntl = pytest.importorskip("fcntl", reason="this system has no flock")


def test_the_lock_is_exclusive_and_leaves_no_file(tmp_path):
    folder = tmp_path / "a/b"
    with lock_folder(folder):
        with pytest.raises(InputError, match=r"b: expected no other run at work in the folder, found one"):
            lock_folder(folder).__enter__()
        with lock_folder(tmp_path / "a"):  # another folder
            pass
    with pytest.raises(KeyError), lock_folder(folder):
        raise KeyError
    with lock_folder(folder):
        assert not list(folder.iterdir())


def test_a_process_started_within_does_not_hold_it(tmp_path):
    """Workers may outlive the process that planned: they must not keep the next one out."""
    with lock_folder(tmp_path):
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        with lock_folder(tmp_path):
            assert child.poll() is None
    finally:
        child.communicate(b"\n")


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EBADF, errno.ENOTSUP])
def test_where_folders_cannot_be_locked_work_goes_on(tmp_path, monkeypatch, code):
    def refuse(*_: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with lock_folder(tmp_path), lock_folder(tmp_path):
        pass


def test_locking_ignores_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("a file, no folder")
    for place in (tmp_path / "file", tmp_path / "file/below"):
        with lock_folder(place):
            pass
    assert (tmp_path / "file").read_text() == "a file, no folder"
