"""Shards of WebDataset, plain tar files that are read from one end to the other, for training at scale.

    DIR/train-000000.tar, val-000000.tar   of each frame: NAME.png  NAME.id.png  NAME.depth.png  NAME.json
    DIR/keypoints.json                     the keypoints in 3D: see `keypoints`

NAME.png is the picture over black, id.png its object numbers, depth.png the dataset's depth. The JSON has the camera,
the Sun, metres a step of depth, and of each object seen its pose (OpenCV's axes, metres), box, area, RLE mask and
keypoints (pixels, the first one's centre at 0.5, 0.5; 2 seen, 1 hidden, 0 not in the picture).
"""

import io
import tarfile
from pathlib import Path

from spacesim.data.exporters.keypoints import NAME, write_body_labels
from spacesim.data.exporters.labels import DatasetLabeller, Instance
from spacesim.data.exporters.masks import run_lengths
from spacesim.data.exporters.objects import ExportProgress, frame_camera, opaque_picture
from spacesim.data.files import JsonDict, json_bytes, read_bytes, write_bytes
from spacesim.data.identity import frame_names
from spacesim.data.images import png_bytes
from spacesim.data.integrity.outputs import replaced_content
from spacesim.data.records import Dataset, Frame

SHARD = 1 << 28  #: bytes after which a shard is full
OVERHEAD = 1024  #: bytes a file, at most: its header, and zeros up to the next 512
MOST = 1000  #: frames of a shard


def write_webdataset(
    dataset: Dataset, out: Path, keypoints: int | Path | None = None, progress: ExportProgress | None = None
) -> int:
    """Write `dataset` into the new folder `out`; returns how many shards there are. The same dataset gives the same
    bytes.

    keypoints: how many are to be found, or a file, see `body_labels`. Raises InputError as `DatasetLabeller` does,
    where pictures cannot be read, and for a folder that is not empty.
    """
    labeller = DatasetLabeller(dataset, keypoints)
    with replaced_content(out) as out:
        names = dict(zip(dataset.frames, frame_names(dataset.frames), strict=True))
        done, shards = 0, 0
        for split, frames in (("train", dataset.train), ("val", dataset.test)):
            shard = _Shard(out, split)
            for frame, instances in labeller.frames(frames):
                shard.add(names[frame].replace(".", "_"), _sample(dataset, frame, instances))
                done += 1
                if progress is not None:
                    progress(done, len(dataset.frames), frame.file_path)
            shards += shard.close()
        write_body_labels(out / NAME, labeller.bodies)
        return shards


class _Shard:
    """One after the other, each in memory until it is full: whole on the disk or not there."""

    def __init__(self, out: Path, split: str) -> None:
        self._out, self._split, self._count = out, split, 0
        self._frames: list[tuple[str, dict[str, bytes]]] = []
        self._size = 0

    def add(self, name: str, files: dict[str, bytes]) -> None:
        size = sum(len(content) + OVERHEAD for content in files.values())
        if self._frames and (len(self._frames) == MOST or self._size + size > SHARD):
            self.close()
        self._frames.append((name, files))
        self._size += size

    def close(self) -> int:
        """Write what there is; how many shards there are."""
        if self._frames:
            stream = io.BytesIO()
            with tarfile.open(fileobj=stream, mode="w", format=tarfile.GNU_FORMAT) as tar:
                for name, files in self._frames:
                    for suffix, content in files.items():
                        member = tarfile.TarInfo(f"{name}.{suffix}")
                        member.size, member.mode = len(content), 0o644
                        tar.addfile(member, io.BytesIO(content))
            write_bytes(self._out / f"{self._split}-{self._count:06d}.tar", stream.getvalue(), durable=False)
            self._frames, self._size, self._count = [], 0, self._count + 1
        return self._count


def _sample(dataset: Dataset, frame: Frame, instances: list[Instance]) -> dict[str, bytes]:
    """{suffix: content}."""
    files = {"png": png_bytes(opaque_picture(dataset, frame))}
    for suffix, path in (("id.png", frame.id_path), ("depth.png", frame.depth_file_path)):
        if path is not None:
            files[suffix] = read_bytes(dataset.root / path)
    described: JsonDict = {
        "file_path": frame.file_path,
        "width": frame.camera.width,
        "height": frame.camera.height,
        "camera": frame_camera(frame),
        "world_from_camera": frame.camera.world_from_camera.tolist(),
        "sun_direction": None if frame.sun is None else frame.sun.direction.tolist(),
        "depth_unit": dataset.depth_unit,
        "objects": [_object(frame, instance) for instance in instances],
    }
    return {**files, "json": json_bytes(described)}


def _object(frame: Frame, instance: Instance) -> JsonDict:
    return {
        "id": instance.target.id,
        "name": instance.target.name,
        "camera_from_object": instance.target.camera_from_object(frame.camera).tolist(),
        "box": list(instance.box),
        "area": instance.area,
        "mask": run_lengths(instance.mask),
        "keypoints": instance.keypoints.tolist(),
    }
