"""Gaussians in files for other tools: decoded by others' readers, and by ours that know the formats' texts alone, they
are drawn as before."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from splat_readers import READERS, Decoded, read_glb, read_spz, read_usda
from splats import light_of, random_splats

from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.integrity.outputs import SUFFIXES
from spacesim.data.records import Camera
from spacesim.splat.export import spz
from spacesim.splat.export.frame import FileFrame
from spacesim.splat.export.splats import write_splats
from spacesim.splat.export.spz import write_spz
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import SH_C0, Gaussians
from spacesim.splat.raster.render import render

#: {form: least PSNR in dB between pictures}. Numbers that are kept are to single precision; noise at 46 dB changes a
#: model's own 30 dB by 0.1.
LEAST = {"ply": 100, "glb": 100, "usd": 100, "spz": 46}
#: {up: rotation, file from dataset}, by where x, y and z go
TURNS = {
    "z": np.eye(3),
    "y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def model(degree: int = 3, count: int = 200) -> Gaussians:
    arrays = random_splats(count, 3, degree)
    arrays["quaternions"] *= np.random.default_rng(0).uniform(0.1, 9, (count, 1))
    return Gaussians.from_numpy(arrays)


def out_of(folder: Path, form: str) -> Path:
    return folder / f"model{SUFFIXES[form][0]}"


def again(decoded: Decoded) -> Gaussians:
    opacities = np.clip(decoded.opacities, 1e-9, 1 - 1e-9)
    return Gaussians.from_numpy(
        {
            "means": decoded.means,
            "log_scales": np.log(decoded.scales),
            "quaternions": decoded.quaternions,
            "logit_opacities": np.log(opacities / (1 - opacities)),
            "sh": decoded.sh,
        }
    )


def pictures(gaussians: Gaussians, turn=TURNS["z"], scale: float = 1.0, origin=(0, 0, 0)) -> np.ndarray:
    """From four places of the dataset, seen by cameras that went where the file's points went."""
    shown = []
    for direction in fibonacci_sphere(4):
        pose = look_at(3 * direction, np.zeros(3))
        pose[:3, 3] = scale * (pose[:3, 3] - origin)
        pose[:3] = turn @ pose[:3]
        shown.append(
            render(gaussians, Pinhole.of(Camera(pose, 64, 48, 70, 70, 32, 24)), outputs=("color",)).image("color")
        )
    return np.stack(shown)


def psnr_of(one: np.ndarray, other: np.ndarray) -> float:
    return -10 * np.log10(np.mean(np.square(one - other)) + 1e-20)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("form", READERS)
def test_what_is_written_is_drawn_as_before(tmp_path, form, degree):
    gaussians, path = model(degree), out_of(tmp_path, form)
    write_splats(gaussians, path, form, FileFrame())
    decoded = READERS[form](path)
    assert decoded.sh.shape == (200, (degree + 1) ** 2, 3)
    before = pictures(gaussians)
    assert before.std() > 0.1
    assert psnr_of(pictures(again(decoded)), before) > LEAST[form]


@pytest.mark.parametrize("up", TURNS)
@pytest.mark.parametrize("form", READERS)
def test_the_frame_of_the_file(tmp_path, form, up):
    gaussians, path = model(), out_of(tmp_path, form)
    arrays = gaussians.to_numpy()
    gaussians = Gaussians.from_numpy(arrays | {"means": arrays["means"] + [0.1, -0.2, 0.3]})
    frame = FileFrame(up, 3.0, True)
    if (form, up) == ("usd", "-y"):
        with pytest.raises(InputError, match="up: expected z or y in USD, found -y"):
            write_splats(gaussians, path, form, frame)
        return
    write_splats(gaussians, path, form, frame)
    decoded = READERS[form](path)
    middle = np.quantile(decoded.means, (0.005, 0.995), axis=0).mean(axis=0)
    np.testing.assert_allclose(middle, 0, atol=1e-4)
    origin = np.quantile(gaussians.to_numpy()["means"], (0.005, 0.995), axis=0).mean(axis=0)
    moved = pictures(again(decoded), TURNS[up], 3.0, origin)
    assert psnr_of(moved, pictures(gaussians)) > min(LEAST[form], 90)
    if form == "usd":
        assert decoded.said["upAxis"] == up.upper()


