"""Warm start by foreground attraction (thesis 5.3, 5.23 to 5.31, table 5.7): Gaussians that start anywhere are pulled
towards what the training pictures show, before densification begins to prune.
"""

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float
from spacesim.backend.upload import upload, upload_rows
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.images import luminance
from spacesim.data.structure import check_fields
from spacesim.splat.raster.cameras import NEAR, Pinhole
from spacesim.splat.raster.gaussians import Gaussians, stack_rows
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.start import spacing
from spacesim.splat.train.strategies.densify import raise_opacities
from spacesim.splat.train.strategies.strategy import MAX_STEPS, MAX_THRESHOLD
from spacesim.splat.train.views import DEVICE_BYTES, TrainingView, TrainingViews


@dataclass(frozen=True)
class WarmStartConfig:
    """Gaussians that start anywhere are pulled to what pictures show. Steps count from the start of training."""

    steps: int = 2_000  #: table 5.7, T_ws: full strength, no densification
    decay: int = 2_000  #: table 5.7, T_decay: steps in which it fades
    weight: float = 0.5  #: table 5.7, lambda_ws, of the foreground loss
    alpha_mask: bool = True  #: the foreground of pictures with transparency is their alpha; false: 5.24 of all
    luminance: float = 0.03  #: table 5.7, tau_fg: brighter is foreground, over black
    dilation: int = 3  #: table 5.7, pixels, of masks by luminance; a mask by alpha is known exactly
    projection_weight: float = 0.4  #: table 5.7, lambda_proj, of the pull towards the foreground beside it
    downsampling: int = 4  #: table 5.7, of the distance image
    reach: float = 0.125  #: rho of 5.26: the distance that counts 1, a share of the picture's smaller side
    travel: float = 1.0  #: of the radius of the start, how far a Gaussian can move during `steps`; 0: as without
    rescue: float = 0.5  #: table 5.7, alpha_rescue: how far the unseen move towards the visible cloud
    rescue_every: int = 100  #: steps; a Gaussian that no view of them had in its picture is unseen
    least_seen: int = 16  #: Gaussians that make a visible cloud, as many as table 5.3's least supported one has
    gather: bool = True  #: beyond the nearest camera is unseen, too
    spacing: float = 1.0  #: widest a Gaussian is after a rescue, in mean distances to its three nearest; 0: any
    revive: float = 0.1  #: opacity to which fainter ones are raised at each rescue: that of the start; 0: none
    conservative: int = 1_000  #: table 5.7, steps after `steps` with a lower opacity threshold
    opacity_scale: float = 0.5  #: table 5.7, of that threshold

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.reach > 0:
            raise InputError(f"reach: expected a number above 0, found {self.reach}")
        check_ranges(self, rescue=(0, 1), least_seen=(0, MAX_STEPS))
        check_ranges(self, steps=(0, MAX_STEPS), decay=(0, MAX_STEPS), conservative=(0, MAX_STEPS))
        check_ranges(self, weight=(0, MAX_THRESHOLD), projection_weight=(0, MAX_THRESHOLD), reach=(0, MAX_THRESHOLD))
        check_ranges(
            self, travel=(0, MAX_THRESHOLD), spacing=(0, MAX_THRESHOLD), dilation=(0, 1000), downsampling=(1, 1000)
        )
        check_ranges(self, luminance=(0, 1), revive=(0, 1), opacity_scale=(0, 1), rescue_every=(1, MAX_STEPS))

    def remark(self, iterations: int) -> str:
        """A sentence where training is over before the attraction is; "" where it is not."""
        if iterations > self.steps + self.decay:
            return ""
        return (
            f"warm_start: gathers Gaussians for {self.steps} iterations and fades over {self.decay} more, expected a "
            f"training of more than {self.steps + self.decay}, better of several times as many, found {iterations}: "
            "what is gathered is hardly trained"
        )

    def strength(self, step: int) -> float:
        """w_ws of 5.29 at `step`, the first of which is 0."""
        if step < self.steps:
            return self.weight
        if step < self.steps + self.decay:
            return self.weight * (1 - (step - self.steps) / self.decay)
        return 0.0

    def means_rate(self, step: int, usual: float, radius: float) -> float:
        """Step size of the means, metres: so that they can cross `travel` times the `radius` of the start, metres,
        while densification waits; falls back to the usual one as the attraction does, by powers."""
        fast = max(self.travel * radius / max(self.steps, 1), usual)
        share = self.strength(step) / self.weight if self.weight > 0 else 0.0
        return float(usual * (fast / usual) ** share)

    def leniency(self, step: int) -> float:
        """Factor of the opacity threshold after `step` finished steps: conservative culling."""
        return self.opacity_scale if step < self.steps + self.conservative else 1.0


