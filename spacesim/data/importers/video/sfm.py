"""Structure from motion: poses, one camera and points of pictures of one object, by pycolmap on the CPU.

J. L. Schoenberger, J.-M. Frahm, "Structure-from-motion revisited", CVPR 2016.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.importers.video.adjust import adjust, doubt_focal, doubt_given, is_bent, library, run, soft_pixels
from spacesim.data.importers.video.model import SfmModel, median_angle, with_points
from spacesim.data.importers.video.path import Features, begun_anew, is_smooth, on_path, without_strays

SEED = 1
EXHAUSTIVE = 60, 300  #: pictures in time order, in any: up to so many each is matched with each
OVERLAP = 12  #: of more: each is matched with so many next ones, and 2, 4, 8, ... beyond
_PEAK = 0.0027  # of SIFT's difference of Gaussians; 0.0067 by default: a spacecraft has little texture
_FEATURES = 8192
_LEAST_FEATURES, _LEAST_MATCHES = 50, 15
_FLAT = 0.8  # share of pairs that a homography explains wholly, from which on there is no parallax
FOCAL = 0.2, 90.0  #: of a camera, in longer sides of its pictures
_LEAST_ANGLE = 2.0  # degrees: of the median point, from which on its depth is known
_STRICT = 480  # pixels of the longer side for which a match may be off by one; up to four: all of a small object looks
# like a plane otherwise
_ROUNDS = 2  # of a film's cameras put on its path and its points made anew, before the last

Progress = Callable[[str, int, int], None]
"""Called with the step's name, how much of it is done, and of how much."""


@dataclass(frozen=True)
class Matches:
    """What was found before any pose was."""

    features: float  #: median number of a picture
    pairs: int  #: of pictures that share enough matches
    flat_pairs: int  #: of these, such that a homography explains: no parallax, or a plane


