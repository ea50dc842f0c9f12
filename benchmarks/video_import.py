"""A film of the spent upper stage, the Earth passing behind: `import video`, `train` and `eval` against the truth.

    python benchmarks/video_import.py --out OUT [--width 960] [--frames 100] [--iterations N]

It path-traces the film as far as OUT lacks it: three quarters of it a fly-around of 90 degrees from ahead to above, one
quarter an approach from above, one Sun; the sky, then the Earth's limb, then its clouds and seas behind. It is encoded
as H.264 at 4 Mbit/s and imported, once with the field of view given and once without. Positions are compared after the
alignment of `eval --align`, in per cent of each camera's distance from the stage; masks with the traced silhouettes of
the same frames.

The method vanilla is then trained on the import with the field of view given, with the poses as found and with these
refined, and on the same frames of the film with the true poses and masks, from the same points. All are evaluated on
the traced pictures of the frames held out, over the true silhouettes: each model seen by the cameras that its own poses
give these frames, and, "aligned", by the true cameras, after one motion of the whole model.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
from support import common

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import read_json, write_bytes
from spacesim.data.images import read_png
from spacesim.data.importers.kinds import import_dataset
from spacesim.data.importers.writing import ImportedFrame, write_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset, read_points
from spacesim.eval.align import KEY, robust_similarity
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.progress import show_progress
from spacesim.reproduce.perform import evaluated
from spacesim.splat.compose.pose import Pose
from spacesim.splat.run import load_run
from spacesim.splat.train.config import preset, with_options, with_settings

TrueFrame = tuple[Dataset, Frame]

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
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=common.positive, help="of each training (default: the preset's)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of each training")
    options = parser.parse_args()
    backend.select(options.backend)
    if options.frames < 4:
        raise InputError(f"--frames: expected at least 4, found {options.frames}")
    truth = film_of(options.out, options.width, options.frames, options.spp)
    film = options.out / "film.mp4"
    write_bytes(film, encoded([opaque(data, frame) for data, frame in truth]))
    rows = []
    for name, fov in ("given", FOV), ("estimated", None):
        folder = options.out / f"import-{name}"
        start = time.perf_counter()
        try:
            if not (folder / "transforms.json").exists():
                with show_progress("import", "%") as report:
                    import_dataset("video", film, folder, report, length=LENGTH, fov=fov)
            row = compared(read_dataset(folder), truth)
            note: common.Row = {"seconds": time.perf_counter() - start}
        except (InputError, WorkError) as error:
            row, note = {}, {"note": str(error)}
        rows.append({"field of view": name, **row, **note})
    trainings = list(trainings_of(options, truth)) if "note" not in rows[0] else []
    tables = {
        f"A film of {len(truth)} frames, {options.width} pixels wide": rows,
        f"Trained on it, the field of view given, preset {options.preset}": trainings,
    }
    common.emit({"rows": rows, "trainings": trainings}, tables, options)


def film_of(out: Path, width: int, frames: int, spp: int) -> list[TrueFrame]:
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


def compared(data: Dataset, truth: list[TrueFrame]) -> common.Row:
    """Of an import: share of frames with a pose, errors of positions, of scale, and of masks."""
    report = json.loads((data.root / "structure.json").read_text())
    frames = numbered(data)
    numbers = list(frames)
    pose, true = pose_of(frames, truth), np.array([truth[k][1].camera.position for k in numbers])
    aligned = pose.points(np.array([frame.camera.position for frame in frames.values()]))
    errors = 100 * np.linalg.norm(aligned - true, axis=1) / np.linalg.norm(true, axis=1)
    overlaps = []
    for k in numbers:
        mask = read_png(data.root / frames[k].file_path)[..., 3] > 127  # of the film's pixels, whatever the lens found
        silhouette = true_mask(truth[k]) > 0
        overlaps.append((mask & silhouette).sum() / max((mask | silhouette).sum(), 1))
    true_focal = truth[0][1].camera.fx
    return {
        "registered": len(numbers) / report["pictures"],
        "position, % median": float(np.median(errors)),
        "% largest": float(errors.max()),
        "length, % off": float(100 * abs(1 / pose.scale - 1)),
        "focal length, % off": float(100 * abs(frames[numbers[0]].camera.fx / true_focal - 1)),
        "mask IoU": float(np.mean(overlaps)),
        "least": float(np.min(overlaps)),
        "reprojection, px": report["reprojection_error_px"],
        "points": report["points"],
    }


def trainings_of(options: argparse.Namespace, truth: list[TrueFrame]) -> Iterator[common.Row]:
    """With the true poses and masks; with those found; with these refined."""
    from spacesim.cli.train import parse_setting

    own = read_dataset(options.out / "import-given")
    true = true_dataset(options.out / "truth", own, truth)
    plain = with_options(preset(options.preset, "vanilla"), iterations=options.iterations)
    plain = with_settings(plain, dict(map(parse_setting, options.set)))
    evaluation = EvaluateConfig(geometry=None)
    seen, best = seen_by(own, true), float("nan")
    for name, config, data, truth_data in (
        ("true", plain, true, true),
        ("found", plain, own, seen),
        ("found, refined", replace(plain, refine_poses=True), own, seen),
    ):
        folder = options.out / name.replace(", ", "-")
        metrics = common.measured(name, config, evaluation, data, folder, truth_data)
        if "note" in metrics:
            yield {"poses and masks": name, "note": metrics["note"]}
            continue
        psnr = aligned = metrics["image"]["psnr"]["mean"]
        if name == "true":
            best = psnr
        else:
            aligned_evaluation, run = replace(evaluation, align=own), load_run(folder / "run")
            moved = evaluated(run, true, folder / "eval-aligned", aligned_evaluation, f"{name}, aligned", show_progress)
            aligned = moved["image"]["psnr"]["mean"]
        yield {
            "poses and masks": name,
            "PSNR, dB": psnr,
            "below true, dB": best - psnr,
            "aligned, dB": aligned,
            "SSIM": metrics["image"]["ssim"]["mean"],
            "test views": len(metrics["frames"]),
            "iterations": config.iterations,
            "Gaussians": metrics["model"]["gaussians"],
            "s": metrics["training"]["seconds"],
        }


def true_dataset(folder: Path, own: Dataset, truth: list[TrueFrame]) -> Dataset:
    """The frames of an import with their true cameras and masks: those to train on as the film shows them, those held
    out as they were traced. It starts at the import's points, moved by the alignment."""
    if (folder / "transforms.json").exists():
        return read_dataset(folder)
    frames, held_out = numbered(own), {frame.file_path for frame in own.test}

    def true_frame(number: int, frame: Frame) -> ImportedFrame:
        def picture() -> np.ndarray:
            of_film = read_png(own.root / frame.file_path)[..., :3]
            shown = opaque(*truth[number]) if frame.file_path in held_out else of_film
            return np.dstack([shown, true_mask(truth[number])])

        return ImportedFrame(
            name=Path(frame.file_path).stem,
            picture=picture,
            camera=truth[number][1].camera,
            keys={KEY: number},
        )

    made = {frame.file_path: true_frame(number, frame) for number, frame in frames.items()}
    train, test = ([made[frame.file_path] for frame in split] for split in (own.train, own.test))
    points, colors = read_points(own.root / str(own.ply_file_path))
    source = {"kind": "truth", "source": str(own.root)}
    return write_dataset(folder, train, test, source, (pose_of(frames, truth).points(points), colors))


