"""The kinds of source that can be imported, and the one function that imports them all."""

from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.importers import colmap, nerfstudio, speedplus
from spacesim.data.importers.importer import Importer, Option
from spacesim.data.importers.video import importing as video
from spacesim.data.importers.writing import Progress
from spacesim.data.records import Dataset
from spacesim.data.structure import did_you_mean

KINDS: dict[str, Importer] = {
    "nerfstudio": nerfstudio.NERFSTUDIO,
    "blender": nerfstudio.BLENDER,
    "colmap": colmap.COLMAP,
    "speedplus": speedplus.SPEEDPLUS,
    "images": video.IMAGES,
    "video": video.VIDEO,
}
"""By their names on the command line."""

_TYPES: dict[object, type | tuple[type, ...]] = {float: (float, int), int: int, str: str, bool: bool, Path: Path}


def import_dataset(
    kind: str, src: str | Path, out: str | Path, progress: Progress | None = None, **options: object
) -> Dataset:
    """Write what lies at `src` as a dataset into the folder `out`; returns it. options: those of the kind.

    Raises InputError for a kind or an option that is not known, and as the importer does.
    """
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, found {kind!r}{did_you_mean(kind, KINDS)}")
    importer = KINDS[kind]
    known = {option.name: option for option in importer.options}
    for name in options:
        if name not in known:
            names = f"one of {', '.join(known)}" if known else "none"
            raise InputError(f"{name}: expected options of {kind}, {names}, found another{did_you_mean(name, known)}")
    given = {name: _value(known[name], value) for name, value in options.items() if value is not None}
    return importer.function(Path(src), Path(out), progress=progress, **given)


def _value(option: Option, value: object) -> object:
    """Of an option, which may be text as on the command line. Raises InputError for one of another type."""
    wanted = _TYPES.get(option.type, object)
    try:
        read = option.type(value) if isinstance(value, str) and option.type is not bool else value
    except (TypeError, ValueError):
        read = None
    if read is None or not isinstance(read, wanted) or (isinstance(read, bool) and option.type is not bool):
        raise InputError(f"{option.name}: expected {option.value or 'True or False'}, found {value!r}")
    if option.choices and read not in option.choices:
        raise InputError(f"{option.name}: expected one of {', '.join(option.choices)}, found {value!r}")
    return read
