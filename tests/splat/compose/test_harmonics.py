"""Harmonics that turn: against resampling with scipy's functions, and in pictures of scenes made plain."""

from dataclasses import replace

import numpy as np
import pytest
from posed import disc_run, made_run, seen_from
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere
from spacesim.data.records import Sun
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.plain import bake_scene
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.harmonics import band_rotations, rotate_harmonics
from spacesim.splat.light.shadow.cast import cast_shadows
from spacesim.splat.light.shadow.light_camera import light_rows
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.render import render, view_colors
from spacesim.splat.run import Run

SUN = Sun.from_angles(40, 35)


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """[D, K] real harmonics with the Condon-Shortley phase, by scipy."""
    polar, azimuth = np.arccos(np.clip(directions[:, 2], -1, 1)), np.arctan2(directions[:, 1], directions[:, 0])
    terms = []
    for l in range(degree + 1):  # noqa: E741
        for m in range(-l, l + 1):
            value = sph_harm_y(l, abs(m), polar, azimuth) * (1 if m == 0 else np.sqrt(2))
            terms.append(value.imag if m < 0 else value.real)
    return np.stack(terms, axis=1)


@pytest.mark.parametrize("degree", range(5))
def test_turned_coefficients_are_those_of_the_turned_function(degree):
    rng = np.random.default_rng(degree)
    coefficients, directions = rng.normal(size=(6, (degree + 1) ** 2, 3)), fibonacci_sphere(200, seed=1)
    for turn in (Rotation.random(rng=rng), Rotation.identity(), Rotation.from_euler("z", 180, degrees=True)):
        rotation = turn.as_matrix()
        expected = np.einsum("dk,nkc->ndc", basis(directions @ rotation, degree), coefficients)  # f(R^-1 d)
        found = np.einsum("dk,nkc->ndc", basis(directions, degree), rotate_harmonics(coefficients, rotation))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_bands_are_rotations_and_follow_each_other_as_rotations_do():
    one, other = Rotation.random(rng=np.random.default_rng(0)), Rotation.random(rng=np.random.default_rng(1))
    first, second, both = (band_rotations(turn.as_matrix(), 3) for turn in (one, other, one * other))
    for band in range(4):
        np.testing.assert_allclose(first[band] @ first[band].T, np.eye(2 * band + 1), atol=1e-12)
        np.testing.assert_allclose(first[band] @ second[band], both[band], atol=1e-12)


def test_no_coefficients_and_no_rotation():
    assert rotate_harmonics(np.zeros((4, 0, 3)), np.eye(3)).shape == (4, 0, 3)
    given = np.random.default_rng(0).normal(size=(4, 16, 3))
    assert np.array_equal(rotate_harmonics(given, np.eye(3)), given)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_vanilla_scene_made_plain_is_the_same_picture(degree):
    """Two ways to the same colours: the camera brought into the model, the harmonics brought into the world."""
    turned = Pose(Rotation.random(rng=np.random.default_rng(3)).as_matrix(), [0.5, 0.4, 0.3], 0.8)
    scene = GaussianComposition(
        [PlacedRun(made_run("vanilla", 1, degree=degree), turned), PlacedRun(made_run("vanilla", 2, degree=2)),
         PlacedRun(disc_run(0.3), Pose(translation=1.5 * SUN.direction))]
    )  # fmt: skip
    eye = seen_from([3, -2, 1.5])
    picture = scene.predict(eye, SUN)
    plain = render(bake_scene(scene, SUN), Pinhole.of(eye))
    # Plain colours are clipped at 0 after the shadow, not before it: equal but where a colour is negative.
    np.testing.assert_allclose(plain.image("color"), picture.rgb, atol=1e-4)
    assert picture.visibility.min() < 0.5


def of_one_color(method: str, seed: int) -> Run:
    """A run whose colours differ by shadows alone."""
    run = made_run(method, seed)
    fields = 1 + 2 * run.light.config.field.layers
    run.light.weights = [weight * (i >= fields) for i, weight in enumerate(run.light.weights)]
    return run


@pytest.mark.parametrize("method", ["map", "splat", "linear"])
def test_a_scene_made_plain_has_the_visibility_of_its_pictures(method):
    """Two models 200 m apart, each behind a disc that covers half of it: one light camera for both sees neither."""
    run, across = of_one_color(method, 1), np.cross(SUN.direction, [0, 0, 1])
    across /= np.linalg.norm(across)
    away, facing = 200 * across, rotation_about(np.cross([0, 0, 1], SUN.direction), 55)
    before = 50 * SUN.direction + 3 * across
    discs = [PlacedRun(disc_run(3.0), Pose(facing, before + place)) for place in (np.zeros(3), away)]
    scene = GaussianComposition([PlacedRun(run), PlacedRun(run, Pose(translation=away)), *discs])
    whole = scene.in_world()
    (first, other) = (np.array(v) for v in scene.cross_visibility(SUN) if v is not None)
    one_camera = cast_shadows(whole, light_rows(SUN.direction), replace(run.light.config.shadow, bias=0.0), 4.0)
    assert np.abs(1 - np.array(one_camera.occlusion)[-len(first) :] - other).mean() > 0.1
    np.testing.assert_allclose(first, other, atol=0.02)
    eye = seen_from([3, -2, 1.5])
    _, colors = scene.lit_gaussians(eye, SUN)
    baked = view_colors(bake_scene(scene, SUN), Pinhole.of(eye))
    assert 0.1 < other.mean() < 0.9
    np.testing.assert_allclose(np.array(baked), np.stack([np.array(color) for color in colors]), atol=1e-5)


def test_a_relightable_scene_made_plain_looks_alike():
    turned = Pose(Rotation.random(rng=np.random.default_rng(3)).as_matrix(), [0.5, 0.4, 0.3], 0.8)
    scene = GaussianComposition([PlacedRun(made_run("map", 1), turned), PlacedRun(made_run("splat", 2))])
    eye = seen_from([3, -2, 1.5])
    picture = scene.predict(eye, SUN)
    plain = render(bake_scene(scene, SUN), Pinhole.of(eye)).image("color")
    assert np.abs(plain - picture.rgb).mean() < 0.02
    away = scene.posed([Pose(np.eye(3), turned.translation, 0.8), Pose()])
    assert np.abs(render(bake_scene(away, SUN), Pinhole.of(eye)).image("color") - picture.rgb).mean() > 0.02
    with pytest.raises(InputError, match="expected the Sun"):
        bake_scene(scene, None)
