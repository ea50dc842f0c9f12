"""COCO (T.-Y. Lin et al., "Microsoft COCO: common objects in context", 2014): instances and keypoints in one file.

    DIR/annotations/train.json, val.json     val is our test split
    DIR/train/NAME.png, DIR/val/NAME.png     pictures over black, as the camera records them
    DIR/keypoints.json                       the keypoints in 3D: see `keypoints`

Masks are run lengths (compressed RLE). Boxes count from the picture's upper left corner; keypoints count from the
centre of its first pixel, as COCO's do, so they are half a pixel less than ours. Their visibility is 2 seen, 1 hidden,
0 not in the picture. Images also have `camera`, pixels, with cx and cy from the corner.
"""

from pathlib import Path

from spacesim.data.exporters.keypoints import NAME, write_body_labels
from spacesim.data.exporters.labels import OUTSIDE, DatasetLabeller, Instance
from spacesim.data.exporters.masks import run_lengths
from spacesim.data.exporters.objects import ExportProgress, frame_camera, opaque_picture
from spacesim.data.files import JsonDict, write_json
from spacesim.data.identity import frame_names
from spacesim.data.images import write_png
from spacesim.data.integrity.outputs import replaced_content
from spacesim.data.records import Dataset, Frame

HALF = 0.5  # from our pixel coordinates to those of COCO's keypoints


def write_coco(
    dataset: Dataset, out: Path, keypoints: int | Path | None = None, progress: ExportProgress | None = None
) -> int:
    """Write `dataset` into the new folder `out`; returns how many instances there are.

    keypoints: how many are to be found, or a file, see `body_labels`. Raises InputError as `DatasetLabeller` does,
    where pictures cannot be read, and for a folder that is not empty.
    """
    labeller = DatasetLabeller(dataset, keypoints)
    with replaced_content(out) as out:
        categories = [
            {
                "id": category.number,
                "name": category.name,
                "supercategory": "spacecraft",
                "keypoints": list(category.body.keypoints),
                "skeleton": [],
            }
            for category in labeller.categories
        ]
        names = dict(zip(dataset.frames, frame_names(dataset.frames), strict=True))
        splits = {"train": dataset.train, "val": dataset.test}
        images: dict[str, list[JsonDict]] = {split: [] for split in splits}
        annotations: dict[str, list[JsonDict]] = {split: [] for split in splits}
        tested = set(dataset.test)
        for number, (frame, instances) in enumerate(labeller.frames(dataset.frames, progress), start=1):
            split = "val" if frame in tested else "train"
            write_png(out / split / f"{names[frame]}.png", opaque_picture(dataset, frame), durable=False)
            images[split].append(_image(number, f"{names[frame]}.png", frame))
            annotations[split] += [_annotation(number, instance) for instance in instances]
        total = 0
        for split in splits:
            for annotation in annotations[split]:
                total += 1
                annotation["id"] = total  # 0 would be taken for none
            content = {"images": images[split], "annotations": annotations[split], "categories": categories}
            write_json(out / f"annotations/{split}.json", {"info": {"description": dataset.root.name}, **content})
        write_body_labels(out / NAME, labeller.bodies)
        return total


def _image(number: int, name: str, frame: Frame) -> JsonDict:
    camera = frame.camera
    return {
        "id": number,
        "file_name": name,
        "width": camera.width,
        "height": camera.height,
        "camera": frame_camera(frame),
    }


def _annotation(image: int, instance: Instance) -> JsonDict:
    keypoints: list[float] = []
    for x, y, state in instance.keypoints.tolist():
        keypoints += [x - HALF, y - HALF, int(state)] if state != OUTSIDE else [0, 0, 0]
    return {
        "id": 0,
        "image_id": image,
        "category_id": instance.category,
        "segmentation": run_lengths(instance.mask),
        "area": instance.area,
        "bbox": list(instance.box),
        "iscrowd": 0,
        "keypoints": keypoints,
        "num_keypoints": int((instance.keypoints[:, 2] != OUTSIDE).sum()),
    }
