"""Faster-GS as the peer of the benchmarks: the same splats and camera, its rasterizer, its Adam, fused_ssim's loss.

Measured: https://github.com/nerficg-project/faster-gaussian-splatting, commit 3cb0b75, and
https://github.com/rahul-goel/fused-ssim, commit 0ac916a; spacesim installs neither. With torch and the CUDA toolkit:

    pip install --no-build-isolation git+https://github.com/rahul-goel/fused-ssim@0ac916a \
        "git+https://github.com/nerficg-project/faster-gaussian-splatting@3cb0b75#subdirectory=FasterGSCudaBackend"

CUDA 13 has no `cub::Max()`: clone Faster-GS and write `::cuda::maximum<>()` in its place in
rasterization/include/kernels_forward.cuh before `pip install --no-build-isolation ./FasterGSCudaBackend`.
"""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from FasterGSCudaBackend.torch_bindings import FusedAdam, RasterizerSettings, diff_rasterize, rasterize

from spacesim.data.records import Camera
from support.peer_torch import Step, StepInputs, Tensors, fused_similarity, has_fused_ssim, tensor, upload

if not has_fused_ssim():
    raise ImportError("its loss, fused_ssim, is not installed")

NEAR, FAR = 0.01, 1e4
BASES = 16  #: of spherical harmonics of degree 3


@lru_cache
def settings(camera: Camera) -> RasterizerSettings:
    """Over black."""
    return RasterizerSettings(
        tensor(camera.camera_from_world),
        tensor(camera.position),
        tensor(np.zeros(3)),
        BASES,
        camera.width,
        camera.height,
        *(float(number) for number in (camera.fx, camera.fy, camera.cx, camera.cy)),
        NEAR,
        FAR,
        False,
    )


def parameters(splats: Tensors) -> tuple[torch.Tensor, ...]:
    """In the order of its functions."""
    names = ("means", "log_scales", "quaternions", "logit_opacities", "sh0", "shN")
    means, scales, rotations, opacities, *harmonics = (splats[name] for name in names)
    return means, scales, rotations, opacities.reshape(-1, 1), *harmonics


class Frame:
    """One frame, as `rasterizer.py` measures ours."""

    def __init__(self, arrays: dict[str, np.ndarray], camera: Camera) -> None:
        self.camera, self.splats = camera, upload(arrays)
        self.pairs = None

    def whole(self) -> torch.Tensor:
        """Parameters to picture [3, H, W], without gradients."""
        with torch.inference_mode():
            picture: torch.Tensor = rasterize(*parameters(self.splats), settings(self.camera), True, False)
        return picture


def steps(inputs: StepInputs) -> dict[str, Step]:
    """Training steps by their names."""

    def adam(groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        return FusedAdam(groups, lr=0.0, eps=1e-15)

    name = "SSIM by fused_ssim, FusedAdam"
    return {name: Step(inputs, _picture, fused_similarity, adam)}


def _picture(splats: Tensors, camera: Camera) -> torch.Tensor:
    picture: torch.Tensor = diff_rasterize(*parameters(splats), torch.empty(0), settings(camera))
    return picture
