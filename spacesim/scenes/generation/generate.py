"""Sweep cameras and Suns over a scene and write the dataset."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from spacesim import backend
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError, expect
from spacesim.data.files import MAX_LIST_BYTES, JsonValue, read_json, write_json
from spacesim.data.geometry import Array, angles_from_direction
from spacesim.data.integrity.manifest import digest_of
from spacesim.data.lock import lock_folder
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.data.store import DEPTH_UNIT, DatasetWriter, FrameWriter, WrittenFrame, choose_depth_unit
from spacesim.data.transforms import MILLIMETRE, earth_keys
from spacesim.scenes.build import build
from spacesim.scenes.cameras.rig import PlannedView, RigConfig, TargetSphere, plan
from spacesim.scenes.cameras.sphere_rigs import RandomRig
from spacesim.scenes.config import QualityConfig, SceneConfig
from spacesim.scenes.generation.estimate import LONG, Estimate, measure, samples
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, raw_suffixes, versions, writing_threads
from spacesim.scenes.generation.lighting import is_sunlit, warn_of_dark_frames
from spacesim.scenes.generation.moves import cameras_inside, poses_in, warn_of_objects_inside
from spacesim.scenes.generation.overview import write_overview
from spacesim.scenes.generation.points import sample_surface_points
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM, EarthConfig
from spacesim.scenes.lights.eclipse import visible_fraction
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene
from spacesim.scenes.trajectory.rig import TrajectoryRig

SCHEMA = 2  #: of scene.json
COARSE_DEPTH = 0.01  #: of the scene's size: longer steps of depth pictures are reported

GenerationProgress = Callable[[int, int, str], None]
MakeFrames = Callable[[Job, Sequence[FrameSpec]], Iterator[WrittenFrame]]  #: makes frames and yields them
NamedViews = list[tuple[str, PlannedView]]  #: views with the names of their frames

_log = logging.getLogger(__name__)


def generate(
    config: SceneConfig,
    out: Path,
    resume: bool = False,
    progress: GenerationProgress | None = None,
    workers: int = 1,
    ray: str | None = None,
) -> Dataset:
    """Render the scene that `config` describes into the new folder `out` and return the dataset there.

    resume: complete a folder that an interrupted run of the same scene has left; progress: called with (frames done,
    frames in all, name of the frame last done); workers: processes of this machine; ray: address of a Ray cluster that
    shares the folder, "local" for one of this machine alone. The bytes depend on none of these. Raises InputError for a
    scene that cannot be built, a camera within an object or a folder that cannot be used or that another run works on,
    WorkError where disk, memory or processes fail.
    """
    _check_processes(workers, ray)
    sweep = _DatasetPlan(config)
    job = replace(sweep.job, root=Path(out).absolute())
    described = sweep.describe(config)
    with ExitStack() as alone:
        with _frame_maker(sweep.renderer, workers, ray) as make:
            alone.enter_context(lock_folder(job.root))
            writer = _open(Path(out), described, resume, sweep)
            _warn_of_coarse_depth(writer.depth_unit, sweep.scene)
            _warn_of_another_earth(config, sweep)
            warn_of_objects_inside(sweep.scene, sweep.specs[0].objects)
            made = _make_missing(
                writer, sweep.specs, lambda left: _make_frames(make, job, left, sweep.renderer), progress
            )
        written = _with_those_before(writer, sweep.specs, made)
        points, colors = sample_surface_points(sweep.renderer, config.quality.points, config.seed)
        sunlit = {frame.name: frame.sunlit for frame in written}
        more = {name: {**keys, "sunlit_fraction": sunlit[name]} for name, keys in sweep.keys.items()}
        dataset = writer.finish(
            _view_records(sweep.train),
            _view_records(sweep.test),
            points,
            colors,
            sweep.scene.mesh,
            distortion=config.camera.distortion,
            overview=lambda d: write_overview(d.root, d),
            more=more,
            written=written,
        )
        eclipsed = {name: keys.get("sun_visibility") == 0 for name, keys in more.items()}
        warn_of_dark_frames(sunlit, eclipsed, _against_dark_frames(config), isinstance(config.rig, RigConfig))
        return dataset


def _against_dark_frames(config: SceneConfig) -> str:
    """What a scene that is made with dark frames can say to have none."""
    limit = "" if config.min_sunlit else "min_sunlit = 0.05 (--min-sunlit)"
    if isinstance(config.rig, RandomRig) and config.rig.max_phase_deg is None:
        phase = "max_phase_deg = 90 keeps the Sun on the camera's side, clear of the Earth"
        return f"{phase}; {limit} leaves them out" if limit else phase
    if isinstance(config.rig, TrajectoryRig) and config.rig.max_phase_deg is None:
        limit = f"max_phase_deg = 90 in [rig]{f' or {limit}' if limit else ''}"
    return f"{limit} leaves them out" if limit else ""


def generate_part(
    config: SceneConfig,
    out: Path,
    frames: tuple[int, int | None],
    progress: GenerationProgress | None = None,
    workers: int = 1,
    ray: str | None = None,
) -> tuple[int, int, bool]:
    """Render some frames of a dataset into the folder `out`, where others may make theirs at the same time; returns
    (number of frames of this part, of all, whether the dataset has been completed and lacks none). `generate` with
    resume completes the dataset once all parts are there, and its bytes are the same as without parts.

    frames: (first, end) among all frames, training ones first, as slices have them; None: up to the last. Parts made in
    folders of their own can be copied into one. Raises as `generate`.
    """
    _check_processes(workers, ray)
    sweep = _DatasetPlan(config)
    first, end = frames
    count = len(sweep.specs)
    possible = 0 <= first < count and (end is None or first < end)
    expected = f"A:B, A from 0 to {count - 1}, the number of the last frame, and B above it"
    expect(possible, "frames", expected, f"{first}:{'' if end is None else end}")
    specs = sweep.specs[first:end]
    job = replace(sweep.job, root=Path(out).absolute(), shared=True)
    described = sweep.describe(config)
    with ExitStack() as alone, _frame_maker(sweep.renderer, workers, ray) as make:
        alone.enter_context(lock_folder(job.root, shared=True))
        writer = DatasetWriter(Path(out), described, True, raw_suffixes(sweep.job.camera), shared=True)
        _make_missing(writer, specs, lambda left: make(job, left), progress)
    completed = (job.root / "transforms.json").exists()
    return len(specs), count, completed and all(writer.has_frame(spec.name) for spec in sweep.specs)


def _check_processes(workers: int, ray: str | None) -> None:
    expect(workers >= 1, "workers", "at least 1", workers)
    expect(ray is None or workers == 1, "workers", "none beside ray, which counts for itself", workers)


def _make_missing(
    writer: FrameWriter,
    specs: Sequence[FrameSpec],
    make: Callable[[list[FrameSpec]], Iterator[WrittenFrame]],
    progress: GenerationProgress | None,
) -> list[WrittenFrame]:
    """Make those of the frames that are not there, and report each; returns these."""
    missing = [spec for spec in specs if not writer.has_frame(spec.name)]
    total, complete = len(specs), len(specs) - len(missing)
    if progress is not None and complete:
        progress(complete, total, "")
    made = []
    for done, frame in enumerate(make(missing), start=complete + 1):
        made.append(frame)
        if progress is not None:
            progress(done, total, frame.name)
    return made


def _with_those_before(
    writer: FrameWriter, specs: Sequence[FrameSpec], made: Sequence[WrittenFrame]
) -> list[WrittenFrame]:
    """All frames, in their order: those made now, and what the files of the others say."""
    there = {frame.name: frame for frame in made}
    others = [spec.name for spec in specs if spec.name not in there]
    with ThreadPoolExecutor() as pool:
        there |= zip(others, pool.map(writer.read_written, others), strict=True)
    return [there[spec.name] for spec in specs]


def _warn_of_coarse_depth(unit: float, scene: Scene) -> None:
    size = 2 * scene.bounding_sphere[1]
    if unit > COARSE_DEPTH * size:
        _log.warning(
            "depth/*.png: steps of %g m, to reach the farthest view, are coarse for %.3g m; gt/*.exr has depth in full",
            unit,
            size,
        )


def _warn_of_another_earth(config: SceneConfig, sweep: "_DatasetPlan") -> None:
    """Where pictures show an Earth elsewhere than labels have theirs."""
    background = config.background
    if background is None or not background.earth or not background.share or background.is_fixed(config.earth):
        return
    if any("earth_direction" in keys for keys in sweep.keys.values()):
        _log.warning(
            "generate: the Earth drawn behind the objects is not that of earth_direction, which lights them or hides "
            'the Sun; [earth] and placement = "fixed" in [background] draw that one'
        )


def _open(root: Path, described: dict[str, JsonValue], resume: bool, sweep: "_DatasetPlan") -> DatasetWriter:
    """The writer of the folder. Only scene.json says which scene frames are of. Where it is broken, nothing is
    resumed; where it is gone, resuming says that they are of the scene asked for, and it is written again."""
    path = root / "scene.json"
    if resume and path.exists():
        try:
            read_json(path, MAX_LIST_BYTES)
        except InputError as error:
            raise InputError(
                f"{error}; if the frames there are of the scene asked for, delete this file and resume again, "
                "else choose another folder"
            ) from None
    frames = {file.stem for file in root.glob("gt/*.exr")} if resume and not path.exists() else set()
    if frames and frames <= {spec.name for spec in sweep.specs}:
        _log.warning("%s is missing: the frames there are taken to be of the scene asked for", path)
        write_json(path, described)
    return DatasetWriter(root, described, resume, raw_suffixes(sweep.job.camera))


def estimate(config: SceneConfig, out: Path) -> Estimate:
    """Time and disk that `generate` needs for the frames that are not in `out` yet; leaves no file behind.

    Raises InputError as `generate` does.
    """
    sweep = _DatasetPlan(config)
    there = replace(sweep.job, root=Path(out).absolute()).writer
    left = [spec for spec in sweep.specs if not there.has_frame(spec.name)]
    with TemporaryDirectory(prefix="spacesim-") as folder:
        maker = FrameMaker(replace(sweep.job, root=Path(folder)), sweep.renderer)
        return measure(maker, samples(left or sweep.specs), left, there.root)


@contextmanager
def _frame_maker(renderer: Renderer, workers: int, ray: str | None) -> Iterator[MakeFrames]:
    """Who makes the frames: a Ray cluster, several processes or this one, with its renderer."""
    if ray is not None:
        from spacesim.scenes.generation.cluster import join_cluster, make_on_cluster

        with join_cluster(ray):
            yield make_on_cluster
    elif workers > 1:
        from spacesim.scenes.generation.workers import make_in_processes

        yield partial(make_in_processes, count=workers)
    else:
        yield lambda job, specs: FrameMaker(job, renderer).make(specs)


def _make_frames(make: MakeFrames, job: Job, specs: Sequence[FrameSpec], renderer: Renderer) -> Iterator[WrittenFrame]:
    """Frames, as they are made. A long run begins with a few, from which time and size are estimated."""
    names: set[str] = set()
    if len(specs) > LONG:
        first = samples(specs)
        estimated = measure(FrameMaker(job, renderer), first, specs, job.root)
        _log.info("generate: %s", estimated)
        estimated.check(job.root)
        names = {spec.name for spec in first}
        yield from map(job.writer.read_written, sorted(names))
    yield from make(job, [spec for spec in specs if spec.name not in names])


class _DatasetPlan:
    """A scene that is built and loaded, with all of its frames. Raises InputError for a camera within an object."""

    def __init__(self, config: SceneConfig) -> None:
        self.scene = build(config)
        self.train, self.test = plan_views(self.scene, config)
        quality = config.quality
        self.renderer = Renderer(self.scene, quality.spp, quality.max_depth, config.camera.distortion)
        self._set_frames(quality)
        self.keys = {name: self._keys_of(name, view) for name, view in (*self.train, *self.test)}
        self._refuse_cameras_inside(config)
        self.left_out: dict[str, list[int]] = {}  # numbers that views would have had, by train and test
        if config.min_sunlit:
            self._leave_out_dark_views(config.min_sunlit)
            self._set_frames(quality)
        threads = writing_threads(1)
        self.job = Job(self.scene, config.camera, quality, config.seed, Path(), threads, config.background)
        self.job = replace(self.job, depth_unit=depth_unit(self.scene, [*self.train, *self.test]))

    def describe(self, config: SceneConfig) -> dict[str, JsonValue]:
        """scene.json of all frames."""
        described = describe(self.scene, config, self.train, self.test)
        return {**described, "left_out": self.left_out} if self.left_out else described

    def _set_frames(self, quality: QualityConfig) -> None:
        """To those of the views, training ones first."""
        views = [(quality.spp, *planned) for planned in self.train]
        views += [(quality.resolved_test_spp, *planned) for planned in self.test]
        self.specs = [self._frame(i, *planned) for i, planned in enumerate(views)]

    def _leave_out_dark_views(self, least: float) -> None:
        """Number the others anew. Raises InputError where no training view stays."""
        lit = {spec.name for spec in self.specs if is_sunlit(self.renderer, spec, least)}
        kept, keys = {}, dict[str, dict[str, JsonValue]]()
        for some, named in {"train": self.train, "test": self.test}.items():
            self.left_out[some] = [i for i, (name, _) in enumerate(named) if name not in lit]
            stay = [(name, view) for name, view in named if name in lit]
            kept[some] = _numbered(some, [view for _, view in stay])
            keys |= {new: self.keys[old] for (new, _), (old, _) in zip(kept[some], stay, strict=True)}
        if not kept["train"]:
            expected = f"a training frame of whose object at least {least:g} is sunlit"
            raise InputError(f"min_sunlit: expected {expected}, found none of {len(self.train)}")
        if left := len(self.specs) - len(lit):
            _log.info(
                "generate: %d of %d frames are left out, as less than %g of their object is sunlit or none is seen",
                left,
                len(self.specs),
                least,
            )
        self.train, self.test, self.keys = kept["train"], kept["test"], keys

    def _refuse_cameras_inside(self, config: SceneConfig) -> None:
        positions = np.stack([spec.camera.position for spec in self.specs])
        inside = cameras_inside(self.scene, self.renderer, positions, [spec.objects for spec in self.specs])
        if inside.any():
            name = self.specs[int(inside.argmax())].name
            field = "distance" if hasattr(config.rig, "distance") else "rig"
            raise InputError(f"{field}: expected cameras outside of {config.name}, found that of {name} within a part")

    def _frame(self, index: int, spp: int, name: str, view: PlannedView) -> FrameSpec:
        sunlight, earth = 1.0, self._earth_in(name, view)
        if view.earth is not None and earth is None:  # else it hides the Sun as it is traced
            sunlight = visible_fraction(view.sun.direction, view.earth, self.scene.sun.angular_radius)
        return FrameSpec(
            index, name, view.camera, view.sun, spp, view.exposure, earth, sunlight, view.sky_from_world, view.objects
        )

    def _earth_in(self, name: str, view: PlannedView) -> EarthConfig | None:
        """The scene's Earth, if it has one, where that view has it. Raises InputError for a place within it."""
        earth = self.scene.earth
        if view.earth is not None and not np.linalg.norm(view.earth) > 1e3 * EARTH_RADIUS_KM:
            distance = f"{np.linalg.norm(view.earth) / 1e3:.6g} km in {name}"
            raise InputError(
                f"earth: expected the Earth's centre beyond its radius of {EARTH_RADIUS_KM} km, found {distance}"
            )
        return earth if view.earth is None or earth is None else replace(earth, **_place_of(view.earth))

    def _keys_of(self, name: str, view: PlannedView) -> dict[str, JsonValue]:
        """What transforms.json says of a frame beside its camera and its Sun's direction."""
        earth = view.earth
        if earth is None and self.scene.earth is not None:
            earth = 1e3 * EARTH_RADIUS_KM * self.scene.earth.distance * self.scene.earth.direction
        visible = None
        if earth is not None:
            visible = visible_fraction(view.sun.direction, earth, self.scene.sun.angular_radius)
        keys: dict[str, JsonValue] = {"time": view.time, "epoch": view.epoch, "exposure": view.exposure}
        if view.objects:
            poses = poses_in(self.scene, view.objects)
            moves = [{"id": number, "world_from_object": poses[number - 1].tolist()} for number in view.objects]
            keys["objects"] = moves
        if (lit_by := self._earth_in(name, view)) is not None:
            keys |= earth_keys(lit_by.light)
        elif view.earth is not None:
            keys |= earth_keys(_dark_earth(view.earth))
        return {key: value for key, value in {**keys, "sun_visibility": visible}.items() if value is not None}


