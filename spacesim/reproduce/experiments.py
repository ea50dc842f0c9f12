"""What has to be done for each table and figure: datasets, and independent experiments, which tables share."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from spacesim import methods
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping, JsonValue
from spacesim.data.structure import did_you_mean
from spacesim.reproduce.size import Size
from spacesim.reproduce.thesis import Row, Table, thesis
from spacesim.splat.train.config import TrainConfig, preset, with_options, with_settings
from spacesim.splat.train.config import warm_start as warm_start_of
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.warm_start import WarmStartConfig

Variant = Literal["thesis", "improved"]
VARIANTS: tuple[Variant, ...] = ("thesis", "improved")  #: ours as the thesis has it, and as we have it

FIGURES: Mapping[str, str] = {
    "figure-3.2": "Rendering time comparison between NeRF and 3DGS methods.",
    "figure-4.2": "Appearance field-based dynamic relighting with a single 3DGS model.",
    "figure-4.3": "Photometric and spatial reconstruction, fixed-illumination-trained and relightable 3DGS models.",
    "figure-4.4": "Photometric and spatial reconstruction, fixed-illumination-trained and relightable 3DGS models.",
    "figure-5.5": "Share of Gaussians inside the true mesh, nominal and warm-started random initialization.",
    "figure-6.1": "Heat map of Hubble training camera density.",
    "figure-6.2": "Hubble model relighting showcase.",
}
SUN = (45.0, 35.0)  #: azimuth and elevation, degrees, of tables 4.6 and 4.7
PLACES = {"first": (0.0, 0.0, 0.0), "second": (-3.0, -3.0, -3.0)}  #: metres, of the pair (section 4.3.6)
BOX = 10.0  #: sizes of the object, of the cube that figure 5.5 starts in
NEVER = 10**9
RELIGHTABLE, FIXED, FIELD = "relight", "one-sun", "one-sun-nerf"
VANILLA, FULLY_LIT, TELESCOPE = "vanilla", "vanilla-fully-lit", "telescope"


@dataclass(frozen=True)
class Experiment:
    """A training and what is made of it: its folder's name, data and configuration."""

    name: str  #: of its folder
    data: str  #: name of the dataset
    config: methods.Config  #: of the training
    #: "own", "pair" and "one-sun" evaluate against these data, "suns" draws one view under many Suns, "frames" times
    #: frames of several models
    parts: tuple[str, ...] = ()
    fully_lit: bool = False  #: trained on the views whose camera is near the Sun alone


@dataclass(frozen=True)
class Curve:
    """A training whose Gaussians are counted over its first steps (figure 5.5)."""

    name: str  #: of its folder
    config: TrainConfig  #: of the training
    data: str = "one-sun"  #: name of the dataset


Work = Experiment | Curve


def parts_known() -> tuple[str, ...]:
    """Names of all tables and figures."""
    return (*(table.number for table in thesis().tables), *FIGURES)


def check_parts(wanted: Sequence[str]) -> tuple[str, ...]:
    """The wanted tables and figures in their order, all where none is named. Raises InputError for another name."""
    known = parts_known()
    for name in wanted:
        if name not in known:
            expected = f"tables: expected some of {', '.join(known)}"
            raise InputError(f"{expected}, found {name!r}{did_you_mean(name, known)}")
    return tuple(name for name in known if not wanted or name in wanted)


def data_of(size: Size) -> dict[str, tuple[str, JsonDict]]:
    """{name of a dataset: (scene, options of `read_scene`)}."""
    common = {"resolution": size.resolution, "spp": size.spp, "test_spp": size.test_spp}
    suns = {"suns": size.suns, "views": size.views, "test_suns": size.test_suns, "test_views": size.test_views}
    shared = {"known_test_views": size.known_test_views, "shared_test_views": True}
    one = {"sun": [SUN], "test_suns": 0}
    telescope = {"suns": size.telescope_suns, "views": size.telescope_views, "test_suns": 0}
    return {
        "boxsat": ("boxsat", {**common, **suns, **shared}),
        "pair": ("boxsat-pair", {**common, **one, "views": 1, "test_views": size.pair_views}),
        "one-sun": ("boxsat", {**common, **one, "views": size.one_sun_views, "test_views": size.one_sun_test_views}),
        "telescope": ("telescope", {**common, **telescope, "test_views": 2, "shared_test_views": True}),
    }


def datasets_for(size: Size, parts: Iterable[str], work: Iterable[Work]) -> list[str]:
    """Names of the datasets that the tables and figures and their experiments need."""
    needed = {"telescope"} if "figure-6.1" in parts else set()
    for one in work:
        needed |= {one.data, *(one.parts if isinstance(one, Experiment) else ())}
    return [name for name in data_of(size) if name in needed]


def experiments_for(size: Size, parts: Iterable[str], seeds: int) -> list[Work]:
    """What the tables and figures need, each once: first what the thesis has, cheap and dear, then ours."""
    works: dict[str, Work] = {}
    for part in parts:
        for one in _of_part(size, part, seeds):
            before = works.get(one.name)
            if isinstance(one, Experiment) and isinstance(before, Experiment):
                one = replace(one, parts=tuple(dict.fromkeys((*before.parts, *one.parts))))
            works[one.name] = one
    return list(works.values())


