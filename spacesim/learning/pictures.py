"""One prediction as a PNG to look at or an EXR to compute with."""

from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.images import srgb_from_linear, write_exr, write_png
from spacesim.data.images.tone import as_bytes
from spacesim.data.integrity.outputs import check_output
from spacesim.learning.prediction import MaterialView, Prediction

LIT, SHADOWED = (222, 222, 216), (58, 64, 82)  #: sRGB colours of visibility 1 and 0


def write_picture(prediction: Prediction, kind: str, path: Path) -> None:
    """kind: "rgb" (PNG: straight alpha; EXR: sRGB over black, or `Prediction.linear` where there is one), "alpha",
    "depth" (PNG: near is bright; EXR: metres), "normal" (PNG: world x, y, z from -1 to 1 as red, green, blue; EXR: the
    vectors) or "shadow" (PNG: `shadow_colors`; EXR: visibility, 1 where all of the Sun is seen).

    Raises InputError as `check_output` does, and for shadows of a method without.
    """
    check_output(path := Path(path), "picture")
    plane = getattr(prediction, "visibility" if kind == "shadow" else kind)
    if plane is None:
        raise InputError("kind: expected another than shadow, of a run whose method predicts none, found shadow")
    if kind == "shadow":
        plane = np.clip(plane, 0, 1)  # a sum of weights over their sum is rounded
    if path.suffix.lower() == ".exr":
        shown = prediction.linear if kind == "rgb" else None
        layers = {kind: plane} if shown is None else {"linear": shown}
        write_exr(path, {name: layer.astype(np.float32) for name, layer in layers.items()})
    elif kind == "rgb":
        alpha = np.clip(prediction.alpha, 0, 1)[..., None]
        straight = np.where(alpha > 0, plane / np.maximum(alpha, 1e-6), 0)
        write_png(path, as_bytes(np.concatenate([straight, alpha], axis=-1)))
    elif kind == "depth":
        write_png(path, as_bytes(_near_is_bright(plane)))
    elif kind == "shadow":
        write_png(path, as_bytes(shadow_colors(prediction)))
    elif kind == "normal":
        surface = np.any(plane != 0, axis=-1, keepdims=True)
        write_png(path, as_bytes(np.where(surface, 0.5 + 0.5 * plane, 0)))
    else:
        write_png(path, as_bytes(plane))


def write_material(view: MaterialView, kind: str, path: Path) -> None:
    """kind: "albedo", "specular" (PNG: as sRGB values, straight alpha; EXR: linear), "roughness" or "metallic". Raises
    InputError as `check_output` does."""
    check_output(path, "picture")
    plane = np.asarray(getattr(view, kind))
    if path.suffix.lower() == ".exr":
        write_exr(path, {kind: plane.astype(np.float32)})
    elif plane.ndim == 3:
        alpha = np.clip(view.alpha, 0, 1)[..., None]
        write_png(path, as_bytes(np.concatenate([srgb_from_linear(plane), alpha], axis=-1)))
    else:
        write_png(path, as_bytes(plane))


def shadow_colors(prediction: Prediction) -> np.ndarray:
    """[H, W, 3] values in [0, 1], over black: SHADOWED where the Sun is hidden, LIT where it is seen. Raises ValueError
    for a prediction without visibility."""
    if prediction.visibility is None:
        raise ValueError("prediction: expected one with visibility, found none")
    lit, shadowed = (np.array(color) / 255 for color in (LIT, SHADOWED))
    visibility = np.clip(np.nan_to_num(prediction.visibility), 0, 1)[..., None]
    return (shadowed + visibility * (lit - shadowed)) * np.clip(prediction.alpha, 0, 1)[..., None]


def _near_is_bright(depth: np.ndarray) -> np.ndarray:
    """[H, W] 1 at the nearest surface to 0.2 at the farthest, 0 where there is none."""
    surface = depth > 0
    if not surface.any():
        return np.zeros_like(depth)
    near, far = depth[surface].min(), depth[surface].max()
    return np.where(surface, 1 - 0.8 * (depth - near) / max(far - near, 1e-9), 0)
