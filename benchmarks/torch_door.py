"""The rasterizer through `spacesim.torch.rasterization` beside our own path and, where it is installed, gsplat.

python benchmarks/torch_door.py [--sizes 31622x512,...] [--peers gsplat] [--repeats 15] [--store FILE.npz] [--json]

A picture with its gradients, by all parameters of the Gaussians, for one camera: harmonics of degree 3, colour and
alpha. "own" is `render` with Dr.Jit's gradients. Both are handed the same gradients of the picture and of alpha: a loss
is its user's, in torch or elsewhere. With --peers gsplat the largest differences from its pictures and
gradients are reported, too; that needs CUDA. --store writes what gsplat makes of a small scene, which
tests/test_torch.py holds ours against.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from rasterizer import load_peer
from support import common

from spacesim import backend
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.records import Camera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render

NAMES = ("means", "quats", "scales", "opacities", "colors")
MODES: tuple[dict[str, Any], ...] = (
    {},
    {"rasterize_mode": "antialiased"},
    {"camera_model": "ortho"},
    {"render_mode": "RGB+ED"},
)


def main() -> None:
    """Measure each size and print a table."""
    parser = common.arguments(__doc__, "sizes", "repeats", sizes="31622x512,101958x512")
    parser.add_argument("--peers", choices=["gsplat"], help="measured beside ours; needs CUDA and gsplat")
    parser.add_argument("--store", type=Path, metavar="FILE.npz", help="write the peer's pictures and gradients")
    options = parser.parse_args()
    name = backend.select(options.backend)
    try:
        import torch
    except ImportError:
        raise InputError("torch: expected it, found none; type: pip install torch") from None
    gsplat = load_peer(options.peers, name, "gsplat")
    peer = gsplat and gsplat.rasterization
    if options.store is not None and peer is not None:
        np.savez_compressed(options.store, **_stored(torch, peer))  # type: ignore[arg-type]
        return
    from spacesim.torch import rasterization

    device = "cuda" if name == "cuda" else "cpu"
    if device == "cpu":
        torch.set_num_threads(1)
    rows, differences = [], []
    for count, side in common.parse_sizes(options.sizes):
        leaves, camera = _scene(torch, count, side, device)
        weights = np.random.default_rng(1).normal(size=(side, side, 4)).astype(np.float32)
        planes = [upload(plane) for plane in weights.reshape(-1, 4).T]
        given = [torch.tensor(part, device=device)[None] for part in (weights[..., :3].copy(), weights[..., 3:].copy())]
        works = {
            "own": partial(_own, leaves, camera, planes),
            "torch": partial(_through, torch, rasterization, leaves, camera, given),
        }
        if peer is not None:
            works["gsplat"] = partial(_through, torch, peer, leaves, camera, given)
        times = {name: timing.median for name, timing in common.interleaved(works, options.repeats).items()}
        row: common.Row = {"Gaussians": count, "pixels": side, **{f"{name}, ms": time for name, time in times.items()}}
        row["torch / own"] = times["torch"] / times["own"]
        if peer is not None:
            row["torch / gsplat"] = times["torch"] / times["gsplat"]
            for mode in MODES:
                different = _differences(torch, rasterization, peer, leaves, camera, mode)
                differences.append({"Gaussians": count, **mode, **different})
        rows.append(row)
    if options.json:
        print(json.dumps({"rows": rows, "differences": differences}, indent=1))
        return
    print(common.table(rows, options.markdown))
    for one in differences:
        print(one)


def _scene(torch: Any, count: int, side: int, device: str) -> tuple[dict[str, Any], Camera]:
    """Splats on a sphere, as leaves, and a camera."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    spacing = np.sqrt(4 * np.pi / count)
    arrays = {
        "means": directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "quats": rng.normal(size=(count, 4)),
        "scales": spacing * rng.uniform(0.3, 1.0, (count, 3)),
        "opacities": rng.uniform(0.1, 0.95, count),
        "colors": 0.3 * rng.normal(size=(count, 16, 3)),
    }
    camera = Camera.look_at([4, 1, 1], [0, 0, 0], side, side, 35)
    leaves = {k: torch.tensor(v, dtype=torch.float32, device=device, requires_grad=True) for k, v in arrays.items()}
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    for name, value in (("viewmats", camera.camera_from_world), ("Ks", intrinsics)):
        leaves[name] = torch.tensor(np.array(value), dtype=torch.float32, device=device)[None]
    return leaves, camera


def _own(leaves: dict[str, Any], camera: Camera, weights: list[Float]) -> None:
    """A picture by `render`, and gradients, without torch in between. weights: gradients of its planes, of alpha"""
    if not hasattr(_own, "arrays") or _own.arrays.count != len(leaves["means"]):
        plain = {name: leaves[name].detach().cpu().numpy() for name in NAMES}
        opacity = plain["opacities"]
        _own.arrays = Gaussians.from_numpy(  # type: ignore[attr-defined]
            {
                "means": plain["means"],
                "log_scales": np.log(plain["scales"]),
                "quaternions": plain["quats"],
                "logit_opacities": np.log(opacity / (1 - opacity)),
                "sh": plain["colors"],
            }
        )
    model: Gaussians = _own.arrays  # type: ignore[attr-defined]
    for parameter in model.parameters().values():
        dr.disable_grad(parameter)
        dr.enable_grad(parameter)
    output = render(model, Pinhole.of(camera), outputs=("color", "alpha"))
    assert output.color is not None
    planes = [*output.color, output.alpha]
    dr.backward(sum(dr.sum(plane * weight) for plane, weight in zip(planes, weights, strict=True)))
    gradients = [dr.grad(parameter) for parameter in model.parameters().values()]
    dr.eval(gradients)
    dr.sync_thread()


