"""Pictures for tests: a textured box seen from a camera that moves, and what space looks like behind it."""

import numpy as np
from scipy import ndimage

from spacesim.data.geometry import Array, look_at

SIZE, FOCAL = (320, 240), 420.0
BOX = np.array([1.0, 0.7, 0.5])  # half axes
_rng = np.random.default_rng(5)
_TEXTURES = [
    0.25 + 0.75 * ndimage.zoom(_rng.uniform(size=(28, 28, 3)), (8, 8, 1), order=1) for _ in range(6)
]  # of faces


def poses_around(count: int, degrees: float = 60.0, distance: float = 5.0) -> list[Array]:
    angles = np.radians(np.linspace(0, degrees, count))
    return [look_at(distance * np.array([np.cos(a) * 0.9, np.sin(a), 0.45]), np.zeros(3)) for a in angles]


def box_from(world_from_camera: Array, focal: float = FOCAL) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] uint8 over black, [H, W] bool where the box is)."""
    width, height = SIZE
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], axis=-1) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    slabs = np.stack([(-BOX - origin) / rays, (BOX - origin) / rays])
    near, far = slabs.min(axis=0), slabs.max(axis=0)
    entry = near.max(axis=-1)
    hit = entry < far.min(axis=-1)
    axis = near.argmax(axis=-1)
    place = (origin + entry[..., None] * rays) / BOX
    picture = np.zeros((height, width, 3))
    for k in range(3):
        for sign in (0, 1):
            on = hit & (axis == k) & ((np.take(place, k, axis=-1) > 0) == bool(sign))
            a, b = (np.clip((place[on][:, i] + 1) / 2, 0, 0.999) * 224 for i in range(3) if i != k)
            picture[on] = _TEXTURES[2 * k + sign][a.astype(int), b.astype(int)]
    return np.rint(255 * picture).astype(np.uint8), hit


def earth(shift: float, edge: float, seed: int = 0) -> np.ndarray:
    """[H, W, 3] uint8: sea and clouds to the right of a limb at the share `edge` of the width, stars to its left."""
    width, height = SIZE
    rng = np.random.default_rng(seed)
    clouds = ndimage.gaussian_filter(rng.normal(size=(height, 3 * width)), 9)
    clouds = np.clip(clouds / clouds.std() - 0.3, 0, 1)[:, int(shift) : int(shift) + width, None]
    sea, white = np.array([0.16, 0.26, 0.40]), np.array([0.75, 0.77, 0.80])
    ground = sea + clouds * (white - sea)
    y, x = np.mgrid[:height, :width]
    radius = 4.0 * width
    inside = radius - np.hypot(x - edge * width - radius, y - height / 2)
    lit = np.clip(inside / 8, 0, 1)[..., None]
    sky = np.full((height, width, 3), 0.01)
    sky[rng.integers(0, height, 40), rng.integers(0, width, 40)] = 0.8
    return np.rint(255 * (lit * ground + (1 - lit) * sky)).astype(np.uint8)


def before(picture: np.ndarray, mask: np.ndarray, background: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], picture, background)
