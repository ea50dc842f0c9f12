"""Gaussians as OpenUSD text with a ParticleField3DGaussianSplat.

Source: OpenUSD 26.11, pxr/usd/usdVol/schema.usda. Text needs no library; `usdcat -o model.usdc` makes it small.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import write_bytes
from spacesim.splat.export.frame import Up, unit_quaternions
from spacesim.splat.export.glb import LARGEST_LOG, opacity_of
from spacesim.splat.raster.gaussians import Gaussians

ROWS = 4096  #: of an array that are made text at once


def write_usd(gaussians: Gaussians, path: Path, up: Up = "z", scale: float = 1.0) -> None:
    """Write linear scales, opacities from 0 to 1, unit quaternions (w, x, y, z) and the harmonics of each Gaussian one
    after the other; colours are sRGB values, as the attribute says; drawn in the order of depth, as ours are. up:
    which of the file's axes points up, "z" or "y", USD knows no other;  scale: units a metre, which the file records

    Raises InputError for another one and where the file cannot be written.
    """
    if up not in ("z", "y"):
        raise InputError(f"up: expected z or y in USD, found {up}")
    arrays = gaussians.to_numpy()
    scales = np.exp(np.clip(arrays["log_scales"], -LARGEST_LOG, LARGEST_LOG))
    means, reach = arrays["means"], 3 * scales.max(axis=1, keepdims=True, initial=0)
    corners = (means - reach).min(axis=0, initial=np.inf), (means + reach).max(axis=0, initial=-np.inf)
    extent = np.stack(corners) if len(means) else np.zeros((0, 3))
    harmonics = arrays["sh"].reshape(-1, 3)
    parts = [
        f'#usda 1.0\n(\n    defaultPrim = "splats"\n    metersPerUnit = {1 / scale:.9g}\n'
        f'    upAxis = "{up.upper()}"\n)\n\n'
        f'def ParticleField3DGaussianSplat "splats"\n{{\n    float3[] extent = ',
        *_text(extent),
        "\n    point3f[] positions = ",
        *_text(means),
        "\n    quatf[] orientations = ",
        *_text(unit_quaternions(arrays["quaternions"])),
        "\n    float3[] scales = ",
        *_text(scales),
        "\n    float[] opacities = ",
        *_text(opacity_of(arrays["logit_opacities"])),
        f"\n    uniform int radiance:sphericalHarmonicsDegree = {gaussians.sh_degree}"
        "\n    float3[] radiance:sphericalHarmonicsCoefficients = ",
        *_text(harmonics),
        ' (\n        colorSpace = "srgb_rec709_scene"\n    )\n'
        '    uniform token projectionModeHint = "perspective"\n    uniform token sortingModeHint = "zDepth"\n}\n',
    ]
    write_bytes(path, "".join(parts).encode())


def _text(values: np.ndarray) -> Iterator[str]:
    """An array [N] or [N, C] as USD writes it, with the nine digits that single precision has."""
    yield "["
    row = "%.9g" if values.ndim == 1 else f"({', '.join(values.shape[1] * ['%.9g'])})"
    for first in range(0, len(values), ROWS):
        some = values[first : first + ROWS].astype(np.float32)
        yield (", " if first else "") + ", ".join(len(some) * [row]) % tuple(some.ravel().tolist())
    yield "]"
