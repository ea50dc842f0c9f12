"""6. Refine a pose: where the camera of a picture stood, from a guess 5 degrees and 5 % of the distance off.

python examples/06_refine_pose.py     some seconds; needs what 01_simulate.py and 02_reconstruct.py have written

`pose.covariance` says how sure it is: docs/how-to/pose.md.
"""

from dataclasses import replace

import numpy as np

import spacesim as ss


def main(run="out/examples/run", data="out/examples/data", starts=4):
    model, frame = ss.load_run(run), ss.read_dataset(data).test[0]
    guess = frame.camera.world_from_camera.copy()
    cross, angle = np.cross(np.eye(3), [0.6, -0.64, 0.48]), np.radians(5)
    guess[:3, :3] = guess[:3, :3] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
    guess[:3, 3] += 0.05 * np.linalg.norm(frame.camera.position) * np.array([0.6, 0.64, -0.48])
    off = replace(frame.camera, world_from_camera=guess)
    pose = ss.refine_pose(model, f"{data}/{frame.file_path}", off, sun=frame.sun, starts=starts)
    for name, camera in ("before", off), ("after", pose.camera):
        print(name, "{:.2f} degrees, {:.2f} % of the distance off".format(*errors(camera, frame.camera)))
    return pose, errors(off, frame.camera), errors(pose.camera, frame.camera)


def errors(camera, true):
    """Degrees and % of the distance between two poses."""
    off = camera.world_from_camera - true.world_from_camera
    turn = 2 * np.arcsin(np.linalg.norm(off[:3, :3]) / np.sqrt(8))
    return np.degrees(turn), 100 * np.linalg.norm(off[:3, 3]) / np.linalg.norm(true.position)


if __name__ == "__main__":
    main()
