"""Surface materials of spacecraft: a table of presets (assets/materials.toml), each with its source, and
constructors for others.

A material's albedo is its spectrum weighted with sunlight and the camera's response (spectra.py). No surface is
perfectly smooth, because a mirror never meets a directional Sun.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.structure import Rules, check_fields, structure
from spacesim.data.toml import Document, read_document
from spacesim.scenes.materials import textures

Color = tuple[float, float, float]

TABLE = Path(__file__).parents[2] / "assets" / "materials.toml"

SOLAR_CELL = (0.08, 0.04)  #: width and height of a cell of the preset solar-cell, metres: 2 x 4 in its tile

WHITEST = 0.9
"""Most base colour of a coated surface and of a dielectric: above it Mitsuba's principled BSDF, which adds its
gloss to an undiminished diffuse base, can reflect more of an even sky than it gets (index 1.7, GGX alpha 0.1: from
0.903)."""

SMOOTHEST = 0.05  #: least `roughness` of `principled`: smoother facets would hardly ever meet the Sun


@dataclass(frozen=True, eq=False)
class Material:
    """A surface and how light leaves it.

    `bsdf` holds plain JSON values only. A texture in it is {"type": "bitmap", "image": KEY, "raw": bool}, its
    pixels are `images[KEY]`: uint8 [H, W], [H, W, 3] or [H, W, 4], sRGB-encoded colours or, where "raw", data.
    """

    name: str  #: of the preset, or as a file has it
    albedo: Color  #: mean linear camera RGB reflectance, diffuse or (metals) specular
    bsdf: JsonMapping  #: Mitsuba's description
    source: str  #: where the numbers are from
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    tile: float | None = None  #: metres that one repeat of the images covers where a part has no uv of its own
    reflectance: tuple[tuple[float, float], ...] = ()  #: (wavelength nm, reflectance); the albedo follows from it


def _rgb(color: Color) -> JsonDict:
    return {"type": "rgb", "value": list(color)}


def lambertian(name: str, albedo: Color, source: str) -> Material:
    """An ideally diffuse surface."""
    return Material(name, albedo, {"type": "diffuse", "reflectance": _rgb(albedo)}, source)


def metal(name: str, albedo: Color, alpha: float, source: str) -> Material:
    """A rough metal of GGX roughness `alpha` whose reflectance at normal incidence is `albedo`, at other angles
    within a few per cent of it. Microfacets of one bounce lose the light that meets a second facet (17 % at alpha
    0.35), so each facet reflects `albedo` / `facet_albedo(alpha)`, at most 1."""
    facets = facet_albedo(alpha)
    bsdf = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": alpha,
        "specular_reflectance": _rgb(_color(min(x / facets, 1.0) for x in albedo)),
    }
    return Material(name, albedo, bsdf, source)


def facet_albedo(alpha: float) -> float:
    """What a surface of perfect GGX mirrors reflects after one bounce at normal incidence: the mean of Smith's
    shadowing G1 over the mirrored directions (Walter et al. 2007, eqs. 33 to 35)."""
    u = (np.arange(4096) + 0.5) / 4096
    tilt = np.arctan(alpha * np.sqrt(u / (1.0 - u)))  # of facets, as many as are seen from above
    leaving = np.cos(2.0 * tilt)
    shadowing = 2.0 / (1.0 + np.sqrt(1.0 + (alpha * np.tan(2.0 * tilt)) ** 2))
    return float(np.where(leaving > 0.0, shadowing, 0.0).mean())


def coated(name: str, albedo: Color, alpha: float, source: str, ior: float = 1.5) -> Material:
    """A diffuse base under a clear coat of refractive index `ior` and GGX roughness `alpha`. albedo: of the base, as
    seen through the coat; the surface reflects ((ior - 1) / (ior + 1))^2 more, so that their sum stays below 1.

    Mitsuba's principled BSDF (Burley 2012), whose roughness is the root of alpha: the diffuse light of its
    "roughplastic" fades with roughness, to 0.6 of its value at alpha 0.4.
    """
    bsdf = {
        "type": "principled",
        "base_color": _rgb(albedo),
        "metallic": 0.0,
        "roughness": math.sqrt(alpha),
        "eta": ior,
    }
    return Material(name, albedo, bsdf, source)


def principled(
    name: str,
    base_color: Color = (1.0, 1.0, 1.0),
    metallic: float = 0.0,
    roughness: float = 0.5,
    source: str = "",
    images: Mapping[str, np.ndarray] | None = None,
    tile: float | None = None,
) -> Material:
    """A surface of glTF 2.0's metallic-roughness model (section 3.9.2) as Mitsuba's principled BSDF, which has
    its dielectric n = 1.5 and its GGX alpha = roughness^2.

    base_color: linear RGB; metallic, roughness: in [0, 1]. images: any of "base_color" [H, W, 3] uint8
    (sRGB-encoded), "metallic" and "roughness" [H, W] uint8 and "normal" [H, W, 3] uint8 (raw, tangent space,
    +y up); as in glTF, the numbers multiply the images. Raises InputError for a number out of range.

    Disney's diffuse lobe, which this BSDF has, does not conserve energy at grazing angles: a white surface that is
    lit from everywhere has radiance 1.00 seen at normal incidence and 1.17 at 80 degrees.
    """
    for key, values in (("base_color", base_color), ("metallic", [metallic]), ("roughness", [roughness])):
        _check_unit(f"material {name}: {key}", values)
    images = dict(images or {})
    albedo = base_color
    if "base_color" in images:
        linear = linear_from_srgb(images["base_color"][..., :3] / np.float32(255)) * np.asarray(base_color)
        albedo = _color(linear.mean(axis=(0, 1)))
        images["base_color"] = np.round(255 * srgb_from_linear(linear)).astype(np.uint8)
    for key, factor in (("metallic", metallic), ("roughness", roughness)):
        if key in images:
            lowest = SMOOTHEST if key == "roughness" else 0.0
            images[key] = np.round(np.maximum(factor * images[key], 255 * lowest)).astype(np.uint8)
    bsdf: JsonDict = {
        "type": "principled",
        "base_color": _bitmap("base_color", raw=False) if "base_color" in images else _rgb(base_color),
        "metallic": _bitmap("metallic") if "metallic" in images else metallic,
        "roughness": _bitmap("roughness") if "roughness" in images else max(roughness, SMOOTHEST),
    }
    if "normal" in images:
        bsdf = _with_normals(bsdf, "normal")
    return Material(name, albedo, bsdf, source, images, tile)


Kind = Literal["diffuse", "coated", "metal"]


@dataclass(frozen=True)
class MaterialPreset:
    """A row of the table; its columns are explained there."""

    kind: Kind  #: how it reflects
    source: str  #: where the numbers are from
    albedo: Color  #: linear camera RGB reflectance; of coated surfaces the base's as seen through the coat
    absorptance: float | None = None  #: solar, 300 to 2500 nm, that the spectrum is scaled to
    roughness: float | None = None  #: GGX alpha
    ior: float | None = None  #: refractive index of the coat
    normals: str | None = None  #: name of a picture of normals, as "crinkle"
    pattern: str | None = None  #: name of a pattern of its colour, as "cells"
    tile: float | None = None  #: metres that one repeat of the pictures covers
    spectrum: tuple[tuple[float, float], ...] = ()  #: (wavelength in nm, reflectance), which the albedo follows from

    def __post_init__(self) -> None:
        check_fields(self)
        _check_unit("albedo", self.albedo)
        if self.kind == "coated" and max(self.albedo) > WHITEST:
            raise InputError(
                f"albedo: expected at most {WHITEST:g} under a coat, which adds its gloss, found {max(self.albedo):g}"
            )
        for key, (low, high) in LIMITS.items():
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise InputError(f"{key}: expected a number from {low:g} to {high:g}, found {value}")
        if self.kind != "diffuse" and self.roughness is None:
            raise InputError(f"roughness: expected a number, as {self.kind} surfaces have one, found none")
        for key, names in (("normals", NORMALS), ("pattern", PATTERNS)):
            if getattr(self, key) not in (None, *names):
                raise InputError(f"{key}: expected one of {', '.join(names)}, found {getattr(self, key)!r}")

    def material(self, name: str) -> Material:
        """The row as a Material of that name."""
        if self.kind == "coated":
            result = coated(name, self.albedo, self.roughness or 0.0, self.source, self.ior or 1.5)
        elif self.kind == "metal":
            result = metal(name, self.albedo, self.roughness or 0.0, self.source)
        else:
            result = lambertian(name, self.albedo, self.source)
        if self.pattern is not None:
            result = _with_pattern(result, self.pattern)
        if self.normals is not None:
            images = {**result.images, self.normals: NORMALS[self.normals]()}
            result = replace(result, bsdf=_with_normals(result.bsdf, self.normals), images=images)
        return replace(result, tile=self.tile, reflectance=self.spectrum)


NORMALS = {"crinkle": textures.crinkle, "grain": textures.grain}
PATTERNS = {"cells": textures.cells}
LIMITS = {"roughness": (0.01, 1.0), "ior": (1.001, 4.0), "tile": (1e-6, 1e6)}  #: of what a row has of these


def _with_pattern(plain: Material, pattern: str) -> Material:
    """`plain`, diffuse or coated, with the image of a pattern of its albedo."""
    image = PATTERNS[pattern](plain.albedo)
    key = "base_color" if "base_color" in plain.bsdf else "reflectance"
    bsdf = {**plain.bsdf, key: _bitmap(pattern, raw=False)}
    mean = linear_from_srgb(image / np.float32(255)).mean(axis=(0, 1), dtype=np.float64)
    return replace(plain, albedo=_color(mean), bsdf=bsdf, images={**plain.images, pattern: image})


@cache
def _table() -> dict[str, MaterialPreset]:
    document = read_document(TABLE)
    return {name: _row(document, name) for name in document.values}


def _row(document: Document, name: str) -> MaterialPreset:
    """The row called `name`. Raises InputError with line and key for what it lacks or cannot have."""
    lines = {keys[1:]: line for keys, line in document.lines.items() if keys[0] == name}
    return structure(MaterialPreset, Document(f"{TABLE.name}: {name}", document.values[name], lines), Rules())


def material_names() -> tuple[str, ...]:
    """The names of the presets."""
    return tuple(_table())


def material_preset(name: str) -> MaterialPreset:
    """The row called `name`; InputError lists the names where there is none."""
    if name not in _table():
        raise InputError(f"material: expected one of {', '.join(material_names())}, found {name!r}")
    return _table()[name]


@cache
def material(name: str) -> Material:
    """The preset called `name`; InputError lists the names where there is none."""
    return material_preset(name).material(name)


def customise(
    name: str,
    base: str,
    albedo: Color | None = None,
    roughness: float | None = None,
    ior: float | None = None,
    tile: float | None = None,
) -> Material:
    """The preset `base` under another name and with other numbers, those that are not None.

    albedo: linear camera RGB in [0, 1], of coated presets at most WHITEST; roughness: GGX alpha from 0.01 to 1; ior:
    refractive index of the coat; tile: metres. Raises InputError for an unknown preset, a number out of range or one
    that the preset has not.
    """
    row = customise_preset(name, base, albedo, roughness, ior, tile)
    return replace(material(base), name=name) if row is material_preset(base) else row.material(name)


def customise_preset(
    name: str,
    base: str,
    albedo: Color | None = None,
    roughness: float | None = None,
    ior: float | None = None,
    tile: float | None = None,
) -> MaterialPreset:
    """The row `base` with other numbers, as `customise` takes them, for a material called `name`; itself where all are
    None. Raises InputError as `customise` does."""
    row = material_preset(base)
    changes: JsonDict = {}
    if albedo is not None:
        changes.update(albedo=_color(albedo), spectrum=())
    for key, value in (("roughness", roughness), ("ior", ior), ("tile", tile)):
        if value is None:
            continue
        if getattr(row, key) is None:
            raise InputError(f"material {name}: {key}: expected none, as {base} has none, found {value}")
        changes[key] = float(value)
    if not changes:
        return row
    source = f"{base} with {', '.join(key for key in changes if key != 'spectrum')} of the scene file; {row.source}"
    try:
        return replace(row, source=source, **changes)
    except InputError as error:
        raise InputError(f"material {name}: {error}") from None


def _check_unit(what: str, values: Iterable[float]) -> None:
    if not all(0.0 <= x <= 1.0 for x in values):
        listed = ", ".join(f"{x:g}" for x in values)
        raise InputError(f"{what}: expected numbers from 0 to 1, found {listed}")


def _color(values: Iterable[float]) -> Color:
    red, green, blue = (float(x) for x in values)
    return red, green, blue


def _bitmap(key: str, raw: bool = True) -> JsonDict:
    """A texture in a BSDF, its pixels in `Material.images[key]`."""
    return {"type": "bitmap", "image": key, "raw": raw}


def _with_normals(bsdf: JsonMapping, key: str) -> JsonDict:
    """`bsdf` with the normals of the image `key` (tangent space)."""
    return {"type": "normalmap", "normalmap": _bitmap(key), "bsdf": dict(bsdf)}
