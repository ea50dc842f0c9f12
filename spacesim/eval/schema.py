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

    mean: float  #: over the frames that have it, in the metric's unit
    std: float  #: population standard deviation over them, in the same unit
    count: int  #: frames that have it
    pooled: float | None = None  #: over the pixels of all frames at once

    def __post_init__(self) -> None:
        check_ranges(self, mean=(-MAX_NUMBER, MAX_NUMBER), std=(0, MAX_NUMBER), count=(0, MAX_NUMBER))


Group = Mapping[str, Summary | None]
Values = Mapping[str, float | None]


@dataclass(frozen=True)
class Groups:
    """Summaries by group (`labels.GROUPS`); None: not measured."""

    image: Group | None  #: of the picture, over the silhouette
    image_full: Group | None  #: of the picture, over whole frames
    shadow: Group | None  #: of shadow by luminance, over the silhouette
    shadow_full: Group | None  #: of shadow by luminance, over whole frames
    shadow_mask: Group | None  #: of predicted visibility, over lit and cast-shadow pixels
    shadow_attached: Group | None = None  #: the same over lit pixels and those that face away from the Sun
    shadow_self_cast: Group | None = None  #: the same over lit pixels and shadow that an object casts on itself
    shadow_other_cast: Group | None = None  #: the same over lit pixels and shadow that another object casts
    depth: Group | None = None  #: errors of depth over the object's pixels; None without truth


@dataclass(frozen=True)
class GrazingBin:
    """Errors of pixels over which the Sun stands so high, degrees."""

    from_deg: float  #: least height of the Sun over the surface, degrees
    to_deg: float  #: greatest height
    pixels: int  #: how many there are, in all frames
    luminance_mae: float | None  #: mean absolute error of the luminance in [0, 1]
    visibility_mae: float | None  #: mean absolute error of the Sun's visibility in [0, 1]; None where none is predicted
    error_rate: float | None  #: share of the pixels that are on the wrong side of visibility one half
    false_shadow: float | None  #: share of the lit pixels that are predicted dark
    missed_shadow: float | None  #: share of the cast shadow that is predicted lit


@dataclass(frozen=True)
class SunGroups(Groups):
    """The groups over the frames of some Suns."""

    frames: int = 0  #: how many there are
    suns: int = 0  #: how many these are
    by_grazing_angle: tuple[GrazingBin, ...] | None = None  #: errors by the Sun's height over the surface


@dataclass(frozen=True)
class NearShares:
    """Shares of points nearer than `distance`, metres, to the other surface."""

    distance: float
    precision: float  #: share of the run's points
    recall: float  #: share of the truth's points
    f: float  #: harmonic mean of both


@dataclass(frozen=True)
class Floaters:
    """Shares of the Gaussians' opacity farther than `distance`, metres, from the true surface."""

    distance: float
    outside: float | None = None  #: share of the opacity that is farther outside of it than that
    inside: float | None = None  #: share of the Gaussians whose centres are inside of it


@dataclass(frozen=True)
class Geometry:
    """The shape against the truth."""

    size: float  #: of the object, metres
    chamfer: float | None  #: (2.27), metres^2
    hausdorff99: float | None  #: 99th percentile in place of the suprema of (2.28), metres
    iou: float | None  #: intersection over union of what both surfaces fill (2.29)
    precision_recall: NearShares | None  #: shares of points that are near the other surface
    normals_deg: float | None = None  #: mean angle between normals of nearest points, as lines, degrees
    accuracy: float | None = None  #: mean distance of the run's surface from the true one, metres
    completeness: float | None = None  #: mean distance of the true surface from the run's, metres
    floaters: Floaters | None = None  #: Gaussians off the surface; None without Gaussians
    mesh: Any = None  #: faces, voxel, views and depth of the run's surface
    hausdorff: float | None = None  #: (2.28), metres

    def __post_init__(self) -> None:
        check_ranges(self, size=(1e-9, MAX_NUMBER))


