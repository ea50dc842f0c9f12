"""Masks from a folder, made by hand or by another program, and what they say of the pixels that they cut off."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image as PillowImage

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.importers.importer import Option

MASKED = "empty", "unknown"
"""Of the pixels that are black in a mask: nothing of the object is there, which training learns (silhouette_path); or
nothing is known of them, and training ignores them (mask_path)."""
AUTO, NO_MASKS = "auto", "none"  #: in place of a folder of masks
NO_OBJECT = "masks: expected an object in the pictures, found none; give masks, or masks none"

_log = logging.getLogger(__name__)


def check_shown(empty: Sequence[str], count: int, sentence: str = NO_OBJECT) -> None:
    """Log how many of `count` masks show nothing. empty: names of their pictures. Raises InputError with `sentence`
    where all do."""
    if count and len(empty) == count:
        raise InputError(sentence)
    if empty:
        _log.warning("masks: nothing is found in %d of %d pictures, %s first", len(empty), count, empty[0])


class WatchedMasks:
    """What makes masks [H, W] bool, by the names of pictures, and which of them show nothing. Raises InputError where
    none shows anything."""

    def __init__(self, makers: Mapping[str, Callable[[], np.ndarray]]) -> None:
        self.makers = {name: partial(self._make, name, make) for name, make in makers.items()}
        self._shows: dict[str, bool] = {}
        if not any(make().any() for make in self.makers.values()):
            self.warn()

    def warn(self) -> None:
        """Of those made by now, as `check_shown` does."""
        check_shown([name for name, shows in self._shows.items() if not shows], len(self._shows))

    def _make(self, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
        mask = make()
        self._shows[name] = bool(mask.any())
        return mask


def mask_options(default: str, masked: str = "default: empty") -> tuple[Option, Option]:
    """Of importers that take masks. default: what they do without; masked: which kind of pixels they take then."""
    return (
        Option(
            "masks",
            Path,
            "DIR|auto|none",
            "masks named like the pictures (of a video: like data/images of an earlier import), white = object; auto: "
            f"the object is cut out by what space looks like; none: the background stays (default: {default})",
        ),
        Option(
            "masked",
            str,
            "WHAT",
            "pixels black in a mask: empty = nothing is there, and training learns it; unknown = training ignores "
            f"them ({masked})",
            MASKED,
        ),
    )


def over_black(pixels: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 of what `read_png` gives."""
    pixels = as_color(pixels)
    if pixels.shape[2] == 3:
        return pixels
    return ((pixels[..., :3].astype(np.uint16) * pixels[..., 3:] + 127) // 255).astype(np.uint8)


def as_color(pixels: np.ndarray) -> np.ndarray:
    """[H, W, 3] or [H, W, 4] uint8 of what `read_png` gives."""
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels


class MaskFolder:
    """Masks by the names of the pictures. Raises InputError where there is no folder."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"masks: expected a folder, found {'a file' if folder.exists() else 'none'} at {folder}")
        self.folder = folder
        files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
        self._by_stem = {path.relative_to(folder).with_suffix("").as_posix(): path for path in reversed(files)}

    def find(self, name: str) -> Path | None:
        """The mask of the picture `name` (relative, with suffix): DIR/name.png, as COLMAP has it, else a file that
        differs in its suffix alone."""
        return self._by_stem.get(name) or self._by_stem.get(PurePosixPath(name).with_suffix("").as_posix())

    def find_all(self, names: Iterable[str]) -> dict[str, Path]:
        """Masks of pictures. Logs how many have none; raises InputError where none has one."""
        names = list(names)
        paths = {name: path for name in names if (path := self.find(name)) is not None}
        if not paths:
            found = next((path.name for path in self._by_stem.values()), "no file")
            raise InputError(
                f"masks: expected masks named like the pictures, {names[0]} to {names[-1]}, found {found} in "
                f"{self.folder}"
            )
        if len(paths) < len(names):
            first = next(name for name in names if name not in paths)
            lacking = len(names) - len(paths)
            _log.warning(
                "%s: %d of %d pictures have no mask and count as a whole, %s first",
                self.folder, lacking, len(names), first,
            )  # fmt: skip
        return paths


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """[H, W] bool, True where the mask is white: its alpha where it has one that is not 1 everywhere, else its
    brightest channel, from one half on, or from 1 on where no pixel has more. One of the same shape but another size is
    scaled, by the nearest pixel.

    Raises InputError where it is no picture or of another shape.
    """
    pixels = read_png(path)
    values = pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=-1)
    if pixels.ndim == 3 and pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        values = pixels[..., 3]  # a picture that has been cut out
    white = values >= (1 if values.max() == 1 else (np.iinfo(values.dtype).max + 1) // 2)
    return _scaled(path, white, width, height)


def read_silhouette(path: Path, width: int, height: int) -> np.ndarray:
    """[H, W] bool, True where the file has another value than 0. Scaled, and raises InputError, as `read_mask`."""
    pixels = read_png(path)
    return _scaled(path, (pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=-1)) > 0, width, height)


def check_shape(path: Path, found_width: int, found_height: int, width: int, height: int) -> None:
    """Raise InputError where what belongs to a picture of width x height pixels has other proportions."""
    if abs(found_width * height - found_height * width) > max(found_width, found_height, width, height):
        expected = f"{width}x{height} pixels, or a multiple or fraction, as its picture"
        raise InputError(f"{path}: expected {expected}, found {found_width}x{found_height}")


def _scaled(path: Path, white: np.ndarray, width: int, height: int) -> np.ndarray:
    mask_height, mask_width = white.shape
    if (mask_width, mask_height) == (width, height):
        return white
    check_shape(path, mask_width, mask_height, width, height)
    resized = PillowImage.fromarray(white.astype(np.uint8)).resize((width, height), PillowImage.Resampling.NEAREST)
    return np.asarray(resized) > 0
