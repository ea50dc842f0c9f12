"""What a frame shows to training and evaluating."""

from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.images.lens import Resampling, Undistortion
from spacesim.data.images.png import read_png
from spacesim.data.records import Camera, Dataset, Frame, Image, check_frame


def load_image(dataset: Dataset, frame: Frame) -> Image:
    """The image of `frame` as trained on and compared with, undistorted where the frame says so: rgb [H, W, 3] sRGB
    values in [0, 1], alpha [H, W], valid [H, W].

    Straight alpha comes from the file, else from the silhouette, else it is 1. Pixels to be ignored are opaque
    black whatever the file holds, so that it cannot reach their neighbours through a window. Raises InputError
    where a file is missing, broken or of another size than the camera.
    """
    check_frame(dataset, frame)
    pixels = read_sized(dataset.root / frame.file_path, frame.camera)
    values = np.atleast_3d(pixels).astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    alpha = np.ones(values.shape[:2], np.float32)
    if values.shape[2] == 4:
        alpha = np.ascontiguousarray(values[..., 3])
    elif frame.silhouette_path is not None:
        alpha = (read_labels(dataset.root / frame.silhouette_path, frame.camera) > 0).astype(np.float32)
    valid = np.ones(alpha.shape, bool)
    if frame.mask_path is not None:
        valid = read_labels(dataset.root / frame.mask_path, frame.camera) > 0
    rgb = np.ascontiguousarray(np.broadcast_to(values[..., :3], (*alpha.shape, 3)))
    image = Image(*_without_ignored(rgb, alpha, valid), valid)
    return undistort(image, frame.camera, frame.distortion) if any(frame.distortion) else image


def undistort(image: Image, camera: Camera, distortion: tuple[float, ...]) -> Image:
    """`image` as the pinhole `camera` sees it, resampled bilinearly. What comes from outside is not valid.

    distortion: see `distort_points`. Colours are weighted by alpha, so that none bleeds in from where alpha is 0.
    Pixels that are not valid are opaque black.
    """
    return resample(image, Undistortion(camera, distortion))


def resample(image: Image, source: Resampling) -> Image:
    """`image` in the pixels of `source`, as `undistort`."""
    alpha = source.linear(image.alpha)
    weighted = source.linear(image.rgb * image.alpha[..., None])
    rgb = np.clip(weighted / np.where(alpha > 0, alpha, 1)[..., None], 0, 1)
    valid = source.inside & (source.linear(image.valid.astype(np.float32)) > 0.999)  # no ignored pixel takes part
    return Image(*_without_ignored(rgb, alpha, valid), valid)


def _without_ignored(rgb: np.ndarray, alpha: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rgb, alpha), opaque black where not `valid`."""
    return np.where(valid[..., None], rgb, np.float32(0)), np.where(valid, alpha, np.float32(1))


def read_sized(path: Path, camera: Camera) -> np.ndarray:
    """`read_png` of a picture as large as the camera's. Raises InputError for another size."""
    pixels = read_png(path)
    check_size_of(path, (pixels.shape[1], pixels.shape[0]), camera)
    return pixels


def check_size_of(path: Path, size: tuple[int, int], camera: Camera) -> None:
    """Raise InputError where a picture of `size` (width, height) is not of the camera's."""
    if size != (camera.width, camera.height):
        expected = f"{camera.width}x{camera.height} pixels as the camera says"
        raise InputError(f"{path}: expected {expected}, found {size[0]}x{size[1]}")


def read_labels(path: Path, camera: Camera) -> np.ndarray:
    """[H, W] of a mask or silhouette, its brightest channel. Raises InputError for another size than the camera's."""
    pixels = read_sized(path, camera)
    return pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=-1)
