"""2. Reconstruct: train Gaussians on the dataset of 01_simulate.py, render a held-out view, export a PLY.

python examples/02_reconstruct.py     about half a minute on two cores; writes out/examples/run
"""

from pathlib import Path

from spacesim.data.store import read_dataset
from spacesim.splat.picture import write_picture
from spacesim.splat.ply import write_ply
from spacesim.splat.run import Run
from spacesim.splat.train.config import preset, with_options
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Progress

DATA, OUT = Path("out/examples/data"), Path("out/examples/run")


def main(data: Path = DATA, out: Path = OUT, iterations: int = 1_000, gaussians: int = 4_000) -> Run:
    dataset = read_dataset(data)
    config = with_options(preset("demo"), iterations=iterations, init_count=gaussians)
    run = train(dataset, out, config, resume=out.exists(), on_progress=show)

    frame = dataset.test[0]
    prediction = run.predict(frame.camera, frame.sun)  # numpy: rgb [H, W, 3], alpha [H, W], depth [H, W]
    write_picture(prediction, "rgb", out / "view.png")
    write_picture(prediction, "depth", out / "depth.exr")
    write_ply(run.model, out / "gaussians.ply")
    print(f"{out}: {run.gaussians} Gaussians in {run.bytes / 1e6:.1f} MB, trained on {run.training['backend']}")
    return run


def show(progress: Progress) -> None:
    if progress.iteration % 250 == 0:
        print(f"iteration {progress.iteration}: loss {progress.loss:.4f}, {progress.gaussians} Gaussians")


if __name__ == "__main__":
    main()
