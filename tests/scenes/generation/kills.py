"""Kills a run again and again, resumes it, and compares every byte with an undisturbed run's.

python tests/scenes/generation/kills.py [--kills 20] [--workers 1] [--seed 0]      one to two minutes
"""

import argparse
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2]))
from tiny import contents

SCENE = ("boxsat", "--views", "400", "--test-views", "40", "--resolution", "32", "--spp", "4", "--seed", "1")


def command(out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "spacesim.cli", "generate", *SCENE, "--out", str(out), *options]


def killed(out: Path, kills: int, workers: int, seed: int = 0) -> list[int]:
    """Start or resume the run `kills` times and end each by SIGKILL at a random moment, after up to 3 frames of its own
    or, one time in four, within its first second and a half. Returns how many frames there were each time."""
    rng, frames = random.Random(seed), []
    for _ in range(kills):
        more = rng.randint(1, 3) if rng.random() < 0.75 else 10**9
        target, end = count(out) + more, time.monotonic() + (60 if more < 10**9 else 1.5 * rng.random())
        process = subprocess.Popen(
            command(out, "--resume", "--workers", str(workers)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while process.poll() is None and count(out) < target and time.monotonic() < end:
            time.sleep(0.002)
        time.sleep(0.05 * rng.random())
        assert process.poll() is None, "it should have been killed before its end"
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(0.2)  # workers notice that their parent is gone
        frames.append(count(out))
    return frames


def count(out: Path) -> int:
    return len(list(out.glob("gt/*.exr")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        out, whole = Path(folder) / "killed", Path(folder) / "whole"
        frames = killed(out, options.kills, options.workers, options.seed)
        print(f"{len(frames)} kills, frames after each: {' '.join(map(str, frames))}", flush=True)
        for place, extra in ((out, ("--resume",)), (whole, ())):
            subprocess.run(command(place, *extra), check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        one, other = contents(out), contents(whole)
        different = sorted(set(one) ^ set(other) | {name for name in set(one) & set(other) if one[name] != other[name]})
        print(f"{len(other)} files, {len(different)} differ from the undisturbed run's {different[:5]}")
        sys.exit(bool(different))


if __name__ == "__main__":
    main()
