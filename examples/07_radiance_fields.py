"""7. Radiance fields: train one on the data of 01_simulate.py, and draw two of it on each ray (algorithm 1).

python examples/07_radiance_fields.py        minutes on two cores; writes out/examples/field and out/examples/fields
"""

from pathlib import Path

import spacesim as ss

SCENE = """
frames = 1
[camera]
position = [9, -12, 7]
look_at = [0, 0, 0]
fov_deg = 40
resolution = [{size}, {size}]
[[models]]
run = "{run}"
name = "left"
[[models]]
run = "{run}"
name = "right, half as large"
position = [3.0, 0.0, 2.0]
scale = 0.5
"""


def main(data="out/examples/data", run="out/examples/field", out="out/examples/fields", size=256, **options):
    trained = ss.train(ss.read_dataset(data), run, method="nerf", preset="demo", **options)
    scene = Path(run).with_suffix(".toml")
    scene.write_text(SCENE.format(run=Path(run).absolute(), size=size))
    done = ss.compose(scene, out)
    print(f"field: {run}; two of it: {done.sheet}")
    return trained


if __name__ == "__main__":
    main()
