"""The Dr.Jit rasterizer against its float64 reference: pictures, gradients, symmetries, hostile input."""

from functools import cache

import drjit as dr
import numpy as np
import pytest
from splats import random_splats, take_cudas
from twin import record

from spacesim.backend import Recorded, ad, select
from spacesim.backend.upload import upload
from spacesim.data.errors import WorkError
from spacesim.data.geometry import quaternion_from_rotation, rotation_from_quaternion
from spacesim.data.records import Camera
from spacesim.splat.raster import adjoint, records, walks
from spacesim.splat.raster import blend as rasterize
from spacesim.splat.raster import render as rendering
from spacesim.splat.raster.gaussians import NAMES, Gaussians
from spacesim.splat.raster.lists import bin as binning
from spacesim.splat.raster.lists import boxes, capacity, tiles
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.raster.render import render
from spacesim.splat.reference.rasterizer import real_spherical_harmonics, render_reference
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.trainer import Trainer

pytestmark = pytest.mark.threads
SIZE = (40, 28)


@pytest.fixture(autouse=True, params=["cuda", "llvm", "parts"])
def way(request, monkeypatch):
    """Each backend's tiles, order and adjoint, on the backend that runs; lists that are walked in parts, CUDA's, which
    are traced, or recordings of whole lists would be replayed."""
    if request.param == "parts":
        take_cudas(monkeypatch)
        for module in (rasterize, rendering):
            for name, function in list(vars(module).items()):
                if isinstance(function, Recorded):
                    monkeypatch.setattr(module, name, function.traced)
        monkeypatch.setattr(walks, "IN_PARTS", {"cuda": 0})
        monkeypatch.setattr(walks, "PART", 8)
    elif request.param != select():
        if select() == "cuda":
            pytest.skip("Dr.Jit cannot replay its sort on CUDA")
        take_cudas(monkeypatch)


def camera(width: int = SIZE[0], height: int = SIZE[1]) -> Camera:
    return record("perspective", width, height)


def placed_splats() -> dict[str, np.ndarray]:
    """Four wide, half-transparent splats whose colours stay off the clamp: no discontinuity in a pixel's reach."""
    rng = np.random.default_rng(7)
    sh = rng.normal(size=(4, 16, 3)) * 0.04
    sh[:, 0] = rng.uniform(0.2, 0.8, (4, 3))
    return {
        "means": np.array([[0.3, 0.05, 0.0], [0.0, -0.2, 0.1], [-0.3, 0.15, -0.1], [-0.6, 0.0, 0.05]]),
        "log_scales": np.log([[0.9, 0.7, 0.8], [0.8, 1.0, 0.7], [1.1, 0.8, 0.9], [1.0, 1.2, 0.8]]),
        "quaternions": rng.normal(size=(4, 4)),
        "logit_opacities": np.array([-0.4, 0.2, -0.8, 0.5]),
        "sh": sh,
    }


def picture(arrays: dict[str, np.ndarray], view: Camera) -> dict[str, np.ndarray]:
    output = render(Gaussians.from_numpy(arrays), Pinhole.of(view))
    shape = (view.height, view.width)
    return {
        "color": np.array(output.color).T.reshape(*shape, 3),
        "alpha": np.array(output.alpha).reshape(shape),
        "depth": np.array(output.depth).reshape(shape),
    }


def test_a_pixel_ends_before_the_splat_that_would_finish_it():
    """As in gsplat: behind an opacity of 0.95 one of 0.999 would leave 5e-5, so neither it nor what follows counts."""
    arrays = placed_splats() | {"logit_opacities": np.log([19.0, 1999.0, 1.0, 1.0])}
    arrays["log_scales"][:] = np.log(50.0)
    view = camera(16, 12)
    model = Gaussians.from_numpy(arrays)
    dr.enable_grad(model.logit_opacities)
    output = render(model, Pinhole.of(view))
    dr.backward(dr.sum(output.alpha))
    alpha = np.array(output.alpha)
    assert 0.94 < alpha.min() <= alpha.max() < 0.96
    assert np.array(dr.grad(model.logit_opacities))[1:].tolist() == [0, 0, 0]
    np.testing.assert_allclose(alpha, render_reference(arrays, view).alpha.ravel(), atol=1e-6)


