"""Focal lengths and principal points of calibrated cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.store import load_truth, read_dataset
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.config import with_options
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene, scene_text

SIZE, FOCAL, CENTRE = (48, 40), (70.0, 84.0), (20.0, 23.0)
POSE = np.eye(4)


def test_a_camera_has_the_numbers_that_it_was_given():
    camera = CameraConfig(SIZE, focal=FOCAL, principal=CENTRE).at(POSE)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (*FOCAL, *CENTRE)
    middle = CameraConfig(SIZE, focal=FOCAL).at(POSE)
    assert (middle.fx, middle.fy, middle.cx, middle.cy) == (*FOCAL, 24.0, 20.0)
    angle = CameraConfig(SIZE, fov_deg=40.0, principal=CENTRE).at(POSE)
    assert angle.fx == angle.fy == pytest.approx(24 / math.tan(math.radians(20)))
    assert (angle.cx, angle.cy) == CENTRE


def test_the_nearest_border_says_what_fits():
    plain, same = CameraConfig(SIZE, fov_deg=40.0), CameraConfig(SIZE, focal=(24 / math.tan(math.radians(20)),) * 2)
    np.testing.assert_allclose(same.half_tangents, plain.half_tangents, rtol=1e-14)
    assert same.smallest_fov == pytest.approx(plain.smallest_fov, rel=1e-14)
    assert CameraConfig(SIZE, focal=FOCAL, principal=CENTRE).half_tangents == (20 / 70, 17 / 84)


def test_a_part_of_a_picture_is_a_picture_of_its_own(tmp_path):
    """With the principal point moved: the same depths."""
    scene = with_options(read_scene("boxsat"), resolution=SIZE, spp=1, points=10, min_sunlit=None)
    camera = ss.Camera.look_at([7, -6, 4], [0, 0, 0], *SIZE, fov_x_deg=30)
    scene = with_options(scene, rig=ss.PoseRig(camera.world_from_camera[None], sun=(40, 25)))
    whole = replace(scene, camera=CameraConfig(SIZE, focal=FOCAL))
    part = replace(scene, camera=CameraConfig((30, 25), focal=FOCAL, principal=(24.0 - 11, 20.0 - 9)))
    depths = []
    for name, one in (("whole", whole), ("part", part)):
        generate(one, tmp_path / name)
        dataset = read_dataset(tmp_path / name)
        depths.append(load_truth(dataset, dataset.train[0]).depth)
        assert (dataset.train[0].camera.fx, dataset.train[0].camera.fy) == FOCAL
    assert (depths[1] > 0).sum() > 100
    np.testing.assert_allclose(depths[1], depths[0][9:34, 11:41], rtol=1e-5)
    assert "focal = [70.0, 84.0]\nprincipal = [13.0, 11.0]" in scene_text(replace(part, rig=read_scene("boxsat").rig))


def test_a_scene_without_them_is_recorded_as_ever():
    recorded = read_scene("boxsat").to_json()["camera"]
    assert not {"focal", "principal"} & recorded.keys()
    assert with_options(read_scene("boxsat"), focal=(700, 700)).to_json()["camera"]["focal"] == (700.0, 700.0)
    with pytest.raises(InputError, match="background: expected words that say what is drawn, found 1"):
        with_options(read_scene("boxsat"), background=1)


def test_what_is_given_takes_the_place_of_the_scenes_own():
    scene = read_scene("speedplus")  # which has an angle
    camera = with_options(scene, focal=(2988.58, 2988.34)).camera
    assert (camera.focal, with_options(scene).camera.focal) == ((2988.58, 2988.34), None)
    long = with_options(read_scene("boxsat"), focal=(700, 710))
    assert "fov_deg" not in long.to_json()["camera"]
    assert "fov_deg" not in scene_text(long)
    assert with_options(long, fov_deg=30).camera == read_scene("boxsat").camera
    with pytest.raises(InputError, match="focal: expected alone, found fov_deg beside it"):
        with_options(scene, focal=(700, 700), fov_deg=20)


def test_a_rig_does_not_frame_by_an_axis_at_the_border(tmp_path):
    scene = with_options(read_scene("boxsat"), resolution=64, principal=(7.0, 32.0))
    with pytest.raises(InputError, match="principal: expected a point nearer to the middle where the rig is to choose"):
        generate(scene, tmp_path / "data")
    near = with_options(scene, principal=(9.0, 32.0)).camera
    assert near.nearest_border == pytest.approx(9 / 32)


def test_a_lens_is_checked_over_the_part_that_is_seen():
    folds = (-0.3, 0.0, 0.0, 0.0, 0.0)  # 70 pixels from the axis; the middle is 64 from the corners
    CameraConfig((90, 90), focal=(100.0, 100.0), distortion=folds)
    with pytest.raises(InputError, match=r"a lens that is one-to-one over the image, found one that folds 70 of"):
        CameraConfig((90, 90), focal=(100.0, 100.0), principal=(5.0, 45.0), distortion=folds)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"focal": (70.0, 0.0)}, r"focal: expected positive numbers of pixels, found \[70.0, 0.0\]"),
        ({"focal": (math.nan, 70.0)}, "focal: expected positive numbers of pixels"),
        ({"focal": (70.0, 70.0), "fov_deg": 40.0}, "focal: expected alone, found fov_deg 40 beside it"),
        (
            {"focal": (1.0, 70.0)},
            r"focal: expected an angle from 0.001 to 120 degrees across the image, found 175\.\d+ by",
        ),
        ({"principal": (48.0, 20.0)}, r"principal: expected a point within \(48, 40\) pixels, found \[48.0, 20.0\]"),
    ],
)
def test_what_no_picture_has_is_refused(values, words):
    with pytest.raises(InputError, match=words):
        CameraConfig(SIZE, **values)
