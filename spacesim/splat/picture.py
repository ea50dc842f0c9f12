"""One prediction as a PNG to look at or an EXR to compute with."""

from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.images import write_exr, write_png
from spacesim.splat.run import Prediction


def write_picture(prediction: Prediction, kind: str, path: Path) -> None:
    """kind: "rgb" (PNG: straight alpha; EXR: sRGB over black), "alpha", "depth" (PNG: near is bright; EXR: metres)
    or "normal" (PNG: world x, y, z from -1 to 1 as red, green, blue; EXR: the vectors).

    Raises InputError for another suffix than .png or .exr.
    """
    path, plane = Path(path), getattr(prediction, kind)
    if path.suffix == ".exr":
        write_exr(path, {kind: plane.astype(np.float32)})
    elif path.suffix != ".png":
        raise InputError(f"{path}: expected a file name that ends in .png or .exr")
    elif kind == "rgb":
        alpha = np.clip(prediction.alpha, 0, 1)[..., None]
        straight = np.where(alpha > 0, plane / np.maximum(alpha, 1e-6), 0)
        write_png(path, _bytes(np.concatenate([straight, alpha], axis=-1)))
    elif kind == "depth":
        write_png(path, _bytes(_near_is_bright(plane)))
    elif kind == "normal":
        surface = np.any(plane != 0, axis=-1, keepdims=True)
        write_png(path, _bytes(np.where(surface, 0.5 + 0.5 * plane, 0)))
    else:
        write_png(path, _bytes(plane))


def _bytes(plane: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(plane, 0, 1) * 255).astype(np.uint8)


def _near_is_bright(depth: np.ndarray) -> np.ndarray:
    """[H, W] 1 at the nearest surface to 0.2 at the farthest, 0 where there is none."""
    surface = depth > 0
    if not surface.any():
        return np.zeros_like(depth)
    near, far = depth[surface].min(), depth[surface].max()
    return np.where(surface, 1 - 0.8 * (depth - near) / max(far - near, 1e-9), 0)