def loss_weights(view: Camera) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [rng.normal(size=view.width * view.height) for _ in range(5)]


def gradients(arrays: dict[str, np.ndarray], view: Camera) -> dict[str, np.ndarray]:
    """Of sum(weights * (r, g, b, alpha, depth * alpha)), with N first."""
    gaussians = Gaussians.from_numpy(arrays)
    for parameter in gaussians.parameters().values():
        dr.enable_grad(parameter)
    output = render(gaussians, Pinhole.of(view))
    planes = [*output.color, output.alpha, output.depth * output.alpha]
    loss = ad.Float(0)
    for weight, plane in zip(loss_weights(view), planes, strict=True):
        loss += dr.sum(upload(weight.astype(np.float32)) * plane)
    dr.backward(loss)
    result = {name: np.array(dr.grad(value)).T for name, value in gaussians.parameters().items()}
    result["sh"] = result["sh"].reshape(len(arrays["means"]), -1, 3)
    return result


def reference_loss(arrays: dict[str, np.ndarray], view: Camera) -> float:
    output = render_reference(arrays, view)
    planes = [*np.moveaxis(output.color, -1, 0), output.alpha, output.depth * output.alpha]
    return float(sum((w * p.ravel()).sum() for w, p in zip(loss_weights(view), planes, strict=True)))


def central_differences(arrays: dict[str, np.ndarray], view: Camera, step: float = 1e-5) -> dict[str, np.ndarray]:
    result = {}
    for name in NAMES:
        values = np.array(arrays[name], dtype=np.float64)
        slope = np.empty_like(values)
        for index in np.ndindex(values.shape):
            ends = []
            for sign in (1, -1):
                moved = values.copy()
                moved[index] += sign * step
                ends.append(reference_loss({**arrays, name: moved}, view))
            slope[index] = (ends[0] - ends[1]) / (2 * step)
        result[name] = slope
    return result


@pytest.mark.parametrize(("count", "size"), [(1, SIZE), (4, (16, 8)), (60, SIZE), (300, (33, 47))])
def test_picture_matches_the_twin(count, size):
    arrays, view = random_splats(count, seed=count), camera(*size)
    ours, twin = picture(arrays, view), render_reference(arrays, view)
    assert twin.alpha.max() > 0.1
    np.testing.assert_allclose(ours["color"], twin.color, atol=1e-5)
    np.testing.assert_allclose(ours["alpha"], twin.alpha, atol=1e-5)
    solid = twin.alpha > 0.01  # below, depth divides by next to nothing
    np.testing.assert_allclose(ours["depth"][solid], twin.depth[solid], atol=2e-5)


def test_gradients_match_central_differences_on_placed_splats():
    arrays, view = placed_splats(), camera(24, 17)
    ours, twin = gradients(arrays, view), central_differences(arrays, view)
    for name in NAMES:
        scale = np.abs(twin[name]).max()
        assert scale > 0
        np.testing.assert_allclose(ours[name], twin[name], rtol=1e-3, atol=1e-4 * scale, err_msg=name)


@cache
def differences() -> dict[str, np.ndarray]:
    return central_differences(random_splats(25, seed=11, degree=1), camera(24, 17), step=1e-7)


def test_gradients_match_central_differences_on_a_random_scene():
    arrays, view = random_splats(25, seed=11, degree=1), camera(24, 17)
    ours, twin = gradients(arrays, view), differences()
    for name in NAMES:
        error = np.linalg.norm(ours[name] - twin[name]) / np.linalg.norm(twin[name])
        assert error < 1e-3, (name, error)


def test_permuting_splats_changes_nothing():
    arrays, view = random_splats(200, seed=5), camera()
    order = np.random.default_rng(1).permutation(200)
    shuffled = {name: value[order] for name, value in arrays.items()}
    first, second = picture(arrays, view), picture(shuffled, view)
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    before, after = gradients(arrays, view), gradients(shuffled, view)
    for name in NAMES:
        np.testing.assert_array_equal(before[name][order], after[name])


