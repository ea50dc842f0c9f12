"""OpenSplat's CPU mode as a peer: its binary on a data set of ours, in Nerfstudio's layout, refinement off.

Built from https://github.com/pierotofy/OpenSplat at 15b7e80 with a CPU build of libtorch; spacesim installs neither.
Its steps are timed in a row, as ours beside them.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from spacesim.data.errors import WorkError
from spacesim.data.records import Dataset

STEPS = 40, 120  #: of the short and the long run; their difference is free of start-up and of writing the result
OFF = "1000000000"


def run_pair(binary: Path, dataset: Dataset) -> tuple[float, float]:
    """Seconds of a short and of a long run. Raises WorkError where the binary fails."""
    return _seconds(binary, dataset, STEPS[0]), _seconds(binary, dataset, STEPS[1])


def seconds_a_step(pairs: list[tuple[float, float]]) -> list[float]:
    """What each long run takes more than the median of the short ones, over its steps more."""
    start = float(np.median([short for short, _ in pairs]))
    return [(long - start) / (STEPS[1] - STEPS[0]) for _, long in pairs]


def _seconds(binary: Path, dataset: Dataset, steps: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        splats = Path(folder) / "splat.ply"
        command = [str(binary.resolve()), str(dataset.root), "-o", str(splats), "-n", str(steps)]
        command += ["-d", "1", "--num-downscales", "0", "--sh-degree", "3", "--sh-degree-interval", "1"]
        command += ["--refine-every", OFF, "--warmup-length", OFF]
        start = time.perf_counter()
        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
        try:
            done = subprocess.run(command, capture_output=True, text=True, env=environment)
        except OSError as error:
            raise WorkError(f"--opensplat: {binary} cannot be run ({error})") from None
        seconds, has_written = time.perf_counter() - start, splats.is_file()
    if done.returncode != 0:
        raise WorkError(f"--opensplat: {binary} ended with code {done.returncode}: {done.stderr.strip()[-300:]}")
    if not has_written:
        raise WorkError(f"--opensplat: {binary} has written no splats: is it OpenSplat?")
    return seconds
