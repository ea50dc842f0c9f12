"""Trained runs as members of a scene: their Gaussians in one set, and what each adds to the colours.

Everything here stays as it is while poses, Sun and camera change: arrays of one size each, so that nothing compiles
anew and nothing is loaded again.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.backend.upload import upload, upload_numbers
from spacesim.data.earth import Earth
from spacesim.data.geometry import Array, robust_radius
from spacesim.data.images.tone import Curve
from spacesim.splat.compose.pose import Pose
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import ALPHA_MIN
from spacesim.splat.raster.render import view_colors
from spacesim.splat.raster.tone import tone_map
from spacesim.splat.run import Run

PLAIN_SHADOWS = ShadowConfig(refine=None)
"""Of a run that was trained without any: a depth test."""
MODEL_DISTANCE = 5.0  #: farthest training camera of such a run, in its radii: only softness depends on it


@dataclass(frozen=True, eq=False)
class Member:
    """A run as it takes part in scenes; its frame is the model's."""

    run: Run  #: the trained model
    rows: list[Float]  #: 11 Floats [N], `Gaussians.shape_rows`
    centre: Array  #: [3] metres
    radius: float  #: metres, of a sphere about the centre that holds every Gaussian to three standard deviations
    shadow: ShadowConfig  #: its own kind of shadows
    distance: float  #: metres, of the farthest training camera, as `TrainingFrame.distance`
    extent: float  #: metres, of the Gaussians, as `TrainingFrame.radius`
    key: str  #: equal for equal contents

    @staticmethod
    def of(run: Run) -> "Member":
        """What scenes know of a run."""
        arrays = run.gaussians.to_numpy()
        means, spread = arrays["means"].astype(np.float64), 3 * np.exp(arrays["log_scales"].astype(np.float64).max(1))
        shown = arrays["logit_opacities"] >= np.log(ALPHA_MIN / (1 - ALPHA_MIN))
        means, spread = (means[shown], spread[shown]) if shown.any() else (np.zeros((1, 3)), np.zeros(1))
        centre = 0.5 * (means.min(axis=0) + means.max(axis=0))
        away = np.linalg.norm(means - centre, axis=1)
        light = run.light
        shadow = light.config.shadow if light and light.config.shadow else PLAIN_SHADOWS
        extent = light.frame.radius if light else robust_radius(means)
        distance = light.frame.distance if light else MODEL_DISTANCE * extent
        rows = [ad.Float(row) for row in run.gaussians.shape_rows()]
        return Member(run, rows, centre, float((away + spread).max()), shadow, distance, extent, _digest(run))

    @property
    def count(self) -> int:
        """N."""
        return self.run.gaussian_count

    @property
    def cross_shadow_config(self) -> ShadowConfig:
        """How shadows of other models fall on it: as its own, but where the Sun's picture shows the others alone, a
        depth test must know how much of a pixel they cover, as a faint rim is no wall and a veil lets light through.
        Neither bias nor offset points are needed, as no surface is tested against itself."""
        method = self.shadow.method
        if isinstance(method, MappingConfig) and method.filter in ("bilinear", "median"):
            method = replace(method, filter="percentage-closer", radius=0.5)
        return replace(self.shadow, bias=0.0, grazing="none", method=method)

    @property
    def curve(self) -> Curve | None:
        """Of its linear colours, see `LightConfig.curve`; None where colours are sRGB values."""
        return self.run.light.config.curve if self.run.light else None

    @property
    def bounces(self) -> bool:
        """Whether light bounces within it."""
        return self.run.light is not None and self.run.light.config.bounce > 0

    def visibility(self, sun: Array | None) -> Float | None:
        """Of the Sun in its own shadows, [N]; None for a run without any. sun: [3] in the model's frame"""
        light = self.run.light
        return None if light is None else light.visibility(self.run.gaussians, sun)

    def sunlight(self, sun: Array | None) -> Sunlight | None:
        """In its own shadows; None for a run without light. sun: [3] in the model's frame"""
        light = self.run.light
        return None if light is None else light.sunlight(self.run.gaussians, sun)

    def arriving(self, sun: Array | None, visibility: Float) -> Sunlight | None:
        """Of which so much arrives, [N]; None for a run without light. sun: [3] in the model's frame"""
        light = self.run.light
        return None if light is None else light.arriving(self.run.gaussians, sun, visibility)

    def shade(
        self, camera: Pinhole, sun: Array | None, sunlight: Sunlight | None, earth: Earth | None = None
    ) -> tuple[list[Float], Float | None]:
        """(colours, three Floats [N], visibility of the Sun [N] or None) as the run alone has them. camera, sun, earth:
        in the model's frame, the latter two unused by a run that knows one light;  sunlight: of this Sun"""
        run = self.run
        if run.light is None:
            return list(_harmonic_colors(run.gaussians.rows(), camera)), None
        return run.light.shade_picture(run.gaussians, camera, sun, sunlight=sunlight, earth=earth)


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Members one after another as one set of N Gaussians."""

    #: in an order that does not depend on how they were named, so that composing [A, B] and [B, A] is one and the same
    members: Sequence[Member]
    starts: Sequence[int] = field(init=False)  #: of each member, the index of its first Gaussian

    def __post_init__(self) -> None:
        counts = [member.count for member in self.members]
        object.__setattr__(self, "starts", [sum(counts[:k]) for k in range(len(counts))])

    @property
    def count(self) -> int:
        """N."""
        return sum(member.count for member in self.members)

    @cached_property
    def rows(self) -> list[Float]:
        """11 Floats [N], each member's in its own frame."""
        if len(self.members) == 1:
            return self.members[0].rows
        rows = [dr.concat([member.rows[i] for member in self.members]) for i in range(11)]
        dr.eval(rows)
        return rows

    @cached_property
    def owner(self) -> UInt32:
        """UInt32 [N]: whose each Gaussian is."""
        numbers = [np.full(member.count, k, np.uint32) for k, member in enumerate(self.members)]
        return upload(np.concatenate(numbers), ad.UInt32)

    @cached_property
    def indices(self) -> list[UInt32]:
        """UInt32 of each member: where its Gaussians stand in the set."""
        pairs = zip(self.starts, self.members, strict=True)
        return [upload(np.arange(start, start + member.count), ad.UInt32) for start, member in pairs]

    @cached_property
    def shares(self) -> list[Float]:
        """Float [N] of each member: 1 for its Gaussians, else 0."""
        if len(self.members) == 1:
            return [dr.opaque(ad.Float, 1, self.count)]
        return [self._share(k) for k in range(len(self.members))]

    def _share(self, k: int) -> Float:
        share = dr.select(self.owner == dr.opaque(ad.UInt32, k), ad.Float(1), 0)
        dr.eval(share)
        return share

    @cached_property
    def own(self) -> list[Bool]:
        """Bool [N] of each member: is a Gaussian its?"""
        return self._masks([share > 0.5 for share in self.shares])

    @cached_property
    def others(self) -> list[Bool]:
        """Bool [N] of each member: is a Gaussian another's?"""
        return self._masks([share < 0.5 for share in self.shares])

    @cached_property
    def antialiased(self) -> Bool | bool:
        """Whether Gaussians are drawn with the anti-aliasing filter: one for all, or Bool [N] where runs differ."""
        flags = [member.run.antialiased for member in self.members]
        if len(set(flags)) < 2:
            return any(flags)
        of_each = [np.full(m.count, f) for m, f in zip(self.members, flags, strict=True)]
        return upload(np.concatenate(of_each), ad.Bool)

    @cached_property
    def curve(self) -> Curve | None:
        """Of the whole, which is blended in linear light where all members have one curve and exposure."""
        curves = {member.curve for member in self.members}
        return curves.pop() if len(curves) == 1 else None

    def placed(self, poses: Sequence[Pose]) -> Gaussians:
        """The set with a pose of each member, colours left out (3.11 to 3.13)."""
        if not self.members:
            none = [ad.Float([]) for _ in range(11)]
            return Gaussians.from_rows(none)
        numbers = [[*p.rotation.ravel(), *p.translation, p.scale, np.log(p.scale), *p.quaternion] for p in poses]
        table = upload_numbers([float(number) for row in numbers for number in row])
        return Gaussians.from_rows([*_placed(self.rows[:10], self.owner, table), self.rows[10]])

    def joined(self, parts: Sequence[Sequence[Float]]) -> list[Float]:
        """Floats [N] of each member's, row by row. parts: of each member the same number of Floats."""
        return list(parts[0]) if len(parts) == 1 else [dr.concat(list(row)) for row in zip(*parts, strict=True)]

    @staticmethod
    def _masks(masks: list[Bool]) -> list[Bool]:
        dr.eval(masks)
        return masks


