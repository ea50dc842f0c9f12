"""From what the command line names to what is shown."""

from dataclasses import replace
from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.records import Dataset, Sun
from spacesim.data.store import read_dataset
from spacesim.learning.folder import run_name
from spacesim.methods import compose, load_run, load_scene
from spacesim.splat.compose import PlacedRun
from spacesim.splat.compose.posed_scene import PosedScene
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.path import path_from_scene
from spacesim.viewer.server import ViewerSetup, import_viser
from spacesim.viewer.state import SceneState
from spacesim.viewer.truth.source import dataset_folder

SUN = (45.0, 30.0)  #: azimuth and elevation at first, degrees, where no data say


def load_setup(path: Path, data: Path | None = None, out: Path | None = None) -> ViewerSetup:
    """The run in a folder, or the scene of a TOML file.

    data: a dataset of what is shown, for its cameras and truth; of a run, where it is not said, what it was trained on,
    if that is there;  out: folder where scenes are saved, the working directory by default
    Raises InputError where there is no such run, scene or dataset.
    """
    import_viser()
    dataset = read_dataset(data) if data is not None else None
    scene = _scene(path)
    composition = scene.composition
    runs = [placed.run for placed in composition.models]
    folders = [dataset_folder(run) for run in runs]
    if len(runs) == 1:
        if dataset is not None:
            folders = [dataset.root]
        elif folders[0] is not None:
            dataset = read_dataset(folders[0])
    poses = tuple(placed.pose for placed in scene.posed_at(0.0).models)
    sun, earth = scene.sun_at(0.0) or _initial_sun(dataset), scene.earth_at(0.0)
    return ViewerSetup(
        SceneRenderer(composition),
        SceneState(poses, replace(sun, earth=earth) if earth else sun),
        tuple(folders),
        dataset,
        out or Path(),
        scene.at(0.0).camera if scene.camera is not None else None,
        path_from_scene(scene),
    )


def _scene(path: Path) -> PosedScene:
    if path.suffix == ".toml":
        return load_scene(path)
    if not path.exists():
        raise InputError(f"{path}: expected the folder of a run or a scene file (.toml), found nothing")
    run = load_run(path)
    return PosedScene(compose([PlacedRun(run, name=run_name(path))]))  # type: ignore[arg-type]


def _initial_sun(dataset: Dataset | None) -> Sun:
    sun = dataset.frames[0].sun if dataset else None
    return sun or Sun.from_angles(*SUN)
