"""How to train: one frozen record and its presets."""

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import Rules, structure
from spacesim.data.toml import Document
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import FieldConfig
from spacesim.splat.light.shading import LightConfig
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.light.shadow.refine import RefineConfig
from spacesim.splat.raster.supersample import MOST_PLACES
from spacesim.splat.train.strategies.default import DefaultStrategyConfig
from spacesim.splat.train.strategies.mcmc import McmcConfig
from spacesim.splat.train.strategies.mesh_aware import MeshAwareConfig
from spacesim.splat.train.strategies.strategy import MOST_STEPS
from spacesim.splat.train.strategies.support_aware import SupportAwareConfig
from spacesim.splat.train.warm_start import WarmStartConfig

METHODS = ("vanilla", "relight", "shadow-map", "shadow-splat", "park")
STRATEGIES = ("default", "mesh-aware", "support-aware", "mcmc")
INITS = ("mesh", "points", "random")
PRESETS = ("demo", "fast", "fine", "thesis")
ISOTROPY = 1e-2  #: weight of the isotropy term of `park`, chosen
MARGIN = 1e-3  #: to the exterior, but of `thesis`: at few pixels 1e-4 prunes half of the surface (docs/strategies.md)
LIT_SCREEN_SIZES = {"demo": 0.06, "fast": 0.03, "fine": 0.015}
"""Above which methods of light split, a share of the picture: a Gaussian has one visibility."""
EMITTERS = {"demo": 256, "fast": 256, "fine": 1024}  #: of one bounce of light, of methods with shadows
MCMC_PENALTY = 1e-2  #: weights of the penalties on opacity and scale of `mcmc` (Kheradmand et al. 2024)
PRIORS = ("truth", "mesh")
MOST_VIEWS = 64  #: of a step, chosen: one kernel reads the gradients of all; for 64 two cores compile about 11 s
MOST_RATE, MOST_WEIGHT = 1e3, 1e6  #: of learning rates and of weights in the loss, chosen
LARGEST_BOX = 1e6  #: of `init_box`, chosen
WEIGHTS = (
    *("visibility_weight", "isotropy_weight", "opacity_weight", "scale_weight", "flatten_weight"),
    *("depth_weight", "normal_weight"),
)


SUNLESS = RefineConfig(width=32, sun=Encoding("harmonics", 0), positions="world")
"""Told nothing that changes with the Sun but raw shadows: told more, it learns the Suns of training by heart."""
FINE_OPACITY = 0.005  #: below it methods of light prune in `fine`; chosen (docs/ablations.md)

