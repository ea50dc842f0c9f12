"""Multi-resolution hash grids (Müller et al. 2022): look-up, and the adjoint of that by hand.

Many samples add to one vertex, in an order that threads decide, and sums of floats depend on it. So gradients are
summed as whole numbers, which do not: each is rounded to a unit so small that the sum of all absolute gradients of a
level is 2^30 of them. Both numbers of a vertex go in one 64-bit addition, the cheapest that both backends have, and
what rounds to 0 is not added.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.nerf.config import GridConfig

PRIMES = 1, 2654435761, 805459861  #: of the hash (Müller et al. 2022, equation 4)
START = 1e-4  #: numbers are uniform within it at the start
FEATURES = 2  #: numbers a vertex
UNITS = 2.0**30  #: of the sum of absolute gradients of a level


@dataclass(frozen=True)
class GridLevel:
    """One resolution."""

    cells: int  #: along the box's longest side
    first: int  #: vertex of the table
    size: int  #: vertices
    hashed: bool  #: vertices share places


@dataclass(frozen=True)
class HashGrid:
    """Numbers at the vertices of cubic grids over [0, 1]^3; between them they are trilinear."""

    config: GridConfig  #: levels and sizes

    @cached_property
    def levels(self) -> tuple[GridLevel, ...]:
        """From coarse to fine."""
        config, first, levels = self.config, 0, []
        assert config.finest is not None, "a grid that fits its pictures"
        growth = (config.finest / config.coarsest) ** (1 / max(config.levels - 1, 1))
        for i in range(config.levels):
            cells = int(np.floor(config.coarsest * growth**i + 1e-6))
            hashed = (cells + 1) ** 3 > 1 << config.log2_size
            size = 1 << config.log2_size if hashed else (cells + 1) ** 3
            levels.append(GridLevel(cells, first, size, hashed))
            first += size
        return tuple(levels)

    @property
    def outputs(self) -> int:
        """Numbers of a point."""
        return FEATURES * self.config.levels

    @property
    def parameters(self) -> int:
        """Numbers of the table."""
        return FEATURES * (self.levels[-1].first + self.levels[-1].size)

    def initial(self, rng: np.random.Generator) -> np.ndarray:
        """A table, float32."""
        return rng.uniform(-START, START, self.parameters).astype(np.float32)

    def look_up(self, table: Float, point: Array3f) -> list[Float]:
        """`outputs` Floats [N] at points [3, N] in [0, 1]^3."""
        rows: list[Float] = []
        for level in self.levels:
            features = ad.Array2f(0)
            for vertex, weight, _ in _corners(level, point):
                features = dr.fma(dr.gather(ad.Array2f, table, vertex), weight, features)
            rows += list(features)
        return rows

    def adjoint(self, point: Array3f, gradients: list[Float]) -> Float:
        """Gradient by the table, from those [N] by the outputs at points [3, N]: the same bits in every run."""
        sums = [dr.sum(dr.abs(a) + dr.abs(b)) for a, b in zip(gradients[::2], gradients[1::2], strict=True)]
        units = [_power_of_two(UNITS / dr.maximum(total, 1e-30)) for total in sums]
        dr.eval(units)
        total = dr.zeros(ad.UInt64, self.parameters // FEATURES)
        for i, level in enumerate(self.levels):
            first, second = gradients[2 * i] * units[i], gradients[2 * i + 1] * units[i]
            for vertex, weight, _ in _corners(level, point):
                low, high = (ad.Int64(ad.Int(dr.round(g * weight))) for g in (first, second))
                both = ad.UInt64(low + high * 2**32)
                dr.scatter_add(total, both, vertex, (low != 0) | (high != 0))
        dr.eval(total)
        vertex = dr.arange(ad.UInt32, self.parameters // FEATURES)
        unit = ad.Float(0)
        for i, level in enumerate(self.levels):
            unit = dr.select(vertex >= level.first, dr.rcp(units[i]), unit)
        both = dr.gather(ad.UInt64, total, vertex)
        first_sum = ad.Int(ad.UInt32(both))
        second_sum = ad.Int(ad.UInt32((both - ad.UInt64(ad.Int64(first_sum))) >> 32))
        result = dr.empty(ad.Float, self.parameters)
        dr.scatter(result, ad.Array2f(first_sum, second_sum) * unit, vertex, mode=dr.ReduceMode.Permute)
        return result

    def slopes(self, table: Float, point: Array3f, gradients: list[Float]) -> Array3f:
        """[3, N] gradient by the points, from those [N] by the outputs."""
        result = ad.Array3f(0)
        for i, level in enumerate(self.levels):
            for vertex, _, slope in _corners(level, point):
                value = dr.gather(ad.Array2f, table, vertex)
                result = dr.fma(slope, value.x * gradients[2 * i] + value.y * gradients[2 * i + 1], result)
        return result


def _power_of_two(value: Float) -> Float:
    """The largest power of two that is at most `value`, a positive number: products with it are exact."""
    bits = cast("UInt32", dr.reinterpret_array(ad.UInt32, value))
    return cast("Float", dr.reinterpret_array(ad.Float, bits & ad.UInt32(0x7F800000)))


def _corners(level: GridLevel, point: Array3f) -> Iterator[tuple[UInt32, Float, Array3f]]:
    """(place in the table, weight, gradient of the weight by the point) of the 8 vertices around points."""
    scaled = dr.clip(point, 0, 1) * level.cells
    cell = dr.minimum(ad.Array3u(scaled), level.cells - 1)
    share = scaled - ad.Array3f(cell)
    for corner in range(8):
        upper = corner & 1, corner >> 1 & 1, corner >> 2
        x, y, z = (share[i] if upper[i] else 1 - share[i] for i in range(3))
        sign = [level.cells if bit else -level.cells for bit in upper]
        index = [cell[i] + upper[i] for i in range(3)]
        if level.hashed:
            mixed = index[0] * PRIMES[0] ^ index[1] * PRIMES[1] ^ index[2] * PRIMES[2]
            vertex = (mixed & (level.size - 1)) + level.first
        else:
            vertex = (index[2] * (level.cells + 1) + index[1]) * (level.cells + 1) + index[0] + level.first
        yield vertex, x * y * z, ad.Array3f(sign[0] * y * z, sign[1] * x * z, sign[2] * x * y)