@dataclass(frozen=True)
class ObjectRecord:
    """One object of several."""

    id: int  #: its number in the label pictures, from 1
    name: str  #: the model's in a composed scene, else the object's in scene.json with its number
    frames: int  #: how many show it
    image: Group | None  #: of the picture, over its pixels
    shadow: Group | None  #: of shadow by luminance, over its pixels
    shadow_mask: Group | None  #: of predicted visibility, over its pixels
    depth: Group | None = None  #: errors of depth, over its pixels; None without truth
    geometry: Geometry | None = None  #: its shape against the truth, of a composed scene


@dataclass(frozen=True)
class FrameRecord:
    """One evaluated frame."""

    file_path: str  #: as transforms.json has it
    name: str  #: of its folder of pictures
    sun: tuple[float, float] | None  #: azimuth and elevation, degrees
    psnr: float | None  #: dB, over the silhouette, as all that have no group here
    image_full: Values  #: the metrics of the picture over the whole frame
    shadow_full: Values | None  #: those of shadow by luminance over the whole frame
    shadow_mask: Values | None  #: those of predicted visibility
    known_sun: bool | None = None  #: whether training has seen its Sun; None where that is not known
    material: Values | None = None  #: errors of albedo and normals; None without truth
    depth: Values | None = None  #: errors of its depth; None without truth
    depth_range: tuple[float, float] | None = None  #: metres: the ends of its pictures of depth, None: it has none
    ssim: float | None = None  #: at most 1
    lpips: float | None = None  #: None without the network's weights
    mae: float | None = None  #: of sRGB values in [0, 1]
    rmse: float | None = None  #: of sRGB values in [0, 1]
    flip: float | None = None  #: 0 to 1
    psnr_mu: float | None = None  #: dB, of linear light; None without radiance
    ber: float | None = None  #: share of pixels on the wrong side of the luminance that counts as shadow (2.23)
    bias: float | None = None  #: mean error of the luminance over true shadow (2.24)
    boundary_mae: float | None = None  #: mean absolute error of the luminance near the shadow's boundary (2.25)
    sharpness_ratio: float | None = None  #: gradient of the luminance there, predicted over true (2.26)
    fitted: JsonMapping | None = None  #: what was fitted to it, of a run with `Metrics.fitted`

    def __post_init__(self) -> None:
        if Path(self.name).name != self.name:
            raise InputError(f"name: expected a frame's name without folders, found {self.name!r}")
        if self.psnr is not None:
            check_ranges(self, psnr=(-MAX_NUMBER, MAX_NUMBER))


@dataclass(frozen=True)
class RelitView:
    """The view under one of many Suns."""

    sun: tuple[float, float]  #: azimuth and elevation, degrees
    truth: str | None  #: the frame that shows it, or None
    psnr: float | None  #: dB; None where no frame shows it
    known_sun: bool | None  #: whether training has seen this Sun; None where that is not known


@dataclass(frozen=True)
class RelightSweep:
    """One view under many Suns."""

    view: str  #: the frame whose camera it is seen from
    visibility: bool  #: whether it was predicted
    suns: tuple[RelitView, ...]  #: the views, by rising phase angle


@dataclass(frozen=True)
class FittedNumbers:
    """What was fitted to each picture, on one half of it to score the other."""

    name: str  #: "sun", "embedding" or "gain"
    how: str  #: in words


@dataclass(frozen=True)
class AlignmentFacts:
    """How a run was brought into the axes and scale of the data."""

    cameras: int  #: that match
    inliers: int  #: of these, that it is fitted to
    rms: float  #: metres, between the positions of these
    rms_over_distance: float  #: the same as a share of the cameras' distance
    scale: float  #: factor on the run's lengths


