"""gsplat's `rasterization` over our kernels, beside the same formulas in dense torch, pixel by pixel."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from spacesim import backend  # noqa: E402
from spacesim.data.records import Camera  # noqa: E402
from spacesim.torch import rasterization  # noqa: E402

SIDE = 40
ALPHA_MIN, ALPHA_MAX, PASSES = 1 / 255, 0.999, 1e-4
DEVICE = "cuda" if backend.select() == "cuda" else "cpu"


def scene(count: int = 60, cameras: int = 2) -> dict:
    """Leaves in double precision, so that finite differences and the dense reference are exact."""
    rng = np.random.default_rng(3)
    placed = [Camera.look_at([3.5, 1, 1 - k], [0, 0, 0], SIDE, SIDE, 40) for k in range(cameras)]
    arrays = {
        "means": 0.7 * rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": rng.uniform(0.03, 0.25, (count, 3)),
        "opacities": rng.uniform(0.1, 0.95, count),
        "colors": 0.4 * rng.normal(size=(count, 16, 3)),
        "viewmats": np.stack([camera.camera_from_world for camera in placed]),
        "Ks": np.stack([[[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in placed]),
    }
    return {name: torch.tensor(array, dtype=torch.float64, requires_grad=True) for name, array in arrays.items()}


def as_floats(leaves: dict) -> dict:
    """The same leaves for our kernels."""
    return {k: v.detach().to(DEVICE, torch.float32).requires_grad_() for k, v in leaves.items()}


def rotations(quats):
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def harmonics(directions):
    """[N, 16] real spherical harmonics of unit vectors up to degree 3, in the order and signs of the 3DGS code."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            0.28209479177387814 + 0 * x,
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        -1,
    )


def dense(leaves: dict, camera: int, degree: int | None, eps2d: float, antialiased: bool, ortho: bool):
    """(features [H, W, D + 1] with depth last, alpha [H, W]): every splat on every pixel, sorted by depth."""
    view, matrix = leaves["viewmats"][camera], leaves["Ks"][camera]
    rotation, shift = view[:3, :3], view[:3, 3]
    points = leaves["means"] @ rotation.T + shift
    covariance = rotations(leaves["quats"]) * leaves["scales"][:, None, :]
    covariance = rotation @ (covariance @ covariance.transpose(-1, -2)) @ rotation.T
    x, y, z = points.unbind(-1)
    (fx, fy), (cx, cy) = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
    zero = 0 * z
    if ortho:
        centre = torch.stack([fx * x + cx, fy * y + cy], -1)
        jacobian = [[fx + zero, zero, zero], [zero, fy + zero, zero]]
    else:
        centre = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
        limits = [((-0.15 * SIDE - c) / f, (1.15 * SIDE - c) / f) for f, c in ((fx, cx), (fy, cy))]
        tx, ty = ((v / z).clamp(float(low), float(high)) for v, (low, high) in zip((x, y), limits, strict=True))
        jacobian = [[fx / z, zero, -fx * tx / z], [zero, fy / z, -fy * ty / z]]
    jacobian = torch.stack([torch.stack(row, -1) for row in jacobian], -2)
    flat = jacobian @ covariance @ jacobian.transpose(-1, -2)
    spread = flat + eps2d * torch.eye(2)
    opacity = leaves["opacities"]
    if antialiased:
        opacity = opacity * torch.sqrt((torch.linalg.det(flat) / torch.linalg.det(spread)).clamp(min=0))
    color = leaves["colors"]
    if degree is not None:
        away = leaves["means"] - torch.linalg.inv(view)[:3, 3]
        basis = harmonics(away / away.norm(dim=-1, keepdim=True))[:, : (degree + 1) ** 2]
        color = (torch.einsum("nk,nkc->nc", basis, color[:, : (degree + 1) ** 2]) + 0.5).clamp(min=0)
    features = torch.cat([color, z[:, None]], -1)
    order = torch.argsort(z)
    pixel = torch.arange(SIDE) + 0.5
    grid = torch.stack(torch.meshgrid(pixel, pixel, indexing="xy"), -1).double()
    passes, picture = torch.ones(SIDE, SIDE, dtype=torch.float64), torch.zeros(SIDE, SIDE, features.shape[1]).double()
    inverse, goes_on = torch.linalg.inv(spread), torch.ones(SIDE, SIDE, dtype=torch.bool)
    for k in order.tolist():
        offset = grid - centre[k]
        alpha = opacity[k] * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", offset, inverse[k], offset))
        alpha = alpha.clamp(max=ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & (z[k] > 0.01), alpha, 0 * alpha)
        goes_on = goes_on & (passes.detach() * (1 - alpha.detach()) > PASSES)
        alpha = torch.where(goes_on, alpha, 0 * alpha)
        picture = picture + (passes * alpha)[..., None] * features[k]
        passes = passes * (1 - alpha)
    return picture, 1 - passes


