"""gsplat's `rasterization` over Dr.Jit's kernels: for torch, on CUDA and on any CPU, without a compiler.

    from spacesim.torch import rasterization

It takes the arguments of gsplat 1.5.3's function of that name (V. Ye et al., "gsplat: An open-source library for
Gaussian splatting", 2025), in their order, and returns what it returns; what is not supported ends in one sentence.
Tensors on a CUDA device run on CUDA, others on the CPU, one of the two in a process. On a CPU torch's threads wait by
spinning and take cores from the kernels: `torch.set_num_threads(1)`.
"""

from typing import NoReturn, TypedDict, cast

try:
    import torch
    from torch import Tensor
except ImportError:
    raise ImportError("spacesim.torch: expected torch, found none; type: pip install 'spacesim[torch]'") from None

from spacesim import backend
from spacesim.torch import arguments
from spacesim.torch.autograd import DEPTH, OPACITY, Blend, BlendInputs, Project, pack


class Meta(TypedDict):
    """What `rasterization` returns beside pictures and alphas. `...` is M with packed=True, the splats that are drawn,
    camera by camera; with packed=False it is C, N, all Gaussians of each camera."""

    batch_ids: Tensor | None  #: int64 [M], all 0; None where not packed
    camera_ids: Tensor | None  #: int64 [M], camera of each splat; None where not packed
    gaussian_ids: Tensor | None  #: int64 [M], Gaussian of each splat; None where not packed
    radii: Tensor  #: int32 [..., 2], half the sides of the box around a splat, pixels; 0 of what is not drawn
    means2d: Tensor  #: [..., 2], centres, pixels
    depths: Tensor  #: [...], of the centres along the camera's axis, metres
    conics: Tensor  #: [..., 3], inverse of the 2D covariance, pixels^-2: a, b, c of a dx^2 + 2 b dx dy + c dy^2
    opacities: Tensor  #: [...], in [0, 1]; with "antialiased" those that are drawn
    tile_width: int  #: tiles of `tile_size` in a row of the picture
    tile_height: int  #: tiles in a column
    width: int  #: of the pictures, pixels
    height: int  #: of the pictures, pixels
    tile_size: int  #: as given, pixels
    n_batches: int  #: 1
    n_cameras: int  #: C


class _MissingEntryError(KeyError):
    """An entry that `Meta` has not. Its message is a sentence as it is, not quoted."""

    def __str__(self) -> str:
        return str(self.args[0])


class _Entries(dict[str, object]):
    """A `Meta` that says which entries it has where it is asked for another."""

    def __missing__(self, name: str) -> NoReturn:
        why = "; splats are not listed by tile" if name in OF_TILES else ""
        raise _MissingEntryError(f"meta: expected one of {', '.join(self)}, found {name!r}{why}")


Results = tuple[Tensor, Tensor, Meta]

