"""The public functions take plain values, and say in a sentence which of them cannot be."""

import re

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
def test_impossible_options_of_scenes_are_refused(name, value):
    with pytest.raises(ss.InputError, match=f"^{name}: expected"):
        ss.read_scene("boxsat", **{name: value})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"iterations": "5"}, "iterations: expected a whole number, found '5'"),
        ({"iterations": 2.5}, "iterations: expected a whole number, found 2.5"),
        ({"light": {"bounce": 2}}, "light: expected a LightConfig, found a table"),
        ({"init": "dreams"}, "init: expected one of mesh, points, random, found 'dreams'"),
        ({"config": "demo"}, "config: expected what `preset` returns, found 'demo'"),
        ({"config": {"iterations": 3}}, "config: expected what `preset` returns, found {'iterations': 3}"),
        ({"settings": "seed=5"}, "settings: expected {name: value}, found 'seed=5'"),
        ({"settings": {5: 1}}, "settings: expected {name: value}, found {5: 1}"),
        ({"progress": 4}, "progress: expected a function, found 4"),
        ({"resume": "no"}, "resume: expected true or false, found 'no'"),
        ({"out": "a\0b"}, r"out: expected a path without a null character, found 'a\\x00b'"),
        (
            {"settings": {"bias": 5}},
            "bias: expected a field of TrainConfig, found 'bias'; did you mean light.shadow.bias",
        ),
        ({"settings": {"preset": "demo"}}, "preset: expected beside the settings"),
        ({"settings": {"method": "relight"}}, "method: expected beside the settings"),
        ({"method": "nerf", "settings": {"method": "nerf-relight"}}, "method: expected beside the settings"),
        ({"method": "nerf", "rays": "4"}, "rays: expected a whole number, found '4'"),
        ({"method": "relight", "light": None}, "light: expected that of the method relight, found that of vanilla"),
    ],
)
def test_impossible_trainings_are_refused(options, said, tiny_data, tmp_path):
    with pytest.raises(ss.InputError, match=f"^{said}"):
        ss.train(tiny_data, **{"out": tmp_path / "run", **options})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("config", "fields", "said"),
    [
        (ss.TrainConfig, {"iterations": "a"}, "iterations: expected a whole number, found 'a'"),
        (ss.TrainConfig, {"ssim_weight": "x"}, "ssim_weight: expected a finite number, found 'x'"),
        (ss.TrainConfig, {"light": "shadow-map"}, "light: expected a LightConfig, found 'shadow-map'"),
        (ss.TrainConfig, {"antialiased": "no"}, "antialiased: expected true or false, found 'no'"),
        (ss.NerfConfig, {"rays": "4"}, "rays: expected a whole number, found '4'"),
    ],
)
def test_configurations_that_cannot_be(config, fields, said):
    with pytest.raises(ss.InputError, match=f"^{said}"):
        config(**fields)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"workers": "2"}, "workers: expected a whole number, found '2'"),
        ({"workers": 2.5}, "workers: expected a whole number, found 2.5"),
        ({"progress": 4}, "progress: expected a function, found 4"),
        ({"out": "a\0b"}, "out: expected a path without a null character"),
    ],
)
def test_datasets_that_cannot_be(options, said, tmp_path):
    with pytest.raises(ss.InputError, match=f"^{said}"):
        ss.generate(**{"scene": "boxsat", "out": tmp_path / "data", **options})
    assert not any(tmp_path.iterdir())


def test_pictures_and_poses(tiny_run, tiny_data, tmp_path):
    run, frame = ss.load_run(tiny_run), ss.read_dataset(tiny_data).test[0]
    view = run.render(frame.camera, sun=np.array([40.0, 25.0]))
    with pytest.raises(ss.InputError, match=r"^sun: expected \(azimuth, elevation up to 90\)"):
        run.render(frame.camera, sun="40,25")
    with pytest.raises(ss.InputError, match=r"^kind: expected one of rgb, alpha"):
        view.save(tmp_path / "a.png", "foo")
    with pytest.raises(ss.InputError, match=r"^run: expected a run of .spacesim train., found no config.json in it"):
        ss.refine_pose("run", view.rgb, frame.camera)
    numbers = [("starts", "4", "a whole number"), ("seed", -1, "0 or more"), ("within", "ab", "a list of 2 numbers")]
    for name, value, expected in numbers:
        with pytest.raises(ss.InputError, match=f"^{name}: expected {expected}, found {value!r}$"):
            ss.refine_pose(run, view.rgb, frame.camera, (40, 25), **{name: value})
    still, moved = (ss.render(run.gaussians, frame.camera, twist=twist) for twist in (np.zeros(6), [0, 0, 0, 0, 0, 1]))
    assert np.array_equal(still.to_numpy()[1], ss.render(run.gaussians, frame.camera).to_numpy()[1])
    assert not np.array_equal(moved.to_numpy()[1], still.to_numpy()[1])
    with pytest.raises(ValueError, match=r"^log_scales: expected an array, found none"):
        ss.Gaussians.from_numpy({"means": np.zeros((1, 3))})


