"""Harmonics that turn: against resampling with scipy's functions, and in pictures of scenes made plain."""

import numpy as np
import pytest
from posed import disc_run, made_run, seen_from
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere
from spacesim.data.records import Sun
from spacesim.splat.compose import Composition, Placed, Pose
from spacesim.splat.compose.harmonics import band_rotations, rotated_harmonics
from spacesim.splat.compose.plain import gathered
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.render import render

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
        found = np.einsum("dk,nkc->ndc", basis(directions, degree), rotated_harmonics(coefficients, rotation))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_bands_are_rotations_and_follow_each_other_as_rotations_do():
    one, other = Rotation.random(rng=np.random.default_rng(0)), Rotation.random(rng=np.random.default_rng(1))
    first, second, both = (band_rotations(turn.as_matrix(), 3) for turn in (one, other, one * other))
    for band in range(4):
        np.testing.assert_allclose(first[band] @ first[band].T, np.eye(2 * band + 1), atol=1e-12)
        np.testing.assert_allclose(first[band] @ second[band], both[band], atol=1e-12)


def test_no_coefficients_and_no_rotation():
    assert rotated_harmonics(np.zeros((4, 0, 3)), np.eye(3)).shape == (4, 0, 3)
    given = np.random.default_rng(0).normal(size=(4, 16, 3))
    assert np.array_equal(rotated_harmonics(given, np.eye(3)), given)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_vanilla_scene_made_plain_is_the_same_picture(degree):
    """Two ways to the same colours: the camera brought into the model, the harmonics brought into the world."""
    turned = Pose(Rotation.random(rng=np.random.default_rng(3)).as_matrix(), [0.5, 0.4, 0.3], 0.8)
    scene = Composition(
        [Placed(made_run("vanilla", 1, degree=degree), turned), Placed(made_run("vanilla", 2, degree=2)),
         Placed(disc_run(0.3), Pose(translation=1.5 * SUN.direction))]
    )  # fmt: skip
    eye = seen_from([3, -2, 1.5])
    picture = scene.predict(eye, SUN)
    plain = render(gathered(scene, SUN), Pinhole.of(eye))
    # Plain colours are clipped at 0 after the shadow, not before it: equal but where a colour is negative.
    np.testing.assert_allclose(plain.image("colour"), picture.rgb, atol=1e-4)
    assert picture.visibility.min() < 0.5


def test_a_relightable_scene_made_plain_looks_alike():
    turned = Pose(Rotation.random(rng=np.random.default_rng(3)).as_matrix(), [0.5, 0.4, 0.3], 0.8)
    scene = Composition([Placed(made_run("map", 1), turned), Placed(made_run("splat", 2))])
    eye = seen_from([3, -2, 1.5])
    picture = scene.predict(eye, SUN)
    plain = render(gathered(scene, SUN), Pinhole.of(eye)).image("colour")
    assert np.abs(plain - picture.rgb).mean() < 0.02
    away = scene.posed([Pose(np.eye(3), turned.translation, 0.8), Pose()])
    assert np.abs(render(gathered(away, SUN), Pinhole.of(eye)).image("colour") - picture.rgb).mean() > 0.02
    with pytest.raises(InputError, match="expected the Sun"):
        gathered(scene, None)