@pytest.mark.parametrize("degree", [0, 3, None])
@pytest.mark.parametrize(
    ("mode", "model", "eps2d"),
    [("classic", "pinhole", 0.3), ("antialiased", "pinhole", 0.1), ("classic", "ortho", 0.3)],
)
def test_pictures_and_gradients_are_those_of_the_formulas(degree, mode, model, eps2d):
    leaves = scene()
    if model == "ortho":
        with torch.no_grad():
            leaves["Ks"][:, :2, :2] /= 4
    if degree is None:
        leaves["colors"] = leaves["colors"].detach()[:, :7, 0].clone().requires_grad_()  # seven channels
    ours = as_floats(leaves)
    options = {"sh_degree": degree, "rasterize_mode": mode, "camera_model": model, "eps2d": eps2d}
    pictures, alphas, _ = rasterization(**ours, width=SIDE, height=SIDE, render_mode="RGB+D", **options)
    weights = torch.tensor(np.random.default_rng(1).normal(size=(*pictures.shape[:3], pictures.shape[3] + 1)))
    total = 0
    for camera in range(2):
        expected, alpha = dense(leaves, camera, degree, eps2d, mode == "antialiased", model == "ortho")
        assert float((pictures[camera].detach().cpu() - expected.detach()).abs().max()) < 1e-4
        assert float((alphas[camera, ..., 0].detach().cpu() - alpha.detach()).abs().max()) < 1e-5
        assert float(alpha.detach().max()) > 0.9
        total = total + (weights[camera, ..., :-1] * expected).sum() + (weights[camera, ..., -1] * alpha).sum()
    total.backward()
    device_weights = weights.to(DEVICE, torch.float32)
    ((device_weights[..., :-1] * pictures).sum() + (device_weights[..., -1] * alphas[..., 0]).sum()).backward()
    for name, leaf in leaves.items():
        expected, found = leaf.grad, ours[name].grad.cpu().double()
        assert float((found - expected).norm() / expected.norm()) < 1e-3, name


@pytest.mark.parametrize(
    ("number", "mode"),
    list(enumerate([{}, {"rasterize_mode": "antialiased"}, {"camera_model": "ortho"}, {"render_mode": "RGB+ED"}])),
)
def test_pictures_and_gradients_are_those_that_gsplat_made(number, mode):
    """Of gsplat 1.5.3 on CUDA, stored by benchmarks/torch_door.py --peers gsplat --store."""
    with np.load(Path(__file__).parent / "gsplat.npz", allow_pickle=False) as file:
        stored = {name: torch.tensor(file[name]) for name in file.files}
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
    leaves = {name: stored[name].clone().to(DEVICE) for name in names}
    if mode.get("camera_model") == "ortho":
        leaves["Ks"][:, :2, :2] /= 4
    leaves = {name: leaf.requires_grad_(name != "Ks") for name, leaf in leaves.items()}
    picture, alpha, _ = rasterization(**leaves, width=32, height=24, sh_degree=3, **mode)
    assert float((picture.detach().cpu() - stored[f"{number}.picture"]).abs().max()) < 1e-4
    assert float((alpha.detach().cpu() - stored[f"{number}.alpha"]).abs().max()) < 1e-4
    weights = stored["weights"].to(DEVICE)
    ((weights[..., : picture.shape[-1]] * picture).sum() + (weights[..., 4:] * alpha).sum()).backward()
    for name, leaf in leaves.items():
        if name != "Ks":
            expected = stored[f"{number}.by.{name}"]
            assert float((leaf.grad.cpu() - expected).norm() / expected.norm()) < 1e-3, name


