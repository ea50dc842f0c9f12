"""What the Sun gives each Gaussian, tabulated over all directions of the Sun: shadows and light that bounces.

Visibility is nearly binary and follows no few components: with 256 of them, 256 bytes a Gaussian, it is 0.08 off (root
mean square). An octahedral map of 32 x 32 directions (Cigolle et al. 2014) at 4 bits, 115 bytes once deflated, costs
pictures 0.03 dB. What bounces is smooth: few components do.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spacesim.backend import ad
from spacesim.backend.memory import check_memory
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.splat.light.earthlight import earth_irradiance
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.gaussians import Gaussians

SIDE, SIDE_OF_MANY, MANY = 32, 16, 40_000
"""Directions on a side of the maps of visibility; and of models of more than `MANY` Gaussians."""
LEVELS = 15  #: of visibility, two maps' cells to a byte
BOUNCE_SIDE = 8  #: directions on a side of the table of light that bounces
#: of the 4 x 4 Suns that a direction of that table is the mean of, four are computed, one in each row: their columns.
#: They are 0.006 off (root mean square of the light's square root), what the table's components leave out is 0.021
STAGGERED = (1, 3, 0, 2)
BOUNCE_COMPONENTS = 8  #: principal components of it


@dataclass(frozen=True, eq=False)
class SunlightTables:
    """Of N Gaussians."""

    side: int  #: directions on a side of the maps of visibility
    visibility: np.ndarray | None  #: uint8 [N, side^2 / 2], two directions a byte, the first in the low bits; or None
    #: int8 [K, N, 6], shares of 1/127: square root of the albedo times the light that arrives at the side of the normal
    #: (RGB) and at the other, by components; None where neither light bounces nor the Earth shines
    bounce: np.ndarray | None
    bounce_table: np.ndarray | None  #: float32 [BOUNCE_SIDE^2, K]: how much of each component a Sun makes


def octahedral_directions(side: int) -> np.ndarray:
    """[side^2, 3] unit: the cells' middles of an octahedral map of the sphere, row by row."""
    cells = (2 * np.arange(side) + 1) / side - 1
    x, y = np.meshgrid(cells, cells)
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    directions = np.stack([x - np.copysign(fold, x), y - np.copysign(fold, y), z], axis=-1).reshape(-1, 3)
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def tabulate_sunlight(
    gaussians: Gaussians, light: LightModel, report: Callable[[], None], earth: Earth | None = None
) -> SunlightTables:
    """Tables of a model that knows the Sun, of N Gaussians. report: called `sunlight_steps` times;  earth: whose light
    is with that which bounces, of a model that has learned it: it arrives at either side under each Sun, too"""
    count, side = gaussians.count, _side(gaussians, light, earth)
    directions = octahedral_directions(side)
    check_memory(count * len(directions) * 2, f"shadows of {count} Gaussians under {len(directions)} Suns")
    levels = np.zeros((len(directions), count), np.uint8)
    blocks = max(side // BOUNCE_SIDE, 1)
    bounced = np.zeros((BOUNCE_SIDE, BOUNCE_SIDE, count, 6), np.float32)
    more = bool(light.config.bounce) or earth is not None
    albedo, all_reflected = _reflectances(gaussians, light) if more else [np.zeros((count, 6), np.float32)] * 2
    for index, sun in enumerate(directions):
        row, column = divmod(index, side)
        bounces = more and (blocks < len(STAGGERED) or column % blocks == STAGGERED[row % blocks])
        sunlight = light.sunlight(gaussians, sun) if bounces else Sunlight(light.visibility(gaussians, sun), [])
        if sunlight.visibility is not None:
            levels[index] = np.rint(LEVELS * np.clip(np.array(sunlight.visibility), 0, 1))
        if bounces:
            reflected = np.zeros((count, 6), np.float32)
            if earth is not None:
                reflected += light.config.sunlit_white * albedo * _earthlight(gaussians, light, sun, earth)
            if sunlight.bounced:
                left = 1.0 if earth is None else earth.visible_sun(sun)
                reflected += left * all_reflected * np.stack([np.array(part) for part in sunlight.bounced], axis=1)
            bounced[row // blocks, column // blocks] += reflected / min(blocks**2, len(STAGGERED))
        report()
    packed = np.ascontiguousarray((levels[0::2] | levels[1::2] << 4).T) if light.config.shadow else None
    if not more:
        return SunlightTables(side, packed, None, None)
    table, components = _principal_components(np.sqrt(bounced).reshape(BOUNCE_SIDE**2, -1))
    return SunlightTables(side, packed, components.reshape(len(components), count, 6), table)


def sunlight_steps(gaussians: Gaussians, light: LightModel, earth: Earth | None = None) -> int:
    """How often `tabulate_sunlight` reports."""
    return _side(gaussians, light, earth) ** 2


def _side(gaussians: Gaussians, light: LightModel, earth: Earth | None) -> int:
    if light.config.shadow is None:
        return BOUNCE_SIDE if light.config.bounce or earth else 0
    return SIDE if gaussians.count <= MANY else SIDE_OF_MANY


def _reflectances(gaussians: Gaussians, light: LightModel) -> list[np.ndarray]:
    """Two of [N, 6]: of both sides the albedo, RGB each; the same with what surfaces mirror, which counts as scattered,
    as a table knows no camera."""
    albedo = 1 / (1 + np.exp(-_features(gaussians, light.config.albedos).T))
    specular = light.config.specular
    both = albedo if specular is None else np.minimum(albedo + 1 / (1 + np.exp(-_features(gaussians, specular).T)), 1)
    return [np.tile(albedo, (1, 2)), np.tile(both, (1, 2))]


def _earthlight(gaussians: Gaussians, light: LightModel, sun: np.ndarray, earth: Earth) -> np.ndarray:
    """float32 [N, 6]: what arrives at the side of the normal and at the other, three times each."""
    beams = upload(earth.beams(sun))
    normals = ad.Array3f(_features(gaussians, light.config.field.features))
    sides = [np.array(earth_irradiance(normals, direction, beams)) for direction in (-normals, normals)]
    return np.repeat(np.stack(sides, axis=1), 3, axis=1)


def _features(gaussians: Gaussians, first: int) -> np.ndarray:
    """[3, N]: three features from number `first`."""
    return np.array(gaussians.features).reshape(-1, gaussians.count)[first : first + 3]


def _principal_components(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(float32 [S, K], int8 [K, M]) whose product, in shares of 1/127, is near `rows` [S, M]."""
    _, vectors = np.linalg.eigh(rows.astype(np.float64) @ rows.T.astype(np.float64))
    basis = vectors[:, ::-1][:, :BOUNCE_COMPONENTS]
    return quantized(basis, basis.T.astype(np.float32) @ rows)


def quantized(table: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(float32 [..., K], int8 [K, ...]): coefficients [K, ...] in shares of 1/127 of the largest of each component, and
    the table [..., K] that they go with times that largest."""
    flat = coefficients.reshape(len(coefficients), -1)
    largest = np.maximum(np.abs(flat).max(axis=1), 1e-12)
    shares = np.rint(127 * flat / largest[:, None]).astype(np.int8)
    return (table * largest).astype(np.float32), shares.reshape(coefficients.shape)