def _place_of(earth: Array) -> dict[str, float]:
    """Where the Earth is, as `EarthConfig` says it, of the vector [3] to its centre, metres."""
    azimuth, elevation = angles_from_direction(earth)
    altitude = float(np.linalg.norm(earth)) * 1e-3 - EARTH_RADIUS_KM
    return {"azimuth_deg": azimuth, "elevation_deg": elevation, "altitude_km": altitude}


def _dark_earth(earth: Array) -> Earth:
    """One that hides the Sun and gives no light, of the vector [3] to its centre, metres."""
    radius = math.asin(1e3 * EARTH_RADIUS_KM / float(np.linalg.norm(earth)))
    return Earth(earth, math.degrees(radius), albedo=0.0)


def plan_views(scene: Scene, config: SceneConfig) -> tuple[NamedViews, NamedViews]:
    """The named training and test views."""
    target = TargetSphere(*scene.bounding_sphere, scene.earth)
    train, test = plan(config.rig.located(config.folder or Path()), target, config.camera, config.seed)
    return _numbered("train", train), _numbered("test", test)


def _numbered(some: str, views: Sequence[PlannedView]) -> NamedViews:
    return [(f"{some}_{i:05d}", view) for i, view in enumerate(views)]


def describe(scene: Scene, config: SceneConfig, train: NamedViews, test: NamedViews) -> dict[str, JsonValue]:
    """scene.json: all that is needed to render the same dataset again."""
    files = config.rig.located(config.folder or Path()).files()
    return {
        "schema": SCHEMA,
        **({"files": [{"name": path.name, "sha256": digest_of(path)} for path in files]} if files else {}),
        **scene.describe(),
        "mesh": [_mesh_counts(scene, i) for i in range(1, len(scene.objects) + 1)],
        "suns": {"train": _angles(train), "test": _angles(test)},
        **({DEPTH_UNIT: unit} if (unit := depth_unit(scene, [*train, *test])) != MILLIMETRE else {}),
        **({"test_cameras": cameras} if (cameras := config.rig.shared_cameras) else {}),
        "exposure": config.camera.exposure,
        "seed": config.seed,
        "spp": config.quality.spp,
        "test_spp": config.quality.resolved_test_spp,
        "config": config.to_json(),
        "backend": backend.select(),
        "versions": versions(),
    }