def test_modes_backgrounds_and_meta():
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 2, "packed": False}
    rgb, alpha, meta = rasterization(**leaves, **size)
    both, _, _ = rasterization(**leaves, **size, render_mode="RGB+D")
    expected, _, _ = rasterization(**leaves, **size, render_mode="ED")
    alone, _, _ = rasterization(**leaves, **size, render_mode="D")
    assert torch.equal(both[..., :3], rgb)
    assert torch.allclose(both[..., 3:], alone, atol=1e-6)
    assert torch.allclose(expected * alpha, alone, atol=1e-5)
    ground = torch.tensor([[0.2, 0.4, 0.9], [1.0, 0.0, 0.5]], device=DEVICE)
    over, _, _ = rasterization(**leaves, **size, backgrounds=ground)
    assert torch.allclose(over, rgb + (1 - alpha) * ground[:, None, None], atol=1e-6)
    count = len(leaves["means"])
    shapes = {name: tuple(meta[name].shape) for name in ("means2d", "conics", "opacities", "depths", "radii")}
    assert shapes == {
        "means2d": (2, count, 2), "conics": (2, count, 3), "opacities": (2, count), "depths": (2, count),
        "radii": (2, count, 2),
    }  # fmt: skip
    assert meta["radii"].dtype == torch.int32
    assert (meta["tile_width"], meta["tile_height"]) == (3, 3)  # of 16 pixels
    with pytest.raises(KeyError, match=r"^meta: expected one of batch_ids, .*, found 'isect_ids'; splats are not"):
        meta["isect_ids"]
    assert meta.get("isect_ids") is None
    each = [
        rasterization(**{**leaves, "viewmats": leaves["viewmats"][k : k + 1], "Ks": leaves["Ks"][k : k + 1]}, **size)
        for k in (0, 1)
    ]
    assert torch.equal(torch.cat([one[0] for one in each]), rgb)


def test_numbers_of_numpy_and_backgrounds_of_one_channel_are_taken():
    leaves = as_floats(scene())
    depths, _, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3, render_mode="D")
    size = {"width": np.int64(SIDE), "height": np.int32(SIDE), "near_plane": np.float32(0.01), "sh_degree": np.int8(3)}
    over, _, _ = rasterization(**leaves, **size, render_mode="D", backgrounds=torch.ones(2, 1, device=DEVICE))
    assert torch.equal(depths, over)  # as gsplat has it: depth has no background


def test_planes_and_radii_leave_out_what_is_beyond_them():
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 0, "render_mode": "ED", "packed": False}
    depths = rasterization(**leaves, **size)[2]["depths"]
    middle = float(depths.median())
    near, alpha, meta = rasterization(**leaves, **size, far_plane=middle)
    assert (near[alpha > 1e-3] < middle).all()
    assert (meta["radii"][meta["depths"] > middle] == 0).all()
    far, alpha, _ = rasterization(**leaves, **size, near_plane=middle)
    assert (far[alpha > 1e-3] > middle).all()
    _, alpha, meta = rasterization(**leaves, **size, radius_clip=1e6)
    assert not alpha.any()
    assert not meta["radii"].any()
    radii = rasterization(**leaves, **size)[2]["radii"]
    middle = float(radii[radii > 0].float().median()) + 0.5  # gsplat compares whole pixels with it
    kept = rasterization(**leaves, **size, radius_clip=middle)[2]["radii"]
    assert torch.equal(kept, radii * (radii > middle).any(dim=-1, keepdim=True))
    assert 0 < (kept > 0).sum() < (radii > 0).sum()


