"""The colours of Gaussians, shadows apart, by principal components: K numbers a channel of each Gaussian, and a table,
which all share, of what Sun and view make of each component.

A field's colours of a Gaussian are a function of a condition c, Sun and view. With coefficients C [3 N, K] and K
functions b(c), they are C b(c). C comes from the principal components of a sample of the Gaussians under random c, b at
the table's nodes from least squares over the sample. There are two kinds of c, as there are of fields:

cosines      of surface fields: n . h, n . v and n . s about each Gaussian's own normal
directions   of all others: the Sun's and, by spherical harmonics, the view's. Plain harmonics (`vanilla`) are this,
             too, with one Sun, and a component for each harmonic
"""

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.geometry import fibonacci_sphere, look_at, normalize
from spacesim.learning.networks import mlp, network
from spacesim.learning.reflectance import LOBES
from spacesim.splat.export.html.sunlight import octahedral_directions, quantized
from spacesim.splat.light.field import field_color
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shading.forward import split_weights
from spacesim.splat.light.shading.pictures import first_layer_of_features
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians

COMPONENTS = 16  #: a multiple of 4
CONDITIONS = 600  #: random ones, far more than components
SAMPLE = 1_000  #: Gaussians that components are found with
NODES = (33, 5, 17)  #: of the table of cosines: sqrt(1 - n . h) and n . v in [0, 1], n . s in [-1, 1]
SUN_SIDE = 16  #: Suns on a side of the table of directions
DEGREE, VIEWS = 3, 32  #: its harmonics, and the views that these are fitted to


@dataclass(frozen=True, eq=False)
class ColorTables:
    """Of N Gaussians."""

    coefficients: np.ndarray  #: int8 [K, N, 3], shares of 1/127
    #: of cosines: float16 [K / 4, 17, 5, 33, 4], `NODES` from the last; of directions: float32 [Suns, harmonics, K]
    table: np.ndarray
    offset: float = 0.0  #: added to all colours


def color_steps(light: LightModel | None) -> int:
    """How often `tabulate_colors` reports."""
    if light is None:
        return 0
    suns = SUN_SIDE**2 if light.config.field.knows_sun else 1
    return CONDITIONS + (int(np.prod(NODES)) if tells_cosines(light) else suns * VIEWS)


def tabulate_colors(gaussians: Gaussians, light: LightModel | None, report: Callable[[], None]) -> ColorTables:
    """Colours without shadows and without light that bounces, of N Gaussians. report: called `color_steps` times"""
    if light is None:
        return _plain_harmonics(gaussians)
    kind = _kind(light)
    few, every = kind(_sample(gaussians), light), kind(gaussians, light)
    conditions = few.conditions(np.random.default_rng(0))
    rows = np.stack([few.colors(condition).ravel() for condition in conditions]).astype(np.float64)
    _, vectors = np.linalg.eigh(rows @ rows.T)
    basis = vectors[:, ::-1][:, :COMPONENTS]  # [conditions, K], orthonormal: products with it are least squares
    coefficients = np.zeros((COMPONENTS, gaussians.count, 3), np.float32)
    for condition, weights in zip(conditions, basis.astype(np.float32), strict=True):
        coefficients += weights[:, None, None] * every.colors(condition)
        report()
    table, coefficients = quantized(few.table(np.linalg.pinv(rows.T @ basis), report), coefficients)
    return ColorTables(coefficients, kind.packed(table))


def tells_cosines(light: LightModel) -> bool:
    """Whether a field knows Sun and view by these alone."""
    field = light.config.field
    return field.surface and field.sun.size == field.view.size == 1


def _kind(light: LightModel) -> "type[_Cosines] | type[_Directions]":
    return _Cosines if tells_cosines(light) else _Directions


