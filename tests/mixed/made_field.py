"""Radiance fields made by hand: a solid of one colour, of any shape, without training."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from spacesim.backend.upload import upload
from spacesim.nerf.config import GridConfig, NerfConfig, ProposalConfig
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.run import NerfRun
from spacesim.nerf.sampling.box import SceneBox

GRID = GridConfig(1, 24, 24, 14)
CONFIG = NerfConfig(
    samples=32,
    width=8,
    features=3,
    color_layers=2,
    grid=GRID,
    coarse=ProposalConfig(64, 8, GRID),
    fine=ProposalConfig(64, 8, GRID),
    occupancy=24,
    chunk=1024,
)
NOTHING = -20.0  #: log density outside


def made_field(
    inside: Callable[[np.ndarray], np.ndarray],
    color=(0.5, 0.5, 0.5),
    density: float = 400.0,
    low=(-1, -1, -1),
    size=(2, 2, 2),
    name: str = "field",
) -> NerfRun:
    """`density` (per side of the box) and `color` where `inside` (points [N, 3], metres, to bools) holds, else
    nothing; between, over a 24th of the box, the density's logarithm is linear."""
    networks, box = Networks(CONFIG), SceneBox(np.array(low, float), np.array(size, float))
    n = GRID.coarsest + 1
    z, y, x = np.meshgrid(*[np.arange(n) / (n - 1)] * 3, indexing="ij")
    points = box.low + np.stack([x, y, z], axis=-1).reshape(-1, 3) * box.side
    filled = inside(points).astype(float)
    parameters = []
    for field in (*networks.proposals, networks.field.density):
        values = [np.zeros_like(v) for v in field.initial(np.random.default_rng(0))]
        values[0][0::2] = filled
        hidden, outputs = field.shape.sizes[0][0], field.shape.sizes[1][0]
        values[1 + 0].fill(0)
        first = values[2].reshape(hidden, field.shape.inputs)
        first[0, 0] = 1
        last = values[4].reshape(outputs, hidden)
        last[0, 0] = np.log(density) - NOTHING
        values[5][0] = NOTHING
        parameters += values
    looks = [np.zeros_like(v) for v in networks.initial(0)[networks.bounds[1] + networks.field.split :]]
    looks[-1][:] = np.log(np.array(color) / (1 - np.array(color)))
    arrays = [upload(v.astype(np.float32)) for v in (*parameters, *looks)]
    ones = upload(np.ones(CONFIG.occupancy**3, np.float32))
    config = {"method": "nerf"}
    return NerfRun(Path(f"runs/{name}"), config, {}, networks, arrays, ones, box, 500)


def box_field(low, high, **named) -> NerfRun:
    """A solid box, metres, within two metres about the origin."""
    return made_field(lambda p: ((p >= np.array(low) - 1e-9) & (p <= np.array(high) + 1e-9)).all(axis=1), **named)
