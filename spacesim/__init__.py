"""Differentiable simulation and reconstruction of spacecraft under the Sun.

    import spacesim as ss

    data = ss.generate("boxsat", "data", suns=4, views=60, resolution=128)
    run = ss.train(data, "run", preset="demo", method="shadow-map")
    view = run.render(data.test[0].camera, sun=(40, 25))
    scores = ss.evaluate(run, data, "eval")
    pose = ss.refine_pose(run, image, camera, sun=(40, 25))

Everything is imported when it is first used: `import spacesim` itself takes no time.
"""

from typing import TYPE_CHECKING, Any

from spacesim.backend.llvm import name_llvm
from spacesim.data.errors import InputError, WorkError

if TYPE_CHECKING:
    from spacesim.api import (
        BackendError,
        Camera,
        CameraClient,
        Composed,
        Dataset,
        FoundPose,
        Frame,
        Gaussians,
        Image,
        NerfConfig,
        NerfRun,
        PosedScene,
        PoseRig,
        RefinedPose,
        Rendering,
        RenderOutput,
        Run,
        SceneConfig,
        Sun,
        SunEstimate,
        TrainConfig,
        Truth,
        compose,
        estimate_sun,
        evaluate,
        find_pose,
        generate,
        import_dataset,
        load_depth,
        load_image,
        load_run,
        load_scene,
        load_truth,
        preset,
        read_dataset,
        read_scene,
        refine_pose,
        render,
        train,
        write_report,
    )

__version__ = "0.1.0"

__all__ = [
    "BackendError",
    "Camera",
    "CameraClient",
    "Composed",
    "Dataset",
    "FoundPose",
    "Frame",
    "Gaussians",
    "Image",
    "InputError",
    "NerfConfig",
    "NerfRun",
    "PoseRig",
    "PosedScene",
    "RefinedPose",
    "RenderOutput",
    "Rendering",
    "Run",
    "SceneConfig",
    "Sun",
    "SunEstimate",
    "TrainConfig",
    "Truth",
    "WorkError",
    "compose",
    "estimate_sun",
    "evaluate",
    "find_pose",
    "generate",
    "import_dataset",
    "load_depth",
    "load_image",
    "load_run",
    "load_scene",
    "load_truth",
    "preset",
    "read_dataset",
    "read_scene",
    "refine_pose",
    "render",
    "train",
    "write_report",
]

name_llvm()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'spacesim' has no attribute {name!r}")
    from spacesim import api

    globals()[name] = getattr(api, name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
