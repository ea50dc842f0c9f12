"""LPIPS (thesis 2.20; Zhang et al. 2018): AlexNet, linear layers of version 0.1, in plain torch.

torch comes with the extra `lpips`. The weights are files of the user's: nothing is downloaded, and nothing is
unpickled (`torch.load` with `weights_only=True` accepts tensors alone).
"""

import hashlib
import importlib.util
import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from safetensors.numpy import load as load_tensors

from spacesim.data.errors import InputError
from spacesim.data.files import read_bytes

if TYPE_CHECKING:
    from torch import Tensor

MAX_WEIGHTS_BYTES = 1 << 30  #: bytes: those of AlexNet take 244 MB

BACKBONE_FILE = "alexnet-owt-7be5be79.pth"
"""AlexNet on ImageNet, as torchvision publishes it: https://download.pytorch.org/models/ and this name."""

LINEAR_FILE = "alex.pth"
"""The linear layers, `lpips/weights/v0.1/alex.pth` of the authors' repository and of their package lpips 0.1.4."""

SHA256 = {
    BACKBONE_FILE: "7be5be79",
    LINEAR_FILE: "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
}
"""How the files' SHA-256 begin: torchvision's is in the name, the other was computed from the package."""

SOURCES = {
    BACKBONE_FILE: f"{BACKBONE_FILE} (download.pytorch.org/models/{BACKBONE_FILE})",
    LINEAR_FILE: f"{LINEAR_FILE} (lpips/weights/v0.1/ in the package lpips)",
}
"""Where each is to be had, in words."""

MIN_SIDE = 31
"""Smallest height and width, pixels, that leave AlexNet's second pooling something to pool."""

INSTALL = "pip install 'spacesim[lpips]'"

# AlexNet's convolutions: place in torchvision's `features`, weight shape, stride, padding, pooling before it.
_LAYERS = (
    (0, (64, 3, 11, 11), 4, 2, False),
    (3, (192, 64, 5, 5), 1, 2, True),
    (6, (384, 192, 3, 3), 1, 1, True),
    (8, (256, 384, 3, 3), 1, 1, False),
    (10, (256, 256, 3, 3), 1, 1, False),
)
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of inputs in [-1, 1]; version 0.1

_SHAPES: dict[str, tuple[int, ...]] = {}
for _index, (_place, _shape, *_rest) in enumerate(_LAYERS):
    _SHAPES[f"features.{_place}.weight"] = _shape
    _SHAPES[f"features.{_place}.bias"] = _shape[:1]
    _SHAPES[f"lin{_index}.model.1.weight"] = (1, _shape[0], 1, 1)


@dataclass(frozen=True, eq=False)
class Lpips:
    """The network."""

    weights: "Mapping[str, Tensor]"  #: by their names in the published files

    def __call__(self, prediction: np.ndarray, truth: np.ndarray) -> float | None:
        """Distance of pictures [H, W, 3] of sRGB values in [0, 1]; None if a side is below `MIN_SIDE`."""
        if min(truth.shape[:2]) < MIN_SIDE:
            return None
        total = 0.0
        pairs = zip(self._features(prediction), self._features(truth), strict=True)
        for layer, (a, b) in enumerate(pairs):
            linear = self.weights[f"lin{layer}.model.1.weight"]
            total += float(((_unit(a) - _unit(b)).square() * linear).sum(dim=1).mean())
        return total

    def _features(self, picture: np.ndarray) -> "list[Tensor]":
        """Activations [1, C, h, w] after each of the five rectified convolutions."""
        import torch
        from torch.nn.functional import conv2d, max_pool2d, relu

        scaled = (2.0 * np.asarray(picture, np.float64) - 1.0 - _SHIFT) / _SCALE
        x = torch.from_numpy(np.moveaxis(scaled, -1, 0)[None].astype(np.float32))
        features = []
        for place, _, stride, padding, pooled in _LAYERS:
            weight, bias = (self.weights[f"features.{place}.{kind}"] for kind in ("weight", "bias"))
            x = max_pool2d(x, 3, 2) if pooled else x
            x = relu(conv2d(x, weight, bias, stride=stride, padding=padding))
            features.append(x)
        return features


