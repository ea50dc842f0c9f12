"""Every file of a dataset, held against its digest and decoded: what `spacesim verify` looks at."""

from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping
from spacesim.data.images import read_png
from spacesim.data.importers.writing import SOURCE
from spacesim.data.integrity.manifest import NAME, check_manifest, read_manifest
from spacesim.data.records import Dataset
from spacesim.data.store import RAW_COLOR, RAW_MONOCHROME, find_unreadable_files, read_dataset


def verify_files(path: Path) -> tuple[Dataset, list[str]]:
    """A dataset and sentences about its faulty files, [] where each one is there and whole.

    Raises InputError where it cannot be read at all; where deleting a file is the way out, the sentence says so.
    """
    try:
        dataset = read_dataset(path)
    except InputError as error:
        raise InputError(f"{error}{_repair_hint(Path(path), error)}") from None
    try:
        changed = check_manifest(dataset.root)
        listed = read_manifest(dataset.root)
    except InputError as error:
        return dataset, [f"{error}; delete it" if dataset.scene else str(error)]
    if dataset.scene and "scene.json" in changed:
        changed["scene.json"] += "; delete it"
    absent = sorted(_named(dataset) - listed.keys()) if listed else []
    changed |= {name: f"{dataset.root / NAME}: expected a digest of {name}, found none" for name in absent}
    reported = tuple(f"{dataset.root / name}:" for name in changed)
    faulty = [
        words for words in find_unreadable_files(dataset) + _faulty_pictures(dataset) if not words.startswith(reported)
    ]
    return dataset, [*changed.values(), *faulty]


def _named(dataset: Dataset) -> set[str]:
    """Paths of the files that a dataset has: transforms.json and what it names, scene.json."""
    keys = "file_path", "gt_path", "shadow_path", "silhouette_path", "id_path", "depth_file_path", "mask_path"
    paths = {getattr(frame, key) for frame in dataset.frames for key in keys}
    paths |= {dataset.ply_file_path, dataset.mesh_path, "transforms.json"}
    return {path for path in paths if path is not None} | ({"scene.json"} if dataset.scene else set())


def has_digests(dataset: Dataset) -> bool:
    """Whether SHA256SUMS lies beside the data: without it, a changed byte of a file without checksums goes unseen."""
    return (dataset.root / NAME).exists()


def repair_hint(dataset: Dataset) -> str:
    """What to do about faulty files of a dataset, by what has made it; "" where that is not known."""
    if dataset.scene:
        return "; generate of the same scene with resume=True makes them again"
    return "; import it again, into a new folder" if (dataset.root / SOURCE).is_file() else ""


def _repair_hint(root: Path, error: InputError) -> str:
    """What to do about a broken scene.json or transforms.json of a dataset that `generate` has made."""
    broken = [name for name in ("scene.json", "transforms.json") if str(root / name) in str(error)]
    if not (root / "scene.json").is_file() or not any((root / name).is_file() for name in broken):
        return ""
    first = "delete it, " if "scene.json" in broken else ""  # else nothing is resumed
    return f"; {first}generate of the same scene with resume=True makes it again"


def _faulty_pictures(dataset: Dataset) -> list[str]:
    """Sentences about pictures that transforms.json does not name and that are missing or cannot be decoded: a sensor's
    in raw/, and the overviews where there are any."""
    names = [Path(frame.file_path).stem for frame in dataset.frames]
    raw = [dataset.root / "raw" / f"{name}{suffix}.png" for name in names for suffix in _raw_suffixes(dataset.scene)]
    problems = []
    for path in [*raw, *sorted(dataset.root.glob("*.png"))]:
        try:
            read_png(path)
        except InputError as error:
            problems.append(str(error))
    return problems


def _raw_suffixes(scene: JsonMapping) -> tuple[str, ...]:
    """Of the names of a sensor's pictures, by scene.json; () where it knows of no sensor."""
    try:
        return RAW_MONOCHROME if scene["config"]["camera"]["sensor"]["monochrome"] else RAW_COLOR
    except (KeyError, TypeError):
        return ()