OF_TILES = ("isect_ids", "flatten_ids", "isect_offsets", "tiles_per_gauss")  #: entries of gsplat's alone
MIN_ALPHA = 1e-10  #: by which "ED" divides at least, as gsplat


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object = None,
    rolling_shutter: object = None,
    viewmats_rs: Tensor | None = None,
) -> Results:
    """Render N Gaussians with C cameras, differentiable once by every tensor that requires gradients.

    means: [N, 3] metres;  quats: [N, 4] (w, x, y, z), of any length;  scales: [N, 3] standard deviations, metres
    opacities: [N] in [0, 1]
    colors: [N, K, 3] or [C, N, K, 3] harmonics where `sh_degree` is given, else [N, D] or [C, N, D] of any D
    viewmats: [C, 4, 4] world to camera, OpenCV axes;  Ks: [C, 3, 3] pinhole intrinsics, pixels (of an "ortho" camera
        pixels per metre)
    near_plane, far_plane: metres;  radius_clip: pixels, splats no larger are not drawn
    eps2d: pixels^2 added to the screen-space covariance;  rasterize_mode: "classic", or "antialiased": what that adds
        to a splat's area is taken from its opacity
    backgrounds: [C, D] or None;  render_mode: "RGB", "D" (summed depth), "ED" (expected depth), "RGB+D", "RGB+ED"
    absgrad: means2d gets the attribute `absgrad`, of its shape, in the backward pass
    packed: how the dictionary lies, see below; pictures and time are the same but for a few indices
    tile_size, channel_chunk, segmented: taken and without effect

    Returns (pictures [C, H, W, D], depth last; alphas [C, H, W, 1]; a dictionary). In the dictionary are means2d
    [..., 2] (pixels, which `retain_grad` works on), conics [..., 3], opacities [...], depths [...] and radii [..., 2]
    int32: with packed=True of the splats that are drawn, camera by camera, whose batch_ids, camera_ids and gaussian_ids
    are int64 [M]; with packed=False [C, N, ...], radii 0 of what is not drawn, and None for the ids. Further width,
    height, n_cameras, n_batches, tile_size, tile_width and tile_height.

    Raises ValueError for what is no tensor, for numbers that cannot be, for shapes that do not fit, for tensors on
    several devices, for a second device in one process and for what is not supported, BackendError where the device's
    backend cannot run. Without torch, importing this module raises ImportError.
    """
    arguments.check_unsupported(
        {
            "sparse_grad": sparse_grad,
            "distributed": distributed,
            "covars": covars,
            "with_ut": with_ut,
            "with_eval3d": with_eval3d,
            "radial_coeffs": radial_coeffs,
            "tangential_coeffs": tangential_coeffs,
            "thin_prism_coeffs": thin_prism_coeffs,
            "ftheta_coeffs": ftheta_coeffs,
            "viewmats_rs": viewmats_rs,
            "rolling_shutter": rolling_shutter,
        }
    )
    arguments.check_choice("render_mode", render_mode, arguments.RENDER_MODES)
    arguments.check_choice("rasterize_mode", rasterize_mode, arguments.RASTERIZE_MODES)
    arguments.check_choice("camera_model", camera_model, arguments.CAMERA_MODELS)
    sizes = {"width": width, "height": height, "tile_size": tile_size}
    width, height, tile_size = (arguments.checked_size(name, size) for name, size in sizes.items())
    numbers = arguments.checked_numbers(
        {"near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip, "eps2d": eps2d}
    )
    sh_degree = None if sh_degree is None else arguments.checked_whole("sh_degree", sh_degree)
    count, cameras = arguments.check_shapes(means, quats, scales, opacities, viewmats, Ks)
    arguments.check_colors(colors, backgrounds, sh_degree, render_mode, means, cameras)
    backend.select("cuda" if means.is_cuda else "llvm")
    settings = arguments.raster_settings(
        width=width,
        height=height,
        near=numbers["near_plane"],
        far=numbers["far_plane"],
        radius_clip=numbers["radius_clip"],
        eps2d=numbers["eps2d"],
        antialiased=rasterize_mode == "antialiased",
        ortho=camera_model == "ortho",
        degree=sh_degree,
    )
    colored, harmonic = "RGB" in render_mode, sh_degree is not None
    float32 = torch.float32
    colors = colors.to(float32)
    means2d, table, radii, projected = Project.apply(
        means.to(float32),
        quats.to(float32),
        scales.to(float32),
        opacities.to(float32),
        colors if harmonic else None,
        viewmats.to(float32),
        Ks.to(float32),
        settings,
    )
    visible, camera_ids, gaussian_ids = None, None, None
    if packed:
        visible = radii[..., 0].flatten().nonzero()[:, 0]
        camera_ids, gaussian_ids = visible // count, visible % count
        means2d = pack(means2d, visible)
    drawing = BlendInputs(
        projected=projected,
        width=width,
        height=height,
        harmonic=colored and harmonic,
        depth="D" in render_mode,
        visible=visible,
        target=means2d if absgrad else None,
    )
    pictures, alphas = Blend.apply(means2d, table, colors if colored and not harmonic else None, drawing)
    pictures = _finish_picture(pictures, alphas, backgrounds, render_mode)
    own = pack(table, visible)
    meta: Meta = {
        "batch_ids": None if gaussian_ids is None else torch.zeros_like(gaussian_ids),
        "camera_ids": camera_ids,
        "gaussian_ids": gaussian_ids,
        "radii": pack(radii, visible),
        "means2d": means2d,
        "depths": own[..., DEPTH],
        "conics": own[..., :3],
        "opacities": own[..., OPACITY],
        "tile_width": -(-width // tile_size),
        "tile_height": -(-height // tile_size),
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_batches": 1,
        "n_cameras": cameras,
    }
    return pictures, alphas, cast(Meta, _Entries(meta))


def _finish_picture(picture: Tensor, alpha: Tensor, backgrounds: Tensor | None, render_mode: str) -> Tensor:
    """Over the background, expected depth last where that is asked for."""
    color, depth = (picture[..., :-1], picture[..., -1:]) if "D" in render_mode else (picture, None)
    if backgrounds is not None and color.shape[-1]:
        color = color + (1 - alpha) * backgrounds[:, None, None, :]
    if depth is None:
        return color
    depth = depth / alpha.clamp(min=MIN_ALPHA) if "ED" in render_mode else depth
    return torch.cat([color, depth], dim=-1)


__all__ = ["rasterization"]
