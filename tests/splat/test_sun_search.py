"""The Sun of a picture by a model of light, and by shape: against pictures whose Suns are known."""

from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.geometry import fibonacci_sphere, look_at, normalize
from spacesim.data.images import srgb_from_linear
from spacesim.data.records import Camera, Image
from spacesim.splat import sun_search
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import DirectionsConfig, FieldConfig, SurfaceConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import render
from spacesim.splat.sun_search import ShapeSearch, SmallPicture, SunFinder, _SeenPicture

NOTHING = Encoding("harmonics", 0)
MEAN_COSINE = 0.35  #: of pictures that were not taken against the Sun
FIELD = FieldConfig(features=4, width=12, layers=3, inputs=SurfaceConfig(NOTHING, NOTHING))
DIRECTIONS_FIELD = FieldConfig(
    features=4, width=12, layers=3, inputs=DirectionsConfig(Encoding("harmonics", 2), NOTHING)
)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def eye(position=(0.0, -6.0, 1.0), side: int = 48) -> Camera:
    return Camera(look_at(position, [0, 0, 0]), side, side, 1.6 * side, 1.6 * side, side / 2, side / 2)


def ball(count: int = 1500, features: int = 0) -> Gaussians:
    """Flat Gaussians on the unit sphere, shortest axis outwards, grey as under Suns of the near half."""
    rng, normals = np.random.default_rng(3), fibonacci_sphere(count)
    turn = normalize(np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1))
    grey = (float(srgb_from_linear(0.5 * MEAN_COSINE)) - 0.5) / 0.28209479177387814
    arrays = {
        "means": normals,
        "log_scales": np.tile(np.log([0.07, 0.07, 0.004]), (count, 1)),
        "quaternions": turn,
        "logit_opacities": np.full(count, 4.0),
        "sh": np.full((count, 1, 3), grey),
    }
    if features:
        learned = rng.normal(size=(count, features))
        learned[:, -3:] = normals
        arrays |= {"sh": np.zeros((count, 0, 3)), "features": learned}
    return Gaussians.from_numpy(arrays)


def test_sources_of_directions():
    direction = normalize(np.array([0.3, -0.5, 0.7]))
    right, up = sun_search.tangents(direction)
    np.testing.assert_allclose(
        np.stack([right, up, direction]) @ np.stack([right, up, direction]).T, np.eye(3), atol=1e-12
    )
    around = sun_search.ring(direction, 8.0)
    assert [angle(direction, one) for one in around] == pytest.approx([8.0] * sun_search.RING)


def test_the_lowest_place_of_a_paraboloid_is_found():
    best = normalize(np.array([0.1, 0.2, -0.9]))
    right, up = sun_search.tangents(best)
    lowest = normalize(best + 0.04 * right - 0.06 * up)

    def loss(direction: np.ndarray) -> float:
        x, y = direction @ right / (direction @ best) - 0.04, direction @ up / (direction @ best) + 0.06
        return 5 + 300 * x * x + 100 * x * y + 200 * y * y

    around = sun_search.ring(best, 8.0)
    found = sun_search.paraboloid_minimum(best, around, loss(best), [loss(one) for one in around], 8.0)
    assert angle(found, lowest) < 1e-4
    flat = sun_search.paraboloid_minimum(best, around, 1.0, [1.0] * len(around), 8.0)
    np.testing.assert_array_equal(flat, best)


def test_how_sure_a_sun_is():
    """On a plane in closed form: of exp(-(angle / s)^2 / 2 / ALIKE), angles squared are 2 ALIKE s^2."""
    sphere = fibonacci_sphere(40_000)
    losses = 7.0 + 0.5 * (np.degrees(np.arccos(np.clip(sphere @ sphere[123], -1, 1))) / 2.0) ** 2
    assert sun_search.spread(sphere, losses) == pytest.approx(2 * np.sqrt(2 * sun_search.ALIKE), rel=0.01)


