"""What is written: a file or a folder takes the place of an earlier one of its own kind, and of nothing else."""

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, holds_files, read_json, remove_leftovers
from spacesim.data.integrity.manifest import NAME as DIGESTS
from spacesim.data.integrity.manifest import read_manifest
from spacesim.data.lock import lock_folder

SUFFIXES = {
    "ply": (".ply",),
    "glb": (".glb",),
    "spz": (".spz",),
    "usd": (".usda", ".usd"),
    "mesh": (".ply", ".obj", ".glb", ".stl"),
    "html": (".html", ".htm"),
    "report": (".html", ".htm"),
    "picture": (".png", ".exr"),
    "camera density": (".png",),
    "poses": (".json",),
}
"""{kind of file: suffixes of its names}."""

PART, WRITTEN, CLEARED = ".spacesim-part", ".spacesim-written", ".spacesim-cleared"
"""Hidden, in a folder that is being written: content that is not complete, that is, and what it replaces is gone."""

_RUN = re.compile(
    r"(config|training|cameras)\.json|(model|poses)\.safetensors|checkpoints/(step_\d+\.safetensors|seconds\.json)"
)
_FRAME = "(truth|prediction|error|(shadow|mask)_(truth|prediction)|visibility|(depth|albedo)(_truth)?)"
_PICTURES = (
    rf"camera_density\.png|frames/[^/]+/{_FRAME}\.png|relight/(prediction|visibility|truth)_\d\d\.png"
    r"|geometry/((truth|reconstruction)_\d+\.png|reconstruction\.ply)"
)
_EVALUATION = re.compile(rf"metrics\.json|report\.html|{_PICTURES}")
_SWEEP = re.compile(r"sweep\.(png|mp4)|frames/\d{4}\.(png|exr)")

_SAME = {"report": "report.html", "camera density": "camera_density.png"}
"""{kind of file: what evaluations call theirs}."""


def check_output(path: Path, kind: str) -> None:
    """Raise InputError where a file of one of the kinds of `SUFFIXES` is to be written to a name of another suffix, to
    a folder, or in the place of a file of a dataset, a run or an evaluation. A device may have any name."""
    if path.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder")
    if path.parent == Path("/dev") or (path.exists() and not path.is_file()):
        return
    suffixes = SUFFIXES[kind]
    if path.suffix.lower() not in suffixes:
        expected = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise InputError(f"{path}: expected a file name that ends in {expected}, found {path.suffix or 'no extension'}")
    target = Path(os.path.realpath(path))
    for folder in target.parents if target.is_file() else ():
        owner = _owner(folder, target.relative_to(folder).as_posix(), kind)
        if owner:
            raise InputError(f"{path}: expected a file that is no {owner}'s own, found one of {folder}")


def _owner(folder: Path, name: str, kind: str) -> str:
    """Of which product in `folder` the file called `name` there is a part; "" of none."""
    if (folder / "config.json").is_file() and _RUN.fullmatch(name):
        return "run"
    if name != _SAME.get(kind) and _EVALUATION.fullmatch(name) and _is_evaluation(folder):
        return "evaluation"
    if (folder / "transforms.json").is_file() and _is_of_dataset(folder, name):
        return "dataset"
    return ""


def _is_of_dataset(folder: Path, name: str) -> bool:
    """Whether SHA256SUMS names a file; of a dataset without it, transforms.json, paths also without a suffix."""
    with suppress(InputError):  # of another program, or damaged, which `verify` reports
        if listed := read_manifest(folder):
            return name in (*listed, DIGESTS)
    with suppress(InputError):
        texts = list(_texts(read_json(folder / "transforms.json", MAX_LIST_BYTES)))
        stems = {str(PurePosixPath(text)) for text in texts if "/" in text}
        return name in ("transforms.json", *texts) or bool(stems & {name, str(PurePosixPath(name).with_suffix(""))})
    return False