_CHOICES = (("method", METHODS), ("strategy", STRATEGIES), ("preset", (None, *PRESETS)), ("prior", PRIORS))


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes, splatfacto's values; those of light are chosen. Those of the means and the networks fall
    exponentially; that of the means is per metre of scene scale."""

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    logit_opacities: float = 5e-2
    sh_constant: float = 2.5e-3
    sh_rest: float = 1.25e-4
    features: float = 2e-2
    networks: float = 3e-3
    networks_final: float = 3e-4

    def __post_init__(self) -> None:
        for f in fields(self):
            check_ranges(self, **{f.name: (0, MOST_RATE)})


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a trained model, apart from the data and the backend."""

    method: str = "vanilla"
    strategy: str = "default"
    init: str | None = None  #: mesh, points or random; None takes the first of points, mesh, random that can be had
    preset: str | None = None  #: the preset that this started from
    iterations: int = 7_000
    seed: int = 0
    views_per_step: int = 1  #: whose mean gradient a step follows; the thesis takes one
    init_count: int = 20_000  #: Gaussians at the start, at most
    sh_degree: int = 3
    sh_every: int = 1_000  #: iterations after which one more degree of spherical harmonics joins
    ssim_weight: float = 0.2  #: lambda of thesis 2.8
    random_background: bool = True  #: train against alpha; False: over black, as the thesis
    antialiased: bool = False  #: with Mip-Splatting's 2D filter, in training and in the run's pictures; see `project`
    supersample: int = 1  #: places on a side of each pixel, whose mean light it is, in training and the run's pictures
    light: LightConfig | None = None  #: how the Sun makes colours; None for `vanilla`, whose colours are fixed
    visibility_weight: float = 0.0  #: of the mean error of blended visibility against the path-traced one
    isotropy_weight: float = 0.0  #: of the scales' mean distance from a Gaussian's mean scale, per scene scale (`park`)
    opacity_weight: float = 0.0  #: of the mean opacity (`mcmc`)
    scale_weight: float = 0.0  #: of the mean scale, per scene scale (`mcmc`)
    flatten_weight: float = 0.0  #: of the mean shortest scale, per scene scale: Gaussians become discs
    depth_weight: float = 0.0  #: of the depth's mean error, per scene scale; see `depth_loss`
    normal_weight: float = 0.0  #: of 1 less the cosine between normals; see `normal_loss`
    prior: str = "truth"  #: truth or mesh: whose depth and normals these are
    warm_start: WarmStartConfig | None = None  #: foreground attraction (thesis 5.3); None for none
    init_box: float | None = None  #: side of the cube that `random` fills, in sizes of the object
    checkpoint_every: int = 1_000  #: iterations
    rates: LearningRates = field(default_factory=LearningRates)
    refinement: DefaultStrategyConfig = field(default_factory=DefaultStrategyConfig)  #: of every strategy
    mesh_aware: MeshAwareConfig = field(default_factory=MeshAwareConfig)  #: beside it, of that strategy alone
    support_aware: SupportAwareConfig = field(default_factory=SupportAwareConfig)
    mcmc: McmcConfig = field(default_factory=McmcConfig)

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES:
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"--{name}: expected one of {', '.join(filter(None, allowed))}, found {getattr(self, name)!r}"
                )
        if self.init is not None and self.init not in INITS:
            raise InputError(f"--init: expected one of {', '.join(INITS)}, found {self.init!r}")
        if self.init_box is not None and not 0 < self.init_box <= LARGEST_BOX:
            raise InputError(f"--init-box: expected a number above 0, at most {LARGEST_BOX:g}, found {self.init_box}")
        if self.init_box is not None and self.init != "random":
            raise InputError(f"--init-box: expected --init random, found {self.init}")
        if self.iterations < 1:
            raise InputError(f"--iterations: expected at least 1, found {self.iterations}")
        if not 1 <= self.views_per_step <= MOST_VIEWS:
            raise InputError(f"--views-per-step: expected 1 to {MOST_VIEWS}, found {self.views_per_step}")
        if self.init_count < 1:
            raise InputError(f"--init-count: expected at least 1, found {self.init_count}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"--sh-degree: expected 0 to 3, found {self.sh_degree}")
        if not 1 <= self.supersample <= MOST_PLACES:
            raise InputError(f"--supersample: expected 1 to {MOST_PLACES}, found {self.supersample}")
        if self.seed < 0:
            raise InputError(f"--seed: expected 0 or more, found {self.seed}")
        if (self.light is None) != (self.method == "vanilla"):
            raise InputError(f"--method {self.method}: expected a configuration of light for all but vanilla")
        for name in WEIGHTS:
            if not 0 <= getattr(self, name) < float("inf"):
                option = "flatten" if name == "flatten_weight" else name.replace("_", "-")
                raise InputError(f"--{option}: expected 0 or more, found {getattr(self, name)}")
        check_ranges(self, iterations=(1, MOST_STEPS), sh_every=(1, MOST_STEPS), checkpoint_every=(1, MOST_STEPS))
        check_ranges(self, ssim_weight=(0, 1), seed=(0, 2**63), **{name: (0, MOST_WEIGHT) for name in WEIGHTS})
        if self.visibility_weight > 0 and not (self.light and self.light.shadow):
            raise InputError(f"--visibility-weight: expected a method with shadows, found {self.method}")

    @property
    def shape_terms(self) -> tuple[str, ...]:
        """Which of depth and normals are told to training."""
        weights = {"depth": self.depth_weight, "normal": self.normal_weight}
        return tuple(name for name, weight in weights.items() if weight > 0)

    def to_json(self) -> dict[str, Any]:
        """Plain values for config.json; of the strategies' own configurations the one that counts."""
        others = {strategy.replace("-", "_") for strategy in STRATEGIES} - {self.strategy.replace("-", "_")}
        return {name: value for name, value in asdict(self).items() if name not in others}

    @staticmethod
    def from_json(values: dict[str, Any], name: str = "config.json") -> "TrainConfig":
        """The inverse of `to_json`; missing keys have their defaults, and the key data, which a run's config.json has
        besides, is passed over. name: of the file, for messages. Raises InputError for a key that is not known and for
        a value that cannot be."""
        own = {key: value for key, value in values.items() if key != "data"}
        return structure(TrainConfig, Document(name, own, {}), Rules())


def preset(name: str, method: str = "vanilla", strategy: str = "default") -> TrainConfig:
    """`thesis`: the schedule of section 4.3.6 and tables 4.1 to 5.1 as they stand; `fast`: half a minute on a GPU,
    minutes on two CPU cores; `fine`: the most exact light that we know, minutes on a GPU; `demo`: a minute on two
    CPU cores.

    All but the first are for pictures of some hundred pixels. Table 5.1 splits what is wider than a hundredth of the
    picture: at 256 pixels that is every splat, and the maximum of 250,000 is reached for nothing (docs/performance.md).
    Raises InputError for another name, method or strategy.
    """
    if name not in PRESETS:
        raise InputError(f"--preset: expected one of {', '.join(PRESETS)}, found {name!r}")
    if method not in METHODS:
        raise InputError(f"--method: expected one of {', '.join(METHODS)}, found {method!r}")
    light = None if method == "vanilla" else _light(name, method)
    isotropy = ISOTROPY if method == "park" else 0.0
    penalty = MCMC_PENALTY if strategy == "mcmc" else 0.0
    config = replace(_schedule(name), method=method, light=light, isotropy_weight=isotropy, strategy=strategy)
    config = replace(config, opacity_weight=penalty, scale_weight=penalty)
    if light is None or name == "thesis":
        return config  # a vanilla run's PLY is for other viewers, too, which have no such filter
    refinement = replace(config.refinement, split_screen_size=LIT_SCREEN_SIZES[name])
    if name != "fine":
        return replace(config, antialiased=True, refinement=refinement)
    return replace(config, antialiased=True, supersample=2, refinement=replace(refinement, prune_opacity=FINE_OPACITY))


def warm_start(name: str) -> WarmStartConfig:
    """Of a preset: `thesis` as in table 5.7, the others shorter, as their training is (chosen)."""
    if name == "thesis":
        return WarmStartConfig()
    if name in ("fast", "fine"):
        return WarmStartConfig(steps=1_000, decay=1_000, conservative=500)
    return WarmStartConfig(steps=500, decay=500, conservative=250)


def _schedule(name: str) -> TrainConfig:
    if name == "thesis":
        return TrainConfig(
            preset=name,
            iterations=200_000,
            init_count=50_000,
            checkpoint_every=5_000,
            refinement=DefaultStrategyConfig(refine_stop=150_000, screen_size_stop=150_000),
        )
    gentle = DefaultStrategyConfig(prune_screen_size=0.5, split_screen_size=0.1)
    if name in ("fast", "fine"):
        refinement = replace(gentle, refine_stop=5_000)
        mesh_aware = MeshAwareConfig(cull_every=500, exterior_margin=MARGIN)
        iterations = 7_000 if name == "fast" else 20_000
        return TrainConfig(preset=name, iterations=iterations, refinement=refinement, mesh_aware=mesh_aware)
    return TrainConfig(
        preset=name,
        iterations=3_000,
        init_count=8_000,
        sh_every=600,
        refinement=replace(gentle, refine_start=300, refine_stop=2_000, pause_after_reset=0),
        mesh_aware=MeshAwareConfig(cull_every=500, exterior_margin=MARGIN, min_gaussians=8_000),
        support_aware=SupportAwareConfig(warm_up=300, backfill_start=400, min_gaussians=8_000),
    )


def _light(name: str, method: str) -> LightConfig:
    """Networks and shadows of a preset: `thesis` as in tables 4.1 to 4.3; the others smaller, and with what we
    found better (docs/relighting.md, docs/ablations.md)."""
    sizes = {"thesis": (128, 256, 1024), "fast": (32, 64, 512), "fine": (32, 64, 1024), "demo": (16, 64, 256)}
    features, width, image = sizes[name]
    if method != "shadow-map" and name in ("demo", "fast"):
        image *= 2  # splatting reads whole pixels
    if method == "park":
        encoding = Encoding("positional", 4)
        field = FieldConfig(72 if name == "thesis" else features, width, 3, encoding, encoding)
        refine = RefineConfig(width=32, sun=encoding, positions="world", positional=4, bias_info=False)
        return LightConfig(field, ShadowConfig("splatting", image, bias=0.0, refine=refine))
    field = with_field(FieldConfig(features, width), "thesis" if name == "thesis" else "surface")
    if method == "relight":
        return LightConfig(field)
    kind = "mapping" if method == "shadow-map" else "splatting"
    if name == "thesis":
        return LightConfig(field, ShadowConfig(kind, image))
    shadow = ShadowConfig(kind, image, bias=5.0, grazing="both", refine=SUNLESS)
    if kind == "mapping":
        shadow = replace(shadow, mapping=MappingConfig("variance" if name == "fine" else "median"))
    return LightConfig(field, shadow, bounce=EMITTERS[name])


def with_field(field: FieldConfig, kind: str) -> FieldConfig:
    """The field told what the thesis tells it, which of `park` is its own encoding, or the cosines about a learned
    normal in place of the directions."""
    if kind == "thesis" and not field.surface:
        return field
    encoding = Encoding("harmonics", 0 if kind == "surface" else 4)
    return replace(field, surface=kind == "surface", sun=encoding, view=encoding)


def with_options(config: TrainConfig, **options: Any) -> TrainConfig:
    """`config` with the options that are not None put in."""
    return replace(config, **{name: value for name, value in options.items() if value is not None})
