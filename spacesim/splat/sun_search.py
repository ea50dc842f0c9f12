"""The Sun of a picture that does not name it: by the shape of Gaussians at first, then by a model of light.

Both compare small pictures with what is expected under the Suns of a lattice over the sphere, shadows included. Where
poses and shape are known, shading fixes the direction in the model's axes: no rotation and no mirror image is left, but
what is turned away from the Sun says little, and one flat surface alone only how obliquely it is lit.

Shape alone, by alternation (`ShapeSearch`): surfaces are Lambertian, their albedo at first the mean colour of all
pictures times the number that suits them best, then what the Suns found so far leave. All pictures share one exposure,
as brightness determines the angle: too large an albedo would put all Suns too low.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array, degrees_between, fibonacci_sphere
from spacesim.data.images import linear_from_srgb, luminance
from spacesim.data.images.tone import Curve
from spacesim.data.records import Camera, Image
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.shadow.cast import ShadowConfig, cast_shadows
from spacesim.splat.light.shadow.light_camera import light_rows
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.render import render
from spacesim.splat.raster.tone import tone_map

SPHERE = 300  #: Suns of the lattice: 12 degrees apart
SIDE = 128  #: pixels of the longer side of a small picture, which shows the object alone
SHAPE_SIDE = 64  #: the same for `ShapeSearch`, which blends all Suns of the lattice at once
ERROR = 0.05  #: sRGB values, or roots of linear ones: an error so large counts half (Cauchy's loss)
DRAWN = 16  #: Suns whose pictures are drawn at once: Gaussians are projected and sorted once for all of them
GRANULES = 4  #: steps to the longer side, of which the sides of small pictures are multiples
BLOCKS = 512  #: parts of a small picture of SIDE x SIDE pixels whose errors count as one each
#: blocks whose errors are one, as a model is wrong in one way over several: with it the root mean square of errors over
#: `sigma_deg` was 0.96 for 30 unseen pictures of a model trained for 2,000 steps, 1.26 for 8 of one trained for 800
ALIKE = 2.5
LEAST = 30  #: pixels of a half of a picture that tells of a Sun
COVERED = 0.5  #: least alpha of a pixel that counts
AMBIENT = 0.02  #: light that comes from everywhere, as a share of the Sun's
#: of a surface's n . s times visibility over the Suns of pictures, one of these: a quarter under Suns all round without
#: shadows, more where no picture is taken against the Sun
MEAN_COSINES = 0.14, 0.2, 0.28, 0.4, 0.56
ALTERNATIONS = 2  #: of Suns and albedo
KEPT_BYTES = 2**30  #: that light of the lattice's Suns may take to be kept from one picture to the next
#: which Suns of the lattice are looked at first, all over the sphere: every second. Of 180 pictures and halves of them
#: 179 had the best of all 300 Suns so, of 160, and one another that is as good
FIRST = 2
BEST, NEAR = 4, 15.0  #: around how many of the best of these others are looked at, up to so many degrees off
RINGS = 8.0, 3.0  #: degrees about the best Sun, at which a paraboloid is fitted
RING = 6  #: Suns of a ring


@dataclass(frozen=True, eq=False)
class SunEstimate:
    """A Sun's direction by a picture."""

    direction: Array  #: [3] unit, world axes, towards the Sun
    #: degrees: root mean square angle to the other Suns that would do, by how well they do. It suits models trained to
    #: the end; errors of those trained less, or of pictures by other cameras, may be larger
    sigma_deg: float
    loss: float  #: of Cauchy, summed over blocks of pixels, lower is better