def depth_unit(scene: Scene, named: NamedViews) -> float:
    """Metres a step of depth pictures, with which 16 bits reach all that the views may see."""
    still, farthest = _corners(scene), 0.0
    alone: list[Array] = []
    if any(view.objects for _, view in named):
        own = [replace(item, world_from_object=np.eye(4)) for item in scene.objects]
        alone = [_corners(replace(scene, objects=(item,))) for item in own]
    for _, view in named:
        points, forward = still, view.camera.world_from_camera[:3, 2]
        if view.objects:
            placed = zip(alone, poses_in(scene, view.objects), strict=True)
            points = np.concatenate([corners @ pose[:3, :3].T + pose[:3, 3] for corners, pose in placed])
        farthest = max(farthest, float((points @ forward).max() - view.camera.position @ forward))
    return choose_depth_unit(farthest)


def _corners(scene: Scene) -> Array:
    """[N, 3] vertices of the convex hull, of all that lies in a plane all."""
    points: Array = scene.mesh.vertices
    with suppress(QhullError):
        points = points[ConvexHull(points).vertices]
    return points


def _mesh_counts(scene: Scene, object_id: int) -> dict[str, int]:
    """How many vertices and faces of mesh.ply, where objects stand in the order of their ids, are an object's."""
    meshes = [placed.mesh for placed in scene.parts if placed.object_id == object_id]
    vertices, faces = (sum(len(getattr(mesh, name)) for mesh in meshes) for name in ("vertices", "faces"))
    return {"object": object_id, "vertices": vertices, "faces": faces}


def _angles(named: NamedViews) -> list[list[float]]:
    """Azimuth and elevation, degrees, of each Sun once, in the order of the views."""
    return [list(angles) for angles in dict.fromkeys(view.sun.angles for _, view in named)]


def _view_records(named: NamedViews) -> list[tuple[str, Camera, Sun]]:
    return [(name, view.camera, view.sun) for name, view in named]
