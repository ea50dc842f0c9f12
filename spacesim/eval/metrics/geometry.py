"""How far the shape of a run is from the true one: distances between samples of what can be seen of both surfaces, the
overlap of what they fill, and how much of the run floats beside the object (thesis 2.3 and 5.2.3)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.backend.arrays import Bool
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array
from spacesim.data.mesh import SignedDistance, read_mesh
from spacesim.data.records import Camera, Dataset
from spacesim.eval.metrics.exterior import SurfaceSamples, exterior_samples
from spacesim.eval.metrics.solid import filled_beyond, filled_voxels
from spacesim.nerf.run import NerfRun
from spacesim.splat.export.fusion import Grid
from spacesim.splat.export.mesh import MeshConfig, RunMesh, cameras_around, cameras_on_sphere, mesh_of, mesh_of_depths

if TYPE_CHECKING:
    from spacesim.splat.raster.gaussians import Gaussians
    from spacesim.splat.run import Predictor

QUANTILE = 0.99  #: of the distances: the Hausdorff distance without its outliers (5.2.3)

NO_SURFACE = "no view of the run shows an opaque surface"

COMPARED = ("chamfer", "hausdorff", "hausdorff99", "iou", "precision_recall", "normals_deg", "accuracy", "completeness")
"""What is null without two surfaces."""

Mesh = tuple[Array, np.ndarray]
"""Vertices [V, 3] in metres and faces [F, 3]."""


@dataclass(frozen=True)
class GeometryConfig:
    """How shapes are compared."""

    samples: int = 100_000  #: points on each surface
    share: float = 0.01  #: of the object's size, the distance of precision, recall and floaters
    voxels: int = 128  #: of the overlap, along the object's size
    seed: int = 0  #: of the samples
    mesh: MeshConfig = field(default_factory=MeshConfig)  #: how the run's surface is found

    def __post_init__(self) -> None:
        if self.samples < 1 or self.voxels < 2 or not 0 < self.share < 1:
            raise InputError(
                "geometry: expected at least 1 sample, 2 voxels and a share between 0 and 1, found "
                f"{self.samples}, {self.voxels} and {self.share}"
            )


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface's samples, and how far each is from the other surface's, metres."""

    samples: SurfaceSamples  #: points on it, with their normals
    distances: Array  #: [N] metres, from each sample to the nearest of the other surface


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two surfaces compared."""

    values: JsonDict  #: as metrics.json has them
    truth: Shape  #: samples with their distances
    predicted: Shape  #: samples with their distances
    size: float  #: metres, the diagonal of the box around the truth


@dataclass(frozen=True, eq=False)
class ShapeResult:
    """The shape of a run against the truth."""

    values: JsonDict | None  #: metrics.json's "geometry", or None
    note: str  #: a sentence where it, or a part of it, is None, else ""
    comparison: Comparison | None = None  #: None where the surfaces cannot be compared
    truth: Mesh | None = None  #: the true surface, None where there is none
    predicted: RunMesh | None = None  #: the run's surface, None where there is none


def compare_geometry(run: "Predictor", dataset: Dataset, config: GeometryConfig | None) -> ShapeResult:
    """The shape of a run, or of a composed scene as a whole, against the dataset's mesh. The views are the dataset's
    training cameras; around a composed scene cameras stand on a sphere. config: None for no evaluation, only the
    sentence that says so.

    Raises InputError where the file of the mesh is missing or holds none, or the grid does not fit into memory.
    """
    if config is None:
        return ShapeResult(None, "Geometry is null: it was not asked for.")
    if dataset.mesh_path is None:
        return ShapeResult(None, "Geometry is null: the data has no true mesh.")
    path = dataset.root / dataset.mesh_path
    truth = read_mesh(path)
    try:
        size_of(*truth)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    model, cameras = run.gaussians, [frame.camera for frame in dataset.train or dataset.frames]
    if isinstance(run, NerfRun):
        return _compare_surface(mesh_of_depths(run.surface_depth, cameras, config.mesh), None, "median", truth, config)
    if model is None:
        return compare_depths(run, truth, config)
    if run.parts:  # trained on other data: what this dataset looks at says nothing
        cameras = cameras_around(model, config.mesh.views)
    return compare_shape(model, run.antialiased, cameras, truth, config)


def compare_shape(
    model: "Gaussians", antialiased: "Bool | bool", cameras: Sequence[Camera], truth: Mesh, config: GeometryConfig
) -> ShapeResult:
    """The shape of Gaussians, as `cameras` see it, against a true mesh. antialiased: see `project`

    Raises InputError where the truth is a point or the grid does not fit into memory.
    """
    mesh = mesh_of(model, cameras, config.mesh, antialiased)
    return _compare_surface(mesh, model, config.mesh.depth, truth, config)


def compare_depths(scene: Any, truth: Mesh, config: GeometryConfig) -> ShapeResult:
    """The shape of a scene with radiance fields, or of one of its fields, against a true mesh: see its `surface_depth`,
    from around its `sphere`. Raises as `compare_shape` does."""
    centre, radius = scene.sphere
    cameras = cameras_on_sphere(centre, radius, config.mesh.views)
    return _compare_surface(mesh_of_depths(scene.surface_depth, cameras, config.mesh), None, "median", truth, config)


def _compare_surface(
    mesh: RunMesh, model: "Gaussians | None", depth: str, truth: Mesh, config: GeometryConfig
) -> ShapeResult:
    """The surface of a model, Gaussians or None, against a true mesh. depth: which was fused"""
    size = size_of(*truth)
    answer = compare_meshes(truth, (mesh.vertices, mesh.faces), config) if len(mesh.faces) else NO_SURFACE
    compared = answer if isinstance(answer, Comparison) else None
    but = "" if model is None else " but for its floaters"
    note = "" if compared else f"Geometry is null{but}: {answer}."
    values = {
        **(compared.values if compared else dict.fromkeys(COMPARED)),
        "floaters": _floaters(model, truth, config.share * size),
        "size": size,
        "mesh": {"faces": len(mesh.faces), "voxel": mesh.voxel, "views": mesh.views, "depth": depth},
    }
    return ShapeResult(values, note, compared, truth, mesh)


def _floaters(model: "Gaussians | None", truth: Mesh, within: float) -> dict[str, float] | None:
    return None if model is None else floaters(model.to_numpy(), SignedDistance(*truth), within)


def size_of(vertices: Array, faces: np.ndarray) -> float:
    """Metres: diagonal of the box around a mesh. Raises InputError where it has none."""
    corners = vertices[np.unique(faces)]
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    if not (np.isfinite(size) and size > 0):
        raise InputError("mesh: expected one of some extent, found none")
    return size


def compare_meshes(truth: Mesh, predicted: Mesh, config: GeometryConfig | None = None) -> Comparison | str:
    """Compare two surfaces; a sentence where one of them has nothing that can be seen from outside.

    Raises InputError where the truth is a point.
    """
    config = config or GeometryConfig()
    size = size_of(*truth)
    sides = [exterior_samples(*mesh, config.samples, config.seed + k) for k, mesh in enumerate((truth, predicted))]
    true, predicted_samples = sides
    if true is None or predicted_samples is None:
        return f"nothing of the {'true' if true is None else 'reconstructed'} surface can be seen from outside"
    there, nearest_predicted = _nearest(true.points, predicted_samples.points)
    back, nearest_true = _nearest(predicted_samples.points, true.points)
    within = config.share * size
    turned = np.concatenate(
        [
            angles(true.normals, predicted_samples.normals[nearest_predicted]),
            angles(predicted_samples.normals, true.normals[nearest_true]),
        ]
    )
    values = {
        "chamfer": chamfer(there, back),
        "hausdorff": hausdorff(there, back),
        "hausdorff99": hausdorff(there, back, QUANTILE),
        "iou": overlap(truth, predicted, size / config.voxels),
        "precision_recall": precision_recall(there, back, within),
        "normals_deg": float(turned.mean()),
        "accuracy": float(back.mean()),
        "completeness": float(there.mean()),
    }
    return Comparison(values, Shape(true, there), Shape(predicted_samples, back), size)


def chamfer(there: Array, back: Array) -> float:
    """Square metres, of the distances from each set to the nearest of the other: means of squares, added (2.27)."""
    return float(np.mean(np.square(there)) + np.mean(np.square(back)))


def hausdorff(there: Array, back: Array, quantile: float = 1.0) -> float:
    """Metres, of the distances from each set to the nearest of the other: the largest, the worse way (2.28). Below 1,
    `quantile` of the distances of each way stands in for its largest."""
    return float(max(np.quantile(there, quantile), np.quantile(back, quantile)))


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
    """Intersection over union of the voxels that both fill (2.29), of side `voxel` (metres); None where neither fills
    one. The common grid reaches at most as far around the truth's box as that is wide; what the prediction fills
    beyond is in the union, too, as `filled_beyond` counts it."""
    corners = [vertices[np.unique(faces)] for vertices, faces in (truth, predicted)]
    low, high = corners[0].min(axis=0), corners[0].max(axis=0)
    reach = high - low
    low = np.minimum(low, np.maximum(corners[1].min(axis=0), low - reach))
    high = np.maximum(high, np.minimum(corners[1].max(axis=0), high + reach))
    grid = Grid.around(low, high, voxel, 3 * voxel)
    one, other = (filled_voxels(*mesh, grid) for mesh in (truth, predicted))
    either = int((one | other).sum()) + filled_beyond(*predicted, grid)
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
    import igl

    # boxes around the points themselves: from far away, where all of a small surface is about as near, a tree that
    # divides space (scipy's) visits five times as many
    others, points = (np.ascontiguousarray(array, np.float64) for array in (others, points))
    tree, each = igl.AABB(), np.arange(len(others))[:, None]
    tree.init(others, each)
    squared, index, _ = tree.squared_distance(others, each, points)
    return np.sqrt(squared), np.asarray(index)
