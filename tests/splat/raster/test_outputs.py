"""What is rendered beside colour: normals, median depth, own features, the anti-aliased mode; sizes and bad numbers."""

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import device_camera

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.output import OUTPUTS
from spacesim.splat.raster.project import project
from spacesim.splat.raster.render import FEATURES_PER_PASS, render
from spacesim.splat.raster.surface import gather_or_zero, normals, unit
from spacesim.splat.reference.rasterizer import render_reference

POSE = look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0])


def perspective(width: int = 40, height: int = 28) -> Camera:
    return Camera(POSE, width, height, 1.3 * width, 1.2 * width, 0.52 * width, 0.47 * height)


def orthographic(width: int = 40, height: int = 28) -> OrthographicCamera:
    return OrthographicCamera(POSE, width, height, 0.55 * width, 0.6 * width, 0.52 * width, 0.47 * height)


VIEWS = [perspective, orthographic]


def random_splats(count: int, seed: int = 0, scales: tuple[float, float] = (-3.2, -1.4)) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.6, 0.6, (count, 3)),
        "log_scales": rng.uniform(*scales, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.uniform(-2.5, 2.0, count),
        "sh": rng.normal(size=(count, 1, 3)) * 0.25,
    }


def surfels(points: np.ndarray, directions: np.ndarray, size: float, opacity_logit: float = 3.0) -> dict:
    """Discs at `points` [N, 3] facing `directions` [N, 3]."""
    turns = np.array([Rotation.align_vectors([d], [[0.0, 0, 1]])[0].as_quat()[[3, 0, 1, 2]] for d in directions])
    count = len(points)
    return {
        "means": points,
        "log_scales": np.log(np.tile([size, size, size / 30], (count, 1))),
        "quaternions": turns,
        "logit_opacities": np.full(count, opacity_logit),
        "sh": np.zeros((count, 1, 3)),
    }


@pytest.mark.parametrize("view", VIEWS)
def test_median_depth_matches_the_twin(view):
    for count, seed in ((1, 2), (60, 3), (400, 4)):
        arrays, camera = random_splats(count, seed), view()
        arrays["logit_opacities"] += 2.0
        ours = render(Gaussians.from_numpy(arrays), device_camera(camera), outputs=("median_depth",)).image(
            "median_depth"
        )
        twin = render_reference(arrays, camera).median_depth
        assert (twin > 0).mean() > 0.01
        np.testing.assert_allclose(ours, twin, rtol=1e-6)


def test_median_depth_is_the_front_of_two_sheets():
    """Behind a sheet of alpha 0.7 stands another; before it one of 0.2: half of the light ends in the middle one."""
    plane = np.array([[x, y] for x in np.linspace(-1, 1, 30) for y in np.linspace(-1, 1, 30)])
    sheets = [
        surfels(np.c_[plane, np.full(900, z)], np.tile([0.0, 0, -1], (900, 1)), 0.05, logit)
        for z, logit in ((4.0, -3.0), (5.0, 0.0), (6.0, 3.0))
    ]
    arrays = {name: np.concatenate([sheet[name] for sheet in sheets]) for name in sheets[0]}
    view = OrthographicCamera(np.eye(4), 20, 20, 15.0, 15.0, 10.0, 10.0)
    output = render(Gaussians.from_numpy(arrays), Orthographic.of(view), outputs=("depth", "median_depth"))
    np.testing.assert_array_equal(output.image("median_depth")[3:-3, 3:-3], 5.0)
    assert (np.abs(output.image("depth")[3:-3, 3:-3] - 5.0) > 0.01).all()


