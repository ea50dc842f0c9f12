"""Gaussians as PLY in the layout that the INRIA code introduced and that viewers read."""

from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import read_bytes, write_bytes
from spacesim.splat.export.frame import unit_quaternions
from spacesim.splat.raster.gaussians import Gaussians


def _columns(terms: int) -> list[str]:
    """Column names for `terms` spherical-harmonic coefficients a channel."""
    rest = [f"f_rest_{i}" for i in range(3 * (terms - 1))]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    return names + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write binary little-endian PLY: positions in metres, log scales, logit opacities, quaternions (w, x, y, z)
    of unit length, spherical harmonics channel by channel; normals are 0."""
    arrays = gaussians.to_numpy()
    count, sh = gaussians.count, arrays["sh"]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    opacity = arrays["logit_opacities"][:, None]
    parts = [
        arrays["means"],
        np.zeros((count, 3)),
        sh[:, 0],
        rest,
        opacity,
        arrays["log_scales"],
        unit_quaternions(arrays["quaternions"]),
    ]
    table = np.concatenate(parts, axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in _columns(sh.shape[1])] + ["end_header", ""]
    write_bytes(path, "\n".join(header).encode() + table.tobytes())


def read_ply(path: Path) -> Gaussians:
    """The inverse of `write_ply`. Raises InputError where the file has another layout."""
    content = read_bytes(path, "a PLY of Gaussians")
    header, mark, body = content.partition(b"end_header\n")
    lines = header.decode("ascii", errors="replace").split("\n")
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    sizes = [int(line.split()[-1]) for line in lines if line.startswith("element vertex ")]
    terms = (sum(name.startswith("f_rest_") for name in names) + 3) // 3
    expected = _columns(terms)
    if not mark or "format binary_little_endian 1.0" not in lines or sizes == [] or names != expected:
        raise InputError(f"{path}: expected a PLY of Gaussians in the INRIA layout, found another header")
    if len(body) != sizes[0] * len(names) * 4:
        raise InputError(f"{path}: expected {sizes[0]} vertices, found a file that breaks off")
    table = np.frombuffer(body, "<f4").reshape(sizes[0], len(names))
    column = {name: i for i, name in enumerate(names)}
    rest = table[:, 9 : 9 + 3 * (terms - 1)].reshape(-1, 3, terms - 1).transpose(0, 2, 1)
    return Gaussians.from_numpy(
        {
            "means": table[:, :3],
            "log_scales": table[:, column["scale_0"] : column["scale_0"] + 3],
            "quaternions": table[:, column["rot_0"] : column["rot_0"] + 4],
            "logit_opacities": table[:, column["opacity"]],
            "sh": np.concatenate([table[:, None, 6:9], rest], axis=1),
        }
    )
