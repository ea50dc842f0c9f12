"""Objects cut out of pictures whose poses are known: a lit, dark-sided ball beside a bar, before clouds or nothing."""

import json
import logging

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.importers.kinds import import_dataset
from spacesim.data.importers.lenses import LENS_MODELS, Lens
from spacesim.data.importers.pictures import FrameImporter, SourceView
from spacesim.data.store import find_unreadable_files

WIDTH, HEIGHT, FOCAL = 120, 90, 130.0
COUNT = 24
MEAN = 0.88  #: overlap over union; a picture cut by itself has 0.4


def drawn(turn, place, behind):
    """(grey picture, silhouette): balls of the body frame along its x axis, half of each dark."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(x + 0.5 - WIDTH / 2) / FOCAL, (y + 0.5 - HEIGHT / 2) / FOCAL, np.ones(x.shape)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    picture, depth = behind.copy(), np.full(x.shape, np.inf)
    for offset, radius in ((0, 0.4), (0.5, 0.15), (0.7, 0.15), (0.9, 0.15)):
        centre = turn @ [offset, 0, 0] + place
        along = rays @ centre
        inside = along**2 - centre @ centre + radius**2
        near = along - np.sqrt(np.maximum(inside, 0))
        normal = (rays * near[..., None] - centre) / radius
        nearer = (inside > 0) & (near < depth)
        picture = np.where(nearer, np.where(normal @ [0.8, -0.6, 0] > -0.2, 190 + 40 * normal[..., 0], 5), picture)
        depth = np.where(nearer, near, depth)
    return picture, np.isfinite(depth)


@pytest.fixture
def made(tmp_path):
    """The folder, as SPEED+ has it, and the silhouettes by the names of frames."""
    random, labels, silhouettes = np.random.default_rng(3), [], {}
    images = tmp_path / "src/synthetic/images"
    images.mkdir(parents=True)
    for k in range(COUNT):
        turn, place = Rotation.random(random_state=random), np.array([*random.uniform(-0.5, 0.5, 2), 5 + k % 3])
        clouds = ndimage.gaussian_filter(random.standard_normal((HEIGHT, WIDTH)), 8)
        behind = 80 + 20 * clouds / clouds.std() if k % 2 else np.full((HEIGHT, WIDTH), 5.0)
        picture, silhouettes[f"{k:02d}"] = drawn(turn.as_matrix(), place, behind)
        noisy = np.clip(picture + 3 * random.standard_normal(picture.shape), 0, 255)
        Image.fromarray(noisy.astype(np.uint8)).save(images / f"{k:02d}.png")
        x, y, z, w = turn.as_quat().tolist()
        labels.append({"filename": f"{k:02d}.png", "q_vbs2tango_true": [w, x, y, z], "r_Vo2To_vbs_true": list(place)})
    (tmp_path / "src/synthetic/train.json").write_text(json.dumps(labels))
    matrix = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    (tmp_path / "src/camera.json").write_text(json.dumps({"Nu": WIDTH, "Nv": HEIGHT, "cameraMatrix": matrix}))
    return tmp_path / "src", silhouettes


def overlaps(data, silhouettes):
    found = {f.file_path[7:9]: read_png(data.root / f.silhouette_path) > 0 for f in data.frames}
    return {name: (mask & silhouettes[name]).sum() / (mask | silhouettes[name]).sum() for name, mask in found.items()}


def test_speedplus_without_masks_is_cut_out(made, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    src, silhouettes = made
    data = import_dataset("speedplus", src, tmp_path / "data")
    assert f"masks: cut out of the pictures; look at {data.root / 'silhouette'}" in caplog.text
    assert json.loads((data.root / "import.json").read_text())["masks"] == "auto"
    assert all(frame.mask_path is None for frame in data.frames)
    shares = overlaps(data, silhouettes)
    assert len(shares) == COUNT
    assert np.mean(list(shares.values())) > MEAN
    assert min(shares.values()) > 0.8


@pytest.mark.parametrize("kind", ["speedplus", "nerfstudio"])
def test_a_picture_in_which_nothing_is_found_is_unknown(made, tmp_path, caplog, kind):
    src = made[0]
    path = src / "synthetic/train.json"
    labels = json.loads(path.read_text())
    labels[5]["r_Vo2To_vbs_true"] = [40.0, 0.0, 5.0]  # far beside the picture
    path.write_text(json.dumps(labels))
    if kind == "nerfstudio":
        import_dataset("speedplus", src, tmp_path / "bare", masks="none")
        src = tmp_path / "bare"
    data = import_dataset(kind, src, tmp_path / "data", masks="auto")
    (lost,) = [frame for frame in data.frames if frame.mask_path is not None]
    assert (lost.file_path, lost.silhouette_path) == ("images/05.png", None)
    assert not read_png(data.root / lost.mask_path).any()
    assert sum(frame.silhouette_path is not None for frame in data.frames) == COUNT - 1
    assert find_unreadable_files(data.root) == []
    assert f"masks: nothing is found in 1 of {COUNT} pictures, 05" in caplog.text


@pytest.mark.parametrize("guessed", [True, False])
def test_a_guess_that_shows_nothing_leaves_alpha(tmp_path, guessed):
    Image.new("RGBA", (16, 12), (10, 20, 30, 200)).save(tmp_path / "a.png")
    lens = Lens(LENS_MODELS[6], 16, 12, (20.0, 20.0, 8.0, 6.0, *(0.0,) * 8))
    view = SourceView("a", tmp_path / "a.png", np.eye(4), lens, lambda: np.zeros((12, 16), bool))
    frame = FrameImporter(guessed=guessed).frame(view)
    assert callable(frame.picture)
    assert (frame.picture()[..., 3] == (200 if guessed else 0)).all()
    assert (frame.mask is not None and not frame.mask().any()) == guessed


def test_few_pictures_stay_as_they_are(made, tmp_path, caplog):
    few = import_dataset("speedplus", made[0], tmp_path / "data", count=10)
    assert all(frame.silhouette_path is None for frame in few.frames)
    assert "10 pictures are few to cut the object out by; what is behind stays" in caplog.text


def test_other_poses_may_be_asked_for(made, tmp_path):
    """The same pictures by way of Nerfstudio's format."""
    import_dataset("speedplus", made[0], tmp_path / "bare", masks="none")
    data = import_dataset("nerfstudio", tmp_path / "bare", tmp_path / "data", masks="auto")
    assert np.mean(list(overlaps(data, made[1]).values())) > MEAN


def test_pictures_without_an_object_are_refused(made, tmp_path):
    for path in (made[0] / "synthetic/images").iterdir():
        Image.new("L", (WIDTH, HEIGHT), 5).save(path)
    with pytest.raises(InputError, match=r"^masks: expected an object in the pictures, found none"):
        import_dataset("speedplus", made[0], tmp_path / "data")
