"""One bounce of light, against the known case of two surfaces. Its float64 reference is in test_light.py."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images import srgb_from_linear
from spacesim.data.records import Camera
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import FieldConfig, SurfaceConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig
from spacesim.splat.light.surroundings import EDGE
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.config import PRESETS, preset, with_options
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

NONE = Encoding("harmonics", 0)
FIELD = FieldConfig(features=2, width=4, layers=2, inputs=SurfaceConfig())
GLOW = LightConfig(FIELD, bounce=4096)  # 512 rays
SIDE = 40  #: Gaussians on a side of a square wall


def numbers(plane) -> np.ndarray:
    return np.array(plane, dtype=np.float64)


def discs(places: np.ndarray, normals: np.ndarray, spacing: float, albedo: float) -> dict[str, np.ndarray]:
    """Thin opaque Gaussians about `places` [N, 3], across `normals` [N, 3], whose discs just cover squares of
    `spacing`."""
    opacity = 1 / (1 + np.exp(-6))
    scale = 0.8 * spacing / np.sqrt(2 * np.log(opacity / EDGE))
    logit = np.log(albedo / (1 - albedo))
    turns = [Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_quat(scalar_first=True) for normal in normals]
    count = len(places)
    return {
        "means": places,
        "log_scales": np.log(np.tile([scale, scale, 1e-4], (count, 1))),
        "quaternions": np.array(turns),
        "logit_opacities": np.full(count, 6.0),
        "sh": np.zeros((count, 0, 3)),
        "features": np.column_stack([np.zeros((count, 2)), normals, np.full((count, 3), logit)]),
    }


def joined(*parts: dict[str, np.ndarray]) -> Gaussians:
    return Gaussians.from_numpy({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def square(spacing: float) -> np.ndarray:
    """[SIDE^2, 2] places on a square about 0."""
    line = (np.arange(SIDE) - 0.5 * (SIDE - 1)) * spacing
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def model(config: LightConfig = GLOW) -> LightModel:
    return LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, 5.0, 3.0), 0)


def wall_and_receiver(place, normal, albedo: float = 0.5) -> Gaussians:
    """A square wall, 2 m wide, in the plane z = 0 that faces up, and one small Gaussian."""
    spacing = 2.0 / SIDE
    wall = np.column_stack([square(spacing), np.zeros(SIDE * SIDE)])
    up = np.tile([0.0, 0, 1], (len(wall), 1))
    receiver = discs(np.array([place], float), np.array([normal], float), 1e-4, albedo)
    return joined(discs(wall, up, spacing, albedo), receiver)


def form_factor(height: float, half: float) -> float:
    """Of a piece that faces the middle of a square at `height`: four corners, each of half by half (Howell, B-3)."""
    x = half / height
    root = np.sqrt(1 + x * x)
    return 4 * (x / root * np.arctan(x / root)) / np.pi


@pytest.mark.parametrize(("height", "within"), [(0.3, 0.02), (1.0, 0.03), (2.0, 0.07)])
def test_a_wall_lights_what_faces_it_as_its_form_factor_says(height, within):
    """But for the solid angles of rays at its edges."""
    splats = wall_and_receiver([0, 0, height], [0, 0, -1])
    light = model().sunlight(splats, np.array([0.0, 0, 1]))
    assert light.visibility is None
    found = np.array([numbers(row)[-1] for row in light.bounced])
    expected = 0.5 * form_factor(height, 1.0)  # albedo, the Sun straight above
    np.testing.assert_allclose(found[:3], expected, rtol=within)
    np.testing.assert_allclose(found[3:], 0, atol=1e-6)  # its other side sees black sky


def test_what_stands_between_hides_light():
    """A black square half as far away as the wall, which covers all of it, then a quarter of it."""
    whole = wall_and_receiver([0, 0, 0.8], [0, 0, -1])
    spacing, up = 1.0 / SIDE, np.array([0.0, 0, 1])
    shares = []
    for middle in ((0.0, 0.0), (0.55, 0.55)):
        places = np.column_stack([square(1.1 * spacing) + middle, np.full(SIDE * SIDE, 0.4)])
        between = discs(places, np.tile([0.0, 0, 1], (len(places), 1)), 1.1 * spacing, 1e-6)
        parts = {name: np.concatenate([between[name], values]) for name, values in whole.to_numpy().items()}
        light = [model().sunlight(one, up).bounced[0] for one in (whole, Gaussians.from_numpy(parts))]
        shares.append(numbers(light[1])[-1] / numbers(light[0])[-1])
    assert shares[0] < 0.02
    assert shares[1] == pytest.approx(0.75, abs=0.06)


def test_light_goes_with_the_cosine_of_the_sun_and_a_sample_is_as_bright_as_all():
    splats = wall_and_receiver([0.2, 0.1, 0.8], [0, 0, -1])
    high, low = np.array([0.0, 0, 1]), np.array([np.sin(1.2), 0, np.cos(1.2)])
    whole = [numbers(model(GLOW).sunlight(splats, sun).bounced[0])[-1] for sun in (high, low)]
    assert whole[1] == pytest.approx(whole[0] * np.cos(1.2), rel=1e-4)
    part = numbers(model(replace(GLOW, bounce=150)).sunlight(splats, high).bounced[0])[-1]
    assert part == pytest.approx(whole[0], rel=0.1)
    behind = numbers(model(GLOW).sunlight(splats, -high).bounced[0])[-1]
    assert behind == pytest.approx(0, abs=1e-6), "lit from below it shines down, away from the receiver"


def test_what_lies_in_shadow_scatters_nothing():
    """A roof over the wall: what stands beside it sees the wall's light go out."""
    shadow = ShadowConfig(SplattingConfig(), 128, refine=None)
    spacing = 2.0 / SIDE
    roof = np.column_stack([square(1.5 * spacing), np.full(SIDE * SIDE, 2.0)])
    black = discs(roof, np.tile([0.0, 0, 1], (len(roof), 1)), 1.5 * spacing, 0.001)
    places = np.array([[0.0, 0, 0.8]])
    wall = np.column_stack([square(spacing), np.zeros(SIDE * SIDE)])
    parts = [discs(wall, np.tile([0.0, 0, 1], (len(wall), 1)), spacing, 0.5)]
    receiver = discs(places, np.array([[0.0, 0, -1]]), 1e-4, 0.5)
    lit = model(replace(GLOW, shadow=shadow))
    up = np.array([0.0, 0, 1])
    free, covered = (
        numbers(lit.sunlight(joined(*parts, *more, receiver), up).bounced[0])[-1] for more in ([], [black])
    )
    assert free > 0.1
    assert covered < 0.1 * free