def test_median_depth_gradient_goes_to_the_chosen_gaussian():
    """Moving all along the axis moves the median depth by as much; each Gaussian's share is the pixels that it owns."""
    arrays, camera = random_splats(50, 5), orthographic()
    arrays["logit_opacities"] += 3.0
    gaussians = Gaussians.from_numpy(arrays)
    dr.enable_grad(gaussians.means)
    output = render(gaussians, device_camera(camera), outputs=("median_depth",))
    weights = np.random.default_rng(1).normal(size=40 * 28).astype(np.float32)
    dr.backward(dr.sum(upload(weights) * output.median_depth))
    slope = np.array(dr.grad(gaussians.means)).T
    twin = render_reference(arrays, camera).median_depth.ravel()
    depths = arrays["means"] @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    nearest = np.where(twin > 0, np.abs(twin[:, None] - depths).argmin(axis=1), -1)
    share = np.array([weights[nearest == i].sum(dtype=np.float64) for i in range(50)])
    assert (share != 0).sum() > 10
    np.testing.assert_allclose(slope, share[:, None] * camera.camera_from_world[2, :3], atol=1e-5)


def test_picking_is_a_gather_and_adds_up_in_no_order():
    rng = np.random.default_rng(6)
    values, index = rng.normal(size=300).astype(np.float32), rng.integers(0, 301, 200_000).astype(np.uint32)
    gradient = (rng.normal(size=200_000) * 10.0 ** rng.integers(-6, 6, 200_000)).astype(np.float32)
    found = []
    for order in (np.arange(200_000), rng.permutation(200_000)):
        source = upload(values)
        dr.enable_grad(source)
        out = gather_or_zero(source, upload(index[order], ad.UInt32))
        np.testing.assert_array_equal(np.array(out), np.append(values, 0)[index[order]])
        dr.backward(dr.sum(out * upload(gradient[order])))
        found.append(np.array(dr.grad(source)))
    np.testing.assert_array_equal(found[0], found[1])
    expected = np.bincount(index, gradient.astype(np.float64), 301)[:300]
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


@pytest.mark.parametrize("axes", ["world", "camera"])
@pytest.mark.parametrize("view", VIEWS)
def test_normals_of_a_sphere_point_outwards(view, axes):
    outward = fibonacci_sphere(3000)
    arrays, camera = surfels(0.5 * outward, outward, 0.02), view(64, 64)
    on_device = device_camera(camera)
    gaussians = Gaussians.from_numpy(arrays)
    output = render(gaussians, on_device, outputs=("normal",), features=normals(gaussians, on_device, axes))
    found = (
        output.image("normal")
        if axes == "world"
        else np.stack([np.array(p) for p in unit(ad.Array3f(output.features))], -1)
    )
    found = found.reshape(64, 64, 3)
    # closed form: where the ray through the pixel meets the sphere
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    turn = camera.world_from_camera[:3, :3]
    if isinstance(camera, Camera):
        rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones((64, 64))], -1)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ turn.T
        origin = np.broadcast_to(camera.position, rays.shape)
    else:
        across = np.stack([(columns - camera.cx) / camera.scale_x, (rows - camera.cy) / camera.scale_y], -1)
        rays = np.broadcast_to(turn[:, 2], (64, 64, 3))
        origin = camera.world_from_camera[:3, 3] + across @ turn[:, :2].T
    along = (origin * rays).sum(-1)
    squared = along**2 - (origin**2).sum(-1) + 0.25
    hit = squared > 0.03  # away from the limb, where a pixel holds many directions
    expected = 2 * (origin - (along + np.sqrt(np.maximum(squared, 0)))[..., None] * rays)
    expected = expected if axes == "world" else expected @ turn
    assert hit.sum() > 300
    angles = np.degrees(np.arccos(np.clip((found * expected).sum(-1)[hit], -1, 1)))
    reach = np.degrees(
        3 * 0.02 / 0.5
    )  # of a disc across the sphere: 7 degrees; those nearer to the camera lie in front
    assert np.median(angles) < 0.6 * reach
    assert angles.max() < 1.3 * reach
    np.testing.assert_allclose(np.linalg.norm(found[hit], axis=-1), 1, atol=1e-5)


