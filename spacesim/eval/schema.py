"""What metrics.json holds, as records: `spacesim report` checks files against them before it reads on.

Keys that are not named here are passed over: files of later versions may have more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from spacesim.data.errors import InputError, check_ranges
from spacesim.data.files import JsonMapping
from spacesim.data.structure import Rules

SCHEMA = 1
MAX_NUMBER = 1e15  #: of any number in metrics.json: a larger one is damage


@dataclass(frozen=True)
class Summary:
    """Of a metric over frames."""

    mean: float
    std: float
    count: int  #: frames that have it
    pooled: float | None = None  #: over the pixels of all frames at once

    def __post_init__(self) -> None:
        check_ranges(self, mean=(-MAX_NUMBER, MAX_NUMBER), std=(0, MAX_NUMBER), count=(0, MAX_NUMBER))


Group = Mapping[str, Summary | None]
Values = Mapping[str, float | None]


@dataclass(frozen=True)
class Groups:
    """Summaries by group (`labels.GROUPS`); None: not measured."""

    image: Group | None
    image_full: Group | None
    shadow: Group | None
    shadow_full: Group | None
    shadow_mask: Group | None
    shadow_attached: Group | None = None
    shadow_self_cast: Group | None = None
    shadow_other_cast: Group | None = None


@dataclass(frozen=True)
class GrazingBin:
    """Errors of pixels over which the Sun stands so high, degrees."""

    from_deg: float
    to_deg: float
    pixels: int
    luminance_mae: float | None
    visibility_mae: float | None
    error_rate: float | None
    false_shadow: float | None
    missed_shadow: float | None


@dataclass(frozen=True)
class SunGroups(Groups):
    """The groups over the frames of some Suns."""

    frames: int = 0
    suns: int = 0
    by_grazing_angle: tuple[GrazingBin, ...] | None = None


@dataclass(frozen=True)
class NearShares:
    """Shares of points nearer than `distance`, metres, to the other surface."""

    distance: float
    precision: float
    recall: float
    f: float


@dataclass(frozen=True)
class Floaters:
    """Shares of the Gaussians' opacity farther than `distance`, metres, from the true surface."""

    distance: float
    outside: float | None = None
    inside: float | None = None


@dataclass(frozen=True)
class Geometry:
    """The shape against the truth."""

    size: float  #: of the object, metres
    chamfer: float | None
    hausdorff99: float | None
    iou: float | None
    precision_recall: NearShares | None
    normals_deg: float | None = None
    accuracy: float | None = None
    completeness: float | None = None
    floaters: Floaters | None = None
    mesh: Any = None
    hausdorff: float | None = None

    def __post_init__(self) -> None:
        check_ranges(self, size=(1e-9, MAX_NUMBER))


@dataclass(frozen=True)
class ObjectRecord:
    """One object of several."""

    id: int
    name: str
    frames: int
    image: Group | None
    shadow: Group | None
    shadow_mask: Group | None
    geometry: Geometry | None = None


@dataclass(frozen=True)
class FrameRecord:
    """One evaluated frame."""

    file_path: str
    name: str  #: of its folder of pictures
    sun: tuple[float, float] | None  #: azimuth and elevation, degrees
    psnr: float | None
    image_full: Values
    shadow_full: Values | None
    shadow_mask: Values | None
    known_sun: bool | None = None
    ssim: float | None = None
    lpips: float | None = None
    mae: float | None = None
    rmse: float | None = None
    flip: float | None = None
    ber: float | None = None
    bias: float | None = None
    boundary_mae: float | None = None
    sharpness_ratio: float | None = None
    fitted: JsonMapping | None = None  #: what was fitted to it, of a run with `Metrics.fitted`

    def __post_init__(self) -> None:
        if Path(self.name).name != self.name:
            raise InputError(f"name: expected a frame's name without folders, found {self.name!r}")
        if self.psnr is not None:
            check_ranges(self, psnr=(-MAX_NUMBER, MAX_NUMBER))


