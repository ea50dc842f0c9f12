"""How large a reproduction is: the full one, a reduced one that says most of it, a quick one that says that it runs."""

from dataclasses import dataclass, field

from spacesim.data.files import JsonMapping
from spacesim.eval.metrics.geometry import GeometryConfig


@dataclass(frozen=True)
class Size:
    """Data, trainings and evaluations. Counts of views are for each Sun."""

    name: str = "full"  #: "full", "reduced" or "quick"
    resolution: int = 512  #: pixels of each side
    suns: int = 100  #: of training
    views: int = 100  #: of training
    known_test_views: int = 2  #: of testing, under the Suns of training
    test_suns: int = 20  #: never seen in training
    test_views: int = 5  #: of each of them
    spp: int = 64  #: samples a pixel of training views
    test_spp: int = 1024  #: samples a pixel of test views
    pair_views: int = 100  #: of two boxsats under one Sun
    one_sun_views: int = 400  #: of training, under one Sun (figures 4.3 and 4.4)
    one_sun_test_views: int = 300  #: of testing, under that Sun
    fully_lit_deg: tuple[float, float] = (30.0, 15.0)  #: azimuth and elevation between camera and Sun, at most (4.2)
    telescope_suns: int = 24  #: of the telescope's training (figures 6.1 and 6.2)
    telescope_views: int = 100  #: of the telescope's training
    telescope_iterations: int = 50_000  #: refinement stops at four fifths (section 6.2.2)
    figure_steps: int = 5_000  #: of figure 5.5
    figure_gaussians: int = 100_000  #: of figure 5.5
    iterations: int | None = None  #: of all other trainings; none: of their presets
    light: str = "fine"  #: preset of what is improved in tables 4.4 to 4.7
    strategies: str = "fast"  #: preset of what is improved in tables 5.4 to 5.6
    nerf: str = "thesis"  #: preset of figure 3.2's radiance field
    settings: JsonMapping = field(default_factory=dict)  #: fields of every training that has them, by dotted names
    geometry: GeometryConfig | None = field(default_factory=GeometryConfig)  #: how shapes are compared


FULL = Size()

REDUCED = Size(
    name="reduced",
    resolution=256,
    views=20,
    known_test_views=1,
    test_views=3,
    pair_views=40,
    one_sun_views=200,
    one_sun_test_views=100,
    telescope_views=40,
    telescope_iterations=10_000,
    iterations=10_000,
)

QUICK = Size(
    name="quick",
    resolution=64,
    suns=6,
    views=12,
    known_test_views=1,
    test_suns=2,
    test_views=3,
    spp=16,
    test_spp=64,
    pair_views=6,
    one_sun_views=40,
    one_sun_test_views=24,
    fully_lit_deg=(60.0, 30.0),
    telescope_suns=5,
    telescope_views=10,
    telescope_iterations=500,
    figure_steps=400,
    figure_gaussians=5_000,
    iterations=500,
    light="demo",
    strategies="demo",
    nerf="demo",
    settings={
        "init_count": 3_000,
        "checkpoint_every": 100,
        "refinement.refine_start": 100,
        "refinement.refine_stop": 400,
        "refinement.pause_after_reset": 0,
        "refinement.max_gaussians": 8_000,
        "strategy.cull_every": 100,
        "strategy.warm_up": 100,
        "strategy.backfill_start": 100,
        "strategy.min_gaussians": 3_500,
    },
    geometry=GeometryConfig(samples=20_000, voxels=64),
)
