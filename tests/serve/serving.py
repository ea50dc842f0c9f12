"""A view that tests ask a server for."""

from spacesim.data.records import Camera, Sun

SUN = Sun.from_angles(40, 25)
CAMERA = Camera.look_at([9.0, -4.0, 3.0], [0, 0, 0], 40, 32, 30.0)
