"""Correctness and quality beside gsplat on a CUDA device: the same splats, the same data, the same schedule.

    python benchmarks/against_gsplat.py picture
    python benchmarks/against_gsplat.py training --data DATA [--iterations 7000]

`picture` renders random splats with both and prints the largest difference of colour, alpha and depth, and of the
gradients. `training` trains both from the same Gaussians with the same loss, views, backgrounds, rates and
refinement parameters (gsplat's own DefaultStrategy and torch's Adam on its side), and prints the PSNR of both on the
test views. gsplat 1.5 and torch with CUDA are needed, which spacesim does not install.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from support import common

from spacesim import backend
from spacesim.backend import ad
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import load_image
from spacesim.data.records import Camera
from spacesim.data.store import read_dataset
from spacesim.eval.metrics.image import psnr as psnr_of
from spacesim.learning.folder import TrainingProgress
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.config import TrainConfig, preset, with_options, with_settings
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.trainer import Trainer

try:
    import gsplat
    import torch
    from support.peer_gsplat import rasterize
    from support.peer_torch import Tensors, similarity_of
except ImportError as error:
    MISSING: ImportError | None = error
else:
    MISSING = None

GSPLAT_DEFAULTS = DensificationConfig(
    prune_opacity=0.005,
    prune_scale=0.1,
    prune_screen_size=0.15,
    split_screen_size=0.05,
    pause_after_reset=0,
    max_gaussians=10_000_000,  # gsplat's strategy knows no limit
    grow_gradient=0.0008,
    duplicate_scale=0.01,
    refine_start=500,
    screen_size_stop=0,
)
"""The values of gsplat's DefaultStrategy, with the threshold that its documentation gives for absolute gradients."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["picture", "training"])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--iterations", type=int, default=7_000)
    parser.add_argument("--json", action="store_true", help="as always: the result is JSON")
    options = parser.parse_args()
    if MISSING is not None:
        raise InputError(f"gsplat: expected gsplat 1.5 and torch with CUDA, found none ({MISSING})")
    if options.what == "training" and options.data is None:
        raise InputError("--data: expected a dataset to train on, found none")
    backend.select("cuda")
    if options.what == "picture":
        result: object = [compare_pictures(count, size) for count, size in ((1_000, 256), (31_622, 1024))]
    else:
        result = compare_training(options.data, options.iterations)
    print(json.dumps(result, indent=1))


