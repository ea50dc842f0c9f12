"""A run and a composed scene are asked for the same things, in the same words."""

import inspect
import re

import numpy as np
import pytest
from splats import random_splats

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.methods import load_predictor
from spacesim.nerf.run import NerfRun
from spacesim.splat.compose import ComposedRun, GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.aligned import AlignedRun
from spacesim.splat.compose.run import PlacedModel
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import render
from spacesim.splat.run import ComposedModel, Predictor, Run, check_gaussians

CAMERA = Camera.from_fov(look_at((0, -4, 0), (0, 0, 0)), 24, 16, 40)
SUN = Sun.from_angles(45, 30)


def words_of(function) -> list[tuple]:
    """Names, kinds, defaults and annotations of what a method is asked with."""
    return [(p.name, p.kind, p.default, p.annotation) for p in inspect.signature(function).parameters.values()]


@pytest.fixture
def run(tmp_path) -> Run:
    model = Gaussians.from_numpy(random_splats(40))
    return Run(tmp_path / "run", {"method": "vanilla"}, {}, model, 1000)


@pytest.fixture
def scene(run, tmp_path) -> ComposedRun:
    models = [PlacedRun(run, name="left"), PlacedRun(run, Pose(translation=[2.0, 0, 0]), "right")]
    return ComposedRun(GaussianComposition(models), tmp_path / "scene.toml")


@pytest.mark.parametrize("kind", [Run, AlignedRun, ComposedRun, GaussianComposition])
def test_predict_is_asked_in_the_same_words(kind):
    assert words_of(kind.predict) == words_of(Predictor.predict)
    assert words_of(kind.draw_material) == words_of(Predictor.draw_material)


@pytest.mark.parametrize(
    ("kind", "protocol"),
    [
        (Run, Predictor),
        (AlignedRun, Predictor),
        (ComposedRun, Predictor),
        (NerfRun, Predictor),
        (PlacedModel, ComposedModel),
    ],
)
def test_all_that_is_asked_for_is_there(kind, protocol):
    asked = {name for base in protocol.__mro__ for name in vars(base) if not name.startswith("_")}
    assert len(asked) > 3
    assert asked <= {*dir(kind), *kind.__dataclass_fields__}


def test_a_run_has_no_parts_and_a_scene_those_of_its_models(run, scene):
    assert run.parts == ()
    left, right = scene.parts
    assert (left.name, right.name) == ("left", "right")
    assert isinstance(right.gaussians, Gaussians)
    assert np.allclose(right.centre - left.centre, [2, 0, 0])
    assert np.allclose(np.array(right.gaussians.means) - np.array(left.gaussians.means), [[2], [0], [0]], atol=1e-6)
    assert right.antialiased is run.antialiased


def test_runs_and_what_they_draw_are_shown_in_a_line(run, scene):
    assert repr(run) == f"Run({str(run.path)!r}: vanilla, 40 Gaussians)"
    assert repr(run.predict(CAMERA)) == "Prediction(24 x 16 pixels: rgb, alpha, depth)"
    assert re.fullmatch(
        r"ComposedPrediction\(24 x 16 pixels: rgb, alpha, depth.*, id\)", repr(scene.predict(CAMERA, SUN))
    )
    drawn = render(run.gaussians, Pinhole.of(CAMERA), outputs=("depth",))
    assert repr(drawn) == "RenderOutput(24 x 16 pixels: alpha, depth)"


def test_a_run_of_gaussians_is_distinguished_from_a_scene(run, scene):
    assert run.gaussian_run is AlignedRun(run, Pose(scale=2.0)).gaussian_run is check_gaussians(run) is run
    assert scene.gaussian_run is None
    with pytest.raises(InputError, match="run: expected one of Gaussians, found one of the method vanilla"):
        check_gaussians(scene)
    for predictor in (run, scene):
        with pytest.raises(InputError, match="embedding: expected"):
            predictor.with_embedding(np.zeros(3))


def test_both_refuse_an_exposure_of_srgb_values(run, scene):
    for predictor in (run, scene):
        with pytest.raises(InputError, match="exposure"):
            predictor.predict(CAMERA, SUN, exposure=1.0)
        assert predictor.predict(CAMERA, SUN, exposure=None).rgb.shape == (16, 24, 3)


def test_a_scene_file_is_a_predictor_by_its_suffix(tmp_path):
    for name in ("none.toml", "none"):
        with pytest.raises(InputError, match=name):
            load_predictor(tmp_path / name)
