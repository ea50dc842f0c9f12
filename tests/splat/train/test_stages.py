"""What refinement watches of a picture."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from splats import take_cudas

from spacesim.backend import ad
from spacesim.backend.recording import recordings
from spacesim.backend.upload import upload
from spacesim.data.records import Camera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.train import view_pass
from spacesim.splat.train.async_lists import TrainingPairs
from spacesim.splat.train.config import preset
from spacesim.splat.train.stages import TargetImage, screen_radii
from spacesim.splat.train.view_pass import ViewPass
from spacesim.splat.train.views import TrainingView

FOCAL, SIZE = 100.0, 64


def camera() -> Camera:
    """At the origin, looking along z."""
    return Camera(np.eye(4), SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2)


def model(means, scales, opacity, turn=0.0) -> Gaussians:
    """Gaussians turned about z by `turn` radians."""
    count = len(means)
    return Gaussians.from_numpy(
        {
            "means": np.asarray(means, float),
            "log_scales": np.log(np.broadcast_to(scales, (count, 3))),
            "quaternions": np.tile([np.cos(turn / 2), 0, 0, np.sin(turn / 2)], (count, 1)),
            "logit_opacities": np.full(count, np.log(opacity / (1 - opacity))),
            "sh": np.zeros((count, 1, 3)),
        }
    )


def radii(gaussians: Gaussians, antialiased: bool = False) -> list[float]:
    view = Pinhole.of(camera())
    return np.array(screen_radii(gaussians, project(gaussians, view, antialiased)[0], view)).tolist()


@pytest.mark.parametrize("opacity", [0.9, 1e-5])
@pytest.mark.parametrize("turn", [0.0, 0.7])
@pytest.mark.parametrize(("antialiased", "spread"), [(False, 0.3), (True, 1 / 12)])
def test_a_radius_is_three_deviations_of_the_longer_axis_however_faint(opacity, turn, antialiased, spread):
    """5.4: 0.05 m seen from 2 m through 100 pixels are 2.5 pixels."""
    gaussians = model([[0, 0, 2.0]], [0.05, 0.01, 0.001], opacity, turn)
    assert radii(gaussians, antialiased) == [np.ceil(3 * np.sqrt(2.5**2 + spread))]


def test_only_what_is_in_the_picture_has_a_radius():
    """The border is 0.64 m off the axis at 2 m; 2.56 pixels of deviation make a radius of 8, which is 0.16 m. (One
    who is off the axis looks wider.)"""
    means = [[0.78, 0, 2.0], [0.83, 0, 2.0], [-0.78, 0, 2.0], [0, 0.83, 2.0], [0, 0, -2.0], [np.nan, 0, 2.0]]
    found = radii(model(means, 0.05, 0.5))
    assert [radius > 0 for radius in found] == [True, False, True, False, False, False]


def test_a_needle_has_a_finite_radius():
    (found,) = radii(model([[0, 0, 2.0]], [100.0, 1e-9, 1e-9], 0.5, turn=0.7))
    assert 100 < found < np.inf


def test_gaussians_too_faint_to_draw_count_as_seen():
    """What the rasterizer skips has no gradient, and is in the picture all the same: its support must not decay."""
    gaussians = model([[0, 0, 2.0], [0.1, 0, 2.0], [5.0, 0, 2.0]], 0.05, 0.5)
    gaussians.logit_opacities = dr.select(dr.arange(type(gaussians.logit_opacities), 3) == 0, -9.0, 0.0)
    view_pass = ViewPass(preset("fast"), scale=1.0)
    view = TrainingView(0, camera(), None, np.zeros(SIZE * SIZE, np.uint32), None, False, {})
    drawn = view_pass.forward(gaussians, gaussians.rows(), None, view, degree=0, downscale=1, watched=True)
    radius = np.array(drawn.radii)
    assert (radius > 0).tolist() == [True, True, False]
    slopes = ad.Float([0.0, 1e-3, 0.0])
    seen = view_pass.watched(drawn, SimpleNamespace(absolute_x=slopes, absolute_y=slopes), 0).measures()[2]
    assert np.array(seen).tolist() == [True, True, False]
    assert (
        view_pass.forward(gaussians, gaussians.rows(), None, view, degree=0, downscale=1, watched=False).radii is None
    )


def test_recordings_serve_any_number_of_gaussians(monkeypatch):
    """As they are on CUDA: Gaussians come and go, and lists of one capacity may be of more than arrays had room for."""
    take_cudas(monkeypatch)
    monkeypatch.setattr(view_pass, "is_usable", lambda: False)
    rgba = np.full(SIZE * SIZE, 0xFF4080C0, np.uint32)
    view = TrainingView(0, camera(), None, rgba, None, False, {})
    target = TargetImage(upload(rgba, ad.UInt32), ad.Float([0.1, 0.2, 0.3]), ad.Bool(True), {})
    rng, trained, capacities, made = np.random.default_rng(0), ViewPass(preset("fast"), scale=1.0), set(), []
    trained.pairs = TrainingPairs(())

    def gradients(gaussians, compare) -> list[np.ndarray]:
        drawn = trained.forward(gaussians, gaussians.rows(), None, view, degree=0, downscale=1, watched=True)
        capacities.add(drawn.tape.lists.capacity)
        before, size = recordings(), (SIZE, SIZE)
        asked = drawn.take_tape(), drawn.channels, size, target, size, trained._loss_settings[1], True
        loss, by_splats = compare(*asked)
        made.append(recordings() - before)
        rows = [by_splats.splats.x, by_splats.splats.a, by_splats.splats.opacity, *by_splats.features]
        return [np.array(row) for row in (loss.value, *rows, by_splats.absolute_x)]

    for count in (3200, 4000, 4900, 5000, 3300):
        means = np.concatenate([rng.uniform(-0.6, 0.6, (400, 2)), rng.uniform(3, 4, (count - 400, 2))])
        gaussians = model(np.column_stack([means, np.full(count, 2.0)]), 0.02, 0.5)
        found, expected = (gradients(gaussians, way) for way in (trained._compare_at_once, trained._compare))
        assert np.abs(expected[1]).max() > 0
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(capacities) == 1
    assert made[::2] == [1, 0, 1, 0, 0], "one for each size of arrays"


def test_a_picture_of_nothing_has_gradients_of_all_gaussians(monkeypatch):
    """Their number changes between two visits of such a view."""
    take_cudas(monkeypatch)
    monkeypatch.setattr(view_pass, "is_usable", lambda: False)
    rgba = np.full(SIZE * SIZE, 0xFF4080C0, np.uint32)
    view = TrainingView(0, camera(), None, rgba, None, False, {})
    target = TargetImage(upload(rgba, ad.UInt32), ad.Float([0.1, 0.2, 0.3]), ad.Bool(True), {})
    trained = ViewPass(preset("fast"), scale=1.0)
    for count in (30, 30, 40):
        behind = model(np.tile([0, 0, -2.0], (count, 1)), 0.02, 0.5)
        drawn = trained.forward(behind, behind.rows(), None, view, degree=0, downscale=1, watched=True)
        loss, by_splats = trained.backward(drawn, target, camera(), absolute=True)
        rows = [by_splats.splats.x, *by_splats.features, by_splats.absolute_x]
        assert [np.array(row).tolist() for row in rows] == [[0.0] * count] * 5
        assert float(loss.value[0]) > 0.1
