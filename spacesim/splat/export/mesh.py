"""The surface of a run as a mesh: its depth from many views, fused, and marching cubes where the distance is 0.

Only what a view has seen is surface: where voxels were never in sight, the mesh has a hole, not a wall.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import igl
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from spacesim.backend.arrays import Bool
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, fibonacci_sphere, look_at
from spacesim.data.records import Camera
from spacesim.splat.export.fusion import TRUNCATION, DepthView, DistanceField, Grid, check_memory, fuse
from spacesim.splat.export.sweep import resize_camera
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import project
from spacesim.splat.raster.render import blend
from spacesim.splat.raster.surface import gather_or_zero, median_splat, surface_depth

KINDS = ("surface", "median", "expected")
OPAQUE = 0.5  #: alpha from which on a pixel shows a surface
FOV_DEG, SIDE = 40.0, 256  #: of cameras that stand in for missing ones, pixels a side
MAX_PIXELS = 512  #: of a picture's longer side; larger ones are rendered smaller
MAX_TRUNCATION = 100  #: voxels: the grid has as many around the object
OUTLIERS = 1e-3  #: share of the points seen, at each end of each axis, that does not decide how large the object is
MARGIN = 0.1  #: of the size so found, around it, in which outliers still count
COARSE = 0.1  #: of the size: voxels that are larger leave no shape
PIECE = 1e-3  #: of the largest piece's area: smaller ones are dropped
_CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MeshConfig:
    """How the surface of a run is made."""

    voxels: int = 192  #: along the object's size (the diagonal of its box)
    voxel: float | None = None  #: their side in metres instead, or None
    truncation: float = TRUNCATION  #: voxels
    views: int = 64  #: at most, evenly chosen
    #: of a pixel: where its ray meets the Gaussian at which half of the light is gone ("surface"), that Gaussian's
    #: centre ("median"), or the mean of the centres ("expected")
    depth: str = "surface"

    def __post_init__(self) -> None:
        if self.voxel is not None and not (np.isfinite(self.voxel) and self.voxel > 0):
            raise InputError(f"voxel: expected a positive number of metres, found {self.voxel}")
        if self.voxels < 2:
            raise InputError(f"voxels: expected at least 2, found {self.voxels}")
        if self.views < 1:
            raise InputError(f"views: expected at least 1, found {self.views}")
        if not 1 <= self.truncation <= MAX_TRUNCATION:
            raise InputError(f"truncation: expected 1 to {MAX_TRUNCATION} voxels, found {self.truncation}")
        if self.depth not in KINDS:
            raise InputError(f"depth: expected {' or '.join(KINDS)}, found {self.depth!r}")


@dataclass(frozen=True, eq=False)
class RunMesh:
    """The surface of a run."""

    vertices: Array  #: [V, 3] metres, world frame
    faces: np.ndarray  #: [F, 3] int64, outside is where they turn counter-clockwise
    voxel: float  #: metres
    views: int  #: how many were fused. No faces where no view shows a surface.


def mesh_of(
    model: Gaussians,
    cameras: Sequence[Camera],
    config: MeshConfig | None = None,
    antialiased: Bool | bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RunMesh:
    """The surface of Gaussians as `cameras` see it. antialiased: see `project`;  progress: called with the steps done
    and all of them.

    Raises InputError where the grid does not fit into memory.
    """
    config = config or MeshConfig()
    return mesh_of_depths(lambda camera: depth_of(model, camera, config.depth, antialiased), cameras, config, progress)


def mesh_of_depths(
    depth: Callable[[Camera], np.ndarray],
    cameras: Sequence[Camera],
    config: MeshConfig,
    progress: Callable[[int, int], None] | None = None,
) -> RunMesh:
    """The surface of what a camera sees at `depth`, [H, W] metres along its axis, 0 where there is no surface; see
    `mesh_of`."""
    chosen = select_views(cameras, config.views)
    steps = 2 * len(chosen) + 1

    def report(done: int) -> None:
        if progress:
            progress(done, steps)

    views: list[DepthView] = []
    for camera in chosen:
        report(len(views))
        views.append(DepthView(camera, depth(camera)))
    box = bounds(views)
    if box is None:
        report(steps)
        return RunMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), config.voxel or 0.0, len(views))
    size = float(np.linalg.norm(box[1] - box[0]))
    voxel = config.voxel or size / config.voxels
    if voxel > COARSE * size:
        _log.warning("voxel: %.3g m is too coarse for an object of %.3g m; take less than a tenth of that", voxel, size)
    grid = Grid.around(*box, voxel, (config.truncation + 1) * voxel)
    check_memory(grid)
    field = fuse(views, grid, config.truncation, progress=lambda done: report(len(views) + done))
    vertices, faces = remove_small_pieces(*surface(field))
    report(steps)
    return RunMesh(vertices, faces, voxel, len(views))


def select_views(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of the cameras, evenly chosen among those that see something else: under several Suns many are the
    same. As large as `MAX_PIXELS`."""
    views = {(c.world_from_camera.tobytes(), c.width, c.height, c.fx, c.fy, c.cx, c.cy): c for c in cameras}
    different = list(views.values())
    places = np.unique(np.linspace(0, len(different) - 1, min(most, len(different))).round().astype(int))
    return [_limit_pixels(different[place], MAX_PIXELS) for place in places]


