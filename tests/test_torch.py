"""gsplat's `rasterization` over our kernels, beside the same formulas in dense torch, pixel by pixel."""

import subprocess
import sys

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
    """Leaves in double precision, so that finite differences and the dense twin are exact."""
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
    colour = leaves["colors"]
    if degree is not None:
        away = leaves["means"] - torch.linalg.inv(view)[:3, 3]
        basis = harmonics(away / away.norm(dim=-1, keepdim=True))[:, : (degree + 1) ** 2]
        colour = (torch.einsum("nk,nkc->nc", basis, colour[:, : (degree + 1) ** 2]) + 0.5).clamp(min=0)
    features = torch.cat([colour, z[:, None]], -1)
    order = torch.argsort(z)
    pixel = torch.arange(SIDE) + 0.5
    grid = torch.stack(torch.meshgrid(pixel, pixel, indexing="xy"), -1).double()
    passes, picture = torch.ones(SIDE, SIDE, dtype=torch.float64), torch.zeros(SIDE, SIDE, features.shape[1]).double()
    inverse = torch.linalg.inv(spread)
    for k in order.tolist():
        offset = grid - centre[k]
        alpha = opacity[k] * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", offset, inverse[k], offset))
        alpha = alpha.clamp(max=ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & (z[k] > 0.01) & (passes.detach() > PASSES), alpha, 0 * alpha)
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


def test_modes_backgrounds_and_what_is_told():
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 2}
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
    each = [
        rasterization(**{**leaves, "viewmats": leaves["viewmats"][k : k + 1], "Ks": leaves["Ks"][k : k + 1]}, **size)
        for k in (0, 1)
    ]
    assert torch.equal(torch.cat([one[0] for one in each]), rgb)


def test_planes_and_radii_leave_out_what_is_beyond_them():
    leaves = as_floats(scene())
    size = {"width": SIDE, "height": SIDE, "sh_degree": 0, "render_mode": "ED"}
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


def test_gradients_of_positions_on_the_screen():
    """What strategies of gsplat read: `means2d.retain_grad()`, and the sum of absolute gradients beside it."""
    leaves = as_floats(scene())
    picture, _, meta = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=1, absgrad=True)
    meta["means2d"].retain_grad()
    picture.square().sum().backward()
    gradient, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert gradient.shape == absolute.shape == (2, len(leaves["means"]), 2)
    assert gradient.abs().sum() > 0
    assert (absolute >= gradient.abs() * (1 - 1e-4) - 1e-5).all()


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
        ({"sh_degree": None}, r"colors: expected \[60, D\]"),
        ({"quats": torch.zeros(60, 3)}, r"quats: expected \[60, 4\], found \[60, 3\]"),
        ({"means": torch.zeros(2, 60, 3)}, "batches are not supported"),
        ({"backgrounds": torch.zeros(2, 4)}, r"backgrounds: expected \[2, 3\], found \[2, 4\]"),
    ],
)
def test_what_does_not_fit_is_told(changes, words):
    leaves = as_floats(scene())
    with pytest.raises(ValueError, match=words):
        rasterization(**{**leaves, "width": SIDE, "height": SIDE, "sh_degree": 1, **changes})


def test_same_tensors_same_bits():
    leaves = as_floats(scene())
    found = []
    for _ in range(2):
        picture, alpha, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3)
        gradients = torch.autograd.grad(picture.sin().sum() + alpha.sum(), list(leaves.values()))
        found.append([picture, alpha, *gradients])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_without_torch_a_sentence():
    program = "import sys; sys.modules['torch'] = None; import spacesim.torch"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "ImportError: spacesim.torch: expected torch, found none; type: pip install torch" in done.stderr


def test_recordings_serve_other_numbers_of_gaussians(monkeypatch):
    """One after another, larger and smaller: what is replayed is what is traced."""
    from spacesim import torch as door

    for count in (60, 300, 17, 1024, 1, 500):
        leaves = as_floats(scene(count, cameras=1))
        found = []
        for traced in (False, True):
            with monkeypatch.context() as patch:
                if traced:
                    patch.setattr(door, "_project", door._trace_project)
                    patch.setattr(door, "_project_back", door._trace_project_back)
                picture, alpha, _ = rasterization(**leaves, width=SIDE, height=SIDE, sh_degree=3)
                found.append([picture, *torch.autograd.grad(picture.sin().sum() + alpha.sum(), list(leaves.values()))])
        for one, other in zip(*found, strict=True):
            assert torch.allclose(one, other, rtol=1e-5, atol=1e-6), count
