"""5. Compose: the run of 02_reconstruct.py twice in one scene; one of the two flies past while the Sun moves.

python examples/05_compose.py        a few seconds; writes out/examples/scene.toml and out/examples/composed
"""

from pathlib import Path

import spacesim as ss

SCENE = """
frames = {frames}
[sun]
azimuth_deg = -60
elevation_deg = 40
[camera]
position = [5, -7, 4]
look_at = [0, 0, 0.5]
fov_deg = 40
resolution = [{size}, {size}]
[[models]]
run = "{run}"
name = "target"
[[models]]
run = "{run}"
name = "chaser"
position = [2.0, -1.5, 1.5]
[[keyframes]]
time = 0.0
sun = {{ azimuth_deg = -60, elevation_deg = 40 }}
models.chaser = {{ position = [2.0, -1.5, 1.5] }}
[[keyframes]]
time = {seconds}
sun = {{ azimuth_deg = 0, elevation_deg = 40 }}
models.chaser = {{ position = [-1.0, -2.0, 1.0], scale = 0.8 }}
"""


def main(run="out/examples/run", scene="out/examples/scene.toml", out="out/examples/composed", frames=48, size=256):
    text = SCENE.format(frames=frames, size=size, run=Path(run).absolute(), seconds=(frames - 1) / 24)
    Path(scene).write_text(text)  # for `spacesim compose` and `spacesim view`, too
    done = ss.compose(scene, out)
    print(f"scene: {scene}; pictures: {out}; {done.video or done.note or done.sheet}")
    return ss.load_scene(scene)


if __name__ == "__main__":
    main()
