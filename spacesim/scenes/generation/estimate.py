"""How long a dataset will take and how much disk, measured on a few of its frames."""

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spacesim.data.errors import WorkError
from spacesim.data.files import existing_parent
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec

SAMPLES = 5
"""Frames that are measured; the first one of them, which compiles the kernels, not for time."""
LONG = 200
"""Frames left from which on a run begins with an estimate."""
_BLOCK = 4096  # bytes in whose multiples most file systems store


@dataclass(frozen=True)
class Estimate:
    """What a dataset will take."""

    frames: int  #: left to render
    seconds: float  #: that one process on this machine takes for them
    needed: int  #: bytes of disk
    free: int  #: bytes of disk

    def __str__(self) -> str:
        return (
            f"{self.frames} frames left: about {duration(self.seconds)} in one process, "
            f"{size(self.needed)} of disk, {size(self.free)} free"
        )

    def check(self, root: Path) -> None:
        """Raises WorkError where the disk is too small."""
        if self.needed > self.free:
            raise WorkError(
                f"{root}: expected {size(self.needed)} of free disk for {self.frames} frames, found {size(self.free)}"
            )


def samples(specs: Sequence[FrameSpec]) -> list[FrameSpec]:
    """A few of `specs`, spread evenly over them."""
    count = min(SAMPLES, len(specs))
    return [specs[i * len(specs) // count] for i in range(count)]


def measure(maker: FrameMaker, specs: Sequence[FrameSpec], left: Sequence[FrameSpec], root: Path) -> Estimate:
    """Make `specs` and estimate from them what those `left` in `root` take: time by samples, disk by frames."""
    maker.start_encoders(len(specs))
    list(maker.make(specs[:1]))
    start = time.monotonic()
    list(maker.make(specs[1:]))
    seconds = (time.monotonic() - start) / max(1, sum(spec.spp for spec in specs[1:]))
    stored = sum(_stored(path) for spec in specs for path in maker.root.glob(f"*/{spec.name}*"))
    free = shutil.disk_usage(existing_parent(root)).free
    return Estimate(len(left), seconds * sum(spec.spp for spec in left), len(left) * stored // len(specs), free)


def _stored(path: Path) -> int:
    """Bytes of disk that a file takes."""
    return -(-os.path.getsize(path) // _BLOCK) * _BLOCK


def duration(seconds: float) -> str:
    """As people say it: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def size(count: float) -> str:
    """Bytes as people say them: 12 MB, 3.4 GB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
