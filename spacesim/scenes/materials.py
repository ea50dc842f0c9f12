"""Surface materials of spacecraft: a table of presets (assets/materials.toml), each with its source, and
constructors for others.

A material's albedo is its spectrum weighted with sunlight and the camera's response (spectra.py). No surface is
perfectly smooth, because a mirror never meets a directional Sun.
"""

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.scenes import textures

Color = tuple[float, float, float]

TABLE = Path(__file__).parents[1] / "assets" / "materials.toml"

SMOOTHEST = 0.05  #: least `roughness` of `principled`, chosen: smoother facets would hardly ever meet the Sun


@dataclass(frozen=True, eq=False)
class Material:
    """A surface and how light leaves it.

    `bsdf` holds plain JSON values only. A texture in it is {"type": "bitmap", "image": KEY, "raw": bool}, its
    pixels are `images[KEY]`: uint8 [H, W], [H, W, 3] or [H, W, 4], sRGB-encoded colours or, where "raw", data.
    """

    name: str
    albedo: Color  #: mean linear camera RGB reflectance, diffuse or (metals) specular
    bsdf: Mapping[str, Any]  #: Mitsuba's description
    source: str  #: where the numbers are from
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    tile: float | None = None  #: metres that one repeat of the images covers where a part has no uv of its own
    reflectance: tuple[tuple[float, float], ...] = ()  #: (wavelength nm, reflectance); the albedo follows from it


def _rgb(color: Color) -> dict[str, Any]:
    return {"type": "rgb", "value": list(color)}


def lambertian(name: str, albedo: Color, source: str) -> Material:
    """An ideally diffuse surface."""
    return Material(name, albedo, {"type": "diffuse", "reflectance": _rgb(albedo)}, source)


def metal(name: str, albedo: Color, alpha: float, source: str) -> Material:
    """A rough metal: GGX facets of roughness `alpha`, each reflecting `albedo` at every angle. Light that would meet
    a second facet is lost, as in all microfacet models of one bounce: the surface reflects less than `albedo`."""
    bsdf = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": alpha,
        "specular_reflectance": _rgb(albedo),
    }
    return Material(name, albedo, bsdf, source)


def coated(name: str, albedo: Color, alpha: float, source: str, ior: float = 1.5) -> Material:
    """A diffuse base of `albedo` under a clear coat of refractive index `ior` and GGX roughness `alpha`."""
    bsdf = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": alpha,
        "int_ior": ior,
        "diffuse_reflectance": _rgb(albedo),
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
    bsdf: dict[str, Any] = {
        "type": "principled",
        "base_color": _bitmap("base_color", raw=False) if "base_color" in images else _rgb(base_color),
        "metallic": _bitmap("metallic") if "metallic" in images else metallic,
        "roughness": _bitmap("roughness") if "roughness" in images else max(roughness, SMOOTHEST),
    }
    if "normal" in images:
        bsdf = _with_normals(bsdf, "normal")
    return Material(name, albedo, bsdf, source, images, tile)


@dataclass(frozen=True)
class _Row:
    """A row of the table; its columns are explained in materials.toml."""

    kind: str
    source: str
    albedo: Color
    absorptance: float | None = None
    roughness: float | None = None
    ior: float | None = None
    normals: str | None = None
    pattern: str | None = None
    tile: float | None = None
    spectrum: tuple[tuple[float, float], ...] = ()

    def material(self, name: str) -> Material:
        if self.kind == "coated":
            made = coated(name, self.albedo, self.roughness or 0.0, self.source, self.ior or 1.5)
        elif self.kind == "metal":
            made = metal(name, self.albedo, self.roughness or 0.0, self.source)
        else:
            made = lambertian(name, self.albedo, self.source)
        if self.pattern is not None:
            made = _patterned(made, self.pattern)
        if self.normals is not None:
            images = {**made.images, self.normals: NORMALS[self.normals]()}
            made = replace(made, bsdf=_with_normals(made.bsdf, self.normals), images=images)
        return replace(made, tile=self.tile, reflectance=self.spectrum)


NORMALS = {"crinkle": textures.crinkle, "grain": textures.grain}
PATTERNS = {"cells": textures.cells}


def _patterned(plain: Material, pattern: str) -> Material:
    """`plain`, diffuse or coated, with the image of a pattern of its albedo."""
    image = PATTERNS[pattern](plain.albedo)
    key = "diffuse_reflectance" if "diffuse_reflectance" in plain.bsdf else "reflectance"
    bsdf = {**plain.bsdf, key: _bitmap(pattern, raw=False)}
    mean = linear_from_srgb(image / np.float32(255)).mean(axis=(0, 1), dtype=np.float64)
    return replace(plain, albedo=_color(mean), bsdf=bsdf, images={**plain.images, pattern: image})


@cache
def _table() -> dict[str, _Row]:
    toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    return {name: _row_of(values) for name, values in toml.loads(TABLE.read_text(encoding="utf-8")).items()}


