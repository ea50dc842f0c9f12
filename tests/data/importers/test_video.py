"""Pictures without poses: the object cut out, frames chosen, poses found, and what is said where they cannot be."""

import importlib.util
import io
import json
from dataclasses import replace

import made_pictures
import numpy as np
import pytest
from made_pictures import BOX, FOCAL, SIZE, before, box_from, earth, poses_around
from scipy import ndimage
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images import load_image, read_png, write_png
from spacesim.data.importers.kinds import import_dataset
from spacesim.data.importers.video import frames as frames_of
from spacesim.data.importers.video import importing
from spacesim.data.importers.video.chart import draw_cameras
from spacesim.data.importers.video.frames import Survey, choose, read_frames, survey
from spacesim.data.importers.video.model import (
    SfmModel,
    arc_of,
    hull_length,
    placed,
    report_of,
    without_floating,
)
from spacesim.data.importers.video.segmentation import segment, segment_sequence
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.eval.align import align

FOV = float(np.degrees(2 * np.arctan(SIZE[0] / 2 / FOCAL)))
needs_colmap = pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
needs_av = pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="PyAV is not installed")


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    return (mask & truth).sum() / (mask | truth).sum()


@pytest.mark.parametrize("edge", [2.0, 0.85])
def test_an_object_before_a_dark_sky_is_segmented_by_brightness(edge):
    picture, truth = box_from(poses_around(1)[0])
    seen = before(picture, truth, earth(0, edge))
    assert overlap(segment(seen), truth) > 0.97
    grey = seen.mean(axis=-1).astype(np.uint8)
    assert overlap(segment(grey), truth) > 0.97


def test_the_object_is_followed_before_the_earth():
    pictures, truths = [], []
    for k, pose in enumerate(poses_around(6, 8.0)):
        picture, truth = box_from(pose)
        pictures.append(before(picture, truth, earth(40 * k, 0.8 - 0.25 * k)))
        truths.append(truth)
    reported = []
    masks = segment_sequence([lambda picture=picture: picture for picture in pictures], reported.append)
    assert [overlap(mask, truth) > 0.95 for mask, truth in zip(masks, truths, strict=True)] == [True] * 6
    assert reported[-1] == 6
    again = segment_sequence([lambda picture=picture: picture for picture in pictures])
    assert all(np.array_equal(a, b) for a, b in zip(masks, again, strict=True))


def test_a_picture_of_stars_alone_has_no_object():
    assert not segment(earth(0, 2.0)).any()


def test_chosen_frames_are_sharp_and_spread_over_the_motion():
    rng = np.random.default_rng(0)
    sharpness = rng.uniform(size=200)
    motion = np.r_[np.zeros(50), np.full(150, 0.01)]  # it stands still first
    chosen = choose(Survey(sharpness, motion), 15)
    assert len(chosen) == 15
    assert (np.diff(chosen) > 0).all()
    assert (chosen[1:] >= 50).all()
    assert sharpness[chosen].mean() > 0.8  # the best of about ten each
    assert np.histogram(chosen[1:], 3, (50, 200))[0].min() >= 4
    assert choose(Survey(sharpness, motion), 500).tolist() == [0, *range(50, 200)]


def test_a_blurred_frame_is_less_sharp():
    picture, _ = box_from(poses_around(1)[0])
    blurred = ndimage.gaussian_filter(picture, (0, 3, 0))  # moved sideways
    seen = survey(iter([picture, blurred, blurred]))
    assert seen.sharpness[0] > 2 * seen.sharpness[1]
    assert seen.motion[1] > 0
    assert seen.motion[2] == 0


def film(path, pictures, **options):
    from spacesim.splat.export.video import Video

    video = Video(*SIZE, 25, **options)
    for picture in pictures:
        video.add(picture)
    path.write_bytes(video.content())
    return path


