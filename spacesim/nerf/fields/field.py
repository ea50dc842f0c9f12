"""Fields: density and colour at points of the box, by a hash grid and small networks (2.1).

Points are the columns of matrices [B, C, 512] that networks read (`networks.mlp`): N is a multiple of 512. Densities
are per side of the box, so that a field does not know how large it is.
"""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, TensorXf, UInt32
from spacesim.learning.networks import mlp, network
from spacesim.learning.networks.network import MlpShape, round_up_rows, row_of, sigmoid
from spacesim.learning.reflectance import COSINES, surface_cosines
from spacesim.nerf.config import CHUNK, GridConfig, NerfConfig
from spacesim.nerf.fields.hashgrid import HashGrid

MAX_LOG_DENSITY = 12.0  #: e^12 a side: opaque within a hundred-thousandth of it

Parameters = list[Float]
"""A grid's table, then the weights of networks, as `network.initial_weights` orders them."""


@dataclass
class DensityTape:
    """What the adjoint of a density wants."""

    point: Array3f  #: [3, N]
    layers: network.MlpTape  #: of the network
    log_density: Float  #: [N]


@dataclass(frozen=True)
class DensityField:
    """Density, and features of the place for a colour network."""

    grid: HashGrid  #: what is known of places
    #: the network: what the grid says of a place in, the logarithm of the density and the other numbers out
    shape: MlpShape

    @staticmethod
    def of(config: GridConfig, width: int, features: int = 0) -> "DensityField":
        """features: numbers beside the density"""
        grid = HashGrid(config)
        return DensityField(grid, MlpShape(grid.outputs, 1, 1 + features, width, 2))

    def initial(self, rng: np.random.Generator) -> list[np.ndarray]:
        """`Parameters` to start from."""
        return [self.grid.initial(rng), *network.initial_weights(self.shape, rng)]

    def look_up(self, parameters: Parameters, point: Array3f) -> tuple[Float, list[Float], DensityTape]:
        """(density [N] per side, 1 + features outputs, [N] each, tape) at points [3, N] of the box."""
        items = to_matrix(self.grid.look_up(parameters[0], point))
        output, layers = mlp.forward(self.shape, parameters[1:], items, _one())
        log_density = output[0]
        return dr.exp(dr.minimum(log_density, MAX_LOG_DENSITY)), output, DensityTape(point, layers, log_density)

    def adjoint(
        self, parameters: Parameters, tape: DensityTape, by_density: Float, by_features: list[Float]
    ) -> Parameters:
        """Gradients by the parameters, from those [N] by the density and by the features."""
        by_output = self._by_output(tape, by_density, by_features)
        weights, by_items = mlp.backward(self.shape, parameters[1:], tape.layers, _one(), by_output)
        rows = [row_of(by_items, i) for i in range(self.grid.outputs)]
        dr.eval(rows, weights)
        return [self.grid.adjoint(tape.point, rows), *weights]

    def slopes(self, parameters: Parameters, tape: DensityTape) -> Array3f:
        """[3, N] gradient of the density by the points."""
        none = [ad.Float(0)] * (self.shape.outputs - 1)
        by_output = self._by_output(tape, dr.full(ad.Float, 1, dr.width(tape.log_density)), none)
        _, by_items = mlp.backward(self.shape, parameters[1:], tape.layers, _one(), by_output)
        rows = [row_of(by_items, i) for i in range(self.grid.outputs)]
        return self.grid.slopes(parameters[0], tape.point, rows)

    def _by_output(self, tape: DensityTape, by_density: Float, by_features: list[Float]) -> TensorXf:
        is_free = tape.log_density < MAX_LOG_DENSITY
        by_log = dr.select(is_free, by_density * dr.exp(dr.minimum(tape.log_density, MAX_LOG_DENSITY)), 0)
        return to_matrix([by_log, *by_features], exact=True)


@dataclass
class FieldTape:
    """What the adjoint of a field wants."""

    density: DensityTape  #: what the density's own adjoint wants
    layers: network.MlpTape  #: of the colour network
    color: list[Float]  #: [N] each
    normal: Array3f | None  #: [3, N] of any length, where there are some
    view: Array3f  #: [3, N]
    sun: Array3f | None  #: [3, N], where the field takes it


