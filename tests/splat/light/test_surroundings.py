"""What Gaussians see around them, against rays in float64, and training that goes on from a checkpoint."""

from dataclasses import fields, replace

import drjit as dr
import numpy as np
import pytest
from splats import met_along

from spacesim.backend import ad, memory
from spacesim.backend.upload import upload
from spacesim.data.geometry import fibonacci_sphere, rotation_from_quaternion
from spacesim.splat.light import model as light_module
from spacesim.splat.light import surroundings as surroundings_module
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig, SurfaceConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.surroundings import (
    AWAY,
    EDGE,
    FARTHEST,
    LEAST_RAYS,
    LEVEL,
    MOST_RAYS,
    OPAQUE,
    SKY,
    HeldSurroundings,
    Surfaces,
    are_due,
    look_around,
    ray_count,
)
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.tiles import round_capacity
from spacesim.splat.train.config import preset, with_options
from spacesim.splat.train.trainer import Trainer

RADIUS = 2.0  #: of the models here


def surfaces(count: int, seed: int = 0, size: float = 0.2) -> Surfaces:
    """Discs of all directions in a ball of 1 m, some of which let light through."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.uniform(-0.6, 0.6, (count, 3)),
        "log_scales": np.log(size * rng.uniform(0.3, 1, (count, 3)) * [1, 1, 1e-4]),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.uniform(-2, 4, count),
        "normals": rng.normal(size=(count, 3)),
    }
    return Surfaces(**{name: np.float32(values) for name, values in arrays.items()})


def lit_model(of: Surfaces, emitters: int) -> tuple[LightModel, Gaussians]:
    config = LightConfig(FieldConfig(features=2, width=4, layers=2, inputs=SurfaceConfig()), bounce=emitters)
    arrays = {field.name: getattr(of, field.name) for field in fields(Surfaces)}
    count, normals = len(of.means), arrays.pop("normals")
    features = np.column_stack([np.zeros((count, 2)), normals, np.zeros((count, 3))])
    splats = Gaussians.from_numpy({**arrays, "sh": np.zeros((count, 0, 3)), "features": features})
    return LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, 5.0, RADIUS), 0), splats


def first_met(of: Surfaces, towards: np.ndarray) -> np.ndarray:
    """[N] the first disc that a ray from each Gaussian meets, -1 for none: one pair after another."""
    opacity, scales = 1 / (1 + np.exp(-of.logit_opacities.astype(float))), np.exp(of.log_scales.astype(float))
    axes, reach = rotation_from_quaternion(of.quaternions), np.sqrt(2 * np.log(np.maximum(opacity, OPAQUE) / EDGE))
    normals = of.normals / np.linalg.norm(of.normals, axis=1, keepdims=True)
    two = np.sort(scales, axis=1)[:, 1:]
    away = np.minimum(AWAY * np.sqrt(two.prod(axis=1)), FARTHEST * RADIUS)
    start = of.means + (away * np.where(normals @ towards < 0, -1, 1))[:, None] * normals
    nearest, met = np.full(len(start), np.inf), np.full(len(start), -1)
    for k in np.flatnonzero(opacity > OPAQUE):
        across = axes[k][:, scales[k].argmin()]
        distance = ((of.means[k] - start) @ across) / (towards @ across)
        place = (start + distance[:, None] * towards - of.means[k]) @ axes[k]
        in_plane = np.delete(np.arange(3), scales[k].argmin())
        inside = ((place[:, in_plane] / (reach[k] * scales[k][in_plane])) ** 2).sum(axis=1) < 1
        closer = inside & (distance > 0) & (distance < nearest)
        nearest[closer], met[closer] = distance[closer], k
    return met


def test_rays_meet_what_they_meet_in_float64():
    of, count = surfaces(150), 150
    surroundings = look_around(of, 200, RADIUS)
    found, directions = met_along(surroundings, count, ray_count(200)), fibonacci_sphere(ray_count(200))
    emitters = np.append(np.array(surroundings.emitters), -np.ones(0x8000)).astype(int)
    normals = of.normals / np.linalg.norm(of.normals, axis=1, keepdims=True)
    same, sides, hits = [], [], 0
    for towards, sides_met in zip(directions, found, strict=True):
        met = emitters[sides_met // 2]
        expected = first_met(of, towards)
        same.append((met == expected).mean())
        both = (met == expected) & (met >= 0)
        sides.extend((sides_met % 2 == (normals[met] @ towards > 0))[both])
        hits += (met >= 0).sum()
    assert 0.2 < hits / found.size < 0.9
    assert np.mean(same) > 0.99
    assert np.mean(sides) > 0.999


def test_rays_of_a_side_follow_on_each_other():
    """Those along the surface are on both; first come the Gaussians with most on the side that has fewer."""
    of, count = surfaces(150), 150
    around, directions = look_around(of, 200, RADIUS), fibonacci_sphere(LEAST_RAYS)
    normals = of.normals / np.linalg.norm(of.normals, axis=1, keepdims=True)
    met, bounds = np.array(around.met), np.array(around.bounds).reshape(4, count)
    for normal, (first, behind, past, end) in zip(normals, bounds.T, strict=True):
        cosines = directions[met[first:end] >> 16] @ normal
        along, after = behind - first, past - first
        assert (cosines[:along] > LEVEL - 1e-6).all()
        assert (np.abs(cosines[along:after]) < LEVEL + 1e-6).all()
        assert (cosines[after:] < -LEVEL + 1e-6).all()
    assert (bounds[0, 1:] == bounds[3, :-1]).all()
    fewer = np.minimum(bounds[2] - bounds[0], bounds[3] - bounds[1])
    order = np.array(around.order)
    assert 0 <= fewer.min() < fewer.max()
    assert (np.diff(fewer[order[:count]].astype(int)) <= 0).all()
    np.testing.assert_array_equal(np.sort(order), np.arange(round_capacity(count)))


def test_what_is_no_number_stops_no_ray_and_changes_no_other():
    of, count = surfaces(150), 150
    arrays = {field.name: getattr(of, field.name).copy() for field in fields(Surfaces)}
    hidden = replace(
        of, logit_opacities=np.where((np.arange(count) >= 3) & (np.arange(count) < 9), -9, of.logit_opacities)
    )
    arrays["means"][3, 0], arrays["means"][4, 2], arrays["log_scales"][5, 1] = np.nan, np.inf, np.nan
    arrays["log_scales"][6, 0], arrays["quaternions"][7, 0], arrays["logit_opacities"][8] = 1e30, np.nan, np.nan
    sound, odd = (look_around(one, 200, RADIUS) for one in (hidden, Surfaces(**arrays)))
    expected, found = (np.delete(met_along(one, count, LEAST_RAYS), np.arange(3, 9), axis=1) for one in (sound, odd))
    assert (expected != SKY).mean() > 0.2
    np.testing.assert_array_equal(found, expected)


def test_too_many_rays_for_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr(memory, "LARGE", 0)
    monkeypatch.setattr(memory, "free_memory", lambda needed=0: 2 * LEAST_RAYS * 5 - 1)
    with pytest.raises(MemoryError, match="light that bounces onto 5 Gaussians needs about"):
        look_around(surfaces(5), 10, RADIUS)
    free = [2 * LEAST_RAYS * 5, 3]  # enough for the rays, then not for what they meet
    monkeypatch.setattr(memory, "free_memory", lambda needed=0: free.pop(0))
    with pytest.raises(MemoryError, match="light that bounces onto 5 Gaussians needs about"):
        look_around(surfaces(5), 10, RADIUS)
    assert not free
    with pytest.raises(MemoryError, match="onto 5 Gaussians has more rays than 32 bits"):
        surroundings_module._check_memory(2**32, 5)


def test_few_emitters_stand_for_what_is_near():
    """The same rays meet the same; one of 200 stands for each of 900."""
    of, few = surfaces(900, size=0.1), 200
    every, some = (look_around(of, emitters, RADIUS) for emitters in (1000, few))
    assert ray_count(1000) == ray_count(few)
    numbers = np.array(some.emitters)
    assert numbers.shape == (few,)
    assert len(np.unique(numbers)) > 0.9 * few
    met, stands = (met_along(one, 900, ray_count(few)) for one in (every, some))
    assert ((met == SKY) == (stands == SKY)).all()
    hit = met != SKY
    met, stands = np.array(every.emitters)[met[hit] // 2], numbers[stands[hit] // 2]
    away = np.linalg.norm(of.means[met] - of.means[stands], axis=1)
    assert np.median(away) < 0.4
    normals = of.normals / np.linalg.norm(of.normals, axis=1, keepdims=True)
    assert np.mean((normals[met] * normals[stands]).sum(axis=1)) > 0.2


@pytest.mark.parametrize("emitters", [1, 7, 1024, 1040, 2**14])
def test_rays_are_even_in_number(emitters):
    assert ray_count(emitters) % 2 == 0
    assert LEAST_RAYS <= ray_count(emitters) <= MOST_RAYS


def test_the_same_gaussians_see_the_same_to_the_bit():
    one, other = (look_around(surfaces(500), 100, RADIUS) for _ in range(2))
    np.testing.assert_array_equal(np.array(one.met), np.array(other.met))
    np.testing.assert_array_equal(np.array(one.emitters), np.array(other.emitters))


def test_where_the_world_begins_makes_no_difference():
    of = surfaces(300)
    moved = replace(of, means=of.means + np.float32([64, -512, 32]))
    near, far = (met_along(look_around(one, 400, RADIUS), 300, ray_count(400)) for one in (of, moved))
    assert (near != SKY).mean() > 0.2
    assert (near == far).mean() > 0.99, "but for rounding"


def test_what_takes_seconds_says_so_once(monkeypatch, caplog):
    light, splats = lit_model(surfaces(20), 50)
    monkeypatch.setattr(light_module, "MANY_RAYS", 20 * LEAST_RAYS - 1)
    monkeypatch.setattr(light_module, "select", lambda: "llvm")
    with caplog.at_level("INFO"):
        for sun in np.eye(3):
            light.sunlight(splats, sun)
        for _ in range(2):
            light.hold_surroundings(splats)
            light.sunlight(splats, np.eye(3)[0])
    start = "light that bounces: 0 million rays are traced, "
    assert [record.message for record in caplog.records] == [
        f"{start}once for all pictures",
        f"{start}now and then in training",
    ]


def test_surfaces_of_a_checkpoint_are_checked():
    tensors = surfaces(5).tensors()
    source = np.array([4.0, 4.0, 0.0])
    held = HeldSurroundings.from_tensors({**tensors, "surfaces.source": source}, 3)
    assert held is not None
    for name, values in held.tensors().items():
        np.testing.assert_array_equal(values, tensors.get(name, source))
    assert HeldSurroundings.from_tensors({"means": tensors["surfaces.means"]}, 5) is None
    name = "surfaces.normals"
    with pytest.raises(ValueError, match=r"surfaces\.normals: expected \(5, 3\), found \(4, 3\)"):
        HeldSurroundings.from_tensors({**tensors, name: tensors[name][:4]}, 5)
    for bad in (
        {},
        {"surfaces.source": source[:2]},
        {"surfaces.source": source + 1},
        {"surfaces.source": source * np.nan},
    ):
        with pytest.raises(ValueError, match="expected 3 numbers of 5 Gaussians"):
            HeldSurroundings.from_tensors({**tensors, **bad}, 3)
    with pytest.raises(KeyError, match=r"surfaces\.quaternions"):
        HeldSurroundings.from_tensors({k: v for k, v in tensors.items() if k != "surfaces.quaternions"}, 5)


def test_those_that_come_see_what_they_were_made_of_saw():
    """Twice refined: halves of 7, 3 and 11 gone, with 11 an emitter."""
    of, count = surfaces(40, size=0.4), 40
    held = HeldSurroundings(of)
    whole = held.surroundings(40, RADIUS, count)
    first, second = np.r_[0:7, 8:40, 7, 7], np.delete(np.arange(41), [3, 10])
    for source in (first, second):
        held.follow(upload(source, ad.UInt32))
    parents = first[second]
    now = held.surroundings(40, RADIUS, len(parents))
    rays = ray_count(40)
    np.testing.assert_array_equal(met_along(now, len(parents), rays), met_along(whole, count, rays)[:, parents])
    emitters = np.array(now.emitters)
    expected = [10 if e == 11 else 2 if e == 3 else e for e in np.array(whole.emitters)]
    np.testing.assert_array_equal(parents[emitters], expected)
    assert emitters[7] == np.flatnonzero(parents == 7)[0]
    alone = HeldSurroundings(of, upload(np.array([39], np.uint32), ad.UInt32)).surroundings(40, RADIUS, 1)
    assert (np.array(alone.emitters) == 0).all()


def test_what_is_held_is_of_as_many_gaussians():
    light, splats = lit_model(surfaces(20), 50)
    light.hold_surroundings(HeldSurroundings(surfaces(21)))
    with pytest.raises(ValueError, match="held for 21 Gaussians, found 20"):
        light.surroundings(splats)
    light.hold_surroundings(HeldSurroundings(surfaces(20)))
    assert light.surroundings(splats) is light.surroundings(splats)


@pytest.mark.parametrize(("reset_every", "pause", "steps"), [(2, 10, 20), (2, 0, 20), (10, 10, 51)])
def test_an_opacity_reset_hides_no_surroundings(small_lit_dataset, reset_every, pause, steps):
    """All opacities fall below what stops rays; until they are back, what was seen before them is: after a reset alone,
    one that prunes, one in whose step rays are due."""
    config = with_options(preset("demo", "shadow-map"), iterations=80, init_count=200)
    refinement = replace(config.refinement, refine_every=5, reset_every=reset_every, refine_stop=70, refine_start=5)
    trainer = Trainer(small_lit_dataset, replace(config, refinement=replace(refinement, pause_after_reset=pause)))
    trainer.gaussians.logit_opacities = dr.opaque(ad.Float, 2.0, trainer.gaussians.count)
    assert trainer.light is not None
    while trainer.iteration < steps:
        trainer.step()
    opacities = 1 / (1 + np.exp(-trainer.gaussians.to_numpy()["logit_opacities"]))
    assert opacities.max() < OPAQUE, "reset"
    around = trainer.light.surroundings(trainer.gaussians)
    assert around is not None
    rays = ray_count(trainer.light.config.bounce)
    assert (met_along(around, trainer.gaussians.count, rays) != SKY).mean() > 0.05


def test_rays_are_traced_often_at_first():
    assert [step for step in range(2600) if are_due(step)] == [0, 50, *range(200, 1001, 200), 1500, 2000, 2500]


def test_training_goes_on_to_the_bit_between_two_looks_around(small_lit_dataset, tmp_path):
    """Rays are traced anew after 50 and 200 steps, Gaussians come and go; checkpoints fall in between."""
    config = with_options(preset("demo", "shadow-map"), iterations=230, init_count=200)
    config = replace(config, refinement=replace(config.refinement, refine_every=40, refine_start=30, refine_stop=210))
    straight, stops, counts = Trainer(small_lit_dataset, config), (45, 120, 190), set()
    while straight.iteration < 220:
        straight.step()
        counts.add(straight.gaussians.count)
        if straight.iteration in stops:
            straight.save(tmp_path / f"at_{straight.iteration}")
    assert len(counts) > 1, "no Gaussian has come or gone"
    for stop in stops:
        resumed = Trainer(small_lit_dataset, config)
        resumed.restore(tmp_path / f"at_{stop}")
        while resumed.iteration < 220:
            resumed.step()
        for name, value in straight.gaussians.to_numpy().items():
            np.testing.assert_array_equal(value, resumed.gaussians.to_numpy()[name], err_msg=f"{name} from {stop}")
