"""PNG and EXR in and out, colour, and what a frame shows."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image as PillowImage

from spacesim.backend import memory
from spacesim.data.errors import InputError, WorkError
from spacesim.data.images import (
    linear_from_srgb,
    load_image,
    luminance,
    read_exr,
    read_png,
    srgb_from_linear,
    undistort,
    write_exr,
    write_png,
)
from spacesim.data.records import Camera, Dataset, Frame, Image


def make_camera(width=8, height=6, focal=10.0):
    return Camera(np.eye(4), width, height, focal, focal, width / 2, height / 2)


def load(root, camera, **paths):
    frame = Frame("image.png", camera, **paths)
    return load_image(Dataset(root, (frame,), ()), frame)


def test_srgb_hand_values():
    # IEC 61966-2-1: 12.92 x up to 0.0031308, a power of 1 / 2.4 above.
    encoded = srgb_from_linear(np.array([-1.0, 0.0, 0.001, 0.0031308, 0.18, 0.5, 1.0, 7.0]))
    expected = [0, 0, 0.01292, 0.04045, 0.461356, 0.735357, 1, 1]
    np.testing.assert_allclose(encoded, expected, atol=1e-5)
    assert linear_from_srgb(188 / 255) == pytest.approx(0.502886, abs=1e-6)
    assert linear_from_srgb(10 / 255) == pytest.approx(10 / 255 / 12.92)
    codes = np.arange(256) / 255
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(codes)), codes, atol=1e-6)
    assert srgb_from_linear(np.float32([0.5])).dtype == np.float32


def test_luminance_weights():
    np.testing.assert_allclose(luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    assert luminance(np.ones((2, 5, 3), np.float32)).shape == (2, 5)


@pytest.mark.parametrize(("shape", "dtype"), [((5, 7), "u1"), ((5, 7, 3), "u1"), ((5, 7, 4), "u1"), ((5, 7), "u2")])
def test_png_round_trip_and_same_bytes(tmp_path, shape, dtype):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)
    write_png(tmp_path / "a.png", pixels)
    write_png(tmp_path / "b.png", read_png(tmp_path / "a.png"))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    found = read_png(tmp_path / "a.png")
    assert found.dtype == pixels.dtype
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("pixels", [np.zeros((5, 7)), np.zeros((5, 7, 2), "u1"), np.zeros((0, 4), "u1")])
def test_png_refuses_what_it_cannot_hold(tmp_path, pixels):
    with pytest.raises(ValueError, match="pixels"):
        write_png(tmp_path / "a.png", pixels)


def make_layers():
    random = np.random.default_rng(1)
    layers = {
        "radiance": random.normal(size=(40, 33, 3)).astype(np.float32),
        "alpha": random.random((40, 33), np.float32),
        "normal": random.normal(size=(40, 33, 3)).astype(np.float32),
        "object_id": random.integers(0, 3, (40, 33)).astype(np.float32),
    }
    layers["alpha"][0, :4] = [np.nan, np.inf, -0.0, 1e-45]
    return layers


def test_exr_round_trip_and_same_bytes(tmp_path):
    layers = make_layers()
    write_exr(tmp_path / "a.exr", layers)
    found = read_exr(tmp_path / "a.exr")
    assert list(found) == list(layers)
    for name, layer in layers.items():
        assert found[name].dtype == np.float32
        assert found[name].tobytes() == layer.tobytes(), name
    write_exr(tmp_path / "b.exr", found)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_exr_of_one_layer(tmp_path):
    write_exr(tmp_path / "a.exr", {"depth": np.ones((3, 4))})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["depth"], np.ones((3, 4), np.float32))


def test_exr_channels_are_those_that_viewers_know(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    write_exr(tmp_path / "a.exr", {**make_layers(), "depth": np.ones((40, 33))})
    parts = openexr.File(str(tmp_path / "a.exr"), separate_channels=True).parts
    channels = {part.name(): "".join(sorted(part.channels)) for part in parts}
    expected = {"radiance": "BGR", "alpha": "A", "normal": "XYZ", "object_id": "Y", "depth": "Z"}
    assert channels == expected


def test_cut_off_exr_is_refused_at_every_length(tmp_path, capfd):
    write_exr(tmp_path / "whole.exr", make_layers())
    content = (tmp_path / "whole.exr").read_bytes()
    path = tmp_path / "cut.exr"
    for length in [0, 3, 4, 8, 40, 300, 1000, *range(2000, len(content), 3989), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"cut\.exr"):
            read_exr(path)
    assert capfd.readouterr() == ("", "")  # one sentence for the user, nothing of OpenEXR's own


def test_damaged_exr_is_refused_or_read(tmp_path):
    write_exr(tmp_path / "whole.exr", make_layers())
    content = (tmp_path / "whole.exr").read_bytes()
    random = np.random.default_rng(2)
    refused = 0
    for _ in range(60):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(0, 1500, 5)] = random.integers(0, 256, 5)
        (tmp_path / "damaged.exr").write_bytes(damaged.tobytes())
        try:
            read_exr(tmp_path / "damaged.exr")
        except InputError:
            refused += 1
    assert refused > 30


def test_missing_and_wrong_files_are_named(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    for read in (read_png, read_exr):
        for name in ("absent.png", "text.png"):
            with pytest.raises(InputError, match=name):
                read(tmp_path / name)


def test_cut_off_png_is_refused(tmp_path):
    write_png(tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (50, 50, 3)).astype("u1"))
    content = (tmp_path / "a.png").read_bytes()
    for length in (0, 20, 60, 1000, len(content) // 2):
        (tmp_path / "cut.png").write_bytes(content[:length])
        with pytest.raises(InputError, match=r"cut\.png: expected [a-zA-Z, ]+$"):
            read_png(tmp_path / "cut.png")


def test_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def no_space(_):
        raise OSError(28, "No space left on device")

    write_png(tmp_path / "a.png", np.zeros((2, 2), "u1"))
    before = (tmp_path / "a.png").read_bytes()
    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(WorkError, match="disk is full"):
        write_png(tmp_path / "a.png", np.ones((2, 2), "u1"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == before


def test_straight_alpha_is_kept(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4)).astype("u1")
    write_png(tmp_path / "image.png", pixels)
    image = load(tmp_path, make_camera())
    np.testing.assert_array_equal(np.round(image.rgb * 255), pixels[..., :3])
    np.testing.assert_array_equal(np.round(image.alpha * 255), pixels[..., 3])
    assert image.rgb.dtype == image.alpha.dtype == np.float32
    assert image.valid.all()


def test_images_of_other_kinds(tmp_path):
    grey = np.arange(48, dtype="u1").reshape(6, 8) * 5
    cases = {
        "L": PillowImage.fromarray(grey),
        "I;16": PillowImage.fromarray(grey.astype(np.uint16) * 257),
        "P": PillowImage.fromarray(grey).convert("P"),
        "LA": PillowImage.fromarray(np.stack([grey, np.full_like(grey, 255)], -1)),
    }
    for mode, picture in cases.items():
        assert picture.mode == mode
        picture.save(tmp_path / "image.png")
        image = load(tmp_path, make_camera())
        np.testing.assert_allclose(image.rgb, np.repeat(grey[..., None], 3, -1) / 255, atol=1e-6, err_msg=mode)
        np.testing.assert_array_equal(image.alpha, np.ones((6, 8)), err_msg=mode)


def test_pictures_without_a_range_of_values_are_refused(tmp_path):
    grey = np.linspace(0, 1, 48, dtype=np.float32).reshape(6, 8)
    PillowImage.fromarray(grey).save(tmp_path / "image.tif")
    with pytest.raises(InputError, match=r"^[^:]*image\.tif: expected whole numbers of 8 or 16 bits .* floating-point"):
        read_png(tmp_path / "image.tif")
    write_exr(tmp_path / "image.exr", {"": grey})
    with pytest.raises(InputError, match=r"^[^:]*image\.exr: expected PNG, JPEG or another image"):
        read_png(tmp_path / "image.exr")


def test_alpha_from_silhouette_and_ignored_pixels(tmp_path):
    write_png(tmp_path / "image.png", np.full((6, 8, 3), 90, "u1"))
    silhouette, mask = np.zeros((6, 8), "u1"), np.full((6, 8), 255, "u1")
    silhouette[2:4], mask[:, :3] = 255, 0
    write_png(tmp_path / "silhouette.png", silhouette)
    write_png(tmp_path / "mask.png", mask)
    image = load(tmp_path, make_camera(), silhouette_path="silhouette.png", mask_path="mask.png")
    np.testing.assert_array_equal(image.alpha, np.where(mask > 0, silhouette / 255, 1))
    np.testing.assert_array_equal(image.rgb, np.repeat((mask > 0)[..., None] * np.float32(90 / 255), 3, axis=-1))
    np.testing.assert_array_equal(image.valid, mask > 0)


def test_wrong_sizes_are_refused(tmp_path):
    write_png(tmp_path / "image.png", np.zeros((6, 8, 3), "u1"))
    write_png(tmp_path / "mask.png", np.zeros((6, 7), "u1"))
    with pytest.raises(InputError, match=r"image\.png: expected 9x6 .* found 8x6"):
        load(tmp_path, make_camera(9, 6))
    with pytest.raises(InputError, match=r"mask\.png: expected 8x6 .* found 7x6"):
        load(tmp_path, make_camera(), mask_path="mask.png")


def test_undistortion_of_a_ramp_is_the_distortion_itself(tmp_path):
    # A ramp of column numbers, resampled, must read as the columns that the Brown-Conrady formula gives.
    width, height, focal = 64, 48, 60.0
    camera = make_camera(width, height, focal)
    k1, k2, p1, p2, k3 = distortion = (-0.12, 0.03, 0.004, -0.003, 0.01)
    columns = np.tile(np.arange(width) / width, (height, 1)).astype(np.float32)
    image = Image(np.repeat(columns[..., None], 3, -1), np.ones_like(columns), np.ones(columns.shape, bool))
    found = undistort(image, camera, distortion)
    for i, j in [(32, 24), (3, 5), (60, 44), (50, 2), (10, 40)]:
        x, y = (i + 0.5 - width / 2) / focal, (j + 0.5 - height / 2) / focal
        r2 = x * x + y * y
        factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        source = (x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * focal + width / 2 - 0.5
        assert found.rgb[j, i, 0] == pytest.approx(source / width, abs=1e-5)
    assert found.valid.all()  # barrel distortion: the stored image covers more than the pinhole one


def test_undistortion_marks_what_is_outside(tmp_path):
    camera = make_camera(64, 48, 60.0)
    ones = np.ones((48, 64), np.float32)
    found = undistort(Image(np.repeat(ones[..., None], 3, -1), ones, ones > 0), camera, (0.3, 0, 0, 0, 0))
    assert found.valid[24, 32]
    assert not found.valid.all()
    assert found.alpha.min() == 1  # a picture without transparency stays one: training asks for that
    np.testing.assert_array_equal(found.rgb[~found.valid], 0)
    folded = undistort(Image(np.repeat(ones[..., None], 3, -1), ones, ones > 0), camera, (-3.0, 0, 0, 0, 0))
    assert not folded.valid[0, 0]  # r (1 - 3 r^2) falls again past r = 1/3


def test_undistortion_bleeds_no_color_from_nothing():
    camera = make_camera(64, 48, 60.0)
    alpha = np.zeros((48, 64), np.float32)
    alpha[:, 30:] = 1
    rgb = np.where(alpha[..., None] > 0, np.float32(0.8), np.float32(0.1)).repeat(3, -1)
    found = undistort(Image(rgb, alpha, alpha >= 0), camera, (-0.1, 0, 0, 0, 0))
    np.testing.assert_allclose(found.rgb[found.alpha > 0.01], 0.8, atol=1e-5)


def test_distorted_frames_are_undistorted_on_loading(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype("u1")
    write_png(tmp_path / "image.png", pixels)
    camera = make_camera(64, 48, 60.0)
    plain = load(tmp_path, camera)
    distorted = load(tmp_path, camera, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    expected = undistort(plain, camera, (-0.1, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(distorted.rgb, expected.rgb)
    assert np.abs(distorted.rgb - plain.rgb).max() > 0.1


def png_of(width: int, height: int) -> bytes:
    """A picture of zeros, [H, W] grey, in few bytes."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    packer = zlib.compressobj(9)
    row = bytes(width + 1)
    body = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.filterwarnings("ignore")  # Pillow's