def _of_part(size: Size, part: str, seeds: int) -> list[Work]:
    tables = {table.number: table for table in thesis().tables}
    if part in tables:
        table = tables[part]
        return [
            experiment_of(size, table, row, variant, seed)
            for seed in range(seeds)
            for variant in VARIANTS
            for row in table.rows
        ]
    if part == "figure-3.2":
        return figure_frames(size)
    if part == "figure-4.2":
        return figure_relighting(size)
    if part in ("figure-4.3", "figure-4.4"):
        return figure_fixed_sun(size)
    if part == "figure-5.5":
        return list(curves(size))
    return [telescope(size)] if part == "figure-6.2" else []


def preset_of(size: Size, table: Table, variant: Variant) -> str:
    """The preset of a column of a table."""
    return "thesis" if variant == "thesis" else size.light if table.number.startswith("4") else size.strategies


def experiment_of(size: Size, table: Table, row: Row, variant: Variant, seed: int = 0) -> Experiment:
    """What fills a row of a table."""
    name = preset_of(size, table, variant)
    made = _trained(size, name, row.method, row.strategy, (table.scene,), seed)
    most = "refinement.max_gaussians"
    if name != size.strategies or table.number.startswith("4") or most in size.settings:
        return made
    unbound = methods.with_settings(made.config, {most: DensificationConfig().max_gaussians})
    return replace(made, config=unbound)  # at the preset's all strategies would end


def figure_frames(size: Size) -> list[Work]:
    """Figure 3.2: Gaussians and a radiance field, trained on the same data."""
    config = methods.shortened(methods.preset(size.nerf, "nerf"), size.iterations)
    field = Experiment(FIELD, "one-sun", _with_settings(size.settings, config), ("frames",))
    return [_fixed_sun(size, "frames"), field]


def figure_relighting(size: Size) -> list[Work]:
    """Figure 4.2: models with the Sun as input, without it, and trained on views with the Sun behind them alone."""
    relit: list[Work] = [_trained(size, name, "relight", parts=("suns",)) for name in ("thesis", size.light)]
    vanilla = _trained(size, "thesis", "vanilla", parts=("own", "suns"))
    return [*relit, replace(vanilla, name=VANILLA), replace(vanilla, name=FULLY_LIT, fully_lit=True)]


def figure_fixed_sun(size: Size) -> list[Work]:
    """Figures 4.3 and 4.4: a model trained under one Sun, and models with the Sun as input."""
    relit: list[Work] = [_trained(size, name, "relight", parts=("one-sun",)) for name in ("thesis", size.light)]
    return [_fixed_sun(size, "one-sun"), *relit]


def telescope(size: Size) -> Experiment:
    """Figure 6.2, on the schedule of section 6.2.2."""
    made = _trained(size, "thesis", "shadow-map", parts=("own", "suns"))
    stop = {"iterations": size.telescope_iterations, "refinement.refine_stop": size.telescope_iterations * 4 // 5}
    return replace(made, name=TELESCOPE, data="telescope", config=methods.with_settings(made.config, stop))


def curves(size: Size) -> list[Curve]:
    """Figure 5.5: without a warm start, with the thesis's, with ours; without culling and densification."""
    base = preset("thesis", "vanilla", "support-aware")
    still = {"refinement.refine_start": NEVER - 1, "refinement.refine_stop": NEVER}
    random = {"init": "random", "init_box": BOX, "init_count": size.figure_gaussians}
    base = with_settings(base, {**still, **random, "checkpoint_every": max(size.figure_steps // 5, 1)})
    table, share = warm_start_of("thesis"), min(1.0, size.figure_steps / 5_000)

    def lasting(one: WarmStartConfig) -> WarmStartConfig:
        return replace(one, steps=int(share * table.steps), decay=int(share * table.decay))

    starts = {
        "nominal": None,
        "warm-start-thesis": lasting(table),
        "warm-start-improved": lasting(warm_start_of(size.strategies)),
    }
    return [Curve(f"figure-5.5-{name}", replace(base, warm_start=start)) for name, start in starts.items()]


def _trained(
    size: Size,
    name: str,
    method: str,
    strategy: str = "default",
    parts: tuple[str, ...] = (),
    seed: int = 0,
) -> Experiment:
    """A training on the boxsat under many Suns."""
    config = _config_of(name, method, strategy, size.iterations, tuple(size.settings.items()))
    words = [name, method, *([] if strategy == "default" else [strategy]), *([f"seed-{seed}"] if seed else [])]
    return Experiment("-".join(words), "boxsat", replace(config, seed=config.seed + seed), parts)


@cache
def _config_of(
    name: str, method: str, strategy: str, iterations: int, settings: tuple[tuple[str, JsonValue], ...]
) -> methods.Config:
    """Made once: a page of results asks for it in each of its cells."""
    return _with_settings(dict(settings), with_options(preset(name, method, strategy), iterations=iterations))


def _fixed_sun(size: Size, part: str) -> Experiment:
    """Gaussians as the thesis has them, trained under one Sun."""
    return replace(_trained(size, "thesis", "vanilla", parts=(part,)), name=FIXED, data="one-sun")


def _with_settings(settings: JsonMapping, config: methods.Config) -> methods.Config:
    return methods.with_settings(config, {key: value for key, value in settings.items() if _has(config, key)})


def _has(config: methods.Config, key: str) -> bool:
    """Whether there is the field of a dotted name: `vanilla` has no light, and each strategy has its own."""
    record = config
    for name in key.split("."):
        if not hasattr(record, name):
            return False
        record = getattr(record, name)
    return True
