"""The Sun's ways around, cameras of another size, the sheet's pictures and marks, and a video whose bytes repeat."""

import io
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splats import random_splats

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import read_png
from spacesim.data.records import Camera, Sun
from spacesim.learning.pictures import LIT, SHADOWED, shadow_colors, write_picture
from spacesim.splat.export import sweep as module
from spacesim.splat.export.sweep import SUN, resize_camera, sky_mark, suns_around, sweep
from spacesim.splat.export.video import Video, encoder, yuv420_from_rgb
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Prediction, Run

CAMERA = Camera.from_fov(look_at([3, 1, 1], np.zeros(3)), 24, 16, 30)
NO_SHADOWS = {"method": "relight"}
with_video = pytest.mark.skipif(encoder() is None, reason="PyAV, the extra video, is not installed")


@dataclass
class Lit:
    """A run whose every picture is one colour, by the Sun's direction; its left half sees the Sun, a quarter of the
    picture is empty."""

    path: Path = Path("some/lit")
    config: dict[str, Any] = field(default_factory=lambda: {"method": "shadow-map"})
    relightable: bool = True

    def predict(self, camera, sun=None, normals=False, exposure=None):
        shape = camera.height, camera.width
        rgb = 2 ** (exposure or 0) * np.broadcast_to(0.5 + 0.5 * sun.direction, (*shape, 3)).astype(np.float32)
        visibility, alpha = np.zeros(shape, np.float32), np.ones(shape, np.float32)
        visibility[:, : camera.width // 2] = 1
        alpha[: camera.height // 2, : camera.width // 2] = 0
        shadows = None if self.config["method"] == "relight" else visibility
        return Prediction(rgb, alpha, np.ones(shape, np.float32), shadows)


def test_the_sun_goes_round_at_one_elevation():
    angles = [sun.angles for sun in suns_around(8, elevation_deg=-20)]
    np.testing.assert_allclose(angles, [(45 * k, -20) for k in range(8)], atol=1e-9)
    assert np.allclose([sun.angles[1] for sun in suns_around()], 30)
    assert len(suns_around()) == 72


def test_the_sun_goes_overhead_at_one_azimuth():
    angles = [sun.angles for sun in suns_around(12, azimuth_deg=40)]
    elevations = [0, 30, 60, 90, 60, 30, 0, -30, -60, -90, -60, -30]
    np.testing.assert_allclose([elevation for _, elevation in angles], elevations, atol=1e-6)
    azimuths = [azimuth for azimuth, elevation in angles if abs(elevation) < 89]
    np.testing.assert_allclose(azimuths, [40] * 3 + [220] * 5 + [40] * 2, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((0,), "frames: "),
        ((10**6,), "frames: "),
        ((4, 91.0), "elevation: "),
        ((4, float("nan")), "elevation: "),
        ((4, None, float("inf")), "azimuth: "),
        ((4, 10.0, 20.0), "azimuth: "),
    ],
)
def test_wrong_ways_are_refused(arguments, named):
    with pytest.raises(InputError, match=named):
        suns_around(*arguments)


@pytest.mark.parametrize(
    ("size", "shape", "scale"),
    [(48, (48, 32), 2), ((48, 48), (48, 48), 2), ((24, 8), (24, 8), 0.5), (1, (1, 1), 1 / 24)],
)
def test_another_size_shows_the_same_things(size, shape, scale):
    camera = Camera(CAMERA.world_from_camera, 24, 16, 50, 40, 10, 9)
    other = resize_camera(camera, size)
    assert (other.width, other.height) == shape
    # A pixel keeps its place by the middle of the picture, but for the scale: the same things are seen.
    for pixel in ((0, 0), (24, 16), (5, 11)):
        ray = (pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy
        x, y = other.fx * ray[0] + other.cx, other.fy * ray[1] + other.cy
        assert x - 0.5 * other.width == pytest.approx(scale * (pixel[0] - 12))
        assert y - 0.5 * other.height == pytest.approx(scale * (pixel[1] - 8))


@pytest.mark.parametrize("size", [0, -5, (10, 0)])
def test_sizes_below_a_pixel_are_refused(size):
    with pytest.raises(InputError, match="size: "):
        resize_camera(CAMERA, size)


def tile(sheet: np.ndarray, k: int, columns: int) -> np.ndarray:
    """Picture k of a sheet of 24 x 16 pictures."""
    wide, high = 224, round(224 * 16 / 24)
    x, y = 8 + k % columns * (wide + 8), 52 + k // columns * (high + 48)
    return sheet[y : y + high, x : x + wide]


def test_the_sheet_shows_every_sun_of_few_and_the_frames_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    suns, reported = suns_around(8, 10), []
    done = sweep(Lit(), CAMERA, suns, tmp_path, keep_frames=True, report=lambda *numbers: reported.append(numbers))
    assert reported == [(k + 1, 8) for k in range(8)]
    sheet = read_png(done.sheet)
    for k, sun in enumerate(suns):
        color = np.rint(255 * (0.5 + 0.5 * sun.direction))
        assert np.abs(tile(sheet, k, 4) - color).max() <= 1
        frame = read_png(tmp_path / "frames" / f"{k:04d}.png")
        assert frame.shape == (16, 24, 3)
        assert np.abs(frame - color).max() <= 1
    assert done.video is None
    assert "spacesim[video]" in done.note
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames", "sweep.png"]


def test_a_sweep_is_exposed_as_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    sun = suns_around(1, 10)
    sweep(Lit(), CAMERA, sun, tmp_path, keep_frames=True, exposure=-2.0)
    quarter = np.rint(255 * (0.5 + 0.5 * sun[0].direction) / 4)
    assert np.abs(read_png(tmp_path / "frames" / "0000.png") - quarter).max() <= 1


def test_the_sheet_shows_some_of_many_evenly(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    suns = suns_around(72)
    sheet = read_png(sweep(Lit(), CAMERA, suns, tmp_path).sheet)
    for k in range(24):
        assert np.abs(tile(sheet, k, 6) - np.rint(255 * (0.5 + 0.5 * suns[3 * k].direction))).max() <= 1
    assert not (tmp_path / "frames").exists()


def test_shadows_in_their_colors(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    sweep(Lit(), CAMERA, suns_around(1), tmp_path, "shadow", keep_frames=True)
    frame = read_png(tmp_path / "frames" / "0000.png")
    assert (frame[:8, :12] == 0).all()  # nothing there
    assert (frame[8:, :12] == LIT).all()
    assert (frame[:, 12:] == SHADOWED).all()
    prediction = Lit().predict(CAMERA, Sun.from_angles(0, 0))
    halves = Prediction(prediction.rgb, prediction.alpha, prediction.depth, 0.5 + 0 * prediction.visibility)
    between = 0.5 * (np.array(LIT) + SHADOWED) / 255
    np.testing.assert_allclose(shadow_colors(halves)[8:], np.broadcast_to(between, (8, 24, 3)), atol=1e-6)


def test_a_run_that_cannot_and_a_folder_that_is_full_are_refused(tmp_path):
    suns = suns_around(2)
    with pytest.raises(InputError, match=r"some/lit.*vanilla"):
        sweep(Lit(config={"method": "vanilla"}, relightable=False), CAMERA, suns, tmp_path)
    with pytest.raises(InputError, match=r"some/lit.*kind shadow.*relight"):
        sweep(Lit(config=NO_SHADOWS), CAMERA, suns, tmp_path / "nothing", "shadow")
    assert not (tmp_path / "nothing").exists()
    with pytest.raises(InputError, match="kind: "):
        sweep(Lit(), CAMERA, suns, tmp_path, "depth")
    with pytest.raises(InputError, match="suns"):
        sweep(Lit(), CAMERA, [], tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match=r"file: expected a folder"):
        sweep(Lit(), CAMERA, suns, tmp_path / "file", report=lambda *_: pytest.fail("rendered more than one"))
    with pytest.raises(InputError, match="or one of an earlier sweep, found other files in it"):
        sweep(Lit(), CAMERA, suns, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_an_earlier_sweep_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    sweep(Lit(), CAMERA, suns_around(3), tmp_path, keep_frames=True)
    (tmp_path / "sweep.mp4").touch()
    sweep(Lit(), CAMERA, suns_around(2), tmp_path, keep_frames=True)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert left == {"sweep.png", "frames/0000.png", "frames/0001.png"}
    (tmp_path / "sweep.png").unlink()  # as where a sweep was interrupted
    sweep(Lit(), CAMERA, suns_around(2), tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["sweep.png"]


def test_an_interrupted_sweep_leaves_the_one_before_it(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    sweep(Lit(), CAMERA, suns_around(3), tmp_path, keep_frames=True)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}

    def stop(done: int, _count: int) -> None:
        with pytest.raises(InputError, match="expected no other run at work in the folder"):
            sweep(Lit(), CAMERA, suns_around(2), tmp_path)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(Lit(), CAMERA, suns_around(5), tmp_path, report=stop)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize("name", ["frames/0001.png", "transforms.json", "frames/mine.txt"])
def test_a_folder_with_frames_of_others_is_refused_and_left_alone(name, tmp_path):
    """Also beside an earlier sweep's sheet."""
    for file in ("sweep.png", name):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(InputError, match=rf"found other files in it \({name}\)"):
        sweep(Lit(), CAMERA, suns_around(2), tmp_path)
    assert (tmp_path / name).exists()


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (90, 0), (200, 45), (0, 90), (300, -30)])
def test_the_mark_has_the_sun_where_it_is_in_the_sky(azimuth, elevation):
    mark = sky_mark(Sun.from_angles(azimuth, elevation), side=200).astype(int)
    sun = np.abs(mark - SUN).max(axis=-1) < 10
    row, column = (where.mean() for where in np.nonzero(sun))
    away = 80 * (1 - abs(elevation) / 90)
    assert column + 0.5 == pytest.approx(100 + away * np.cos(np.radians(azimuth)), abs=1)
    assert row + 0.5 == pytest.approx(100 - away * np.sin(np.radians(azimuth)), abs=1)
    assert sun[round(row), round(column)] == (elevation >= 0)  # a ring below the horizon


def test_a_relightable_model_goes_through(tmp_path):
    """Gaussians with untrained networks: shadows fall by geometry alone."""
    config = LightConfig(shadow=ShadowConfig(size=64))
    arrays = random_splats(50, degree=0) | {"features": np.random.default_rng(1).normal(size=(50, config.features))}
    light = LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, 3.0, 1.0), seed=0)
    run = Run(tmp_path / "run", {"method": "shadow-map"}, {}, Gaussians.from_numpy(arrays), 0, light)
    first, second = tmp_path / "a", tmp_path / "b"
    for out in (first, second):
        done = sweep(run, CAMERA, suns_around(4), out, "shadow", keep_frames=True)
        assert (done.video is None) == (encoder() is None)
    files = sorted(path.relative_to(first) for path in first.rglob("*.*"))
    assert len(files) == 5 + (encoder() is not None)
    assert all((first / name).read_bytes() == (second / name).read_bytes() for name in files)
    frames = [read_png(first / "frames" / f"{k:04d}.png").astype(int) for k in range(4)]
    assert max(np.abs(frames[k] - frames[0]).max() for k in (1, 2, 3)) > 50  # the Sun matters


# The video.

BARS = {  # 8-bit colour bars of ITU-R BT.709: colour, (Y, Cb, Cr)
    (255, 255, 255): (235, 128, 128),
    (0, 0, 0): (16, 128, 128),
    (255, 0, 0): (63, 102, 240),
    (0, 255, 0): (173, 42, 26),
    (0, 0, 255): (32, 240, 118),
    (255, 255, 0): (219, 16, 138),
}


@pytest.mark.parametrize("color", BARS)
def test_luma_and_chroma_of_color_bars(color):
    planes = yuv420_from_rgb(np.full((4, 6, 3), color, np.uint8))
    assert planes.shape == (6, 6)
    assert (planes[:4] == BARS[color][0]).all()
    blue, red = planes[4:].reshape(2, 2, 3)
    assert (blue == BARS[color][1]).all()
    assert (red == BARS[color][2]).all()


def test_odd_sides_repeat_the_last_row_and_column():
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    planes = yuv420_from_rgb(picture)
    assert planes.shape == (9, 8)
    assert (planes[5] == planes[4]).all()
    assert (planes[:6, 7] == planes[:6, 6]).all()


@with_video
def test_a_video_repeats_to_the_bit_and_shows_its_pictures():
    import av

    colors = np.random.default_rng(2).integers(30, 220, (9, 3))

    def encoded():
        film = Video(33, 18, 24)
        for color in colors:
            film.add(np.full((18, 33, 3), color, np.uint8))
        return film.content()

    content = encoded()
    assert content == encoded()
    with av.open(io.BytesIO(content)) as file:
        frames = list(file.decode(video=0))
        assert file.streams.video[0].average_rate == 24
        assert file.streams.video[0].codec_context.name == "h264"
    assert len(frames) == 9
    for frame, color in zip(frames, colors, strict=True):
        assert (frame.width, frame.height) == (34, 18)
        assert np.abs(frame.to_ndarray(format="rgb24").reshape(-1, 3).mean(axis=0) - color).max() < 4


@with_video
def test_a_video_of_larger_moving_pictures_repeats_to_the_bit():
    noise = np.kron(np.random.default_rng(0).integers(0, 255, (54, 80, 3)), np.ones((8, 8, 1))).astype(np.uint8)

    def encoded():
        film = Video(480, 270, 25)
        for k in range(30):
            film.add(np.ascontiguousarray(noise[k : k + 270, 2 * k : 2 * k + 480]))
        return film.content()

    assert len({encoded() for _ in range(3)}) == 1


@with_video
@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (24, Fraction(24)),
        (24000 / 1001, Fraction(24000, 1001)),
        (Fraction(60000, 1001), Fraction(60000, 1001)),
        (12.5, Fraction(25, 2)),
        (1 / 3, Fraction(1, 3)),
        (0.1, Fraction(1, 10)),
        (1000.0, Fraction(1000)),
    ],
)
def test_a_video_has_fractions_of_pictures_a_second(rate, expected):
    import av

    film = Video(16, 16, rate)
    for k in range(4):
        film.add(np.full((16, 16, 3), 60 * k, np.uint8))
    with av.open(io.BytesIO(film.content())) as file:
        assert file.streams.video[0].average_rate == expected
        times = [Fraction(frame.pts) * frame.time_base for frame in file.decode(video=0)]
    assert times == [k / expected for k in range(4)]


