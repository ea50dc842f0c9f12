"""nerfacc's instant-ngp recipe as the peer of nerf.py: an occupancy grid of 128 cells, a hash grid of 16 levels with
2^19 places each, fused half-precision networks, Adam at 1e-2 with its warm-up and three falls.

nerfacc, tinycudann and torch with CUDA are needed, which spacesim does not install.
"""

from typing import Any

import nerfacc
import numpy as np
import tinycudann
import torch
from nerfacc.estimators.occ_grid import OccGridEstimator

from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset
from spacesim.learning.prediction import Prediction
from spacesim.nerf.sampling.box import scene_box

DEVICE = "cuda"
STEPS_ACROSS = 1024  #: march steps along the box's diagonal, about what the recipe's 5e-3 in a box of 3 units gives
GRID = {
    "otype": "HashGrid",
    "n_levels": 16,
    "n_features_per_level": 2,
    "log2_hashmap_size": 19,
    "base_resolution": 16,
    "per_level_scale": 1.4472692012786865,
}
HARMONICS = {"nested": [{"n_dims_to_encode": 3, "otype": "SphericalHarmonics", "degree": 4}, {"otype": "Identity"}]}
FEATURES = 15


def network(layers: int, last: str = "None") -> dict[str, Any]:
    size = {"n_neurons": 64, "n_hidden_layers": layers}
    return {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": last, **size}


class Training:
    """A field of nerfacc's on a dataset of ours; trained by `run`, drawn by `predict`."""

    def __init__(self, dataset: Dataset, rays: int, iterations: int) -> None:
        torch.manual_seed(0)
        box = scene_box(dataset, 0.05)
        corners = np.concatenate([box.low, box.low + box.size])
        self.low, self.size = _tensor(box.low), _tensor(box.size)
        self.rays, self.iterations, self.done = rays, iterations, 0
        self.step_size = float(np.linalg.norm(box.size)) / STEPS_ACROSS
        self.estimator = OccGridEstimator(corners.tolist(), resolution=128, levels=1).to(DEVICE)
        self.density = tinycudann.NetworkWithInputEncoding(3, 1 + FEATURES, GRID, network(1)).to(DEVICE)
        encoding = {"otype": "Composite", **HARMONICS}
        self.color = tinycudann.NetworkWithInputEncoding(3 + FEATURES, 3, encoding, network(2)).to(DEVICE)
        parameters = [*self.density.parameters(), *self.color.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=1e-2, eps=1e-15, weight_decay=1e-6)
        self.scaler = torch.amp.GradScaler(DEVICE, 2**10)
        falls = [iterations // 2, iterations * 3 // 4, iterations * 9 // 10]
        schedules = [
            torch.optim.lr_scheduler.LinearLR(self.optimizer, 0.01, total_iters=100),
            torch.optim.lr_scheduler.MultiStepLR(self.optimizer, falls, 0.33),
        ]
        self.schedule = torch.optim.lr_scheduler.ChainedScheduler(schedules)
        pictures = [load_image(dataset, frame) for frame in dataset.train]
        self.rgba = _tensor(np.stack([np.concatenate([p.rgb, p.alpha[..., None]], -1) for p in pictures]))
        ways = [pixel_rays(frame.camera) for frame in dataset.train]
        self.origins = _tensor(np.stack([frame.camera.position for frame in dataset.train]))
        self.directions = _tensor(np.stack(ways))

    def run(self) -> None:
        while self.done < self.iterations:
            self.step()
        torch.cuda.synchronize()

    def step(self) -> None:
        count, height, width, _ = self.rgba.shape
        view = torch.randint(0, count, (self.rays,), device=DEVICE)
        row = torch.randint(0, height, (self.rays,), device=DEVICE)
        column = torch.randint(0, width, (self.rays,), device=DEVICE)
        rgba, background = self.rgba[view, row, column], torch.rand(3, device=DEVICE)
        wanted = rgba[:, :3] * rgba[:, 3:] + background * (1 - rgba[:, 3:])
        with torch.no_grad():
            self.estimator.update_every_n_steps(
                self.done, lambda x: self.density_at(x)[0] * self.step_size, occ_thre=1e-2
            )
        shown, _, _, samples = self.drawn(self.origins[view], self.directions[view, row, column], background, True)
        self.done += 1
        if samples == 0:
            return
        loss = torch.nn.functional.smooth_l1_loss(shown, wanted)
        self.optimizer.zero_grad()
        self.scaler.scale(loss).backward()
        self.optimizer.step()
        self.schedule.step()

    def density_at(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = self.density(((x - self.low) / self.size).view(-1, 3)).float()
        inside = ((x >= self.low) & (x <= self.low + self.size)).all(-1)
        return torch.exp(torch.clamp(out[:, 0] - 1, max=11)) * inside, out[:, 1:]

    def drawn(self, origins: Any, directions: Any, background: Any, training: bool) -> tuple[Any, Any, Any, int]:
        """(colour [R, 3], opacity [R, 1], depth [R, 1], number of samples)."""

        def at(start: Any, end: Any, ray: Any) -> Any:
            return origins[ray] + directions[ray] * (0.5 * (start + end))[:, None]

        def density(start: Any, end: Any, ray: Any) -> Any:
            return self.density_at(at(start, end, ray))[0]

        def density_and_color(start: Any, end: Any, ray: Any) -> Any:
            sigma, features = self.density_at(at(start, end, ray))
            inputs = torch.cat([(directions[ray] + 1) / 2, features], -1)
            return torch.sigmoid(self.color(inputs).float()), sigma

        size = self.step_size
        rays, low, high = self.estimator.sampling(
            origins, directions, sigma_fn=density, render_step_size=size, stratified=training
        )
        if len(low) == 0:  # tiny-cuda-nn takes no empty batch
            nothing = torch.zeros(len(origins), 1, device=DEVICE)
            return background.expand(len(origins), 3), nothing, nothing, 0
        parts = nerfacc.rendering(
            low, high, rays, n_rays=len(origins), rgb_sigma_fn=density_and_color, render_bkgd=background
        )
        return parts[0], parts[1], parts[2], len(low)

    @torch.no_grad()
    def predict(self, camera: Camera) -> Prediction:
        directions = _tensor(pixel_rays(camera)).view(-1, 3)
        origins = _tensor(camera.position).expand_as(directions)
        parts = [
            self.drawn(origins[i : i + 8192], directions[i : i + 8192], torch.zeros(3, device=DEVICE), False)[:3]
            for i in range(0, len(directions), 8192)
        ]
        rgb, alpha, depth = (
            torch.cat(planes).view(camera.height, camera.width, -1).cpu().numpy() for planes in zip(*parts, strict=True)
        )
        return Prediction(rgb, alpha[..., 0], depth[..., 0], None, None)


def pixel_rays(camera: Camera) -> np.ndarray:
    """[H, W, 3] unit directions through the centres of pixels."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    ways = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)
    ways = ways @ camera.world_from_camera[:3, :3].T
    return np.asarray(ways / np.linalg.norm(ways, axis=-1, keepdims=True))


def _tensor(values: Any) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32, device=DEVICE)
