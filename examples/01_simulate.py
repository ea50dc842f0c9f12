"""1. Simulate: path-trace a small dataset of boxsat under one Sun, then read the truth of a frame back.

python examples/01_simulate.py        about 10 seconds on two cores; writes out/examples/data
"""

import spacesim as ss


def main(out="out/examples/data", views=40, resolution=128, spp=32):
    sizes = {"views": views, "test_views": 4, "resolution": resolution, "spp": spp}
    data = ss.generate("boxsat", out, sun=[(40, 25)], resume=True, **sizes)  # an interrupted run goes on
    frame = data.test[0]
    truth = ss.load_truth(data, frame)
    surface = truth.object_id > 0
    print(f"{out}: {len(data.train)} training and {len(data.test)} test frames")
    print(f"{frame.file_path}: radiance up to {truth.radiance.max():.0f} W m^-2 sr^-1")
    print(f"  surface on {surface.mean():.0%} of the pixels, {truth.depth[surface].min():.2f} m away at the nearest")
    for name, value in ("lit", 255), ("cast shadow", 170), ("attached shadow", 85):
        print(f"  {name}: {(truth.shadow[surface] == value).mean():.0%} of the surface's pixels")
    return data


if __name__ == "__main__":
    main()
