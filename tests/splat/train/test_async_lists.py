"""Lists made without a wait: the same training to the bit, whatever the forecasts are worth."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad, select
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import make_boxes
from spacesim.splat.raster.lists.capacity import Extent
from spacesim.splat.raster.lists.tiles import round_capacity
from spacesim.splat.raster.project import Footprints, Pinhole, project
from spacesim.splat.train import async_lists, view_pass
from spacesim.splat.train.async_lists import ENOUGH, HISTORY, PairForecast, TrainingPairs
from spacesim.splat.train.config import TrainConfig, preset
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.trainer import Trainer

REFINEMENT = DensificationConfig(
    refine_start=20, refine_every=30, pause_after_reset=0, reset_every=4, refine_stop=240, screen_size_stop=0
)
CONFIG = TrainConfig(iterations=300, checkpoint_every=100, sh_every=40, sh_degree=1, refinement=REFINEMENT)


def known(changes: list[float], pairs: int = 1000) -> PairForecast:
    """A forecast that has seen a view "a" once and other views change so."""
    forecast = PairForecast()
    forecast.observe("a", pairs)
    for i, change in enumerate(changes):
        forecast.observe(i, 10_000)
        forecast.observe(i, round(change * 10_000))
    return forecast


def test_capacity_follows_the_largest_recent_change():
    assert known([1.0, 1.5, 1.2, 0.5], 10_000).capacity_for("a") == round_capacity(int(1.02 * 15_000))
    later = known([1.5] + [1.1] * HISTORY, 10_000)
    assert later.capacity_for("a") == round_capacity(int(1.02 * 1.1 * 10_000))


def test_capacity_is_unknown_without_history():
    assert known([1.0] * (ENOUGH - 1)).capacity_for("a") is None
    forecast = known([1.0] * ENOUGH)
    assert forecast.capacity_for("a") is not None
    assert forecast.capacity_for("new") is None
    forecast.observe("a", 0)
    assert forecast.capacity_for("a") is None  # it shows nothing: nobody knows how much it will show


def test_capacity_after_a_refinement_follows_views_seen_since():
    forecast = known([1.0] * ENOUGH, 10_000)
    for view in range(ENOUGH + 1):
        forecast.observe(view, 10_000)
    forecast.after_refinement()
    assert forecast.capacity_for("a") is None
    for view in range(ENOUGH):
        assert forecast.capacity_for(ENOUGH) is None
        forecast.observe(view, 20_000)
    assert forecast.capacity_for(ENOUGH) == round_capacity(int(1.02 * 20_000))
    assert forecast.capacity_for(0) is None  # seen since
    for view in range(ENOUGH):
        forecast.observe(view, 20_000)
    assert forecast.capacity_for(0) == round_capacity(int(1.02 * 20_000))


class Counted(TrainingPairs):
    """Counts lists that were made without a wait, of which kinds of pictures, and steps whose lists were too small."""

    def __init__(self, backends: tuple[str, ...]) -> None:
        super().__init__(backends)
        self.made, self.again, self.kinds = 0, 0, set()

    def all_fit(self):
        self.made += len(self.pending)
        self.kinds |= {kind for kind, one in self.forecasts.items() if any(p.forecast is one for p in self.pending)}
        fits = super().all_fit()
        self.again += not fits
        return fits


def trained(dataset, config, steps: int, lists: TrainingPairs, start=None) -> tuple[Trainer, list[float]]:
    trainer = Trainer(dataset, config)
    if start is not None:
        trainer.restore(start)
    trainer._view_pass.pairs = lists
    return trainer, [float(trainer.step()[0]) for _ in range(steps)]


def check_same(one: Trainer, other: Trainer) -> None:
    for tensors, others in (one.model_tensors(), other.model_tensors()), (one.state_tensors(), other.state_tensors()):
        assert tensors.keys() == others.keys()
        for name, values in tensors.items():
            np.testing.assert_array_equal(values, others[name], err_msg=name)


@pytest.fixture
def tight(monkeypatch):
    """Every third forecast is of ten pairs."""
    calls, capacity_for = [], PairForecast.capacity_for

    def too_little(self, view):
        calls.append(view)
        capacity = capacity_for(self, view)
        return capacity if capacity is None or len(calls) % 3 else 10

    monkeypatch.setattr(async_lists.PairForecast, "capacity_for", too_little)


@pytest.mark.threads
def test_asynchronous_lists_train_to_the_same_bits(small_dataset, tmp_path):
    plain, losses = trained(small_dataset, CONFIG, 300, Counted(()))
    free, other = trained(small_dataset, CONFIG, 300, lists := Counted((select(),)))
    assert lists.made > 200
    assert lists.again < 10
    assert plain.gaussians.count != 60  # refined
    assert other == losses
    check_same(plain, free)

    half, _ = trained(small_dataset, CONFIG, 145, Counted((select(),)))
    half.save(tmp_path / "checkpoint.safetensors")
    on, other = trained(small_dataset, CONFIG, 155, lists := Counted((select(),)), tmp_path / "checkpoint.safetensors")
    assert lists.made > 90
    assert other == losses[145:]
    check_same(plain, on)


@pytest.mark.threads
@pytest.mark.usefixtures("tight")
def test_steps_with_too_small_lists_are_taken_again(small_dataset):
    plain, losses = trained(small_dataset, CONFIG, 150, Counted(()))
    free, other = trained(small_dataset, CONFIG, 150, lists := Counted((select(),)))
    assert lists.again > 30
    assert other == losses
    check_same(plain, free)


@pytest.mark.threads
@pytest.mark.parametrize(("method", "wrong"), [("shadow-map", False), ("shadow-map", True), ("shadow-splat", True)])
def test_shadows_and_networks_learn_the_same_to_the_bit(small_lit_dataset, method, wrong, request, monkeypatch):
    monkeypatch.setattr(view_pass, "WIDE", 0)  # on CUDA, too, these networks leave out who is hidden
    if wrong:
        request.getfixturevalue("tight")
    config = replace(preset("demo", method), iterations=300, init_count=200, refinement=REFINEMENT)
    plain, losses = trained(small_lit_dataset, config, 70, Counted(()))
    free, other = trained(small_lit_dataset, config, 70, lists := Counted((select(),)))
    assert lists.kinds == {"sun", "picture", "shown"}
    assert (lists.again > 10) == wrong
    assert other == losses
    check_same(plain, free)


def test_asynchronous_lists_of_several_views_train_to_the_same_bits(small_dataset):
    config = replace(CONFIG, views_per_step=2)
    plain, losses = trained(small_dataset, config, 40, Counted(()))
    free, other = trained(small_dataset, config, 40, lists := Counted((select(),)))
    assert lists.made > 40
    assert other == losses
    check_same(plain, free)


def test_an_emptied_picture_has_an_empty_list():
    """Lists of nobody have a form of their own, which the forecast cannot give."""
    camera = Camera.from_fov(look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0]), 40, 40, 40)
    splats, boxes = project(Gaussians.from_numpy(random_splats(50, 0, degree=0)), Pinhole.of(camera))
    dr.eval(splats, boxes)
    lists, extent = TrainingPairs((select(),)), Extent(50, 40, 40)

    def capacity(view: int, footprints: Footprints) -> int:
        boxes = make_boxes(splats, footprints, extent.live, extent.most, extent.grid)
        pairs = lists.of_view("picture", view)
        if (expected := pairs.expected(extent)) is None:
            return pairs.counted(extent, boxes)
        pairs.check(extent, boxes.pair_ends, expected)
        return expected

    for view in [*range(ENOUGH + 1)] * 2:
        assert capacity(view, boxes) > 0
    assert len(lists.pending) > 0
    assert lists.all_fit()
    hidden = replace(boxes, visible=dr.opaque(ad.Bool, False, 50))
    assert capacity(0, hidden) > 0
    assert not lists.all_fit()
    with lists.synchronous():
        assert capacity(0, hidden) == 0
    assert lists.all_fit()


def test_where_a_forecast_does_not_fit_into_memory_pairs_are_counted(small_dataset, monkeypatch):
    """A forecast may say more than there are."""

    lists = Counted((select(),))
    trainer, _ = trained(small_dataset, CONFIG, 19, lists)
    assert lists.made > 0
    monkeypatch.setattr(async_lists, "has_memory", lambda *_: False)
    made = lists.made
    trainer.step()
    assert lists.made == made


def test_lists_are_asynchronous_on_cuda_alone():
    assert TrainingPairs().is_async == (select() == "cuda")
    assert not TrainingPairs(()).is_async