def test_impossible_pictures_are_refused(tiny_run, tiny_data, tmp_path):
    run, frame = ss.load_run(tiny_run), ss.read_dataset(tiny_data).test[0]
    wrong = [
        (r"count: expected 0 or more, found -1", lambda: ss.Gaussians.random(-1, 1.0, 0.1)),
        (r"count: expected a whole number, found 'a'", lambda: ss.Gaussians.random("a", 1.0, 0.1)),
        (r"count: expected a whole number, found 2.5", lambda: ss.Gaussians.random(2.5, 1.0, 0.1)),
        (r"radius: expected a finite number, found nan", lambda: ss.Gaussians.random(3, float("nan"), 0.1)),
        (r"scale: expected metres above 0, found 0", lambda: ss.Gaussians.random(3, 1.0, 0)),
        (r"seed: expected 0 or more, found -1", lambda: ss.Gaussians.random(3, 1.0, 0.1, -1)),
        (r"camera: expected a whole number of pixels", lambda: ss.Camera(np.eye(4), 4.5, 4, 1, 1, 1, 1)),
        (r"camera: expected focal lengths .*, found a and 1", lambda: ss.Camera(np.eye(4), 4, 4, "a", 1, 1, 1)),
        (r"camera: expected focal lengths", lambda: ss.Camera(np.eye(4), 4, 4, 1, None, 1, 1)),
        (r"camera: expected a principal point", lambda: ss.Camera(np.eye(4), 4, 4, 1, 1, "1", 1)),
        (r"camera: expected a size in pixels, found '4' x 4", lambda: ss.Camera.from_fov(np.eye(4), "4", 4, 40)),
        (r"fov_x_deg: expected a number .*, found 'a'", lambda: ss.Camera.from_fov(np.eye(4), 4, 4, "a")),
        (r"position: expected three finite numbers", lambda: ss.Camera.look_at([0, 0, np.nan], [0, 0, 0], 4, 4, 40)),
        (r"position: expected three finite numbers", lambda: ss.Camera.look_at(["a"] * 3, [0, 0, 0], 4, 4, 40)),
        (r"target: expected three finite numbers", lambda: ss.Camera.look_at([0, 0, 1], "abc", 4, 4, 40)),
        (r"world_from_camera\[0\]: expected a \[4, 4\] matrix", lambda: ss.PoseRig(np.full((2, 4, 4), np.nan))),
        (r".*: expected a folder for an evaluation, found a dataset", lambda: ss.evaluate(run, tiny_data, tiny_data)),
    ]
    for said, call in wrong:
        with pytest.raises((ss.InputError, ValueError), match=f"^{said}"):
            call()
    options = [
        ("twist", [0] * 5, "6 finite numbers, found "),
        ("twist", 5, "6 finite numbers, found 5.0"),
        ("twist", [np.nan] * 6, "6 finite numbers, found "),
        ("twist", np.zeros((6, 2)), "6 finite numbers, found "),
        ("outputs", "colour", "some of color, .*, found 'colour'"),
        ("outputs", None, "some of color, .*, found None"),
        ("features", "ab", "arrays of .*, found 'ab'"),
        ("sh_degree", -1, "0 to"),
        ("sh_degree", 5, "0 to"),
        ("sh_degree", "a", "a whole number, found 'a'"),
        ("antialiased", "no", "true or false, found 'no'"),
    ]
    for name, value, said in options:
        with pytest.raises(ValueError, match=f"^{name}: expected {said}"):
            ss.render(run.gaussians, frame.camera, **{name: value})
    with pytest.raises(ss.InputError, match=r"^exposure: expected a finite number, found 'a'"):
        run.render(frame.camera, exposure="a")
    assert sorted(path.name for path in tmp_path.iterdir()) == []


@pytest.mark.parametrize("angle", [400, 180, 180.0, 0, -5, float("nan"), float("inf"), None, "40", [40]])
def test_a_field_of_view_that_no_camera_has_is_named(angle):
    expected = re.escape(f"fov_x_deg: expected a number between 0 and 180 degrees, found {angle!r}")
    with pytest.raises(ss.InputError, match=f"^{expected}$"):
        ss.Camera.look_at([0, -5, 1], [0, 0, 0], 4, 4, angle)
    assert np.isclose(ss.Camera.look_at([0, -5, 1], [0, 0, 0], 4, 4, 90).fx, 2)


