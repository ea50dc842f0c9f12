"""A radiance field with its proposals: samples of rays, densities and colours at them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.nerf.config import NerfConfig, ProposalConfig
from spacesim.nerf.fields.field import DensityField, DensityTape, Parameters, RadianceField
from spacesim.nerf.sampling.occupancy import Occupancy
from spacesim.nerf.sampling.rays import Rays
from spacesim.nerf.sampling.render import Weights, volume_weights
from spacesim.nerf.sampling.sampler import intervals, random, resample, uniform_edges


@dataclass
class Round:
    """Samples of R rays from one round."""

    edges: Float  #: [R (S + 1)] shares of the ray's part in the box
    made: Weights  #: [R S]
    lengths: Float  #: [R S] of intervals
    tape: DensityTape  #: of the field that was asked


@dataclass(frozen=True)
class Networks:
    """The fields of a configuration; their parameters lie in one list, those of the proposals first."""

    config: NerfConfig  #: how they are trained, which says how large they are

    @cached_property
    def proposals(self) -> tuple[DensityField, ...]:
        """Of the first and the second round."""
        return tuple(DensityField.of(round_.grid, round_.width) for round_ in self.rounds)

    @property
    def rounds(self) -> tuple[ProposalConfig, ProposalConfig]:
        """The proposals' configurations."""
        return self.config.coarse, self.config.fine

    @cached_property
    def field(self) -> RadianceField:
        """That which is drawn."""
        return RadianceField.of(self.config)

    @property
    def occupancy(self) -> Occupancy:
        """Which cells hold anything."""
        return Occupancy(self.config.occupancy)

    @property
    def bounds(self) -> tuple[int, int]:
        """Where the second proposal's parameters begin, and the field's."""
        first = 2 + 2 * self.proposals[0].shape.layers
        return first, first + 2 + 2 * self.proposals[1].shape.layers

    def of_round(self, parameters: Parameters, number: int) -> Parameters:
        """Parameters of proposal `number`; of the field where it is 2."""
        first, second = self.bounds
        return (parameters[:first], parameters[first:second], parameters[second:])[number]

    def initial(self, seed: int) -> list[np.ndarray]:
        """All parameters to start from."""
        rng = np.random.default_rng([seed, 0])
        proposals = [values for proposal in self.proposals for values in proposal.initial(rng)]
        return proposals + self.field.initial(rng)

    def names(self) -> list[str]:
        """Of the parameters, for a file."""
        names = []
        for owner, layers in (
            *((f"proposals.{i}", proposal.shape.layers) for i, proposal in enumerate(self.proposals)),
            ("field", self.field.density.shape.layers),
        ):
            names += [f"{owner}.grid", *(f"{owner}.density.{i}" for i in range(1 + 2 * layers))]
        return names + [f"field.color.{i}" for i in range(1 + 2 * self.field.color.layers)]

    def parameters(self, tensors: Mapping[str, np.ndarray]) -> Parameters:
        """From a file's arrays. Raises KeyError, or ValueError for arrays of other sizes or numbers that are not
        finite."""
        result = []
        for name, start in zip(self.names(), self.initial(0), strict=True):
            values = tensors[name]
            if values.shape != start.shape or not np.isfinite(values).all():
                raise ValueError(f"{name}: expected {len(start)} finite numbers, found others")
            result.append(upload(values))
        return result

    def sample(
        self,
        parameters: Parameters,
        rays: Rays,
        count: int,
        key: UInt32 | None,
        anneal: Float | None = None,
        samples: int | None = None,
    ) -> tuple[Float, list[Round]]:
        """(edges [R (S + 1)] of the field's samples of `count` rays, the two rounds that found them).

        key: of the random shifts, None: in the middle, as pictures are drawn;  anneal: Float of width 1, the power that
        proposals' weights are raised to;  samples: of the field, None: those of pictures
        """
        ray = dr.arange(ad.UInt32, count)

        def jitter(stream: int) -> Float:
            return dr.full(ad.Float, 0.5, count) if key is None else random(key, ray, stream)

        wanted = [self.config.fine.samples, samples or self.config.samples]
        edges = uniform_edges(count, self.config.coarse.samples, jitter(0))
        rounds = []
        for number, (proposal, config) in enumerate(zip(self.proposals, self.rounds, strict=True)):
            made = self._round(proposal, self.of_round(parameters, number), rays, edges, count, config.samples)
            rounds.append(made)
            weights: Any = made.made.weights
            if anneal is not None:
                weights = dr.power(dr.maximum(weights, 1e-7), anneal)
            edges = resample(edges, weights, count, config.samples, wanted[number], jitter(1 + number))
        return edges, rounds

    def _round(
        self, field: DensityField, parameters: Parameters, rays: Rays, edges: Float, count: int, samples: int
    ) -> Round:
        t, lengths, ray = places(rays, edges, count, samples)
        point, _ = rays.at(ray, t)
        density, _, tape = field.look_up(parameters, point)
        return Round(edges, volume_weights(density * lengths, samples), lengths, tape)

    def density_tape(self, parameters: Parameters, point: Array3f) -> tuple[Float, DensityTape]:
        """(density [N] of the field per side, tape) at points [3, N]."""
        density, _, tape = self.field.density.look_up(self.of_round(parameters, 2)[: self.field.split], point)
        return density, tape


def places(rays: Rays, edges: Float, count: int, samples: int) -> tuple[Float, Float, UInt32]:
    """(t of the middle, length, ray) [R S] of intervals between edges [R (S + 1)], shares of the ray's part."""
    low, high, ray = intervals(edges, count, samples)
    near = dr.gather(ad.Float, rays.near, ray)
    span = dr.gather(ad.Float, rays.far, ray) - near
    return dr.fma(0.5 * (low + high), span, near), (high - low) * span, ray
