"""How small radiance fields are trained in tests: in seconds."""

from spacesim.nerf.config import GridConfig, NerfConfig, ProposalConfig

GRID = GridConfig(4, 8, 48, 12)
CONFIG = NerfConfig(
    iterations=250,
    rate=3e-2,
    rays=512,
    samples=10,
    width=16,
    features=7,
    harmonics=2,
    grid=GRID,
    coarse=ProposalConfig(16, 8, GridConfig(2, 8, 16, 10)),
    fine=ProposalConfig(8, 8, GridConfig(2, 8, 16, 10)),
    warm_up=60,
    occupancy=16,
    occupancy_every=10,
    checkpoint_every=60,
    chunk=512,
)
