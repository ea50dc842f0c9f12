"""What the renderer is checked against in closed form, as numbers: `test_truth.py` bounds them, and

python tests/scenes/truth.py                                    prints them (a minute on two cores)
python tests/scenes/truth.py --labels boxsat FILE.glb           labels of scenes and mesh files, against `raycast.py`
python tests/scenes/truth.py --penumbrae boxsat telescope       visibility of the solar disc, against the same
python tests/scenes/truth.py --whole boxsat                     whole renders, `whole.py`

These are the figures of docs/research/truth.md.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import raycast
import trimesh
import whole

from spacesim.data.geometry import direction_from_angles, look_at
from spacesim.data.records import Camera, Sun, Truth
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM, EarthConfig
from spacesim.scenes.lights.sun import SOLAR_IRRADIANCE, SunConfig
from spacesim.scenes.materials.table import lambertian
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.scenefile import BUILT_IN_SCENES
from spacesim.scenes.spacecraft import Part, Spacecraft

SOLAR_RADIUS = math.asin(695_700.0 / 149_597_870.7)  # radians
OVERHEAD = Sun.from_angles(0, 90)


def scene_of(*meshes: trimesh.Trimesh, albedo: float = 0.5, sun: SunConfig | None = None, earth=None) -> Scene:
    material = lambertian("test", (albedo,) * 3, "test")
    parts = tuple(Part(f"part {i}", mesh, material) for i, mesh in enumerate(meshes))
    return Scene("test", (SceneObject(Spacecraft("test", parts)),), sun or SunConfig(), earth)


def plate(size: float = 20.0) -> trimesh.Trimesh:
    """A slab whose upper face lies at z = 0."""
    return trimesh.creation.box((size, size, 0.1), transform=trimesh.transformations.translation_matrix([0, 0, -0.05]))


def seen_from_above(scene: Scene, sun: Sun, spp: int = 256) -> Truth:
    camera = Camera.from_fov(look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), 8, 8, 10.0)
    return Renderer(scene, spp=spp).render(camera, sun, seed=(1,))


def plate_error(elevation_deg: float = 90.0, distance_au: float = 1.0) -> float:
    """Relative error of a Lambertian plate's radiance: albedo E sin(elevation) / (pi d^2)."""
    scene = scene_of(plate(), sun=SunConfig(distance_au=distance_au))
    radiance = seen_from_above(scene, Sun.from_angles(20, elevation_deg)).radiance.mean()
    expected = 0.5 * SOLAR_IRRADIANCE * math.sin(math.radians(elevation_deg)) / math.pi / distance_au**2
    return float(radiance / expected - 1)


def disc_seen_beside(separation: np.ndarray, occulter: np.ndarray) -> np.ndarray:
    """Fraction of the Sun's disc that an occulting disc of angular radius `occulter` leaves, their centres `separation`
    apart, radians: one minus the lens of two circles."""
    a, b, d = SOLAR_RADIUS, occulter, np.maximum(separation, 1e-12)
    lens = (
        a**2 * np.arccos(np.clip((d**2 + a**2 - b**2) / (2 * d * a), -1, 1))
        + b**2 * np.arccos(np.clip((d**2 + b**2 - a**2) / (2 * d * b), -1, 1))
        - 0.5 * np.sqrt(np.maximum((-d + a + b) * (d + a - b) * (d - a + b) * (d + a + b), 0))
    )
    lens = np.where(d >= a + b, 0, np.where(d <= np.abs(a - b), np.pi * np.minimum(a, b) ** 2, lens))
    return 1 - lens / (np.pi * a**2)


def penumbra_profile(elevation_deg: float = 90.0) -> dict[str, np.ndarray]:
    """Along a row of pixels over the shadow that a sphere of 1 m casts on a plate from 60 m above.

    Returns x: metres along the row, visibility and radiance (relative to full sunlight) as rendered, expected.
    """
    sun = Sun.from_angles(0, elevation_deg)
    centre = 60.0 * sun.direction
    ball = trimesh.creation.icosphere(subdivisions=6, radius=1.0).apply_translation(centre)
    camera = Camera.from_fov(look_at([0, 0, 10], [0, 0, 0], [0, 1, 0]), 256, 16, 40.0)
    truth = Renderer(scene_of(plate(40.0), ball), spp=256).render(camera, sun, seed=(2,))
    row = 8
    x = (np.arange(256) + 0.5 - camera.cx) / camera.fx * 10
    y = -(row + 0.5 - camera.cy) / camera.fy * 10
    points = np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1)
    to_ball = centre - points
    reach = np.linalg.norm(to_ball, axis=1)
    separation = np.arccos(np.clip(to_ball @ sun.direction / reach, -1, 1))
    full = 0.5 * SOLAR_IRRADIANCE * sun.direction[2] / math.pi
    return {
        "x": x,
        "visibility": truth.sun_visibility[row],
        "radiance": truth.radiance[row, :, 0] / full,
        "expected": disc_seen_beside(separation, np.arcsin(1.0 / reach)),
    }


