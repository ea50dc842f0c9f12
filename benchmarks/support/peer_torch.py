"""What peers that are written for torch have in common: parameters as leaves, loss, optimizer, the device's time."""

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from spacesim.data.records import Camera

DEVICE = "cuda"
PARAMETERS = ("means", "log_scales", "quaternions", "logit_opacities", "sh0", "shN")

Tensors = dict[str, torch.Tensor]
StepInputs = tuple[dict[str, np.ndarray], list[tuple[Camera, np.ndarray]], dict[str, float], float]
"""Parameters (`Gaussians.to_numpy`), pictures [H, W, 3] with their cameras, step sizes, weight of D-SSIM."""


def upload(arrays: dict[str, np.ndarray]) -> Tensors:
    """Our parameters (`Gaussians.to_numpy`) as leaves; the harmonics apart, as gsplat's own trainer has them."""
    split = {**arrays, "sh0": arrays["sh"][:, :1], "shN": arrays["sh"][:, 1:]}
    return {name: tensor(split[name]).requires_grad_() for name in PARAMETERS}


def tensor(array: np.ndarray) -> torch.Tensor:
    """Floats on the device."""
    return torch.tensor(np.asarray(array), dtype=torch.float32, device=DEVICE)


class Step:
    """One training step: rasterization, L1 + D-SSIM, gradients, Adam over all parameters; no refinement.

    draw: (splats, camera) to the picture [3, H, W]
    similarity: of two such pictures, their mean SSIM
    make_optimizer: of groups of parameters with their step sizes

    The pictures wait on the device as floats; ours unpacks 8-bit values and composites them over a background.
    """

    def __init__(
        self,
        inputs: StepInputs,
        draw: Callable[[Tensors, Camera], torch.Tensor],
        similarity: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        make_optimizer: Callable[[list[dict[str, Any]]], torch.optim.Optimizer],
    ) -> None:
        arrays, views, rates, self.ssim_weight = inputs
        self.splats, self.steps = upload(arrays), 0
        self.draw, self.similarity = draw, similarity
        self.views = [(camera, tensor(picture).permute(2, 0, 1).contiguous()) for camera, picture in views]
        self.optimizer = make_optimizer([{"params": [self.splats[name]], "lr": rates[name]} for name in PARAMETERS])

    def __call__(self) -> None:
        camera, target = self.views[self.steps % len(self.views)]
        picture = self.draw(self.splats, camera)
        l1 = (picture - target).abs().mean()
        loss = (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - self.similarity(picture, target))
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.steps += 1


def similarity_of(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean SSIM with an 11 x 11 Gaussian window, sigma 1.5, zero beyond the border. [3, H, W] each."""
    offsets = torch.arange(-5, 6, device=picture.device, dtype=torch.float32)
    window = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = (window / window.sum())[None, None]
    x, y = picture[:, None], target[:, None]

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

    return fused_ssim(picture[None].contiguous(), target[None].contiguous())


def has_fused_ssim() -> bool:
    """Whether the fused_ssim package is installed."""
    return importlib.util.find_spec("fused_ssim") is not None


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