@dataclass(frozen=True)
class ModelFacts:
    """Size and speed of a model."""

    gaussians: int | None  #: None of a radiance field
    bytes: int  #: of its files
    render_ms: float  #: median of a frame
    backend: str  #: that rendered: "cuda" or "llvm"

    def __post_init__(self) -> None:
        check_ranges(self, bytes=(0, MAX_NUMBER), render_ms=(0, MAX_NUMBER))
        if self.gaussians is not None:
            check_ranges(self, gaussians=(0, MAX_NUMBER))


@dataclass(frozen=True)
class DatasetFacts:
    """The dataset that a run was evaluated on."""

    frames: int  #: evaluated ones
    train_frames: int  #: of the dataset, for training
    suns: int  #: of the evaluated frames
    resolution: tuple[int, int]  #: width and height of the first frame, pixels
    sizes: int = 1  #: how many different ones the frames have
    digest: str | None = None  #: of the evaluated frames
    ignored: float | None = None  #: share of their pixels that count nowhere
    truth: bool | None = None  #: whether it was path-traced
    scene: str | None = None  #: its name in scene.json
    config: JsonMapping | None = None  #: of the scene, as scene.json has it
    versions: JsonMapping | None = None  #: of the programs that rendered it


@dataclass(frozen=True)
class TrainingStep:
    """A point of the curves of training."""

    iteration: int  #: how many were finished
    loss: float | None = None  #: of the last one
    gaussians: int | None = None  #: at that time

    def __post_init__(self) -> None:
        check_ranges(self, iteration=(0, MAX_NUMBER))
        for name in ("loss", "gaussians"):
            if getattr(self, name) is not None:
                check_ranges(self, **{name: (-MAX_NUMBER, MAX_NUMBER)})


@dataclass(frozen=True)
class TrainingFacts:
    """Of training.json; all None of a composed scene, which no training has made."""

    history: tuple[TrainingStep, ...] | None = None  #: some iterations, in order
    seconds: float | None = None  #: of training
    backend: str | None = None  #: that trained: "cuda" or "llvm"
    device: str | None = None  #: that trained
    command: Any = None  #: text, or its words
    versions: Mapping[str, str] | None = None  #: of libraries


@dataclass(frozen=True)
class Metrics(Groups):
    """The whole file."""

    schema: int = 0  #: version of this layout
    run: str = ""  #: the run's folder, or the scene's file
    data: str = ""  #: the dataset's folder
    split: str = ""  #: "test", "train" or "all"
    model: ModelFacts = field(kw_only=True)  #: its size and speed
    notes: tuple[str, ...] = field(kw_only=True)  #: sentences: why values are missing, what stands in for what
    dataset: DatasetFacts = field(kw_only=True)  #: what was evaluated on
    config: JsonMapping = field(kw_only=True)  #: how the run was trained
    training: TrainingFacts = field(kw_only=True)  #: how its training went
    versions: Mapping[str, str] = field(kw_only=True)  #: of the programs that evaluated
    frames: tuple[FrameRecord, ...] = field(kw_only=True)  #: the evaluated frames, in order
    geometry: Geometry | None = None  #: None where the shape was not evaluated
    objects: tuple[ObjectRecord, ...] | None = None  #: of data with several
    known_suns: SunGroups | None = None  #: over frames whose Sun training has seen
    unseen_suns: SunGroups | None = None  #: over the others
    by_grazing_angle: tuple[GrazingBin, ...] | None = None  #: errors by the Sun's height over the surface
    material: Group | None = None  #: errors of albedo and normals, over the object's pixels; None without truth
    albedo_scale: float | None = None  #: by which the run's albedo is multiplied; None where it has none
    relight: RelightSweep | None = None  #: None where there are no two Suns, or they change nothing
    image_region: str = "silhouette"  #: what `image` is over: "silhouette", or "frame" where none is known
    fitted: tuple[FittedNumbers, ...] | None = None  #: None where nothing was
    alignment: AlignmentFacts | None = None  #: None of a run in the axes of the data

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
