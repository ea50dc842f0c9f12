"""6. Refine a pose: where the camera of a picture stood, from a guess 5 degrees and 5 % of the distance off.

python examples/06_refine_pose.py     some seconds; needs what 01_simulate.py and 02_reconstruct.py have written

`pose.covariance` says how sure it is: docs/how-to/pose.md.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import spacesim as ss


def main(run="out/examples/run", data="out/examples/data", starts=4):
    model, dataset = ss.load_run(run), ss.read_dataset(data)
    frame = dataset.test[0]
    guess = frame.camera.world_from_camera.copy()
    guess[:3, :3] = guess[:3, :3] @ Rotation.from_rotvec([3.0, -3.2, 2.4], degrees=True).as_matrix()
    guess[:3, 3] += 0.05 * np.linalg.norm(frame.camera.position) * np.array([0.6, 0.64, -0.48])
    off, image = replace(frame.camera, world_from_camera=guess), ss.load_image(dataset, frame)
    pose = ss.refine_pose(model, image, off, sun=frame.sun, starts=starts)
    for name, camera in ("before", off), ("after", pose.camera):
        print(name, "{:.2f} degrees, {:.2f} % of the distance off".format(*errors(camera, frame.camera)))
    return pose, errors(off, frame.camera), errors(pose.camera, frame.camera)


def errors(camera, true):
    turn = Rotation.from_matrix(camera.world_from_camera[:3, :3].T @ true.world_from_camera[:3, :3]).magnitude()
    return np.degrees(turn), 100 * np.linalg.norm(camera.position - true.position) / np.linalg.norm(true.position)


if __name__ == "__main__":
    main()