def test_rigid_motion_of_scene_and_camera_changes_nothing():
    arrays, view = random_splats(150, seed=8, degree=0), camera()
    motion = np.eye(4)
    motion[:3, :3] = rotation_from_quaternion([0.3, -0.5, 0.7, 0.4])
    motion[:3, 3] = [0.4, -0.9, 0.2]
    turn = quaternion_from_rotation(motion[:3, :3])
    moved = dict(arrays)
    moved["means"] = arrays["means"] @ motion[:3, :3].T + motion[:3, 3]
    moved["quaternions"] = np.array([_product(turn, q) for q in arrays["quaternions"]])
    moved_view = Camera(motion @ view.world_from_camera, view.width, view.height, view.fx, view.fy, view.cx, view.cy)
    first, second = picture(arrays, view), picture(moved, moved_view)
    solid = first["alpha"] > 0.01
    for name, plane in first.items():
        np.testing.assert_allclose(plane[solid], second[name][solid], atol=2e-5, err_msg=name)
        if name != "depth":
            np.testing.assert_allclose(plane, second[name], atol=2e-5, err_msg=name)


def _product(p, q):
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *v])


def test_same_input_same_bits():
    arrays, view = random_splats(5000, seed=2), camera(200, 150)
    first, second = gradients(arrays, view), gradients(arrays, view)
    for name in NAMES:
        np.testing.assert_array_equal(first[name], second[name])


def test_no_splats_at_all():
    view = camera()
    empty = {name: value[:0] for name, value in random_splats(3).items()}
    output = picture(empty, view)
    assert not output["color"].any()
    assert not output["alpha"].any()


def test_all_behind_the_camera():
    arrays, view = random_splats(20), camera()
    arrays["means"] = arrays["means"] + 10 * (view.position / np.linalg.norm(view.position))
    assert not picture(arrays, view)["alpha"].any()
    for gradient in gradients(arrays, view).values():
        assert not gradient.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e38, -1e38, 1e-38, 1e9, -80.0, 60.0])
@pytest.mark.parametrize("name", NAMES)
def test_hostile_values_stay_finite_and_alone(name, value):
    arrays, view = random_splats(30, seed=4), camera()
    hostile = {key: array.copy() for key, array in arrays.items()}
    hostile[name][7] = value
    output, slope = picture(hostile, view), gradients(hostile, view)
    for plane in output.values():
        assert np.isfinite(plane).all()
    for gradient in slope.values():
        assert np.isfinite(gradient).all()
    if not np.isfinite(value) and name != "sh":  # such a splat is not drawn, and the others are as without it
        others = picture({key: np.delete(array, 7, axis=0) for key, array in arrays.items()}, view)
        np.testing.assert_array_equal(output["color"], others["color"])


def test_extremes_of_size_and_number():
    giant = random_splats(3)
    giant["log_scales"][:] = 3.0
    assert picture(giant, camera(130, 90))["alpha"].min() > 0.1
    crowd = random_splats(10_000, seed=6, degree=0)
    crowd["means"][:] *= 1e-6
    crowd["log_scales"][:] = -9.0
    crowd["logit_opacities"][:] = -5.0
    view = camera(16, 16)
    ours, twin = picture(crowd, view), render_reference(crowd, view, 0)
    np.testing.assert_allclose(ours["alpha"], twin.alpha, atol=2e-5)


def test_the_twin_knows_its_spherical_harmonics():
    directions = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    basis = real_spherical_harmonics(directions, 1)
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    np.testing.assert_allclose(basis, [[c0, 0, c1, 0], [c0, 0, 0, -c1], [c0, -c1, 0, 0]], atol=1e-12)


def test_recordings_serve_models_of_any_size():
    """Recorded for one number of splats and pairs, replayed for others, larger and smaller, back and forth."""
    view = camera(48, 40)
    for count in (1000, 40, 1020, 7, 1, 961, 1000):
        arrays = random_splats(count, seed=count, degree=0)
        ours, twin = picture(arrays, view), render_reference(arrays, view)
        np.testing.assert_allclose(ours["color"], twin.color, atol=2e-5)
        np.testing.assert_allclose(ours["alpha"], twin.alpha, atol=2e-5)


