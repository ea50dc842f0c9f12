"""Differentiable simulation and reconstruction of spacecraft under the Sun.

    import spacesim as ss

    data = ss.generate("boxsat", "data", suns=4, views=60, resolution=128)
    run = ss.train(data, "run", preset="demo", method="shadow-map")
    view = run.render(data.test[0].camera, sun=(40, 25))
    scores = ss.evaluate(run, data, "eval")
    pose = ss.refine_pose(run, image, camera, sun=(40, 25))

What there is stands in `spacesim.api`, which is imported when a name of it is first used: `import spacesim` itself
takes no time.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from spacesim.backend.llvm import name_llvm

if TYPE_CHECKING:
    from spacesim.api import *  # noqa: F403
else:  # or type checkers would take any name

    def __getattr__(name: str) -> object:
        is_private = name.startswith("_") and name != "__all__"
        is_module = not is_private and find_spec(f"{__name__}.{name}") is not None  # which an import looks for here
        if is_private or is_module:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        api = import_module(f"{__name__}.api")
        if name != "__all__" and name not in api.__all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = getattr(api, name)
        return globals()[name]


__version__ = "0.1.0"

name_llvm()


def __dir__() -> list[str]:
    return sorted([*import_module(f"{__name__}.api").__all__, "__version__"])
