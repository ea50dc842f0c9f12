"""The stages of a training step that Dr.Jit differentiates; each is recorded once and replayed."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Footprints, Splats, project
from spacesim.splat.raster.render import view_colours
from spacesim.splat.raster.supersample import pixel_means
from spacesim.splat.raster.surface import normals
from spacesim.splat.raster.tone import light_of, picture_of
from spacesim.splat.train.loss import depth_loss, normal_loss, photometric_loss, visibility_loss
from spacesim.splat.train.optimizer import adam_step
from spacesim.splat.train.warm_start import foreground_loss


def project_views(
    rows: list[Any], camera: Pinhole, degree: int, antialiased: bool, shape: tuple[str, ...], scale: float
) -> tuple[Splats, Footprints, dict[str, list[Any]]]:
    """Splats, footprints and what is blended, Floats [N] by name, without gradients: "colour", none where it comes from
    a field, and of `shape` "depth", in units of `scale` metres, and "normal"."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera, antialiased)
    colour = [] if gaussians.features is not None else list(view_colours(gaussians, camera, degree))
    return splats, footprints, {"colour": colour, **shape_values(gaussians, splats, camera, shape, scale)}


def shape_values(
    gaussians: Gaussians, splats: Splats, camera: Pinhole, shape: Iterable[str], scale: float
) -> dict[str, list[Any]]:
    """What is blended for the sake of the shape, see `project_views`, of the names in `shape`."""
    found = {}
    if "depth" in shape:
        found["depth"] = [splats.depth / scale]
    if "normal" in shape:
        found["normal"] = list(normals(gaussians, camera))
    return found


@dataclass
class Target:
    """What a picture is compared with. rgba: UInt32 [H * W];  background: Float [3];  valid: Bool [H * W] or of width 1
    truth: Floats [H * W] by name, see `View`, and "foreground": Bool [H * W] and its weight, Float"""

    rgba: Any
    background: Any
    valid: Any
    truth: dict[str, list[Any]]


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms;  scale: metres, the unit of depth;  tone: curve of colours that are blended, with the
    background, in linear light, or None;  supersample: places on a side of each pixel, see `pixel_means`"""

    ssim: float
    visibility: float
    depth: float
    normal: float
    scale: float
    tone: str | None
    supersample: int = 1


def picture_loss(
    planes: dict[str, list[Any]], transmittance: Any, target: Target, size: tuple[int, int], config: LossConfig
) -> tuple[Any, dict[str, list[Any]], Any]:
    """Loss of a picture over the target's background, and its gradients by its planes (by name) and transmittance.
    size: width and height of the target, pixels"""
    channels = [ad.Float((target.rgba >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24)]
    below = ad.Array3f([dr.gather(ad.Float, target.background, ad.UInt32(c)) for c in range(3)])
    straight = ad.Array3f(channels[:3])
    if config.tone:
        straight, below = light_of(straight, config.tone), light_of(below, config.tone)
    truth = straight * channels[3] + (1 - channels[3]) * below
    planes = {name: [ad.Float(plane) for plane in group] for name, group in planes.items()}
    transmittance = ad.Float(transmittance)
    dr.enable_grad(planes, transmittance)
    drawn, places = planes, transmittance
    if config.supersample > 1:
        planes, transmittance = pixel_means(planes, transmittance, size, config.supersample, config.tone is not None)
    picture = dr.select(target.valid, ad.Array3f(planes["colour"]) + transmittance * below, truth)
    if config.tone:
        picture, truth = picture_of(picture, config.tone), picture_of(truth, config.tone)
    loss = photometric_loss(picture, truth, *size, ssim_weight=config.ssim)
    known, valid = target.truth, target.valid
    if "visibility" in planes:
        loss += config.visibility * visibility_loss(planes["visibility"][0], known["visibility"][0], valid)
    if "depth" in planes:
        depth = known["depth"][0] / config.scale
        loss += config.depth * depth_loss(planes["depth"][0], transmittance, depth, valid)
    if "normal" in planes:
        normal = ad.Array3f(planes["normal"]), transmittance, ad.Array3f(known["normal"])
        loss += config.normal * normal_loss(*normal, valid)
    if "foreground" in known:
        mask, weight = known["foreground"]
        loss += weight * foreground_loss(transmittance, mask)
    dr.backward(loss)
    by_plane = {name: [dr.grad(plane) for plane in group] for name, group in drawn.items()}
    return dr.detach(loss), by_plane, dr.grad(places)


def on_screen(absolute: tuple[Any, Any], half: tuple[Any, Any], sizes: Any) -> tuple[Any, Any]:
    """What refinement watches, [N] each: the norm of the absolute gradient by half a picture, and the larger radius as
    a share of the picture's longer side. absolute: by x and y, a pixel;  half: width and height of the box, pixels;
    sizes: Float [3], half the picture's width and height, its longer side"""
    half_width, half_height, longer = (dr.gather(ad.Float, sizes, ad.UInt32(i)) for i in range(3))
    gradient = dr.sqrt(dr.square(absolute[0] * half_width) + dr.square(absolute[1] * half_height))
    return gradient, dr.maximum(*half) / longer


def update_light(
    weights: list[Any], moments: tuple[list[Any], list[Any]], gradients: list[list[Any]], factors: Any
) -> tuple[list[Any], list[Any], list[Any]]:
    """An Adam step of the networks by their mean gradient. factors: Float [3], two corrections and the step size."""
    numbers = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in range(3)]
    means = [mean(list(of_views)) for of_views in zip(*gradients, strict=True)]
    return adam_step(weights, means, moments, [numbers[2]] * len(weights), (numbers[0], numbers[1]))


def mean(values: list[Any]) -> Any:
    """Of some views' gradients."""
    return values[0] if len(values) == 1 else sum(values[1:], values[0]) / len(values)