def test_a_smooth_path_passes_over_a_picture_that_misleads():
    sphere = fibonacci_sphere(60)
    true = sphere[7]
    losses = np.tile(0.5 * (np.degrees(np.arccos(np.clip(sphere @ true, -1, 1))) / 20) ** 2, (9, 1))
    losses[4] = 0.3 * np.degrees(np.arccos(np.clip(sphere @ -true, -1, 1))) / 20
    assert int(losses[4].argmin()) != 7
    assert sun_search.smoothest(losses, sphere, 5.0) == [7] * 9
    assert sun_search.smoothest(losses, sphere, 1e6) == losses.argmin(axis=1).tolist()


def test_small_pictures_show_the_object_alone():
    image = Image(np.full((90, 120, 3), 0.25, np.float32), np.zeros((90, 120), np.float32), np.ones((90, 120), bool))
    image.alpha[40:60, 10:110] = 1
    camera = eye(side=120)
    camera = replace(camera, height=90)
    small = SmallPicture.of(camera, image, side=64)
    assert (small.camera.width, small.camera.height) == (64, 16)  # of few sizes
    assert small.counts[:10, :50].all()
    assert small.counts.sum() == 10 * 50
    np.testing.assert_allclose(small.rgb[:10, :50], 0.25)
    point = np.array([0.2, -0.1, 0.3, 1.0])  # seen at the same place of the object
    x, y, z = (camera.camera_from_world @ point)[:3]
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    assert (column - 10) / 2 == pytest.approx(small.camera.fx * x / z + small.camera.cx)
    assert (row - 40) / 2 == pytest.approx(small.camera.fy * y / z + small.camera.cy)
    empty = SmallPicture.of(camera, replace(image, alpha=np.zeros_like(image.alpha)), side=64)
    assert not empty.counts.any()


def shaded(sun: np.ndarray, camera: Camera) -> Image:
    """The grey ball of albedo one half under a Sun, Lambertian."""
    drawn = render(ball(), Pinhole.of(camera), outputs=("alpha", "normal"))
    light = 0.5 * (np.maximum(drawn.image("normal") @ sun, 0) + sun_search.AMBIENT)
    alpha = drawn.image("alpha")
    rgb = np.repeat(srgb_from_linear(light)[..., None], 3, axis=2).astype(np.float32)
    return Image(rgb, (alpha > 0.5).astype(np.float32), np.ones(alpha.shape, bool))


def test_shape_and_shading_tell_the_sun():
    """Of a ball, seen from six sides under Suns of the near half: within the lattice's spacing."""
    rng, errors, pictures, suns = np.random.default_rng(0), [], [], []
    for place in 6 * fibonacci_sphere(6):
        sun = normalize(normalize(place) + 0.8 * normalize(rng.normal(size=3)))
        camera = eye(place)
        pictures.append(SmallPicture.of(camera, shaded(sun, camera)))
        suns.append(sun)
    search = ShapeSearch(ball(), False, 6.0)
    losses = search.losses(pictures)
    errors = [angle(search.sphere[row.argmin()], sun) for row, sun in zip(losses, suns, strict=True)]
    assert max(errors) < 14, errors
    assert np.median(search.albedo) == pytest.approx(0.5, rel=0.15)  # of all that is between black and white


def test_the_lowest_place_of_a_parabola_is_found():
    places = np.array([0.0, 1.0, 2.0, 4.0])
    assert sun_search.lowest_between(places, 3 * (places - 1.7) ** 2 - 5) == pytest.approx(1.7)
    assert sun_search.lowest_between(places, places) == 0
    assert sun_search.lowest_between(places, -places) == 4


def model(field: FieldConfig) -> LightModel:
    frame = TrainingFrame(np.zeros(3), 2.0, 6.0, 1.0)
    return LightModel.initial(LightConfig(field), frame, 1)