@pytest.mark.parametrize("gloss", [False, True])
def test_turning_all_together_changes_little(gloss):
    """The rays do not turn with it."""
    splats, light = wall_and_receiver([0.3, -0.2, 0.6], [0.3, 0.1, -0.9]), model()
    if gloss:
        splats, light = shining(splats, 0.2)
        light.weights = model(light.config).weights
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    arrays = splats.to_numpy()
    arrays["means"] = turn.apply(arrays["means"])
    quaternions = turn * Rotation.from_quat(arrays["quaternions"], scalar_first=True)
    arrays["quaternions"] = quaternions.as_quat(scalar_first=True)
    arrays["features"][:, 2:5] = turn.apply(arrays["features"][:, 2:5])
    sun = np.array([0.48, -0.36, 0.8])
    one, other = light.sunlight(splats, sun), light.sunlight(Gaussians.from_numpy(arrays), turn.apply(sun))
    rows = [[numbers(row) for row in light.bounced] for light in (one, other)]
    np.testing.assert_allclose(*rows, rtol=0.02, atol=1e-4)


def test_a_picture_is_brighter_by_what_arrives_at_the_side_that_is_seen():
    """Linear colours: what one bounce adds is albedo times the light at that side."""
    splats = wall_and_receiver([0, 0, 0.7], [0, 0, 1])
    plain, glowing = (model(LightConfig(FIELD, linear=True, bounce=bounce)) for bounce in (0, 500))
    glowing.weights = plain.weights
    up, count = np.array([0.0, 0, 1]), splats.count
    bounced = glowing.sunlight(splats, up).bounced
    for height, side in ((3.0, 0), (0.4, 1)):
        camera = Pinhole.of(Camera(look_at([0.01, 0, height], [0, 0, 0.7]), 8, 8, 8, 8, 4, 4))
        bare = replace_features(splats, count)
        before, after = plain.shade_picture(bare, camera, up)[0], glowing.shade_picture(splats, camera, up)[0]
        for c in range(3):
            more = numbers(after[c])[-1] - numbers(before[c])[-1]
            assert more == pytest.approx(0.5 * numbers(bounced[3 * side + c])[-1], abs=1e-5)
    assert numbers(bounced[3])[-1] > 0.05 > numbers(bounced[0])[-1]


