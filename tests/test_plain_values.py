"""The public functions take plain values, and say in a sentence which of them cannot be."""

import numpy as np
import pytest

import spacesim as ss


@pytest.mark.parametrize("sun", [(40, 25), [(40.0, 25.0)], np.array([40, 25]), np.array([[40, 25]])])
def test_one_sun_is_enough(sun):
    assert ss.read_scene("boxsat", sun=sun).rig.sun == ((40.0, 25.0),)


def test_numbers_of_numpy_are_numbers():
    scene = ss.read_scene("boxsat", views=np.int64(3), resolution=np.array([64, 32]), distance=np.float32(9))
    assert (scene.rig.views, scene.camera.resolution, scene.rig.distance) == (3, (64, 32), 9.0)


@pytest.mark.parametrize(
    ("name", "value"), [("resolution", "128"), ("views", "60"), ("spp", 2.5), ("exposure", "bright"), ("sun", "40,25")]
)
def test_options_of_scenes_that_cannot_be(name, value):
    with pytest.raises(ss.InputError, match=f"^{name}: expected"):
        ss.read_scene("boxsat", **{name: value})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"iterations": "5"}, "iterations: expected a whole number, found '5'"),
        ({"iterations": 2.5}, "iterations: expected a whole number, found 2.5"),
        ({"light": {"bounce": 2}}, "light: expected a LightConfig, found a table"),
        ({"init": "dreams"}, "init: expected one of mesh, points, random, found 'dreams'"),
        ({"settings": {"preset": "demo"}}, "preset: expected beside the settings"),
        ({"settings": {"method": "relight"}}, "method: expected beside the settings"),
        ({"method": "nerf", "settings": {"method": "nerf-relight"}}, "method: expected beside the settings"),
        ({"method": "nerf", "rays": "4"}, "rays: expected a whole number, found '4'"),
        ({"method": "relight", "light": None}, "light: expected that of the method relight, found that of vanilla"),
    ],
)
def test_trainings_that_cannot_be(options, said, tiny_data, tmp_path):
    with pytest.raises(ss.InputError, match=f"^{said}"):
        ss.train(tiny_data, tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


def test_pictures_and_poses(tiny_run, tiny_data, tmp_path):
    run, frame = ss.load_run(tiny_run), ss.read_dataset(tiny_data).test[0]
    view = run.render(frame.camera, sun=np.array([40.0, 25.0]))
    with pytest.raises(ss.InputError, match=r"^sun: expected \(azimuth, elevation up to 90\)"):
        run.render(frame.camera, sun="40,25")
    with pytest.raises(ss.InputError, match=r"^kind: expected one of rgb, alpha"):
        view.save(tmp_path / "a.png", "foo")
    with pytest.raises(ss.InputError, match=r"^run: expected what load_run returns, found the path run"):
        ss.refine_pose("run", view.rgb, frame.camera)
    still, moved = (ss.render(run.gaussians, frame.camera, twist=twist) for twist in (np.zeros(6), [0, 0, 0, 0, 0, 1]))
    assert np.array_equal(still.to_numpy()[1], ss.render(run.gaussians, frame.camera).to_numpy()[1])
    assert not np.array_equal(moved.to_numpy()[1], still.to_numpy()[1])
    with pytest.raises(ValueError, match=r"^log_scales: expected an array, found none"):
        ss.Gaussians.from_numpy({"means": np.zeros((1, 3))})
