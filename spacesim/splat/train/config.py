"""How to train: one frozen record, its presets (assets/presets/*.toml), and settings by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

from spacesim.data.errors import InputError, check_ranges
from spacesim.data.files import JsonDict, JsonMapping
from spacesim.data.structure import Rules, alternatives, check_fields, check_first_key, did_you_mean, plain, structure
from spacesim.data.toml import Document, read_document
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.shadow.cast import SplattingConfig
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.raster.supersample import MAX_SUPERSAMPLE
from spacesim.splat.train.old_config import ALIASES, in_this_layout
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.strategies.default import DefaultStrategyConfig
from spacesim.splat.train.strategies.mcmc import McmcConfig
from spacesim.splat.train.strategies.mesh_aware import MeshAwareConfig
from spacesim.splat.train.strategies.strategy import MAX_STEPS
from spacesim.splat.train.strategies.support_aware import SupportAwareConfig
from spacesim.splat.train.warm_start import WarmStartConfig

Method = Literal["vanilla", "relight", "shadow-map", "shadow-splat", "baseline-park"]
Preset = Literal["demo", "fast", "fine", "thesis"]
Init = Literal["mesh", "points", "random"]
StrategyConfig = DefaultStrategyConfig | MeshAwareConfig | SupportAwareConfig | McmcConfig

METHODS: tuple[str, ...] = get_args(Method)
PRESETS: tuple[str, ...] = get_args(Preset)
STRATEGIES = tuple(alternatives(StrategyConfig))
ASSETS = Path(__file__).parents[2] / "assets" / "presets"
MAX_VIEWS = 64  #: of a step: one kernel reads the gradients of all; for 64 two cores compile about 11 s
MAX_LEARNING_RATE, MAX_LOSS_WEIGHT = 1e3, 1e6  #: of learning rates and of weights in the loss
MAX_BOX = 1e6  #: of `init_box`
MOST_DOWNSCALES = 4  #: halvings of a picture: a pixel then is the mean of 256
WEIGHTS = (
    "visibility_weight",
    "isotropy_weight",
    "opacity_weight",
    "scale_weight",
    "depth_weight",
    "normal_weight",
)


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes; those of the Gaussians are splatfacto's. Those of the means, the features and the networks
    fall as `decay` says; that of the means is per metre of scene scale."""

    #: how step sizes of means, features and networks fall: by the same factor each step, or as 1 - t^2, t from 0 at the
    #: start to 1 at the end, by which they stay large for longer
    decay: Literal["exponential", "quadratic"] = "exponential"
    means: float = 1.6e-4  #: of the centres, at the start
    means_final: float = 1.6e-6  #: of the centres, at the end
    #: times `means` where Gaussians start on a mesh or at points, with no warm start, and poses and Suns are known
    surface_start: float = 1.0
    log_scales: float = 5e-3  #: of the scales' logarithms
    quaternions: float = 1e-3  #: of the rotations
    logit_opacities: float = 5e-2  #: of the opacities' logits
    sh_constant: float = 2.5e-3  #: of the constant term of spherical harmonics
    sh_rest: float = 1.25e-4  #: of their other terms
    #: of what each Gaussian has for the networks of light, and of the pictures' embeddings, at the start
    features: float = 2e-2
    features_final: float = 2e-2  #: of the Gaussians' features, at the end; the embeddings' falls as the networks' does
    networks: float = 3e-3  #: of their weights, at the start
    networks_final: float = 3e-4  #: of their weights, at the end
    #: of the pictures' poses (`refine_poses`), radians and shares of the distance, at first; falls to a hundredth
    poses: float = 5e-3
    #: of the pictures' Suns (`sun = "unknown"`), radians, at the start; falls to a hundredth
    suns: float = 2e-2
    #: of the logarithms of the pictures' gains (`exposure_per_picture`), at the start; falls to a hundredth
    gains: float = 5e-2

    def __post_init__(self) -> None:
        check_fields(self)
        for f in fields(self):
            if f.name != "decay":
                check_ranges(self, **{f.name: (0, MAX_LEARNING_RATE)})

    def between(self, start: float, final: float, done: float) -> float:
        """A step size that falls from `start` to `final`, after a share `done` of the steps in which it does. What
        starts at 0 stays there."""
        if start == 0:
            return 0.0
        if self.decay == "quadratic":
            return final + (start - final) * (1 - done**2)
        return float(start ** (1 - done) * final**done)


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a trained model, apart from the data and the backend. `light` implies the method."""

    #: what makes colours: fixed ones, or light: without shadows, by shadow maps, by shadow splatting, or as table 4.3
    method: Method = field(init=False, repr=False, default="vanilla")
    preset: Preset | None = None  #: the preset that this started from
    init: Init | None = None  #: where Gaussians start; none takes the first of points, mesh, random that can be had
    iterations: int = 7_000  #: steps of training
    seed: int = 0  #: random seed: same seed, same bits
    views_per_step: int = 1  #: views whose mean gradient a step follows; the thesis takes one
    init_count: int = 20_000  #: Gaussians at the start, at most, and no more than refinement.max_gaussians
    splatfacto_start: bool = False  #: turned at random; `random` fills 10 scene scales, in greys: as splatfacto starts
    sh_degree: int = 3  #: of spherical harmonics, of `vanilla`; 0 to 3
    sh_every: int = 1_000  #: iterations after which one more degree of spherical harmonics joins; 0: all at once
    ssim_weight: float = 0.2  #: share of D-SSIM in the loss beside L1, lambda of thesis 2.8
    random_background: bool = True  #: each step over another colour, by alpha; false: over black, as 2.16 is printed
    random_behind_opaque: bool = False  #: also behind pictures without alpha, as splatfacto: their sky is modelled, too
    num_downscales: int = 0  #: training begins with pictures smaller by 2 to this power on a side; splatfacto's is 2
    resolution_schedule: int = 3_000  #: steps after which they are twice as large on a side, up to their own size
    antialiased: bool = False  #: with Mip-Splatting's 2D filter, in training and in the run's pictures
    surfels: bool = False  #: Gaussians are discs; the first axis is their normal
    supersample: int = 1  #: places on a side of each pixel, whose mean light it is, in training and the run's pictures
    light: LightConfig | None = None  #: how the Sun makes colours; none for `vanilla`, whose colours are fixed
    #: of methods of light: Gaussians that weigh no more in any pixel of a view are black and in shadow in its step, and
    #: learn neither from it, so that networks leave them out. 0 changes no picture: fields of 128 units and more leave
    #: out what weighs nothing, narrower ones none; on CUDA these, for which it takes as long, never do. Counts as
    #: `refinement.prune_opacity` at most, half of what a reset of opacities leaves
    hidden_weight: float = 0.0
    visibility_weight: float = 0.0  #: weight in the loss: mean error of blended visibility against the path-traced one
    isotropy_weight: float = 0.0  #: weight: mean distance of the scales from a Gaussian's mean scale, per scene scale
    opacity_weight: float = 0.0  #: weight: mean opacity (`mcmc`)
    scale_weight: float = 0.0  #: weight: mean scale, per scene scale (`mcmc`)
    depth_weight: float = 0.0  #: weight: mean error of the depth, per scene scale
    normal_weight: float = 0.0  #: weight: 1 less the cosine between normals
    prior: Literal["truth", "mesh"] = "truth"  #: whose depth and normals these compare with: traced ones, or mesh.ply's
    warm_start: WarmStartConfig | None = None  #: pull Gaussians to the foreground before densification (thesis 5.3)
    init_box: float | None = None  #: side of the cube that `random` fills, in sizes of the object
    checkpoint_every: int = 1_000  #: iterations between two checkpoints
    #: where the pictures' Suns come from: the data, or estimated with the model
    sun: Literal["given", "unknown"] = "given"
    refine_poses: bool = False  #: move the cameras of training pictures to where these fit the model
    exposure_per_picture: bool = (
        False  #: learn a gain of each channel for each training picture: exposure, white balance
    )
    means_steps: int | None = None  #: in which the centres' step size falls; none: in the whole training
    rates: LearningRates = field(default_factory=LearningRates)  #: step sizes
    #: schedule and rules of every strategy
    refinement: DensificationConfig = field(default_factory=DensificationConfig)
    strategy: StrategyConfig = field(default_factory=DefaultStrategyConfig)  #: chooses what grows and what is pruned

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "method", _method_of(self.light))
        if self.init_box is not None and not 0 < self.init_box <= MAX_BOX:
            raise InputError(f"init_box: expected a number above 0, at most {MAX_BOX:g}, found {self.init_box}")
        if self.init_box is not None and self.init != "random":
            raise InputError(f"init_box: expected init=random beside it, found {self.init or 'none'}")
        for name in ("iterations", "init_count"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, found {getattr(self, name)}")
        for name in ("seed", *WEIGHTS):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, found {getattr(self, name)}")
        check_ranges(self, views_per_step=(1, MAX_VIEWS), sh_degree=(0, 3), supersample=(1, MAX_SUPERSAMPLE))
        check_ranges(self, iterations=(1, MAX_STEPS), sh_every=(0, MAX_STEPS), checkpoint_every=(1, MAX_STEPS))
        check_ranges(self, num_downscales=(0, MOST_DOWNSCALES), resolution_schedule=(1, MAX_STEPS))
        if self.means_steps is not None:
            check_ranges(self, means_steps=(1, MAX_STEPS))
        check_ranges(
            self,
            ssim_weight=(0, 1),
            hidden_weight=(0, 1),
            seed=(0, 2**63),
            **{name: (0, MAX_LOSS_WEIGHT) for name in WEIGHTS},
        )
        if self.sun == "unknown" and not (self.light and self.light.field.knows_sun):
            raise InputError(f"sun: expected a method that takes the Sun, as shadow-map, found {self.method}")
        if self.visibility_weight > 0 and not (self.light and self.light.shadow):
            raise InputError(f"visibility_weight: expected a method with shadows, found {self.method}")
        if self.prior == "mesh" and not self.shape_terms:
            expected = "depth_weight or normal_weight above 0, which say how much of it counts"
            raise InputError(f"prior: expected {expected}, found neither")

    @property
    def shape_terms(self) -> tuple[str, ...]:
        """Which of depth and normals supervise training."""
        weights = {"depth": self.depth_weight, "normal": self.normal_weight}
        return tuple(name for name, weight in weights.items() if weight > 0)

    def penalty_weights(self, unit: float) -> dict[str, float]:
        """Of the penalties on Gaussians that there are, see `loss.terms.penalty`. unit: of length, metres"""
        weights = {
            "isotropy": self.isotropy_weight / unit,
            "scale": self.scale_weight / unit,
            "opacity": self.opacity_weight,
        }
        return {name: weight for name, weight in weights.items() if weight > 0}

    @property
    def refine_stop(self) -> int:
        """Iterations after which Gaussians stay as many: what densification leaves is trained."""
        stop = self.refinement.refine_stop
        return stop if stop < self.iterations else 3 * self.iterations // 4

    @property
    def holds_sizes(self) -> bool:
        """Whether no Gaussian gets larger than those that `refinement` splits: not of a strategy that splits by other
        rules (`reads`), nor in a training too short to split any."""
        if self.refinement.split_screen != "held" or hasattr(self.strategy, "reads"):
            return False
        refinement = replace(self.refinement, refine_stop=self.refine_stop)
        return any(refinement.refines_at(step) for step in range(0, self.refine_stop, refinement.refine_every))

    def degree(self, step: int) -> int:
        """Of the harmonics that are drawn at `step`, the first of which is 0."""
        return min(self.sh_degree, step // self.sh_every) if self.sh_every else self.sh_degree

    def downscale(self, step: int) -> int:
        """How many pixels of a picture make one, on a side, at `step`, the first of which is 0 (as splatfacto)."""
        return 1 << max(self.num_downscales - step // self.resolution_schedule, 0)

    def to_json(self) -> JsonDict:
        """Plain values for config.json."""
        values: JsonDict = plain(self)
        if self.light and self.light.shadow:
            values["light"]["shadow"]["method"].pop("baseline", None)  # `method` implies it
        return values

    @staticmethod
    def from_json(values: JsonMapping, name: str = "config.json") -> "TrainConfig":
        """The inverse of `to_json`; missing keys have their defaults, or what `old_config` says of runs that had none,
        and the key data, which a run's config.json has besides, is passed over. name: of the file, for messages. Raises
        InputError for a key that is not known and for a value that cannot be."""
        settings = {key: value for key, value in values.items() if key != "data"}
        return _read(Document(name, in_this_layout(settings), {}), Rules())


def _method_of(light: LightConfig | None) -> Method:
    """The method whose light this is."""
    if light is None:
        return "vanilla"
    if light.shadow is None:
        return "relight"
    if isinstance(light.shadow.method, MappingConfig):
        return "shadow-map"
    return "baseline-park" if light.shadow.method.baseline else "shadow-splat"


_LIGHTS: dict[Method, str] = {
    "vanilla": "none",
    "relight": "light without shadows",
    "shadow-map": "shadow mapping",
    "shadow-splat": "shadow splatting",
    "baseline-park": "shadow splatting as table 4.3 has it",
}
"""The light of each method, in words."""


@dataclass(frozen=True)
class _Named:
    """What files say beside the light, which implies it, too."""

    method: Method = "vanilla"


def _read(document: Document, rules: Rules) -> TrainConfig:
    """The configuration that a document says. Raises InputError, also where its light is not that of its method."""
    values = dict(document.values)
    named = {"method": values.pop("method")} if "method" in values else {}
    method = structure(_Named, replace(document, values=named), rules).method
    config = structure(TrainConfig, replace(document, values=values), rules)
    light = config.light
    if method == "baseline-park" and light and light.shadow and isinstance(light.shadow.method, SplattingConfig):
        shadow = replace(light.shadow, method=replace(light.shadow.method, baseline=True))
        config = replace(config, light=replace(light, shadow=shadow))
    if config.method != method:
        expected = f"{_LIGHTS[method]}, which is the method {method}'s"
        raise InputError(f"{document.label(('light',))}: expected {expected}, found {_LIGHTS[config.method]}")
    return config


def preset(name: str, method: str = "vanilla", strategy: str = "default") -> TrainConfig:
    """What a file of assets/presets says of a method and a strategy: `thesis`, the thesis's own schedule and networks;
    `fast`, `fine` and `demo`, which are for pictures of some hundred pixels; two CPU cores take `demo`.

    name: "demo", "fast", "fine", "thesis"
    method: "vanilla", "relight", "shadow-map", "shadow-splat", "baseline-park"
    strategy: "default", "mesh-aware", "support-aware", "mcmc"
    Raises InputError for another name, method or strategy. docs/how-to/choose.md says which to take.
    """
    method = ALIASES.get(method, method)
    choices = ("preset", name, PRESETS), ("method", method, METHODS), ("strategy", strategy, STRATEGIES)
    for what, word, words in choices:
        if word not in words:
            raise InputError(f"{what}: expected one of {', '.join(words)}, found {word!r}{did_you_mean(word, words)}")
    sections = _sections(name)
    values = merged(sections["all"], sections["methods"].get(method, {}))
    values = merged(values, sections["strategies"].get(strategy, {}))
    strategy_settings = {"kind": strategy, **values.get("strategy", {})}
    values |= {"preset": name, "method": method, "strategy": strategy_settings}
    return _read(Document(str(ASSETS / f"{name}.toml"), values, {}), Rules(none="none"))


def warm_start(name: str) -> WarmStartConfig:
    """Of a preset: `thesis` as in table 5.7, the others shorter, as their training is."""
    return structure(WarmStartConfig, Document(f"{name}.toml", _sections(name)["warm_start"], {}), Rules())


@cache
def _sections(name: str) -> JsonMapping:
    """The tables of a preset's file, over those of its base where it has one."""
    tables = dict(read_document(ASSETS / f"{name}.toml").values)
    base = tables.pop("base", None)
    return tables if base is None else merged(_sections(base), tables)


