"""Where a training step's time goes: milliseconds of each stage, and how the step grows.

    python benchmarks/stages.py [--backend auto] [--sizes 30000x256,30000x512,100000x512] [--json]

The scene is a sphere of random splats that fills most of the picture. Times are medians of synchronised calls after
warm-up; "ns a pair" is the whole step divided by the number of (tile, splat) pairs, which stays level where the cost
is linear in them.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import ad
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Pinhole, project
from spacesim.splat.rasterize import backward, forward
from spacesim.splat.render import view_colours
from spacesim.splat.tiles import bin_splats
from spacesim.splat.train.losses import photometric_loss

REPEATS = 15


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--sizes", default="10000x256,30000x256,100000x256,30000x128,30000x512")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    name = backend.select(options.backend)
    rows = [measure(*map(int, size.split("x"))) for size in options.sizes.split(",")]
    if options.json:
        print(json.dumps({"backend": name, "rows": rows}, indent=1))
        return
    print(f"backend {name}, milliseconds")
    print("  ".join(f"{key:>10}" for key in rows[0]))
    for row in rows:
        print("  ".join(f"{value:>10.2f}" if isinstance(value, float) else f"{value:>10}" for value in row.values()))


def measure(count: int, size: int) -> dict[str, Any]:
    """Times of the stages for `count` Gaussians on size x size pixels."""
    gaussians = sphere(count)
    camera = Pinhole.of(Camera.from_fov(look_at([4, 1, 1], [0, 0, 0]), size, size, 35))
    splats, footprints = project(gaussians, camera)
    colour = list(view_colours(gaussians, camera))
    dr.eval(splats, footprints, colour)
    lists = bin_splats(splats, footprints, size, size)
    blended = forward(splats, colour, lists, size, size)
    planes = [dr.full(ad.Float, 1e-3, size * size) for _ in range(4)]
    dr.eval(blended.features, blended.transmittance, blended.tile_last, planes)

    def run_project() -> None:
        dr.eval(project(gaussians, camera), view_colours(gaussians, camera))

    def run_forward() -> None:
        result = forward(splats, colour, lists, size, size)
        dr.eval(result.features, result.transmittance, result.tile_last)

    def run_loss() -> None:
        picture = ad.Array3f(blended.features)
        dr.enable_grad(picture)
        dr.backward(photometric_loss(picture, ad.Array3f(planes[:3]), size, size))
        dr.eval(dr.grad(picture))

    row: dict[str, Any] = {"gaussians": count, "pixels": size, "pairs": lists.pairs}
    row["project"] = milliseconds(run_project)
    row["bin"] = milliseconds(lambda: bin_splats(splats, footprints, size, size))
    row["forward"] = milliseconds(run_forward)
    row["loss"] = milliseconds(run_loss)
    row["backward"] = milliseconds(lambda: backward(splats, blended, lists, (size, size), planes[:3], planes[3]))
    row["sum"] = sum(row[stage] for stage in ("project", "bin", "forward", "loss", "backward"))
    row["ns a pair"] = 1e6 * row["sum"] / lists.pairs
    return row


def sphere(count: int) -> Gaussians:
    """Splats on the unit sphere, as wide as their spacing."""
    rng, spacing = np.random.default_rng(0), np.sqrt(4 * np.pi / count)
    return Gaussians.from_numpy(
        {
            "means": fibonacci_sphere(count),
            "log_scales": np.log(spacing * rng.uniform(0.3, 1.0, (count, 3))),
            "quaternions": rng.normal(size=(count, 4)),
            "logit_opacities": rng.normal(size=count),
            "sh": 0.3 * rng.normal(size=(count, 16, 3)),
        }
    )


def milliseconds(work: Callable[[], Any]) -> float:
    """Median time of `work`, device synchronised, after three calls that do not count."""
    times = []
    for _ in range(REPEATS + 3):
        dr.sync_thread()
        start = time.perf_counter()
        work()
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times[3:]))


if __name__ == "__main__":
    main()