@needs_av
def test_broken_videos_end_in_a_sentence(tmp_path, caplog):
    noise = np.random.default_rng(0).integers(0, 255, (12, SIZE[1], SIZE[0], 3), np.uint8)
    path = film(tmp_path / "film.mp4", noise)
    assert len(list(read_frames(path))) == 12
    (tmp_path / "text.mp4").write_text("no video at all")
    with pytest.raises(InputError, match=r"text.mp4: expected a video that FFmpeg reads, found"):
        next(read_frames(tmp_path / "text.mp4"))
    with pytest.raises(InputError, match=r"none.mp4: expected a video file, found none"):
        next(read_frames(tmp_path / "none.mp4"))
    (tmp_path / "cut.mp4").write_bytes(path.read_bytes()[: path.stat().st_size // 2])  # its index is at the end
    with pytest.raises(InputError, match=r"cut.mp4: expected .* found an MP4 file that is cut off before its index$"):
        list(read_frames(tmp_path / "cut.mp4"))
    with pytest.raises(InputError, match="nothing moves"):
        import_dataset("video", film(tmp_path / "still.mp4", [noise[0]] * 12), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@needs_av
@pytest.mark.parametrize("kind", ["matroska", "mp4"])
def test_a_video_that_is_cut_off_is_warned_of_once(tmp_path, caplog, kind):
    """Matroska tells how long it is, and not of how many frames; this MP4 has its index in front."""
    import av

    noise = np.random.default_rng(0).integers(0, 255, (12, SIZE[1], SIZE[0], 3), np.uint8)
    path, options = tmp_path / f"film.{kind}", {} if kind == "matroska" else {"movflags": "faststart"}
    with av.open(str(film(tmp_path / "f", noise))) as source, av.open(str(path), "w", kind, options) as target:
        copy = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = copy
                target.mux(packet)
    assert len(list(read_frames(path))) == 12
    assert caplog.records == []
    path.write_bytes(path.read_bytes()[: 7 * path.stat().st_size // 10])
    count = len(list(read_frames(path)))
    assert 2 < count < 10
    assert [r.getMessage().split(" (")[0] for r in caplog.records] == [
        f"{path}: breaks off after {count}{' of 12' * (kind == 'mp4')} frames"
    ]
    assert len(list(read_frames(path, again=True))) == count
    assert len(caplog.records) == 1


@needs_av
def test_a_film_of_sound_alone_has_no_pictures(tmp_path):
    import av

    stream = io.BytesIO()
    with av.open(stream, "w", format="wav") as file:
        sound = file.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        file.mux(sound.encode(frame))
    (tmp_path / "sound.wav").write_bytes(stream.getvalue())
    with pytest.raises(InputError, match=r"sound.wav: expected a video, found a file without pictures"):
        next(read_frames(tmp_path / "sound.wav"))


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    import importlib

    def missing(name):
        raise ImportError(name)

    for k, pose in enumerate(poses_around(3)):
        write_png(tmp_path / "in" / f"{k}.png", box_from(pose)[0])
    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'spacesim\[video\]'"):
        next(read_frames(tmp_path / "film.mp4"))
    with pytest.raises(InputError, match=r"pip install 'spacesim\[sfm\]'"):
        import_dataset("images", tmp_path / "in", tmp_path / "out")
    assert frames_of.INSTALL == "pip install 'spacesim[video]'"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"fov": 0.0}, "fov: expected degrees from 0.7 to 136, found 0.0"),
        ({"fov": 140.0}, "fov: expected degrees from 0.7 to 136, found 140.0"),
        ({"length": -1.0}, "length: expected metres"),
        ({"length": 1.0, "distance": 2.0}, "length, distance: expected one of them, found both"),
        ({"height": 3}, "height: expected at least 16 pixels"),
        ({"masks": "nowhere"}, "masks: expected a folder, found none"),
    ],
)
def test_wrong_options_are_named(tmp_path, options, sentence):
    for k, pose in enumerate(poses_around(3)):
        write_png(tmp_path / "in" / f"{k}.png", box_from(pose)[0])
    with pytest.raises(InputError, match=sentence):
        import_dataset("images", tmp_path / "in", tmp_path / "out", **options)


def test_a_field_of_view_that_no_camera_has_is_refused_at_once(tmp_path, monkeypatch):
    """It covers the width: of upright pictures the height's is larger."""
    for k in range(3):
        write_png(tmp_path / "in" / f"{k}.png", np.full((90, 30, 3), k, np.uint8))
    monkeypatch.setattr(importing, "segment_sequence", lambda *_: pytest.fail("work was begun"))
    with pytest.raises(InputError, match=r"^fov: expected a focal length of 0\.2 to 90 times .*, found 0\.0894"):
        import_dataset("images", tmp_path / "in", tmp_path / "out", fov=123.6)


def test_wrong_folders_are_named(tmp_path):
    with pytest.raises(InputError, match=r"in: expected a folder of pictures, found nothing"):
        import_dataset("images", tmp_path / "in", tmp_path / "out")
    write_png(tmp_path / "in" / "a.png", np.zeros((20, 30), np.uint8))
    with pytest.raises(InputError, match="expected at least 3 pictures, found 1"):
        import_dataset("images", tmp_path / "in", tmp_path / "out")
    for name in "bc":
        write_png(tmp_path / "in" / f"{name}.png", np.zeros((20, 31), np.uint8))
    with pytest.raises(InputError, match=r"b.png: expected 30x20 pixels as the first picture has, found 31x20"):
        import_dataset("images", tmp_path / "in", tmp_path / "out")
    with pytest.raises(InputError, match="expected a new or empty folder, found files in it"):
        import_dataset("images", tmp_path / "in", tmp_path)


def model_of(points: np.ndarray, turn: Rotation, scale: float, shift: np.ndarray) -> SfmModel:
    """Cameras around points along x, in another frame."""
    poses = np.array(poses_around(5))
    moved = poses.copy()
    moved[:, :3, :3] = turn.as_matrix() @ poses[:, :3, :3]
    moved[:, :3, 3] = scale * turn.apply(poses[:, :3, 3]) + shift
    seen = tuple((0, 1, 2) for _ in points)
    count = len(points)
    return SfmModel(
        *(tuple("abcde"), moved, FOCAL, (160.0, 120.0), 0.0, *SIZE),
        *(scale * turn.apply(points) + shift, np.zeros((count, 3), np.uint8), np.ones(count), seen, (5,)),
    )


def test_a_model_is_put_upright_to_scale_and_about_the_object():
    points = fibonacci_sphere(2001) * [3.0, 1.0, 1.0]
    model = model_of(points, Rotation.from_rotvec([1.0, 2.0, 3.0]), 7.0, np.array([10.0, -20.0, 30.0]))
    right = placed(model, length=12.0)
    assert np.abs(np.median(right.points, axis=0)).max() < 0.1
    assert 2 * np.linalg.norm(right.points, axis=1).max() == pytest.approx(12.0, rel=0.02)  # 99 % of the points
    assert (right.world_from_camera[:, 2, 1] < -0.8).all()  # pictures are upright
    np.testing.assert_allclose(np.linalg.det(right.world_from_camera[:, :3, :3]), 1)

    def median(found: SfmModel) -> float:
        return float(np.median(np.linalg.norm(found.positions, axis=1)))

    assert median(placed(model, distance=40.0)) == pytest.approx(40)
    assert median(placed(model)) == pytest.approx(1)
    report = report_of(right, ["a", "b", "c", "d", "e", "f"])
    assert report["not_registered"] == ["f"]
    assert report["track_length"] == {"mean": 3.0, "median": 3.0}
    assert draw_cameras(right).shape[2] == 3


def test_the_arc_of_cameras_is_between_those_farthest_apart():
    model = model_of(np.zeros((1, 3)), Rotation.identity(), 1.0, np.zeros(3))
    towards = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([3.0, 14.0, 0.0, 9.0, 170.0])])
    poses = model.world_from_camera.copy()
    poses[:, :3, 3] = towards * [[2.0], [5.0], [3.0], [1.0], [4.0]]
    assert arc_of(replace(model, world_from_camera=poses)) == pytest.approx(170.0)
    assert arc_of(replace(model, world_from_camera=poses[:4])) == pytest.approx(14.0)
    assert arc_of(replace(model, world_from_camera=poses[:1])) == 0.0