def foreground(view: TrainingView, config: WarmStartConfig) -> np.ndarray:
    """[H, W] bool: where the picture shows the object. By alpha; of a picture without transparency, or of all without
    `alpha_mask`, by luminance over black, dilated (5.23, 5.24). Pixels that are to be ignored show nothing."""
    from scipy.ndimage import (
        binary_dilation,
    )  # a quarter of a second, that other trainings need not wait

    bytes_ = view.rgba.view(np.uint8).reshape(view.camera.height, view.camera.width, 4)
    if view.opaque or not config.alpha_mask:
        straight, alpha = bytes_[..., :3] / np.float32(255), bytes_[..., 3:] / np.float32(255)
        mask = luminance(straight * alpha) > config.luminance
        if config.dilation and mask.any():
            mask = binary_dilation(mask, disc(config.dilation))
    else:
        mask = bytes_[..., 3] >= 128
    return mask if view.valid is None else mask & view.valid.reshape(mask.shape)


def disc(radius: int) -> np.ndarray:
    """[2 r + 1, 2 r + 1] bool."""
    across = np.arange(-radius, radius + 1)
    return across[:, None] ** 2 + across**2 <= radius**2


def distance_image(mask: np.ndarray, config: WarmStartConfig, valid: np.ndarray | None = None) -> np.ndarray:
    """[h, w] float32, a pixel for each `downsampling`^2 of the mask: distance to the nearest of them that shows
    foreground, as a share of `reach` times the picture's smaller side (5.26). 0 where there is no foreground.
    Negative where no pixel counts by `valid` [H, W]: what is unknown is not empty, and pulls nothing away."""
    from scipy.ndimage import distance_transform_edt

    step = config.downsampling

    def is_any(pixels: np.ndarray) -> np.ndarray:
        height, width = (-(-side // step) * step for side in pixels.shape)
        padded = np.zeros((height, width), bool)
        padded[: pixels.shape[0], : pixels.shape[1]] = pixels
        return np.asarray(padded.reshape(height // step, step, width // step, step).any(axis=(1, 3)))

    coarse = is_any(mask)
    if not coarse.any():
        return np.zeros(coarse.shape, np.float32)
    shares = step * distance_transform_edt(~coarse) / (config.reach * min(mask.shape))
    return np.asarray(shares if valid is None else np.where(is_any(valid), shares, -shares), np.float32)


@dataclass
class Attraction:
    """Of one view."""

    mask: Bool  #: Bool [H * W]
    image: Float  #: Float [h * w], the distance image
    size: tuple[int, int]  #: its (width, height)


class WarmStart:
    """The attraction of every view, and who has been in a picture since the last rescue.

    state: "framed" Float [N], number of views since then that had a Gaussian's centre in their picture; N does not
    change while it is kept.
    """

    def __init__(
        self, config: WarmStartConfig, views: TrainingViews, centre: np.ndarray, nearest: float, count: int
    ) -> None:
        """centre: [3] metres, where the cameras look;  nearest: metres to the nearest of them;  count: of Gaussians"""
        self.config, self.views, self.centre, self.nearest = config, views, centre, nearest
        self.state = {"framed": dr.zeros(ad.Float, count)}
        self._cached = lru_cache(maxsize=max(1, DEVICE_BYTES // (2 * views.most_pixels)))(self._attraction)

    def active(self, step: int) -> bool:
        """Whether densification waits, and the unseen are rescued, at step number `step`, the first of which is 0."""
        return step < self.config.steps

    def attraction(self, view: TrainingView) -> Attraction:
        """What pulls in a view; nothing does where it shows no foreground."""
        attraction: Attraction = self._cached(view.index)
        return attraction

    def attraction_gradients(
        self, rows: list[Float], camera: Pinhole, attraction: Attraction, step: int
    ) -> list[Float]:
        """Gradients of the projected foreground loss by the means, as it counts at `step`: 3 Floats [N]. Counts who is
        in the picture while densification waits. rows: of the Gaussians, the first 3 count"""
        weight = dr.opaque(ad.Float, self.config.strength(step) * self.config.projection_weight)
        gradients, framed = _pull(rows[:3], camera, attraction.image, attraction.size, self.config.downsampling, weight)
        if self.active(step):
            self.state["framed"] = self.state["framed"] + framed
            dr.eval(self.state)
        return list(gradients)

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> None:
        """Rescue the unseen (5.31), narrow the wide and revive the faint if it is time to, after `step` finished
        steps."""
        config = self.config
        if step > config.steps or step % config.rescue_every:
            return
        means = stack_rows(gaussians.means).astype(np.float64)
        means[:, ~np.isfinite(means).all(axis=0)] = self.centre[:, None]
        unseen = np.array(self.state["framed"]) == 0
        if config.gather:
            unseen |= np.linalg.norm(means - self.centre[:, None], axis=0) > self.nearest
        self.state["framed"] = dr.zeros(ad.Float, gaussians.count)
        if unseen.any():
            enough = (~unseen).sum() >= config.least_seen
            target = means[:, ~unseen].mean(axis=1) if enough else self.centre
            means[:, unseen] += config.rescue * (target[:, None] - means[:, unseen])
            gaussians.means = upload_rows(means)
        if config.spacing > 0:
            widest = np.log(config.spacing * spacing(means.T))
            gaussians.log_scales = upload_rows(np.minimum(stack_rows(gaussians.log_scales), widest))
        if config.revive > 0:
            raise_opacities(gaussians, optimizer, config.revive)

    def _attraction(self, index: int) -> Attraction:
        view = self.views[index]
        mask = foreground(view, self.config)
        image = distance_image(mask, self.config, None if view.valid is None else view.valid.reshape(mask.shape))
        return Attraction(upload(mask.ravel(), ad.Bool), upload(image.ravel()), (image.shape[1], image.shape[0]))


def projected_loss(
    means: Array3f, camera: Pinhole, image: Float, size: tuple[int, int], step: int
) -> tuple[Float, Bool]:
    """(loss of width 1, Bool [N]: centre in the picture) of 5.27: the mean of the distance image, bilinearly sampled
    where each centre falls, over those that are in front of the camera and in the picture. Differentiable by `means`
    (Array3f [3, N]). The square root of the square is the value itself: distances are not negative.

    image: Float [h * w] of size (w, h), see `distance_image`;  step: pixels of the picture for one of its pixels
    """
    center = camera.transform(means)
    ahead = dr.detach(camera.in_reach(center)) & (dr.detach(center.z) > NEAR)
    screen = camera.screen(dr.select(ahead, center, ad.Array3f(0, 0, 1)))
    x, y = screen.x, screen.y
    framed = ahead & dr.detach((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    u, v = (ad.UInt32(dr.select(framed, dr.detach(place) / step, 0)) for place in (screen.x, screen.y))
    nearest = dr.minimum(v, size[1] - 1) * size[0] + dr.minimum(u, size[0] - 1)
    known = framed & (dr.gather(ad.Float, image, nearest) >= 0)
    value = dr.select(known, bilinear(image, size, x / step - 0.5, y / step - 0.5), 0)
    ones = dr.select(framed, ad.Float(1), 0)
    count = dr.maximum(dr.sum(ones), 1)
    return dr.sum(value) / count, framed


def bilinear(image: Float, size: tuple[int, int], u: Float, v: Float) -> Float:
    """[N] of the magnitudes of an image Float [h * w] at columns u and rows v, whose whole numbers are the centres of
    its pixels; linear beyond the outermost. Differentiable by u and v."""
    width, height = size
    left = dr.clip(dr.floor(dr.detach(u)), 0, max(width - 2, 0))
    top = dr.clip(dr.floor(dr.detach(v)), 0, max(height - 2, 0))
    fx, fy = u - left, v - top
    i, j = ad.UInt32(left), ad.UInt32(top)
    i1, j1 = dr.minimum(i + 1, width - 1), dr.minimum(j + 1, height - 1)
    corners = [dr.abs(dr.gather(ad.Float, image, row * width + column)) for row in (j, j1) for column in (i, i1)]
    upper, lower = dr.lerp(corners[0], corners[1], fx), dr.lerp(corners[2], corners[3], fx)
    return dr.lerp(upper, lower, fy)


@recorded
def _pull(
    rows: list[Float], camera: Pinhole, image: Float, size: tuple[int, int], step: int, weight: Float
) -> tuple[list[Float], Float]:
    """(gradients by the 3 rows, Float [N]: 1 where the centre is in the picture). weight: Float [1], no literal, as a
    0 known beforehand has no gradients"""
    rows = [ad.Float(row) for row in rows]
    dr.enable_grad(rows)
    loss, framed = projected_loss(ad.Array3f(rows), camera, image, size, step)
    dr.backward(loss * dr.gather(ad.Float, weight, ad.UInt32(0)))
    return [dr.grad(row) for row in rows], dr.select(framed, ad.Float(1), 0)


def foreground_loss(transmittance: Float, mask: Bool) -> Float:
    """5.25: mean of (1 - A)^2 over the foreground. transmittance: Float [H * W], 1 - A;  mask: Bool [H * W]"""
    ones, missing = dr.select(mask, ad.Float(1), 0), dr.select(mask, dr.square(transmittance), 0)
    return dr.sum(missing) / dr.maximum(dr.sum(ones), 1)
