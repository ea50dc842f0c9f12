"""How well `spacesim import video` finds poses and masks: a film of the spent upper stage, the Earth passing behind.

    python benchmarks/video_import.py --out OUT [--width 960] [--frames 100]

It path-traces the film as far as OUT lacks it: three quarters of it a fly-around of 90 degrees from ahead to above, one
quarter an approach from above, one Sun; the sky, then the Earth's limb, then its clouds and seas behind. It is encoded
as H.264 at 4 Mbit/s and imported, once with the field of view told and once without. Positions are compared after the
similarity that fits the cameras best (S. Umeyama, "Least-squares estimation of transformation parameters", 1991), in
per cent of each camera's distance from the stage; masks with the traced silhouettes of the same frames.
"""

import json
import time
from fractions import Fraction
from pathlib import Path

import common
import numpy as np

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import write_bytes
from spacesim.data.geometry import Array
from spacesim.data.images import load_image, read_png
from spacesim.data.importers.kinds import import_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.progress import show_progress

FOV, LENGTH = 24.0, 11.0  #: degrees, metres of the stage
BIT_RATE, RATE = 4_000_000, Fraction(25)
SCENE = """
[[objects]]
spacecraft = "upper-stage"
rotation_wxyz = [0.9239, 0.0, -0.3827, 0.0]

[earth]
elevation_deg = -90.0
altitude_km = 600.0

[background]

[camera]
fov_deg = 24.0

[rig]
sun = [[60.0, 40.0]]
test_views = 0
"""
FLY_AROUND = """kind = "fly-around"
altitude_km = 600.0
duration_s = 1450.0         # a quarter of a revolution
phase_deg = 95.0
size = 28.0
across = 12.0
"""
APPROACH = """kind = "approach"
axis = "-r-bar"
start = 44.0
end = 26.0
"""


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where scenes, film and datasets are, or are made")
    parser.add_argument("--width", type=common.positive, default=960, help="pixels (default 960), 16:9")
    parser.add_argument("--frames", type=common.positive, default=100, help="of the film (default 100)")
    parser.add_argument("--spp", type=common.positive, default=16)
    options = parser.parse_args()
    backend.select(options.backend)
    if options.frames < 4:
        raise InputError(f"--frames: expected at least 4, found {options.frames}")
    truth = film_of(options.out, options.width, options.frames, options.spp)
    film = options.out / "film.mp4"
    write_bytes(film, encoded([opaque(data, frame) for data, frame in truth]))
    rows = []
    for name, wishes in (("told", {"fov": FOV}), ("estimated", {})):
        folder = options.out / f"import-{name}"
        start = time.perf_counter()
        try:
            if not (folder / "transforms.json").exists():
                with show_progress("import", "%") as report:
                    import_dataset("video", film, folder, report, length=LENGTH, **wishes)
            row = compared(read_dataset(folder), truth)
            note = {"seconds": time.perf_counter() - start}
        except (InputError, WorkError) as error:
            row, note = {}, {"note": str(error)}
        rows.append({"field of view": name, **row, **note})
    common.emit({"rows": rows}, {f"A film of {len(truth)} frames, {options.width} pixels wide": rows}, options)


def film_of(out: Path, width: int, frames: int, spp: int) -> list[tuple[Dataset, Frame]]:
    """The film's frames with their truth, in order."""
    approach = frames // 4
    truth = []
    for name, rig, views in (("fly-around", FLY_AROUND, frames - approach), ("approach", APPROACH, approach)):
        scene = out / f"{name}.toml"
        write_bytes(scene, SCENE.replace("[rig]\n", f"[rig]\n{rig}").encode())
        size = width, 2 * round(width * 9 / 32)
        folder = common.generated(str(scene), out / name, resolution=size, views=views, spp=spp)
        data = read_dataset(folder)
        truth += [(data, frame) for frame in data.train]
    return truth


def opaque(data: Dataset, frame: Frame) -> np.ndarray:
    """[H, W, 3] uint8 over black."""
    pixels = read_png(data.root / frame.file_path)
    return pixels if pixels.shape[2] == 3 else np.rint(pixels[..., :3] * (pixels[..., 3:] / 255)).astype(np.uint8)


def encoded(pictures: list[np.ndarray]) -> bytes:
    """An MP4 file of H.264 at 4 Mbit/s."""
    from spacesim.splat.export.video import Video

    height, width = pictures[0].shape[:2]
    video = Video(width, height, RATE, bit_rate=BIT_RATE)
    for picture in pictures:
        video.add(picture)
    return video.content()


def compared(data: Dataset, truth: list[tuple[Dataset, Frame]]) -> common.Row:
    """Of an import: share of frames with a pose, errors of positions, of scale, and of masks."""
    report = json.loads((data.root / "structure.json").read_text())
    frames = {int(Path(frame.file_path).stem.removeprefix("frame_")): frame for frame in data.frames}
    numbers = sorted(frames)
    found = np.array([frames[k].camera.position for k in numbers])
    true = np.array([truth[k][1].camera.position for k in numbers])
    scale, aligned = similarity(found, true)
    errors = 100 * np.linalg.norm(aligned - true, axis=1) / np.linalg.norm(true, axis=1)
    overlaps = []
    for k in numbers:
        mask = load_image(data, frames[k]).alpha > 0.5
        silhouette = read_png(truth[k][0].root / truth[k][1].silhouette_path) > 0
        overlaps.append((mask & silhouette).sum() / max((mask | silhouette).sum(), 1))
    true_focal = truth[0][1].camera.fx
    return {
        "registered": len(numbers) / report["pictures"],
        "position, % median": float(np.median(errors)),
        "% largest": float(errors.max()),
        "length, % off": float(100 * abs(1 / scale - 1)),
        "focal length, % off": float(100 * abs(frames[numbers[0]].camera.fx / true_focal - 1)),
        "mask IoU": float(np.mean(overlaps)),
        "least": float(np.min(overlaps)),
        "reprojection, px": report["reprojection_error_px"],
        "points": report["points"],
    }


def similarity(source: Array, target: Array) -> tuple[float, Array]:
    """(scale, `source` [N, 3] moved) by the similarity that brings it nearest to `target` [N, 3]."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * signs).sum() / (a**2).sum())
    return scale, scale * a @ ((u * signs) @ vt).T + target.mean(axis=0)


if __name__ == "__main__":
    common.told(main)
