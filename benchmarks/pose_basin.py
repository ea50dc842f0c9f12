"""From how far off, in what light and how dark poses are still found.

    python benchmarks/pose_basin.py --out OUT [--views 5] [--searched 5]
    python benchmarks/pose_basin.py --out OUT --data DATA --run RUN

Data and run as of `benchmarks/pose.py`. Path-traced pictures over a black sky, without alpha. Each view's camera goes
round the object by an angle, rolls by as much and changes its range by a share, both ways at random; `within` of
`refine_pose` says by how much that turns and moves it. Where a case names one, the other is 5 degrees or 5 %. The phase
angle is that at the object between Sun and camera. Darkness multiplies linear light before it is rounded to 8 bits.
"searched" is `find_pose`, with no start at all. "found": within 2 degrees and 2 %; "wrong of converged" the share of
these that is not.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from pose import WRONG, arguments, data_and_run, errors
from scipy.spatial.transform import Rotation
from support import common

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.geometry import degrees_between, normalize
from spacesim.data.images import linear_from_srgb, load_image, srgb_from_linear
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.splat.pose import find_pose, refine_pose
from spacesim.splat.pose.search import ModelViews
from spacesim.splat.run import Run

ANGLES, RANGES, DARKNESS = (5.0, 10.0, 20.0, 40.0), (0.1, 0.2, 0.4), (0.3, 0.1)
PHASES = (0.0, 60.0, 120.0, 180.0)  #: degrees, limits
USUAL = 5.0, 0.05  #: degrees and share of the range by which cameras are off


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--views", type=common.positive, default=5, help="test views a case, evenly taken (default 5)")
    parser.add_argument("--searched", type=common.natural, default=5, help="of these, views that are searched for")
    options = parser.parse_args()
    backend.select(options.backend)
    data, run = data_and_run(options)
    views = list(measured(run, data, options.views, options.searched, options.seed))
    cases = dict.fromkeys(str(view["case"]) for view in views)
    rows = [summary(case, [view for view in views if view["case"] == case]) for case in cases]
    usual = [view for view in views if view["case"] == case_of(*USUAL)]
    for low, high in pairwise(PHASES):
        some = [view for view in usual if low <= view["phase"] < high]
        if some:
            rows.append(summary(f"phase {low:g} to {high:g} deg", some))
    common.emit({"rows": rows, "views": views}, {"Basin of convergence": rows}, options)


def case_of(degrees: float, share: float) -> str:
    return f"angle {degrees:g} deg, range {100 * share:g} %"


def measured(run: Run, data: Dataset, count: int, searched: int, seed: int) -> Iterator[common.Row]:
    """What became of each view in each case; the usual one has twice as many views."""
    cases = [(case_of(*USUAL), *USUAL, 1.0, 2)]
    cases += [(case_of(angle, USUAL[1]), angle, USUAL[1], 1.0, 1) for angle in ANGLES[1:]]
    cases += [(case_of(USUAL[0], share), USUAL[0], share, 1.0, 1) for share in RANGES]
    cases += [(f"darkness {factor:g}", *USUAL, factor, 1) for factor in DARKNESS]
    for case, degrees, share, factor, times in cases:
        for k, frame in enumerate(taken(data, times * count)):
            start = displaced(frame.camera, degrees, share, np.random.default_rng([seed, k]))
            moved = math.hypot(2 * math.sin(math.radians(0.5 * degrees)), share)
            within = min(math.sqrt(2) * degrees, 60.0), min(moved, 0.5)  # attitude and place
            yield {"case": case, **refined(run, data, frame, start, within, factor, seed)}
    for frame in taken(data, searched) if searched else ():
        yield {"case": "searched", **refined(run, data, frame, None, USUAL, 1.0, seed)}


def taken(data: Dataset, count: int) -> list[Frame]:
    """Test views, evenly."""
    chosen = np.unique(np.linspace(0, len(data.test) - 1, min(count, len(data.test))).astype(int))
    return [data.test[k] for k in chosen]


def displaced(camera: Camera, degrees: float, share: float, rng: np.random.Generator) -> Camera:
    """The camera gone round the origin, rolled and moved along its line of sight."""
    way = normalize(np.cross(camera.position, rng.normal(size=3)))
    orbit = Rotation.from_rotvec(degrees * way, degrees=True).as_matrix()
    roll = Rotation.from_euler("z", degrees * rng.choice([-1, 1]), degrees=True).as_matrix()
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = orbit @ pose[:3, :3] @ roll
    pose[:3, 3] = orbit @ pose[:3, 3] * (1 + share * rng.choice([-1, 1]))
    return replace(camera, world_from_camera=pose)


def refined(
    run: Run,
    data: Dataset,
    frame: Frame,
    start: Camera | None,
    within: tuple[float, float],
    factor: float,
    seed: int,
) -> common.Row:
    light = factor * linear_from_srgb(load_image(data, frame).over(np.zeros(3)))
    image = np.rint(255 * srgb_from_linear(light)).astype(np.uint8)
    began = time.perf_counter()
    phase = 0.0 if frame.sun is None else float(degrees_between(frame.sun.direction @ normalize(frame.camera.position)))
    row: common.Row = {"view": frame.file_path, "phase": phase, "off": [math.inf, math.inf], "converged": False}
    try:
        if start is None:
            views = ModelViews.of(run, frame.sun if run.relightable else None, False)
            pose = find_pose(run, image, frame.camera, frame.sun, seed=seed, views=views).pose
        else:
            pose = refine_pose(run, image, start, frame.sun, within=within, seed=seed)
        row |= {"off": list(errors(pose.camera, frame.camera)), "converged": pose.converged}
    except InputError:  # nothing in the picture is brighter than the sky
        pass
    return row | {"s": time.perf_counter() - began}


def summary(case: str, views: list[common.Row]) -> common.Row:
    off = np.array([view["off"] for view in views])
    correct = off.max(axis=1) < WRONG
    converged = np.array([view["converged"] for view in views])
    middle = np.median(np.where(np.isfinite(off), off, 180.0), axis=0)
    return {
        "case": case,
        "views": len(views),
        "found": float(correct.mean()),
        "median, deg": float(middle[0]),
        "median, %": float(middle[1]),
        "converged": float(converged.mean()),
        "wrong of converged": float((~correct[converged]).mean()) if converged.any() else 0.0,
        "s a view": float(np.mean([view["s"] for view in views])),
    }


if __name__ == "__main__":
    common.run_main(main)