@pytest.mark.parametrize("cameras", [1, 2])
def test_what_is_returned_may_be_changed_in_place(cameras):
    """As gsplat's own trainer does with masks."""
    leaves = as_floats(scene())
    leaves |= {name: leaves[name][:cameras] for name in ("viewmats", "Ks")}
    means = leaves["means"].requires_grad_()
    picture, alpha, meta = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3, packed=False)
    (whole,) = torch.autograd.grad(picture[:, : SIDE // 2].sum(), means, retain_graph=True)
    picture[:, SIDE // 2 :] = 0
    alpha.clamp_(0, 0.5)
    meta["opacities"].mul_(1.0)
    (masked,) = torch.autograd.grad(picture.sum(), means, retain_graph=True)
    torch.testing.assert_close(masked, whole)
    (gradient,) = torch.autograd.grad(alpha.square().sum(), means, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.square().sum().backward()


def test_gradients_of_positions_on_the_screen():
    """What strategies of gsplat read: `means2d.retain_grad()`, and the sum of absolute gradients beside it."""
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 1, "absgrad": True}
    picture, _, meta = rasterization(**leaves, **size, packed=False)
    meta["means2d"].retain_grad()
    picture.square().sum().backward()
    gradient, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert gradient.shape == absolute.shape == (2, len(leaves["means"]), 2)
    assert gradient.abs().sum() > 0
    assert (absolute >= gradient.abs() * (1 - 1e-4) - 1e-5).all()


def test_packed_results_are_those_that_are_drawn():
    """Rows of the others, camera by camera, with what makes gradients reach them."""
    found = []
    for packed in (True, False):
        leaves = as_floats(scene())
        size = {"width": SIDE, "height": SIDE, "sh_degree": 1, "far_plane": 4.0, "absgrad": True}
        picture, _, meta = rasterization(**leaves, **size, packed=packed)
        meta["means2d"].retain_grad()
        (picture.square().sum() + meta["depths"][meta["radii"][..., 0] > 0].sum()).backward()
        found.append((picture, meta, leaves))
    (picture, packed, by_packed), (expected, dense, by_dense) = found
    drawn = (dense["radii"] > 0).all(-1)
    assert 0 < int(drawn.sum()) < drawn.numel()
    cameras, gaussians = torch.where(drawn)
    assert torch.equal(packed["camera_ids"], cameras)
    assert torch.equal(packed["gaussian_ids"], gaussians)
    assert torch.equal(packed["batch_ids"], 0 * cameras)
    for name in ("means2d", "conics", "opacities", "depths", "radii"):
        assert torch.equal(packed[name], dense[name][drawn]), name
    assert torch.equal(packed["means2d"].grad, dense["means2d"].grad[drawn])
    assert torch.equal(packed["means2d"].absgrad, dense["means2d"].absgrad[drawn])
    assert torch.equal(picture, expected)
    for name, leaf in by_dense.items():
        assert torch.equal(by_packed[name].grad, leaf.grad), name


@pytest.mark.parametrize("packed", [{}, {"packed": False}])
def test_a_training_script_of_gsplats_runs_with_its_import_changed(packed):
    """Packed, as gsplat has it by default, and not: sums of the gradients on the screen by Gaussian, and Gaussians that
    are duplicated and removed by them, as its default strategy does it."""
    torch.manual_seed(0)
    count, is_packed = 80, packed.get("packed", True)
    truth = as_floats(scene(120, cameras=3))
    cameras = {"viewmats": truth.pop("viewmats").detach(), "Ks": truth.pop("Ks").detach()}
    size = {"width": SIDE, "height": SIDE, "sh_degree": 1}
    with torch.no_grad():
        target = rasterization(**truth, **cameras, **size)[0]
    splats = {name: leaf.detach()[:count].clone().requires_grad_() for name, leaf in truth.items()}
    losses, numbers = [], [count]
    state = {"gradient": torch.zeros(count, device=DEVICE), "count": torch.zeros(count, device=DEVICE)}
    optimizer = torch.optim.Adam(splats.values(), lr=0.01)
    for step in range(1, 31):
        picture, _, info = rasterization(**splats, **cameras, **size, **packed, absgrad=True)
        info["means2d"].retain_grad()
        loss = (picture - target).square().mean()
        loss.backward()
        by_place = info["means2d"].absgrad.clone()
        assert (by_place >= info["means2d"].grad.abs() * (1 - 1e-4) - 1e-7).all()
        by_place *= torch.tensor([info["width"], info["height"]], device=DEVICE) / 2 * info["n_cameras"]
        if is_packed:
            ids = info["gaussian_ids"]
        else:
            drawn = (info["radii"] > 0).all(dim=-1)
            ids, by_place = torch.where(drawn)[1], by_place[drawn]
        state["gradient"].index_add_(0, ids, by_place.norm(dim=-1))
        state["count"].index_add_(0, ids, torch.ones_like(ids, dtype=torch.float32))
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            splats["opacities"].clamp_(0.01, 0.99)
            if step % 10 == 0:
                mean = state["gradient"] / state["count"].clamp_min(1)
                grows, stays = mean > mean.quantile(0.7), splats["opacities"] > 0.02
                for name, value in splats.items():
                    splats[name] = torch.cat([value[stays], value[grows]]).requires_grad_()
                numbers.append(len(splats["means"]))
                state = {name: torch.zeros(numbers[-1], device=DEVICE) for name in state}
                optimizer = torch.optim.Adam(splats.values(), lr=0.01)
        losses.append(float(loss))
    assert len(set(numbers)) == 4
    assert losses[-1] < 0.6 * losses[0]


def test_numbers_that_cannot_be_drawn_harm_no_others():
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 3}
    with torch.no_grad():
        leaves["opacities"][0] = 0
        expected = rasterization(**leaves, **size)[0]
        leaves["means"][0] = float("nan")
        leaves["scales"][0] = float("inf")
    picture, _, _ = rasterization(**leaves, **size)
    assert torch.allclose(picture, expected, atol=1e-6)
    picture.sum().backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None, name
        assert torch.isfinite(leaf.grad).all(), name


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"render_mode": "RGBD"}, "render_mode: expected one of RGB, D, ED"),
        ({"camera_model": "fisheye"}, "camera_model: expected one of pinhole, ortho, found 'fisheye'"),
        ({"with_ut": True}, "with_ut: not supported"),
        ({"covars": torch.zeros(60, 6)}, "covars: not supported"),
        ({"sh_degree": 4}, "sh_degree: expected 0 to 3, found 4"),
        ({"sh_degree": 1.5}, "sh_degree: expected a whole number, found 1.5"),
        ({"sh_degree": "2"}, "sh_degree: expected a whole number, found '2'"),
        ({"near_plane": "1"}, "near_plane: expected a number, found '1'"),
        ({"near_plane": float("nan")}, "near_plane: expected a number, found nan"),
        ({"radius_clip": None}, "radius_clip: expected a number, found None"),
        ({"near_plane": 5, "far_plane": 2}, "far_plane: expected at least near_plane, 5, found 2"),
        ({"eps2d": -1}, "eps2d: expected 0 or more, found -1"),
        (
            {"colors": torch.zeros(60, 16, 3).cfloat()},
            "colors: expected real numbers, found torch.complex64",
        ),
        ({"sh_degree": None}, r"colors: expected \[60, D\]"),
        ({"quats": torch.zeros(60, 3)}, r"quats: expected \[60, 4\], found \[60, 3\]"),
        ({"quats": torch.zeros(60, 3)}, r"found \[60, 3\]$"),
        ({"means": torch.zeros(2, 60, 3)}, r"means: expected \[N, 3\], found \[2, 60, 3\]; batches are not supported"),
        ({"quats": None}, "quats: expected a tensor, found one of type NoneType"),
        ({"colors": [1.0]}, "colors: expected a tensor, found one of type list"),
        ({"tile_size": 0}, "tile_size: expected at least 1, found 0"),
        ({"height": 0}, "height: expected at least 1, found 0"),
        ({"width": 64.0}, "width: expected a whole number, found 64.0"),
        ({"viewmats": torch.eye(4)}, r"viewmats: expected \[C, 4, 4\], found \[4, 4\]; add \[None\]"),
        ({"Ks": torch.eye(3)}, r"Ks: expected \[C, 3, 3\], found \[3, 3\]; add \[None\]"),
        ({"backgrounds": torch.zeros(2, 4)}, r"backgrounds: expected \[2, 3\], found \[2, 4\]"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes, words):
    leaves = as_floats(scene())
    changes = {key: value.to(DEVICE) if torch.is_tensor(value) else value for key, value in changes.items()}
    with pytest.raises(ValueError, match=words):
        rasterization(**{**leaves, "width": SIDE, "height": SIDE, "sh_degree": 1, **changes})


