"""Scene files, and the scenes that are built in."""

from typing import Any

from spacesim.data.errors import InputError
from spacesim.scenes.config import ObjectConfig, SceneConfig, with_options

_BUILT_IN = {
    "boxsat": SceneConfig("boxsat", (ObjectConfig(spacecraft="boxsat"),)),
    "boxsat-pair": SceneConfig(  # the second at [-3, -3, -3] m (thesis 4.3.6)
        "boxsat-pair",
        (ObjectConfig(spacecraft="boxsat"), ObjectConfig(spacecraft="boxsat", position=(-3.0, -3.0, -3.0))),
    ),
}
BUILT_IN_SCENES = tuple(_BUILT_IN)


def read_scene(source: str, **options: Any) -> SceneConfig:
    """The built-in scene called `source`, with `options` changed (see `with_options`).

    Raises InputError, which lists the names, where there is none.
    """
    if source not in _BUILT_IN:
        raise InputError(f"scene: expected one of {', '.join(BUILT_IN_SCENES)}, found {source!r}")
    return with_options(_BUILT_IN[source], **options)