def test_normals_of_quaternions_without_direction_are_finite():
    arrays = random_splats(4)
    arrays["quaternions"][:3] = [[0, 0, 0, 0], [np.nan, 0, 0, 1], [1e30, 0, 0, 0]]
    found = np.array(normals(Gaussians.from_numpy(arrays), device_camera(perspective())))
    np.testing.assert_allclose(np.linalg.norm(found, axis=0), 1, atol=1e-6)


def test_normal_axes_by_name_only():
    gaussians = Gaussians.from_numpy(random_splats(3))
    with pytest.raises(ValueError, match='axes: expected "world" or "camera"'):
        normals(gaussians, device_camera(perspective()), "eye")


@pytest.mark.parametrize("channels", [0, 1, FEATURES_PER_PASS, FEATURES_PER_PASS + 1, 3 * FEATURES_PER_PASS + 2])
def test_any_number_of_channels(channels):
    """Each is the same picture as alone; the picture's gradient is that of the twin's linear map, the weights."""
    arrays, camera = random_splats(120, 8), device_camera(perspective())
    gaussians = Gaussians.from_numpy(arrays)
    values = np.random.default_rng(2).normal(size=(channels, 120)).astype(np.float32)
    features = [upload(row) for row in values]
    dr.enable_grad(features)
    output = render(gaussians, camera, outputs=("alpha",), features=features)
    assert output.image("features").shape == (28, 40, channels)
    assert output.color is None
    assert output.depth is None
    twin = render_reference(arrays, perspective(), features=values.T)
    np.testing.assert_allclose(output.image("features"), twin.features, atol=1e-5)
    np.testing.assert_allclose(output.image("alpha"), twin.alpha, atol=1e-5)
    if channels:
        dr.backward(sum((dr.sum(plane) for plane in output.features), ad.Float(0)))
        ones = render_reference(arrays, perspective(), features=np.eye(120)).features.sum(axis=(0, 1))
        for feature in features:
            np.testing.assert_allclose(np.array(dr.grad(feature)), ones, rtol=2e-4, atol=2e-4)


def test_splat_gradients_do_not_depend_on_how_channels_are_grouped():
    arrays, camera = random_splats(120, 8), device_camera(perspective())
    values = np.random.default_rng(2).normal(size=(FEATURES_PER_PASS + 3, 120)).astype(np.float32)

    def slope(groups):
        gaussians = Gaussians.from_numpy(arrays)
        dr.enable_grad(gaussians.means)
        loss = ad.Float(0)
        for group in groups:
            output = render(gaussians, camera, outputs=("alpha",), features=[upload(values[i]) for i in group])
            loss += sum((dr.sum((1 + i) * plane) for i, plane in zip(group, output.features, strict=True)), ad.Float(0))
        dr.backward(loss)
        return np.array(dr.grad(gaussians.means))

    together, alone = slope([range(FEATURES_PER_PASS + 3)]), slope([[i] for i in range(FEATURES_PER_PASS + 3)])
    np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-4 * np.abs(alone).max())


def test_features_as_an_array_and_features_that_are_not_finite():
    arrays, camera = random_splats(30, 4), device_camera(perspective())
    gaussians = Gaussians.from_numpy(arrays)
    values = np.random.default_rng(3).normal(size=(4, 30)).astype(np.float32)
    plain = render(gaussians, camera, features=[upload(row) for row in values]).image("features")
    np.testing.assert_array_equal(render(gaussians, camera, features=ad.ArrayXf(values)).image("features"), plain)
    hostile = values.copy()
    hostile[0, 3], hostile[1, 5], hostile[2, 7] = np.nan, np.inf, -np.inf
    zeroed = np.where(np.isfinite(hostile), hostile, 0)
    features = [upload(row) for row in hostile]
    dr.enable_grad(features)
    output = render(gaussians, camera, features=features)
    expected = render(gaussians, camera, features=[upload(row) for row in zeroed])
    np.testing.assert_array_equal(output.image("features"), expected.image("features"))
    dr.backward(sum((dr.sum(plane) for plane in output.features), ad.Float(0)))
    for feature in features:
        assert np.isfinite(np.array(dr.grad(feature))).all()