def replace_features(splats: Gaussians, count: int) -> Gaussians:
    """Without albedos."""
    arrays = splats.to_numpy()
    return Gaussians.from_numpy({**arrays, "features": arrays["features"][:, :5]})


def shining(splats: Gaussians, specular: float, **more) -> tuple[Gaussians, LightModel]:
    """With this specular reflectance, and a field that paints everything a linear 0.6."""
    arrays = splats.to_numpy()
    logit = np.full((splats.count, 3), np.log(specular / (1 - specular)))
    arrays["features"] = np.column_stack([arrays["features"], logit])
    light = model(LightConfig(FIELD, bounce=GLOW.bounce, gloss=True, linear=True, **more))
    light.weights = [ad.Float(0) * weight for weight in light.weights]
    value = srgb_from_linear(np.float64(0.6))
    light.weights[-1] = ad.Float([float(np.log(value / (1 - value)))] * 3)
    return Gaussians.from_numpy(arrays), light


def mirrored(normal: np.ndarray, view: np.ndarray, specular: float, is_wall) -> float:
    """Integral of GGX of alpha 0.15 over the directions in which there is a wall, of 1; Kelemen's visibility, Schlick's
    reflectance with all of it from 0.04 on at grazing incidence."""
    towards = fibonacci_sphere(400_000)
    towards = towards[is_wall(towards) & (towards @ normal > 0)]
    half = towards + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    facing, across = half @ normal, half @ view
    facets = 0.15**2 / (np.pi * (facing**2 * (0.15**2 - 1) + 1) ** 2)
    reflectance = specular + (min(specular / 0.04, 1) - specular) * (1 - across) ** 5
    return float((reflectance * facets * (towards @ normal) / (4 * across**2)).sum() * 4 * np.pi / 400_000)


@pytest.mark.parametrize("specular", [0.01, 0.5])
@pytest.mark.parametrize("tilt", [0.0, 0.5, np.pi])
def test_a_mirror_shows_what_it_faces(specular, tilt):
    """Over a wall, across its lobe, or turned to black space."""
    up, normal = np.array([0.0, 0, 1]), np.array([np.sin(tilt), 0, -np.cos(tilt)])
    splats, light = shining(wall_and_receiver([0, 0, 0.2], normal), specular)
    camera = Pinhole.of(Camera(look_at(np.array([1e-3, 0, 0.2]) + 3 * normal, [0, 0, 0.2]), 8, 8, 8, 8, 4, 4))
    found = mirror_in(splats, light, camera, up)
    below = mirrored(normal, normal, specular, lambda d: (d[:, 2] < 0) & (np.abs(d[:, :2]).max(axis=1) < -5 * d[:, 2]))
    assert found == pytest.approx(0.6 * below, rel=0.08, abs=1e-4)
    assert (below > 0.5 * specular) == (tilt < 1)


def mirror_in(splats: Gaussians, light: LightModel, camera: Pinhole, sun: np.ndarray) -> float:
    """What the last Gaussian mirrors, of a red of 0.6 that all paint."""
    shown = numbers(light.shade_picture(splats, camera, sun)[0][0])[-1]
    return shown - 0.6 - 0.5 * numbers(light.sunlight(splats, sun).bounced[0])[-1]


def test_a_glossy_surface_mirrors_most_at_grazing_angles():
    """Glass seen at 75 degrees that stands before a wall: several times its 0.04 at normal incidence."""
    turn, wall = Rotation.from_euler("y", 90, degrees=True), wall_and_receiver([0, 0, 0], [0, 0, 1]).to_numpy()
    wall["means"][:-1] = turn.apply(wall["means"][:-1]) - np.array([0.7, 0, 0])
    quaternions = turn * Rotation.from_quat(wall["quaternions"][:-1], scalar_first=True)
    wall["quaternions"][:-1] = quaternions.as_quat(scalar_first=True)
    wall["features"][:-1, 2:5] = [1, 0, 0]
    splats, light = shining(Gaussians.from_numpy(wall), 0.04)
    view = np.array([np.sin(np.radians(75)), 0, np.cos(np.radians(75))])
    camera = Pinhole.of(Camera(look_at(3 * view, [0, 0, 0]), 8, 8, 8, 8, 4, 4))
    found = mirror_in(splats, light, camera, np.array([1.0, 0, 0]))

    def is_wall(towards: np.ndarray) -> np.ndarray:
        return (towards[:, 0] < 0) & (np.abs(towards[:, 1:]).max(axis=1) < -towards[:, 0] / 0.7)

    expected = mirrored(np.array([0.0, 0, 1]), view, 0.04, is_wall)
    assert expected > 3 * 0.04
    assert found == pytest.approx(0.6 * expected, rel=0.1)