@with_video
@pytest.mark.parametrize("rate", [0, -1.0, 1e-9, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_named(rate):
    with pytest.raises(ValueError, match="rate: expected"):
        Video(16, 16, rate)


@with_video
def test_a_sweep_has_a_video_with_a_caption(tmp_path):
    import av

    done = sweep(Lit(), CAMERA, suns_around(5), tmp_path)
    assert done.note is None
    with av.open(str(done.video)) as file:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in file.decode(video=0)]
    assert len(frames) == 5
    times = 14  # 24 pixels to at least 320
    for frame, sun in zip(frames, suns_around(5), strict=True):
        assert frame.shape == (16 * times + 28, 24 * times, 3)
        shown = frame[8 : 16 * times - 8].reshape(-1, 3).mean(axis=0)
        assert np.abs(shown - 255 * (0.5 + 0.5 * sun.direction)).max() < 4
        assert frame[16 * times :].max() > 200  # the caption


@with_video
def test_wrong_pictures_are_named():
    film = Video(8, 6, 24)
    for wrong in (np.zeros((8, 6, 3), np.uint8), np.zeros((6, 8, 3), np.float32), np.zeros((6, 8), np.uint8)):
        with pytest.raises(ValueError, match=r"picture: expected \[6, 8, 3\] uint8"):
            film.add(wrong)


def test_without_an_encoder_a_video_says_what_to_type(monkeypatch):
    from spacesim.splat.export import video

    monkeypatch.setattr(video, "encoder", lambda: None)
    with pytest.raises(RuntimeError, match=r"spacesim\[video\]"):
        Video(8, 8, 24)


# The command.


@pytest.fixture
def lit_run(monkeypatch):
    """A run in the place of what `load_run` reads."""
    monkeypatch.setattr("spacesim.splat.run.load_run", lambda path: Lit(path))


def test_the_command(spacesim, lit_run, small_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    common = ("--data", small_dataset.root, "--out", tmp_path / "out")
    done = spacesim("sweep", tmp_path / "lit", *common, "--frame", 2, "--azimuth", 40, "--frames", 4, "--size", "20x10")
    assert done.code == 0, done.errors
    assert done.output == f"{tmp_path / 'out' / 'sweep.png'}\n"
    assert any("sweep.mp4: not written" in line for line in done.errors)
    assert read_png(tmp_path / "out" / "sweep.png").shape[1] > 800


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--frame", 10), "--frame"),
        (("--frames", 0), "--frames"),
        (("--elevation", 100), "--elevation"),
        (("--elevation", 10, "--azimuth", 5), "--azimuth"),
        (("--size", 0), "--size"),
        (("--size", "ab"), "--size"),
        (("--kind", "depth"), "--kind"),
    ],
)
def test_the_command_refuses(spacesim, lit_run, small_dataset, tmp_path, options, named):
    common = ("--data", small_dataset.root, "--out", tmp_path / "out")
    assert spacesim("sweep", tmp_path / "lit", *common, *options).is_refusal(named)
    assert not (tmp_path / "out").exists()


def test_pictures_brighter_than_white_are_white(tmp_path):
    """Colours of harmonics have no upper end; in eight bits they must not start again from black."""
    rgb, alpha = np.full((4, 5, 3), 1.4, np.float32), np.ones((4, 5), np.float32)
    write_picture(Prediction(rgb, alpha, alpha, None), "rgb", tmp_path / "bright.png")
    assert (read_png(tmp_path / "bright.png") == 255).all()
