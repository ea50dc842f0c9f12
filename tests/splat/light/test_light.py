"""Networks and their adjoints against a float64 reference; what light does to training, checkpoints and predictions."""

import json
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from splats import light_of, met_along, srgb_of

from spacesim.backend import ad, select
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images import linear_from_srgb, load_image, srgb_from_linear
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.data.store import read_points, write_points
from spacesim.learning.networks import fused, tensor_cores
from spacesim.learning.networks.network import MlpShape
from spacesim.splat.export.bake import bake
from spacesim.splat.light import bounce, bounce_text
from spacesim.splat.light import model as light_module
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import DirectionsConfig, FieldConfig, SurfaceConfig, ViewAloneConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading import forward as shading_forward
from spacesim.splat.light.shading import pictures
from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig
from spacesim.splat.light.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig
from spacesim.splat.light.shadow.splatting import occlusion_by_splatting
from spacesim.splat.light.surroundings import ray_count
from spacesim.splat.raster import tone
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians, gather_entries
from spacesim.splat.raster.lists import pictures as picture_lists
from spacesim.splat.raster.lists.tiles import round_capacity
from spacesim.splat.raster.render import render, view_colors
from spacesim.splat.raster.seen import Chosen
from spacesim.splat.run import Run, draw_lit, load_run
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import METHODS, PRESETS, LearningRates, TrainConfig, preset
from spacesim.splat.train.loss.terms import anisotropy
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.strategies.densify import grow, prune
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

SUN = np.array([0.48, -0.36, 0.8])
EARTH = Earth(np.array([-0.6, -0.5, -0.6]), 60.0, albedo=0.9)
ECLIPSE = Earth([0.48, -0.6, 0.64], np.degrees(np.arccos(0.48**2 + 0.36 * 0.6 + 0.8 * 0.64)) - 0.1)  #: two thirds seen
ENCODINGS = {"sun": Encoding("harmonics", 2), "view": Encoding("positional", 1)}
FIELD = FieldConfig(features=5, width=12, layers=3, inputs=DirectionsConfig(**ENCODINGS))
ON_SURFACE = replace(FIELD, inputs=SurfaceConfig(**ENCODINGS))
REFINE = ShadowRefinementConfig(features=3, width=8, sun=Encoding("harmonics", 1))
CONFIGS = {
    "relight": LightConfig(FIELD),
    "map": LightConfig(FIELD, ShadowConfig(MappingConfig(), 32, refine=REFINE)),
    "splat": LightConfig(FIELD, ShadowConfig(SplattingConfig(), 32, refine=None)),
    "linear": LightConfig(FIELD, linear=True),
    "older linear": LightConfig(FIELD, linear=True, encoded=False),
    "radiance": LightConfig(FIELD, ShadowConfig(SplattingConfig(), 32, refine=None), linear=True, radiance=True),
    "surface": LightConfig(ON_SURFACE, ShadowConfig(MappingConfig(), 32, grazing="lift", refine=REFINE)),
    "printed": LightConfig(  # 4.13 as the thesis has it
        FIELD, ShadowConfig(SplattingConfig(), 32, refine=replace(REFINE, residual=False))
    ),
    "bounce": LightConfig(ON_SURFACE, ShadowConfig(SplattingConfig(), 32, refine=REFINE), bounce=7),
    "bounce, linear": LightConfig(ON_SURFACE, bounce=5, linear=True),
    "gloss": LightConfig(
        ON_SURFACE, ShadowConfig(SplattingConfig(), 32, refine=REFINE), bounce=7, gloss=True, earth=True
    ),
    "gloss, embeddings": LightConfig(replace(ON_SURFACE, embeddings=2), bounce=5, gloss=True),
    "gloss, linear": LightConfig(
        ON_SURFACE, bounce=5, gloss=True, earth=True, linear=True, tone="filmic", exposure=1.0
    ),
    "earth": LightConfig(ON_SURFACE, ShadowConfig(SplattingConfig(), 32, refine=REFINE), bounce=7, earth=True),
    "earth, linear": LightConfig(ON_SURFACE, earth=True, linear=True),
    "all": LightConfig(
        ON_SURFACE,
        ShadowConfig(SplattingConfig(), 32, refine=REFINE),
        bounce=7,
        gloss=True,
        earth=True,
        linear=True,
        radiance=True,
    ),
    "no sun": LightConfig(replace(FIELD, inputs=ViewAloneConfig(ENCODINGS["view"]))),
    "embeddings": LightConfig(replace(FIELD, embeddings=4)),
    "no sun, embeddings": LightConfig(replace(FIELD, inputs=ViewAloneConfig(ENCODINGS["view"]), embeddings=1)),
    "map, embeddings": LightConfig(replace(ON_SURFACE, embeddings=3), ShadowConfig(MappingConfig(), 32, refine=REFINE)),
    "park": LightConfig(
        FIELD,
        ShadowConfig(
            SplattingConfig(), 32, bias=0.0, refine=replace(REFINE, positions="world", positional=2, bias_info=False)
        ),
    ),
}


def numbers(plane) -> np.ndarray:
    return np.array(plane, dtype=np.float64)


def gaussians(count: int, features: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians.from_numpy(
        {
            "means": rng.normal(size=(count, 3)),
            "log_scales": rng.uniform(-3, -1, (count, 3)),
            "quaternions": rng.normal(size=(count, 4)),
            "logit_opacities": rng.normal(size=count),
            "sh": np.zeros((count, 0, 3)),
            "features": rng.normal(size=(count, features)),
        }
    )


def eye() -> Pinhole:
    return Pinhole.of(Camera(look_at([0, -6, 1], [0, 0, 0]), 32, 32, 40, 40, 16, 16))


def model(name: str, seed: int = 0) -> LightModel:
    """With a refinement that does something, and embeddings of five pictures: these and its last layer start at 0."""
    light = LightModel.initial(CONFIGS[name], TrainingFrame(np.array([0.1, 0.2, -0.3]), 2.0, 7.0, 3.0), seed, 5)
    rng = np.random.default_rng(seed)
    light.weights = [upload(numbers(w) + 0.3 * rng.normal(size=dr.width(w))) for w in light.weights]
    light.embeddings = [upload(rng.normal(size=dr.width(every))) for every in light.embeddings]
    return light


def embedding_of(light: LightModel, picture: int | None = None) -> np.ndarray:
    """[E] of a training picture, or the mean one; [0] of a model without."""
    every = light.tensors().get("light.embeddings", np.zeros((5, 0))).astype(np.float64)
    return every.mean(axis=0) if picture is None else every[picture]


# ---- a float64 reference, from the equations ----


def encoded(encoding: Encoding, vectors: np.ndarray) -> np.ndarray:
    """[N, size] by scipy and by numpy."""
    if encoding.kind == "positional":
        waves = [f(2**k * np.pi * vectors) for k in range(encoding.degree) for f in (np.sin, np.cos)]
        # sine and cosine of each coordinate stand side by side
        pairs = [np.stack(waves[2 * k : 2 * k + 2], axis=-1).reshape(len(vectors), 6) for k in range(encoding.degree)]
        return np.concatenate([vectors, *pairs], axis=1)
    polar, azimuth = np.arccos(np.clip(vectors[:, 2], -1, 1)), np.arctan2(vectors[:, 1], vectors[:, 0])
    terms = []
    for degree in range(encoding.degree + 1):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth) * (1 if order == 0 else np.sqrt(2))
            terms.append(value.imag if order < 0 else value.real)
    return np.stack(terms, axis=1)


