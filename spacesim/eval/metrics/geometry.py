"""How far the shape of a run is from the true one: distances between samples of what can be seen of both surfaces, the
overlap of what they fill, and how much of the run floats beside the object (thesis 2.3 and 5.2.3)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.mesh import SignedDistance, read_mesh
from spacesim.data.records import Camera, Dataset
from spacesim.eval.composition import ComposedRun
from spacesim.eval.metrics.exterior import Samples, exterior_samples
from spacesim.eval.metrics.solid import filled
from spacesim.splat.export.fusion import Grid
from spacesim.splat.export.mesh import MeshConfig, RunMesh, cameras_around, mesh_of

if TYPE_CHECKING:
    from spacesim.splat.raster.gaussians import Gaussians
    from spacesim.splat.run import Run

QUANTILE = 0.99  #: of the distances: the Hausdorff distance without its outliers

NO_SURFACE = "no view of the run shows an opaque surface"

COMPARED = ("chamfer", "hausdorff99", "iou", "precision_recall", "normals_deg", "accuracy", "completeness")
"""What is null without two surfaces."""

Mesh = tuple[Array, np.ndarray]
"""Vertices [V, 3] in metres and faces [F, 3]."""


@dataclass(frozen=True)
class GeometryConfig:
    """samples: points on each surface;  share: of the object's size, the distance of precision, recall and floaters
    voxels: of the overlap, along the object's size;  seed: of the samples;  mesh: how the run's surface is found.
    All chosen."""

    samples: int = 100_000
    share: float = 0.01
    voxels: int = 128
    seed: int = 0
    mesh: MeshConfig = field(default_factory=MeshConfig)

    def __post_init__(self) -> None:
        if self.samples < 1 or self.voxels < 2 or not 0 < self.share < 1:
            raise InputError(
                "geometry: expected at least 1 sample, 2 voxels and a share between 0 and 1, found "
                f"{self.samples}, {self.voxels} and {self.share}"
            )


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface's samples, and how far each is from the other surface's, metres."""

    samples: Samples
    distances: Array


@dataclass(frozen=True, eq=False)
class Comparison:
    """values: as metrics.json has them;  truth, predicted: samples with their distances;  size: metres, the diagonal of
    the box around the truth"""

    values: dict[str, Any]
    truth: Shape
    predicted: Shape
    size: float


@dataclass(frozen=True, eq=False)
class JudgedShape:
    """values: metrics.json's "geometry", or None;  note: a sentence where it, or a part of it, is None, else "";
    comparison: None where the surfaces cannot be compared;  truth, found: both surfaces, None where there is none"""

    values: dict[str, Any] | None
    note: str
    comparison: Comparison | None = None
    truth: Mesh | None = None
    found: RunMesh | None = None


def judge_geometry(run: "Run", dataset: Dataset, config: GeometryConfig | None) -> JudgedShape:
    """The shape of a run, or of a `ComposedRun` as a whole, against the dataset's mesh. The views are the dataset's
    training cameras; around a composed scene cameras stand on a sphere. config: None for no judgement, only the
    sentence that says so.

    Raises InputError where the file of the mesh is missing or holds none, or the grid does not fit into memory.
    """
    if config is None:
        return JudgedShape(None, "Geometry is null: it was not asked for.")
    if dataset.mesh_path is None:
        return JudgedShape(None, "Geometry is null: the data has no true mesh.")
    path = dataset.root / dataset.mesh_path
    truth = read_mesh(path)
    try:
        size_of(*truth)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    model = run.model
    if isinstance(run, ComposedRun):  # trained on other data: what this dataset looks at says nothing
        cameras = cameras_around(model, config.mesh.views)
    else:
        cameras = [frame.camera for frame in dataset.train or dataset.frames]
    return judge_shape(model, run.antialiased, cameras, truth, config)


def judge_shape(
    model: "Gaussians", antialiased: Any, cameras: Sequence[Camera], truth: Mesh, config: GeometryConfig
) -> JudgedShape:
    """The shape of Gaussians, as `cameras` see it, against a true mesh. antialiased: see `project`

    Raises InputError where the truth is a point or the grid does not fit into memory.
    """
    size = size_of(*truth)
    found = mesh_of(model, cameras, config.mesh, antialiased)
    answer = compare(truth, (found.vertices, found.faces), config) if len(found.faces) else NO_SURFACE
    compared = answer if isinstance(answer, Comparison) else None
    note = "" if compared else f"Geometry is null but for its floaters: {answer}."
    values = {
        **(compared.values if compared else dict.fromkeys(COMPARED)),
        "floaters": floaters(model.to_numpy(), SignedDistance(*truth), config.share * size),
        "size": size,
        "mesh": {"faces": len(found.faces), "voxel": found.voxel, "views": found.views, "depth": config.mesh.depth},
    }
    return JudgedShape(values, note, compared, truth, found)


