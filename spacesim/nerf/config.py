"""How a radiance field is trained: one frozen record, its presets (assets/presets/nerf.toml), settings by name."""

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal, get_args

from spacesim.data.errors import InputError, check_ranges
from spacesim.data.files import JsonDict, JsonMapping
from spacesim.data.structure import Rules, check_fields, check_first_key, did_you_mean, plain, structure
from spacesim.data.toml import Document, read_document

Method = Literal["nerf", "nerf-relight"]
Preset = Literal["demo", "fast", "thesis"]
METHODS: tuple[str, ...] = get_args(Method)
PRESETS: tuple[str, ...] = get_args(Preset)
ASSET = Path(__file__).parents[1] / "assets" / "presets" / "nerf.toml"
CHUNK = 512  #: samples of which networks read a multiple, see `field.Columns`
MAX_STEPS, MAX_RAYS, MAX_SAMPLES, MAX_CELLS = 10_000_000, 2**20, 1024, 2**16


@dataclass(frozen=True)
class GridConfig:
    """A multi-resolution hash grid (Müller et al. 2022): two numbers at each vertex of each level."""

    levels: int = 8  #: resolutions
    coarsest: int = 16  #: cells along the box's longest side, of the first level
    #: of the last level, None: as many as pictures have pixels there, as finer ones overfit to each picture; those
    #: between grow by one factor
    finest: int | None = None
    log2_size: int = 15  #: vertices that a level stores at most, as a power of 2; beyond that they share by a hash

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, levels=(1, 32), coarsest=(1, 4096), log2_size=(4, 24))
        if self.finest is None:
            return
        check_ranges(self, finest=(1, MAX_CELLS))
        if self.finest < self.coarsest:
            raise InputError(f"finest: expected at least coarsest, {self.coarsest}, found {self.finest}")


@dataclass(frozen=True)
class ProposalConfig:
    """One of the two coarse density fields that say where samples are worth their cost."""

    samples: int = 32  #: of a ray
    width: int = 16  #: units of the hidden layer
    grid: GridConfig = field(default_factory=lambda: GridConfig(4, 8, 64, 13))  #: where it stores what it knows

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, samples=(2, MAX_SAMPLES), width=(1, 256))
        if self.grid.finest is None:
            raise InputError("grid: expected one whose finest level is given, found finest none, as the field's may be")


@dataclass(frozen=True)
class NerfShadowConfig:
    """How a field shadows itself: by what it lets through towards the Sun, along a second ray from each surface."""

    samples: int = 16  #: of that ray, of the field itself; 0: no shadows, only the colour depends on the Sun
    bias: float = 0.03  #: of the box's longest side: where that ray begins, so that a surface does not shadow itself

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, samples=(0, MAX_SAMPLES), bias=(0, 1))