def reconstruct(
    folder: Path,
    names: Sequence[str],
    size: tuple[int, int],
    workspace: Path,
    masks: Path | None = None,
    focal: float | None = None,
    times: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> SfmModel:
    """Poses of the pictures folder/NAME, all of one camera and of `size` (width, height).

    masks: a folder of NAME.png, features are taken where they are not black
    focal: pixels, where it is known; else it is estimated. A warning is logged where others fit as well, or better than
    the known one
    times: of the pictures in their film, rising strictly, of any unit: cameras are then begun anew between their
    neighbours where that fits better, put on a smooth path, if theirs is one (`path.is_smooth`), and left out with a
    warning where they stray (`path.without_strays`)
    workspace: an empty folder for what is needed meanwhile

    Raises InputError where pycolmap is missing, and where the pictures do not fix poses: too few features or matches,
    no parallax, less than half of the pictures in one model, an absurd one.

    The lens has no distortion unless that brings in pictures or a twentieth less error: a small object before a black
    sky says little of it.
    """
    colmap = library()
    report = progress or (lambda step, done, total: None)
    database = workspace / "database.db"
    colmap.logging.minloglevel = 3
    colmap.set_random_seed(SEED)
    reader = colmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    if masks is not None:
        reader.mask_path = str(masks)
    if focal is not None:
        reader.camera_params = f"{focal},{size[0] / 2},{size[1] / 2},0"
    _find_features(colmap, database, folder, names, reader, report)
    strict = min(max(max(size) / _STRICT, 1.0), 4.0)
    _match(colmap, database, len(names), times is not None, strict, report)
    matches = _matches(colmap, database)
    if matches.features < _LEAST_FEATURES:
        raise InputError(
            f"{folder.name}: expected at least {_LEAST_FEATURES} features in a picture, found {matches.features:.0f} "
            "in the median one: too dark, too blurred or too small an object"
        )
    if matches.pairs < len(names) // 2:
        raise InputError(
            f"{folder.name}: expected neighbouring pictures to share {_LEAST_MATCHES} matches or more, found "
            f"{matches.pairs} such pairs of {len(names)} pictures: too few matches"
        )
    find = partial(_map, colmap, database, folder, workspace, focal, strict, len(names), report)
    models, distorted = find(False), False
    if is_bent(colmap, models, len(names), focal is None):
        others = find(True)
        if others and (not models or others[0].num_reg_images() >= models[0].num_reg_images()):
            models, distorted = others, True
            adjust(colmap, models[0], focal is None, distorted)
    if not models:
        raise InputError(f"{folder.name}: {_why_none(matches)}")
    sizes = [one.num_reg_images() for one in models]
    options = _mapping(colmap, focal, strict, distorted)
    most = options.mapper.filter_max_reproj_error
    triangulated = partial(_triangulated, colmap, database, folder, workspace, options)
    models[0] = triangulated(models[0])
    adjust(colmap, models[0], focal is None, distorted)
    model, features = _model(models[0], sizes)
    if times is not None:
        by_name = dict(zip(names, times, strict=True))
        when = np.array([by_name[name] for name in model.names], np.float64)
        soft = soft_pixels(*size)
        model = begun_anew(model, features, when, soft)
        if is_smooth(model, features, when, soft):
            for _ in range(_ROUNDS):
                model = on_path(model, features, when, soft)
                model, features = _model(triangulated(_with_poses(colmap, models[0], model)), sizes)
            model = on_path(model, features, when, soft)
        model = without_strays(model, when)
        model = with_points(model, np.flatnonzero(model.errors <= most).tolist())
    model = _checked(model, matches, len(names), folder.name)
    if focal is None:
        doubt_focal(colmap, models[0], model, distorted)
    else:
        doubt_given(colmap, models[0], distorted)
    return model


def _find_features(
    colmap: ModuleType, database: Path, folder: Path, names: Sequence[str], reader: object, report: Progress
) -> None:
    options = colmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.peak_threshold, options.sift.max_num_features = _PEAK, _FEATURES
    colmap.Database.open(database).close()
    single = colmap.CameraMode.SINGLE
    colmap.import_images(database, folder, camera_mode=single, image_names=list(names), options=reader)  # numbers them
    for start in range(0, len(names), 8):
        report("features", start, len(names))
        extract = partial(
            colmap.extract_features,
            database,
            folder,
            list(names[start : start + 8]),
            camera_mode=single,
            reader_options=reader,
            extraction_options=options,
            device=colmap.Device.cpu,
        )
        run(colmap, lambda token, extract=extract: extract(cancellation_token=token))  # type: ignore[misc]


def _match(colmap: ModuleType, database: Path, count: int, ordered: bool, strict: float, report: Progress) -> None:
    options = colmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = 1
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.max_error = strict
    verification.ransac.random_seed = SEED
    report("matches", 0, 1)
    shared = {
        "matching_options": options,
        "verification_options": verification,
        "device": colmap.Device.cpu,
    }
    if count > EXHAUSTIVE[0 if ordered else 1]:
        near, far = colmap.SequentialPairingOptions(), colmap.SequentialPairingOptions()
        near.overlap = far.overlap = OVERLAP
        near.quadratic_overlap = False
        works = [partial(colmap.match_sequential, pairing_options=pairing) for pairing in (near, far)]
    else:
        works = [partial(colmap.match_exhaustive, pairing_options=colmap.ExhaustivePairingOptions())]
    for match in works:
        run(colmap, lambda token, match=match: match(database, cancellation_token=token, **shared))  # type: ignore[misc]
    report("matches", 1, 1)


def _matches(colmap: ModuleType, path: Path) -> Matches:
    database = colmap.Database.open(path)
    try:
        counts = [database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()]
        pairs = [pair for _, pair in zip(*_columns(database.read_two_view_geometries()), strict=True)]
    finally:
        database.close()
    used = [pair for pair in pairs if len(pair.inlier_matches) >= _LEAST_MATCHES]
    kinds = colmap.TwoViewGeometryConfiguration
    flat = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
    return Matches(float(np.median(counts)), len(used), sum(pair.config in flat for pair in used))


def _columns(pairs: Any) -> Any:
    """(numbers, geometries), whichever of the two forms pycolmap's versions give."""
    return pairs if isinstance(pairs, tuple) else (list(zip(*pairs, strict=True)) or [(), ()])


def _map(
    colmap: ModuleType,
    database: Path,
    folder: Path,
    workspace: Path,
    focal: float | None,
    strict: float,
    count: int,
    report: Progress,
    distorted: bool,
) -> list[Any]:
    """Models, the largest first, empty where none was found. strict: pixels that a match may be off"""
    options = _mapping(colmap, focal, strict, distorted)
    registered = 0

    def another() -> None:
        nonlocal registered
        registered += 1

    output = workspace / ("distorted" if distorted else "plain")
    output.mkdir()
    models = run(
        colmap,
        lambda token: colmap.incremental_mapping(
            database, folder, output, options, next_image_callback=another, cancellation_token=token
        ),
        lambda: report("poses", min(registered, count), count),
    )
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def _mapping(colmap: ModuleType, focal: float | None, strict: float, distorted: bool) -> Any:
    """COLMAP's options of how poses and points are found."""
    options = colmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = 3
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = 100.0  # telescopes
    options.triangulation.max_focal_length_ratio = 100.0
    options.mapper.init_min_tri_angle = 8.0  # neighbours in a video see the object from almost one side
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 20
    options.mapper.init_max_error, options.mapper.abs_pose_max_error = strict, 3 * strict
    off = max(strict, 2.0)
    options.mapper.filter_max_reproj_error = off
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = off
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = focal is None
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = distorted
    return options


def _triangulated(colmap: ModuleType, database: Path, folder: Path, workspace: Path, options: Any, model: Any) -> Any:
    """The model with its points made anew: tracks that broke while poses were worse are whole, and hold together
    parts of a film that stood askew."""
    output = workspace / "triangulated"
    output.mkdir(exist_ok=True)
    return run(
        colmap,
        lambda token: colmap.triangulate_points(
            model, database, folder, output, options=options, cancellation_token=token
        ),
    )


def _with_poses(colmap: ModuleType, model: Any, found: SfmModel) -> Any:
    """The model with the poses that were found since."""
    for name, pose in zip(found.names, found.world_from_camera, strict=True):
        turn = pose[:3, :3].T
        placed = colmap.Rigid3d(colmap.Rotation3d(turn), -turn @ pose[:3, 3])
        model.find_image_with_name(name).frame.rig_from_world = placed
    return model


def _model(model: Any, sizes: list[int]) -> tuple[SfmModel, Features]:
    """(the model, what its pictures show of its points)."""
    images = sorted((model.images[number] for number in model.reg_image_ids()), key=lambda image: image.name)
    poses = []
    for image in images:
        world_from_camera = np.eye(4)
        world_from_camera[:3] = image.cam_from_world().inverse().matrix()
        poses.append(world_from_camera)
    camera = model.cameras[images[0].camera_id]
    points = [model.points3D[number] for number in sorted(model.points3D)]
    numbers = {image.image_id: k for k, image in enumerate(images)}
    seen = [[numbers[e.image_id] for e in point.track.elements if e.image_id in numbers] for point in points]
    focal, cx, cy, k1 = camera.params.tolist()
    shown = [image.get_observation_points2D() for image in images]
    rows = {number: k for k, number in enumerate(sorted(model.points3D))}
    features = Features(
        np.repeat(np.arange(len(images)), [len(found) for found in shown]),
        np.array([rows[feature.point3D_id] for found in shown for feature in found], int),
        np.array([feature.xy for found in shown for feature in found]).reshape(-1, 2),
    )
    found = SfmModel(
        names=tuple(image.name for image in images),
        world_from_camera=np.array(poses),
        focal=focal,
        centre=(cx, cy),
        k1=k1,
        width=camera.width,
        height=camera.height,
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points]),
        seen_by=tuple(tuple(dict.fromkeys(frames)) for frames in seen),
        sizes=tuple(sizes),
    )
    return found, features