def test_a_tensor_without_memory_is_refused():
    leaves = as_floats(scene())
    words = "means: expected a tensor on a CPU or on CUDA, found one on meta"
    with pytest.raises(ValueError, match=words):
        rasterization(**{**leaves, "means": leaves["means"].to("meta")}, width=SIDE, height=SIDE, sh_degree=1)


def test_same_tensors_same_bits():
    leaves = as_floats(scene())
    found = []
    for _ in range(2):
        picture, alpha, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3)
        gradients = torch.autograd.grad(picture.sin().sum() + alpha.sum(), list(leaves.values()))
        found.append([picture, alpha, *gradients])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_threads_do_not_disturb_each_other():
    def results(count: int) -> list[torch.Tensor]:
        leaves = {name: leaf.detach().requires_grad_() for name, leaf in scenes[count].items()}
        picture, alpha, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3)
        return [picture, *torch.autograd.grad(picture.sin().sum() + alpha.sum(), list(leaves.values()))]

    scenes = {count: as_floats(scene(count, cameras=1)) for count in (59, 60, 200)}
    alone = {count: results(count) for count in scenes}
    with ThreadPoolExecutor(len(scenes)) as threads:
        found = list(threads.map(lambda i: results(list(scenes)[i % len(scenes)]), range(40)))
    for i, own in enumerate(found):
        assert all(torch.equal(one, other) for one, other in zip(own, alone[list(scenes)[i % 3]], strict=True))


def test_without_torch_a_sentence():
    program = "import sys; sys.modules['torch'] = None; import spacesim.torch"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "ImportError: spacesim.torch: expected torch, found none; type: pip install 'spacesim[torch]'" in done.stderr


def test_recordings_serve_other_numbers_of_gaussians(monkeypatch):
    """One after another, larger and smaller: what is replayed is what is traced."""
    from spacesim.torch import autograd

    for count in (60, 300, 17, 1024, 1, 500, 1023, 768, 2):
        leaves = as_floats(scene(count, cameras=1))
        found = []
        for traced in (False, True):
            with monkeypatch.context() as patch:
                if traced:
                    patch.setattr(autograd, "project", autograd.project.traced)
                    patch.setattr(autograd, "project_back", autograd.project_back.traced)
                picture, alpha, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3)
                found.append([picture, *torch.autograd.grad(picture.sin().sum() + alpha.sum(), list(leaves.values()))])
        for one, other in zip(*found, strict=True):
            assert torch.allclose(one, other, rtol=1e-5, atol=1e-6), count