@dataclass(frozen=True)
class NerfConfig:
    """Everything that decides a trained radiance field, apart from the data and the backend."""

    method: Method = "nerf"  #: whether colours depend on the Sun
    preset: Preset | None = None  #: the preset that this started from
    iterations: int = 2_000  #: steps of training
    seed: int = 0  #: random seed: same seed, same bits
    rays: int = 1_024  #: of a step; a multiple of 512
    samples: int = 16  #: of a ray, of the field itself
    width: int = 32  #: units of hidden layers
    features: int = 15  #: numbers of a point that the density network gives the colour network
    color_layers: int = 3  #: matrix products of the colour network
    harmonics: int = 3  #: degree of spherical harmonics of the view's direction
    #: what colours of `nerf-relight` are given of Sun and view: their directions, or cosines about a normal that each
    #: place learns, which serve Suns never seen
    inputs: Literal["directions", "surface"] = "surface"
    sun_harmonics: int = 1  #: of "directions", of the Sun's: more of them memorise training's few Suns
    shadow: NerfShadowConfig = field(default_factory=NerfShadowConfig)  #: of `nerf-relight`
    grid: GridConfig = field(default_factory=GridConfig)  #: what the field knows of places
    coarse: ProposalConfig = field(default_factory=ProposalConfig)  #: first round: reads evenly spaced samples
    fine: ProposalConfig = field(default_factory=lambda: ProposalConfig(16))  #: second: where the first saw density
    proposals_every: int = 4  #: steps after which proposals learn, once `warm_up` is over
    warm_up: int = 250  #: steps in which proposals learn each time and the whole box counts as filled
    occupancy: int = 32  #: cells along the box's longest side that are known as empty or not; a multiple of 8
    occupancy_every: int = 25  #: steps between two looks at these
    interlevel_weight: float = 1.0  #: in the loss: proposals that miss what the field has (Barron et al. 2022)
    distortion_weight: float = 0.002  #: in the loss: weights of a ray that lie apart (Barron et al. 2022)
    #: in the loss: normals that places learn against the slope of density (Verbin et al. 2022, equation 11)
    normal_weight: float = 0.01
    random_background: bool = True  #: each ray over another colour, by alpha; false: over black
    rate: float = 1e-2  #: Adam's step size at the start
    rate_final: float = 1e-3  #: at the end; it falls exponentially
    margin: float = 0.05  #: of the object's size, around it, that the box has
    checkpoint_every: int = 1_000  #: iterations between two checkpoints
    chunk: int = 8_192  #: rays that are drawn at once: bounds memory, changes no picture

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, iterations=(1, MAX_STEPS), seed=(0, 2**63), checkpoint_every=(1, MAX_STEPS))
        check_ranges(self, rays=(CHUNK, MAX_RAYS), chunk=(CHUNK, MAX_RAYS), samples=(2, MAX_SAMPLES), width=(1, 1024))
        check_ranges(
            self, features=(1, 256), color_layers=(2, 8), harmonics=(0, 6), sun_harmonics=(1, 6), occupancy=(4, 512)
        )
        check_ranges(self, proposals_every=(1, MAX_STEPS), warm_up=(0, MAX_STEPS), occupancy_every=(1, MAX_STEPS))
        check_ranges(
            self, interlevel_weight=(0, 1e6), distortion_weight=(0, 1e6), normal_weight=(0, 1e6), margin=(0, 10)
        )
        check_ranges(self, rate=(0, 10), rate_final=(0, 10))
        if self.occupancy % 8:
            raise InputError(f"occupancy: expected a multiple of 8, found {self.occupancy}")
        for name in ("rays", "chunk"):
            if getattr(self, name) % CHUNK:
                raise InputError(f"{name}: expected a multiple of {CHUNK}, found {getattr(self, name)}")

    @property
    def knows_sun(self) -> bool:
        """Whether colours depend on the Sun."""
        return self.method == "nerf-relight"

    @property
    def has_normals(self) -> bool:
        """Whether each place learns a normal."""
        return self.knows_sun and self.inputs == "surface"

    @property
    def casts_shadows(self) -> bool:
        """Whether colours are dimmed by what stands before the Sun."""
        return self.knows_sun and self.shadow.samples > 0

    @property
    def sun_samples(self) -> int:
        """Of a ray towards the Sun: of a field without shadows of its own as many as of any ray."""
        return self.shadow.samples if self.casts_shadows else self.samples

    @property
    def ray_bytes(self) -> int:
        """About as many bytes as a ray takes in a step of training; drawn, it takes half. By peaks seen on LLVM: 20 for
        each unit of a hidden layer and 72 for each level of the grid, of a sample; half of that of a proposal's."""
        sample = 20 * self.width * self.color_layers + 72 * self.grid.levels
        proposals = [one.samples * (10 * one.width + 36 * one.grid.levels) for one in (self.coarse, self.fine)]
        return self.samples * sample + sum(proposals)

    def to_json(self) -> JsonDict:
        """Plain values for config.json."""
        values: JsonDict = plain(self)
        return values

    @staticmethod
    def from_json(values: JsonMapping, name: str = "config.json") -> "NerfConfig":
        """The inverse of `to_json`; the key data, which a run's config.json has besides, is passed over. Raises
        InputError for a key that is not known and for a value that cannot be."""
        settings = {key: value for key, value in values.items() if key != "data"}
        return structure(NerfConfig, Document(name, settings, {}), Rules())


def preset(name: str, method: str = "nerf") -> NerfConfig:
    """What assets/presets/nerf.toml says: `thesis` has nerfacto's sizes (Tancik et al. 2023), `fast` and `demo` are for
    pictures of some hundred pixels on two CPU cores. Raises InputError for another name or method."""
    for what, word, words in (("preset", name, PRESETS), ("method", method, METHODS)):
        if word not in words:
            raise InputError(f"{what}: expected one of {', '.join(words)}, found {word!r}{did_you_mean(word, words)}")
    values = {**_sections()[name], "preset": name, "method": method}
    return structure(NerfConfig, Document(str(ASSET), values, {}), Rules())


@cache
def _sections() -> JsonMapping:
    return read_document(ASSET).values


def shortened(config: NerfConfig, iterations: int) -> NerfConfig:
    """`config` with so many iterations; where they are fewer, the warm-up shrinks by the same share."""
    share = min(iterations / config.iterations, 1)
    return replace(config, iterations=iterations, warm_up=round(share * config.warm_up))


def with_settings(config: NerfConfig, settings: JsonMapping) -> NerfConfig:
    """`config` with fields set by their dotted names: {"grid.levels": 12}. Fewer `iterations` shorten the warm-up.
    Raises InputError "grid.levels: expected ..., found ..." for a name or a value that cannot be."""
    for name in settings:
        check_first_key(NerfConfig, name)
    iterations = settings.get("iterations")
    values = (shortened(config, iterations) if type(iterations) is int else config).to_json()
    for name, value in settings.items():
        *tables, key = name.split(".")
        table = values
        for depth, part in enumerate(tables, start=1):
            inner = table.setdefault(part, {})
            if not isinstance(inner, dict):
                raise InputError(
                    f"{name}: expected {'.'.join(tables[:depth])} alone, which has no fields, found {name}"
                )
            table = inner
        table[key] = value
    return structure(NerfConfig, Document("", values, {}), Rules(none="none"))
