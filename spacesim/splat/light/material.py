"""The material in a model of light: what its field answers about a Gaussian's normal, as a metal or not.

A field of cosines (`SurfaceConfig`) says how bright a Gaussian is under any Sun from anywhere, fully lit, nothing
bounced. A metal or something else is fitted to that, as glTF 2.0 (appendix B) tells them apart: a metal is facets
alone; what is none is a Lambertian surface, bare or under facets that reflect little. Facets are GGX (Walter et al.
2007) with Smith's height-correlated masking (Heitz 2014) and Schlick's Fresnel term (1994). Nothing of it was trained
as such. Were facets of any strength allowed over a Lambertian surface, broad lobes would pass for each other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.backend.memory import check_memory
from spacesim.data.geometry import Array, look_at
from spacesim.data.images.tone import Tone, linear_from_display
from spacesim.splat.light.field import FieldConfig
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians

ROUGHNESSES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)  #: alphas of GGX that are tried; 1 stands for no lobe
HALFWAY_DEG, DIFFERENCE_DEG, AROUND_DEG = (0, 3, 7, 12, 20, 30, 42, 55), (5, 20, 40), (0, 90, 180)
"""Of Sun and view about the normal: angle of the halfway vector, half of the angle between them, and around it
(Rusinkiewicz 1998): most where a lobe is."""
LEAST_COSINE = 0.25  #: of the normal with Sun and view: what brushes the surface says little
SATURATED = 0.98  #: a colour from which the field says no more than that it is at least as bright
FAINT = 0.05  #: errors count by what is reflected plus this, of what a white surface does
MOST_COAT = 0.08  #: that facets of what is no metal reflect at normal incidence, as in Burley 2012
LEAST_METAL = 0.3  #: of a metal's brightest channel: none in assets/materials.toml reflects less
CHUNK = 1 << 14  #: Gaussians that are fitted at once


@dataclass(frozen=True, eq=False)
class FittedMaterial:
    """Of N Gaussians, float32; linear camera RGB."""

    #: [N, 3] reflectance: a metal's at normal incidence, in [0, 1], else of the Lambertian surface (under its facets),
    #: which is fitted without an upper bound
    albedo: np.ndarray
    metallic: np.ndarray  #: [N] 1 of metals, 0 of others
    roughness: np.ndarray  #: [N] alpha of GGX, 1 where no facets are seen
    specular: np.ndarray  #: [N, 3] what facets reflect at normal incidence: a metal's albedo; 0 where none are seen

    @staticmethod
    def joined(materials: "Sequence[FittedMaterial]") -> "FittedMaterial":
        """Of one set of Gaussians after another."""
        rows = ((each.albedo, each.metallic, each.roughness, each.specular) for each in materials)
        return FittedMaterial(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


@dataclass(frozen=True, eq=False)
class SunAndView:
    """Directions about a normal along z, K of each."""

    suns: Array  #: [K, 3] unit, towards the Sun
    views: Array  #: [K, 3] unit, towards the viewer

    @staticmethod
    def spread() -> "SunAndView":
        """Those at which fields are asked."""
        suns, views = [], []
        for halfway_deg in HALFWAY_DEG:
            tilt = np.radians(halfway_deg)
            halfway = np.array([np.sin(tilt), 0, np.cos(tilt)])
            across = np.array([np.cos(tilt), 0, -np.sin(tilt)])
            for difference_deg in DIFFERENCE_DEG:
                for around_deg in AROUND_DEG if halfway_deg else AROUND_DEG[:1]:
                    difference, around = np.radians(difference_deg), np.radians(around_deg)
                    aside = np.cos(around) * across + np.array([0, np.sin(around), 0])
                    suns.append(np.cos(difference) * halfway + np.sin(difference) * aside)
                    views.append(np.cos(difference) * halfway - np.sin(difference) * aside)
        seen = np.minimum(np.array(suns)[:, 2], np.array(views)[:, 2]) >= LEAST_COSINE
        return SunAndView(np.array(suns)[seen], np.array(views)[seen])

    def facets(self, roughness: float) -> tuple[Array, Array]:
        """([K] what facets reflect of a specular reflectance of 1 more, [K] what they do at none: Schlick's rest), both
        as shares of a white Lambertian surface that faces the Sun, n . s included. roughness: alpha"""
        halfway = self.suns + self.views
        halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
        sun, view, square = self.suns[:, 2], self.views[:, 2], roughness**2
        facing = square / (np.pi * (halfway[:, 2] ** 2 * (square - 1) + 1) ** 2)
        masked = sun * np.sqrt(square + (1 - square) * view**2) + view * np.sqrt(square + (1 - square) * sun**2)
        lobe = np.pi * facing * 0.5 / masked * sun
        grazing = (1 - np.einsum("kc,kc->k", self.views, halfway)) ** 5
        return lobe * (1 - grazing), lobe * grazing


def has_material(field: FieldConfig) -> bool:
    """Whether a field takes normals and, of Sun and view, nothing but the cosines about them."""
    return field.surface and field.sun.size == 1 and field.view.size == 1


def read_material(
    gaussians: Gaussians, light: LightModel, white: Array, tone: Tone, embedding: np.ndarray | None = None
) -> FittedMaterial:
    """What the field of a model says of each Gaussian's surface; `has_material` of it.

    white: [3] linear display value of a white Lambertian surface that faces the Sun;  tone: the curve of colours that
    are sRGB values;  embedding: as `LightModel.shade_picture` takes it. Raises MemoryError where the answers do not fit
    into memory.
    """
    angles, field = SunAndView.spread(), light.config.field
    check_memory(16 * len(angles.suns) * gaussians.count, "colours of all Gaussians about their normals")
    arrays = gaussians.to_numpy()
    features = arrays["features"].copy()
    features[:, field.features : field.features + 3] = (0, 0, 1)
    upright = Gaussians.from_numpy(arrays | {"features": features})
    colors = np.empty((len(angles.suns), 3, gaussians.count), np.float32)
    for answer, sun, view in zip(colors, angles.suns, angles.views, strict=True):
        camera = Orthographic.of(OrthographicCamera.from_extent(look_at(view, np.zeros(3), (0, 1, 0)), 1, 1, 1.0))
        shown, _ = light.shade_picture(upright, camera, sun, Sunlight(None, []), embedding)
        answer[:] = [np.array(color) for color in shown]
    parts = [slice(first, first + CHUNK) for first in range(0, gaussians.count, CHUNK)]
    curve, per_white = light.config.curve, 1 / np.asarray(white)[:, None]
    fitted = []
    for part in parts:
        asked = colors[..., part].astype(np.float64)
        linear = asked * curve.white if curve else linear_from_display(asked, tone)
        fitted.append(fit_material(angles, linear * per_white, asked < SATURATED))
    return FittedMaterial.joined(fitted)


def fit_material(angles: SunAndView, reflected: Array, known: np.ndarray) -> FittedMaterial:
    """By least squares of what is `known`, [K, 3, N] bool, of light `reflected` [K, 3, N], of which a white Lambertian
    surface that faces the Sun reflects 1: the best reflectances of each kind of surface in closed form, then the best
    kind."""
    count = reflected.shape[2]
    light = np.moveaxis(reflected, 0, 2).reshape(3 * count, -1)
    weights = np.moveaxis(known, 0, 2).reshape(3 * count, -1) / (np.maximum(light, 0) + FAINT) ** 2
    least, albedo, facets = np.full(count, np.inf), np.zeros((3, count)), np.zeros((3, count))
    metallic, roughness = np.zeros(count), np.ones(count)
    for kind in _surfaces(angles):
        fitted = _fit_lobes(light - kind.rest, weights, kind.lambert, kind.facets, kind.most)
        errors, diffuse, specular = (row.reshape(3, count) for row in fitted)
        tried, error = specular if kind.is_metal else diffuse, errors.sum(axis=0)
        better = error < least
        if kind.is_metal:
            better &= tried.max(axis=0) >= LEAST_METAL
        least, albedo = np.where(better, error, least), np.where(better, tried, albedo)
        facets, metallic = np.where(better, specular, facets), np.where(better, kind.is_metal, metallic)
        roughness = np.where(better, kind.roughness, roughness)
    return FittedMaterial(*(np.float32(values.T) for values in (albedo, metallic, roughness, facets)))


@dataclass(frozen=True, eq=False)
class _Surface:
    """A kind of surface: it reflects diffuse * lambert + specular * facets + rest, [K] each, as shares of a white
    Lambertian one that faces the Sun."""

    roughness: float
    is_metal: bool
    lambert: Array
    facets: Array
    rest: Array
    most: float  #: that facets reflect at normal incidence


def _surfaces(angles: SunAndView) -> Iterator[_Surface]:
    """All that are tried."""
    lambert, none = angles.suns[:, 2], np.zeros(len(angles.suns))
    yield _Surface(1.0, False, lambert, none, none, 0.0)
    for roughness in ROUGHNESSES:
        facets, rest = angles.facets(roughness)
        yield _Surface(roughness, False, lambert, facets, rest, MOST_COAT)
        yield _Surface(roughness, True, none, facets, rest, 1.0)


def _fit_lobes(light: Array, weights: Array, lambert: Array, facets: Array, most: float) -> tuple[Array, Array, Array]:
    """([M] weighted squares left, [M] diffuse >= 0, [M] specular in [0, most]) of light [M, K]: the quadratic's minimum
    where that is allowed, else the best on an edge."""
    ll, ff, lf = weights @ lambert**2, weights @ facets**2, weights @ (lambert * facets)
    weighted = weights * light
    yl, yf = weighted @ lambert, weighted @ facets
    yy = np.einsum("mk,mk->m", weighted, light)
    ll, safe = np.maximum(ll, 1e-30), np.maximum(ff, 1e-30)
    determinant = np.maximum(ll * ff - lf**2, 1e-12 * ll * safe)
    zero, full = np.zeros_like(ll), np.full_like(ll, most)
    diffuse = np.stack([(ff * yl - lf * yf) / determinant, zero, yl / ll, (yl - most * lf) / ll])
    specular = np.stack([(ll * yf - lf * yl) / determinant, np.clip(yf / safe, 0, most), zero, full])
    error = yy - 2 * (diffuse * yl + specular * yf) + diffuse**2 * ll + specular**2 * ff + 2 * diffuse * specular * lf
    allowed = (diffuse >= 0) & (specular >= 0) & (specular <= most)
    best = np.argmin(np.where(allowed, error, np.inf), axis=0)[None]
    return tuple(np.take_along_axis(values, best, axis=0)[0] for values in (error, diffuse, specular))
