"""6. Refine a pose: where the camera of a picture stood, from a guess 5 degrees and 5 % of the distance off.

python examples/06_refine_pose.py     some seconds; needs what 01_simulate.py and 02_reconstruct.py have written
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import spacesim as ss


def main(run="out/examples/run", data="out/examples/data", starts=4, seed=0):
    model, dataset = ss.load_run(run), ss.read_dataset(data)
    frame = dataset.test[0]
    axis, way = (vector / np.linalg.norm(vector) for vector in np.random.default_rng(seed).normal(size=(2, 3)))
    guess = frame.camera.world_from_camera.copy()
    guess[:3, :3] = guess[:3, :3] @ Rotation.from_rotvec(5 * axis, degrees=True).as_matrix()
    guess[:3, 3] += 0.05 * np.linalg.norm(frame.camera.position) * way
    off, image = replace(frame.camera, world_from_camera=guess), ss.load_image(dataset, frame)
    pose = ss.refine_pose(model, image, off, sun=frame.sun, starts=starts)
    print("before: {:.2f} degrees, {:.2f} % of the distance off".format(*errors(off, frame.camera)))
    print("after:  {:.2f} degrees, {:.2f} % of the distance off".format(*errors(pose.camera, frame.camera)))
    turns, metres = np.split(np.sqrt(np.diag(pose.covariance)), 2)
    print(f"standard deviations: {np.degrees(turns)} degrees, {metres} m about the camera's axes")
    return pose, errors(off, frame.camera), errors(pose.camera, frame.camera)


def errors(camera, true):
    turn = Rotation.from_matrix(camera.world_from_camera[:3, :3].T @ true.world_from_camera[:3, :3]).magnitude()
    return np.degrees(turn), 100 * np.linalg.norm(camera.position - true.position) / np.linalg.norm(true.position)


if __name__ == "__main__":
    main()