def merged(first: JsonMapping, second: JsonMapping) -> JsonDict:
    """Both tables in one: what only one has, and what both have as the second has it; tables within are merged, too."""
    result = dict(first)
    for key, value in second.items():
        before = result.get(key)
        result[key] = merged(before, value) if isinstance(before, Mapping) and isinstance(value, Mapping) else value
    return result


def with_options(config: TrainConfig, **options: Any) -> TrainConfig:
    """`config` with the options that are not None put in; fewer `iterations` shorten its schedule, see `shortened`."""
    options = {name: value for name, value in options.items() if value is not None}
    return replace(shortened(config, options.get("iterations", config.iterations)), **options)


def shortened(config: TrainConfig, iterations: int) -> TrainConfig:
    """`config` with so many iterations; where they are fewer, what waits for iterations waits for less.

    The end of densification keeps its share of the training, so that what it leaves is trained. What comes at the start
    (first densification step, pauses, harmonics, coarse pictures, warm start, what strategies wait for) shrinks by the
    same share, or to a twentieth of the training where that is longer. Learning rates follow the training's length by
    themselves, but for `means_steps`. Densification steps and opacity resets are as far apart as they were: both take
    the steps that they take. Where screen sizes cull nothing, being over with the pause after the first reset, they go
    on culling nothing. In a longer training nothing changes but for the steps that come last.
    """
    share = iterations / config.iterations
    if not 0 < share < 1:
        return replace(config, iterations=iterations)

    def beginning(record: object, *names: str) -> JsonDict:
        lengths = {name: getattr(record, name) for name in names}
        return {name: max(round(share * n), min(n, iterations // 20), min(n, 1)) for name, n in lengths.items()}

    refinement, strategy, warm = config.refinement, config.strategy, config.warm_start
    first_reset = refinement.reset_every * refinement.refine_every
    culls_by_screen = refinement.screen_size_stop > first_reset + refinement.pause_after_reset
    refinement = replace(
        refinement,
        **beginning(refinement, "refine_start", "pause_after_reset"),
        refine_stop=round(share * refinement.refine_stop),
    )
    if not culls_by_screen:
        over = first_reset + refinement.pause_after_reset
        refinement = replace(refinement, screen_size_stop=min(refinement.screen_size_stop, over))
    if isinstance(strategy, SupportAwareConfig):
        strategy = replace(strategy, **beginning(strategy, "warm_up", "backfill_start"))
    elif isinstance(strategy, MeshAwareConfig):
        strategy = replace(strategy, **beginning(strategy, "cull_every"))
    if warm is not None:
        warm = replace(warm, **beginning(warm, "steps", "decay", "conservative"))
    return replace(
        config,
        iterations=iterations,
        **beginning(config, "sh_every", "resolution_schedule"),
        refinement=refinement,
        strategy=strategy,
        warm_start=warm,
    )


def with_settings(config: TrainConfig, settings: JsonMapping) -> TrainConfig:
    """`config` with fields set by their dotted names: {"light.shadow.bias": 5, "light.shadow.refine": "none"}.

    A value is what config.json has for such a field; "none" is None where a field can be that, and the name of an
    alternative, as in {"light.field.inputs": "directions"}, stands for it with its defaults. Fewer `iterations` shorten
    the schedule, see `shortened`; other fields of it are put in after that. Raises InputError
    "light.shadow.bias: expected ..., found ..." for a name or a value that cannot be.
    """
    for name in settings:
        check_first_key(TrainConfig, name)
    iterations = settings.get("iterations")
    values = (shortened(config, iterations) if type(iterations) is int else config).to_json()
    depths = {name: name.count(".") - name.endswith(".kind") for name in settings}
    for name in sorted(settings, key=depths.__getitem__):  # what is chosen first, then what it has
        keys = name.split(".")
        table = values
        for depth, key in enumerate(keys[:-1], start=1):
            inner = table.setdefault(key, {})
            if not isinstance(inner, dict):
                first = ".".join(keys[:depth])
                if inner is None:
                    why = "" if keys[0] != "light" else f"; {first}={{}} puts it there with its defaults"
                    if first in ("light", "light.shadow"):
                        why = f" under the method {config.method}"
                    raise InputError(f"{name}: expected {first} to be there, found none{why}")
                raise InputError(f"{name}: expected {first} alone, which has no fields, found {name}")
            table = inner
        if keys[-1] == "kind" and table.get("kind", settings[name]) != settings[name]:
            table.clear()  # of another alternative
        table[keys[-1]] = _put(table.get(keys[-1]), settings[name])
    result = _read(Document("", values, {}), Rules(none="none"))
    reads: tuple[str, ...] | None = getattr(result.strategy, "reads", None)
    for name in settings:
        first, _, key = name.partition(".")
        if reads is not None and first == "refinement" and key and key not in reads:
            found = f"{result.strategy.kind}, which reads {', '.join(reads)} alone"
            raise InputError(f"{name}: expected a strategy that reads it, found {found}")
    return result


def _put(before: object, value: object) -> object:
    """What takes the place of the plain value `before` where `value` is asked for."""
    if not isinstance(before, dict):
        return value
    if isinstance(value, str) and "kind" in before:
        value = {"kind": value}  # the name of an alternative
    if not isinstance(value, Mapping) or value.get("kind", before.get("kind")) != before.get("kind"):
        return value
    return merged(before, value)