def test_pictures_have_lists_of_few_sizes():
    """Two from one power of two to the next; a model that is seen from all over then has few recordings."""
    counts = range(2**13, 2**17, 61)
    sizes = {tiles.round_capacity(count, capacity.FEW) for count in counts}
    assert len(sizes) <= 9
    assert len({tiles.round_capacity(count) for count in counts}) > 30
    assert all(count < tiles.round_capacity(count, capacity.FEW) <= 1.5 * count + 1 for count in counts)
    arrays = random_splats(600, seed=5, degree=0)
    splats, footprints = project(Gaussians.from_numpy(arrays), Pinhole.of(camera(64, 48)))
    few, many = (binning.bin_splats(splats, footprints, 64, 48, few_sizes=flag) for flag in (True, False))
    assert few.pairs == many.pairs > 100
    for name in ("start", "end"):
        assert np.array_equal(np.array(getattr(few, name)), np.array(getattr(many, name)))
    assert np.array_equal(np.array(few.splat)[: few.pairs], np.array(many.splat)[: many.pairs])


@pytest.mark.parametrize("first", [1024, 2048])
def test_a_recording_of_as_many_splats_as_its_capacity_serves_fewer(first):
    """Were the capacity the count, a replay would take it from the next, smaller number of splats."""
    assert all(tiles.round_capacity(count) > count for count in (*range(1, 5000), 2**20, 2**20 - 1))
    for count in (first, first - 300):
        arrays = {**random_splats(count), "logit_opacities": np.full(count, -1.0)}
        twin = render_reference(arrays, camera())
        np.testing.assert_allclose(picture(arrays, camera())["alpha"], twin.alpha, atol=1e-5)


@pytest.mark.parametrize(("count", "sentence"), [(20_000, "GB are free"), (150_000, "can be sorted")])
def test_more_pairs_than_memory_holds_are_a_sentence(count, sentence, monkeypatch):
    """Splats that cover all tiles of a large picture."""
    monkeypatch.setattr(capacity, "free_memory", lambda _: 10**9)
    arrays = random_splats(count, degree=0)
    arrays["log_scales"][:] = 3.0
    arrays["logit_opacities"][:] = 5.0
    with pytest.raises(WorkError, match=sentence):
        render(Gaussians.from_numpy(arrays), Pinhole.of(camera(1024, 1024)))


def test_a_picture_larger_than_memory_is_a_sentence(monkeypatch):
    """Also of a single splat, and of none in sight."""
    monkeypatch.setattr(capacity, "free_memory", lambda _: 10**9)
    arrays, view = random_splats(1), camera(4096, 4096)
    with pytest.raises(WorkError, match=r"on 1.68e\+07 pixels need about 1.43 GB of memory, 1 GB are free"):
        render(Gaussians.from_numpy(arrays), Pinhole.of(view))
    arrays["means"] += 1e4
    with pytest.raises(WorkError, match=r"0 pairs of tile and splat on 1.68e\+07"):
        render(Gaussians.from_numpy(arrays), Pinhole.of(view))


def test_a_training_step_needs_more_than_a_picture(monkeypatch, small_dataset):
    monkeypatch.setattr(capacity, "free_memory", lambda _: 2 * 10**9)
    view = camera(4096, 4096)
    splats, footprints = project(Gaussians.from_numpy(random_splats(1)), Pinhole.of(view))
    assert binning.bin_splats(splats, footprints, 4096, 4096).pairs > 0
    needed = {"cuda": "2.68", "llvm": "4.7"}[capacity.select()]
    with pytest.raises(WorkError, match=rf"need about {needed} GB of memory, 2 GB are free"):
        capacity.list_capacity(1, capacity.Extent(1, 4096, 4096, training=True))
    monkeypatch.setattr(capacity, "TRAINING_BYTES", dict.fromkeys(("cuda", "llvm"), (0, 10**7)))
    with pytest.raises(WorkError, match="2 GB are free"):
        Trainer(small_dataset, TrainConfig()).step()