def _through(torch: Any, rasterization: Any, leaves: dict[str, Any], camera: Camera, given: list[Any]) -> None:
    """A picture by a function of gsplat's signature, and gradients. given: those of the picture and of alpha"""
    picture, alpha, _ = rasterization(
        **leaves, width=camera.width, height=camera.height, sh_degree=3, packed=False, render_mode="RGB"
    )
    torch.autograd.grad([picture, alpha], [leaves[name] for name in NAMES], given)


def _differences(
    torch: Any, one: Any, other: Any, leaves: dict[str, Any], camera: Camera, mode: dict
) -> dict[str, float]:
    """Largest absolute differences of pictures and alphas, shares of pixels that differ by more than some (a splat
    whose alpha is all but 1/255 may count with one alone, and two of all but one depth may change places), relative
    norms of differences of gradients: of all pixels, and of those that differ by at most 1e-4."""
    size = {"width": camera.width, "height": camera.height, "sh_degree": 3, "packed": False}

    def drawn(function: Any) -> tuple[Any, Any, dict[str, Any]]:
        own = {name: leaf.detach().clone().requires_grad_(name != "Ks") for name, leaf in leaves.items()}
        if mode.get("camera_model") == "ortho":
            own["Ks"][:, :2, :2] /= 4
        picture, alpha, _ = function(**own, **size, **mode)
        return picture, alpha, own

    def gradients(function: Any, weights: Any) -> dict[str, Any]:
        picture, alpha, own = drawn(function)
        (weights[..., :3] * picture[..., :3] + weights[..., -1:] * alpha).sum().backward()
        return {name: own[name].grad for name in (*NAMES, "viewmats")}

    (a, alpha_a, _), (b, alpha_b, _) = drawn(one), drawn(other)
    off = torch.where(alpha_b > 0.01, a - b, 0 * a).abs().amax(dim=-1, keepdim=True).detach()
    differences = {"picture": float(off.max()), "alpha": float((alpha_a - alpha_b).abs().max())}
    differences |= {f"pixels off by {bound:g}": float((off > bound).float().mean()) for bound in (1e-4, 1e-3)}
    generator = torch.Generator(a.device).manual_seed(1)
    weights = torch.randn((*a.shape[:-1], 4), device=a.device, generator=generator)
    for where, some in (("", weights), (" of like pixels", weights * (off <= 1e-4))):
        by_a, by_b = gradients(one, some), gradients(other, some)
        for name, gradient in by_b.items():
            differences[f"gradient {name}{where}"] = float((by_a[name] - gradient).norm() / gradient.norm())
    return differences


def _stored(torch: Any, peer: Any) -> dict[str, np.ndarray]:
    """Inputs, and for each of MODES pictures, alphas and gradients of a weighted sum of both, of 40 Gaussians before
    two cameras of 32 x 24 pixels."""
    rng = np.random.default_rng(7)
    cameras = [Camera.look_at([3.5, 1, 1 - k], [0, 0, 0], 32, 24, 40) for k in range(2)]
    values = {
        "means": 0.6 * rng.normal(size=(40, 3)),
        "quats": rng.normal(size=(40, 4)),
        "scales": rng.uniform(0.05, 0.3, (40, 3)),
        "opacities": rng.uniform(0.1, 0.95, 40),
        "colors": 0.4 * rng.normal(size=(40, 16, 3)),
        "viewmats": np.stack([camera.camera_from_world for camera in cameras]),
        "Ks": np.array([[[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in cameras]),
        "backgrounds": rng.uniform(size=(2, 3)),
        "weights": rng.normal(size=(2, 24, 32, 5)),
    }
    inputs = {name: array.astype(np.float32) for name, array in values.items()}
    arrays: dict[str, Any] = dict(inputs)
    for number, mode in enumerate(MODES):
        own = {name: torch.tensor(array, device="cuda") for name, array in inputs.items()}
        weights = own.pop("weights")
        if mode.get("camera_model") == "ortho":
            own["Ks"][:, :2, :2] /= 4
        leaves = {name: tensor.requires_grad_(name != "Ks") for name, tensor in own.items()}
        picture, alpha, _ = peer(**leaves, width=32, height=24, sh_degree=3, packed=False, **mode)
        ((weights[..., : picture.shape[-1]] * picture).sum() + (weights[..., 4:] * alpha).sum()).backward()
        arrays |= {f"{number}.picture": picture.detach(), f"{number}.alpha": alpha.detach()}
        arrays |= {f"{number}.by.{name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {name: array if isinstance(array, np.ndarray) else array.cpu().numpy() for name, array in arrays.items()}


if __name__ == "__main__":
    common.run_main(main)
