"""Shadow splatting against its float64 reference, closed forms on hand-placed Gaussians, symmetries, hostile input."""

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats, take_cudas
from walls import acne, screen_shadow, way

from spacesim.backend import ad, recorded
from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.splat.light.shadow import splatting
from spacesim.splat.light.shadow.bias import receiver_bias
from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig, cast_shadows
from spacesim.splat.light.shadow.light_camera import light_rows
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.light.shadow.splatting import BETA_MIN, LEAST_BETA, occlusion_by_splatting
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.reference.shadow_splatting import occlusion_reference

PARAMETERS = ("means", "log_scales", "quaternions", "logit_opacities")
POSE = look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0])
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # the light looks along -z
PIXELS = 10.0  # a metre, of `overhead`


def light(width: int = 40, height: int = 28, pose=POSE) -> OrthographicCamera:
    return OrthographicCamera(pose, width, height, 22.0, 17.0, 0.52 * width, 0.47 * height)


def overhead(width: int = 64, height: int = 64) -> OrthographicCamera:
    """Looks down upon the origin, which lies in the middle of the image, between four pixels."""
    return OrthographicCamera(DOWN, width, height, PIXELS, PIXELS, width / 2, height / 2)


def occlusion(arrays, camera, bias=0.0, antialiased=False, points=None, beta_min=BETA_MIN) -> np.ndarray:
    numbers = upload(np.broadcast_to(np.float32(bias), len(arrays["means"])).copy())
    points = None if points is None else ad.Array3f(points.T.astype(np.float32))
    given = Gaussians.from_numpy(arrays), Orthographic.of(camera), numbers, points, antialiased
    return np.array(occlusion_by_splatting(*given, beta_min=beta_min))


def placed(means, scales=0.1, opacities=0.999999) -> dict[str, np.ndarray]:
    """Gaussians along the world's axes: means [N, 3], scales broadcast to [N, 3], opacities to [N]."""
    means = np.asarray(means, dtype=np.float64)
    opacity = np.broadcast_to(opacities, len(means))
    return {
        "means": means,
        "log_scales": np.log(np.broadcast_to(scales, means.shape)),
        "quaternions": np.tile([1.0, 0, 0, 0], (len(means), 1)),
        "logit_opacities": np.log(opacity / (1 - opacity)),
        "sh": np.zeros((len(means), 1, 3)),
    }


def joined(*parts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def sheet(height: float, low: float, high: float, spacing: float = 0.05, opacity: float = 0.9) -> dict:
    """Flat Gaussians at z = height that close the square low <= x, y <= high."""
    ticks = np.arange(low + spacing / 2, high, spacing)
    x, y = (plane.ravel() for plane in np.meshgrid(ticks, ticks))
    means = np.stack([x, y, np.full(x.size, height)], axis=1)
    return placed(means, [0.7 * spacing, 0.7 * spacing, 1e-3], opacity)


@pytest.fixture(params=["the backend's way", "CUDA's way"])
def _ways(request, monkeypatch) -> None:
    """That of CUDA gives the same on a CPU, where it is slower."""
    if request.param == "CUDA's way":
        take_cudas(monkeypatch)
        monkeypatch.setattr(splatting, "select", lambda: "cuda")
        monkeypatch.setattr(splatting, "occlusion_in_events", recorded(splatting.occlusion_in_events.traced))


@pytest.mark.usefixtures("_ways")
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("count", "size"), [(1, (40, 28)), (2, (40, 28)), (60, (16, 8)), (200, (33, 47))])
def test_occlusion_matches_the_twin(count, size, antialiased):
    arrays, view = random_splats(count, seed=count), light(*size)
    bias = np.random.default_rng(count).uniform(0, 0.2, count)
    twin = occlusion_reference(arrays, view, bias, BETA_MIN, antialiased)
    assert count < 60 or (twin.max() > 0.5 and (twin > 0).mean() > 0.4)
    np.testing.assert_allclose(occlusion(arrays, view, bias, antialiased), twin, atol=2e-6)


@pytest.mark.parametrize("end", [LEAST_BETA, 0.3])
def test_footprints_end_at_beta_min(end):
    arrays, view = random_splats(60, seed=2), light()
    ours, twin = occlusion(arrays, view, beta_min=end), occlusion_reference(arrays, view, np.zeros(60), end)
    np.testing.assert_allclose(ours, twin, atol=2e-6)
    assert np.abs(ours - occlusion(arrays, view)).max() > 0.01


