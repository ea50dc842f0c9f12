"""The built-in spacecraft by name."""

from collections.abc import Callable
from functools import cache

from spacesim.data.errors import InputError
from spacesim.data.structure import did_you_mean
from spacesim.scenes.spacecraft.boxsat import boxsat
from spacesim.scenes.spacecraft.cubesat import cubesat
from spacesim.scenes.spacecraft.part import Spacecraft
from spacesim.scenes.spacecraft.small_body import small_body
from spacesim.scenes.spacecraft.telescope import telescope
from spacesim.scenes.spacecraft.upper_stage import upper_stage

_BUILT_IN: dict[str, Callable[[], Spacecraft]] = {
    "boxsat": boxsat,
    "telescope": telescope,
    "cubesat": cubesat,
    "upper-stage": upper_stage,
    "small-body": small_body,
}
SPACECRAFT = tuple(_BUILT_IN)  #: names of the built-in spacecraft


def spacecraft(name: str) -> Spacecraft:
    """The built-in spacecraft called `name`, made once (a quarter of a second): its meshes are not to be changed.
    InputError lists the names where there is none."""
    if not isinstance(name, str) or name not in _BUILT_IN:
        hint = did_you_mean(name, SPACECRAFT)
        raise InputError(f"spacecraft: expected one of {', '.join(SPACECRAFT)}, found {name!r}{hint}")
    return _make(name)


@cache
def _make(name: str) -> Spacecraft:
    return _BUILT_IN[name]()