def cameras_around(model: Gaussians, count: int) -> list[Camera]:
    """`count` cameras on a Fibonacci sphere that see all of the model: where its own cameras are not to be had."""
    arrays = model.to_numpy()
    finite = np.isfinite(arrays["means"]).all(axis=1) & (arrays["logit_opacities"] > -2)
    points = arrays["means"][finite].astype(np.float64)
    if len(points) == 0:
        return []
    low, high = np.quantile(points, (0.005, 0.995), axis=0)
    return cameras_on_sphere(0.5 * (low + high), 0.6 * float(np.linalg.norm(high - low)) + 1e-3, count)


def cameras_on_sphere(centre: Array, radius: float, count: int) -> list[Camera]:
    """`count` cameras on a Fibonacci sphere that see all of a smaller one. centre: [3] metres;  radius: metres"""
    distance = radius / np.sin(np.radians(0.5 * FOV_DEG))
    poses = (look_at(centre + distance * direction, centre) for direction in fibonacci_sphere(count))
    return [Camera.from_fov(pose, SIDE, SIDE, FOV_DEG) for pose in poses]


def depth_of(model: Gaussians, camera: Camera, kind: str = "surface", antialiased: Bool | bool = False) -> np.ndarray:
    """[H, W] float32, metres, of one of `KINDS`: where the picture is opaque, else 0."""
    if model.count == 0:
        return np.zeros((camera.height, camera.width), np.float32)
    seen = Pinhole.of(camera)
    splats, footprints = project(model, seen, antialiased)
    blended = blend(splats, footprints, [splats.depth] if kind == "expected" else [], seen)
    alpha = 1 - blended.transmittance
    if kind == "expected":
        depth = blended.planes[0] * dr.rcp(dr.maximum(alpha, OPAQUE))
    else:
        index = median_splat(splats, blended.lists, seen.width, seen.height)
        if kind == "surface":
            depth = surface_depth(model, splats, index, seen, model.count)
        else:
            depth = gather_or_zero(splats.depth, index)
    depth = dr.select((alpha >= OPAQUE) & dr.isfinite(depth) & (depth > 0), depth, 0)
    return np.array(depth, np.float32).reshape(camera.height, camera.width)


def bounds(views: Sequence[DepthView]) -> tuple[Array, Array] | None:
    """Lowest and highest corner, [3] metres, of what the views see, without what floats far away; None of nothing."""
    seen = [points for view in views if len(points := _points(view))]
    if not seen:
        return None
    points = np.concatenate(seen)
    low, high = np.quantile(points, (OUTLIERS, 1 - OUTLIERS), axis=0)
    reach = MARGIN * float(np.linalg.norm(high - low))
    return np.maximum(points.min(axis=0), low - reach), np.minimum(points.max(axis=0), high + reach)


def surface(field: DistanceField) -> tuple[Array, np.ndarray]:
    """Vertices [V, 3] metres and faces [F, 3] where the distance is 0 between voxels that are all observed."""
    grid = field.grid
    nx, ny, nz = grid.shape
    if min(grid.shape) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    is_known = np.ones((nz - 1, ny - 1, nx - 1), bool)
    below, above = np.zeros_like(is_known), np.zeros_like(is_known)
    negative = field.distance < 0
    for x, y, z in _CORNERS:
        part = np.s_[z : z + nz - 1, y : y + ny - 1, x : x + nx - 1]
        is_known &= field.observed[part]
        below |= negative[part]
        above |= ~negative[part]
    z, y, x = np.nonzero(is_known & below & above)
    if len(x) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    corners = np.ravel_multi_index(
        (z[:, None] + _CORNERS[:, 2], y[:, None] + _CORNERS[:, 1], x[:, None] + _CORNERS[:, 0]), (nz, ny, nx)
    )
    used, index = np.unique(corners, return_inverse=True)
    z, y, x = np.unravel_index(used, (nz, ny, nx))
    places = grid.origin + grid.voxel * np.stack([x, y, z], axis=1)
    values = field.distance.ravel()[used].astype(np.float64)
    vertices, faces, _ = igl.marching_cubes(values, places, index.reshape(-1, 8).astype(np.int64), 0.0)
    return np.asarray(vertices, np.float64), np.asarray(faces, np.int64)


def remove_small_pieces(vertices: Array, faces: np.ndarray) -> tuple[Array, np.ndarray]:
    """The mesh without pieces whose area is below `PIECE` of the largest one's."""
    if len(faces) == 0:
        return vertices, faces
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    linked = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices)))
    piece = connected_components(linked, directed=False)[1][faces[:, 0]]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.bincount(piece, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    faces = faces[area[piece] >= PIECE * area.max()]
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3).astype(np.int64)


def _points(view: DepthView) -> Array:
    """[N, 3] metres, world frame: where the pixels with depth are."""
    camera = view.camera
    row, column = np.nonzero(view.depth)
    depth = view.depth[row, column].astype(np.float64)
    x, y = (column + 0.5 - camera.cx) / camera.fx * depth, (row + 0.5 - camera.cy) / camera.fy * depth
    pose = camera.world_from_camera
    return np.asarray(np.stack([x, y, depth], axis=1) @ pose[:3, :3].T + pose[:3, 3], np.float64)


def _limit_pixels(camera: Camera, most: int) -> Camera:
    """The camera with at most `most` pixels on its longer side."""
    return camera if max(camera.width, camera.height) <= most else resize_camera(camera, most)
