"""Gaussians as a file for other tools, in one of four formats."""

from pathlib import Path
from typing import Literal

from spacesim.data.integrity.outputs import check_output
from spacesim.splat.export.frame import FileFrame
from spacesim.splat.export.glb import write_gaussian_glb
from spacesim.splat.export.ply import write_ply
from spacesim.splat.export.spz import write_spz
from spacesim.splat.export.usd import write_usd
from spacesim.splat.raster.gaussians import Gaussians

Form = Literal["ply", "glb", "spz", "usd"]
Y_UP = ("glb", "spz")  #: formats that say that y points up; the others hold the dataset's axes


def write_splats(
    gaussians: Gaussians,
    path: Path,
    form: Form,
    frame: FileFrame,
    antialiased: bool = False,
    spz_version: int = 3,
) -> None:
    """Write Gaussians with harmonics whose colours are sRGB values, see `bake`, in the file's frame.

    antialiased: whether they are drawn with the anti-aliasing filter, which only SPZ can record
    Raises InputError as `check_output` and the formats' own functions do.
    """
    check_output(path, form)
    placed = frame.placed(gaussians)
    if form == "ply":
        write_ply(placed, path)
    elif form == "glb":
        write_gaussian_glb(placed, path)
    elif form == "spz":
        write_spz(placed, path, antialiased, spz_version)
    else:
        write_usd(placed, path, frame.up, frame.scale)