def display_colors(colors: list[Float], model_curve: Curve | None, scene_curve: Curve | None) -> list[Float]:
    """Colours as they are blended: linear ones become sRGB values first where not all are alike. model_curve,
    scene_curve: `curve` of the member and of the ensemble"""
    if model_curve is None or scene_curve is not None:
        return colors
    return [tone_map(color, model_curve.tone, model_curve.white) for color in colors]


@recorded
def _placed(rows: list[Float], owner: UInt32, table: Float) -> list[Float]:
    """The first 10 of `Gaussians.shape_rows`, each by its owner's numbers: R (9), t (3), s, ln s, quaternion (4)."""
    of = [dr.gather(ad.Float, table, owner * _NUMBERS + i) for i in range(_NUMBERS)]
    x, y, z = rows[:3]
    means = [of[12] * (of[3 * i] * x + of[3 * i + 1] * y + of[3 * i + 2] * z) + of[9 + i] for i in range(3)]  # 3.11
    w, i, j, k = of[14:18]
    a, b, c, d = rows[6:10]
    quaternion = [  # 3.12
        w * a - i * b - j * c - k * d,
        w * b + i * a + j * d - k * c,
        w * c - i * d + j * a + k * b,
        w * d + i * c - j * b + k * a,
    ]
    return [*means, *(log_scale + of[13] for log_scale in rows[3:6]), *quaternion]  # 3.13


@recorded
def _harmonic_colors(rows: list[Float], camera: Pinhole) -> Array3f:
    return view_colors(Gaussians.from_rows(rows), camera)


def _digest(run: Run) -> str:
    """Of everything that a picture of the run depends on."""
    drawn = run.antialiased, run.supersample, run.light.config if run.light else None
    digest = hashlib.sha256(repr(drawn).encode())
    tensors = run.gaussians.to_numpy() | (run.light.tensors() if run.light else {})
    for name in sorted(tensors):
        digest.update(f"{name}{tensors[name].shape}".encode())
        digest.update(np.ascontiguousarray(tensors[name]).tobytes())
    return digest.hexdigest()


_NUMBERS = 18  # of a pose's row in the table
