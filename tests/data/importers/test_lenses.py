"""Camera models against pycolmap's and by hand; pictures that are undistorted against what was rendered."""

import numpy as np
import pytest
from colmap_files import EXAMPLES, MODELS, NUMBERS, imported, lens_of, project, ring, write_binary
from PIL import Image

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.importers.lenses import LENS_MODELS, Lens


@pytest.mark.parametrize("name", EXAMPLES)
def test_lenses_project_as_pycolmap_says(name):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    if not hasattr(pycolmap.CameraModelId, name):
        pytest.skip(f"this pycolmap knows no {name}")
    lens = lens_of(name)
    camera = pycolmap.Camera(model=name, width=64, height=48, params=list(lens.parameters))
    assert int(camera.model) == NUMBERS[name] == next(n for n, model in LENS_MODELS.items() if model.name == name)
    x, y = np.random.default_rng(0).uniform(-0.8, 0.8, (2, 500))
    x[0] = y[0] = 0
    theirs = camera.img_from_cam(np.stack([x, y, np.ones(500)], axis=1))
    np.testing.assert_allclose(np.stack(lens.project(x, y), axis=1), theirs, rtol=0, atol=1e-9)


def test_every_model_of_pycolmap_is_known():
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    assert set(pycolmap.CameraModelId.__members__) - {"INVALID"} <= set(EXAMPLES) | {"EQUIRECTANGULAR"}


def test_lenses_by_hand():
    """What the formulas give without another implementation: 45 degrees off the axis."""
    x = np.array([1.0])

    def place(name, others):
        return float(Lens(MODELS[name], 10, 10, (1.0, 1.0, 0.0, 0.0, *others)).project(x, 0 * x)[0][0])

    assert place("FISHEYE", ()) == pytest.approx(np.pi / 4)
    assert place("OPENCV_FISHEYE", (0.1, 0, 0, 0)) == pytest.approx(np.pi / 4 * (1 + 0.1 * (np.pi / 4) ** 2))
    assert place("FOV", (np.pi / 2,)) == pytest.approx(np.arctan(2.0) / (np.pi / 2))
    assert place("EUCM", (0.5, 1.0)) == pytest.approx(1 / (0.5 * np.sqrt(2) + 0.5))  # the unit sphere from its rim
    assert place("FULL_OPENCV", (1, 0, 0, 0, 0, 1, 0, 0)) == pytest.approx(1.0)  # its polynomials cancel
    undone = place("DIVISION", (-0.2,))
    assert undone / (1 - 0.2 * undone**2) == pytest.approx(1.0)


def pattern(x, y):
    """Of the directions (x, y, 1), 0 to 1."""
    return 0.5 + 0.25 * np.sin(9 * x + 1) + 0.25 * np.cos(7 * y)


def unfish(width, height, f, cx, cy, k1):
    """Directions of the pixels of a lens whose picture is at f (t + k1 t^3), found by a table."""
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / f, (np.arange(height) + 0.5 - cy) / f)
    t = np.linspace(0, 1.5, 200_000)
    r = np.hypot(x, y)
    angle = np.interp(r, t + k1 * t**3, t)
    return x / r * np.tan(angle), y / r * np.tan(angle)


def test_undistorted_pictures_show_what_was_rendered(tmp_path):
    width, height, f, cx, cy, k1 = 128, 96, 90.0, 66.3, 47.2, 0.08
    seen = pattern(*unfish(width, height, f, cx, cy, k1))
    root = tmp_path / "src"
    write_binary(root / "sparse/0", ring(2, cameras={1: ("SIMPLE_RADIAL_FISHEYE", width, height, (f, cx, cy, k1))}))
    (root / "images").mkdir()
    for k in range(2):
        Image.fromarray(np.rint(255 * seen).astype(np.uint8)).save(root / f"images/view {k}.png")
    dataset = imported(root, tmp_path / "out")
    frame = dataset.frames[0]
    camera = frame.camera
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - camera.cx) / camera.fx, (np.arange(height) + 0.5 - camera.cy) / camera.fy
    )
    image = ss.load_image(dataset, frame)
    assert image.valid.mean() > 0.95
    off = np.abs(image.rgb[..., 0] - pattern(x, y))[image.valid]
    assert off.mean() < 0.003
    assert off.max() < 0.02
    assert frame.distortion == ()


def test_what_the_lens_does_not_see_is_unknown(tmp_path):
    """A lens that magnifies its rim: the pinhole camera sees farther than the picture reaches."""
    lens = ("FULL_OPENCV", 64, 48, (40.0, 40.0, 32.0, 24.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0))
    dataset = imported(project(tmp_path / "src", ring(2, cameras={1: lens}), size=(64, 48)), tmp_path / "out")
    image = ss.load_image(dataset, dataset.frames[0])
    assert dataset.frames[0].mask_path == "mask/view 0.png" or dataset.frames[0].mask_path == "mask/view 1.png"
    assert 0.3 < image.valid.mean() < 0.95
    assert not image.valid[0, 0]
    assert image.valid[24, 32]
    np.testing.assert_allclose(image.rgb[24, 32], np.array([10, 20, 30]) / 255, atol=1e-6)


def test_a_lens_that_folds_over_its_picture_is_refused_before_anything_is_written(tmp_path):
    camera = ("OPENCV", 16, 12, (20.0, 20.0, 8.0, 6.0, -50.0, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="view 0: expected a lens that images 10 % of the picture before it folds"):
        imported(project(tmp_path / "src", ring(3, cameras={1: camera})), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("lens", [("OPENCV", (1e10, 0.0, 0.0, 0.0)), ("OPENCV_FISHEYE", (1e10, -1e10, 0.0, 0.0))])
def test_a_lens_that_images_nothing_is_warned_of_once(tmp_path, caplog, lens):
    name, others = lens
    camera = (name, 16, 12, (20.0, 20.0, 8.0, 6.0, *others))
    dataset = imported(project(tmp_path / "src", ring(3, cameras={1: camera})), tmp_path / "out")
    share = ss.load_image(dataset, dataset.frames[0]).valid.mean()
    assert share < 0.1
    assert [record.getMessage().split("%")[1:] for record in caplog.records] == [
        [" of the picture, the rest is unknown: its parameters may be wrong"]
    ]


def test_a_fold_of_the_lens_is_cut_off():
    """t - 0.3 t^3 turns back at t = 1.054, of tangent 1.77: beyond, the same pixels would be seen again."""
    lens = Lens(MODELS["SIMPLE_RADIAL_FISHEYE"], 400, 20, (50.0, 200.0, 10.0, -0.3))
    inside = lens.undistortion().inside
    last = np.flatnonzero(inside[10])[-1]
    assert (last + 0.5 - 200) / 50 == pytest.approx(np.tan(1 / np.sqrt(0.9)), abs=0.05)
