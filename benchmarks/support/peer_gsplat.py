"""gsplat as the peer of the benchmarks: the same splats, the same camera, its own rasterizer and torch around it.

gsplat (https://github.com/nerfstudio-project/gsplat), 1.5.3 or main at 90d7b4b, and torch with CUDA are needed, which
spacesim does not install: `pip install gsplat==1.5.3`, or its repository at that commit. It compiles its
kernels at first use.
"""

from typing import Any

import gsplat
import numpy as np
import torch

from spacesim.data.records import Camera
from support.peer_torch import (
    Step,
    StepInputs,
    Tensors,
    fused_similarity,
    has_fused_ssim,
    similarity_of,
    tensor,
    upload,
)

TILE = 16  #: gsplat's default


def rasterize(splats: Tensors, camera: Camera, degree: int, mode: str = "RGB", **more: Any) -> tuple:
    """(image [H, W, C], alpha [H, W, 1], info) of gsplat's rasterizer; harmonics as "sh" or as "sh0" and "shN"."""
    image, alpha, info = gsplat.rasterization(
        splats["means"],
        splats["quaternions"],
        torch.exp(splats["log_scales"]),
        torch.sigmoid(splats["logit_opacities"]),
        splats["sh"] if "sh" in splats else torch.cat([splats["sh0"], splats["shN"]], dim=1),
        tensor(camera.camera_from_world)[None],
        tensor(intrinsics(camera))[None],
        camera.width,
        camera.height,
        sh_degree=degree,
        render_mode=mode,
        packed=False,
        **more,
    )
    return image[0], alpha[0], info


def intrinsics(camera: Camera) -> np.ndarray:
    """[3, 3]."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


class Frame:
    """One frame of gsplat, whole and stage by stage, as `rasterizer.py` measures ours."""

    def __init__(self, arrays: dict[str, np.ndarray], camera: Camera) -> None:
        self.camera, self.splats = camera, upload(arrays)
        self.tiles = -(-camera.width // TILE), -(-camera.height // TILE)
        with torch.no_grad():
            _, _, info = rasterize(self.splats, camera, 3)
        self.radii, self.depths = info["radii"].detach(), info["depths"].detach()
        count = len(arrays["means"])
        colors = tensor(np.random.default_rng(0).uniform(size=(1, count, 3)))
        opacities = info["opacities"].detach().reshape(1, count)
        leaves = (info["means2d"], info["conics"], colors, opacities)
        self.leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        self.pairs = self.bin()
        self.image = self._blend()
        self.gradients = [torch.full_like(plane, 1e-3) for plane in self.image]

    def whole(self) -> torch.Tensor:
        """Parameters to picture [3, H, W], without gradients."""
        with torch.no_grad():
            return _picture(self.splats, self.camera)

    def bin(self) -> int:
        """Sort the projected splats into tiles. Returns the number of pairs."""
        x, y = self.tiles
        with torch.no_grad():
            _, keys, self.ids = gsplat.isect_tiles(self.leaves[0], self.radii, self.depths, TILE, x, y)
            self.offsets = gsplat.isect_offset_encode(keys, 1, x, y).reshape(1, y, x)
        return len(keys)

    def forward(self) -> None:
        """Blend."""
        with torch.no_grad():
            self._blend()

    def backward(self) -> None:
        """The adjoint of blending, to the projected splats."""
        torch.autograd.grad(self.image, self.leaves, self.gradients, retain_graph=True)

    def _blend(self) -> tuple[torch.Tensor, torch.Tensor]:
        size = self.camera.width, self.camera.height, TILE
        return gsplat.rasterize_to_pixels(*self.leaves, *size, self.offsets, self.ids)


def steps(inputs: StepInputs) -> dict[str, Step]:
    """Training steps by their names."""
    ways = {"SSIM by torch, Adam plain": (similarity_of, False), "SSIM by torch, Adam fused": (similarity_of, True)}
    if has_fused_ssim():
        ways["SSIM by fused_ssim, Adam fused"] = fused_similarity, True

    def of(similarity: Any, fused: bool) -> Step:
        def adam(groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
            return torch.optim.Adam(groups, eps=1e-15, fused=fused)

        return Step(inputs, _picture, similarity, adam)

    return {name: of(*way) for name, way in ways.items()}


def _picture(splats: Tensors, camera: Camera) -> torch.Tensor:
    return rasterize(splats, camera, 3)[0].permute(2, 0, 1)