@dataclass(frozen=True)
class RadianceField:
    """Density and colour of a radiance field. The colour takes the view's direction as input, and the Sun's where
    the method does, or in place of both the cosines about a normal, three of the density network's outputs."""

    density: DensityField  #: its density, and the numbers that the colour network reads
    color: MlpShape  #: the network: features, view and Sun in, three colours out, of a field with shadows six
    features: int  #: numbers of a place that the colour network reads
    harmonics: int  #: degree, of the view's direction
    sun_harmonics: int | None  #: degree, of the Sun's; None: the field does not take it
    has_normals: bool  #: the colour takes cosines as input

    @staticmethod
    def of(config: NerfConfig) -> "RadianceField":
        """Of a configuration."""
        has_normals = config.has_normals
        density = DensityField.of(config.grid, config.width, config.features + 3 * has_normals)
        of_sun = config.sun_harmonics if config.knows_sun else None
        terms = (config.harmonics + 1) ** 2 + (0 if of_sun is None else (of_sun + 1) ** 2)
        directions = COSINES if has_normals else terms
        shape = MlpShape(
            config.features + directions, 1, 6 if config.casts_shadows else 3, config.width, config.color_layers
        )
        return RadianceField(density, shape, config.features, config.harmonics, of_sun, has_normals)

    @property
    def split(self) -> int:
        """Where the colour network's weights begin among the parameters."""
        return 2 + 2 * self.density.shape.layers

    def initial(self, rng: np.random.Generator) -> list[np.ndarray]:
        """`Parameters` to start from."""
        return [*self.density.initial(rng), *network.initial_weights(self.color, rng)]

    def directions(self, view: Array3f, sun: Array3f | None) -> list[Float]:
        """The colour network's inputs for directions [3, N], unit: real spherical harmonics."""
        terms = list(dr.sh_eval(view, self.harmonics))
        if self.sun_harmonics is not None:
            assert sun is not None, "a field that takes the Sun"
            terms += dr.sh_eval(sun, self.sun_harmonics)
        return [ad.Float(term) for term in terms]

    def look_up(
        self, parameters: Parameters, point: Array3f, view: Array3f, sun: Array3f | None
    ) -> tuple[Float, list[Float], FieldTape]:
        """(density [N] per side, colour, 3 Floats [N] in 0 to 1, tape) at points [3, N]; of a field that casts shadows
        colour in the Sun, then in the shade, 6 Floats.

        view, sun: [3, N] unit, from the camera and towards the Sun; None: the field does not take it
        """
        density, output, tape = self.density.look_up(parameters[: self.split], point)
        features = output[1:]
        normal = None
        if self.has_normals:
            assert sun is not None, "a field that takes the Sun"
            normal = ad.Array3f(*features[self.features :])
            directions = surface_cosines(normal, view, sun)
        else:
            directions = self.directions(view, sun)
        items = to_matrix([*features[: self.features], *directions])
        raw, layers = mlp.forward(self.color, parameters[self.split :], items, _one())
        color = [sigmoid(value) for value in raw]
        return density, color, FieldTape(tape, layers, color, normal, view, sun)

    def adjoint(
        self,
        parameters: Parameters,
        tape: FieldTape,
        by_density: Float,
        by_color: list[Float],
        by_normal: Array3f | None = None,
    ) -> Parameters:
        """Gradients by the parameters, from those [N] by density and colour, and [3, N] by the normal."""
        by_raw = [gradient * c * (1 - c) for gradient, c in zip(by_color, tape.color, strict=True)]
        by_raw_matrix = to_matrix(by_raw, exact=True)
        colors, by_items = mlp.backward(self.color, parameters[self.split :], tape.layers, _one(), by_raw_matrix)
        by_features = [row_of(by_items, i) for i in range(self.features)]
        if tape.normal is not None:
            slopes = _cosines_adjoint(tape, [row_of(by_items, self.features + i) for i in range(COSINES)])
            by_features += list(slopes if by_normal is None else slopes + by_normal)
        return self.density.adjoint(parameters[: self.split], tape.density, by_density, by_features) + colors


def _cosines_adjoint(tape: FieldTape, gradients: list[Float]) -> Array3f:
    """[3, N] gradient by the normals, from those [N] by the cosines."""
    assert tape.normal is not None, "a field with normals"
    assert tape.sun is not None, "a field that takes the Sun"
    normal = ad.Array3f(tape.normal)
    dr.enable_grad(normal)
    cosines = surface_cosines(normal, tape.view, tape.sun)
    dr.backward(sum((c * g for c, g in zip(cosines, gradients, strict=True)), ad.Float(0)))
    return dr.grad(normal)


def to_matrix(rows: list[Float], exact: bool = False) -> TensorXf:
    """[B, C, 512] of rows [N]; C is rounded up to what products are fast at, by rows of 0, unless it is to be exact."""
    height, count = len(rows) if exact else round_up_rows(len(rows)), max(dr.width(value) for value in rows)
    column = dr.arange(ad.UInt32, count)
    numbers = dr.empty(ad.Float, height * count)
    for i in range(height):
        value = rows[i] if i < len(rows) else ad.Float(0)
        dr.scatter(numbers, value, _place(column, i, height), mode=dr.ReduceMode.Permute)
    return ad.TensorXf(numbers, (count // CHUNK, height, CHUNK))


def _place(column: UInt32, i: int, height: int) -> UInt32:
    return ((column // CHUNK) * height + i) * CHUNK + column % CHUNK


def _one() -> Float:
    """What all points share: nothing, so the first layer has a second bias."""
    return ad.Float(1)
