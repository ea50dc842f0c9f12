"""Where Gaussians start: on a mesh, at points, or at random."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import is_near
from spacesim.data.images import load_image
from spacesim.data.mesh import read_mesh, read_points
from spacesim.data.records import Dataset, Image
from spacesim.learning.cameras import focus_point, nearest_camera
from spacesim.splat.raster.cameras import NEAR
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.surface import flattened

OPACITY = 0.1  #: of every Gaussian at the start (Kerbl et al. 2023)
NEIGHBOURS = 12  #: points that a normal is estimated from
COARSE = 0.05  #: pixels: steps of 0.1 cost 0.4 dB of 26.6, those of 1 pixel 1.9 dB (boxsat, 96 pixels)
MANY_PICTURES = 100  #: that unknown Suns are estimated from: 15 degrees off like SPEED+'s, 28 of 60, 41 of 40
MANY_STEPS = 2_000  #: the same: after 800 they were off by 93 degrees, while halves of pictures agreed to 26
LOOKED_AT = 32  #: training pictures, at most, that are looked at for whether the object is cut out
FEW_LOOKED_AT = 8  #: the same, for whether they show a sky: large ones take a second each
CUT_AWAY = 0.02  #: least share of a picture's pixels that are empty or ignored, where the object is cut out
BLACK, SKY = 0.05, 0.2  #: sRGB value of the brightest black sky, and its least share of a picture before it
FEW_LEFT = 0.25  #: of the most Gaussians that training had: fewer are told; 0.21 gave 14.6 dB, 0.33 22.5 dB
FEATURES = 0.3  #: standard deviation of the features at the start
SOME_POINTS = 5_000  #: of a dataset, that say how near its cameras are
CUT_OFF = 1e-3  #: share of the points before cameras that may be too near to be drawn
RADIUS = 3  #: of a splat on the screen, standard deviations (rho of thesis 5.4)
COVER = 2  #: times that Gaussians cover a surface, at least, whose sizes are held
SPLATFACTO_CUBE = 10  #: scene scales, side of the cube that its random start fills (`random_scale`)


def initial_gaussians(
    dataset: Dataset,
    init: str | None,
    count: int,
    sh_degree: int,
    seed: int,
    features: int = 0,
    box: float | None = None,
    like_splatfacto: bool = False,
) -> Gaussians:
    """At most `count` Gaussians: isotropic, as wide as the mean distance to their three nearest neighbours.

    With `features` > 0 they have that many, normally distributed, and no harmonics.
    init: "mesh" samples the ground-truth mesh evenly, "points" takes the dataset's points, "random" fills the cube
    around the scene; None: see `start_of`
    box: side of that cube in sizes of the object; None: within the cameras
    like_splatfacto: turned at random, and "random" without a box fills `SPLATFACTO_CUBE` in colours of 0.5 to 0.78
    Raises InputError where `init` is not to be had.
    """
    rng, init = np.random.default_rng([seed, 0]), start_of(dataset, init)
    if init == "points":
        means, colors = _from_points(dataset, count, rng)
    elif init == "mesh":
        means, colors = _from_mesh(dataset, count, rng)
    else:
        means, colors = _at_random(dataset, count, rng, box, like_splatfacto)
    gaussians = gaussians_at(means, colors, -1 if features else sh_degree)
    if features:
        values = FEATURES * rng.standard_normal((features, gaussians.count))
        gaussians.features = upload(values.ravel())
    if like_splatfacto:
        turned = rng.standard_normal((4, gaussians.count))
        gaussians.quaternions = ad.Array4f(*map(upload, turned / np.linalg.norm(turned, axis=0)))
    return gaussians


def start_of(dataset: Dataset, init: str | None) -> str:
    """`init`, or the first of points, mesh, random that can be had."""
    return init or ("points" if dataset.ply_file_path else "mesh" if dataset.mesh_path else "random")


def starts_on_surface(dataset: Dataset, init: str | None, warms_up: bool) -> bool:
    """Whether Gaussians start on the surface and stay near it. warms_up: a warm start moves them"""
    return start_of(dataset, init) != "random" and not warms_up


def surface_normals(means: np.ndarray) -> np.ndarray:
    """[N, 3] unit normals of the surface on which points [N, 3] lie, of either sign: the direction in which the
    `NEIGHBOURS` nearest points spread least (Hoppe et al. 1992)."""
    from scipy.spatial import cKDTree  # a third of a second

    count = min(NEIGHBOURS, len(means))
    near = means[cKDTree(means).query(means, k=count)[1].reshape(len(means), count)]
    centred = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]


def lay_flat(gaussians: Gaussians) -> None:
    """Make Gaussians discs (`flattened`) along the surface on which their centres lie (`surface_normals`)."""
    normals = surface_normals(gaussians.to_numpy()["means"].astype(np.float64)).T
    x, y, z = np.where(normals[0] < 0, -normals, normals)
    turns = np.stack([1 + x, np.zeros_like(x), -z, y])  # the shortest turns from (1, 0, 0)
    gaussians.quaternions = ad.Array4f(*map(upload, turns / np.linalg.norm(turns, axis=0)))
    gaussians.log_scales = ad.Array3f(flattened(list(gaussians.log_scales)))


def spacing(means: np.ndarray) -> np.ndarray:
    """[N] metres: the mean distance of each of points [N, 3] to its three nearest neighbours, 1e-6 at least; 0.01 of a
    single one (Kerbl et al. 2023)."""
    from scipy.spatial import cKDTree

    count = len(means)
    neighbours = min(4, count)
    if neighbours < 2:
        return np.full(count, 0.01)
    distances = cKDTree(means).query(means, k=neighbours)[0][:, 1:]
    return np.maximum(distances.mean(axis=1), 1e-6)


def gaussians_at(means: np.ndarray, colors: np.ndarray, sh_degree: int) -> Gaussians:
    """Gaussians at means [N, 3] metres with sRGB colours [N, 3] in [0, 1]; sh_degree -1: without harmonics."""
    count = len(means)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3))
    sh[:, :1] = ((colors - 0.5) / SH_C0)[:, None]
    return Gaussians.from_numpy(
        {
            "means": means,
            "log_scales": np.repeat(np.log(spacing(means))[:, None], 3, axis=1),
            "quaternions": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            "logit_opacities": np.full(count, np.log(OPACITY / (1 - OPACITY))),
            "sh": sh,
        }
    )


def largest_scale(dataset: Dataset, gaussians: Gaussians, share: float, count: int) -> float:
    """Metres: the standard deviation of which `RADIUS` are a `share` of the longer side of a picture, seen from the
    training cameras' median distance to the middle of `gaussians`, those of the start. It is larger where `count` of
    them would not cover `COVER` times the surface that these lie on, each with 2 pi times its square.

    Of points spread at random over a plane the mean distance to three neighbours, squared, is 0.53 of the area of each.
    """
    arrays = gaussians.to_numpy()
    middle = np.median(arrays["means"], axis=0)
    cameras = [frame.camera for frame in dataset.train]
    seen = [max(c.width, c.height) / c.fx * np.linalg.norm(c.position - middle) for c in cameras]
    surface = np.exp(2.0 * arrays["log_scales"][is_near(arrays["means"]), 1]).sum() / 0.53
    return float(max(share * np.median(seen) / RADIUS, np.sqrt(COVER * surface / (2 * np.pi * count))))


def scene_scale(dataset: Dataset) -> float:
    """Metres: largest coordinate of the training cameras about their mean, Nerfstudio's unit of length."""
    centers = np.array([frame.camera.position for frame in dataset.train])
    return float(max(np.abs(centers - centers.mean(axis=0)).max(), 1e-6)) if len(centers) > 1 else 1.0