def _row_of(values: Mapping[str, Any]) -> _Row:
    spectrum = tuple((float(nm), float(value)) for nm, value in values.get("spectrum", ()))
    return _Row(**{**values, "albedo": _color(values["albedo"]), "spectrum": spectrum})


def material_names() -> tuple[str, ...]:
    """The names of the presets."""
    return tuple(_table())


def _row(name: str) -> _Row:
    if name not in _table():
        raise InputError(f"material: expected one of {', '.join(material_names())}, found {name!r}")
    return _table()[name]


@cache
def material(name: str) -> Material:
    """The preset called `name`; InputError lists the names where there is none."""
    return _row(name).material(name)


def customised(
    name: str,
    preset: str,
    albedo: Color | None = None,
    roughness: float | None = None,
    ior: float | None = None,
    tile: float | None = None,
) -> Material:
    """The preset `preset` under another name and with other numbers, those that are not None.

    albedo: linear camera RGB in [0, 1]; roughness: GGX alpha in (0, 1]; ior: refractive index of the coat;
    tile: metres. Raises InputError for an unknown preset, a number out of range or one that the preset has not.
    """
    row = _row(preset)
    changes: dict[str, Any] = {}
    if albedo is not None:
        _check_unit(f"material {name}: albedo", albedo)
        changes.update(albedo=_color(albedo), spectrum=())
    limits = {"roughness": (roughness, 0.01, 1.0), "ior": (ior, 1.0, 4.0), "tile": (tile, 0.0, 1e6)}
    for key, (value, low, high) in limits.items():
        if value is None:
            continue
        if getattr(row, key) is None:
            raise InputError(f"material {name}: expected no {key}, which {preset} does not have, found {value}")
        if not low < value <= high:
            raise InputError(f"material {name}: {key}: expected a number above {low} up to {high}, found {value}")
        changes[key] = float(value)
    if not changes:
        return replace(material(preset), name=name)
    source = f"{preset} with {', '.join(key for key in changes if key != 'spectrum')} of the scene file; {row.source}"
    return replace(row, source=source, **changes).material(name)


def _check_unit(what: str, values: Any) -> None:
    if not all(0.0 <= x <= 1.0 for x in values):
        found = ", ".join(f"{x:g}" for x in values)
        raise InputError(f"{what}: expected numbers from 0 to 1, found {found}")


def _color(values: Any) -> Color:
    red, green, blue = (float(x) for x in values)
    return red, green, blue


def _bitmap(key: str, raw: bool = True) -> dict[str, Any]:
    """A texture in a BSDF, its pixels in `Material.images[key]`."""
    return {"type": "bitmap", "image": key, "raw": raw}


def _with_normals(bsdf: Mapping[str, Any], key: str) -> dict[str, Any]:
    """`bsdf` with the normals of the image `key` (tangent space)."""
    return {"type": "normalmap", "normalmap": _bitmap(key), "bsdf": dict(bsdf)}


TEST_WHITE = lambertian("test white", (1.0, 1.0, 1.0), "ideal Lambertian reflector, for checks")
TEST_GREY = lambertian("test grey", (0.5, 0.5, 0.5), "ideal Lambertian reflector, for checks")
GOLD_FOIL = metal(
    "gold foil",
    (0.83, 0.56, 0.18),
    0.35,
    "aluminised Kapton, Kapton outside: absorptance 0.40 (table 11.3), as the luminance; hue and roughness "
    "chosen, Kapton absorbs below 500 nm",
)
WHITE_PAINT = coated(
    "white paint",
    (0.74, 0.74, 0.72),
    0.4,
    "white silicone paint: absorptance 0.26 (table 11.3); roughness chosen",
)
DISH_WHITE = lambertian(
    "dish white",
    (0.85, 0.85, 0.84),
    "white silicate paint: absorptance 0.12 to 0.14 (table 11.3), taken as matt",
)
BLACK_PAINT = lambertian(
    "black paint",
    (0.05, 0.05, 0.05),
    "black polyurethane paint: absorptance 0.95 (table 11.3), taken as matt",
)
ALUMINIUM = metal(
    "aluminium",
    (0.76, 0.76, 0.77),
    0.35,
    "polished aluminium: absorptance 0.24 (table 11.3); roughness chosen, milled",
)
SOLAR_CELL = coated(
    "solar cell",
    (0.015, 0.03, 0.12),
    0.15,
    "GaAs cells: absorptance 0.88 (table 11.3), of which the cover glass (n = 1.5) reflects 0.04; hue chosen",
)
CARBON_FIBRE = coated(
    "carbon fibre",
    (0.05, 0.05, 0.055),
    0.3,
    "as black epoxy paint: absorptance 0.95 (table 11.3); gloss of its resin (n = 1.5) chosen",
)
BOOM_GREY = lambertian("boom grey", (0.32, 0.32, 0.33), "grey paint between black and white, chosen")
LENS = coated("lens", (0.01, 0.012, 0.02), 0.1, "coated glass over a dark barrel, n = 1.5; chosen")