@pytest.mark.parametrize("gloss", [False, True])
def test_light_bounces_from_where_other_models_leave_sunlight(gloss):
    """A receiver in their shadow is lit as before by a wall in the Sun, and by none of a wall that they shade."""
    splats, up = wall_and_receiver([0, 0, 0.3], [0, 0, -1]), np.array([0.0, 0, 1])
    light = model()
    if gloss:
        splats, light = shining(splats, 0.5)
        light.config = replace(light.config, linear=True)
    camera = Pinhole.of(Camera(look_at([0.01, 0, -3], [0, 0, 0.3]), 8, 8, 8, 8, 4, 4))

    def lit(of_wall: float, of_receiver: float) -> tuple[np.ndarray, np.ndarray]:
        """(what bounces onto the receiver, its colour) where so much of the Sun is left to each."""
        share = np.full(splats.count, of_wall)
        share[-1] = of_receiver
        behind = light.arriving(splats, up, upload(share))
        np.testing.assert_allclose(numbers(behind.visibility), share, atol=1e-6)
        colors, visibility = light.shade_picture(splats, camera, up, behind)
        assert visibility is not None
        return np.array([numbers(row)[-1] for row in behind.bounced]), np.array([numbers(c)[-1] for c in colors])

    alone = light.sunlight(splats, up)
    whole, color = lit(1, 1)
    np.testing.assert_allclose(whole, [numbers(row)[-1] for row in alone.bounced], rtol=1e-6)
    np.testing.assert_allclose(color, [numbers(c)[-1] for c in light.shade_picture(splats, camera, up)[0]], rtol=1e-5)
    assert whole[:3].min() > 0.1
    shaded, color = lit(1, 0)
    np.testing.assert_allclose(shaded, whole, rtol=1e-6)
    assert color.min() > 0.02, "no sunlight, but what the wall scatters"
    np.testing.assert_allclose(lit(0.25, 1)[0], 0.25 * whole, rtol=1e-5)
    dark, color = lit(0, 0)
    assert np.abs(dark).max() == np.abs(color).max() == 0
    np.testing.assert_array_equal(numbers(light.sunlight(splats, up).bounced[0]), numbers(alone.bounced[0]))


@pytest.mark.parametrize(
    "change",
    [
        "two in one place",
        "no normal",
        "no size",
        "vast",
        "not a number",
        "one Gaussian",
        "sun along the wall",
        "sun below",
    ],
)
@pytest.mark.parametrize("gloss", [False, True])
def test_odd_models_stay_finite(change, gloss):
    arrays = wall_and_receiver([0, 0, 0.5], [0, 0, -1]).to_numpy()
    sun = np.array([0.0, 0, 1])
    if change == "two in one place":
        arrays["means"][:] = 0
    elif change == "no normal":
        arrays["features"][:, 2:5] = 0
    elif change == "no size":
        arrays["log_scales"][:] = -60
    elif change == "vast":
        arrays["log_scales"][:, 0] = 60
    elif change == "not a number":
        arrays["means"][7], arrays["features"][9], arrays["logit_opacities"][11] = np.nan, np.nan, np.nan
    elif change == "one Gaussian":
        arrays = {name: values[:1] for name, values in arrays.items()}
    else:
        sun = np.array([1.0, 0, 0] if change == "sun along the wall" else [0.0, 0, -1])
    splats, lit = Gaussians.from_numpy(arrays), model()
    rows = lit.sunlight(splats, sun).bounced
    if gloss:
        splats, lit = shining(splats, 0.5)
        lit.weights = model(lit.config).weights
        camera = Pinhole.of(Camera(look_at([0.3, 0.2, -3], [0, 0, 0.3]), 8, 8, 8, 8, 4, 4))
        rows = [*lit.sunlight(splats, sun).bounced, *lit.shade_picture(splats, camera, sun)[0]]
    for row in rows:
        assert len(numbers(row)) == len(arrays["means"])
        odd = np.isin(np.arange(len(numbers(row))), [7, 9]) & (change == "not a number")  # what they receive themselves
        assert np.isfinite(numbers(row)[~odd]).all()
        assert (numbers(row)[~odd] >= 0).all()


