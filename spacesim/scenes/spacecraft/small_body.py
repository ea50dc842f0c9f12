"""small-body: a cratered asteroid with boulders, 500 m across.

Body axes: +x the longest, +z the shortest and the axis of spin. The origin is its centre of mass but for the boulders.

Craters have the shape of fresh simple ones (Pike, "Size-dependence in the shape of fresh impact craters on the
moon", 1977: depth 0.196 D, rim height 0.036 D), each made shallower by an age drawn at random, and diameters after
a power law, N(>D) ~ D^-2, as near saturation (Gault 1970, "Saturation and equilibrium conditions for impact
cratering on the lunar surface"). Boulders follow N(>D) ~ D^-3, as counted on Itokawa (Michikami et al. 2008, 3.1).
Form, roughness and numbers are those of no real body. One facet is about 5 m wide, so nothing smaller is there.
"""

from dataclasses import replace

import numpy as np
import trimesh

from spacesim.data.geometry import Array, normalize
from spacesim.scenes.materials.table import material
from spacesim.scenes.spacecraft.part import Part, Spacecraft

DIAMETER = 500.0  #: of the sphere of equal volume, metres

_SEED = 7
_SUBDIVISIONS = 6  # 81,920 facets
_AXES = np.array([1.16, 1.0, 0.87])
_CRATERS, _CRATER_DIAMETERS = 190, (34.0, 210.0)
_BOULDERS, _BOULDER_DIAMETERS = 240, (6.0, 40.0)
_GROUND = 120.0  # metres that the pattern of pits and grains covers: pits of 3 to 17 m, below the least crater
_DEPTH, _RIM = 0.196, 0.036  # of a fresh simple crater, in diameters (Pike 1977)
_SHARPNESS = 100.0  # of the rim


def small_body() -> Spacecraft:
    """An asteroid of 500 m: one closed surface, and the boulders that lie on it."""
    random = np.random.default_rng(_SEED)
    body = _body(random)
    soil = replace(material("regolith"), name="coarse-regolith", tile=_GROUND)
    return Spacecraft(
        "small-body",
        (
            Part("surface", body, soil),
            Part("boulders", _boulders(body, random), soil),
        ),
    )


def _body(random: np.random.Generator) -> trimesh.Trimesh:
    """The surface: an ellipsoid, uneven in several octaves, struck by craters from the largest to the smallest."""
    sphere = trimesh.creation.icosphere(subdivisions=_SUBDIVISIONS)
    spacing = float(sphere.edges_unique_length.mean())
    unit = normalize(sphere.vertices + random.uniform(-0.3, 0.3, sphere.vertices.shape) * spacing)  # no pattern shows
    form = 1.0 / np.linalg.norm(unit / _AXES, axis=1)
    height = 0.5 * DIAMETER * form * (1.0 + noise(unit, random, octaves=3, lowest=1.3, amplitude=0.07))
    for diameter in np.sort(power_law(random, _CRATERS, _CRATER_DIAMETERS, 2.0))[::-1]:
        centre = normalize(random.normal(size=3))
        height = height + _crater(unit, height, centre, diameter, freshness=random.uniform(0.35, 1.0))
    height = height + 0.5 * DIAMETER * noise(unit, random, octaves=4, lowest=9.0, amplitude=0.009)
    mesh = trimesh.Trimesh(unit * height[:, None], sphere.faces, process=False)
    mesh.apply_translation(-mesh.center_mass)
    mesh.apply_scale(DIAMETER / (6.0 * mesh.volume / np.pi) ** (1 / 3))
    return mesh


def noise(points: Array, random: np.random.Generator, octaves: int, lowest: float, amplitude: float) -> Array:
    """A smooth random field [N] at `points` [N, 3]: plane waves of random direction and phase.

    lowest: wave number of the first octave, radians a unit of length; each octave doubles the wave number and
    halves the amplitude. amplitude: standard deviation of the first octave.
    """
    waves = 32
    field = np.zeros(len(points))
    for octave in range(octaves):
        direction = normalize(random.normal(size=(waves, 3)))
        wave_number = lowest * 2.0**octave * random.uniform(0.75, 1.5, waves)
        phase = random.uniform(0.0, 2.0 * np.pi, waves)
        crest = np.cos((points @ direction.T) * wave_number + phase)
        field += amplitude * 0.5**octave * np.sqrt(2.0 / waves) * crest.sum(axis=1)
    return field