def test_silhouettes_tell_the_length_where_points_cover_a_part(monkeypatch):
    """Of a long box, which the cameras must see from the side."""
    monkeypatch.setattr(made_pictures, "BOX", np.array([1.0, 0.3, 0.3]))
    poses = np.array(poses_around(12, 120.0))
    masks = [box_from(pose)[1] for pose in poses]
    end = BOX * [0.2, 1.0, 1.0] * fibonacci_sphere(200) + [0.8, 0.0, 0.0]
    model = model_of(end, Rotation.identity(), 1.0, np.zeros(3))
    model = replace(model, names=tuple(f"{k:02d}" for k in range(12)), world_from_camera=poses)
    found = hull_length(model, masks)
    assert found is not None
    assert found == pytest.approx(2.0, rel=0.1)
    wrong = [np.zeros_like(masks[0]) if k == 5 else mask for k, mask in enumerate(masks)]
    assert hull_length(model, wrong) == pytest.approx(found, rel=0.1)
    by_hull, plain = (placed(model, extent=found, length=length) for length in (2.0, None))
    away = np.median(np.linalg.norm(model.positions - np.median(end, axis=0), axis=1))
    np.testing.assert_allclose(by_hull.positions, plain.positions * away * 2 / found, atol=1e-9)
    one_side = replace(model, names=model.names[:2], world_from_camera=poses[:2])
    assert hull_length(one_side, masks[:2]) is None


