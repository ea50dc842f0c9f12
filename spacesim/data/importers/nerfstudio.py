"""Folders of Nerfstudio and of NeRF-synthetic (Blender) as datasets of ours."""

from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.importers.importer import Importer
from spacesim.data.importers.writing import ImportedFrame, Progress, write_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_points
from spacesim.data.transforms import read_dataset


def import_nerfstudio(src: Path, out: Path, *, progress: Progress | None = None) -> Dataset:
    """Import a folder with a transforms.json, or the file itself. Raises InputError as `read_dataset` does."""
    return _import("nerfstudio", read_dataset(src), src, out, progress)


def import_blender(src: Path, out: Path, *, progress: Progress | None = None) -> Dataset:
    """Import a folder with transforms_train.json and transforms_test.json or transforms_val.json.

    Raises InputError where there is none, and as `read_dataset` does.
    """
    path = src / "transforms_train.json" if src.is_dir() else src
    if not path.is_file():
        raise InputError(f"{src}: expected a folder with transforms_train.json, found none in it")
    return _import("blender", read_dataset(path), src, out, progress)


def _import(kind: str, dataset: Dataset, src: Path, out: Path, progress: Progress | None) -> Dataset:
    train, test = ([_frame(dataset, frame) for frame in group] for group in (dataset.train, dataset.test))
    points = None if dataset.ply_file_path is None else read_points(dataset.root / dataset.ply_file_path)
    return write_dataset(out, train, test, {"kind": kind, "source": str(src)}, points, progress=progress)


def _frame(dataset: Dataset, frame: Frame) -> ImportedFrame:
    root = dataset.root
    name = Path(frame.file_path).with_suffix("").as_posix().lstrip("./").removeprefix("images/")
    silhouette, mask = (None if p is None else root / p for p in (frame.silhouette_path, frame.mask_path))
    return ImportedFrame(
        name, root / frame.file_path, frame.camera, frame.distortion, frame.sun, silhouette=silhouette, mask=mask
    )


NERFSTUDIO = Importer(import_nerfstudio, "a folder with a transforms.json", "folder or transforms.json")
BLENDER = Importer(import_blender, "NeRF-synthetic: transforms_train.json and its like", "folder")