def test_memory_that_was_free_a_moment_ago_is_not_asked_for_again(monkeypatch):
    asked, now, extent = [], [100.0], capacity.Extent(1, 0, 0)
    monkeypatch.setattr(capacity, "free_memory", lambda needed: asked.append(needed) or 10**9)
    monkeypatch.setattr(capacity.time, "monotonic", lambda: now[0])
    for pairs in (4 * 10**6, 4 * 10**6, 3 * 10**6, 5 * 10**6, 10**6):
        capacity.check_memory(pairs, extent)
    assert asked == [8 * 10**8, 10**9]
    with pytest.raises(WorkError, match=r"need about 1\.2 GB"):
        capacity.check_memory(6 * 10**6, extent)
    now[0] += capacity.BELIEVED
    capacity.check_memory(4 * 10**6, extent)
    assert asked == [8 * 10**8, 10**9, 12 * 10**8, 8 * 10**8]


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (16, 8), (17, 9)])
def test_pictures_of_few_pixels(size):
    arrays, view = random_splats(60, seed=4, degree=0), camera(*size)
    ours, twin = picture(arrays, view), render_reference(arrays, view)
    np.testing.assert_allclose(ours["color"], twin.color, atol=2e-5)
    np.testing.assert_allclose(ours["alpha"], twin.alpha, atol=2e-5)


def adjoints(arrays, view, channels: int, absolute: bool, monkeypatch) -> list[np.ndarray]:
    """Gradients [N] of weighted sums of `channels` planes: by buckets, then by tiles, with CUDA's tiles."""
    take_cudas(monkeypatch)
    splats, footprints = project(Gaussians.from_numpy(arrays), Pinhole.of(view))
    rng, size = np.random.default_rng(4), (view.width, view.height)
    features = [upload(row) for row in rng.normal(size=(channels, len(arrays["means"]))).astype(np.float32)]
    weights = [upload(row) for row in rng.normal(size=(channels + 1, view.width * view.height)).astype(np.float32)]
    lists = binning.bin_splats(splats, footprints, *size)
    found = []
    for limit in (rasterize.CHECKPOINT_BYTES, 0):
        monkeypatch.setattr(rasterize, "CHECKPOINT_BYTES", limit)
        blended = rasterize.forward(splats, features, lists, *size, adjoint=True)
        assert blended.state is not None
        assert bool(blended.state.bucket) == bool(limit)
        result = rasterize.backward(splats, blended, lists, size, weights[:-1], weights[-1], absolute)
        numbers = [getattr(result.splats, name) for name in ("x", "y", "a", "b", "c", "opacity")] + result.features
        assert (result.absolute_x is None) == (not absolute)
        found.append(np.array(numbers + ([result.absolute_x, result.absolute_y] if absolute else [])))
    return found


@pytest.mark.parametrize(
    ("channels", "absolute"), [(0, True), (1, False), (3, True), (3, False), (4, True), (16, False)]
)
@pytest.mark.parametrize("logit", [-3.0, 3.0])
def test_both_adjoints_agree(channels, absolute, logit, monkeypatch):
    """Faint splats, whose lists are walked to their ends, and opaque ones, where threads of a tile stop apart."""
    arrays, view = random_splats(400, seed=12), camera(61, 45)
    arrays["logit_opacities"] = arrays["logit_opacities"] + logit
    by_buckets, by_tiles = adjoints(arrays, view, channels, absolute, monkeypatch)
    assert by_tiles.shape == by_buckets.shape
    for ours, twin in zip(by_buckets, by_tiles, strict=True):
        np.testing.assert_allclose(ours, twin, atol=1e-5 * np.abs(twin).max())