def size_of(vertices: Array, faces: np.ndarray) -> float:
    """Metres: diagonal of the box around a mesh. Raises InputError where it has none."""
    corners = vertices[np.unique(faces)]
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    if not (np.isfinite(size) and size > 0):
        raise InputError("mesh: expected one of some extent, found none")
    return size


def compare(truth: Mesh, predicted: Mesh, config: GeometryConfig | None = None) -> Comparison | str:
    """Compare two surfaces; a sentence where one of them has nothing that can be seen from outside.

    Raises InputError where the truth is a point.
    """
    config = config or GeometryConfig()
    size = size_of(*truth)
    sides = [exterior_samples(*mesh, config.samples, config.seed + k) for k, mesh in enumerate((truth, predicted))]
    true, found = sides
    if true is None or found is None:
        return f"nothing of the {'true' if true is None else 'reconstructed'} surface can be seen from outside"
    there, nearest_found = _nearest(true.points, found.points)
    back, nearest_true = _nearest(found.points, true.points)
    within = config.share * size
    turned = np.concatenate(
        [angles(true.normals, found.normals[nearest_found]), angles(found.normals, true.normals[nearest_true])]
    )
    values = {
        "chamfer": chamfer(there, back),
        "hausdorff99": float(max(np.quantile(there, QUANTILE), np.quantile(back, QUANTILE))),
        "iou": overlap(truth, predicted, size / config.voxels),
        "precision_recall": precision_recall(there, back, within),
        "normals_deg": float(turned.mean()),
        "accuracy": float(back.mean()),
        "completeness": float(there.mean()),
    }
    return Comparison(values, Shape(true, there), Shape(found, back), size)


def chamfer(there: Array, back: Array) -> float:
    """Square metres, of the distances from each set to the nearest of the other: means of squares, added (2.27)."""
    return float(np.mean(np.square(there)) + np.mean(np.square(back)))


def precision_recall(there: Array, back: Array, within: float) -> dict[str, float]:
    """precision: share of the reconstruction's points (distances `back`) nearer than `within` to the truth; recall: the
    other way round; f: their harmonic mean (Knapitsch et al. 2017)."""
    precision, recall = float(np.mean(back < within)), float(np.mean(there < within))
    f = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return {"distance": within, "precision": precision, "recall": recall, "f": f}


def angles(normals: Array, others: Array) -> Array:
    """[N] degrees between unit normals [N, 3], 0 to 90: of lines, as beside a thin sheet either side may be nearest."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(np.einsum("nc,nc->n", normals, others)), 0, 1))))


def overlap(truth: Mesh, predicted: Mesh, voxel: float) -> float | None:
    """Intersection over union of the voxels that both fill (2.29), a common grid of side `voxel` (metres) around both;
    None where neither fills one. What lies farther from the truth than its box is wide does not count."""
    corners = [vertices[np.unique(faces)] for vertices, faces in (truth, predicted)]
    low, high = corners[0].min(axis=0), corners[0].max(axis=0)
    reach = high - low
    low = np.minimum(low, np.maximum(corners[1].min(axis=0), low - reach))
    high = np.maximum(high, np.minimum(corners[1].max(axis=0), high + reach))
    grid = Grid.around(low, high, voxel, 3 * voxel)
    one, other = (filled(*mesh, grid) for mesh in (truth, predicted))
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else None


def floaters(model: Mapping[str, np.ndarray], surface: SignedDistance, within: float) -> dict[str, float] | None:
    """Where the opacity of Gaussians lies: `outside` of the true surface by more than `within` metres, the share of the
    sum of opacities that floats; `inside`, the share of the Gaussians whose centre is inside.  None without Gaussians.

    model: as `Gaussians.to_numpy` gives it
    """
    if len(model["means"]) == 0:
        return None
    distance = surface(model["means"])
    opacity = 1 / (1 + np.exp(-np.clip(model["logit_opacities"].astype(np.float64), -60, 60)))
    outside = float(opacity[distance > within].sum() / opacity.sum())
    return {"distance": within, "outside": outside, "inside": float(np.mean(distance < 0))}


def _nearest(points: Array, others: Array) -> tuple[Array, np.ndarray]:
    """Of each of `points`, the distance to the nearest of `others` and which that is."""
    distance, index = cKDTree(others).query(points, workers=-1)
    return distance, index