@dataclass(frozen=True)
class RelitView:
    """The view under one of many Suns."""

    sun: tuple[float, float]
    truth: str | None  #: the frame that shows it, or None
    psnr: float | None
    known_sun: bool | None


@dataclass(frozen=True)
class RelightSweep:
    """One view under many Suns."""

    view: str
    visibility: bool  #: whether it was predicted
    suns: tuple[RelitView, ...]


@dataclass(frozen=True)
class FittedNumbers:
    """What was fitted to each picture, on one half of it to judge the other."""

    name: str
    how: str  #: in words


@dataclass(frozen=True)
class AlignmentFacts:
    """How a run was brought into the axes and scale of the data."""

    cameras: int  #: that match
    inliers: int  #: of these, that it is fitted to
    rms: float  #: metres, between the positions of these
    rms_over_distance: float
    scale: float


@dataclass(frozen=True)
class ModelFacts:
    """Size and speed of a model."""

    gaussians: int | None  #: None of a radiance field
    bytes: int
    render_ms: float  #: median of a frame
    backend: str

    def __post_init__(self) -> None:
        check_ranges(self, bytes=(0, MAX_NUMBER), render_ms=(0, MAX_NUMBER))
        if self.gaussians is not None:
            check_ranges(self, gaussians=(0, MAX_NUMBER))


@dataclass(frozen=True)
class DatasetFacts:
    """The dataset that a run was evaluated on."""

    frames: int
    train_frames: int
    suns: int
    resolution: tuple[int, int]  #: width and height of the first frame, pixels
    digest: str | None = None  #: of the evaluated frames
    ignored: float | None = None  #: share of their pixels that count nowhere
    truth: bool | None = None  #: whether it was path-traced
    scene: str | None = None
    config: JsonMapping | None = None
    versions: JsonMapping | None = None


@dataclass(frozen=True)
class TrainingStep:
    """A point of the curves of training."""

    iteration: int
    loss: float | None = None
    gaussians: int | None = None

    def __post_init__(self) -> None:
        check_ranges(self, iteration=(0, MAX_NUMBER))
        for name in ("loss", "gaussians"):
            if getattr(self, name) is not None:
                check_ranges(self, **{name: (-MAX_NUMBER, MAX_NUMBER)})


@dataclass(frozen=True)
class TrainingFacts:
    """Of training.json; all None of a composed scene, which no training has made."""

    history: tuple[TrainingStep, ...] | None = None
    seconds: float | None = None
    backend: str | None = None
    device: str | None = None
    command: Any = None  #: text, or its words
    versions: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Metrics(Groups):
    """The whole file."""

    schema: int = 0
    run: str = ""
    data: str = ""
    split: str = ""
    model: ModelFacts = field(kw_only=True)
    notes: tuple[str, ...] = field(kw_only=True)
    dataset: DatasetFacts = field(kw_only=True)
    config: JsonMapping = field(kw_only=True)
    training: TrainingFacts = field(kw_only=True)
    versions: Mapping[str, str] = field(kw_only=True)
    frames: tuple[FrameRecord, ...] = field(kw_only=True)
    geometry: Geometry | None = None
    objects: tuple[ObjectRecord, ...] | None = None
    known_suns: SunGroups | None = None
    unseen_suns: SunGroups | None = None
    by_grazing_angle: tuple[GrazingBin, ...] | None = None
    relight: RelightSweep | None = None
    image_region: str = "silhouette"  #: what `image` is over: "silhouette", or "frame" where none is known
    fitted: tuple[FittedNumbers, ...] | None = None
    alignment: AlignmentFacts | None = None

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise InputError(f"schema: expected metrics of schema {SCHEMA}, found {self.schema}")
        if not self.frames:
            raise InputError("frames: expected at least one, found none")


RULES = Rules(
    open=(
        *(Summary, Groups, GrazingBin, NearShares, Floaters, Geometry, ObjectRecord, FrameRecord, RelitView),
        *(FittedNumbers, AlignmentFacts, RelightSweep, ModelFacts, DatasetFacts, TrainingStep, TrainingFacts),
    )
)