def edge_error(profile: dict[str, np.ndarray], key: str = "visibility") -> float:
    """Largest distance in pixels between where `key` and the expectation cross 0.02, 0.5 and 0.98."""
    errors = []
    for level in (0.02, 0.5, 0.98):
        found, expected = (_crossings(profile[name], level) for name in (key, "expected"))
        errors.append(np.abs(found - expected).max() if len(found) == len(expected) else math.inf)
    return float(max(errors))


def _crossings(values: np.ndarray, level: float) -> np.ndarray:
    i = np.flatnonzero((values[:-1] < level) != (values[1:] < level))
    return i + (level - values[i]) / (values[i + 1] - values[i])


def integrating_sphere_error(albedo: float = 0.8) -> float:
    """Relative error of the radiance of a sphere's inside, lit by sunlight through a port (unlit parts of the wall).

    Every path is counted: light of flux F that enters through a port of the fraction f of the whole sphere leaves the
    wall with radiance albedo^2 F / (pi A (1 - albedo (1 - f))) where no sunlight falls directly (Jacquez and Kuppenheim
    1955, "Theory of the integrating sphere").
    """
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    ball.update_faces(ball.triangles_center[:, 2] < 0.95)
    fraction = 1 - ball.area / (4 * math.pi)
    outline = ball.vertices[ball.outline().entities[0].points[:-1]]
    x, y = outline[:, 0], outline[:, 1]
    port = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    scene = scene_of(ball, albedo=albedo)
    camera = Camera.from_fov(look_at([0, 0, 0], [1, 0, 0]), 8, 8, 60.0)
    radiance = Renderer(scene, spp=4096, max_depth=200).render(camera, OVERHEAD, seed=(3,)).radiance.mean()
    area = ball.area / (1 - fraction)
    expected = albedo**2 * SOLAR_IRRADIANCE * port / (math.pi * area * (1 - albedo * (1 - fraction)))
    return float(radiance / expected - 1)


def earth_error(phase_deg: float = 0.0, altitude_km: float = 500.0) -> float:
    """Relative error of a plate's radiance that faces the Earth, against quadrature over the sphere's visible cap."""
    sun = Sun(-direction_from_angles(0.0, 90.0 - phase_deg))  # phase 0: the Sun behind the scene, the Earth full
    earth = EarthConfig(0.0, 90.0, altitude_km, albedo=0.3)
    truth = seen_from_above(scene_of(plate(), earth=earth), sun, spp=16_384)
    distance = 1 + altitude_km / EARTH_RADIUS_KM
    # elements of the sphere (centre at +z distance): position p, normal n, irradiance L cos cos / r^2
    step = (1 - 1 / distance) / 2000  # of the cap that is seen alone, n_z from -1 to -1 / distance
    cosine = -1 + step * (np.arange(2000) + 0.5)
    turn = np.linspace(0, 2 * np.pi, 721)[:-1]
    c, t = np.meshgrid(cosine, turn, indexing="ij")
    normal = np.stack([np.sqrt(1 - c * c) * np.cos(t), np.sqrt(1 - c * c) * np.sin(t), c], axis=-1)
    towards = normal + np.array([0, 0, distance])
    r = np.linalg.norm(towards, axis=-1)
    leaving = np.maximum(-(normal * towards).sum(-1) / r, 0)
    arriving = np.maximum(towards[..., 2] / r, 0)
    glow = 0.3 * SOLAR_IRRADIANCE / np.pi * np.maximum(normal @ sun.direction, 0)
    irradiance = (glow * leaving * arriving / r**2).sum() * step * (2 * np.pi / 720)
    assert truth.radiance_earth is not None
    return float(truth.radiance_earth.mean() / (0.5 * irradiance / np.pi) - 1)