@dataclass(frozen=True, eq=False)
class SmallPicture:
    """A picture of few pixels, and which of them count. It has one of few sizes, as what is drawn is recorded anew for
    each: none of the pixels beyond its right and lower edge count."""

    camera: Camera  #: of as many pixels
    rgb: Array  #: [H, W, 3] sRGB values over black
    counts: np.ndarray  #: [H, W] bool, on the object, as far as known

    @staticmethod
    def of(camera: Camera, image: Image, least: float = 0.999, side: int = SIDE) -> "SmallPicture":
        """The object's part of a picture, in means over squares of pixels, of those that are valid. least: share of
        them in a square that counts;  side: pixels of the longer side, at most"""
        rows, columns = cropped(image)
        factor = max(1, -(-max(rows.stop - rows.start, columns.stop - columns.start) // side))
        numbers = camera.fx, camera.fy, camera.cx - columns.start, camera.cy - rows.start
        image = Image(image.rgb[rows, columns], image.alpha[rows, columns], image.valid[rows, columns])
        valid = image.valid.astype(np.float32)
        share = block_means(valid, factor)
        weights = (image.alpha * valid)[..., None]
        rgb = block_means(image.rgb * weights, factor) / np.maximum(share, 1e-6)[..., None]
        counts = (block_means(weights[..., 0], factor) / np.maximum(share, 1e-6) >= COVERED) & (share >= least)
        height, width = (-(-pixels // (side // GRANULES)) * (side // GRANULES) for pixels in counts.shape)
        padding = (0, height - counts.shape[0]), (0, width - counts.shape[1])
        small = Camera(camera.world_from_camera, width, height, *(number / factor for number in numbers))
        return SmallPicture(small, np.pad(rgb, (*padding, (0, 0))), np.pad(counts, padding))


def cropped(image: Image) -> tuple[slice, slice]:
    """Rows and columns that hold what of a picture is valid and not empty; all where there is none."""
    shown = (image.alpha >= COVERED) & image.valid
    if not shown.any():
        return slice(0, shown.shape[0]), slice(0, shown.shape[1])
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def block_means(values: np.ndarray, factor: int) -> np.ndarray:
    """[H // f, W // f, ...] means over squares of f pixels a side."""
    height, width = max(values.shape[0] // factor, 1), max(values.shape[1] // factor, 1)
    cut = values[: height * factor, : width * factor]
    if cut.shape[0] < factor or cut.shape[1] < factor:
        return cut.mean(axis=(0, 1), keepdims=True)
    means: np.ndarray = cut.reshape(height, factor, width, factor, *values.shape[2:]).mean(axis=(1, 3))
    return means


class SunFinder:
    """Finds Suns of pictures by a model that takes the Sun as input.

    gaussians, light: the model
    antialiased: whether it is drawn so
    curve: as `Run.curve`
    """

    def __init__(self, gaussians: Gaussians, light: LightModel, antialiased: bool, curve: Curve | None) -> None:
        self.gaussians, self.light, self.antialiased, self.curve = gaussians, light, antialiased, curve
        self.sphere = fibonacci_sphere(SPHERE)
        self._sunlight: dict[int, Sunlight] = {}

    def estimate(
        self,
        picture: SmallPicture,
        among: Sequence[int] | None = None,
        cost: Callable[[Array], float] = lambda direction: 0.0,
    ) -> SunEstimate:
        """The Sun under which the model looks most like a picture.

        among: numbers of the lattice that are looked at, by default some all over the sphere, then all near the best of
        these;  cost: what a direction [3] costs besides
        """
        numbers = list(range(0, SPHERE, FIRST)) if among is None else sorted({int(number) for number in among})
        directions = list(self.sphere[numbers])
        seen = _SeenPicture(picture)

        def losses_of(directions: Sequence[Array], numbers: Sequence[int | None]) -> list[float]:
            losses = self._losses(seen, directions, numbers)
            return [loss + cost(direction) for loss, direction in zip(losses, directions, strict=True)]

        losses = losses_of(directions, numbers)
        if among is None:
            best_ones = np.array(directions)[np.argsort(losses, kind="stable")[:BEST]]
            is_near = (degrees_between(self.sphere @ best_ones.T) < NEAR).any(axis=1)
            others = [int(number) for number in np.setdiff1d(np.flatnonzero(is_near), numbers)]
            closer = list(self.sphere[others])
            directions, losses = directions + closer, losses + losses_of(closer, others)
        for degrees in RINGS:
            best = directions[int(np.argmin(losses))]
            around = ring(best, degrees)
            of_ring = losses_of(around, [None] * RING)
            directions, losses = [*directions, *around], [*losses, *of_ring]
            lowest = paraboloid_minimum(best, around, min(losses), of_ring, degrees)
            directions.append(lowest)
            losses += losses_of([lowest], [None])
        best = int(np.argmin(losses))
        return SunEstimate(directions[best], spread(np.array(directions), np.array(losses)), float(losses[best]))

    def apart(self, picture: SmallPicture) -> float:
        """Degrees between the Suns of a picture's two halves, left and right of the median column of what counts, each
        looked for all over the sphere; 90 on average where they have nothing to do with each other. NaN where a half
        shows less than `LEAST` pixels, or the object is not cut out, so that halves agree on what is behind it.
        """
        counts = picture.counts
        middle = np.median(np.nonzero(counts)[1]) if counts.any() else 0
        is_left = np.arange(counts.shape[1]) < middle
        halves = [counts & side for side in (is_left, ~is_left)]
        is_cut_out = not counts[np.ix_(counts.any(axis=1), counts.any(axis=0))].all()
        if min(half.sum() for half in halves) < LEAST or not is_cut_out:
            return float("nan")
        left, right = (self.estimate(replace(picture, counts=half)).direction for half in halves)
        return float(degrees_between(left @ right))

    def near(self, direction: Array, besides: Sequence[int], count: int) -> list[int]:
        """Numbers of so many of the lattice's Suns: `besides`, and of the others those nearest to a direction."""
        others = np.setdiff1d(np.arange(SPHERE), besides)
        nearest = others[np.argsort(-(self.sphere[others] @ direction), kind="stable")]
        return [*(int(k) for k in besides), *(int(k) for k in nearest[: count - len(besides)])]

    def _losses(self, seen: "_SeenPicture", directions: Sequence[Array], numbers: Sequence[int | None]) -> Array:
        """[K] of the model under K Suns. numbers: theirs in the lattice, whose light is kept for other pictures"""
        losses, curve = [], (self.curve.tone, self.curve.white) if self.curve else None
        for start in range(0, len(directions), DRAWN):
            suns = zip(directions[start : start + DRAWN], numbers[start : start + DRAWN], strict=True)
            colors = [color for sun in suns for color in self._colors(seen.camera, *sun)]
            drawn = render(self.gaussians, seen.camera, outputs=(), features=colors, antialiased=self.antialiased)
            errors = _errors(drawn.features or [], seen.rgb, seen.counts, curve)
            losses.append(dr.block_sum(dr.ravel(ad.ArrayXf(errors), order="C"), drawn.width * drawn.height))
        return np.concatenate([np.empty(0), *(np.array(some, np.float64) for some in losses)]) * BLOCKS / SIDE**2

    def _colors(self, camera: Pinhole, direction: Array, number: int | None) -> list[Float]:
        light = None if number is None else self._sunlight.get(number)
        if light is None:
            light = self.light.sunlight(self.gaussians, direction)
            if number is not None and (len(self._sunlight) + 1) * light.bytes <= KEPT_BYTES:
                self._sunlight[number] = light
        return self.light.shade_picture(self.gaussians, camera, direction, sunlight=light)[0]


class _SeenPicture:
    """A small picture where it is compared with others."""

    def __init__(self, picture: SmallPicture) -> None:
        self.camera = Pinhole.of(picture.camera)
        self.rgb = [upload(np.ascontiguousarray(picture.rgb[..., c].ravel())) for c in range(3)]
        self.counts = upload(picture.counts.ravel().astype(np.float32))  #: 1 or 0


@recorded
def _errors(planes: list[Float], rgb: list[Float], counts: Float, curve: tuple[str, float] | None) -> list[Float]:
    """[K] planes: of each of K pictures, three planes each, Cauchy's loss of its pixels, a third for each channel.
    curve: tone and white of linear pictures, None: values are sRGB"""
    errors = []
    for k in range(0, len(planes), 3):
        drawn = planes[k : k + 3]
        if curve:
            drawn = [tone_map(plane, *curve) for plane in drawn]
        terms = [dr.log(1 + dr.square((d - t) / ERROR)) for d, t in zip(drawn, rgb, strict=True)]
        errors.append(counts / 3 * (terms[0] + terms[1] + terms[2]))
    return errors


def ring(direction: Array, degrees: float) -> list[Array]:
    """Directions so far from one, all round."""
    right, up = tangents(direction)
    turns, slope = 2 * np.pi * np.arange(RING) / RING, np.tan(np.radians(degrees))
    return [_unit(direction + slope * (np.cos(turn) * right + np.sin(turn) * up)) for turn in turns]


def tangents(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors [3] that stand upright on a direction and on each other."""
    axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    right = _unit(np.cross(axis, direction))
    return right, np.cross(direction, right)


def paraboloid_minimum(best: Array, around: list[Array], loss: float, losses: list[float], degrees: float) -> Array:
    """Where a paraboloid through `best` and the ring about it is lowest, within the ring."""
    right, up = tangents(best)
    slope = np.tan(np.radians(degrees))
    x, y = (np.array([(one / (one @ best)) @ axis / slope for one in (best, *around)]) for axis in (right, up))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    _, bx, by, cxx, cxy, cyy = np.linalg.lstsq(terms, np.array([loss, *losses]), rcond=None)[0]
    curvature = np.array([[2 * cxx, cxy], [cxy, 2 * cyy]])
    if np.linalg.eigvalsh(curvature)[0] <= 1e-9:
        return best
    step = -np.linalg.solve(curvature, [bx, by])
    step *= min(1.0, 1.0 / max(float(np.linalg.norm(step)), 1e-9))
    return _unit(best + slope * (step[0] * right + step[1] * up))


def constant_colors(gaussians: Gaussians) -> Array:
    """[N, 3] sRGB values, mean over all directions."""
    colors: Array = 0.5 + SH_C0 * gaussians.to_numpy()["sh"].reshape(gaussians.count, -1, 3)[:, 0]
    return colors


def lowest_between(places: Array, losses: Array) -> float:
    """Where a parabola through the lowest of `losses` and its neighbours is lowest; the end where that is one."""
    best = int(np.argmin(losses))
    if best in (0, len(losses) - 1):
        return float(places[best])
    a, b, _ = np.polyfit(places[best - 1 : best + 2] - places[best], losses[best - 1 : best + 2], 2)
    return float(places[best] - b / (2 * a)) if a > 0 else float(places[best])


def spread(directions: Array, losses: Array) -> float:
    """Degrees: root mean square angle to the best of directions [K, 3], weighted by exp(-loss / `ALIKE`)."""
    likely = np.exp(-(losses - losses.min()) / ALIKE)
    angles = degrees_between(directions @ directions[int(np.argmin(losses))])
    return float(np.sqrt((likely * angles**2).sum() / likely.sum()))


@dataclass(frozen=True, eq=False)
class _LitSurface:
    """What a small picture shows of a Lambertian surface, P pixels."""

    counts: np.ndarray  #: [H, W] bool, which pixels
    seen: np.ndarray  #: [P] luminance in the picture, linear
    reflected: Array  #: [P] luminance under the Sun overhead
    light: Array  #: [P, SPHERE] share of it under the lattice's Suns

    def losses(self, brighter: float = 1.0) -> Array:
        """[SPHERE], of a surface that reflects so many times as much."""
        errors = np.sqrt(brighter * self.reflected[:, None] * self.light) - np.sqrt(self.seen)[:, None]
        losses: Array = np.log1p((errors / ERROR) ** 2).sum(axis=0) * BLOCKS / SHAPE_SIDE**2
        return losses


class ShapeSearch:
    """Suns of many pictures by the Gaussians of a training without known Suns.

    gaussians: their colours are the mean of all pictures
    distance: metres, of the farthest camera
    """

    def __init__(self, gaussians: Gaussians, antialiased: bool, distance: float) -> None:
        self.gaussians, self.antialiased = gaussians, antialiased
        self.sphere = fibonacci_sphere(SPHERE)
        shadow = ShadowConfig(size=256, refine=None)
        self.visible = [upload(1 - np.array(self._occlusion(sun, shadow, distance))) for sun in self.sphere]
        self.albedo = np.maximum(luminance(linear_from_srgb(np.clip(constant_colors(gaussians), 0, 1))), 1e-3)

    def losses(
        self, pictures: Sequence[SmallPicture], progress: Callable[[int, int], None] = lambda done, total: None
    ) -> Array:
        """[V, SPHERE] of the pictures under the lattice's Suns, after `ALTERNATIONS`."""
        total, losses = (1 + ALTERNATIONS) * len(pictures), np.zeros((len(pictures), SPHERE))
        lowest = np.zeros(len(MEAN_COSINES))
        for i, picture in enumerate(pictures):
            surface = self._surface(picture, upload(self.albedo.astype(np.float32)))
            lowest += [surface.losses(1 / cosine).min() for cosine in MEAN_COSINES]
            progress(i + 1, total)
        self.albedo /= np.exp(lowest_between(np.log(MEAN_COSINES), lowest))
        for turn in range(1, 1 + ALTERNATIONS):
            albedo, sums = upload(self.albedo.astype(np.float32)), np.zeros((2, self.gaussians.count))
            for i, picture in enumerate(pictures):
                losses[i], target = self._compare(picture, albedo)
                sums += self._spread_back(picture, target)
                progress(turn * len(pictures) + i + 1, total)
            self.albedo *= np.clip((sums[0] + 1e-3) / (sums[1] + 1e-3), 0.3, 3)
        return losses

    def _occlusion(self, sun: Array, config: ShadowConfig, distance: float) -> Float:
        return cast_shadows(self.gaussians, light_rows(sun), config, distance).occlusion

    def _compare(self, picture: SmallPicture, albedo: Float) -> tuple[Array, list[np.ndarray]]:
        """(loss under each Sun of the lattice [SPHERE], planes [H, W] of light that is seen and that is expected)."""
        surface = self._surface(picture, albedo)
        losses = surface.losses()
        likely = np.exp(-(losses - losses.min()))
        expected = surface.light @ (likely / likely.sum())
        reflected, weights = surface.reflected, expected / (0.05 + expected)
        target = [np.zeros(surface.counts.shape, np.float32) for _ in range(2)]
        target[0][surface.counts] = np.minimum(surface.seen, 3 * reflected * expected + 0.01) * weights
        target[1][surface.counts] = reflected * expected * weights
        return losses, target

    def _surface(self, picture: SmallPicture, albedo: Float) -> "_LitSurface":
        drawn = render(
            self.gaussians,
            Pinhole.of(picture.camera),
            outputs=("alpha", "normal"),
            features=[*self.visible, albedo],
            antialiased=self.antialiased,
        )
        alpha, planes = drawn.image("alpha"), drawn.image("features")
        counts = picture.counts & (alpha >= COVERED)
        visible, reflected = (planes[counts] / alpha[counts][:, None])[:, :SPHERE], planes[counts][:, SPHERE]
        light = np.maximum(drawn.image("normal")[counts] @ self.sphere.T, 0) * visible + AMBIENT
        seen = luminance(linear_from_srgb(picture.rgb[counts]))
        return _LitSurface(counts, seen, reflected, light)

    def _spread_back(self, picture: SmallPicture, planes: list[np.ndarray]) -> Array:
        """[2, N] sums over pixels of what each Gaussian has of them, times the planes [H, W]."""
        shares = [upload(np.full(self.gaussians.count, 1e-9 * i, np.float32)) for i in range(len(planes))]
        dr.enable_grad(shares)
        camera = Pinhole.of(picture.camera)
        drawn = render(self.gaussians, camera, outputs=(), features=shares, antialiased=self.antialiased)
        total = ad.Float(0)
        for blended, plane in zip(drawn.features or (), planes, strict=True):
            total += dr.sum(blended * upload(np.ascontiguousarray(plane.ravel())))
        dr.backward(total)
        return np.array([np.array(dr.grad(share)) for share in shares])


def smoothest(losses: Array, sphere: Array, degrees: float) -> list[int]:
    """The Suns of pictures in time order: numbers of the lattice whose losses and turns cost least (Viterbi 1967).

    losses: [V, K];  sphere: [K, 3];  degrees: a turn from one picture to the next that costs half
    """
    turns = degrees_between(sphere @ sphere.T)
    cost = 0.5 * (turns / degrees) ** 2
    total, before = losses[0].copy(), np.zeros(losses.shape, int)
    for i in range(1, len(losses)):
        ways = total[:, None] + cost
        before[i] = ways.argmin(axis=0)
        total = ways.min(axis=0) + losses[i]
    path = [int(total.argmin())]
    for i in range(len(losses) - 1, 0, -1):
        path.append(int(before[i][path[-1]]))
    return path[::-1]


def _unit(vector: Array) -> Array:
    unit: Array = vector / np.linalg.norm(vector)
    return unit