def test_wrong_requests_are_refused():
    gaussians, camera = Gaussians.from_numpy(random_splats(30)), device_camera(perspective())
    with pytest.raises(ValueError, match=r"outputs: expected some of color, alpha, .* found 'shade'"):
        render(gaussians, camera, outputs=("shade",))
    assert render(gaussians, camera, outputs="color").depth is None, "one name"
    for wrong in ("shade", 3, None):
        with pytest.raises(InputError, match=r"outputs: expected some of color, alpha"):
            render(gaussians, camera, outputs=wrong)
    with pytest.raises(ValueError, match="features: expected arrays of 30, found one of 29"):
        render(gaussians, camera, features=[dr.zeros(ad.Float, 30), dr.zeros(ad.Float, 29)])
    with pytest.raises(ValueError, match=r"name: expected one of the outputs asked for .* found 'normal'"):
        render(gaussians, camera).image("normal")
    output = render(gaussians, camera, outputs=("alpha",), features=[dr.zeros(ad.Float, 30)])
    with pytest.raises(ValueError, match=r"name: .* asked for \(alpha, features\), found 'depth'"):
        output.image("depth")
    with pytest.raises(ValueError, match="outputs: expected color and depth for to_numpy, found no color"):
        output.to_numpy()
    with pytest.raises(ValueError, match="outputs: expected color for over, found none"):
        output.over(0)


@pytest.mark.parametrize("view", VIEWS)
def test_zooming_out_keeps_the_mean_of_the_antialiased_picture(view):
    """From 256 to 32 pixels: most splats become thinner than a pixel. Classic splats grow by the dilation."""
    gaussians = Gaussians.from_numpy(random_splats(400, 3, scales=(-4.0, -3.0)))
    change = {}
    for antialiased in (False, True):
        means = [
            render(gaussians, device_camera(view(size, size)), antialiased=antialiased).image("color").mean()
            for size in (256, 32)
        ]
        change[antialiased] = abs(means[1] / means[0] - 1)
    assert change[True] < 0.01
    assert change[False] > 0.3


def test_compensation_is_the_ratio_of_areas():
    """A ball of s pixels keeps s^2 / (s^2 + 1/12) of its opacity; one with no area fades away, without NaN."""
    view = OrthographicCamera(np.eye(4), 16, 16, 1.0, 1.0, 8.0, 8.0)
    sizes = np.array([5.0, 1.0, 0.3, 0.1, 1e-2, 1e-20])
    arrays = {name: np.repeat(value[:1], 6, axis=0) for name, value in random_splats(1).items()}
    arrays["log_scales"] = np.log(np.tile(sizes[:, None], (1, 3)))
    gaussians = Gaussians.from_numpy(arrays)
    dr.enable_grad(gaussians.log_scales)
    splats, _ = project(gaussians, Orthographic.of(view), antialiased=True)
    opacity = 1 / (1 + np.exp(-arrays["logit_opacities"]))
    np.testing.assert_allclose(np.array(splats.opacity), opacity * sizes**2 / (sizes**2 + 1 / 12), rtol=1e-4, atol=1e-9)
    dr.backward(dr.sum(splats.opacity))
    slope = np.array(dr.grad(gaussians.log_scales)).sum(axis=0)
    np.testing.assert_allclose(slope, opacity / 6 * sizes**2 / (sizes**2 + 1 / 12) ** 2, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("view", VIEWS)
def test_no_gaussians_give_every_output(view):
    empty = Gaussians.from_numpy({name: value[:0] for name, value in random_splats(3).items()})
    output = render(empty, device_camera(view()), outputs=OUTPUTS, features=[ad.Float(), ad.Float()])
    for name in (*OUTPUTS, "features"):
        assert not output.image(name).any()
    assert output.image("features").shape == (28, 40, 2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e38, -1e38, 1e9, -80.0, 60.0])
