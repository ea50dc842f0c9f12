"""Pictures of a lens and their masks as frames: copied where our cameras can say the lens, else resampled."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array
from spacesim.data.images import BLIND, Resampling, Undistortion, has_alpha, image_size, read_png, resample
from spacesim.data.importers.lenses import Lens
from spacesim.data.importers.masks import read_silhouette
from spacesim.data.importers.writing import ImportedFrame
from spacesim.data.records import Camera, Image, Sun

_UNDISTORTING = 120  # bytes a pixel, for a while
_COARSE = 64  # pixels

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SourceView:
    """A picture, from where and through which lens it was taken."""

    name: str  #: of the frame
    path: Path  #: of the picture, which has the lens's size
    world_from_camera: Array  #: [4, 4]
    lens: Lens  #: intrinsics, size and distortion of the picture
    mask: Callable[[], np.ndarray] | None = None  #: makes [H, W] bool: the object, or known, as the frames' maker says
    sun: Sun | None = None  #: None where the source does not name it
    silhouette: Path | None = None  #: other than 0 = object
    depth: Callable[[], np.ndarray] | None = None  #: makes uint16 [H, W], steps along the optical axis
    keys: Mapping[str, JsonValue] = field(default_factory=dict)  #: as of `ImportedFrame`


@dataclass
class FrameImporter:
    """Makes frames of views. Where a lens is more than Brown-Conrady's, pictures and masks are resampled to the pinhole
    camera in its middle, and what it does not image is unknown."""

    masked: str = "empty"  #: what black in a mask means, see `masks.MASKED`
    guessed: bool = False  #: of masks that show nothing, nothing is known either
    _resampling: Callable[[Lens], Resampling] = field(init=False)  # of a lens: two are kept
    _seen_share: Callable[[Lens], float] = field(init=False)
    _warned: set[Lens] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        self._resampling = lru_cache(maxsize=2)(_undistortion)
        self._seen_share = lru_cache(maxsize=None)(self._find_seen_share)

    def frame(self, view: SourceView) -> ImportedFrame:
        """Pictures are read when the frame is written. Raises InputError for a camera that cannot be."""
        lens, empty = view.lens, self.masked == "empty"
        try:
            camera = Camera(view.world_from_camera, lens.width, lens.height, *lens.pinhole)
        except InputError as error:
            raise InputError(f"{view.path}: {error}") from None
        distortion = lens.distortion
        resampled = distortion is None
        self._warn_of_blindness(lens, view.path)
        cut_out = view.mask is not None and empty and has_alpha(view.path)
        unknown = view.mask is not None and (self.guessed or not empty)
        unknown = unknown or (resampled and self._seen_share(lens) < 1)
        in_file = view.mask is not None and empty and not cut_out
        made = in_file or (
            view.silhouette is not None and (resampled or image_size(view.silhouette) != (lens.width, lens.height))
        )
        silhouette = (lambda: self._silhouette(view)) if made else view.silhouette
        return ImportedFrame(
            name=view.name,
            picture=(lambda: self._picture(view)) if resampled or cut_out else view.path,
            camera=camera,
            distortion=distortion or (),
            sun=view.sun,
            silhouette=silhouette,
            mask=(lambda: self._known(view)) if unknown else None,
            depth=None if view.depth is None else partial(self._depth, view.depth, view),
            keys=view.keys,
        )

    def _find_seen_share(self, lens: Lens) -> float:
        """Of the pinhole camera's pixels, those that the lens images; of Brown-Conrady's lenses on a coarse grid."""
        if lens.distortion is None:
            return float(self._resampling(lens).inside.mean())
        small = lens.scaled(min(lens.width, _COARSE), min(lens.height, _COARSE))
        camera = Camera(np.eye(4), small.width, small.height, *small.pinhole)
        return float(Undistortion(camera, lens.distortion).inside.mean()) if lens.distortion else 1.0

    def _warn_of_blindness(self, lens: Lens, path: Path) -> None:
        """Once of a lens."""
        if lens not in self._warned and (share := self._seen_share(lens)) < BLIND:
            self._warned.add(lens)
            _log.warning(
                "%s: its lens images %.2g %% of the picture, the rest is unknown: its parameters may be wrong",
                path, 100 * share,
            )  # fmt: skip

    def _picture(self, view: SourceView) -> np.ndarray:
        """uint8, with the file's channels."""
        pixels = read_png(view.path)
        values = np.atleast_3d(pixels).astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
        source = self._resampling(view.lens) if view.lens.distortion is None else None
        if values.shape[2] < 4:
            shown = values if source is None else source.linear(values)
            return np.rint(255 * shown[..., 0] if shown.shape[2] == 1 else 255 * shown).astype(np.uint8)
        alpha = values[..., 3]
        if view.mask is not None and self.masked == "empty":
            found = self._found(view)
            alpha = alpha if found is None else alpha * found
        image = Image(values[..., :3], alpha, np.ones(alpha.shape, bool))
        if source is not None:
            image = resample(image, source)
        return np.rint(255 * np.concatenate([image.rgb, image.alpha[..., None]], axis=-1)).astype(np.uint8)

    def _found(self, view: SourceView) -> np.ndarray | None:
        """[H, W] bool of the view's mask; None of a guess that shows nothing."""
        assert view.mask is not None
        mask = view.mask()
        return mask if mask.any() or not self.guessed else None

    def _silhouette(self, view: SourceView) -> np.ndarray | None:
        """255 object, 0 none; None where it is not known."""
        known: np.ndarray | None
        if view.mask is not None and self.masked == "empty":
            known = self._found(view)
        else:
            assert view.silhouette is not None
            known = read_silhouette(view.silhouette, view.lens.width, view.lens.height)
        return None if known is None else self._labels(view, np.where(known, 255, 0).astype(np.uint8))

    def _known(self, view: SourceView) -> np.ndarray | None:
        """255 counts, 0 unknown; None where a guess leaves nothing unknown."""
        known = np.ones((view.lens.height, view.lens.width), bool)
        if view.mask is not None and self.masked == "unknown":
            known = view.mask()
        elif view.mask is not None and self.guessed:
            known &= self._found(view) is not None
        if view.lens.distortion is None:
            source = self._resampling(view.lens)
            known = source.inside & (source.linear(known.astype(np.float32)) > 0.999)  # no unknown pixel takes part
        if self.guessed and self.masked == "empty" and known.all():
            return None
        return np.where(known, 255, 0).astype(np.uint8)

    def _depth(self, read: Callable[[], np.ndarray], view: SourceView) -> np.ndarray:
        return self._labels(view, read())

    def _labels(self, view: SourceView, labels: np.ndarray) -> np.ndarray:
        return self._resampling(view.lens).nearest(labels) if view.lens.distortion is None else labels


def fitted(lens: Lens, path: Path) -> Lens:
    """The lens before a picture, which may have a fraction of the camera's size, its sides rounded. Raises InputError
    for one of another shape."""
    width, height = image_size(path)
    if (width, height) == (lens.width, lens.height):
        return lens
    apart = abs(width - lens.width * height / lens.height), abs(height - lens.height * width / lens.width)
    if min(apart) > 1 or width == lens.width or height == lens.height:
        expected = f"{lens.width}x{lens.height} pixels as its camera says, or a multiple or fraction"
        raise InputError(f"{path}: expected {expected}, found {width}x{height}")
    return lens.scaled(width, height)


def _undistortion(lens: Lens) -> Resampling:
    check_memory(_UNDISTORTING * lens.width * lens.height, f"undistorting {lens.width} x {lens.height} pixels")
    return lens.undistortion()