def _texts(value: object) -> Iterator[str]:
    """All strings in a value of JSON."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def check_evaluation_folder(out: Path) -> None:
    """Raise InputError where a folder has a report or numbers that no evaluation has written. Other files stay."""
    mine = next((name for name in ("metrics.json", "report.html") if (out / name).exists()), None)
    if mine and not _is_evaluation(out):
        raise InputError(f"{out}: expected a new folder, or one of an earlier evaluation, found another {mine} in it")
    for name in ("frames", "relight", "geometry"):
        if (out / name).is_file():
            raise InputError(f"{out / name}: expected room for a folder, found a file")


def _is_evaluation(folder: Path) -> bool:
    """metrics.json is one of ours."""
    with suppress(InputError):
        values = read_json(folder / "metrics.json", MAX_LIST_BYTES)
        return isinstance(values, dict) and {"schema", "run", "data", "split", "frames"} <= values.keys()
    return False


def clear_evaluation(out: Path) -> None:
    """Take away all that an evaluation has written into a folder, its numbers before the pictures: a folder that has
    these is complete. Raises OSError where that fails."""
    _remove(out, _EVALUATION, ("report.html", "metrics.json"))
    remove_leftovers(out)


def check_sweep_folder(out: Path) -> None:
    """Raise InputError where a folder holds files that no sweep, finished or interrupted, has written: its frames are
    numbered from 0 on, those of others hardly ever."""
    names = sorted(_files(out))
    foreign = [name for name in names if not _SWEEP.fullmatch(name)]
    frames = [name for name in names if name.startswith("frames/")]
    if not foreign and [Path(name).stem for name in frames] != [f"{i:04d}" for i in range(len(frames))]:
        foreign = frames
    if foreign:
        expected = "expected an empty or new folder, or one of an earlier sweep"
        raise InputError(f"{out}: {expected}, found other files in it ({foreign[0]})")


def clear_sweep(out: Path) -> None:
    """Take away all that a sweep has written into a folder. Raises OSError where that fails."""
    _remove(out, _SWEEP)


@contextmanager
def replaced_content(out: Path, clear: Callable[[Path], None] | None = None) -> Iterator[Path]:
    """A hidden folder in `out` to write into. When the `with` block ends, what it holds takes the place of what `clear`
    takes away from `out`; without `clear`, `out` must be new or empty. Where the block raises, `out` is as it was
    before; a process that is killed while files take their places leaves them to the next call, which goes on.

    Raises InputError where `out` is no such folder or cannot be written, where another process is writing into it, and
    where a file would take the place of a folder, or a folder that of a file.
    """
    out = Path(out)
    was_there, part = out.exists(), out / PART
    with lock_folder(out):
        try:
            with _written(out):
                _put_in_place(out, clear)  # of a process that was killed
                if part.exists():
                    shutil.rmtree(part)
                _check_content(out, clear is None)
                part.mkdir(parents=True)
            yield part
            with _written(out):
                _check_content(out, clear is None)
                _check_places(part, out)
                part.rename(out / WRITTEN)
                try:
                    _put_in_place(out, clear)
                except KeyboardInterrupt:
                    _put_in_place(out, clear)  # that takes a moment
                    raise
        finally:
            shutil.rmtree(part, ignore_errors=True)
            if not was_there:
                with suppress(OSError):  # it is not empty
                    out.rmdir()


def _put_in_place(out: Path, clear: Callable[[Path], None] | None) -> None:
    """Go on, from wherever it was, with what makes complete content that of `out`."""
    if (out / WRITTEN).exists():
        if clear is not None:
            clear(out)
        (out / WRITTEN).rename(out / CLEARED)
    if (out / CLEARED).exists():
        _move_content(out / CLEARED, out)
        (out / CLEARED).rmdir()


def _check_content(out: Path, is_new: bool) -> None:
    if out.exists() and (not out.is_dir() or (is_new and holds_files(out))):
        expected = "a new or empty folder" if is_new else "a folder"
        raise InputError(f"{out}: expected {expected}, found a file or files in it")


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder}: expected a folder that can be written ({error.strerror or error})") from None


def _check_places(source: Path, target: Path) -> None:
    """Raise InputError where what is in `source` cannot take its place in `target`."""
    for path in source.iterdir():
        place = target / path.name
        if place.exists() and path.is_dir() != place.is_dir():
            kinds = ("folder", "file") if path.is_dir() else ("file", "folder")
            raise InputError(f"{place}: expected room for a {kinds[0]}, found a {kinds[1]}")
        if path.is_dir() and place.is_dir():
            _check_places(path, place)


def _move_content(source: Path, target: Path) -> None:
    """All that is in `source` into `target`, files last, as they say that the rest is there."""
    for path in sorted(source.iterdir(), key=lambda path: (path.is_file(), path.name)):
        place = target / path.name
        if path.is_dir() and place.is_dir():
            _move_content(path, place)
            path.rmdir()
            continue
        try:
            path.replace(place)
        except OSError as error:
            if error.errno != errno.EXDEV:  # a link leads to another disk
                raise
            shutil.move(path, place)


def _files(folder: Path) -> Iterator[str]:
    """Paths from there of the visible files in and below a folder."""
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        here = Path(place).relative_to(folder)
        yield from ((here / name).as_posix() for name in names if not name.startswith("."))


def _remove(folder: Path, own: re.Pattern[str], first: Sequence[str] = ()) -> None:
    """Take away the files that are its `own`, `first` ones before others, and folders that are empty then."""
    names = [name for name in _files(folder) if own.fullmatch(name)]
    for name in (*first, *names):
        (folder / name).unlink(missing_ok=True)
    within = {place for name in names for place in PurePosixPath(name).parents if place.parts}
    for place in sorted(within, key=lambda place: -len(place.parts)):
        with suppress(OSError):  # it is not empty
            (folder / place).rmdir()
