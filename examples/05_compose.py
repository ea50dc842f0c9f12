"""5. Compose: the run of 02_reconstruct.py twice in one scene; one of the two flies past while the Sun moves.

python examples/05_compose.py        a few seconds; writes out/examples/composed and out/examples/scene.toml
"""

from pathlib import Path

from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import Composition, Keyframe, Placed, Pose, PosedScene, save_scene
from spacesim.splat.compose.output import compose
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.run import load_run

RUN, SCENE, OUT = Path("out/examples/run"), Path("out/examples/scene.toml"), Path("out/examples/composed")


def main(run: Path = RUN, scene_file: Path = SCENE, out: Path = OUT, frames: int = 48, size: int = 256) -> PosedScene:
    model = load_run(run)
    start, end = Pose(translation=[2.0, -1.5, 1.5]), Pose(rotation_about([0, 0, 1], 60), [-1.0, -2.0, 1.0], 0.8)
    camera = Camera.from_fov(look_at([5, -7, 4], [0, 0, 0.5]), size, size, 40)
    scene = PosedScene(
        Composition([Placed(model, name="target"), Placed(model, start, "chaser")]),
        Sun.from_angles(-60, 40),
        camera,
        keyframes=[
            Keyframe(0.0, Sun.from_angles(-60, 40), poses={"chaser": start}),
            Keyframe((frames - 1) / 24, Sun.from_angles(0, 40), poses={"chaser": end}),
        ],
        frames=frames,
    )
    save_scene(scene_file, scene)  # for `spacesim compose` and `spacesim view`
    done = compose(scene, out, report=lambda k, of: print(f"{k}/{of}") if k == of else None)
    print(f"scene: {scene_file}; pictures: {out}; {done.video or done.note or done.sheet}")
    return scene


if __name__ == "__main__":
    main()