def seen_by(own: Dataset, true: Dataset) -> Dataset:
    """`true`, its held-out frames seen by the cameras that `own` gives them."""
    cameras = {Path(frame.file_path).stem: frame.camera for frame in own.test}
    frames = (replace(frame, camera=cameras[Path(frame.file_path).stem]) for frame in true.test)
    return replace(true, test=tuple(frames))


def numbered(data: Dataset) -> dict[int, Frame]:
    """The frames of an import by their numbers in the film, in its order."""
    entries = read_json(data.root / "transforms.json")["frames"]
    numbers = {entry["file_path"]: entry[KEY] for entry in entries}
    return {numbers[frame.file_path]: frame for frame in sorted(data.frames, key=lambda f: numbers[f.file_path])}


def pose_of(frames: dict[int, Frame], truth: list[TrueFrame]) -> Pose:
    """Of an import in the truth's world."""
    true = [truth[number][1] for number in frames]
    poses = (np.array([frame.camera.world_from_camera for frame in group]) for group in (frames.values(), true))
    return robust_similarity(*poses)[0]


def true_mask(frame: TrueFrame) -> np.ndarray:
    """[H, W] uint8, 255 the stage."""
    return read_png(frame[0].root / str(frame[1].silhouette_path))


if __name__ == "__main__":
    common.run_main(main)
