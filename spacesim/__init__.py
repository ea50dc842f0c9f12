"""Differentiable simulation and reconstruction of spacecraft under the Sun.

    import spacesim as ss

    data = ss.generate("boxsat", "data", suns=4, views=60, resolution=128)
    run = ss.train(data, "run", preset="demo", method="shadow-map")
    view = run.render(data.test[0].camera, sun=(40, 25))
    scores = ss.evaluate(run, data, "eval")
    pose = ss.refine_pose(run, image, camera, sun=(40, 25))

What there is stands in `spacesim.api`. Each name is imported from its own module when it is first used: `import
spacesim` itself takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from spacesim.backend.llvm import name_llvm
from spacesim.version import __version__ as __version__

_NAMES = {
    "api": "compose evaluate generate import_dataset render train write_report",
    "backend.selection": "BackendError",
    "data.earth": "Earth",
    "data.errors": "InputError WorkError",
    "data.images": "load_image",
    "data.records": "Camera Dataset Frame Image Sun Truth",
    "data.store": "load_depth load_truth",
    "data.transforms": "read_dataset",
    "learning.rendering": "Rendering",
    "methods": "load_run load_scene preset",
    "nerf.config": "NerfConfig",
    "nerf.run": "NerfRun",
    "scenes.config": "SceneConfig",
    "scenes.scenefile": "read_scene",
    "scenes.spacecraft": "spacecraft",
    "scenes.trajectory.rig": "PoseRig",
    "serve.client": "CameraClient",
    "splat.compose": "PosedScene",
    "splat.compose.output": "Composed",
    "splat.fit": "estimate_sun",
    "splat.pose": "FoundPose RefinedPose find_pose refine_pose",
    "splat.raster.cameras": "Pinhole",
    "splat.raster.gaussians": "Gaussians",
    "splat.raster.render": "RenderOutput",
    "splat.run": "Run",
    "splat.sun_search": "SunEstimate",
    "splat.train.config": "TrainConfig",
}
"""{module: public names that are imported from it}: those of `spacesim.api.__all__`, which type checkers read."""

_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

if TYPE_CHECKING:
    from spacesim.api import *  # noqa: F403
else:  # or type checkers would take any name
    __all__ = sorted(_MODULES)

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        return globals()[name]


name_llvm()


def __dir__() -> list[str]:
    return [*_MODULES, "__version__"]
