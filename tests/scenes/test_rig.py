import numpy as np
import pytest

from spacesim.scenes import GenerateConfig, built_in_scene
from spacesim.scenes.generate import plan_views
from spacesim.scenes.rig import SINGLE_SUN, held_out_suns, training_suns

SCENE = built_in_scene("boxsat")


def test_all_of_the_object_is_in_every_frame():
    train, test = plan_views(SCENE, GenerateConfig(views=40, test_views=10))
    points = np.c_[SCENE.mesh.convex_hull.vertices, np.ones(len(SCENE.mesh.convex_hull.vertices))]
    largest = 0.0
    for _, view in train + test:
        camera = view.camera
        x, y, z = (camera.camera_from_world @ points.T)[:3]
        assert z.min() > 0
        image = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        assert image.min() > 0
        assert image.max() < camera.width
        largest = max(largest, np.abs(image - camera.cx).max() / camera.cx)
    assert largest > 0.8, "the object should fill the frame in some view"


def test_no_camera_is_in_both_sets():
    train, test = plan_views(SCENE, GenerateConfig(suns=3, views=30, test_views=30, test_suns=2))
    assert [name for name, _ in train] == [f"train_{i:05d}" for i in range(90)]
    assert [name for name, _ in test] == [f"test_{i:05d}" for i in range(60)]
    positions = np.array([view.camera.position for _, view in train + test])
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2) + 1e9 * np.eye(len(positions))
    assert apart.min() > 1e-3


def test_views_are_spread_evenly():
    train, _ = plan_views(SCENE, GenerateConfig(views=200))
    directions = np.array([view.camera.position / np.linalg.norm(view.camera.position) for _, view in train])
    assert np.linalg.norm(directions.mean(axis=0)) < 0.02
    np.testing.assert_allclose(directions.T @ directions / 200, np.eye(3) / 3, atol=0.02)


def test_suns():
    assert training_suns(1)[0].angles == pytest.approx(SINGLE_SUN)
    assert [sun.angles for sun in training_suns(1, [(10, 20), (30, -40)])] == [
        pytest.approx((10, 20)),
        pytest.approx((30, -40)),
    ]
    known = np.array([sun.direction for sun in training_suns(24)])
    held_out = np.array([sun.direction for sun in held_out_suns(24, seed=0)])
    np.testing.assert_allclose(np.linalg.norm(known, axis=1), 1)
    assert (known @ held_out.T).max() < np.cos(np.radians(0.5))


def test_test_views_are_of_the_training_suns_unless_others_are_asked_for():
    config = {"suns": 4, "views": 2, "test_views": 3}
    train, test = plan_views(SCENE, GenerateConfig(**config))
    directions = {view.sun.angles for _, view in train}
    assert len(directions) == 4
    assert {view.sun.angles for _, view in test} == directions
    _, test = plan_views(SCENE, GenerateConfig(test_suns=5, **config))
    assert len({view.sun.angles for _, view in test} - directions) == 5
    assert len(test) == 15


def test_seed_turns_the_views_and_nothing_else():
    first, again, other = (
        np.array([view.camera.position for _, view in plan_views(SCENE, GenerateConfig(views=8, seed=seed))[0]])
        for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(first, again)
    assert np.linalg.norm(first - other, axis=1).min() > 1e-3
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), np.linalg.norm(other, axis=1), rtol=1e-3)
