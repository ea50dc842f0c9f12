"""Which cells of the box hold anything: rays are sampled from the first to the last of these that they cross."""

from dataclasses import dataclass, replace

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.nerf.sampling.rays import Rays
from spacesim.nerf.sampling.sampler import random

DECAY = 0.9  #: of a cell's density from one look at it to the next (Müller et al. 2022 take 0.95, of more looks)
FILLED = 0.01  #: alpha of a cell's width from which on it is filled
STREAM = 16  #: of random numbers


@dataclass(frozen=True)
class Occupancy:
    """A grid of `cells`^3 over [0, 1]^3; its state: the largest density seen in each cell of late, Float [cells^3]."""

    cells: int

    def points(self, key: UInt32, index: UInt32) -> Array3f:
        """[3, N] a place in each of the cells number `index` [N]. key: see `sampler.random`"""
        n = self.cells
        corner = ad.Array3f(index % n, index // n % n, index // (n * n))
        return (corner + ad.Array3f([random(key, index, STREAM + i) for i in range(3)])) / n

    def updated(self, state: Float, density: Float) -> Float:
        """The state after a look: `density` at `points`."""
        return dr.maximum(DECAY * state, density)

    def filled(self, state: Float) -> Float:
        """[cells^3] 1 where a cell or one of its 26 neighbours is filled, else 0."""
        n = self.cells
        index = dr.arange(ad.UInt32, n**3)
        x, y, z = ad.Int(index % n), ad.Int(index // n % n), ad.Int(index // (n * n))
        most = ad.Float(0)
        for i in range(27):
            near = [dr.clip(c + i // 3**k % 3 - 1, 0, n - 1) for k, c in enumerate((x, y, z))]
            most = dr.maximum(most, dr.gather(ad.Float, state, ad.UInt32((near[2] * n + near[1]) * n + near[0])))
        return dr.select(1 - dr.exp(-most / n) > FILLED, ad.Float(1), ad.Float(0))

    def clip(self, rays: Rays, filled: Float) -> tuple[Rays, Bool]:
        """(rays with near and far around the filled cells that they cross, whether they cross any). Looks at every half
        cell; `filled` has a margin of a cell."""
        n = self.cells
        step = 0.5 / n
        first, last = ad.Float(dr.inf), ad.Float(-dr.inf)
        count = dr.maximum(dr.ceil((rays.far - rays.near) / step), 0)
        k = dr.zeros(ad.Float, dr.width(rays.near))

        def step_cell(k: Float, first: Float, last: Float) -> tuple[Float, Float, Float]:
            t = rays.near + (k + 0.5) * step
            place = dr.fma(rays.direction, t, rays.origin) * n
            cell = ad.Array3u(dr.clip(place, 0, n - 1))
            hit = dr.gather(ad.Float, filled, (cell.z * n + cell.y) * n + cell.x) > 0
            first = dr.select(hit, dr.minimum(first, t), first)
            last = dr.select(hit, dr.maximum(last, t), last)
            return k + 1, first, last

        def goes_on(k: Float, first: Float, last: Float) -> Bool:
            return k < count

        _, first, last = dr.while_loop((k, first, last), goes_on, step_cell)
        crosses = last >= first
        near = dr.select(crosses, dr.maximum(rays.near, first - step), rays.near)
        far = dr.select(crosses, dr.minimum(rays.far, last + step), rays.far)
        return replace(rays, near=near, far=dr.maximum(near, far)), crosses