def network(shape: MlpShape, weights: list[np.ndarray], items: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """[N, outputs]."""
    value = items
    for i, (rows, columns) in enumerate(shape.sizes):
        bias = weights[2 + 2 * i] + (weights[0].reshape(rows, -1) @ shared if i == 0 else 0)
        value = value @ weights[1 + 2 * i].reshape(rows, columns).T + bias
        if i < shape.layers - 1:
            value = np.maximum(value, 0)
    return value


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def cosines(normal: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """[N, 8]: of the side that is seen with the Sun (and where that is positive), the viewer, and halfway between."""
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign((normal * direction).sum(axis=1, keepdims=True))
    half = SUN - direction
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lambert = normal @ SUN
    halfway = np.maximum((normal * half).sum(axis=1), 0)
    lobes = [halfway**n for n in (8, 32, 128, 512)]
    return np.stack([lambert, np.maximum(lambert, 0), -(normal * direction).sum(axis=1), halfway, *lobes], axis=1)


def shortest_axes(arrays: dict) -> np.ndarray:
    turns = Rotation.from_quat(arrays["quaternions"], scalar_first=True).as_matrix()
    return turns[np.arange(len(turns)), :, arrays["log_scales"].argmin(axis=1)]


def bounced(light: LightModel, arrays: dict, visibility: np.ndarray, paint) -> np.ndarray:
    """[N, 3] light of what is seen from the side that is seen, one ray after another; with gloss [N, 9], then what each
    mirrors per specular reflectance at normal and at grazing incidence. What the rays meet is given: it is in
    test_surroundings.py. paint: the field's colours of some Gaussians seen along directions [M, 3]"""
    config, count = light.config, len(arrays["means"])
    features, first = arrays["features"].astype(np.float64), config.field.features
    normals = features[:, first : first + 3] / np.linalg.norm(features[:, first : first + 3], axis=1, keepdims=True)
    albedo, found = sigmoid(features[:, config.albedos : config.albedos + 3]), np.zeros((3, count, 3))
    if not config.bounce:
        return np.zeros((count, 9 if config.gloss else 3))
    surroundings, rays = light.surroundings(Gaussians.from_numpy(arrays)), ray_count(config.bounce)
    met = met_along(surroundings, count, rays)
    scattered = np.zeros((0x10000, 3))  # of the sides of emitters, and of the sky
    for number, k in enumerate(np.array(surroundings.emitters)):
        back = normals[k] @ SUN < 0
        lit = -normals[k] if back else normals[k]
        emitted = albedo[k] * visibility[k] * (lit @ SUN)
        if config.gloss:
            colors = visibility[k] * paint(np.full(4, k), four_sides(lit))
            emitted = (colors if config.linear else light_of(colors)).mean(axis=0)
        scattered[2 * number + back] = emitted
    view = np.array([0, -6, 1.0]) - arrays["means"]
    seen = normals * np.sign((normals * view).sum(axis=1, keepdims=True))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    angle, alpha2 = 4 * np.pi / rays, 0.15**2 + 1 / rays
    for towards, sides in zip(fibonacci_sphere(rays), met, strict=True):
        emitted, cosine = scattered[sides], np.maximum(seen @ towards, 0)[:, None]
        found[0] += emitted * angle / np.pi * cosine
        half = towards + view
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        facing, across = (seen * half).sum(axis=1)[:, None], (half @ towards)[:, None]
        facets = alpha2 / (np.pi * (facing**2 * (alpha2 - 1) + 1) ** 2)
        mirrored = facets * cosine / (4 * across**2) * angle
        found[1] += emitted * mirrored * (1 - (1 - across) ** 5)
        found[2] += emitted * mirrored * (1 - across) ** 5
    return np.concatenate(found, axis=1) if config.gloss else found[0]


def four_sides(normal: np.ndarray) -> np.ndarray:
    """[4, 3] from viewers at 45 degrees to a unit `normal`, off its plane with the Sun by 45 degrees about it."""
    along = SUN - (SUN @ normal) * normal
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    around = [along + across, across - along, -along - across, along - across]
    return -(normal + np.array(around) / np.sqrt(2)) / np.sqrt(2)


def brightened(light: LightModel, color: np.ndarray, more: np.ndarray) -> np.ndarray:
    if light.config.linear:
        return color + more
    return srgb_of(light_of(color) + more)


def twin(
    light: LightModel,
    arrays: dict,
    weights: list[np.ndarray],
    raw: list[np.ndarray],
    given=None,
    embedding=None,
    earth=EARTH,
) -> tuple:
    """(colours [N, 3], visibility [N] as it is shown, light that bounces) of 4.2, 4.11 to 4.14 and 4.17; raw: occlusion
    and bias info as given; given: light that bounces, instead of that of these numbers; embedding: the mean one
    where none is given."""
    config, field = light.config, light.config.field
    left = earth.visible_sun(SUN) if field.knows_sun else 1
    direction = arrays["means"] - np.array([0, -6, 1.0])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    features, split = arrays["features"].astype(np.float64), 1 + 2 * field.layers
    own = embedding_of(light) if embedding is None else embedding
    shared = np.concatenate([encoded(field.sun, SUN[None])[0], own])
    normal = features[:, field.features : field.stored]

    def paint(some: np.ndarray, direction: np.ndarray) -> np.ndarray:
        items = np.concatenate([features[some, : field.features], encoded(field.view, direction)], axis=1)
        if field.surface:
            items = np.concatenate([items, cosines(normal[some], direction)], axis=1)
        value = sigmoid(network(field.shape, weights[:split], items, shared))
        if not config.linear or not config.encoded:
            return value
        if not config.radiance:
            return light_of(value)
        value *= 1 + 1.055 / 2.4 * np.log(16)
        return np.where(value < 1, light_of(np.minimum(value, 1)), np.exp((value - 1) * 2.4 / 1.055)) / 16

    faces = 1
    if field.surface:
        learned, of_shape = (cosines(n, direction)[:, 0] for n in (normal, shortest_axes(arrays)))
        faces = np.interp(np.maximum(learned, of_shape), [-0.15, 0], [0, 1])
    color = paint(np.arange(len(direction)), direction)
    if not raw:
        visible = np.ones(len(color))
        color, given = with_scattered(light, arrays, eclipsed(light, color, left), visible, given, earth, paint)
        return color, visible, given
    occlusion, alignment, thickness, bias = raw
    if config.refine:
        refine = config.refine
        position = (arrays["means"] - light.frame.centre) / light.frame.scale
        if refine.positions == "light":
            axes = numbers(light.encode_sun(SUN).light_axes).reshape(3, 3)
            np.testing.assert_allclose(axes[2], -SUN, atol=1e-6)
            position = position @ axes.T
        columns = [occlusion[:, None], features[:, field.stored : config.albedos]]
        columns.append(encoded(Encoding("positional", refine.positional), position))
        if refine.bias_info:
            scale = light.frame.scale
            columns += [column[:, None] for column in (1 - occlusion, alignment, thickness / scale, bias / scale)]
        items = np.concatenate(columns, axis=1)
        output = network(refine.shape, weights[split:], items, encoded(refine.sun, SUN[None])[0])[:, 0]
        sure = np.clip(occlusion, 0.02, 0.98)
        occlusion = sigmoid(output + (np.log(sure / (1 - sure)) if refine.residual else 0))
    color = eclipsed(light, color * (1 - occlusion)[:, None], left)
    color, given = with_scattered(light, arrays, color, 1 - occlusion, given, earth, paint)
    return color, left * (1 - occlusion) * faces, given


def eclipsed(light: LightModel, color: np.ndarray, left: float) -> np.ndarray:
    if left == 1 or light.config.linear:
        return left * color
    return np.maximum(left * color, left ** (1 / 2.4) * (color + 0.055) - 0.055)


def earthlit(light: LightModel, arrays: dict, earth: Earth = EARTH) -> np.ndarray:
    """[N, 1] irradiance of the side that is seen, one beam after another."""
    first, towards = light.config.field.features, np.array([0, -6, 1.0]) - arrays["means"]
    normals = arrays["features"][:, first : first + 3].astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.sign((normals * towards).sum(axis=1, keepdims=True))
    return sum(power * np.maximum(normals @ beam, 0) for *beam, power in earth.beams(SUN))[:, None]


def with_scattered(
    light: LightModel, arrays: dict, color: np.ndarray, visible: np.ndarray, given, earth, paint
) -> tuple:
    """(colours, light that bounces): as they are for a model without bounce and Earth."""
    config = light.config
    if not (config.bounce or config.earth):
        return color, None
    given = bounced(light, arrays, visible, paint) if given is None else given
    logits = arrays["features"].astype(np.float64)[:, config.albedos :]
    unit = 2**config.curve.exposure / config.curve.white if config.gloss and config.linear else 1
    more = earth.visible_sun(SUN) * given[:, :3] + (unit * earthlit(light, arrays, earth) if config.earth else 0)
    reflected = sigmoid(logits[:, :3]) * more
    if config.gloss:
        specular = sigmoid(logits[:, 3:])
        mirrored = specular * given[:, 3:6] + np.minimum(specular / 0.04, 1) * given[:, 6:]
        reflected = reflected + earth.visible_sun(SUN) * mirrored
    return brightened(light, color, reflected), given


@pytest.fixture(params=["the backend's way", "all at once", "hidden layers in between"])
def _products(request, monkeypatch) -> None:
    """As networks are computed: by a kernel each on a CPU, in one recording, and as those of 128 units and more on
    CUDA; on a CPU other products stand for those of its tensor cores."""
    if request.param == "the backend's way":
        return
    monkeypatch.setattr(fused, "takes", lambda shape: False)
    if request.param == "all at once":
        monkeypatch.setattr(tensor_cores, "takes", lambda shape, columns: False)
        return
    monkeypatch.setattr(tensor_cores, "WIDE", 1)
    if select() == "llvm":
        monkeypatch.setattr(tensor_cores, "is_usable", lambda: True)
        monkeypatch.setattr(tensor_cores, "select", lambda: "cuda")
        monkeypatch.setattr(tensor_cores, "_launch", launched)


def launched(kind, factors, shape, sizes, beside=None):
    """In place of `tensor_cores._launch`."""
    rows, columns, depth, batch = sizes[:4]
    if kind == "outer":
        first, second = (numbers(factor).reshape(batch, -1, depth) for factor in factors)
        parts = np.array_split(np.einsum("bmk,bnk->bmn", first, second), sizes[4])
        result = np.stack([part.sum(axis=0) for part in parts])
    else:
        matrix, columns_of = numbers(factors[0]), numbers(factors[1]).reshape(batch, depth, columns)
        matrix = matrix.reshape(depth, rows).T if kind == "back" else matrix.reshape(rows, depth)
        result = matrix @ columns_of
        if kind == "hidden":
            result = np.maximum(result + numbers(beside)[:, None], 0)
        elif beside is not None:
            result = np.where(numbers(beside).reshape(shape) > 0, result, 0)
    assert result.shape == shape
    return ad.TensorXf(upload(result.ravel()), shape)


@pytest.mark.usefixtures("_products")
@pytest.mark.parametrize(
    ("name", "earth"),
    [
        *((name, EARTH) for name in CONFIGS),
        ("earth", ECLIPSE),
        ("gloss", ECLIPSE),
        ("bounce, linear", ECLIPSE),
        ("no sun", ECLIPSE),
    ],
)
def test_shading_and_its_adjoint_match_the_equations_in_float64(name, earth):
    light, count = model(name), 37
    splats = gaussians(count, light.config.features)
    arrays = {key: value.astype(np.float64) for key, value in splats.to_numpy().items()}
    weights = [numbers(weight) for weight in light.weights]
    shadows = light.shadows(splats, SUN)
    raw = [numbers(row) for row in (shadows.occlusion, *shadows.info)] if shadows else []
    own = embedding_of(light, 3)
    shading = light.shade(splats, eye(), SUN, picture=3, earth=earth)
    color, visibility, given_light = twin(light, arrays, weights, raw, embedding=own, earth=earth)
    assert not light.config.bounce or np.abs(given_light).max() > 0.01
    assert not light.config.earth or earthlit(light, arrays).max() > 0.1
    np.testing.assert_allclose(np.stack([numbers(c) for c in shading.colors], axis=1), color, atol=5e-5, rtol=1e-4)
    assert (shading.visibility is None) == (light.config.shadow is None)
    if shading.visibility is not None:
        np.testing.assert_allclose(numbers(shading.visibility), visibility, atol=3e-5)

    rng = np.random.default_rng(5)
    grad_color, grad_visibility = rng.normal(size=(count, 3)), rng.normal(size=count) * bool(raw)
    given = upload(grad_visibility) if raw else None
    back = light.adjoint(shading, [upload(column) for column in grad_color.T], given)

    def loss(arrays: dict, weights: list[np.ndarray], own: np.ndarray = own) -> float:
        color, visibility, _ = twin(light, arrays, weights, raw, given_light, own, earth)
        return float((grad_color * color).sum() + grad_visibility @ visibility)

    for _ in range(6):  # along random directions, all numbers at once
        step = rng.normal(size=arrays["features"].shape)
        slope = difference(lambda h, s=step: loss({**arrays, "features": arrays["features"] + h * s}, weights))
        assert numbers(back.features).reshape(-1, count).T.ravel() @ step.ravel() == pytest.approx(
            slope, rel=2e-3, abs=2e-3
        )
    for i, weight in enumerate(weights):
        step = rng.normal(size=weight.shape)
        slope = difference(
            lambda h, i=i, s=step: loss(arrays, [w + h * s * (j == i) if j == i else w for j, w in enumerate(weights)])
        )
        assert numbers(back.weights[i]) @ step == pytest.approx(slope, rel=2e-3, abs=2e-3), i
    assert len(back.embeddings) == bool(light.config.field.embeddings)
    for every in back.embeddings:
        gradient = numbers(every).reshape(5, -1)
        for unit in np.eye(len(own)):
            slope = difference(lambda h, s=unit: loss(arrays, weights, own=own + h * s))
            assert gradient[3] @ unit == pytest.approx(slope, rel=2e-3, abs=2e-3)
        assert np.abs(gradient[3]).max() > 0.01
        assert not gradient[[0, 1, 2, 4]].any(), "of the other pictures"


@pytest.mark.usefixtures("_products")
def test_gradients_of_what_is_shaded_go_through_networks():
    if select() == "cuda":
        pytest.skip("there Dr.Jit does not differentiate the loop of the last layer, in neither way")
    light, splats = model("relight"), gaussians(37, FIELD.features)
    dr.enable_grad(splats.means)
    shading = light.shade(splats, eye(), SUN, picture=3)
    dr.backward(dr.sum(sum(shading.colors, ad.Float(0))))
    assert np.abs(numbers(dr.grad(splats.means))).sum() > 1


def chosen(indices: np.ndarray, count: int) -> Chosen:
    """In arrays as long as training's."""
    length = round_capacity(count)
    places = np.full(length, length, np.uint32)
    places[indices] = np.arange(len(indices))
    padded = np.pad(indices.astype(np.uint32), (0, length - len(indices)))
    return Chosen(dr.opaque(ad.UInt32, len(indices)), upload(padded, ad.UInt32), upload(places, ad.UInt32))


@pytest.mark.usefixtures("_products")
@pytest.mark.parametrize("name", CONFIGS)
def test_of_chosen_gaussians_light_and_its_adjoint_are_as_of_all(name):
    light, rng = model(name), np.random.default_rng(2)
    for count, some in ((37, 20), (61, 33), (61, 1), (1_100, 1_024), (2_100, 30)):  # recordings are replayed
        splats = gaussians(count, light.config.features, seed=count)
        indices = np.sort(rng.choice(count, some, replace=False))
        batch = PaddedBatch.of_chosen(chosen(indices, count), round_capacity(some), count)
        every = light.shade(splats, eye(), SUN, picture=3, earth=EARTH)
        these = light.shade(splats, eye(), SUN, picture=3, earth=EARTH, batch=batch)
        gradients = np.zeros((4, count))
        gradients[:, indices] = rng.normal(size=(4, some))
        back = []
        for shading in (every, these):
            given = None if shading.visibility is None else upload(gradients[3])
            back.append(light.adjoint(shading, [upload(row) for row in gradients[:3]], given))
        pairs = list(zip(every.colors, these.colors, strict=True))
        if every.visibility is not None:
            pairs.append((every.visibility, these.visibility))
        for whole, part in pairs:
            expected = np.zeros(count)
            expected[indices] = numbers(whole)[indices]
            np.testing.assert_allclose(numbers(part), expected, atol=1e-6)
        scale = np.abs(numbers(back[0].features)).max()
        np.testing.assert_allclose(numbers(back[1].features), numbers(back[0].features), atol=1e-5 * scale)
        for one, other in zip(
            [*back[0].weights, *back[0].embeddings], [*back[1].weights, *back[1].embeddings], strict=True
        ):
            np.testing.assert_allclose(numbers(other), numbers(one), atol=1e-5 * max(np.abs(numbers(one)).max(), 1e-3))


def test_of_more_chosen_gaussians_than_there_is_room_for_the_first_are_lit():
    """The host hears of it a step later, and takes the step again."""
    light, count = model("map"), 3_000
    splats, few = gaussians(count, light.config.features), chosen(np.arange(1, count, 2), count)
    batch = PaddedBatch.of_chosen(few, 1_024, count)
    shading = light.shade(splats, eye(), SUN, batch=batch)
    lit = numbers(shading.colors[0]) > 0
    assert lit[1:2048:2].all()
    assert not lit[2048:].any()
    gradients = light.adjoint(shading, [dr.opaque(ad.Float, 1, count) for _ in range(3)])
    assert np.isfinite(numbers(gradients.features)).all()


def test_rays_of_a_turn_are_summed_up_one_after_another(monkeypatch):
    """CUDA takes some at once."""
    light, splats = model("gloss"), gaussians(300, model("gloss").config.features)
    around, emitters = light.surroundings(splats), light.config.bounce
    scatterers = bounce.Scatterers(splats.features, light.config.field.features, light.config.albedos, ad.Array3f(SUN))
    emitted = [upload(np.random.default_rng(5).uniform(size=8 * emitters))]
    batch, received = PaddedBatch.of(300), []
    parts = bounce.Parts(front=True, mirrored=True)
    for turn in (1, 3, 4):
        monkeypatch.setattr(bounce, "TURN", dict.fromkeys(bounce.TURN, turn))
        rows = bounce.received_on_seen(
            scatterers,
            around,
            emitted,
            emitters,
            batch,
            directions=lambda rays: eye().directions_to(rays.repeat_last(splats.means)),
            parts=parts,
        )
        received.append(np.stack([numbers(row) for row in rows]))
    assert (received[0][:, :300].max(axis=1) > 0).all()
    np.testing.assert_array_equal(received[1], received[0])
    np.testing.assert_array_equal(received[2], received[0])


@pytest.mark.threads
@pytest.mark.usefixtures("kernels_of_text")
@pytest.mark.parametrize("count", [1, 63, 300])
def test_light_along_rays_is_the_same_by_a_kernel_of_text(count):
    light, splats = model("gloss"), gaussians(300, model("gloss").config.features)
    around, emitters = light.surroundings(splats), light.config.bounce
    scatterers = bounce.Scatterers(splats.features, light.config.field.features, light.config.albedos, ad.Array3f(SUN))
    emitted = [upload(np.random.default_rng(5).uniform(size=8 * emitters))]
    numbers_of = np.arange(300 - count, 300)  # the last, whose rays are at the end of an array, among them
    batch = PaddedBatch.of_chosen(chosen(numbers_of, 300), 512, 300)

    def directions(rays: PaddedBatch):
        return eye().directions_to(rays.repeat_last(splats.means))

    every = [bounce.BOTH_SIDES, *(bounce.Parts(front, False, mirrored) for front, mirrored in ((1, 0), (0, 1), (1, 1)))]
    for parts in every:
        if parts is bounce.BOTH_SIDES:
            usual = bounce.received_on_sides(scatterers, around, emitted, emitters, batch)
            rays = bounce.rays_on_sides(scatterers, around, batch)
        else:
            usual = bounce.received_on_seen(scatterers, around, emitted, emitters, batch, directions, parts)
            rays = bounce.rays_on_seen(scatterers, around, batch, directions(batch))
        found = bounce_text.gather_light(around, emitted, emitters, rays, parts)
        assert len(found) == len(usual) == 3 * parts.count
        exact = np.stack([numbers(row)[:count] for row in usual])
        assert exact.max() > 0
        np.testing.assert_allclose(np.stack([numbers(row)[:count] for row in found]), exact, rtol=2e-5, atol=1e-7)


@pytest.mark.usefixtures("kernels_of_text")
@pytest.mark.parametrize("name", ["relight", "map", "gloss"])
def test_a_cpu_launches_networks_and_rays(name, monkeypatch):
    light, launched = model(name), []
    for module, function in (
        *((fused, kernel) for kernel in ("forward", "backward", "outputs")),
        *((module, "gather_light") for module in (shading_forward, pictures)),
    ):
        usual = getattr(module, function)
        monkeypatch.setattr(module, function, lambda *of, f=function, u=usual: launched.append(f) or u(*of))

    def launches() -> list[str]:
        names = sorted(launched)
        launched.clear()
        return names

    splats, refined, bounces = gaussians(60, light.config.features), bool(light.config.refine), light.config.bounce > 0
    painted, rays = ["outputs"] * light.config.mirrors, ["gather_light"] * bounces
    shading = light.shade(splats, eye(), SUN)
    assert launches() == sorted(["forward"] * (1 + refined) + painted + rays)
    light.adjoint(shading, [dr.opaque(ad.Float, 1, 60) for _ in range(3)])
    assert launches() == ["backward"] * (1 + refined)
    light.shade_picture(splats, eye(), SUN)
    of_mirrors = ["gather_light"] * light.config.mirrors
    assert launches() == sorted(["outputs"] * (1 + refined) + painted + rays + of_mirrors)


@pytest.mark.parametrize("name", ["bounce", "gloss"])
def test_pictures_change_with_the_light_that_arrives(name):
    """What bounces, too; launches know of no gradients."""
    light, share = model(name), np.random.default_rng(1).uniform(0.3, 0.7, 37)
    splats = gaussians(37, light.config.features)

    def shown(visibility) -> list:
        return light.shade_picture(splats, eye(), SUN, light.arriving(splats, SUN, visibility))[0]

    visibility, h = upload(share), 1e-2
    dr.enable_grad(visibility)
    dr.set_grad(visibility, ad.Float(1))
    rows = shown(visibility)
    dr.enqueue(dr.ADMode.Forward, visibility)
    dr.traverse(dr.ADMode.Forward)
    more, less = (np.stack([numbers(row) for row in shown(upload(share + step))]) for step in (h, -h))
    slopes = (more - less) / (2 * h)
    assert np.abs(slopes).max() > 0.01
    np.testing.assert_allclose(np.stack([numbers(dr.grad(row)) for row in rows]), slopes, rtol=0.02, atol=2e-3)


def difference(function) -> float:
    h = 1e-6
    return (function(h) - function(-h)) / (2 * h)


@pytest.mark.parametrize("kind", [("harmonics", 0), ("harmonics", 4), ("positional", 0), ("positional", 4)])
def test_encodings_are_those_of_scipy_and_numpy(kind):
    encoding = Encoding(*kind)
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(50, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    ours = encoding(ad.Array3f(vectors.T.astype(np.float32)))
    assert len(ours) == encoding.size
    rows = np.stack([numbers(row) + np.zeros(50) for row in ours], axis=1)
    expected = encoded(encoding, vectors)
    signs = np.sign((rows * expected).sum(axis=0))  # conventions differ in the sign of a harmonic
    np.testing.assert_allclose(rows, expected * (signs if encoding.kind == "harmonics" else 1), atol=2e-5)
    np.testing.assert_allclose(numbers(encoding.of_one(vectors[3])), rows[3], atol=2e-5)


def test_a_sun_that_stays_is_asked_for_once():
    light = model("map")
    splats = gaussians(60, light.config.features)
    first = light.sunlight(splats, SUN)
    assert light.sunlight(splats, SUN.copy()) is first, "computed again for another camera"
    moved = light.sunlight(splats, -SUN)
    assert moved is not first
    splats.means += 0.1  # in place
    changed = light.sunlight(splats, -SUN)
    assert changed is not moved
    light.weights[-1] = light.weights[-1] + 1
    assert light.sunlight(splats, -SUN) is not changed
    dr.enable_grad(splats.log_scales)
    assert light.sunlight(splats, -SUN) is not light.sunlight(splats, -SUN), "gradients would be lost"


@pytest.mark.parametrize("way", ["the backend's", "in one recording", "by vectors"])
@pytest.mark.parametrize("name", CONFIGS)
def test_pictures_have_the_colors_that_are_trained(monkeypatch, name, way):
    by_vectors = way == "by vectors"
    monkeypatch.setattr(light_module, "COOPERATIVE", ("cuda", "llvm") if by_vectors else ())
    if way == "in one recording":
        monkeypatch.setattr(fused, "takes", lambda shape: False)
    made, cache = [], light_module._PictureCache
    monkeypatch.setattr(light_module, "_PictureCache", lambda *parts: made.append(parts) or cache(*parts))
    light, tolerance = model(name), 2e-3 if by_vectors else 1e-5
    if light.config.decoding:  # what the network is off, times the slope of what decodes it
        tolerance *= 2.4
    splats = gaussians(700, light.config.features)
    other_eye = Pinhole.of(Camera(look_at([5, 2, 1], [0, 0, 0]), 32, 32, 40, 40, 16, 16))

    def same(camera, sun: np.ndarray, earth: Earth = EARTH) -> None:
        colors, visibility = light.shade_picture(splats, camera, sun, earth=earth)
        trained = light.shade(splats, camera, sun, earth=earth)
        for one, other in zip(colors, trained.colors, strict=True):
            np.testing.assert_allclose(numbers(one), numbers(other), atol=tolerance)
        assert (visibility is None) == (trained.visibility is None)
        if visibility is not None:
            np.testing.assert_allclose(numbers(visibility), numbers(trained.visibility), atol=1e-6)

    same(eye(), SUN)
    assert len(made) == 1
    same(other_eye, -SUN)
    same(other_eye, SUN, ECLIPSE)
    assert len(made) == 1, "computed again for another Sun"
    splats.features += 0.5  # in place
    same(eye(), SUN)
    assert len(made) == (1 if by_vectors else 2)
    light.embeddings = [every + 0.5 for every in light.embeddings]
    same(eye(), SUN)
    light.weights[1] = light.weights[1] * 2
    same(eye(), SUN)
    splats = gaussians(40, light.config.features, seed=3)
    same(eye(), SUN)


def test_an_untrained_refinement_passes_raw_shadows_on():
    light = LightModel.initial(CONFIGS["map"], TrainingFrame(np.zeros(3), 1.0, 5.0, 3.0), 0)
    splats = gaussians(200, light.config.features)
    raw = numbers(light.shadows(splats, SUN).occlusion)
    refined = 1 - numbers(light.shade(splats, eye(), SUN).visibility)
    np.testing.assert_allclose(refined, np.clip(raw, 0.02, 0.98), atol=1e-5)


def test_a_refinement_as_printed_begins_as_any_network():
    trained = TrainingFrame(np.zeros(3), 1.0, 5.0, 3.0)
    last = [LightModel.initial(CONFIGS[name], trained, 0).weights[-2] for name in ("map", "printed")]
    assert not numbers(last[0]).any()
    assert numbers(last[1]).std() > 0.1


@pytest.mark.parametrize("method", [MappingConfig(), SplattingConfig()], ids=lambda method: method.kind)
def test_the_refinement_is_given_the_bias_that_was_applied(method):
    """The bias in `info` gives the raw occlusion again; epsilon_s of 4.5 is in farthest camera distances."""
    shadow = ShadowConfig(method, 32, bias=4.0, grazing="both", softness=0.02)
    light = LightModel.initial(LightConfig(FIELD, shadow), TrainingFrame(np.zeros(3), 2.0, 7.0, 3.0), 0)
    splats = gaussians(200, light.config.features)
    shadows = light.shadows(splats, SUN)

    def occlusion(bias) -> np.ndarray:
        if isinstance(method, MappingConfig):
            return numbers(occlusion_by_mapping(splats, shadows.camera, bias, 0.02 * 7, method, shadows.points))
        return numbers(occlusion_by_splatting(splats, shadows.camera, bias, shadows.points))

    _, _, applied = shadows.info
    np.testing.assert_allclose(occlusion(applied), numbers(shadows.occlusion), atol=1e-6)
    assert np.abs(occlusion(0.5 * applied) - numbers(shadows.occlusion)).max() > 0.1


def scattered(name: str) -> tuple[LightModel, Gaussians]:
    """A model that was trained when it was three metres wide, and is now two clusters 40 m apart, all of one colour but
    for their shadows."""
    light, arrays = model(name), gaussians(400, CONFIGS[name].features).to_numpy()
    arrays["means"][200:, 0] += 40
    arrays["logit_opacities"][:] = 4
    fields = 1 + 2 * light.config.field.layers
    light.weights = [weight * (i >= fields) for i, weight in enumerate(light.weights)]
    return light, Gaussians.from_numpy(arrays)


@pytest.mark.parametrize("name", ["map", "splat", "park"])
def test_training_pictures_and_baked_colors_have_one_visibility(name):
    light, splats = scattered(name)
    camera = Pinhole.of(Camera(look_at([0, -60, 1], [20, 0, 0]), 64, 32, 80, 80, 32, 16))
    shown = draw_lit(splats, light, camera, SUN, outputs=("alpha",))
    visible = shown.image("features")[..., 3]
    assert 0.1 < visible[shown.image("alpha") > 0.5].mean() < 0.9
    trained = light.shade(splats, camera, SUN)
    drawn = render(splats, camera, outputs=(), features=[trained.visibility]).image("features")[..., 0]
    np.testing.assert_allclose(visible, drawn, atol=1e-6)
    baked = render(bake(splats, light, SUN), camera).image("color")
    np.testing.assert_allclose(baked, np.tile(0.5 * visible[..., None], 3), atol=1e-5)


@pytest.mark.parametrize("name", ["map", "splat", "bounce"])
def test_shadows_of_pictures_whose_lists_do_not_fit_are_the_same(monkeypatch, name):
    """With too little room, then with enough."""
    light, splats = scattered(name)
    monkeypatch.setattr(picture_lists, "_capacities", {})
    monkeypatch.setattr(picture_lists, "BACKENDS", ())
    suns = [SUN, np.array([0.0, 0.6, 0.8])]
    wanted = [numbers(light.sunlight(splats, sun).visibility) for sun in suns]
    monkeypatch.setattr(picture_lists, "BACKENDS", ("cuda", "llvm"))
    made: list[int] = []
    plain = picture_lists._PicturePairs.check

    def spied(self, extent, pair_ends, capacity):
        made.append(capacity)
        plain(self, extent, pair_ends, capacity)

    monkeypatch.setattr(picture_lists._PicturePairs, "check", spied)
    light.sunlight(splats, suns[0])
    picture_lists._capacities.update(dict.fromkeys(picture_lists._capacities, 1))
    for sun, visibility in zip([*suns, *suns][1:], [*wanted, *wanted][1:], strict=True):
        np.testing.assert_array_equal(numbers(light.sunlight(splats, sun).visibility), visibility)
    assert made[0] == 1 < min(made[1:])
    assert len(made) == 3
    assert wanted[0].std() > 0.1


# ---- features as parameters of Gaussians ----


def test_features_follow_their_gaussian_through_refinement():
    splats = gaussians(6, 4)
    splats.features = upload(np.arange(24, dtype=np.float32))
    optimizer = Adam(splats.rows())
    first, second = optimizer.moments()
    first[-1] = np.arange(24, dtype=np.float32) + 100
    optimizer.put(first, second)
    before = splats.to_numpy()["features"]
    duplicate, split = np.eye(6, dtype=bool)[1], np.eye(6, dtype=bool)[4]
    index = grow(splats, optimizer, duplicate, split, np.random.default_rng(0))
    np.testing.assert_array_equal(splats.to_numpy()["features"], before[index])
    moments = optimizer.moments()[0][-1].reshape(4, -1).T
    np.testing.assert_array_equal(moments[:5], before[index[:5]] + 100)
    assert not moments[5:].any(), "what is new starts without moments"
    kept = prune(splats, optimizer, np.arange(splats.count) % 2 == 0)
    np.testing.assert_array_equal(splats.to_numpy()["features"], before[index[kept]])
    assert splats.feature_count == 4
    assert len(optimizer.moments()[1][-1]) == 4 * splats.count


def test_entries_of_packed_rows():
    row = np.arange(12, dtype=np.float32)
    chosen = gather_entries(ad.Float(row), ad.UInt32([2, 2, 0]), 4)
    np.testing.assert_array_equal(np.array(chosen).reshape(3, 3), row.reshape(3, 4)[:, [2, 2, 0]])


@pytest.mark.parametrize("features", [np.zeros((5, 2)), np.zeros((6, 0)), np.zeros(6)])
def test_features_of_another_shape_are_refused(features):
    arrays = gaussians(6, 2).to_numpy()
    with pytest.raises(ValueError, match="features"):
        Gaussians.from_numpy({**arrays, "features": features})


def test_a_field_without_features_is_refused():
    """Nothing would tell its Gaussians' colours apart."""
    with pytest.raises(InputError, match="features: expected 1 to 1024, found 0"):
        FieldConfig(features=0)


# ---- training ----

REFINEMENT = DensificationConfig(
    refine_start=10,
    refine_every=20,
    pause_after_reset=0,
    reset_every=4,
    refine_stop=80,
    screen_size_stop=0,
    prune_opacity=0.01,
)


def training(name: str, **changes) -> TrainConfig:
    given = {"light": CONFIGS[name], "iterations": 60, "checkpoint_every": 25, "init_count": 40}
    return TrainConfig(**{**given, "refinement": REFINEMENT, **changes})


@pytest.mark.parametrize("name", CONFIGS)
def test_training_with_light_repeats_to_the_bit_and_resumes(small_lit_dataset, tmp_path, name):
    config = training(name, visibility_weight=0.1 if CONFIGS[name].shadow else 0.0)
    dataset = earthlit_dataset(small_lit_dataset) if CONFIGS[name].earth else small_lit_dataset
    run = train(dataset, tmp_path / "one", config)
    again = train(dataset, tmp_path / "two", config)
    model_of = [(folder.path / "model.safetensors").read_bytes() for folder in (run, again)]
    assert model_of[0] == model_of[1]
    assert run.training["history"] == again.training["history"]

    resumed = Trainer(dataset, config)
    resumed.restore(tmp_path / "one/checkpoints/step_00000050.safetensors")
    for _ in range(10):
        resumed.step()
    tensors, _ = read_tensors(run.path / "model.safetensors")
    for key, value in resumed.model_tensors().items():
        np.testing.assert_array_equal(value, tensors[key], err_msg=key)


def earthlit_dataset(dataset: Dataset) -> Dataset:
    """The same pictures, said to be over the Earth."""
    lit = [replace(frame, sun=replace(frame.sun, earth=EARTH)) for frame in dataset.train]
    return replace(dataset, train=tuple(lit))


def psnr(run: Run, dataset: Dataset) -> float:
    """Of the training pictures over black, dB."""
    errors = []
    for frame in dataset.train:
        truth = load_image(dataset, frame).over(np.zeros(3))
        errors.append(np.mean((np.clip(run.predict(frame.camera, frame.sun).rgb, 0, 1) - truth) ** 2))
    return float(-10 * np.log10(np.mean(errors)))


def test_light_learns_and_the_sun_changes_the_picture(small_lit_dataset, tmp_path):
    rates = LearningRates(features=2e-2, networks=5e-3)
    start, run = (
        train(small_lit_dataset, tmp_path / str(n), training("map", rates=rates, iterations=n, init_count=400))
        for n in (1, 400)
    )
    assert psnr(run, small_lit_dataset) > psnr(start, small_lit_dataset) + 3
    loaded, frame = load_run(run.path), small_lit_dataset.test[0]
    assert loaded.relightable
    one, other = (loaded.predict(frame.camera, Sun.from_angles(*angles)) for angles in ((0, 40), (180, -40)))
    assert np.abs(one.rgb - other.rgb).max() > 0.05
    assert one.visibility.shape == one.alpha.shape
    assert ((one.visibility >= 0) & (one.visibility <= 1 + 1e-5)).all()
    with pytest.raises(InputError, match="Sun's direction"):
        loaded.predict(frame.camera)
    for direction in (*np.eye(3), *-np.eye(3), frame.camera.world_from_camera[:3, 2]):
        shown = loaded.predict(frame.camera, Sun(direction))
        assert np.isfinite(shown.rgb).all()
        assert np.isfinite(shown.visibility).all()


def test_the_transfer_function_is_that_of_our_images():
    values = np.linspace(-0.1, 1.2, 400).astype(np.float32)
    np.testing.assert_allclose(numbers(tone.encode_srgb(upload(values))), srgb_from_linear(values), atol=2e-6)
    inside = np.clip(values, 0, 1)
    np.testing.assert_allclose(numbers(tone.decode_srgb(upload(inside))), linear_from_srgb(inside), atol=2e-6)


def test_linear_colors_are_blended_before_they_are_encoded(small_lit_dataset, tmp_path):
    run = train(small_lit_dataset, tmp_path / "run", training("linear", iterations=5))
    frame = small_lit_dataset.test[0]
    drawn = draw_lit(run.gaussians, run.light, Pinhole.of(frame.camera), frame.sun.direction).image("features")
    np.testing.assert_array_equal(run.predict(frame.camera, frame.sun).rgb, srgb_from_linear(drawn))


@pytest.mark.parametrize("name", ["map", "linear"])
def test_baked_harmonics_show_what_the_model_shows_under_that_sun(name):
    light, splats = model(name), gaussians(120, CONFIGS[name].features)
    plain = bake(splats, light, SUN)
    assert plain.sh_degree == 3
    assert plain.features is None
    errors, spread = [], []
    for place in fibonacci_sphere(20):
        camera = Pinhole.of(Camera(look_at(40 * place, [0, 0, 0]), 32, 32, 40, 40, 16, 16))
        exact = np.stack([numbers(c) for c in light.shade_picture(splats, camera, SUN)[0]])
        exact = srgb_from_linear(exact) if CONFIGS[name].linear else exact
        errors.append(numbers(view_colors(plain, camera)) - exact)
        spread.append(exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.5 * np.std(spread, axis=0).mean(), "the view matters, and is kept"


def test_round_gaussians_feel_no_pull_towards_roundness():
    """Their scales differ by the last bit of an exponential; its sign must not decide a gradient."""
    log_scales = ad.Array3f(np.repeat(np.random.default_rng(0).uniform(-9, 2, (1, 500)), 3, axis=0).astype(np.float32))
    log_scales[1] *= 1 + 1e-7
    dr.enable_grad(log_scales)
    dr.backward(anisotropy(log_scales))
    assert not numbers(dr.grad(log_scales)).any()
    flat = np.log([[0.1], [0.2], [0.6]]).astype(np.float32)
    assert numbers(anisotropy(ad.Array3f(flat)))[0] == pytest.approx((0.2 + 0.1 + 0.3) / 3, rel=1e-5)


WIDER = SplattingConfig(beta_min=0.004)
PRINTED = replace(REFINE, residual=False)
SPLATTED = LightConfig(FIELD, ShadowConfig(SplattingConfig(), 32, refine=REFINE))


@pytest.mark.parametrize(
    ("tensor", "changes"),
    [
        ("light.weight.05", {"visibility_weight": 1.0}),
        ("features", {"light": replace(SPLATTED, linear=True)}),
        ("features", {"light": replace(SPLATTED, shadow=replace(SPLATTED.shadow, grazing="lift"))}),
        ("features", {"light": replace(SPLATTED, shadow=replace(SPLATTED.shadow, bias=0.0))}),
        ("features", {"light": replace(SPLATTED, shadow=replace(SPLATTED.shadow, crop=False))}),
        ("features", {"light": replace(SPLATTED, shadow=replace(SPLATTED.shadow, method=WIDER))}),
        ("features", {"light": replace(SPLATTED, shadow=replace(SPLATTED.shadow, refine=PRINTED))}),
    ],
    ids=["supervised", "linear", "grazing", "bias", "crop", "beta_min", "residual"],
)
def test_every_option_changes_what_is_learned(small_lit_dataset, tensor, changes):
    learned = []
    for given in ({"light": SPLATTED}, {"light": SPLATTED, **changes}):
        trainer = Trainer(small_lit_dataset, training("splat", **given))
        for _ in range(4):
            trainer.step()
        learned.append(trainer.model_tensors()[tensor])
    assert not np.array_equal(*learned)


def test_one_outlier_of_a_point_cloud_changes_no_length(small_lit_dataset, tmp_path):
    points, _ = read_points(small_lit_dataset.root / small_lit_dataset.ply_file_path)
    frames = []
    for cloud in (points, np.append(points, [[1e4, -1e4, 1e4]], axis=0)):
        path = tmp_path / f"{len(cloud)}.ply"
        write_points(path, cloud, np.full(cloud.shape, 128))
        dataset = replace(small_lit_dataset, ply_file_path=str(path))
        frames.append(Trainer(dataset, training("map", init="points", init_count=1000)).light.frame)
    for name in ("centre", "distance", "radius"):
        np.testing.assert_allclose(getattr(frames[1], name), getattr(frames[0], name), rtol=0.02, atol=1e-6)
    assert frames[0].radius == pytest.approx(np.linalg.norm(points - points.mean(axis=0), axis=1).max(), rel=0.2)


def test_a_footprint_ends_within_what_lists_hold():
    for wrong in (0.003, 0.6):
        with pytest.raises(InputError, match=f"beta_min: expected 0.004 to 0.5, found {wrong}"):
            SplattingConfig(beta_min=wrong)


@pytest.mark.parametrize("kind", ["empty", "no features", "few features"])
def test_models_that_do_not_fit_their_networks_are_refused(small_lit_dataset, tmp_path, kind):
    run = train(small_lit_dataset, tmp_path / "run", training("map", iterations=2))
    tensors, header = read_tensors(run.path / "model.safetensors")
    if kind == "empty":
        tensors |= {name: tensors[name][:0] for name in run.gaussians.to_numpy()}
    elif kind == "no features":
        del tensors["features"]
    else:
        tensors["features"] = tensors["features"][:, :4]
    write_tensors(run.path / "model.safetensors", tensors, {k: v for k, v in header.items() if k != "format"})
    with pytest.raises(InputError, match=r"model\.safetensors"):
        load_run(run.path)
    config = json.loads((run.path / "config.json").read_text())
    config["light"]["shadow"]["grazing"] = "somehow"  # of another version
    (run.path / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"config\.json: light\.shadow\.grazing: expected one of .*somehow"):
        load_run(run.path)


def test_a_run_that_never_began_can_be_started_otherwise(small_lit_dataset, tmp_path, monkeypatch):
    def broken(_self):
        raise WorkError("the memory is short")

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "step", broken)
        with pytest.raises(WorkError):
            train(small_lit_dataset, tmp_path / "run", training("map"))
    run = train(small_lit_dataset, tmp_path / "run", training("map", iterations=2))
    assert run.config["iterations"] == 2


def test_resume_takes_what_an_older_version_did_not_write_for_the_default(small_lit_dataset, tmp_path):
    config = training("map", iterations=2)
    run = train(small_lit_dataset, tmp_path / "run", config)
    written = json.loads((run.path / "config.json").read_text())
    for name in ("views_per_step", "isotropy_weight"):
        del written[name]
    (run.path / "config.json").write_text(json.dumps(written))
    assert train(small_lit_dataset, tmp_path / "run", config, resume=True).gaussian_count == run.gaussian_count
    wider = replace(config, light=replace(config.light, field=replace(FIELD, width=20)))
    with pytest.raises(InputError, match=r"light\.field\.width 12, expected the same to resume it, found 20"):
        train(small_lit_dataset, tmp_path / "run", wider, resume=True)


def test_vanilla_ignores_suns_and_light_needs_them(small_lit_dataset):
    dark = replace(small_lit_dataset, train=tuple(replace(frame, sun=None) for frame in small_lit_dataset.train))
    Trainer(dark, replace(training("relight"), light=None))
    for name in ("relight", "map"):
        said = r"expected sun_direction in every training frame, or .* light\.field\.inputs=view, .*train_"
        with pytest.raises(InputError, match=said):
            Trainer(dark, training(name))


def test_supervised_visibility_needs_truth(small_lit_dataset):
    blind = replace(small_lit_dataset, train=tuple(replace(f, gt_path=None) for f in small_lit_dataset.train))
    with pytest.raises(InputError, match=r"path-traced visibility.*train_"):
        Trainer(blind, training("map", visibility_weight=0.1))
    with pytest.raises(InputError, match="visibility_weight: expected a method with shadows"):
        training("relight", visibility_weight=0.1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_json_and_have_the_thesis_numbers(name, method):
    config = preset(name, method)
    written = json.loads(json.dumps(config.to_json()))
    assert TrainConfig.from_json(written) == config
    if name != "thesis" or method == "vanilla":
        return
    field, shadow = config.light.field, config.light.shadow
    assert (field.features, field.sun.kind) == ((72, "positional") if method == "baseline-park" else (128, "harmonics"))
    assert (field.width, field.layers) == (256, 3)
    if method == "relight":
        assert shadow is None
    else:
        assert (shadow.bias, shadow.refine.width) == ((0, 32) if method == "baseline-park" else (10, 64))
        assert shadow.refine.features == 6
        assert shadow.softness == 1e-6
    if method != "baseline-park":
        assert field.shape == MlpShape(128 + 25, 25, 3, 256, 3)


@pytest.mark.parametrize("change", [{"grazing": "mystery"}, {"size": 2}, {"bias": -1.0}, {"softness": 0.0}])
def test_impossible_shadows_are_named(change):
    with pytest.raises(InputError, match="expected"):
        ShadowConfig(**change)