def _plain_harmonics(gaussians: Gaussians) -> ColorTables:
    sh = gaussians.to_numpy()["sh"].transpose(1, 0, 2)
    terms, components = len(sh), -(-len(sh) // 4) * 4
    padded = np.concatenate([sh, np.zeros((components - terms, *sh.shape[1:]), np.float32)])
    table, coefficients = quantized(np.eye(terms, components)[None], padded)
    return ColorTables(coefficients, table, offset=0.5)


def _sample(gaussians: Gaussians) -> Gaussians:
    arrays = gaussians.to_numpy()
    chosen = np.random.default_rng(0).permutation(gaussians.count)[:SAMPLE]
    return Gaussians.from_numpy({name: array[np.sort(chosen)] for name, array in arrays.items()})


class _Cosines:
    """Conditions are what `surface_cosines` gives."""

    def __init__(self, gaussians: Gaussians, light: LightModel) -> None:
        self.gaussians, self.light, self.field = gaussians, light, light.config.field
        self.batch = PaddedBatch.of(gaussians.count, still=True)
        self.weights, _ = split_weights(light.config, light.weights)
        assert gaussians.features is not None, "a field reads features"
        self.first_layer = first_layer_of_features(self.field, self.weights, gaussians.features, self.batch)

    def conditions(self, rng: np.random.Generator) -> np.ndarray:
        """[CONDITIONS, 8]: Suns all around, views on the normal's side, a third of them near the mirror's direction."""
        sun, view = normalize(rng.normal(size=(2, CONDITIONS, 3)))
        mirrored = slice(CONDITIONS // 3)
        view[mirrored] = sun[mirrored] * [-1, -1, 1] + rng.normal(scale=0.15, size=view[mirrored].shape)
        view = normalize(view * [1, 1, -1] ** (view[:, 2:] < 0))
        halfway = np.maximum(normalize(sun + view)[:, 2], 0)
        return _cosines(halfway, view[:, 2], sun[:, 2])

    def colors(self, condition: np.ndarray) -> np.ndarray:
        """float32 [N, 3]."""
        batch, field = self.batch, self.field
        numbers = [*np.array(field.view(ad.Array3f(0, 0, 1))).ravel(), *condition]
        inputs = ad.Float([float(number) for number in numbers])  # no constants of a kernel: others compile nothing
        rows = [dr.gather(ad.Float, inputs, ad.UInt32(i)) for i in range(len(numbers))]
        items = batch.matrix(rows, network.round_up_rows(len(rows)))
        shared = self.light.encode_sun(None).field_encoding
        output, _ = mlp.forward(field.shape, self.weights, items, shared, self.first_layer)
        colors = [field_color(self.light.config.decoding, value) for value in output]
        dr.eval(colors)
        return np.stack([np.array(color)[: self.gaussians.count] for color in colors], axis=1)

    def table(self, inverse: np.ndarray, report: Callable[[], None]) -> np.ndarray:
        """float64 [17, 5, 33, K]. inverse: [K, 3 N], from colours to components"""
        root, view, sun = (np.linspace(low, 1, nodes) for low, nodes in zip((0, 0, -1), NODES, strict=True))
        suns, views, roots = np.meshgrid(sun, view, root, indexing="ij")
        rows = []
        for node in _cosines(1 - roots.ravel() ** 2, views.ravel(), suns.ravel()):
            rows.append(inverse @ self.colors(node).ravel())
            report()
        return np.stack(rows).reshape(*suns.shape, -1)

    @staticmethod
    def packed(table: np.ndarray) -> np.ndarray:
        """As textures have it: four components in a texel."""
        return np.moveaxis(table.reshape(*table.shape[:-1], -1, 4), -2, 0).astype(np.float16)


class _Directions:
    """Conditions are a Sun, None for a field that does not take one, and a direction from the camera."""

    def __init__(self, gaussians: Gaussians, light: LightModel) -> None:
        self.gaussians, self.light = gaussians, light
        shadows = light.config.shadow is not None
        self.unshadowed = upload(np.ones(gaussians.count)) if shadows else None

    def conditions(self, rng: np.random.Generator) -> list[np.ndarray]:
        """`CONDITIONS` of them."""
        return list(normalize(rng.normal(size=(CONDITIONS, 2, 3))))

    def colors(self, condition: np.ndarray | tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """float32 [N, 3]."""
        sun, direction = condition
        # a camera of parallel rays sees every Gaussian in one direction
        camera = OrthographicCamera.from_extent(look_at(-direction, np.zeros(3)), 4, 4, 1.0)
        sun_or_none = sun if self.light.config.field.knows_sun else None
        light = Sunlight(self.unshadowed, [])
        colors, _ = self.light.shade_picture(self.gaussians, Orthographic.of(camera), sun_or_none, sunlight=light)
        return np.stack([np.array(color) for color in colors], axis=1)

    def table(self, inverse: np.ndarray, report: Callable[[], None]) -> np.ndarray:
        """float64 [Suns, harmonics, K]. inverse: [K, 3 N], from colours to components"""
        views = fibonacci_sphere(VIEWS)
        terms = dr.sh_eval(ad.Array3f(views.T.astype(np.float32)), DEGREE)
        harmonics = np.stack([np.broadcast_to(np.array(term), VIEWS) for term in terms], axis=1).astype(np.float64)
        suns = octahedral_directions(SUN_SIDE if self.light.config.field.knows_sun else 1)
        rows = []
        for sun in suns:
            for view in views:
                rows.append(inverse @ self.colors((sun, view)).ravel())
                report()
        return np.linalg.pinv(harmonics) @ np.stack(rows).reshape(len(suns), VIEWS, -1)

    @staticmethod
    def packed(table: np.ndarray) -> np.ndarray:
        """As it is."""
        return table


def _cosines(halfway: np.ndarray, view: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """[M, 8] as `surface_cosines` orders them, of n . h, n . v and n . s [M]."""
    lobes = [halfway**exponent for exponent in LOBES]
    return np.stack([sun, np.maximum(sun, 0), view, halfway, *lobes], axis=1)