def test_glb_says_what_the_extension_asks_for(tmp_path):
    gaussians = model(2)
    write_splats(gaussians, tmp_path / "a.glb", "glb", FileFrame())
    said = read_glb(tmp_path / "a.glb").said
    assert (said["mode"], said["used"]) == (0, ["KHR_gaussian_splatting"])
    assert (said["kernel"], said["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    mean_colors = np.clip(SH_C0 * gaussians.to_numpy()["sh"][:, 0] + 0.5, 0, 1)
    np.testing.assert_allclose(said["COLOR_0"][:, :3], light_of(mean_colors), atol=1e-5)
    # a reader that does not know the extension finds points, in its own words
    (points,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert isinstance(points, trimesh.PointCloud)
    np.testing.assert_array_equal(points.vertices, gaussians.to_numpy()["means"])
    np.testing.assert_allclose(points.colors / 255, said["COLOR_0"], atol=1 / 255)


def test_usd_by_its_own_library(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdVol

    gaussians = model()
    write_splats(gaussians, tmp_path / "a.usda", "usd", FileFrame("y"))
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert field
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    ours, prim = read_usda(tmp_path / "a.usda"), field.GetPrim()
    theirs = {name: np.array(prim.GetAttribute(name).Get()) for name in ("positions", "scales", "opacities")}
    np.testing.assert_array_equal(theirs["positions"], ours.means.astype(np.float32))
    np.testing.assert_array_equal(theirs["scales"], ours.scales.astype(np.float32))
    np.testing.assert_array_equal(theirs["opacities"], ours.opacities.astype(np.float32))
    turns = [[q.GetReal(), *q.GetImaginary()] for q in prim.GetAttribute("orientations").Get()]
    np.testing.assert_allclose(turns, ours.quaternions, atol=1e-7)
    flat = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    np.testing.assert_array_equal(flat.reshape(ours.sh.shape), ours.sh.astype(np.float32))


def test_usd_tells_units_colors_and_size(tmp_path):
    gaussians = model(1)
    write_splats(gaussians, tmp_path / "a.usda", "usd", FileFrame())
    decoded = read_usda(tmp_path / "a.usda")
    assert (decoded.said["metersPerUnit"], decoded.said["colorSpace"]) == ("1", "srgb_rec709_scene")
    write_splats(gaussians, tmp_path / "cm.usda", "usd", FileFrame(scale=100))
    assert read_usda(tmp_path / "cm.usda").said["metersPerUnit"] == "0.01"
    low, high = decoded.said["extent"]
    assert (low <= decoded.means.min(axis=0) - 3 * np.exp(-3.2)).all()
    assert (high >= decoded.means.max(axis=0) + 3 * np.exp(-3.2)).all()


@pytest.mark.parametrize("version", spz.VERSIONS)
def test_spz_by_another_reader(tmp_path, version):
    gsply = pytest.importorskip("gsply")
    write_spz(model(), tmp_path / "a.spz", version=version)
    theirs, ours = gsply.read_spz(tmp_path / "a.spz"), read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(theirs.scales), ours.scales, rtol=1e-5)
    np.testing.assert_allclose(theirs.quats, ours.quaternions, atol=1e-6)
    np.testing.assert_allclose(np.reshape(theirs.shN, (200, 15, 3)), ours.sh[:, 1:], atol=1e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-5)


def test_both_versions_of_spz_hold_the_same(tmp_path):
    pytest.importorskip("zstandard")
    for version in spz.VERSIONS:
        write_spz(model(), tmp_path / f"{version}.spz", True, version)
    one, other = (read_spz(tmp_path / f"{version}.spz") for version in spz.VERSIONS)
    assert all(np.array_equal(a, b) for a, b in zip(one[:-1], other[:-1], strict=True))
    assert (one.said["antialiased"], one.said["version"], other.said["version"]) == (1, 3, 4)


@pytest.mark.parametrize("size", [1e-3, 0.9, 7.9, 8.1, 3000.0, 5e6])
def test_coordinates_in_spz_are_as_fine_as_their_size_lets_them_be(tmp_path, size):
    arrays = random_splats(50)
    arrays["means"] *= size / np.abs(arrays["means"]).max()
    write_spz(Gaussians.from_numpy(arrays), tmp_path / "a.spz")
    decoded = read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(decoded.means, arrays["means"], atol=0.51 * max(2.0**-20, size / 2**22))


def test_spz_clips_what_it_cannot_hold(tmp_path):
    arrays = random_splats(4)
    arrays["sh"][:] = [[[9]], [[-9]], [[0.5]], [[-0.5]]]
    arrays["log_scales"][:] = [[-30], [30], [0], [-1]]
    arrays["logit_opacities"][:] = [-90, 90, 0, 1]
    write_spz(Gaussians.from_numpy(arrays), tmp_path / "a.spz")
    decoded = read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(decoded.sh[:, 5, 0], [127 / 128, -1, 0.5, -0.5])
    np.testing.assert_allclose(decoded.sh[:, 0, 0], [1 / 0.3, -1 / 0.3, 0.5, -0.5], atol=0.02)
    np.testing.assert_allclose(np.log(decoded.scales[:, 0]), [-10, 255 / 16 - 10, 0, -1])
    np.testing.assert_allclose(decoded.opacities, [0, 1, 0.5, 1 / (1 + np.exp(-1))], atol=1 / 255)


def test_quaternions_in_spz(tmp_path):
    """Each component the largest once, of either sign; none of length 0 is anything but no rotation."""
    arrays = random_splats(9)
    arrays["quaternions"][:8] = 0.3 * np.array([[1, -2, 3, -1.5]]) + np.repeat([[9], [-9]], 4, axis=0) * np.tile(
        np.eye(4), (2, 1)
    )
    arrays["quaternions"][8] = 0
    write_spz(Gaussians.from_numpy(arrays), tmp_path / "a.spz")
    decoded = read_spz(tmp_path / "a.spz")
    wanted = arrays["quaternions"][:8] / np.linalg.norm(arrays["quaternions"][:8], axis=1, keepdims=True)
    assert np.abs(np.einsum("ni,ni->n", wanted, decoded.quaternions[:8])).min() > 1 - 2e-6
    np.testing.assert_array_equal(decoded.quaternions[8], [1, 0, 0, 0])


@pytest.mark.parametrize("form", READERS)
def test_the_same_model_gives_the_same_bytes(tmp_path, form):
    for name in ("a", "b"):
        write_splats(model(), tmp_path / name / out_of(tmp_path, form).name, form, FileFrame())
    one, other = (path.read_bytes() for path in sorted(tmp_path.rglob("model.*")))
    assert one == other


@pytest.mark.parametrize("form", READERS)
def test_no_gaussians(tmp_path, form):
    empty, path = Gaussians.from_numpy(random_splats(0)), out_of(tmp_path, form)
    if form == "glb":
        with pytest.raises(InputError, match="expected at least one Gaussian, found none"):
            write_splats(empty, path, form, FileFrame("y", 2.0, True))
        return
    write_splats(empty, path, form, FileFrame("y", 2.0, True))
    assert path.exists()
    if form in ("spz", "usd"):
        assert READERS[form](path).means.shape == (0, 3)


def test_what_cannot_be_written_ends_in_a_sentence(tmp_path, monkeypatch):
    for form in ("ply", "glb", "spz", "usd"):
        with pytest.raises(InputError, match=r"model\.txt: expected a file name that ends in \."):
            write_splats(model(), tmp_path / "model.txt", form, FileFrame())
    for values, words in (
        ({"scale": 0}, r"scale: expected a number from 1e-06 to 1e\+06, found 0"),
        ({"scale": float("nan")}, "scale: .* found nan"),
        ({"scale": 1e39}, r"scale: expected a number from 1e-06 to 1e\+06, found 1e\+39"),
        ({"up": "x"}, "up: expected z, y, -y, found 'x'"),
    ):
        with pytest.raises(InputError, match=words):
            FileFrame(**values)
    with pytest.raises(InputError, match="spz_version: expected 3 or 4, found 2"):
        write_spz(model(), tmp_path / "a.spz", version=2)
    far = Gaussians.from_numpy(random_splats(2) | {"means": np.full((2, 3), 1e8)})
    with pytest.raises(InputError, match="expected coordinates within 8,388,607 units, found 100,000,000"):
        write_spz(far, tmp_path / "a.spz")
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    with pytest.raises(WorkError, match="version 4 needs the library zstandard"):
        write_spz(model(), tmp_path / "a.spz", version=4)
    assert list(tmp_path.iterdir()) == []
