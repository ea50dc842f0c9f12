"""The kinds of source that can be imported, and the one function that imports them all."""

from pathlib import Path
from typing import Any

from spacesim.data.errors import InputError
from spacesim.data.importers import colmap, nerfstudio, speedplus
from spacesim.data.importers.importer import Importer
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


def import_dataset(
    kind: str, src: str | Path, out: str | Path, progress: Progress | None = None, **options: Any
) -> Dataset:
    """Write what lies at `src` as a dataset into the folder `out`; returns it. options: those of the kind.

    Raises InputError for a kind or an option that is not known, and as the importer does.
    """
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, found {kind!r}{did_you_mean(kind, KINDS)}")
    importer = KINDS[kind]
    known = {option.name: option for option in importer.options}
    for name, value in options.items():
        if name not in known:
            names = f"one of {', '.join(known)}" if known else "none"
            raise InputError(f"{name}: expected options of {kind}, {names}, found another{did_you_mean(name, known)}")
        choices = known[name].choices
        if choices and value not in choices:
            raise InputError(f"{name}: expected one of {', '.join(choices)}, found {value!r}")
    return importer.function(Path(src), Path(out), progress=progress, **options)