def test_a_model_tells_the_sun_that_it_was_drawn_with():
    light, splats, camera = model(FIELD), ball(600, FIELD.stored), eye()
    finder = SunFinder(splats, light, False, None)
    for sun in (normalize(np.array([0.5, -0.7, 0.4])), normalize(np.array([-0.6, -0.5, -0.2]))):
        colors, _ = light.shade_picture(splats, Pinhole.of(camera), sun)
        drawn = render(splats, Pinhole.of(camera), outputs=("alpha",), features=colors)
        alpha = drawn.image("alpha")
        rgb = np.clip(drawn.image("features") / np.maximum(alpha, 1e-6)[..., None], 0, 1)
        image = Image(rgb, alpha, np.ones(alpha.shape, bool))
        estimate = finder.estimate(SmallPicture.of(camera, image))
        assert angle(estimate.direction, sun) < 3
        assert estimate.loss < finder._losses(_SeenPicture(SmallPicture.of(camera, image)), [-sun], [None])[0]
        near = finder.estimate(SmallPicture.of(camera, image), finder.near(sun, [0, 7], 32))
        assert angle(near.direction, sun) < 3
        numbers = finder.near(sun, [0, 7], 32)
        assert numbers[:2] == [0, 7]
        assert len(set(numbers)) == 32
        assert max(angle(finder.sphere[k], sun) for k in numbers[2:]) < 40
        assert finder.apart(SmallPicture.of(camera, image)) < 5
        again = SunFinder(splats, light, False, None).estimate(SmallPicture.of(camera, image))
        np.testing.assert_array_equal(again.direction, estimate.direction)


def test_halves_that_two_suns_lit_are_apart():
    light, splats, camera = model(FIELD), ball(600, FIELD.stored), eye()
    finder, planes = SunFinder(splats, light, False, None), []
    suns = normalize(np.array([-0.5, -0.8, 0.1])), normalize(np.array([0.3, -0.5, 0.8]))
    for sun in suns:
        colors, _ = light.shade_picture(splats, Pinhole.of(camera), sun)
        drawn = render(splats, Pinhole.of(camera), outputs=("alpha",), features=colors)
        planes.append(drawn.image("features"))
    alpha = drawn.image("alpha")
    rgb = np.concatenate([planes[0][:, :24], planes[1][:, 24:]], axis=1) / np.maximum(alpha, 1e-6)[..., None]
    picture = SmallPicture.of(camera, Image(np.clip(rgb, 0, 1), alpha, np.ones(alpha.shape, bool)))
    assert finder.apart(picture) == pytest.approx(angle(*suns), abs=10)
    for counts in (np.zeros_like(picture.counts), np.ones_like(picture.counts)):  # nothing seen, nothing cut out
        assert np.isnan(finder.apart(replace(picture, counts=counts)))


@pytest.mark.parametrize("field", [FIELD, DIRECTIONS_FIELD], ids=["surface", "directions"])
def test_the_gradient_by_the_sun_is_that_of_the_colors(field):
    """Against central differences of the colours, along the sphere."""
    from spacesim.backend.upload import upload

    light, splats, camera = model(field), ball(400, field.stored), Pinhole.of(eye())
    sun, rng = normalize(np.array([0.4, -0.8, 0.3])), np.random.default_rng(2)
    grad_color = rng.normal(size=(3, splats.count))

    def loss(direction: np.ndarray) -> float:
        colors = light.shade(splats, camera, direction).colors
        return float((np.array(colors, np.float64) * grad_color).sum())

    shading = light.shade(splats, camera, sun)
    back = light.adjoint(shading, [upload(row) for row in grad_color], by_sun=True)
    gradient = np.array(back.sun[0], np.float64)
    for tangent in sun_search.tangents(sun):
        step = 0.002 * tangent
        slope = (loss(normalize(sun + step)) - loss(normalize(sun - step))) / 0.004
        assert gradient @ tangent == pytest.approx(slope, rel=0.02, abs=0.02 * np.linalg.norm(gradient))
    assert light.adjoint(shading, [upload(row) for row in grad_color]).sun == []