def test_points_that_float_are_left_out():
    points = np.concatenate([fibonacci_sphere(500), [[0.0, 0.0, 9.0], [4.0, 4.0, 0.0]]])
    model = model_of(points, Rotation.identity(), 1.0, np.zeros(3))
    kept = without_floating(model).points
    assert len(kept) >= 499 - 1
    assert np.linalg.norm(kept, axis=1).max() < 1.5


@needs_colmap
def test_poses_of_pictures_are_found(tmp_path):
    poses, truths = poses_around(12), []
    for k, pose in enumerate(poses):
        picture, truth = box_from(pose)
        write_png(tmp_path / "in" / f"{k:02d}.png", before(picture, truth, earth(10 * k, 2.0)))
        truths.append(truth)
    reported = []
    data = import_dataset(
        "images", tmp_path / "in", tmp_path / "out", lambda *step: reported.append(step[0]), fov=FOV, distance=5.0
    )
    assert reported == sorted(reported)
    frames = sorted(data.frames, key=lambda frame: frame.file_path)
    assert [len(data.train), len(data.test)] == [10, 2]
    found, true = np.array([f.camera.position for f in frames]), np.array([pose[:3, 3] for pose in poses])
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    scale = np.linalg.norm(true) / np.linalg.norm(found)
    turn, _ = Rotation.align_vectors(true, found)
    assert np.linalg.norm(scale * turn.apply(found) - true, axis=1).max() < 0.03  # of 5
    assert scale == pytest.approx(1, abs=0.1)  # the middle of the points is that of the sides that are seen
    for frame, truth in zip(frames, truths, strict=True):
        assert overlap(load_image(data, frame).alpha > 0.5, truth) > 0.95
    assert read_png(tmp_path / "out" / "cameras.png").ndim == 3
    report = json.loads((tmp_path / "out" / "structure.json").read_text())
    assert report["pictures"] == 12
    assert report["scale_from"] == "distance"
    assert report["not_registered"] == []
    assert report["reprojection_error_px"] < 1
    assert max(report["extent"]) < 2.1 * np.linalg.norm(BOX)


def test_a_films_times_are_its_seconds_where_they_rise():
    """A frame number is no time where the rate varies."""

    def times(seconds):
        frames = zip((0, 1, 5), seconds, strict=True)
        return importing._times([{"source_index": k} | ({} if one is None else {"time": one}) for k, one in frames])

    assert times([0.0, 0.04, 0.2]) == [0.0, 0.04, 0.2]
    for seconds in ([0.0, None, 0.2], [0.0, 0.2, 0.2], [0.1, 0.0, 0.2]):
        assert times(seconds) == [0, 1, 5]


@needs_colmap
def test_parts_that_share_no_view_are_told(tmp_path, caplog):
    """From one side, then from the other."""
    for k, pose in enumerate(poses_around(12)):
        write_png(tmp_path / "in" / f"a{k:02d}.png", box_from(pose)[0])
    for k, angle in enumerate(np.radians(np.linspace(0, 60, 10))):
        opposite = look_at(-5 * np.array([0.9 * np.cos(angle), np.sin(angle), 0.45]), np.zeros(3))
        write_png(tmp_path / "in" / f"b{k:02d}.png", box_from(opposite)[0])
    data = import_dataset("images", tmp_path / "in", tmp_path / "out", masks="none", fov=FOV)
    assert len(data.frames) == 12
    said = [record.getMessage() for record in caplog.records if "have a pose" in record.getMessage()]
    assert said[0].startswith(f"{tmp_path / 'in'}: 12 of 22 pictures have a pose")
    assert said[0].endswith("10 fit together, but not to these; import them apart")


@needs_colmap
def test_a_wrong_field_of_view_is_told(tmp_path, caplog):
    for k, pose in enumerate(poses_around(12)):
        write_png(tmp_path / "in" / f"{k:02d}.png", box_from(pose)[0])
    for factor in (1.0, 1.5):
        caplog.clear()
        import_dataset("images", tmp_path / "in", tmp_path / f"{factor}", masks="none", fov=factor * FOV)
        said = [record.getMessage() for record in caplog.records if record.getMessage().startswith("fov: ")]
        assert len(said) == (factor == 1.5)
    assert said[0].startswith("fov: the pictures fit better with 4")
    assert "degrees than with 62.6 as given" in said[0]


