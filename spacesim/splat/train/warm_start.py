"""Warm start by foreground attraction (thesis 5.3, 5.23 to 5.31, table 5.7): Gaussians that start anywhere are pulled
towards what the training pictures show, before refinement begins to prune.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.images import luminance
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.cameras import NEAR, Pinhole
from spacesim.splat.raster.gaussians import Gaussians, numbers, triple, uploaded
from spacesim.splat.train.densify import raise_opacities
from spacesim.splat.train.optimizer import Adam
from spacesim.splat.train.start import spacing
from spacesim.splat.train.strategies.strategy import MOST_SIZE, MOST_STEPS
from spacesim.splat.train.views import DEVICE_BYTES, TrainingViews, View


@dataclass(frozen=True)
class WarmStartConfig:
    """Steps count from the start of training."""

    steps: int = 2_000  #: table 5.7, T_ws: full strength, no refinement
    decay: int = 2_000  #: table 5.7, T_decay
    weight: float = 0.5  #: table 5.7, lambda_ws
    luminance: float = 0.03  #: table 5.7, tau_fg, of pictures without transparency
    dilation: int = 3  #: table 5.7, pixels, of masks by luminance; a mask by alpha is known exactly
    projection_weight: float = 0.4  #: table 5.7, lambda_proj
    downsampling: int = 4  #: table 5.7, of the distance image
    reach: float = 0.125  #: rho of 5.26
    travel: float = 1.0  #: of the radius of the start, how far a Gaussian can move during `steps` at least, chosen
    rescue: float = 0.5  #: table 5.7, alpha_rescue
    rescue_every: int = 100  #: steps, chosen; a Gaussian that no view of them had in its picture is unseen
    least_seen: int = 16  #: Gaussians that make a visible cloud, chosen as table 5.3's least supported cloud
    gather: bool = True  #: beyond the nearest camera is unseen, too, chosen
    spacing: float = 1.0  #: widest a Gaussian is after a rescue, in mean distances to its three nearest, chosen; 0: any
    revive: float = 0.1  #: opacity to which fainter ones are raised at each rescue, chosen: that of the start; 0: none
    conservative: int = 1_000  #: table 5.7, steps after `steps` with a lower opacity threshold
    opacity_scale: float = 0.5  #: table 5.7, of that threshold

    def __post_init__(self) -> None:
        counts = self.steps, self.decay, self.conservative, self.dilation
        if min(counts) < 0 or min(self.downsampling, self.rescue_every) < 1:
            raise InputError(f"--warm-start: expected numbers of steps and pixels, found {self}")
        if not (
            0 <= self.rescue <= 1
            and self.reach > 0
            and min(self.weight, self.projection_weight, self.travel, self.spacing) >= 0
        ):
            raise InputError(f"--warm-start: expected weights of 0 or more and a rescue of 0 to 1, found {self}")
        check_ranges(self, steps=(0, MOST_STEPS), decay=(0, MOST_STEPS), conservative=(0, MOST_STEPS))
        check_ranges(self, weight=(0, MOST_SIZE), projection_weight=(0, MOST_SIZE), reach=(0, MOST_SIZE))
        check_ranges(self, travel=(0, MOST_SIZE), spacing=(0, MOST_SIZE), dilation=(0, 1000), downsampling=(1, 1000))
        check_ranges(self, luminance=(0, 1), revive=(0, 1), opacity_scale=(0, 1), rescue_every=(1, MOST_STEPS))

    def remark(self, iterations: int) -> str:
        """A sentence where training is over before the attraction is; "" where it is not."""
        if iterations > self.steps + self.decay:
            return ""
        return (
            f"--warm-start: gathers Gaussians for {self.steps} iterations and fades over {self.decay} more, expected a "
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
        while refinement waits; falls back to the usual one as the attraction does, by powers."""
        fast = max(self.travel * radius / max(self.steps, 1), usual)
        share = self.strength(step) / self.weight if self.weight > 0 else 0.0
        return float(usual * (fast / usual) ** share)

    def leniency(self, step: int) -> float:
        """Factor of the opacity threshold after `step` finished steps: conservative culling."""
        return self.opacity_scale if step < self.steps + self.conservative else 1.0


def foreground(view: View, config: WarmStartConfig) -> np.ndarray:
    """[H, W] bool: where the picture shows the object. By alpha; of a picture without transparency by luminance,
    dilated (5.23, 5.24). Pixels that are to be ignored show nothing."""
    bytes_ = view.rgba.view(np.uint8).reshape(view.camera.height, view.camera.width, 4)
    if view.opaque:
        mask = luminance(bytes_[..., :3] / np.float32(255)) > config.luminance
        if config.dilation and mask.any():
            mask = binary_dilation(mask, disc(config.dilation))
    else:
        mask = bytes_[..., 3] >= 128
    return mask if view.valid is None else mask & view.valid.reshape(mask.shape)


def disc(radius: int) -> np.ndarray:
    """[2 r + 1, 2 r + 1] bool."""
    across = np.arange(-radius, radius + 1)
    return across[:, None] ** 2 + across**2 <= radius**2