def test_receivers_elsewhere_match_the_twin():
    arrays, view = random_splats(80, seed=6), light()
    points = arrays["means"] + np.random.default_rng(0).normal(0, 0.2, (80, 3))
    ours, twin = occlusion(arrays, view, 0.01, points=points), occlusion_reference(arrays, view, np.full(80, 0.01))
    assert np.abs(ours - twin).max() > 0.2
    twin = occlusion_reference(arrays, view, np.full(80, 0.01), points=points)
    np.testing.assert_allclose(ours, twin, atol=2e-6)


def test_a_crowd_that_lets_nothing_pass_matches_the_twin():
    """Pixels end at a transmittance of 1e-4, receivers behind them are counted all the same."""
    arrays, view = random_splats(400, seed=3), light(24, 24)
    arrays["logit_opacities"][:] += 4
    twin = occlusion_reference(arrays, view, np.zeros(400))
    assert (twin > 0.9999).sum() > 20
    np.testing.assert_allclose(occlusion(arrays, view), twin, atol=1e-4)


def test_full_and_no_occlusion():
    arrays = placed([[0, 0, 1], [0, 0, 0], [2.5, 0, 0], [0, 0, -1]], [[1, 1, 0.01], *[[0.1, 0.1, 0.1]] * 3])
    ours = occlusion(arrays, overhead())
    assert ours[0] == 0
    assert 0.95 < ours[1] < 0.999  # alpha of the wide blocker falls off within the receiver's footprint
    assert 0.01 < ours[2] < 0.1  # 2.5 standard deviations off its axis
    assert ours[3] > 0.99  # both lie before it
    beside = placed([[0, 0, 1], [1.5, 0, 0]])
    np.testing.assert_array_equal(occlusion(beside, overhead()), 0)


@pytest.mark.parametrize("opacity", [0.02, 0.25, 0.5, 0.9])
def test_half_transparent_blockers_multiply(opacity):
    """Blockers so wide that alpha is their opacity: 1 - (1 - a)^n behind n of them."""
    means = [[0, 0, 3], [0, 0, 2], [0, 0, 1], [-2, 0.05, 2.5], [0.1, 0, 1.5], [2, 0.03, 0.5]]
    scales = [[90, 90, 0.01]] * 3 + [[0.1, 0.1, 0.1]] * 3
    ours = occlusion(placed(means, scales, [opacity] * 6), overhead())
    np.testing.assert_allclose(ours[3:], 1 - (1 - opacity) ** np.array([1, 2, 3]), rtol=2e-3)


def test_half_of_a_receiver_is_occluded():
    """A closed sheet over x < 0, whose edge the dilation moves by about a pixel, against receivers on either side."""
    blockers = sheet(1.0, -3.2, 3.2, spacing=0.1)
    keep = blockers["means"][:, 0] < 0
    blockers = {name: value[keep] for name, value in blockers.items()}
    receivers = placed([[0, 0, 0], [-2, 0, 0], [2, 0, 0]], [[0.8] * 3, [0.2] * 3, [0.2] * 3])
    ours = occlusion(joined(receivers, blockers), overhead())[:3]
    np.testing.assert_allclose(ours, [0.5, 1, 0], atol=0.06)
    np.testing.assert_allclose(ours[1:], [1, 0], atol=2e-3)


def test_blockers_below_a_pixel():
    """The mean of alpha_j weighted by beta_i is, as an integral over the plane, o v / (v + w + 0.6), v and w the
    variances of blocker and receiver in pixels^2; without anti-aliasing o (v + 0.3) / (v + w + 0.6). Footprints end at
    BETA_MIN."""
    v, w, o = 0.2**2, 36.0, 0.8
    blocker, receiver = np.sqrt(v) / PIXELS, np.sqrt(w) / PIXELS
    offsets = np.random.default_rng(0).uniform(
        -0.05, 0.05, (40, 2)
    )  # within a pixel: the mean over them does not see it
    antialiased, classic = [], []
    for dx, dy in offsets:
        arrays = placed([[dx, dy, 1], [dx, dy, 0]], [[blocker] * 3, [receiver] * 3], [o, 0.5])
        antialiased.append(occlusion(arrays, overhead(), antialiased=True)[1])
        classic.append(occlusion(arrays, overhead())[1])
    inside = (v + w + 0.6) * (1 - BETA_MIN)
    assert np.mean(antialiased) == pytest.approx(o * v / inside, rel=0.1)
    assert np.mean(classic) == pytest.approx(o * (v + 0.3) / inside, rel=0.05)