def power_law(random: np.random.Generator, count: int, limits: tuple[float, float], exponent: float) -> Array:
    """`count` sizes [count] between two limits, of which the number above D falls as D to the minus `exponent`."""
    low, high = (x**-exponent for x in limits)
    return np.asarray((low + random.uniform(size=count) * (high - low)) ** (-1.0 / exponent))


def crater_profile(distance: Array) -> Array:
    """Height [N] of a fresh simple crater, in diameters, at `distance` [N] from its centre in radii: a parabolic
    bowl up to the rim at 1, and ejecta that thin out with the cube of the distance (McGetchin et al. 1973).

    A smooth minimum of the two rounds the rim over about a tenth of the radius and lowers it by 0.007.
    """
    bowl = -(_DEPTH - _RIM) + _DEPTH * np.minimum(distance, 2.0) ** 2
    ejecta = _RIM * np.maximum(distance, 0.8) ** -3
    return np.asarray(-np.logaddexp(-_SHARPNESS * bowl, -_SHARPNESS * ejecta) / _SHARPNESS)


def _crater(unit: Array, height: Array, centre: Array, diameter: float, freshness: float) -> Array:
    """Change of `height` [N] over the directions `unit` [N, 3] by a crater around `centre` [3].

    The bowl is cut into the plain that fits the ground there, not into the ground itself: what was below the
    rim before is gone, as in nature.
    """
    ground = height[(unit @ centre).argmax()]
    across = np.arccos(np.clip(unit @ centre, -1.0, 1.0)) * ground
    distance = across / (0.5 * diameter)
    change = np.zeros(len(unit))
    near = distance < 3.0
    shape = freshness * diameter * crater_profile(distance[near])
    inside = np.clip(1.0 - distance[near], 0.0, 1.0)
    level = height[near].mean() if not (distance < 1.0).any() else height[distance < 1.0].mean()
    smoothing = 0.6 * np.minimum(1.0, 2.5 * inside)
    fade = np.clip(3.0 - distance[near], 0.0, 1.0)
    change[near] = fade * shape + smoothing * (level - height[near])
    return change


def _boulders(body: trimesh.Trimesh, random: np.random.Generator) -> trimesh.Trimesh:
    """Angular rocks, almost half of each in the ground."""
    rocks = []
    for diameter in power_law(random, _BOULDERS, _BOULDER_DIAMETERS, 3.0):
        rock = trimesh.creation.icosphere(subdivisions=2 if diameter > 12.0 else 1)
        unit = np.asarray(rock.vertices)
        shape = random.uniform(0.7, 1.15, 3)
        cut = _facets(unit, random)
        rough = 1.0 + noise(unit, random, octaves=2, lowest=3.0, amplitude=0.05)
        turn = trimesh.transformations.random_rotation_matrix(random.uniform(size=3))[:3, :3]
        vertices = (unit * (cut * rough)[:, None] * shape * 0.5 * diameter) @ turn.T
        foot = random.integers(len(body.vertices))
        place = body.vertices[foot] + 0.06 * diameter * body.vertex_normals[foot]
        rocks.append(trimesh.Trimesh(vertices + place, rock.faces, process=False))
    return trimesh.util.concatenate(rocks)


def _facets(unit: Array, random: np.random.Generator) -> Array:
    """Radii [N] of a unit ball cut by random planes, towards the directions `unit` [N, 3]."""
    planes = normalize(random.normal(size=(9, 3)))
    offset = random.uniform(0.65, 0.95, 9)
    reach = offset / np.maximum(unit @ planes.T, 1e-9)
    return np.asarray(np.minimum(1.0, np.where(reach > 0, reach, 1.0).min(axis=1)))