def test_pictures_of_many_pixels_have_larger_tiles_on_cuda(monkeypatch):
    """Which draw the same."""
    arrays, view, drawn, found = random_splats(300, seed=6), camera(61, 45), [], []
    take_cudas(monkeypatch)
    for small in (2**18, 0):
        monkeypatch.setattr(tiles, "SMALL", small)
        capacity.Extent.of.cache_clear()
        drawn.append(picture(arrays, view))
        found.append(adjoints(arrays, view, 3, True, monkeypatch)[0])
    shapes = [tiles.tile_shape(*size) for size in ((512, 512), (1, 1))]
    monkeypatch.setattr(tiles, "SMALL", 2**18)
    assert tiles.tile_shape(512, 512).pixels == 1
    assert tiles.tile_shape(513, 512) == shapes[0] == shapes[1]
    assert shapes[0].pixels == 2
    for name, plane in drawn[0].items():
        np.testing.assert_allclose(plane, drawn[1][name], rtol=1e-6, atol=1e-6, err_msg=name)
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(other).max())


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (9, 1), (1, 17)])
def test_both_adjoints_agree_on_few_pixels(size, monkeypatch):
    for count in (300, 290):  # recorded, then replayed
        with monkeypatch.context() as patch:
            by_buckets, by_tiles = adjoints(random_splats(count, seed=3), camera(*size), 3, True, patch)
        assert np.abs(by_tiles).max() > 0
        for ours, twin in zip(by_buckets, by_tiles, strict=True):
            np.testing.assert_allclose(ours, twin, atol=1e-5 * np.abs(twin).max())


def test_absolute_sums_change_no_gradient(monkeypatch):
    """And are as large as the sums with their signs, at least."""
    arrays, view = random_splats(120, seed=5), camera()
    with monkeypatch.context() as patch:
        with_them = adjoints(arrays, view, 3, True, patch)
    for ours, without in zip(with_them, adjoints(arrays, view, 3, False, monkeypatch), strict=True):
        scale = np.abs(without).max(axis=1, keepdims=True)
        np.testing.assert_allclose(ours[:-2] / scale, without / scale, atol=1e-6)
        assert (ours[-2:] >= np.abs(ours[:2]) * (1 - 1e-5)).all()
        assert (ours[-2:] > 1.5 * np.abs(ours[:2])).any()


def test_frames_keep_nothing_for_an_adjoint(monkeypatch):
    buckets = []

    def spied(plain):
        def call(*arguments, **named):
            buckets.append(arguments[6] if len(arguments) > 6 else named.get("bucket"))
            return plain(*arguments, **named)

        return call

    for module, name in ((rasterize, "blend_lists"), (rendering, "blend_planes")):
        monkeypatch.setattr(module, name, spied(getattr(module, name)))
    for name in ("_draw_boxes_at_once", "_blend_records"):
        plain = getattr(rendering, name)
        monkeypatch.setattr(rendering, name, getattr(plain, "traced", plain))
    monkeypatch.setattr(rendering, "expected_capacity", lambda _: None)
    arrays, view = random_splats(30), camera()
    picture(arrays, view)
    gradients(arrays, view)
    assert len(buckets) == 2
    assert buckets[0] is None
    assert buckets[1] is not None


SHAPES = [(8, 8, 4, 2), (8, 8, 4, 4), (8, 8, 2, 4), (8, 8, 1, 8), (16, 8, 16, 1), (16, 8, 4, 8), (4, 16, 4, 1)]


@pytest.mark.parametrize("shape", SHAPES[:1] + SHAPES[3:6])
def test_any_tile_shape_blends_the_same(shape, monkeypatch):
    """Threads that hold columns or blocks, tiles that share a packet or fill it: pictures and gradients by the twin."""
    monkeypatch.setattr(boxes, "tile_shape", lambda *_: tiles.TileShape(*shape))
    for module in (rasterize, rendering, binning, adjoint, records):
        for function in filter(lambda one: isinstance(one, Recorded), vars(module).values()):
            function._frozen.clear()  # else what another way has recorded for such tiles would be replayed
    arrays, view = random_splats(25, seed=11, degree=1), camera(24, 17)
    ours, twin = picture(arrays, view), render_reference(arrays, view)
    np.testing.assert_allclose(ours["color"], twin.color, atol=1e-5)
    np.testing.assert_allclose(ours["alpha"], twin.alpha, atol=1e-5)
    slope, expected = gradients(arrays, view), differences()
    for name in NAMES:
        error = np.linalg.norm(slope[name] - expected[name]) / np.linalg.norm(expected[name])
        assert error < 1e-3, (name, error)


