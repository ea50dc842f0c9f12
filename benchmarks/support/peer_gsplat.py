"""gsplat as the peer of the benchmarks: the same splats, the same camera, its own rasterizer and torch around it.

gsplat 1.5 and torch with CUDA are needed, which spacesim does not install. gsplat compiles its kernels at first use.
"""

from typing import Any

import gsplat
import numpy as np
import torch

from spacesim.data.records import Camera

DEVICE = "cuda"
TILE = 16  #: gsplat's default
PARAMETERS = ("means", "log_scales", "quaternions", "logit_opacities", "sh0", "shN")

Tensors = dict[str, torch.Tensor]


def upload(arrays: dict[str, np.ndarray]) -> Tensors:
    """Our parameters (`Gaussians.to_numpy`) as leaves; the harmonics apart, as gsplat's own trainer has them."""
    split = {**arrays, "sh0": arrays["sh"][:, :1], "shN": arrays["sh"][:, 1:]}
    return {name: _tensor(split[name]).requires_grad_() for name in PARAMETERS}


def rasterize(splats: Tensors, camera: Camera, degree: int, mode: str = "RGB", **more: Any) -> tuple:
    """(image [H, W, C], alpha [H, W, 1], info) of gsplat's rasterizer; harmonics as "sh" or as "sh0" and "shN"."""
    image, alpha, info = gsplat.rasterization(
        splats["means"],
        splats["quaternions"],
        torch.exp(splats["log_scales"]),
        torch.sigmoid(splats["logit_opacities"]),
        splats["sh"] if "sh" in splats else torch.cat([splats["sh0"], splats["shN"]], dim=1),
        _tensor(camera.camera_from_world)[None],
        _tensor(intrinsics(camera))[None],
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
        colors = _tensor(np.random.default_rng(0).uniform(size=(1, count, 3)))
        opacities = info["opacities"].detach().reshape(1, count)
        leaves = (info["means2d"], info["conics"], colors, opacities)
        self.leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        self.pairs = self.bin()
        self.image = self._blend()
        self.gradients = [torch.full_like(plane, 1e-3) for plane in self.image]

    def whole(self) -> None:
        """Parameters to picture, without gradients."""
        with torch.no_grad():
            rasterize(self.splats, self.camera, 3)

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


class Step:
    """One training step: rasterization, L1 + D-SSIM, gradients, Adam over all parameters; no refinement.

    ssim: "torch" (five separable blurs by conv2d) or "fused_ssim"
    fused: torch's one-kernel Adam

    The pictures wait on the device as floats; ours unpacks 8-bit values and composites them over a background.
    """

    def __init__(
        self,
        arrays: dict[str, np.ndarray],
        views: list[tuple[Camera, np.ndarray]],
        rates: dict[str, float],
        ssim_weight: float,
        ssim: str,
        fused: bool,
    ) -> None:
        self.splats, self.ssim_weight, self.ssim, self.steps = upload(arrays), ssim_weight, ssim, 0
        self.views = [(camera, _tensor(picture)) for camera, picture in views]
        groups = [{"params": [self.splats[name]], "lr": rates[name]} for name in PARAMETERS]
        self.optimizer = torch.optim.Adam(groups, eps=1e-15, fused=fused)

    def __call__(self) -> None:
        camera, target = self.views[self.steps % len(self.views)]
        picture, _, _ = rasterize(self.splats, camera, 3)
        l1 = (picture - target).abs().mean()
        similarity = fused_similarity(picture, target) if self.ssim == "fused_ssim" else similarity_of(picture, target)
        loss = (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - similarity)
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.steps += 1


def similarity_of(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean SSIM with an 11 x 11 Gaussian window, sigma 1.5, zero beyond the border. [H, W, 3] each."""
    offsets = torch.arange(-5, 6, device=picture.device, dtype=torch.float32)
    window = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = (window / window.sum())[None, None]
    x, y = picture.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]

    def blur(planes: torch.Tensor) -> torch.Tensor:
        rows = torch.nn.functional.conv2d(planes, window[:, :, None, :], padding=(0, 5))
        return torch.nn.functional.conv2d(rows, window[:, :, :, None], padding=(5, 0))

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    value = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return value.mean()


def fused_similarity(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The same by the fused_ssim package."""
    from fused_ssim import fused_ssim

    return fused_ssim(picture.permute(2, 0, 1)[None].contiguous(), target.permute(2, 0, 1)[None].contiguous())


def device_milliseconds(work: Any, repeats: int = 7) -> float | None:
    """Of a call: the sum of the times of its kernels by torch's profiler; None where that sees no device."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(3):
        work()
    torch.cuda.synchronize()
    try:
        with profile(activities=[ProfilerActivity.CUDA]) as profiler:
            for _ in range(repeats):
                work()
            torch.cuda.synchronize()
    except (RuntimeError, AssertionError):
        return None
    microseconds = sum(getattr(event, "self_device_time_total", 0) for event in profiler.key_averages())
    return 1e-3 * microseconds / repeats if microseconds > 0 else None


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32, device=DEVICE)
