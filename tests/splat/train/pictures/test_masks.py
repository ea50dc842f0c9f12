"""What is unknown (`mask_path`) and what is empty (alpha 0, or outside a silhouette), in all that training reads."""

import json
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from PIL import Image

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.records import Camera, Dataset
from spacesim.data.store import read_dataset
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.train.config import preset
from spacesim.splat.train.stages import LossSettings, TargetImage, picture_loss
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.views import TrainingViews
from spacesim.splat.train.warm_start import WarmStartConfig, distance_image, projected_loss

SIZE = 24, 16  #: pixels, width and height; the left half is unknown or empty
LEFT = np.tile(np.arange(24) < 12, (16, 1))
SETTINGS = LossSettings(ssim=0.2, visibility=1, depth=1, normal=1, scale=1.0, tone=None)


def gradients(unknown: bool, weights: dict[str, float]) -> dict[str, np.ndarray]:
    """Of the loss by each plane, [H, W, ...]; a truth that differs from the picture everywhere."""
    rng, count = np.random.default_rng(0), SIZE[0] * SIZE[1]
    planes = {"color": 3, "visibility": 1, "depth": 1, "normal": 3}
    drawn = {name: [upload(rng.uniform(0.2, 0.6, count)) for _ in range(n)] for name, n in planes.items()}
    bytes_ = rng.integers(0, 256, (16, 24, 4)).astype(np.uint8)
    bytes_[..., 3] = np.where(LEFT & (not unknown), 0, 255)
    surface = np.ones(count, np.float32)
    truth = {
        "visibility": [upload(np.where(LEFT.ravel() & (not unknown), -1, surface))],
        "depth": [upload(np.where(LEFT.ravel() & (not unknown), 0, surface))],
        "normal": [
            upload(0 * surface),
            upload(0 * surface),
            upload(np.where(LEFT.ravel() & (not unknown), 0, surface)),
        ],
    }
    valid = upload(~LEFT.ravel(), ad.Bool) if unknown else ad.Bool(True)
    target = TargetImage(upload(bytes_.view("<u4").ravel(), ad.UInt32), ad.Float([0.9, 0.1, 0.5]), valid, truth)
    settings = replace(SETTINGS, **{"ssim": 0.0, "visibility": 0.0, "depth": 0.0, "normal": 0.0, **weights})
    transmittance = upload(rng.uniform(0.3, 0.7, count))
    _, by_planes, by_transmittance = picture_loss(drawn, transmittance, target, SIZE, settings)
    found = {name: np.array([np.array(plane) for plane in group]) for name, group in by_planes.items()}
    found["transmittance"] = np.array(by_transmittance)[None]
    return {name: values.reshape(-1, 16, 24) for name, values in found.items()}


@pytest.mark.parametrize("weights", [{}, {"ssim": 1.0}, {"visibility": 1.0}, {"depth": 1.0}, {"normal": 1.0}])
def test_nothing_is_learned_where_it_is_unknown(weights):
    """In L1, SSIM, visibility, depth and normals; pixels beside it teach as ever."""
    for name, values in gradients(True, weights).items():
        assert np.abs(values[:, LEFT]).max() == 0, name
        if name in ("color", "transmittance", *weights):
            assert (np.abs(values[:, ~LEFT]).max(axis=0) > 0).mean() > 0.9, name


def test_what_is_empty_says_that_nothing_is_there():
    """Every pixel asks for the background's colour, none for a shape."""
    found = gradients(False, {"visibility": 1.0, "depth": 1.0, "normal": 1.0})
    assert (np.abs(found["color"][:, LEFT]).max(axis=0) > 0).mean() > 0.9
    for name in ("visibility", "depth", "normal"):
        assert np.abs(found[name][:, LEFT]).max() == 0
        assert np.abs(found[name][:, ~LEFT]).max() > 0


def masked(dataset: Dataset, root, key: str) -> Dataset:
    """Its pictures as opaque ones, their left half out of a silhouette, or to be ignored."""
    (root / "images").mkdir(parents=True)
    values = json.loads((dataset.root / "transforms.json").read_text())
    for frame in values["frames"]:
        Image.open(dataset.root / frame["file_path"]).convert("RGB").save(root / frame["file_path"])
        frame[key] = "half.png"
    size = values["w"], values["h"]
    half = np.where(np.tile(np.arange(size[0]) < size[0] // 2, (size[1], 1)), 0, 255).astype(np.uint8)
    Image.fromarray(half).save(root / "half.png")
    (root / "points.ply").write_bytes((dataset.root / "points.ply").read_bytes())
    (root / "transforms.json").write_text(json.dumps(values))
    return read_dataset(root)


@pytest.mark.parametrize("key", ["mask_path", "silhouette_path"])
def test_splats_in_the_half_stay_or_fade(small_dataset, tmp_path, key):
    """One picture, in which some are drawn in that half alone: where it is unknown they learn nothing, and refinement
    hears nothing of them; where it is empty they fade."""
    dataset = masked(small_dataset, tmp_path / key, key)
    dataset = replace(dataset, train=dataset.train[:1])
    view = TrainingViews(dataset, 0)[0]
    assert (view.opaque, view.valid is None) == (key == "mask_path", key == "silhouette_path")
    trainer = Trainer(dataset, replace(preset("demo"), iterations=400, init_count=60, surfels=False))
    small = trainer.gaussians.to_numpy()
    trainer.gaussians = Gaussians.from_numpy({**small, "log_scales": np.full_like(small["log_scales"], -3.5)})
    rows = trainer.gaussians.rows()
    camera = Pinhole.of(view.camera)
    splats, footprints = project(Gaussians.from_rows(rows), camera)
    reach = np.array(splats.x) + np.array(footprints.half_width)
    there = np.flatnonzero(np.array(footprints.visible) & (reach < camera.width // 2))
    assert len(there) >= 2
    before = trainer.gaussians.to_numpy()
    for _ in range(5):
        trainer.step()
    after, gradient = trainer.gaussians.to_numpy(), np.array(trainer.strategy.state["gradient"])
    faded = after["logit_opacities"][there] < before["logit_opacities"][there]
    if key == "silhouette_path":
        assert faded.all()
        assert (gradient[there] > 0).all()
        return
    for name, values in before.items():
        np.testing.assert_array_equal(after[name][there], values[there], err_msg=name)
    assert (gradient[there] == 0).all()


def test_the_warm_start_pulls_nothing_out_of_what_is_unknown():
    """Out of what is empty it does, and the foreground counts only where it is known."""
    camera = Camera.from_fov(np.eye(4), 24, 16, 40)
    config = replace(WarmStartConfig(), downsampling=1, dilation=0)
    mask = np.zeros((16, 24), bool)
    mask[6:10, 16:20] = True
    means = np.array([[-0.3, 0.0, 2.0], [0.02, 0.3, 2.0]], np.float32)  # in the left half, and beside it
    slopes = []
    for valid in (None, ~LEFT):
        image = distance_image(mask, config, valid)
        ours = ad.Array3f(np.ascontiguousarray(means.T))
        dr.enable_grad(ours)
        loss, framed = projected_loss(ours, Pinhole.of(camera), upload(image.ravel()), (24, 16), 1)
        dr.backward(loss)
        assert np.array(framed).all()
        slopes.append(np.abs(np.array(dr.grad(ours))).max(axis=0))
    np.testing.assert_array_equal(slopes[1][0], 0)
    assert slopes[0][0] > 0
    assert slopes[1][1] == slopes[0][1] > 0
