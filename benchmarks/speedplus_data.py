"""Data like SPEED+: made, blurred and made noisy, exported in its form, and imported again without the Suns.

    python benchmarks/speedplus_data.py --out DIR [--frames 600] [--height 300] [--seed 0] [--masks] [--json]

--masks cuts the object out (`import speedplus --masks auto`) and compares with the true silhouettes: intersection over
union. `make` is what other benchmarks call. The scene is `speedplus`; an eighth as many frames are held out.
"""

import argparse
import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from support import common

from spacesim import backend
from spacesim.data.exporters import write_speedplus
from spacesim.data.images import read_png, write_png
from spacesim.data.importers.speedplus import import_speedplus
from spacesim.data.importers.writing import ImportedFrame, write_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.progress import show_progress

FULL = 1920, 1200  #: pixels of SPEED+'s pictures
BLUR, VARIANCE = 1.0, 0.0022
"""Of SPEED's synthetic pictures, as are SPEED+'s: a Gaussian blur of one pixel, then white noise of this variance on
values from 0 to 1 (S. Sharma, S. D'Amico, "Neural network-based pose estimation for noncooperative spacecraft
rendezvous", IEEE TAES 56, 2020)."""

_NOISE = 7  # stream of random numbers


@dataclass(frozen=True, eq=False)
class SpeedplusData:
    """Datasets of the same pictures, world and frames, in the same order."""

    made: Dataset  #: as generated: no noise, with the Suns and all truth
    data: Dataset  #: as imported: pictures and poses alone
    labelled: Dataset  #: `data` with the Suns and silhouettes of `made`


def make(folder: Path, frames: int = 600, height: int = 300, seed: int = 0, spp: int = 64) -> SpeedplusData:
    """The datasets in `folder`, made as far as they are not there. frames: to train on; height: pixels, to 1200."""
    folder, size = Path(folder), (round(1.6 * height), height)
    scene = {"views": frames, "test_views": max(frames // 8, 1), "resolution": size, "spp": spp, "test_spp": spp}
    made = read_dataset(common.generated("speedplus", folder / "made", seed=seed, **scene))
    if not (folder / "data/transforms.json").exists():
        for name in ("speedplus", "data", "labelled"):
            shutil.rmtree(folder / name, ignore_errors=True)
        with show_progress("export", "pictures") as report:
            write_speedplus(made, folder / "speedplus", progress=report)
        for number, path in enumerate(sorted((folder / "speedplus/synthetic/images").glob("*.png"))):
            write_png(path, degraded(read_png(path), (seed, number)), durable=False)
        shutil.rmtree(folder / "speedplus/synthetic/masks")  # SPEED+ has none
        import_speedplus(folder / "speedplus", folder / "data", masks="none")
    data = read_dataset(folder / "data")
    if not (folder / "labelled/transforms.json").exists():
        train, test = (
            [_labelled(made, data, *pair) for pair in zip(*sets, strict=True)] for sets in _splits(made, data)
        )
        write_dataset(folder / "labelled", train, test, {"kind": "labelled", "source": str(folder / "data")})
    return SpeedplusData(made, data, read_dataset(folder / "labelled"))


def mask_overlaps(data: SpeedplusData, folder: Path) -> np.ndarray:
    """Intersection over union of silhouettes that `import speedplus --masks auto` finds with the true ones, [N]."""
    if not (folder / "transforms.json").exists():
        with show_progress("cut out", "pictures") as report:
            import_speedplus(folder.parent / "speedplus", folder, masks="auto", progress=report)
    shares = []
    for known, frame in zip(data.made.frames, read_dataset(folder).frames, strict=True):
        assert known.silhouette_path is not None
        assert frame.silhouette_path is not None
        true = read_png(data.made.root / known.silhouette_path) > 0
        found = read_png(folder / frame.silhouette_path) > 0
        shares.append((true & found).sum() / max((true | found).sum(), 1))
    return np.array(shares)


def degraded(picture: np.ndarray, seed: tuple[int, ...]) -> np.ndarray:
    """A picture [H, W] uint8 with the blur and noise of SPEED+: as if each of its pixels were the mean of as many of
    the full size as it covers, each with noise and cut to 8 bits of its own."""
    side = max(1, round(FULL[1] / picture.shape[0]))
    values = gaussian_filter(picture / 255, BLUR / side, mode="nearest")
    random = np.random.default_rng([*seed, _NOISE])
    total = np.zeros(picture.shape)
    for _ in range(side * side):
        noisy = values + np.sqrt(VARIANCE) * random.standard_normal(picture.shape)
        total += np.rint(255 * np.clip(noisy, 0, 1))
    return np.rint(total / side**2).astype(np.uint8)


def _splits(*datasets: Dataset) -> list[list[tuple[Frame, ...]]]:
    return [[dataset.train for dataset in datasets], [dataset.test for dataset in datasets]]


def _labelled(made: Dataset, data: Dataset, known: Frame, frame: Frame) -> ImportedFrame:
    """A frame as imported, with what is known of it."""
    name = Path(frame.file_path).stem
    if Path(known.file_path).stem != name or known.silhouette_path is None:
        raise ValueError(f"{frame.file_path}: expected the frame of the same name, found {known.file_path}")
    picture, silhouette = data.root / frame.file_path, made.root / known.silhouette_path
    return ImportedFrame(name, picture, frame.camera, frame.distortion, known.sun, silhouette=silhouette)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", type=common.positive, default=600, metavar="N", help="to train on (600)")
    parser.add_argument("--height", type=common.positive, default=300, metavar="PX", help="of the pictures (300)")
    parser.add_argument("--spp", type=common.positive, default=64, metavar="N", help="samples a pixel (64)")
    parser.add_argument("--seed", type=common.natural, default=0, metavar="N")
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--masks", action="store_true", help="compare masks that are found with the true ones")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    name = backend.select(options.backend)
    start = time.perf_counter()
    result = make(options.out, options.frames, options.height, options.seed, options.spp)
    seconds = time.perf_counter() - start
    count = len(result.data.frames)
    pictures = [read_png(result.data.root / frame.file_path) for frame in result.data.frames]
    report = {
        "backend": name,
        "frames": count,
        "size": [result.data.frames[0].camera.width, options.height],
        "seconds_a_frame": seconds / count,
        "mean": float(np.mean([picture.mean() for picture in pictures])),
    }
    if options.masks:
        shares = mask_overlaps(result, options.out / "cut-out")
        report |= {"masks_iou_mean": float(shares.mean()), "masks_iou_least": float(shares.min())}
    print(json.dumps(report) if options.json else "\n".join(f"{key}: {value}" for key, value in report.items()))


if __name__ == "__main__":
    common.run_main(main)