def check_focal(focal: float, size: tuple[int, int], name: str, hint: str = "") -> None:
    """Raises InputError in the name of what says the focal length (pixels) where no camera has it."""
    ratio = focal / max(size)
    if not FOCAL[0] < ratio < FOCAL[1]:
        expected = f"a focal length of {FOCAL[0]:g} to {FOCAL[1]:g} times the longer side"
        raise InputError(f"{name}: expected {expected}, found {ratio:.3g}{hint}")


def _checked(model: SfmModel, matches: Matches, count: int, name: str) -> SfmModel:
    """Raises InputError for a model that cannot be believed."""
    registered = len(model.names)
    if len(model.points) < 30 or registered < 3:
        raise InputError(f"{name}: {_why_none(matches)}")
    angle = median_angle(model)
    if angle < _LEAST_ANGLE:
        raise InputError(
            f"{name}: expected cameras that see the object from several sides, found them within {angle:.1f} degrees: "
            "no parallax"
        )
    if registered < 0.5 * count:
        others = ", ".join(map(str, model.sizes[1:])) or "none"
        raise InputError(
            f"{name}: expected one model of at least half of the {count} pictures, found one of {registered} (others: "
            f"{others}): pictures between them are missing or share too few features"
        )
    check_focal(model.focal, (model.width, model.height), name, ": a broken model; name the field of view with fov")
    behind = np.mean(model.depths <= 0)
    if behind > 0.05:
        raise InputError(
            f"{name}: expected the object before the cameras, found it behind {100 * behind:.0f} % of them: a "
            "mirrored or broken model"
        )
    return model


def _why_none(matches: Matches) -> str:
    if matches.pairs and matches.flat_pairs > _FLAT * matches.pairs:
        return (
            f"expected cameras that move around the object, found {matches.flat_pairs} of {matches.pairs} pairs of "
            "pictures that a rotation or a plane explains: no parallax"
        )
    return (
        f"expected pictures that fit together, found {matches.pairs} pairs with matches and no poses that agree with "
        "them: too few matches"
    )
