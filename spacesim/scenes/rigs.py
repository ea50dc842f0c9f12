"""The kinds of rig, as scene files name them."""

from dataclasses import fields

from spacesim.scenes.cameras.path_rigs import ApproachRig, FlyAroundRig
from spacesim.scenes.cameras.rig import Rig
from spacesim.scenes.cameras.sphere_rigs import FibonacciRig, PolarArcRig, RandomRig
from spacesim.scenes.trajectory.rig import FileRig
from spacesim.scenes.trajectory.spice import SpiceRig

RIGS: dict[str, type[Rig]] = {
    "fibonacci": FibonacciRig,
    "polar-arc": PolarArcRig,
    "random": RandomRig,
    "approach": ApproachRig,
    "fly-around": FlyAroundRig,
    "file": FileRig,
    "spice": SpiceRig,
}
"""The first is the default."""


def rig_kind(rig: Rig) -> str:
    """The name of a rig's kind; of one that scene files do not know, that of its class."""
    return next((name for name, cls in RIGS.items() if type(rig) is cls), type(rig).__name__)


def kinds_with(option: str) -> list[str]:
    """The kinds of rig that know an option."""
    return [name for name, cls in RIGS.items() if option in {f.name for f in fields(cls)}]