@pytest.mark.parametrize("wrong", [None, 5, object()], ids=["None", "5", "object"])
def test_what_is_neither_a_path_nor_a_record_is_named(wrong, tiny_run, tiny_data, tmp_path):
    """In place of each path and record that a public function takes."""
    run, data, out = ss.load_run(tiny_run), ss.read_dataset(tiny_data), tmp_path / "out"
    frame, picture = data.test[0], ss.load_image(data, data.test[0])
    scene = tmp_path / "scene.toml"
    scene.write_text(f"[[models]]\nrun = '{tiny_run}'\n", encoding="utf-8")
    frames = [(wrong, frame), (data, wrong)]
    poses = [(wrong, picture, frame.camera), (run, wrong, frame.camera), (run, picture, wrong)]
    calls = {
        "compose": [(wrong, out), (scene, wrong)],
        "estimate_sun": [(wrong, picture, frame.camera)],
        "evaluate": [(wrong, data, out), (run, wrong, out), (run, data, wrong)],
        "find_pose": poses,
        "generate": [(wrong, out), ("boxsat", wrong)],
        "import_dataset": [(wrong, tiny_data, out), ("nerfstudio", wrong, out), ("nerfstudio", tiny_data, wrong)],
        "load_depth": frames,
        "load_image": frames,
        "load_run": [(wrong,)],
        "load_scene": [(wrong,)],
        "load_truth": frames,
        "preset": [(wrong,), ("fast", wrong)],
        "read_dataset": [(wrong,)],
        "read_scene": [(wrong,)],
        "refine_pose": poses,
        "render": [(wrong, frame.camera), (run.gaussians, wrong)],
        "spacecraft": [(wrong,), ([wrong],)],
        "train": [(wrong, out), (data, wrong), (data, out, wrong or "fast")],
        "write_report": [(wrong, out), (tiny_data, wrong)],
    }
    assert set(calls) == {name for name in ss.__all__ if not isinstance(getattr(ss, name), type)}
    for name, several in calls.items():
        for arguments in several:
            with pytest.raises(ss.InputError, match=r"^[a-z]+: expected .+, found "):
                getattr(ss, name)(*arguments)
    for name in "lpips_weights", "align":
        with pytest.raises(ss.InputError, match=f"^{name}: expected a path"):
            ss.evaluate(run, data, out, **{name: wrong or 0})
    with pytest.raises(ss.InputError, match=r"^path: expected a path, found "):
        run.render(frame.camera).save(wrong)
    assert sorted(tmp_path.iterdir()) == [scene]


def test_poses_and_suns_take_the_folder_of_a_run(tiny_data, tmp_path):
    data = ss.read_dataset(tiny_data)
    run = ss.train(data, tmp_path / "run", preset="demo", method="relight", iterations=30, init_count=200)
    camera, sun = data.test[0].camera, data.test[0].sun
    picture = run.render(camera, sun)
    rgba = np.dstack([picture.rgb / np.maximum(picture.alpha, 1e-3)[..., None], picture.alpha]).clip(0, 1)
    calls = [
        lambda one, image: ss.refine_pose(one, image, camera, sun, starts=1).camera.world_from_camera,
        lambda one, image: ss.find_pose(one, image, camera, sun).pose.camera.world_from_camera,
        lambda one, image: ss.estimate_sun(one, image, camera).direction,
    ]
    for find in calls:
        np.testing.assert_array_equal(find(str(run.path), rgba), find(run, rgba))
        for one, image, said in [
            (run.path, None, r"image: expected \[40, 40, 3 or 4\] as the camera has it, found None"),
            (None, rgba, "run: expected a path or what load_run returns, found None"),
            (tiny_data, rgba, ".*data: expected a run of .spacesim train., found no config.json in it"),
        ]:
            with pytest.raises(ss.InputError, match=f"^{said}$"):
                find(one, image)


def test_a_run_is_no_gaussians_and_nor_are_arrays(tiny_run, tiny_data):
    run, camera = ss.load_run(tiny_run), ss.read_dataset(tiny_data).test[0].camera
    with pytest.raises(
        ss.InputError, match=r"^gaussians: expected Gaussians, found Run; .*: run\.render\(camera, sun\)"
    ):
        ss.render(run, camera)
    arrays = run.gaussians.to_numpy()
    with pytest.raises(TypeError, match=r"^means: expected a Dr.Jit array, found ndarray; .* Gaussians.from_numpy$"):
        ss.Gaussians(**arrays)
    with pytest.raises(TypeError, match=r"^sh: expected a Dr.Jit array, found list"):
        ss.Gaussians(**{**run.gaussians.parameters(), "sh": arrays["sh"].tolist()})
    with pytest.raises(TypeError, match=r"^arrays: expected a dict, as to_numpy gives, found ndarray"):
        ss.Gaussians.from_numpy(arrays["means"])
    lists = {name: array.tolist() for name, array in arrays.items()} | {"features": [[1, 2]] * run.gaussian_count}
    assert ss.Gaussians.from_numpy(lists).feature_count == 2
    np.testing.assert_array_equal(ss.Gaussians.from_numpy(lists).to_numpy()["means"], arrays["means"])


@pytest.mark.parametrize("address", ["foo", None])
def test_wrong_addresses_are_refused(address):
    pytest.importorskip("zmq", reason="pyzmq is not installed")
    with pytest.raises(ss.InputError, match=rf"^address: expected one such as tcp://127.0.0.1:5556, found {address!r}"):
        ss.CameraClient(address)


@pytest.mark.parametrize("camera", ["x", np.eye(4), None])
def test_a_view_is_that_of_a_camera(tiny_run, camera):
    with pytest.raises(ss.InputError, match=r"^camera: expected a Camera, such as Camera.look_at gives, found "):
        ss.load_run(tiny_run).render(camera)
