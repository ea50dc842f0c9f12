"""Files in and out: what is no plain file, links, pipes and devices, long names, disks that are read-only."""

import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from spacesim.backend import memory
from spacesim.data.errors import InputError, WorkError, check_ranges
from spacesim.data.files import read_bytes, read_json, remove_leftovers, write_bytes


def device(path: Path, minor: int) -> Path:
    """A device of characters of Linux: 3 is /dev/null, 5 /dev/zero, 7 /dev/full."""
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, minor))
        path.write_bytes(b"") if minor != 7 else None
    except OSError:
        pytest.skip("devices cannot be made here")
    return path


def test_a_device_is_written_into_and_stays_one(tmp_path):
    null = device(tmp_path / "null", 3)
    write_bytes(null, b"content")
    assert stat.S_ISCHR(null.stat().st_mode)
    assert list(tmp_path.iterdir()) == [null]
    with pytest.raises(WorkError, match="disk is full"):
        write_bytes(device(tmp_path / "full", 7), b"content")


@pytest.mark.parametrize("arguments", [("export", "{run}", "--ply", "{out}"), ("report", "{eval}", "--out", "{out}")])
@pytest.mark.parametrize("kind", ["null", "link"])
def test_commands_leave_devices_and_links_in_place(spacesim, tiny_run, tiny_eval, tmp_path, arguments, kind):
    link = tmp_path / ("link.ply" if "--ply" in arguments else "link.html")
    out = device(tmp_path / "null", 3) if kind == "null" else link
    if kind == "link":
        (tmp_path / "there").write_bytes(b"old")
        out.symlink_to("there")
    done = spacesim(*(word.format(run=tiny_run, eval=tiny_eval, out=out) for word in arguments))
    assert done.code == 0, done.errors
    if kind == "null":
        assert stat.S_ISCHR(out.stat().st_mode)
    else:
        assert out.is_symlink()
        assert (tmp_path / "there").stat().st_size > 1000


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_followed(tmp_path, there):
    (tmp_path / "folder").mkdir()
    target, link = tmp_path / "folder/target", tmp_path / "link"
    if there:
        target.write_bytes(b"old")
        target.chmod(0o640)
    link.symlink_to(target)
    write_bytes(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert not there or stat.S_IMODE(target.stat().st_mode) == 0o640
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["folder", "link", "target"]


def test_a_pipe_is_written_into_where_somebody_reads_it(tmp_path):
    pipe, content, found = tmp_path / "pipe", os.urandom(300_000), list[bytes]()
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="expected a pipe with a reader"):
        write_bytes(pipe, content)
    descriptor = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)
    with os.fdopen(descriptor, "rb") as reader:
        thread = threading.Thread(target=lambda: found.append(reader.read()))
        writer = os.open(pipe, os.O_WRONLY)  # holds it open until the reader stands by
        thread.start()
        write_bytes(pipe, content)
        os.close(writer)
        thread.join()
    assert found == [content]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_unwritable_paths_are_refused(tmp_path):
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(tmp_path / "socket"))
        for name, found in ((".", "a folder"), ("socket", "a socket")):
            with pytest.raises(InputError, match=f"expected a file to write, found {found}"):
                write_bytes(tmp_path / name, b"")
    with pytest.raises(InputError, match="cannot be written"):
        write_bytes(tmp_path / ("x" * 300), b"")
    long = tmp_path / ("x" * 255)
    write_bytes(long, b"as long as a name may be")
    assert long.read_bytes() == b"as long as a name may be"


def test_a_read_only_disk_raises_an_input_error(tmp_path):
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(tmp_path)]
    if (
        not sys.platform.startswith("linux")
        or os.geteuid() != 0
        or subprocess.run(mount, capture_output=True).returncode
    ):
        pytest.skip("mounting is not permitted here")
    try:
        (tmp_path / ".a.part").write_bytes(b"left over")
        subprocess.run(["mount", "-o", "remount,ro", str(tmp_path)], check=True)
        with pytest.raises(InputError, match=r"cannot be written \(Read-only file system\)"):
            write_bytes(tmp_path / "file", b"")
        remove_leftovers(tmp_path)
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


@pytest.mark.parametrize("kind", ["zero", "pipe", "folder", "socket", "loop", "none", "null in the name"])
def test_only_plain_files_are_read(tmp_path, kind):
    path = tmp_path / "file"
    if kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "null in the name":
        path = tmp_path / "a\0b"
    with pytest.raises(InputError, match="expected a JSON file, found"):
        read_json(path)


def test_files_are_read_whole_and_as_large_as_they_may_be(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 1000)
    assert read_bytes(path, most=1000) == b"x" * 1000
    with pytest.raises(InputError, match="of at most 999 bytes, found 1,000"):
        read_bytes(path, most=999)
    monkeypatch.setattr(memory, "LARGE", 500)
    monkeypatch.setattr(memory, "main_memory", lambda: 900)
    with pytest.raises(MemoryError, match=r"reading it needs about 1e-06 GB of memory, 9e-07 GB are free"):
        read_bytes(path)
    assert b"cpu" in read_bytes(Path("/proc/cpuinfo")) or not Path("/proc/cpuinfo").exists()


def test_ranges():
    check_ranges(1 + 2j, real=(1, 1), imag=(0, 2))
    for value in (2.5, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"imag: expected 0 to 2, found"):
            check_ranges(complex(0, value), imag=(0, 2))
