"""What `rasterization` takes: checks with one sentence each, and what of a call is no tensor."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import index
from typing import SupportsFloat, SupportsIndex

from torch import Tensor

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
CAMERA_MODELS = ("pinhole", "ortho")


@dataclass(frozen=True)
class RasterSettings:
    """What of a call is no tensor."""

    width: int  #: pixels
    height: int  #: pixels
    near: float  #: metres
    far: float  #: metres
    radius_clip: float  #: pixels; splats no larger are not drawn
    eps2d: float  #: pixels^2 added to the screen-space covariance
    antialiased: bool  #: what that adds to a splat's area is taken from its opacity
    ortho: bool  #: orthographic cameras, not pinhole cameras
    degree: int | None  #: of the harmonics; None where colours are given


@lru_cache(maxsize=256)
def raster_settings(
    width: int,
    height: int,
    near: float,
    far: float,
    radius_clip: float,
    eps2d: float,
    antialiased: bool,
    ortho: bool,
    degree: int | None,
) -> RasterSettings:
    """`RasterSettings`, one object for the same values: recorded calls know it by identity."""
    return RasterSettings(width, height, near, far, radius_clip, eps2d, antialiased, ortho, degree)


def check_unsupported(arguments: Mapping[str, object]) -> None:
    """Raises ValueError for the first argument that asks for something: each is False or None where it does not."""
    for name, value in arguments.items():
        if name == "rolling_shutter":
            is_set = value is not None and getattr(value, "name", "GLOBAL") != "GLOBAL"
        else:
            is_set = value is not None and not (isinstance(value, int) and not value)
        if is_set:
            raise ValueError(f"{name}: not supported by spacesim.torch.rasterization, leave it out")


def check_choice(name: str, value: str, known: Sequence[str]) -> None:
    """Raises ValueError where `value` is not one of `known`."""
    if value not in known:
        raise ValueError(f"{name}: expected one of {', '.join(known)}, found {value!r}")


def checked_size(name: str, value: SupportsIndex) -> int:
    """A size in pixels as Python's number. Raises ValueError for what is no whole number above 0."""
    size = checked_whole(name, value)
    if size < 1:
        raise ValueError(f"{name}: expected at least 1, found {size}")
    return size


def checked_whole(name: str, value: SupportsIndex) -> int:
    """A whole number, also numpy's, as Python's. Raises ValueError for what is none."""
    try:
        return index(value)
    except TypeError:
        raise ValueError(f"{name}: expected a whole number, found {value!r:.60}") from None


def checked_numbers(numbers: Mapping[str, SupportsFloat]) -> dict[str, float]:
    """`near_plane`, `far_plane`, `radius_clip` and `eps2d`, also numpy's, as Python's numbers. Raises ValueError for
    what is no number, for planes in no order and for a negative `eps2d`."""
    checked = {}
    for name, value in numbers.items():
        try:
            checked[name] = float("nan" if isinstance(value, str) else value)
        except (TypeError, ValueError, OverflowError):
            checked[name] = math.nan
        if math.isnan(checked[name]):
            raise ValueError(f"{name}: expected a number, found {value!r:.60}")
    near, far, eps2d = checked["near_plane"], checked["far_plane"], checked["eps2d"]
    if far < near:
        raise ValueError(f"far_plane: expected at least near_plane, {near:g}, found {far:g}")
    if not 0 <= eps2d < math.inf:
        raise ValueError(f"eps2d: expected 0 or more, found {eps2d:g}")
    return checked


def check_shapes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
) -> tuple[int, int]:
    """(N, C). Raises ValueError naming the argument that does not fit."""
    shapes = (
        ("means", means, "N", (3,)),
        ("quats", quats, "N", (4,)),
        ("scales", scales, "N", (3,)),
        ("opacities", opacities, "N", ()),
        ("viewmats", viewmats, "C", (4, 4)),
        ("Ks", Ks, "C", (3, 3)),
    )
    for name, tensor, _, _ in shapes:
        check_tensor(name, tensor)
    for name, tensor, letter, rest in shapes:
        if tensor.dim() != 1 + len(rest):
            few = "; add [None]" if letter == "C" else ""
            hint = "; batches are not supported" if tensor.dim() > len(rest) else few
            expected = ", ".join([letter, *map(str, rest)])
            raise ValueError(f"{name}: expected [{expected}], found {list(tensor.shape)}{hint}")
    counts = {"N": len(means), "C": len(viewmats)}
    for name, tensor, letter, rest in shapes:
        shape = (counts[letter], *rest)
        if tensor.shape != shape:
            raise ValueError(f"{name}: expected {list(shape)}, found {list(tensor.shape)}")
        check_device(name, tensor, means.device)
    count, cameras = counts["N"], counts["C"]
    if count < 1 or cameras < 1:
        raise ValueError(f"means, viewmats: expected at least one each, found {count} and {cameras}")
    return count, cameras


def check_tensor(name: str, value: object) -> None:
    """Raises ValueError for what is no tensor of real numbers."""
    if not isinstance(value, Tensor):
        raise ValueError(f"{name}: expected a tensor, found one of type {type(value).__name__}")
    if value.is_complex():
        raise ValueError(f"{name}: expected real numbers, found {value.dtype}")
    if value.device.type not in ("cpu", "cuda"):
        raise ValueError(f"{name}: expected a tensor on a CPU or on CUDA, found one on {value.device}")


def check_device(name: str, tensor: Tensor, device: object) -> None:
    """Raises ValueError for a tensor elsewhere."""
    if tensor.device != device:
        raise ValueError(f"{name}: expected a tensor on {device}, found one on {tensor.device}")


def check_colors(
    colors: Tensor, backgrounds: Tensor | None, sh_degree: int | None, render_mode: str, means: Tensor, cameras: int
) -> None:
    """Raises ValueError where colours do not fit the harmonics, the Gaussians or the background."""
    check_tensor("colors", colors)
    count, shape = len(means), tuple(colors.shape)
    check_device("colors", colors, means.device)
    if backgrounds is not None:
        check_tensor("backgrounds", backgrounds)
        check_device("backgrounds", backgrounds, means.device)
    if sh_degree is None:
        if shape[:-1] not in ((count,), (cameras, count)):
            raise ValueError(f"colors: expected [{count}, D] or [{cameras}, {count}, D], found {list(shape)}")
    else:
        if not 0 <= sh_degree <= 3:
            raise ValueError(f"sh_degree: expected 0 to 3, found {sh_degree}")
        if shape[:-2] not in ((count,), (cameras, count)) or shape[-1] != 3 or shape[-2] < (sh_degree + 1) ** 2:
            raise ValueError(f"colors: expected harmonics [{count}, K, 3] of degree {sh_degree}, found {list(shape)}")
    channels = 3 if sh_degree is not None else shape[-1]
    sizes = (channels, 1) if render_mode in ("D", "ED") else (channels,)  # of depths alone backgrounds count nothing
    if backgrounds is not None and tuple(backgrounds.shape) not in [(cameras, size) for size in sizes]:
        raise ValueError(f"backgrounds: expected [{cameras}, {channels}], found {list(backgrounds.shape)}")
    if render_mode == "D" and shape[-1] == 0:
        raise ValueError("colors: expected at least one channel, found none")