def test_training_learns_albedos_and_repeats_to_the_bit(small_lit_dataset, tmp_path):
    config = with_options(preset("demo", "shadow-splat"), iterations=150, init_count=300)
    assert config.light.bounce > 0
    runs = [train(small_lit_dataset, tmp_path / name, config) for name in ("one", "two")]
    assert len({(run.path / "model.safetensors").read_bytes() for run in runs}) == 1
    learned = runs[0].gaussians.to_numpy()["features"][:, config.light.albedos :]
    assert learned.shape[1] == 6
    start = Trainer(small_lit_dataset, config).gaussians.to_numpy()["features"][:, config.light.albedos :]
    for rows in (slice(3), slice(3, 6)):  # albedos, specular reflectances
        assert np.ptp(start[:, rows]) == 0
        assert np.ptp(learned[:, rows]) > 0.05
    frame, arrays = small_lit_dataset.test[0], runs[0].gaussians.to_numpy()
    arrays["features"][:, config.light.albedos :] = -30  # black
    black = replace(runs[0], gaussians=Gaussians.from_numpy(arrays)).predict(frame.camera, frame.sun)
    lit = runs[0].predict(frame.camera, frame.sun)
    assert np.isfinite(lit.rgb).all()
    assert (lit.rgb >= black.rgb - 1e-6).all()
    assert (lit.rgb - black.rgb).max() > 1e-3


@pytest.mark.parametrize("emitters", [2000, 1600, 400])
def test_one_that_is_not_a_number_lights_nobody(emitters):
    """A receiver over a wall, one of which is broken: as bright as before, less that."""
    splats = wall_and_receiver([0, 0, 0.5], [0, 0, -1])
    light, up = model(replace(GLOW, bounce=emitters)), np.array([0.0, 0, 1])
    before = numbers(light.sunlight(splats, up).bounced[0])[-1]
    for name, value in (("logit_opacities", np.nan), ("log_scales", np.nan), ("log_scales", np.inf), ("means", np.inf)):
        arrays = splats.to_numpy()
        arrays[name][800] = value
        found = numbers(light.sunlight(Gaussians.from_numpy(arrays), up).bounced[0])[-1]
        assert found == pytest.approx(before, rel=0.02), name


@pytest.mark.parametrize("emitters", [100, 400])
def test_a_vast_one_hides_nothing(emitters):
    """What is larger than the model is no surface of it."""
    splats = wall_and_receiver([0, 0, 0.5], [0, 0, -1])
    arrays, up = splats.to_numpy(), np.array([0.0, 0, 1])
    before, *others = (
        numbers(model(replace(GLOW, bounce=emitters)).sunlight(Gaussians.from_numpy(each), up).bounced[0])[-1]
        for each in (arrays, vast(arrays, 8), vast(arrays, 15))
    )
    assert others == pytest.approx([before, before], rel=0.02)


def vast(arrays: dict[str, np.ndarray], size: float) -> dict[str, np.ndarray]:
    log_scales = arrays["log_scales"].copy()
    log_scales[800, :2] = size
    return {**arrays, "log_scales": log_scales}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_bounce_where_shadows_are_known(name):
    for method in ("relight", "park"):
        assert preset(name, method).light.bounce == 0
    for method in ("shadow-map", "shadow-splat"):
        light = preset(name, method).light
        assert (light.bounce > 0) == light.gloss == (name != "thesis")
        assert (light.refine is None) == ((name, method) == ("demo", "shadow-map"))
        if light.refine:
            assert light.refine.sun.size == (25 if name == "thesis" else 1)
            assert light.refine.positions == ("light" if name == "thesis" else "world")


def test_impossible_bounces_are_named():
    with pytest.raises(InputError, match=r"bounce: expected 0 or light\.field\.inputs=surface"):
        LightConfig(FieldConfig(), bounce=10)
    for bounce in (-1, 2**14 + 1):
        with pytest.raises(InputError, match=f"bounce: expected 0 to 16384, found {bounce}"):
            LightConfig(FIELD, bounce=bounce)
