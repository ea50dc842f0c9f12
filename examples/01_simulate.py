"""1. Simulate: path-trace a small dataset of boxsat under one Sun, then read the truth of a frame back.

python examples/01_simulate.py        about 10 seconds on two cores; writes out/examples/data
"""

from pathlib import Path

from spacesim.data.records import Dataset
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST, load_truth
from spacesim.scenes import generate, read_scene

OUT = Path("out/examples/data")


def main(out: Path = OUT, views: int = 40, resolution: int = 128, spp: int = 32) -> Dataset:
    scene = read_scene("boxsat", views=views, test_views=4, resolution=resolution, spp=spp, sun=((40.0, 25.0),))
    dataset = generate(scene, out, resume=out.exists())  # an interrupted run goes on

    frame = dataset.test[0]
    truth = load_truth(dataset, frame)
    surface = truth.object_id > 0
    print(f"{out}: {len(dataset.train)} training and {len(dataset.test)} test frames")
    print(f"{frame.file_path}: Sun at azimuth and elevation {scene.rig.sun[0]} degrees")
    print(f"  surface on {surface.mean():.0%} of the pixels, {truth.depth[surface].min():.2f} m away at the nearest")
    print(f"  radiance up to {truth.radiance.max():.0f} W m^-2 sr^-1")
    for name, value in ("lit", SHADOW_LIT), ("cast shadow", SHADOW_SELF_CAST), ("attached shadow", SHADOW_ATTACHED):
        print(f"  {name}: {(truth.shadow[surface] == value).mean():.0%} of the surface's pixels")
    return dataset


if __name__ == "__main__":
    main()
