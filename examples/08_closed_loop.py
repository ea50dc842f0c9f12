"""8. Close a loop: each picture of `spacesim serve` decides where the camera looks next.

python examples/08_closed_loop.py     some seconds beside `spacesim serve boxsat`, which answers it; writes nothing

The camera starts turned away and takes the centroid of what is bright for the direction of the target.
"""

import numpy as np

import spacesim as ss


def main(address="tcp://127.0.0.1:5556", steps=8, size=128):
    """Returns how far the centroid is from the picture's middle in each step, pixels."""
    sun, away, misses = ss.Sun.from_angles(40, 25), np.array([9.0, 5.0, 3.0]), []
    aim = np.array([0.0, 1.5, 1.0])  # metres: should come to the target, about the origin
    with ss.CameraClient(address) as camera:
        for k in range(steps):
            view = ss.Camera.look_at(away - 0.1 * k, aim, size, size, fov_x_deg=30)
            bright = camera.picture(view, sun, seed=k)["rgb"].mean(axis=-1) > 10
            rows, columns = np.nonzero(bright)
            off = np.array([columns.mean() + 0.5 - view.cx, rows.mean() + 0.5 - view.cy, 0])
            misses.append(float(np.hypot(*off[:2])))
            aim = aim + 0.7 * np.linalg.norm(view.position) / view.fx * view.world_from_camera[:3, :3] @ off
            print(f"step {k}: {misses[-1]:.1f} pixels off")
    return misses


if __name__ == "__main__":
    main()