@pytest.mark.parametrize("shape", SHAPES)
def test_lanes_hold_each_pixel_of_a_picture_once(shape):
    """And `tiled_index` finds it where its thread stores it, `pixel_in_tile` where it is."""
    shape, (width, height) = tiles.TileShape(*shape), (37, 21)
    across, down = -(-width // shape.width), -(-height // shape.height)
    none, order = ad.UInt32(0), np.random.default_rng(0).permutation(across * down)
    lists = tiles.TileLists(*[none] * 6, 0, across, down, shape, upload(order.astype(np.uint32), ad.UInt32))
    thread = tiles.thread_pixels(lists)
    found = {}
    for p, (i, j) in enumerate(tiles.thread_offsets(shape)):
        column, row, place = (np.array(v) for v in (thread.column + i, thread.row + j, thread.place * shape.pixels + p))
        found |= {(x, y): n for x, y, n in zip(column.tolist(), row.tolist(), place.tolist(), strict=True)}
        inside = tiles.pixel_in_tile(thread.place * shape.pixels % (shape.width * shape.height) + p, shape)
        np.testing.assert_array_equal(np.array(inside[0]), column % shape.width)
        np.testing.assert_array_equal(np.array(inside[1]), row % shape.height)
    pixels = across * down * shape.width * shape.height
    assert sorted(found.values()) == list(range(pixels))
    index = np.array(tiles.tiled_index(lists, width, height)).reshape(height, width)
    assert all(found[x, y] == index[y, x] for y in range(height) for x in range(width))


def test_powers_of_two():
    """Within two units in the last place where splats are blended, and nowhere far off."""
    power = np.linspace(-126, 1, 300_001).astype(np.float32)
    error = np.array(records.exp2(upload(power))).astype(np.float64) / np.exp2(power.astype(np.float64)) - 1
    assert np.abs(error[power >= records.POWER_MIN]).max() < 2.4e-7
    assert np.abs(error).max() < 1e-6
    np.testing.assert_array_equal(np.array(records.exp2(ad.Float([0.0, -1.0, -7.0]))), [1.0, 0.5, 2.0**-7])


def test_the_number_of_threads_does_not_show():
    if select() != "llvm":
        pytest.skip("threads of the CPU")
    arrays, view, threads = random_splats(3000, seed=9), camera(150, 90), dr.thread_count()
    found = []
    try:
        for count in (1, 2, 3):
            dr.set_thread_count(count)
            found.append(gradients(arrays, view))
    finally:
        dr.set_thread_count(threads)
    for other in found[1:]:
        for name in NAMES:
            np.testing.assert_array_equal(found[0][name], other[name])


@pytest.mark.parametrize("lists", ["own", "cuda"])
def test_frames_are_drawn_as_pictures_with_gradients_are(lists, monkeypatch):
    """Recorded for some Gaussians, replayed for others; by the lists of this backend and, on any, by CUDA's."""
    if lists == "cuda":
        take_cudas(monkeypatch)
    outputs = ("color", "depth", "median_depth", "normal")
    for count in (300, 290, 1500, 1400):
        gaussians, camera_ = Gaussians.from_numpy(random_splats(count, seed=count)), Pinhole.of(camera())
        features = [upload(np.arange(count, dtype=np.float32) * k) for k in range(3)]
        with monkeypatch.context() as patch:
            frame = render(gaussians, camera_, outputs=outputs, features=features)
            patch.setitem(rendering.PLANES, "color", rendering.FEATURES_PER_PASS + 1)  # as if they took more passes
            twin = render(gaussians, camera_, outputs=outputs, features=features)
        for name in ("color", "alpha", "depth", "median_depth", "normal", "features"):
            ours, other = (np.array(getattr(picture, name)) for picture in (frame, twin))
            if name == "normal" and select() == "cuda" and walks.IN_PARTS["cuda"] == 0:
                # made unit in another kernel, whose last bit may differ
                np.testing.assert_allclose(ours, other, rtol=0, atol=2.4e-7)
            else:
                np.testing.assert_array_equal(ours, other, name)
