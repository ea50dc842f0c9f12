"""The training pixels whose rays cross the box, on the device: those of others show nothing that a field can learn."""

import logging
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.memory import check_free_memory
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset
from spacesim.learning.lights import sunlit_frames
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.sampling.rays import camera_rows

A_PIXEL = 12  #: bytes on the device

log = logging.getLogger(__name__)


@dataclass
class Pixels:
    """P pixels of V training pictures."""

    color: UInt32  #: [P] 8 bits a channel, red lowest, straight alpha
    place: UInt32  #: [P] column + 2^16 row
    view: UInt32  #: [P] number of the picture
    count: UInt32  #: of width 1, P
    cameras: Float  #: [V * 16] see `rays.camera_rows`
    suns: Float  #: [V * 3] towards the Sun, unit; 0 where the field does not take it
    extent: Float  #: [3] of the box


def training_pixels(dataset: Dataset, box: SceneBox, suns: bool) -> Pixels:
    """Of a dataset's training pictures. suns: each must name its Sun, and those of `sunlit_frames` are taken
    that see all of it: the loss compares with full sunlight.

    Raises InputError where no ray of a pixel that counts crosses the box, for a picture without a Sun, and where
    `sunlit_frames` does; MemoryError where the pixels do not fit.
    """
    if not dataset.train:
        raise InputError(f"{dataset.root}: expected at least one training image, found none")
    for frame in dataset.train:
        if suns and frame.sun is None:
            raise InputError(
                f"{dataset.root}: expected sun_direction in every training frame, or the method nerf, which takes "
                f"no Sun, found none in {frame.file_path}"
            )
    if suns:
        dataset = replace(dataset, train=tuple(dataset.train[number] for number in sunlit_frames(dataset, whole=True)))
    exposures = {frame.exposure for frame in dataset.train}
    if len(exposures) > 1:
        log.warning("%s: pictures name several exposures, which a radiance field takes for one", dataset.root)
    parts: list[tuple[np.ndarray, ...]] = []
    outside: list[str] = []
    for number, frame in enumerate(dataset.train):
        image = load_image(dataset, frame)
        row, column = np.nonzero(image.valid & crosses(frame.camera, box))
        rgba = np.concatenate([image.rgb, image.alpha[..., None]], axis=-1)[row, column]
        colors = np.ascontiguousarray(np.rint(rgba * 255).astype(np.uint8)).view("<u4").ravel()
        parts.append((colors, (column + (row << 16)).astype(np.uint32), np.full(len(row), number, np.uint32)))
        if not len(row):
            outside.append(frame.file_path)
    color, place, view = (np.concatenate(group) for group in zip(*parts, strict=True))
    if not len(color):
        raise InputError(f"{dataset.root}: expected pictures of what is in the scene box, found rays that all miss it")
    if outside:
        shown = f"{len(outside)} of {len(dataset.train)} pictures show nothing of the scene box and are left out"
        log.warning("%s: %s, the first is %s", dataset.root, shown, outside[0])
    check_free_memory(A_PIXEL * len(color), f"{dataset.root}: its {len(color)} training pixels")
    towards = [frame.sun.direction if suns and frame.sun else np.zeros(3) for frame in dataset.train]
    return Pixels(
        upload(color, ad.UInt32),
        upload(place, ad.UInt32),
        upload(view, ad.UInt32),
        dr.opaque(ad.UInt32, len(color)),
        upload(camera_rows([frame.camera for frame in dataset.train], box)),
        upload(np.array(towards)),
        upload(box.extent),
    )


def crosses(camera: Camera, box: SceneBox) -> np.ndarray:
    """[H, W] bool: whether the ray through a pixel's centre crosses the box."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rotation = camera.world_from_camera[:3, :3]
    along = (rotation[:, 2] + v[:, None] * rotation[:, 1])[:, None] + u[:, None] * rotation[:, 0]  # [H, W, 3]
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    corners = np.stack([box.low, box.low + box.size]) - camera.position
    ends: Array = corners[:, None, None] / along
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.asarray(far > np.maximum(near, 0))