def find_weights(path: Path | None = None) -> tuple[Path | None, str]:
    """(where the weights are, None if nowhere; one sentence that says so).

    `path`, if given: a .safetensors file with all tensors or a folder with `BACKBONE_FILE` and `LINEAR_FILE`;
    else torch's cache. Raises InputError where `path` is neither.
    """
    folder = path or _torch_cache()
    if path is not None and path.suffix == ".safetensors" and path.is_file():
        return path, f"weights in {path}"
    missing = [name for name in (BACKBONE_FILE, LINEAR_FILE) if not (folder / name).is_file()]
    if not missing:
        return folder, f"weights in {folder}"
    if path is not None:
        raise InputError(
            f"lpips_weights: expected a .safetensors file or a folder with {BACKBONE_FILE} and {LINEAR_FILE}, found "
            f"no {' and no '.join(missing)} in {path}"
        )
    files = " and ".join(SOURCES[name] for name in missing)
    return (
        None,
        f"its weights are missing: put {files} into {folder} or name their folder as lpips_weights",
    )


def load(path: Path | None = None) -> tuple[Lpips | None, str]:
    """(the network, None where torch or the weights are missing; one sentence that says which).

    Raises InputError where `path` names no weights or the files are not the published ones.
    """
    location, sentence = find_weights(path)
    if importlib.util.find_spec("torch") is None:
        return None, f"torch is not installed; type: {INSTALL}"
    if location is None:
        return None, sentence
    import torch

    arrays: Mapping[str, np.ndarray | Tensor]
    if location.is_file():
        arrays = _read_safetensors(location)
        sources = dict.fromkeys(_SHAPES, location)
    else:
        backbone, linear = location / BACKBONE_FILE, location / LINEAR_FILE
        arrays = {**_read_pth(backbone), **_read_pth(linear)}
        sources = {name: linear if name.startswith("lin") else backbone for name in _SHAPES}
    for name, shape in _SHAPES.items():
        shape_read = tuple(arrays[name].shape) if name in arrays else "none"
        if shape_read != shape:
            raise InputError(f"{sources[name]}: expected a tensor {name} of shape {shape}, found {shape_read}")
    return Lpips({name: torch.as_tensor(arrays[name], dtype=torch.float32) for name in _SHAPES}), sentence


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    content = read_bytes(path, "a safetensors file", MAX_WEIGHTS_BYTES)
    try:
        return dict(load_tensors(content))
    except Exception as error:  # of damaged headers, numbers that numpy lacks
        raise InputError(f"{path}: expected a safetensors file, found another ({error})") from None


def _read_pth(path: Path) -> "dict[str, Tensor]":
    import torch

    data = read_bytes(path, "a file of tensors", MAX_WEIGHTS_BYTES)
    expected, digest = SHA256[path.name], hashlib.sha256(data).hexdigest()
    if not digest.startswith(expected):
        raise InputError(f"{path}: expected the published file, whose SHA-256 begins {expected}, found {digest}")
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch documents none of what it raises on damaged files
        reason = str(error).strip().split("\n")[0]
        raise InputError(f"{path}: expected a file of tensors alone, found another ({reason})") from None
    tensors = content if isinstance(content, dict) else {}
    return {name: value for name, value in tensors.items() if isinstance(value, torch.Tensor)}


def _torch_cache() -> Path:
    """Where torch keeps downloaded checkpoints: $TORCH_HOME, else torch in $XDG_CACHE_HOME or ~/.cache."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("TORCH_HOME") or Path(cache) / "torch") / "hub" / "checkpoints"


def _unit(features: "Tensor") -> "Tensor":
    """Features [1, C, h, w] divided by their length over the channels."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