def labels(sources: list[str], units: str, views: int = 4) -> None:
    """Labels of scenes and mesh files against the other ray caster."""
    for source in sources:
        options = {} if source in BUILT_IN_SCENES or source.endswith(".toml") else {"units": units}
        found = raycast.labels_agree(source, views=views, **options)
        same = 1 - (found.edge + found.offset + sum(found.wrong.values())) / found.surface
        print(
            f"{Path(source).name:20} {found.surface:7,} pixels of surface, {100 * same:.3f} % the same, on edges "
            f"{found.edge}, by the height of shadow rays {found.offset}, wrong {dict(found.wrong) or 'none'}; "
            f"points off their plane by {found.off_plane:.1e} of the distance",
            flush=True,
        )


def penumbrae(sources: list[str]) -> None:
    """The fraction of the solar disc that points beside cast shadows see, against the other ray caster."""
    for source in sources:
        found = raycast.penumbra(source, count=1000)
        part = found.error[(found.expected > 0) & (found.expected < 1)]
        over = (found.error > 0.02).sum()
        print(f"{source:20} {len(found.error)} points beside shadows, {len(part)} in penumbrae", end=", ")
        print(f"there {part.mean():.4f} off; {over} beyond 0.02, worst {found.error.max():.3f}", flush=True)


def wholes(sources: list[str]) -> None:
    """Whole renders: RGB against spectral, both sources against each alone."""
    for source in sources:
        for part, difference in whole.rgb_against_spectral(source).items():
            print(f"{source:20} {part:40} RGB against spectral {100 * difference:.2f} %", flush=True)
        difference, error, share = whole.sources_apart(source)
        worst, noise = 100 * np.abs(difference).max(), np.abs(difference / error).max()
        print(f"{source:20} Sun and Earth against both: {worst:.2f} % at most, {noise:.1f} standard errors", end=", ")
        print(f"the Earth's share {100 * share.min():.0f} to {100 * share.max():.0f} %", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--labels", nargs="+", metavar="SCENE", help="built-in scenes, scene files or mesh files")
    parser.add_argument("--units", default="m", help="of mesh files")
    parser.add_argument("--penumbrae", nargs="+", metavar="SCENE", help="visibility beside shadows of built-in scenes")
    parser.add_argument("--whole", nargs="+", metavar="SCENE", help="sources apart, RGB against spectral rendering")
    options = parser.parse_args()
    if not (options.labels or options.penumbrae or options.whole):
        closed_forms()
    labels(options.labels or [], options.units)
    penumbrae(options.penumbrae or [])
    wholes(options.whole or [])


def closed_forms() -> None:
    rows: list[tuple[str, Callable[[], float], str]] = [
        ("plate that faces the Sun, radiance", plate_error, "%"),
        ("plate at 30 degrees", lambda: plate_error(30.0), "%"),
        ("plate at 5 degrees", lambda: plate_error(5.0), "%"),
        ("plate at 5.2 au", lambda: plate_error(distance_au=5.2), "%"),
        ("integrating sphere, albedo 0.5", lambda: integrating_sphere_error(0.5), "%"),
        ("integrating sphere, albedo 0.8", lambda: integrating_sphere_error(0.8), "%"),
        ("full Earth at 500 km", earth_error, "%"),
        ("half Earth at 500 km", lambda: earth_error(90.0), "%"),
        ("full Earth at 36,000 km", lambda: earth_error(0.0, 36_000.0), "%"),
    ]
    for name, error, unit in rows:
        print(f"{name:40} {100 * error():+.3f} {unit}", flush=True)
    for elevation in (90.0, 45.0):
        profile = penumbra_profile(elevation)
        off = {key: profile[key] - profile["expected"] for key in ("visibility", "radiance")}
        name = f"penumbra of a sphere at {elevation:.0f} degrees"
        seen, edges = np.abs(off["visibility"]).max(), edge_error(profile)
        noise = np.sqrt(np.mean(off["radiance"] ** 2))
        print(
            f"{name:40} visibility within {seen:.4f}, edges within {edges:.2f} pixels; "
            f"radiance, root mean square {noise:.4f}"
        )


if __name__ == "__main__":
    main()