def test_faint_receivers_have_an_occlusion():
    arrays = placed([[0, 0, 1], [0, 0, 0]], [[3, 3, 0.01], [0.1, 0.1, 0.1]], [0.9, 1e-5])
    np.testing.assert_allclose(occlusion(arrays, overhead()), [0, 0.9], atol=0.01)


def test_what_is_equally_deep_does_not_block():
    wall = sheet(0.0, -2.0, 2.0)
    np.testing.assert_array_equal(occlusion(wall, overhead()), 0)


def test_order_does_not_matter():
    arrays, view = random_splats(300, seed=5), light()
    bias = np.random.default_rng(0).uniform(0, 0.1, 300)
    order = np.random.default_rng(1).permutation(300)
    shuffled = {name: value[order] for name, value in arrays.items()}
    np.testing.assert_array_equal(occlusion(arrays, view, bias)[order], occlusion(shuffled, view, bias[order]))


def test_bias_frees_a_wall_of_its_own_shadow_and_keeps_a_real_one():
    """A wall of noisy depth under an overhead Sun, a plate a metre before a part of it."""
    wall, plate = sheet(0.0, -2.5, 2.5), sheet(1.0, -0.8, 0.8)
    wall["means"][:, 2] += np.random.default_rng(0).uniform(-3e-3, 3e-3, len(wall["means"]))
    arrays, count = joined(wall, plate), len(wall["means"])
    bias = receiver_bias(Gaussians.from_numpy(arrays), ad.Array3f(0, 0, 1))
    x, y = np.abs(wall["means"][:, :2]).T
    shadowed, lit = np.maximum(x, y) < 0.65, np.maximum(x, y) > 1.2
    without, biased = occlusion(arrays, overhead())[:count], occlusion(arrays, overhead(), np.array(bias.bias))[:count]
    assert without[lit].mean() > 0.5  # acne
    assert biased[lit].max() < 0.02
    assert biased[shadowed].min() > 0.95
    receding = occlusion(arrays, overhead(), 1.1)[:count]  # a bias beyond the gap loses the shadow as well
    assert receding.max() < 0.02


def test_lifted_receivers_and_the_grazing_bias_free_a_plate_that_the_sun_grazes():
    """The Sun 10 degrees above an uneven plate: mean occlusion where nothing is before it, then a screen's shadow."""
    thesis, both = way("thesis", "splatting"), way("both", "splatting")
    assert acne(10, thesis, 8000)[0] > 0.3
    assert acne(10, both, 8000)[0] < 0.07
    recedes, _ = screen_shadow(10, both, 8000)
    assert recedes < 0.06
    _, too_far = screen_shadow(30, both, 8000)
    assert abs(too_far) < 0.04


def test_same_input_same_bits():
    arrays, view = random_splats(3000, seed=2), light(200, 150)
    first, second = (occlusion(arrays, view, 0.01) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_rigid_motion_of_gaussians_and_sun_changes_nothing():
    arrays, view = random_splats(150, seed=8), light()
    turn = Rotation.from_quat([0.3, -0.5, 0.7, 0.4])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), [0.4, -0.9, 0.2]
    w_last = np.roll(arrays["quaternions"], -1, axis=1)
    moved = {
        **arrays,
        "means": arrays["means"] @ motion[:3, :3].T + motion[:3, 3],
        "quaternions": np.roll((turn * Rotation.from_quat(w_last)).as_quat(), 1, axis=1),
    }
    before, after = occlusion(arrays, view, 0.02), occlusion(moved, light(pose=motion @ POSE), 0.02)
    assert before.mean() > 0.2
    np.testing.assert_allclose(before, after, atol=2e-5)