def test_small_files_of_large_pictures_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png_of(13300, 13300))
    with pytest.raises(InputError, match="at most 134,217,728 pixels, 16,384 a side, found 13300 x 13300"):
        read_png(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(png_of(3000, 2000))
    assert read_png(tmp_path / "b.png").shape == (2000, 3000)
    monkeypatch.setattr(memory, "main_memory", lambda: 300_000_000)
    with pytest.raises(MemoryError, match=r"b\.png: a picture of 3000 x 2000 pixels needs about 0\.384 GB"):
        read_png(tmp_path / "b.png")


def test_every_bit_of_a_png_counts(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, np.random.default_rng(0).integers(0, 255, (5, 4, 3), np.uint8))
    honest = path.read_bytes()
    for bit in range(8 * len(honest)):
        damaged = bytearray(honest)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.png: expected"):
            read_png(path)


@pytest.mark.filterwarnings("ignore")  # Pillow's
@pytest.mark.parametrize("suffix", ["avif", "webp", "tif", "jpg"])
def test_damaged_pictures_of_other_formats(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    PillowImage.fromarray(np.random.default_rng(0).integers(0, 255, (16, 16, 3), np.uint8)).save(path)
    honest, refused = path.read_bytes(), 0
    assert read_png(path).shape == (16, 16, 3)
    for place in range(0, len(honest), max(1, len(honest) // 60)):
        path.write_bytes(honest[:place] + b"\xff" * 9 + honest[place + 9 :])
        try:
            read_png(path)
        except InputError:
            refused += 1
    assert refused > 5