def compare_pictures(count: int, size: int) -> dict[str, Any]:
    """Largest absolute differences of pictures, relative norms of differences of gradients."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    spacing = np.sqrt(4 * np.pi / count)
    arrays = {
        "means": means,
        "log_scales": np.log(spacing * rng.uniform(0.3, 1.0, (count, 3))),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.normal(size=count),
        "sh": 0.3 * rng.normal(size=(count, 16, 3)),
    }
    camera = Camera.from_fov(look_at([4, 1, 1], [0, 0, 0]), size, size, 35)

    ours = Gaussians.from_numpy(arrays)
    for parameter in ours.parameters().values():
        dr.enable_grad(parameter)
    output = render(ours, Pinhole.of(camera))
    weights = rng.normal(size=(size, size, 4)).astype(np.float32)
    assert output.color is not None
    planes = [*output.color, output.alpha]
    columns = [ad.Float(np.ascontiguousarray(weights[..., c].ravel())) for c in range(4)]
    dr.backward(sum((dr.sum(w * p) for w, p in zip(columns, planes, strict=True)), ad.Float(0)))

    theirs = {
        name: torch.tensor(a, dtype=torch.float32, device="cuda", requires_grad=True) for name, a in arrays.items()
    }
    image, alpha, _ = rasterize(theirs, camera, 3, "RGB+ED")
    (torch.cat([image[..., :3], alpha], -1) * torch.tensor(weights, device="cuda")).sum().backward()

    image_np, alpha_np = image.detach().cpu().numpy(), alpha.detach().cpu().numpy()[..., 0]
    color, our_alpha, depth = output.to_numpy()
    solid = alpha_np > 0.01
    off = np.abs(color - image_np[..., :3]).max(axis=-1)
    result = {
        "gaussians": count,
        "pixels": size,
        "color": float(off.max()),
        "pixels off by more than 2e-3": int((off > 2e-3).sum()),
        "alpha": float(np.abs(our_alpha - alpha_np).max()),
        "depth": float(np.abs(depth - image_np[..., 3])[solid].max()),
    }
    gradients = {name: np.array(dr.grad(value)).T for name, value in ours.parameters().items()}
    for name, gradient in gradients.items():
        reference = theirs[name].grad.cpu().numpy()
        difference = np.linalg.norm(gradient.reshape(reference.shape) - reference)
        result[f"gradient of {name}"] = float(difference / np.linalg.norm(reference))
    return result


def compare_training(data: Path, iterations: int) -> dict[str, Any]:
    """Train both, render the test views with both, compare with the truth over black."""
    dataset = read_dataset(data)
    refinement = replace(GSPLAT_DEFAULTS, refine_stop=iterations // 2)
    theirs = {"antialiased": False, "surfels": False, "rates.decay": "exponential"}
    classic = with_settings(preset("fast"), theirs)
    config = with_options(classic, iterations=iterations, refinement=refinement)
    truth = [(frame.camera, load_image(dataset, frame).over(np.zeros(3))) for frame in dataset.test]

    trainer = Trainer(dataset, config)
    start = {name: value.copy() for name, value in trainer.gaussians.to_numpy().items()}
    began = time.monotonic()
    trainer.run(tell, lambda: None)
    dr.sync_thread()
    ours = {"seconds": time.monotonic() - began, "gaussians": trainer.gaussians.count}
    pictures = []
    for camera, _ in truth:
        pictures.append(render(trainer.gaussians, Pinhole.of(camera)).to_numpy()[0])
    ours["psnr"] = psnr(pictures, [image for _, image in truth])

    compare_pictures(1_000, 64)  # gsplat compiles itself at its first call
    began = time.monotonic()
    splats = train_gsplat(Trainer(dataset, config), start, config)
    torch.cuda.synchronize()
    theirs = {"seconds": time.monotonic() - began, "gaussians": len(splats["means"])}
    with torch.no_grad():
        pictures = [rasterize(splats, camera, config.sh_degree, "RGB")[0].cpu().numpy() for camera, _ in truth]
    theirs["psnr"] = psnr(pictures, [image for _, image in truth])
    return {"iterations": iterations, "test views": len(truth), "spacesim": ours, "gsplat": theirs}


def tell(progress: TrainingProgress) -> None:
    """A line every 500 iterations."""
    if progress.iteration % 500 == 0:
        now = time.strftime("%H:%M:%S")
        print(
            f"{now} {progress.iteration}: loss {progress.loss:.4f}, {progress.gaussian_count} Gaussians",
            file=sys.stderr,
        )


def psnr(pictures: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """Mean over views of the PSNR of whole frames, dB (thesis 2.18)."""
    return float(np.mean([psnr_of(np.clip(p, 0, 1), t) for p, t in zip(pictures, truth, strict=True)]))


def train_gsplat(schedule: Trainer, start: dict[str, np.ndarray], config: TrainConfig) -> "Tensors":
    """gsplat's rasterizer, strategy and torch's Adam, on the views, backgrounds and rates of `schedule`."""
    arrays = {**start, "sh0": start["sh"][:, :1], "shN": start["sh"][:, 1:]}
    del arrays["sh"]
    splats = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(torch.tensor(value, device="cuda")) for name, value in arrays.items()}
    )
    splats["scales"], splats["quats"] = splats.pop("log_scales"), splats.pop("quaternions")
    splats["opacities"] = splats.pop("logit_opacities")
    rates = config.rates
    by_name = {"scales": rates.log_scales, "quats": rates.quaternions, "opacities": rates.logit_opacities}
    by_name |= {"sh0": rates.sh_constant, "shN": rates.sh_rest, "means": 0.0}
    optimizers = {
        name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
        for name, rate in by_name.items()
    }
    c = config.refinement
    strategy = gsplat.DefaultStrategy(
        prune_opa=c.prune_opacity,
        grow_grad2d=c.grow_gradient,
        grow_scale3d=c.duplicate_scale,
        grow_scale2d=c.split_screen_size,
        prune_scale3d=c.prune_scale,
        prune_scale2d=c.prune_screen_size,
        refine_scale2d_stop_iter=c.screen_size_stop,
        refine_start_iter=c.refine_start,
        refine_stop_iter=c.refine_stop,
        reset_every=c.reset_every * c.refine_every,
        refine_every=c.refine_every,
        pause_refine_after_reset=c.pause_after_reset,
        absgrad=True,
    )
    state = strategy.initialize_state(scene_scale=schedule.scene_scale)
    for index in range(config.iterations):
        view = schedule.views.at_step(index)
        optimizers["means"].param_groups[0]["lr"] = schedule.rates(index)[0]
        renamed = {
            "means": splats["means"],
            "log_scales": splats["scales"],
            "quaternions": splats["quats"],
            "logit_opacities": splats["opacities"],
            "sh0": splats["sh0"],
            "shN": splats["shN"],
        }
        degree = config.degree(index)
        image, alpha, info = rasterize(renamed, view.camera, degree, "RGB", absgrad=True)
        strategy.step_pre_backward(splats, optimizers, state, index, info)
        rgba = torch.tensor(view.rgba.view(np.uint8).reshape(view.camera.height, view.camera.width, 4), device="cuda")
        rgba = rgba.float() / 255
        below = torch.tensor(schedule.background(index, view), device="cuda")
        target = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * below
        picture = image + (1 - alpha) * below
        l1 = (picture - target).abs().mean()
        similarity = similarity_of(picture.permute(2, 0, 1), target.permute(2, 0, 1))
        loss = (1 - config.ssim_weight) * l1 + config.ssim_weight * (1 - similarity)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(splats, optimizers, state, index, info, packed=False)
        if (index + 1) % 50 == 0:
            tell(TrainingProgress(index + 1, config.iterations, loss.item(), len(splats["means"])))
    names = {"scales": "log_scales", "quats": "quaternions", "opacities": "logit_opacities"}
    return {names.get(name, name): value.detach() for name, value in splats.items()}


if __name__ == "__main__":
    common.run_main(main)
