"""What is behind the objects of each frame: where the Earth is, and what the camera sees of it and of the stars."""

import math
from dataclasses import replace

import numpy as np

from spacesim.data.geometry import Array, rotation_from_quaternion
from spacesim.data.records import Camera, Sun
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.background.globe import Globe, Placement
from spacesim.scenes.background.stars import Stars
from spacesim.scenes.cameras.kernel_camera import Units
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.scene import Scene
from spacesim.scenes.steps import Steps, completed

TRIES = 64  #: to have sunlit ground behind the objects
SUN_UP = 0.2  #: sine of the Sun's elevation there, at least: lower, the ground is dim beside the objects
_GOLDEN = 0.5 * (math.sqrt(5) - 1)
_WHEN, _WHERE, _SKY, _GLOBE = range(100, 104)  # streams of random numbers


class Background:
    """Draws the background of a scene's frames.

    seed: of the scene; the same seed, backend and frame: the same bits

    Where the Earth is behind the objects, it is so in a share of any run of frames (multiples of the golden ratio
    spread evenly), in a direction and turned as drawn at random for the frame, with sunlit ground behind the middle of
    the objects where a few draws find some.
    """

    def __init__(self, config: BackgroundConfig, scene: Scene, distortion: tuple[float, ...], seed: int) -> None:
        self._config, self._seed, self._distortion = config, seed, distortion
        self._earth, self._target = scene.earth or EarthConfig(), scene.bounding_sphere[0]
        self._fixed = config.is_fixed(scene.earth)
        self._stars = Stars(_number(seed, _SKY)) if config.stars else None
        self._globe = None
        if config.earth:
            units = Units.of(scene.bounding_sphere)
            self._globe = Globe(units, distortion, scene.sun.irradiance, _number(seed, _GLOBE))

    def placement(
        self, camera: Camera, sun: Sun, index: int, earth: EarthConfig | None = None, sky: Array | None = None
    ) -> Placement | None:
        """Where the Earth is in frame `index`; None where it is not behind. earth, sky: as in `radiance`"""
        earth = earth or self._earth
        if self._globe is None:
            return None
        if self._fixed:
            turn = _turn(np.random.default_rng([self._seed, _WHERE]))
            return Placement(earth.direction, earth.distance, turn if sky is None else turn @ sky)
        start = _number(self._seed, _WHEN) * 2.0**-32
        if (start + index * _GOLDEN) % 1 >= self._config.share:
            return None
        random = np.random.default_rng([self._seed, _WHERE, index])
        towards = self._target - camera.position
        towards = towards / np.linalg.norm(towards)
        for _ in range(TRIES):
            direction = _within_cone(random, towards, math.cos(earth.angular_radius))
            place = Placement(direction, earth.distance, np.eye(3))
            normal = place.normal_behind(towards)
            if normal is not None and normal @ sun.direction > SUN_UP:
                break
        return Placement(direction, earth.distance, _turn(random))

    def radiance(
        self, camera: Camera, sun: Sun, index: int, earth: EarthConfig | None = None, sky: Array | None = None
    ) -> np.ndarray:
        """[H, W, 3] float32, W m^-2 sr^-1: what frame `index` would show without objects.

        earth: where the Earth is, None: as the scene says; sky: [3, 3] from the world's axes to those in which stars
        and a fixed Earth's ground stand still, None: the world's."""
        return completed(self.drawing(camera, sun, index, earth, sky))

    def drawing(
        self, camera: Camera, sun: Sun, index: int, earth: EarthConfig | None = None, sky: Array | None = None
    ) -> Steps[np.ndarray]:
        """`radiance` in steps; in the first the device is asked for the Earth."""
        place = self.placement(camera, sun, index, earth, sky)
        globe = None if place is None or self._globe is None else self._globe.draw(camera, sun, place)
        if globe is not None:
            next(globe)
        yield
        result = np.zeros((camera.height, camera.width, 3), np.float32)
        if self._stars is not None:
            pose = camera.world_from_camera.copy()
            pose[:3, :3] = pose[:3, :3] if sky is None else sky @ pose[:3, :3]
            stars = self._stars.draw(replace(camera, world_from_camera=pose), self._distortion)
            result += np.float32(self._config.star_gain) * stars[..., None]
        if globe is not None:
            light, cover = yield from globe
            result = result * (1 - cover[..., None]) + light
        return result


def _within_cone(random: np.random.Generator, axis: Array, cosine: float) -> Array:
    """[3] a unit vector, as likely as any other whose angle to the unit `axis` has at least this cosine."""
    c, angle = 1 - random.random() * (1 - cosine), 2 * math.pi * random.random()
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side = side / np.linalg.norm(side)
    across = math.cos(angle) * side + math.sin(angle) * np.cross(axis, side)
    return c * axis + math.sqrt(max(1 - c * c, 0)) * across


def _turn(random: np.random.Generator) -> Array:
    """[3, 3] a rotation, as likely as any other."""
    return rotation_from_quaternion(random.normal(size=4))


def _number(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])
