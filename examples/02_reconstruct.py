"""2. Reconstruct: train Gaussians on the dataset of 01_simulate.py, render a held-out view.

python examples/02_reconstruct.py     about half a minute on two cores; writes out/examples/run
"""

import spacesim as ss


def main(data="out/examples/data", out="out/examples/run", iterations=1_000, gaussians=4_000):
    dataset = ss.read_dataset(data)
    sizes = {"iterations": iterations, "init_count": gaussians}
    run = ss.train(dataset, out, preset="demo", method="shadow-map", resume=True, progress=show, **sizes)
    view = run.render(dataset.test[0].camera, sun=(40, 25))  # view.rgb [H, W, 3], view.depth [H, W] metres
    for name, kind in ("view.png", "rgb"), ("depth.exr", "depth"), ("shadow.png", "shadow"), ("normal.png", "normal"):
        view.save(f"{out}/{name}", kind)
    print(
        f"{out}: {run.gaussian_count} Gaussians in {run.model_bytes / 1e6:.1f} MB, trained on {run.training['backend']}"
    )
    return run


def show(done, total, state):
    print(f"{done}/{total}: {state}") if done % 250 == 0 else None


if __name__ == "__main__":
    main()