def distance_image(mask: np.ndarray, config: WarmStartConfig) -> np.ndarray:
    """[h, w] float32, a pixel for each `downsampling`^2 of the mask: distance to the nearest of them that shows
    foreground, as a share of `reach` times the picture's smaller side (5.26). 0 where there is no foreground."""
    step = config.downsampling
    height, width = (-(-side // step) * step for side in mask.shape)
    padded = np.zeros((height, width), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    coarse = padded.reshape(height // step, step, width // step, step).any(axis=(1, 3))
    if not coarse.any():
        return np.zeros(coarse.shape, np.float32)
    pixels = step * distance_transform_edt(~coarse)
    return np.asarray(pixels / (config.reach * min(mask.shape)), np.float32)


@dataclass
class Attraction:
    """Of one view. mask: Bool [H * W];  image: Float [h * w], the distance image;  size: its (width, height)"""

    mask: Any
    image: Any
    size: tuple[int, int]


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
        """Whether refinement waits, and the unseen are rescued, at step number `step`, the first of which is 0."""
        return step < self.config.steps

    def attraction(self, view: View) -> Attraction:
        """What pulls in a view; nothing does where it shows no foreground."""
        found: Attraction = self._cached(view.index)
        return found

    def pull(self, rows: list[Any], camera: Pinhole, found: Attraction, step: int) -> list[Any]:
        """Gradients of the projected foreground loss by the means, as it counts at `step`: 3 Floats [N]. Counts who is
        in the picture while refinement waits. rows: of the Gaussians, the first 3 count"""
        numbers = ad.Float([self.config.strength(step) * self.config.projection_weight])
        gradients, framed = _pull(rows[:3], camera, found.image, found.size, self.config.downsampling, numbers)
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
        means = numbers(gaussians.means).astype(np.float64)
        means[:, ~np.isfinite(means).all(axis=0)] = self.centre[:, None]
        unseen = np.array(self.state["framed"]) == 0
        if config.gather:
            unseen |= np.linalg.norm(means - self.centre[:, None], axis=0) > self.nearest
        self.state["framed"] = dr.zeros(ad.Float, gaussians.count)
        if unseen.any():
            enough = (~unseen).sum() >= config.least_seen
            target = means[:, ~unseen].mean(axis=1) if enough else self.centre
            means[:, unseen] += config.rescue * (target[:, None] - means[:, unseen])
            gaussians.means = triple(means)
        if config.spacing > 0:
            widest = np.log(config.spacing * spacing(means.T))
            gaussians.log_scales = triple(np.minimum(numbers(gaussians.log_scales), widest))
        if config.revive > 0:
            raise_opacities(gaussians, optimizer, config.revive)

    def _attraction(self, index: int) -> Attraction:
        mask = foreground(self.views[index], self.config)
        image = distance_image(mask, self.config)
        return Attraction(uploaded(mask.ravel(), ad.Bool), uploaded(image.ravel()), (image.shape[1], image.shape[0]))


def projected_loss(means: Any, camera: Pinhole, image: Any, size: tuple[int, int], step: int) -> tuple[Any, Any]:
    """(loss of width 1, Bool [N]: centre in the picture) of 5.27: the mean of the distance image, bilinearly sampled
    where each centre falls, over those that are in front of the camera and in the picture. Differentiable by `means`
    (Array3f [3, N]). The square root of the square is the value itself: distances are not negative.

    image: Float [h * w] of size (w, h);  step: pixels of the picture for one of its pixels
    """
    center = camera.transform(means)
    ahead = dr.detach(camera.in_reach(center)) & (dr.detach(center.z) > NEAR)
    screen = camera.screen(dr.select(ahead, center, ad.Array3f(0, 0, 1)))
    x, y = screen.x, screen.y
    framed = ahead & dr.detach((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    value = dr.select(framed, bilinear(image, size, x / step - 0.5, y / step - 0.5), 0)
    count = dr.maximum(dr.sum(dr.select(framed, ad.Float(1), 0)), 1)
    return dr.sum(value) / count, framed


def bilinear(image: Any, size: tuple[int, int], u: Any, v: Any) -> Any:
    """[N] of an image Float [h * w] at columns u and rows v, whose whole numbers are the centres of its pixels; linear
    beyond the outermost. Differentiable by u and v."""
    width, height = size
    left = dr.clip(dr.floor(dr.detach(u)), 0, max(width - 2, 0))
    top = dr.clip(dr.floor(dr.detach(v)), 0, max(height - 2, 0))
    fx, fy = u - left, v - top
    i, j = ad.UInt32(left), ad.UInt32(top)
    i1, j1 = dr.minimum(i + 1, width - 1), dr.minimum(j + 1, height - 1)
    corners = [dr.gather(ad.Float, image, row * width + column) for row in (j, j1) for column in (i, i1)]
    upper, lower = dr.lerp(corners[0], corners[1], fx), dr.lerp(corners[2], corners[3], fx)
    return dr.lerp(upper, lower, fy)


def _trace_pull(
    rows: list[Any], camera: Pinhole, image: Any, size: tuple[int, int], step: int, numbers: Any
) -> tuple[list[Any], Any]:
    """(gradients by the 3 rows, Float [N]: 1 where the centre is in the picture). numbers: Float [1], the weight"""
    rows = [ad.Float(row) for row in rows]
    dr.enable_grad(rows)
    loss, framed = projected_loss(ad.Array3f(rows), camera, image, size, step)
    dr.backward(loss * dr.gather(ad.Float, numbers, ad.UInt32(0)))
    return [dr.grad(row) for row in rows], dr.select(framed, ad.Float(1), 0)


def foreground_loss(transmittance: Any, mask: Any) -> Any:
    """5.25: mean of (1 - A)^2 over the foreground. transmittance: Float [H * W], 1 - A;  mask: Bool [H * W]"""
    count = dr.sum(dr.select(mask, ad.Float(1), 0))
    return dr.sum(dr.select(mask, dr.square(transmittance), 0)) / dr.maximum(count, 1)


_pull = recorded(_trace_pull, RECORDINGS)