@needs_av
@needs_colmap
def test_frames_of_a_video_have_their_source_index(tmp_path):
    """Also where frames that repeat the one before are left out, so that numbers differ from places in the list."""
    poses = poses_around(10)
    shown = [0, 0, 0, *range(10)]
    pictures = [before(*box_from(pose), earth(10 * k, 2.0)) for k, pose in enumerate(poses)]
    path = film(tmp_path / "film.mp4", [pictures[k] for k in shown], bit_rate=8_000_000)
    data = import_dataset("video", path, tmp_path / "out", fov=FOV)
    entries = json.loads((data.root / "transforms.json").read_text())["frames"]
    numbers = [entry["source_index"] for entry in entries]
    assert set(range(4, 13)) <= set(numbers)
    assert len(numbers) < len(shown)
    assert [entry["time"] for entry in entries] == pytest.approx([number / 25 for number in numbers])
    cameras = [Camera.from_fov(poses[k], *SIZE, FOV) for k in shown]
    frames = [Frame(f"images/train_{number:05d}.png", camera) for number, camera in enumerate(cameras)]
    found = align(data, Dataset(tmp_path / "truth", tuple(frames), ()))
    assert found.matched_by == "source_index in transforms.json, against the order of file paths"
    assert found.cameras == len(numbers)
    assert found.rms < 0.01 * found.distance
    assert found.turn_deg < 0.5


@needs_colmap
def test_a_camera_that_only_turns_shows_no_parallax(tmp_path):
    pose = poses_around(1)[0]
    for k in range(6):
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", k - 2.5, degrees=True).as_matrix()
        write_png(tmp_path / "in" / f"{k}.png", box_from(turned)[0])
    with pytest.raises(InputError, match=r"in: expected .*no parallax"):
        import_dataset("images", tmp_path / "in", tmp_path / "out", fov=FOV)
    assert not (tmp_path / "out").exists()


@needs_colmap
def test_a_small_arc_is_warned_of(tmp_path, caplog):
    for degrees in (8.0, 60.0):
        source = tmp_path / f"{degrees:g}"
        for k, pose in enumerate(poses_around(8, degrees)):
            write_png(source / f"{k}.png", box_from(pose)[0])
        import_dataset("images", source, tmp_path / f"out{degrees:g}", masks="none", fov=FOV)
    said = [record.getMessage() for record in caplog.records if "go around the object" in record.getMessage()]
    assert len(said) == 1
    assert said[0].startswith(f"{tmp_path / '8'}: expected cameras that go around the object by 20 degrees or more")


@needs_colmap
def test_pictures_of_different_things_do_not_fit_together(tmp_path):
    rng = np.random.default_rng(0)
    for k in range(4):
        write_png(tmp_path / "in" / f"{k}.png", rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8))
    with pytest.raises(InputError, match=r"in: expected .*too few matches"):
        import_dataset("images", tmp_path / "in", tmp_path / "out", masks="none")


@needs_colmap
def test_a_field_of_view_that_pictures_do_not_fix_is_warned_of(tmp_path, caplog):
    """A far box looks nearly the same from near by a wider lens."""
    for k, pose in enumerate(poses_around(10, distance=30.0)):
        write_png(tmp_path / "in" / f"{k:02d}.png", box_from(pose, 6 * FOCAL)[0])
    import_dataset("images", tmp_path / "in", tmp_path / "out", masks="none")
    said = [record.getMessage() for record in caplog.records if "field of view" in record.getMessage()]
    assert len(said) == 1
    assert said[0].endswith("name it with fov")
    report = json.loads((tmp_path / "out" / "structure.json").read_text())
    assert report["k1"] == 0  # nothing is made up
    caplog.clear()
    fov = float(np.degrees(2 * np.arctan(SIZE[0] / 2 / (6 * FOCAL))))
    known = import_dataset("images", tmp_path / "in", tmp_path / "known", masks="none", fov=fov, length=2.0)
    assert [record.getMessage().split(": ")[2] for record in caplog.records] == [
        "there are no silhouettes; name distance if it is known"
    ]
    assert json.loads((known.root / "structure.json").read_text())["scale_from"] == "points"