def test_two_models_far_apart_are_shadowed_as_each_alone():
    one, other = random_splats(80, seed=1), random_splats(90, seed=2)
    other["means"] = other["means"] + [20.0, 0.0, -300.0]  # 200 pixels aside, and far along the sunlight
    both = occlusion(joined(one, other), overhead(264, 64))
    assert not both[80:].any()  # to the right of this image
    wide = OrthographicCamera(DOWN, 264, 64, PIXELS, PIXELS, 32, 32)
    aside = OrthographicCamera(DOWN, 64, 64, PIXELS, PIXELS, 32 - 200, 32)
    both = occlusion(joined(one, other), wide)
    np.testing.assert_allclose(both[:80], occlusion(one, overhead()), atol=1e-6)
    np.testing.assert_allclose(both[80:], occlusion(other, aside), atol=1e-6)
    assert both[:80].mean() > 0.2
    assert both[80:].mean() > 0.2


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e38, -1e38, 1e-38, 1e9, -80.0, 60.0])
@pytest.mark.parametrize("name", [*PARAMETERS, "bias"])
def test_hostile_values_stay_finite_and_alone(name, value):
    arrays, view = random_splats(30, seed=4), light()
    hostile = {key: array.copy() for key, array in arrays.items()} | {"bias": np.full(30, 0.01)}
    hostile[name][7] = value
    bias = hostile.pop("bias")
    ours = occlusion(hostile, view, bias)
    assert np.isfinite(ours).all()
    assert (ours >= 0).all()
    assert (ours <= 1).all()
    if not np.isfinite(value) and name != "bias":  # neither shadowed nor a blocker
        assert ours[7] == 0
        others = {key: np.delete(array, 7, axis=0) for key, array in arrays.items()}
        np.testing.assert_array_equal(np.delete(ours, 7), occlusion(others, view, 0.01))
    if name == "bias" and not 0 < value < 1e9:
        unbiased = occlusion(arrays, view, np.where(np.arange(30) == 7, 0, 0.01))
        np.testing.assert_array_equal(ours, unbiased)


def test_nothing_at_all_and_nothing_in_the_image():
    arrays = random_splats(20)
    assert len(occlusion({name: value[:0] for name, value in arrays.items()}, light())) == 0
    arrays["means"] = arrays["means"] + [0.0, 40.0, 0.0]
    np.testing.assert_array_equal(occlusion(arrays, light()), np.zeros(20))


def test_recordings_serve_models_of_any_size():
    """Recorded for one number of Gaussians and pairs, replayed for others, larger and smaller, back and forth."""
    for count in (1000, 40, 1020, 7, 1, 961, 1000):
        arrays, view = random_splats(count, seed=count, degree=0), light(32, 24)
        ours, twin = occlusion(arrays, view, 0.01), occlusion_reference(arrays, view, np.full(count, 0.01))
        np.testing.assert_allclose(ours, twin, atol=2e-4)


def test_recordings_tell_models_apart_whose_lists_are_equally_long():
    """Gaussians that cannot be seen add nothing to the lists, but the arrays grow."""
    arrays, view = random_splats(1000, seed=1, degree=0), light(32, 24)
    alone = occlusion(arrays, view)
    assert alone.mean() > 0.2
    for count in (9000, 2500, 4100, 9000, 6000):
        unseen = random_splats(count, seed=2, degree=0)
        unseen["means"][:] += [0.0, 40.0, 0.0]
        more = occlusion(joined(unseen, arrays), view)
        np.testing.assert_array_equal(alone, more[count:])
        assert not more[:count].any()


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (16, 8), (17, 9)])
def test_images_of_few_pixels(size):
    arrays, view = random_splats(60, seed=4, degree=0), light(*size)
    np.testing.assert_allclose(occlusion(arrays, view), occlusion_reference(arrays, view, np.zeros(60)), atol=2e-5)


def test_one_bias_serves_all_and_another_length_does_not():
    gaussians, camera = Gaussians.from_numpy(random_splats(20)), Orthographic.of(light())
    one = np.array(occlusion_by_splatting(gaussians, camera, ad.Float(0.05)))
    np.testing.assert_array_equal(one, occlusion(random_splats(20), light(), 0.05))
    with pytest.raises(ValueError, match="expected 20 numbers or one, found 3"):
        occlusion_by_splatting(gaussians, camera, ad.Float(0, 0, 0))


def test_occlusion_is_detached():
    gaussians = Gaussians.from_numpy(random_splats(20))
    for name in PARAMETERS:
        dr.enable_grad(getattr(gaussians, name))
    assert not dr.grad_enabled(occlusion_by_splatting(gaussians, Orthographic.of(light()), ad.Float(0)))
    for method in (SplattingConfig(), MappingConfig()):
        shadows = cast_shadows(gaussians, light_rows([0, 1, 1]), ShadowConfig(method, size=64), 4.0)
        assert not dr.grad_enabled(shadows.occlusion)