@pytest.mark.parametrize("name", ["means", "log_scales", "quaternions", "logit_opacities", "sh"])
def test_hostile_values_stay_finite_in_every_output(name, value):
    arrays = random_splats(30, 4)
    arrays[name][7] = value
    for view, antialiased in ((perspective, True), (orthographic, False), (orthographic, True)):
        gaussians, camera = Gaussians.from_numpy(arrays), device_camera(view(16, 12))
        dr.enable_grad(*gaussians.parameters().values(), camera.values)
        output = render(gaussians, camera, outputs=OUTPUTS, antialiased=antialiased)
        planes = [*output.color, output.alpha, output.depth, output.median_depth, *output.normal]
        dr.backward(sum((dr.sum(plane) for plane in planes), ad.Float(0)))
        for plane in (*planes, *map(dr.grad, (*gaussians.parameters().values(), camera.values))):
            assert np.isfinite(np.array(plane)).all()


@pytest.mark.threads
@pytest.mark.parametrize("view", VIEWS)
def test_same_input_same_bits(view):
    def run():
        gaussians, camera = Gaussians.from_numpy(random_splats(4000, 2)), device_camera(view(120, 90))
        twist = dr.zeros(ad.Float, 6)
        dr.enable_grad(*gaussians.parameters().values(), twist)
        output = render(gaussians, camera.moved(twist), outputs=OUTPUTS, antialiased=True)
        planes = [*output.color, output.alpha, output.depth, output.median_depth, *output.normal]
        dr.backward(sum((dr.sum(dr.square(plane)) for plane in planes), ad.Float(0)))
        return [np.array(plane) for plane in (*planes, *map(dr.grad, (*gaussians.parameters().values(), twist)))]

    for first, second in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(("count", "size"), [(10, 16), (200_000, 128), (2_000, 2048)])
def test_sizes_and_numbers(view, count, size):
    arrays = random_splats(count, 1, scales=(-6.0, -4.5))
    output = render(
        Gaussians.from_numpy(arrays), device_camera(view(size, size)), outputs=("alpha", "depth", "median_depth")
    )
    alpha, depth, median = (output.image(name) for name in ("alpha", "depth", "median_depth"))
    assert alpha.shape == (size, size)
    assert 0 < alpha.max() <= 1
    nearest = (arrays["means"] @ view().camera_from_world[2, :3] + view().camera_from_world[2, 3]).min()
    for plane in (depth, median):
        assert np.isfinite(plane).all()
        assert plane[plane != 0].min() >= nearest - 1e-4
    assert ((median > 0) == (alpha > 0.5)).mean() > 0.999


@pytest.mark.parametrize("view", VIEWS)
def test_one_giant_over_all_tiles_and_a_crowd_on_one_pixel(view):
    giant = random_splats(1, 1)
    giant["log_scales"][:], giant["logit_opacities"][:], giant["means"][:] = 6.0, 2.0, 0.0
    output = render(Gaussians.from_numpy(giant), device_camera(view(500, 300)), outputs=("alpha", "median_depth"))
    np.testing.assert_allclose(output.image("alpha"), 1 / (1 + np.exp(-2.0)), rtol=1e-3)
    np.testing.assert_allclose(output.image("median_depth"), np.linalg.norm(POSE[:3, 3]), rtol=1e-5)

    crowd = random_splats(10_000, 6)
    crowd["means"][:] *= 1e-6
    crowd["log_scales"][:], crowd["logit_opacities"][:] = -9.0, -5.0
    output = render(Gaussians.from_numpy(crowd), device_camera(view(16, 16)), outputs=("alpha", "median_depth"))
    twin = render_reference(crowd, view(16, 16), 0)
    np.testing.assert_allclose(output.image("alpha"), twin.alpha, atol=2e-5)
    np.testing.assert_allclose(output.image("median_depth"), twin.median_depth, rtol=1e-5)