def scale_warning(dataset: Dataset) -> str:
    """A sentence where cameras stand so near to what they look at that some of it cannot be drawn, as with poses in
    kilometres; "" where they do not. Training is the same at any larger scale."""
    centre = focus_point(dataset)
    if not _is_cut_off(dataset, centre):
        return ""
    return (
        f"{dataset.root}: expected poses in metres, found training cameras {nearest_camera(dataset, centre):.2g} m "
        f"from what they look at: what is nearer to a camera than {NEAR} m is not drawn; scale poses and points up"
    )


def _is_cut_off(dataset: Dataset, centre: np.ndarray) -> bool:
    """Whether points or the mesh lie before training cameras and nearer than `NEAR`; without either, whether a tenth
    of the cameras are within twice that of `centre`: the random start then reaches there."""
    points = known_points(dataset)
    if points is None or not len(points):
        distances = [np.linalg.norm(frame.camera.position - centre) for frame in dataset.train]
        return bool(np.quantile(distances, 0.1) < 2 * NEAR)
    some = points[:: max(1, len(points) // SOME_POINTS)]
    poses = np.array([frame.camera.camera_from_world for frame in dataset.train])
    depth = some @ poses[:, 2, :3].T + poses[:, 2, 3]
    return bool(((depth > 0) & (depth < NEAR)).sum() > CUT_OFF * (depth > 0).sum())


def known_points(dataset: Dataset) -> np.ndarray | None:
    """[N, 3] metres: the dataset's points, else corners of its mesh's triangles, else None."""
    if dataset.ply_file_path is not None:
        return read_points(dataset.root / dataset.ply_file_path)[0].astype(np.float64)
    if dataset.mesh_path is not None and (dataset.root / dataset.mesh_path).exists():
        vertices, faces = read_mesh(dataset.root / dataset.mesh_path)
        return np.asarray(vertices[faces.ravel()], np.float64)
    return None


def distance_warning(dataset: Dataset) -> str:
    """A sentence where what the cameras look at is so far from the origin that single precision shows in pictures, as
    with the coordinates of an orbit; "" where it is not."""
    focus = focus_point(dataset)
    step = float(np.spacing(np.float32(np.abs(focus).max())))
    camera = min((f.camera for f in dataset.train), key=lambda c: float(np.linalg.norm(c.position - focus)))
    distance, away = float(np.linalg.norm(camera.position - focus)), float(np.linalg.norm(focus))
    pixel = max(distance, 1e-6) / max(camera.fx, camera.fy)
    if step < COARSE * pixel or away < distance:
        return ""
    return (
        f"{dataset.root}: expected poses about an origin near the object, found it {away:.2g} m away, "
        f"where single precision has steps of {step:.2g} m, {step / pixel:.2g} pixels: move the poses"
    )


def sun_warning(dataset: Dataset, iterations: int) -> str:
    """A sentence where estimated Suns (`sun = "unknown"`) will hardly be right; "" where nothing speaks against it."""
    lacking = []
    if iterations < MANY_STEPS:
        lacking.append(f"{iterations} iterations where it takes {MANY_STEPS} or more")
    if len(dataset.train) < MANY_PICTURES:
        lacking.append(f"{len(dataset.train)} training pictures where it takes {MANY_PICTURES} or more")
    if _holds_of_most(dataset, LOOKED_AT, lambda image: not _is_cut_out(image)):
        lacking.append("no silhouette, mask or alpha that separates the object from what is behind it")
    lack = " and ".join(lacking)
    return lack and f"{dataset.root}: expected enough to estimate unknown Suns, found {lack}: they may be far off"


def sky_warning(dataset: Dataset) -> str:
    """A sentence where the object stands before a black sky and is not cut out of most pictures: Gaussians then learn
    the sky, as black things around the object; "" elsewhere."""
    if not _holds_of_most(dataset, FEW_LOOKED_AT, _is_before_sky):
        return ""
    return (
        f"{dataset.root}: expected the object cut out of its black sky, found no alpha, silhouettes or masks: training "
        "takes the sky for black things around it and loses some dB; import with masks auto cuts it out"
    )


def few_left_warning(history: Sequence[Mapping[str, float]]) -> str:
    """A sentence where most Gaussians are gone at the end of training, by its history; "" where they are not."""
    counts = [int(entry["gaussians"]) for entry in history]
    if not counts or counts[-1] >= FEW_LEFT * max(counts):
        return ""
    return (
        f"{counts[-1]} Gaussians are left of {max(counts)}: most were pruned before they learned where the object is; "
        "take more iterations, a warm start, or points or a mesh to start from"
    )


def _holds_of_most(dataset: Dataset, count: int, holds: Callable[[Image], bool]) -> bool:
    """Of the training pictures, by `count` of them at most."""
    looked_at = dataset.train[:: -(-len(dataset.train) // count)]
    return 2 * sum(holds(load_image(dataset, frame)) for frame in looked_at) > len(looked_at)


def _is_before_sky(image: Image) -> bool:
    """Whether a picture is black, also at its border, and nothing separates the object from that."""
    if _is_cut_out(image):
        return False
    black = image.rgb.max(axis=2) < BLACK
    border = np.concatenate([black[0], black[-1], black[:, 0], black[:, -1]])
    return bool(black.mean() > SKY and border.mean() > 0.5)


def _is_cut_out(image: Image) -> bool:
    """Whether a picture's pixels tell the object from what is behind it, be it by alpha, silhouette or mask."""
    return float(((image.alpha < 0.5) | ~image.valid).mean()) >= CUT_AWAY


def _from_points(dataset: Dataset, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    if dataset.ply_file_path is None:
        raise InputError(f"{dataset.root}: init points expects ply_file_path in transforms.json, found none")
    points, colors = read_points(dataset.root / dataset.ply_file_path)
    if len(points) > count:
        chosen = np.sort(rng.choice(len(points), count, replace=False))
        points, colors = points[chosen], colors[chosen]
    return points.astype(np.float64), colors / 255.0


def _from_mesh(dataset: Dataset, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    if dataset.mesh_path is None or not (dataset.root / dataset.mesh_path).exists():
        raise InputError(f"{dataset.root}: init mesh expects a mesh.ply, found none")
    import trimesh

    mesh = trimesh.Trimesh(*read_mesh(dataset.root / dataset.mesh_path), process=False)
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=rng)
    return np.asarray(points), np.full((count, 3), 0.5)


def _at_random(
    dataset: Dataset, count: int, rng: np.random.Generator, box: float | None, like_splatfacto: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform in a cube about the point that the cameras look at: as wide as the nearest camera is far, or `box` times
    as wide as the object. Like splatfacto: about the mean of the cameras, and its constant harmonics are 0 to 1."""
    center = focus_point(dataset)
    half = 0.5 * nearest_camera(dataset, center)
    if box is not None:
        half = 0.5 * box * object_size(dataset)
    elif like_splatfacto:
        center = np.mean([frame.camera.position for frame in dataset.train], axis=0)
        half = 0.5 * SPLATFACTO_CUBE * scene_scale(dataset)
    means, colors = center + rng.uniform(-half, half, (count, 3)), rng.uniform(0, 1, (count, 3))
    return means, 0.5 + SH_C0 * colors if like_splatfacto else colors


def object_size(dataset: Dataset) -> float:
    """Metres: the longest side of the box around the dataset's mesh, or its points. InputError without either."""
    if dataset.mesh_path is not None and (dataset.root / dataset.mesh_path).exists():
        vertices, faces = read_mesh(dataset.root / dataset.mesh_path)
        points = vertices[faces.ravel()]
    elif dataset.ply_file_path is not None:
        points = read_points(dataset.root / dataset.ply_file_path)[0]
    else:
        raise InputError(f"{dataset.root}: init_box expects a mesh or points for the object's size, found none")
    return float(np.ptp(points, axis=0).max())
