"""Labels as Ultralytics reads them, for each of its tasks a folder that trains as it is.

    DIR/detect, DIR/segment, DIR/pose: data.yaml, images/train/NAME.png, labels/train/NAME.txt, the same for val
    DIR/keypoints.json                 the keypoints in 3D: see `keypoints`

A line an instance, numbers from 0 to 1 of the picture's width and height: class, then the box (middle x, y, width,
height), or the outline (x, y, ...), or the box and of each keypoint x, y and visibility: 2 seen, 1 hidden, 0 not in the
picture. val is our test split. Pictures are one file under three names where the disk allows. No flip_idx is written:
a mirrored spacecraft is another one, so Ultralytics does not mirror pictures for poses.
"""

import os
import shutil
from pathlib import Path

import numpy as np

from spacesim.data.exporters.keypoints import NAME, write_body_labels
from spacesim.data.exporters.labels import DatasetLabeller, Instance
from spacesim.data.exporters.masks import outline
from spacesim.data.exporters.objects import ExportProgress, opaque_picture
from spacesim.data.files import write_bytes
from spacesim.data.identity import frame_names
from spacesim.data.images import write_png
from spacesim.data.integrity.outputs import replaced_content
from spacesim.data.records import Dataset

TASKS = ("detect", "segment", "pose")


def write_yolo(
    dataset: Dataset, out: Path, keypoints: int | Path | None = None, progress: ExportProgress | None = None
) -> int:
    """Write `dataset` into the new folder `out`; returns how many instances there are.

    keypoints: how many are to be found, or a file, see `body_labels`. Raises InputError as `DatasetLabeller` does,
    where pictures cannot be read, and for a folder that is not empty.
    """
    labeller = DatasetLabeller(dataset, keypoints)
    with replaced_content(out) as out:
        classes = [category.name for category in labeller.categories]
        most = max(len(body.keypoints) for body in labeller.bodies)
        names = dict(zip(dataset.frames, frame_names(dataset.frames), strict=True))
        tested, total = set(dataset.test), 0
        for frame, instances in labeller.frames(dataset.frames, progress):
            split, name = "val" if frame in tested else "train", names[frame]
            first = out / TASKS[0] / "images" / split / f"{name}.png"
            write_png(first, opaque_picture(dataset, frame), durable=False)
            for task in TASKS:
                lines = [_line(task, instance, most) for instance in instances]
                write_bytes(out / task / "labels" / split / f"{name}.txt", "".join(lines).encode(), durable=False)
                if task != TASKS[0]:
                    _link(first, out / task / "images" / split / f"{name}.png")
            total += len(instances)
        for task in TASKS:
            write_bytes(out / task / "data.yaml", _description(task, classes, most, bool(dataset.test)).encode())
        write_body_labels(out / NAME, labeller.bodies)
        return total


def _line(task: str, instance: Instance, most: int) -> str:
    height, width = instance.mask.shape
    size = np.array([width, height])
    x, y, across, down = instance.box
    box = [(x + 0.5 * across) / width, (y + 0.5 * down) / height, across / width, down / height]
    words = [str(instance.category - 1)]
    if task == "segment":
        words += [f"{number:.6f}" for number in (outline(instance.mask) / size).ravel()]
    else:
        words += [f"{number:.6f}" for number in box]
    if task == "pose":
        for place, state in zip(instance.keypoints[:, :2] / size, instance.keypoints[:, 2], strict=True):
            words += [f"{place[0]:.6f}", f"{place[1]:.6f}", str(int(state))]
        words += ["0", "0", "0"] * (most - len(instance.keypoints))
    return " ".join(words) + "\n"


def _description(task: str, classes: list[str], most: int, has_val: bool) -> str:
    """data.yaml: paths in it are relative to its folder."""
    lines = ["train: images/train", f"val: images/{'val' if has_val else 'train'}"]
    lines += [f"kpt_shape: [{most}, 3]"] * (task == "pose")
    quoted = [name.replace("'", "''") for name in classes]
    return "\n".join([*lines, "names:", *(f"  {number}: '{name}'" for number, name in enumerate(quoted)), ""])


def _link(source: Path, path: Path) -> None:
    """The same file under another name, or a copy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, path)
    except OSError:
        shutil.copyfile(source, path)
