"""What a run does not know of a picture is found on some of its pixels."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from splats import random_splats

from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at, rotation_from_quaternion
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import Pose
from spacesim.splat.compose.aligned import AlignedRun
from spacesim.splat.fit import EmbeddingFit, GainFit, Picture, PictureLight, draw, find_unknowns
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import FieldConfig, ViewAloneConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

PICTURES, SIZE = 12, 6
CAMERA = Camera.from_fov(look_at((0.4, -4, 0.6), (0, 0, 0)), 40, 32, 40)
LEFT = np.broadcast_to(np.arange(40) < 20, (32, 40))


@pytest.fixture(scope="module")
def run() -> Run:
    """Random networks and Gaussians, 12 pictures with embeddings of 6 numbers, which vary along 3 axes."""
    rng, arrays = np.random.default_rng(3), random_splats(60)
    config = LightConfig(
        FieldConfig(features=5, width=12, inputs=ViewAloneConfig(Encoding("harmonics", 1)), embeddings=SIZE)
    )
    arrays |= {"sh": np.zeros((60, 0, 3)), "features": rng.normal(size=(60, config.features))}
    light = LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, 4.0, 1.0), 0, PICTURES)
    light.weights = [upload(np.array(w) + 0.3 * rng.normal(size=dr.width(w))) for w in light.weights]
    embeddings = 0.5 + rng.normal(size=(PICTURES, 3)) @ rng.normal(size=(3, SIZE))
    light.embeddings = [upload(embeddings.ravel())]
    return Run(Path("runs/random"), {"method": "relight"}, {}, Gaussians.from_numpy(arrays), 1000, light)


def embedding_of(run: Run, picture: int) -> np.ndarray:
    return np.array(run.light.embeddings[0], np.float64).reshape(-1, SIZE)[picture]


def error(run, picture: Picture, light: PictureLight, mask: np.ndarray) -> float:
    return float(np.sqrt(np.square(np.clip(draw(run, CAMERA, light).rgb, 0, 1) - picture.rgb)[mask].mean()))


def test_unknowns_are_those_of_the_run(run):
    plain = Run(Path("plain"), {}, {}, Gaussians.from_numpy(random_splats(5)), 1)
    assert find_unknowns(plain) == ()
    assert [unknown.name for unknown in find_unknowns(plain, gain=True)] == ["gain"]
    for known in (run, AlignedRun(run, Pose(scale=2.0))):
        assert [unknown.name for unknown in find_unknowns(known, gain=True)] == ["embedding", "gain"]
    with pytest.raises(InputError, match="embedding: expected 6 numbers"):
        run.with_embedding(np.zeros(5))
    with pytest.raises(InputError, match="embedding: expected 0 numbers"):
        plain.with_embedding(np.zeros(5))


def test_the_embedding_of_a_half_shows_the_other(run):
    """Pictures drawn with embeddings of training: each is found on one half, and shows the other half as it is."""
    (fit,) = find_unknowns(run)
    assert fit.axes.shape == (SIZE, 3)
    for number in (0, 5):
        truth = run.with_embedding(embedding_of(run, number)).predict(CAMERA).rgb
        picture, start = Picture(np.clip(truth, 0, 1), CAMERA), PictureLight()
        masks = [LEFT, ~LEFT]
        lights = fit.fit(run, picture, masks, [start, start])
        for light, scored in zip(lights, masks[::-1], strict=True):
            assert error(run, picture, light, scored) < 0.1 * error(run, picture, start, scored)
        again = fit.fit(run, picture, masks, [start, start])
        assert all(np.array_equal(a.embedding, b.embedding) for a, b in zip(lights, again, strict=True))


def test_pixels_beside_the_mask_do_not_count(run):
    (fit,) = find_unknowns(run)
    truth = np.clip(run.with_embedding(embedding_of(run, 2)).predict(CAMERA).rgb, 0, 1)
    spoilt = np.where(LEFT[..., None], truth, 1 - truth)
    one, other = (fit.fit(run, Picture(rgb, CAMERA), [LEFT], [PictureLight()])[0] for rgb in (truth, spoilt))
    np.testing.assert_array_equal(one.embedding, other.embedding)


def test_a_picture_that_says_nothing_has_the_likeliest_embedding(run):
    """Where what is to be fitted looks the same whatever the embedding, that is the mean one."""
    (fit,) = find_unknowns(run)
    empty = run.predict(CAMERA).alpha == 0
    assert empty.any()
    (light,) = fit.fit(run, Picture(np.zeros((32, 40, 3), np.float32), CAMERA), [empty], [PictureLight()])
    np.testing.assert_allclose(light.embedding, fit.mean)


def test_embeddings_that_are_all_the_same_are_not_searched(run):
    fit = EmbeddingFit.of(np.ones((4, SIZE)))
    start = PictureLight()
    assert fit.fit(run, Picture(np.zeros((32, 40, 3), np.float32), CAMERA), [LEFT], [start]) == [start]


def test_the_gain_is_that_of_linear_light(run):
    shown = np.clip(run.predict(CAMERA).rgb, 0, 1)
    darker = srgb_from_linear(0.4 * linear_from_srgb(shown))
    lights = GainFit().fit(run, Picture(darker, CAMERA), [LEFT, ~LEFT], [PictureLight()] * 2)
    assert [light.gain for light in lights] == pytest.approx([0.4, 0.4], rel=1e-5)
    np.testing.assert_allclose(draw(run, CAMERA, lights[0]).rgb, darker, atol=1e-5)


def test_saturated_pixels_do_not_tell_the_gain(run):
    shown = linear_from_srgb(np.clip(run.predict(CAMERA).rgb, 0, 1))
    factor = 1.5 / float(shown.max())
    bright = srgb_from_linear(factor * shown)
    assert bright.max() > 0.999
    (light,) = GainFit().fit(run, Picture(bright, CAMERA), [np.ones_like(LEFT)], [PictureLight()])
    assert light.gain == pytest.approx(factor, rel=1e-4)


def test_a_run_that_is_moved_shows_the_same_picture(run):
    """From a camera that is moved with it; lengths are scaled and normals turned."""
    pose = Pose(rotation_from_quaternion([0.8, 0.1, -0.5, 0.3]), [3.0, -2.0, 7.0], 2.5)
    turned = AlignedRun(run, pose)
    place = np.eye(4)
    place[:3, :3] = pose.rotation @ CAMERA.world_from_camera[:3, :3]
    place[:3, 3] = pose.points(CAMERA.position)
    there = turned.predict(replace(CAMERA, world_from_camera=place), Sun(np.array([0.0, 0, 1])), normals=True)
    here = run.predict(CAMERA, normals=True)
    np.testing.assert_allclose(there.rgb, here.rgb, atol=2e-4)
    np.testing.assert_allclose(there.depth, 2.5 * here.depth, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(there.normal, here.normal @ pose.rotation.T, atol=2e-3)
    means = turned.gaussians.to_numpy()["means"]
    np.testing.assert_allclose(means, pose.points(run.gaussians.to_numpy()["means"]), atol=1e-4)
