"""Surface materials of spacecraft: a small table of reflectances and Mitsuba BSDFs, each with its source.

The solar absorptances are those of Fortescue, Swinerd and Stark, "Spacecraft Systems Engineering", 4th
edition, Wiley 2011, table 11.3; 1 - absorptance is the reflectance over the whole solar spectrum. Hue and
roughness are not in that table: they are our choice, and each record says so. No surface is perfectly smooth,
because a mirror never meets a directional Sun.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A surface. albedo: linear RGB reflectance, diffuse or (metals) specular; bsdf: Mitsuba's description of
    it, plain JSON values only; source: where the numbers are from."""

    name: str
    albedo: Color
    bsdf: Mapping[str, Any]
    source: str


def _rgb(color: Color) -> dict[str, Any]:
    return {"type": "rgb", "value": list(color)}


def lambertian(name: str, albedo: Color, source: str) -> Material:
    """An ideally diffuse surface."""
    return Material(name, albedo, {"type": "diffuse", "reflectance": _rgb(albedo)}, source)


def metal(name: str, albedo: Color, alpha: float, source: str) -> Material:
    """A rough metal: GGX facets of roughness `alpha`, each reflecting `albedo` at every angle."""
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
