"""Slow twins of the radiance field's parts, float64 numpy, one ray or one point at a time."""

import itertools
from collections.abc import Callable

import numpy as np


def volume(tau: np.ndarray, color: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(weights [S], colour [3], accumulation) of a ray by (2.4) and (2.5). tau: [S];  color: [S, 3]"""
    weights, passed = np.zeros(len(tau)), 1.0
    for i, thickness in enumerate(tau):
        weights[i] = passed * -np.expm1(-thickness)
        passed *= np.exp(-thickness)
    return weights, weights @ color, 1 - passed


def resample(edges: np.ndarray, weights: np.ndarray, wanted: int, jitter: float, padding: float) -> np.ndarray:
    """[wanted + 1] places where the cumulative distribution of a piecewise constant density has (k + jitter) / (wanted
    + 1)."""
    raised = weights + padding / len(weights)
    cumulative = np.concatenate([[0], np.cumsum(raised)]) / raised.sum()
    shares = (np.arange(wanted + 1) + jitter) / (wanted + 1)
    return np.interp(shares, cumulative, edges)


def interlevel(
    edges: np.ndarray, weights: np.ndarray, proposal_edges: np.ndarray, proposal: np.ndarray, epsilon: float
) -> float:
    """Of a ray (Barron et al. 2022, 13): bounds by looking at every pair of intervals."""
    loss = 0.0
    for i, weight in enumerate(weights):
        overlaps = (proposal_edges[1:] > edges[i]) & (proposal_edges[:-1] < edges[i + 1])
        loss += max(weight - proposal[overlaps].sum(), 0) ** 2 / (weight + epsilon)
    return loss


def distortion(edges: np.ndarray, weights: np.ndarray) -> float:
    """Of a ray (Barron et al. 2022, 15), over all pairs."""
    middle, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    pairs = np.abs(middle[:, None] - middle) * weights[:, None] * weights
    return float(pairs.sum() + (weights**2 * length).sum() / 3)


def look_up(table: np.ndarray, levels: list, primes: tuple, point: np.ndarray) -> np.ndarray:
    """[2 L] numbers of a hash grid at a point [3]. table: [vertices, 2]"""
    result = []
    for level in levels:
        scaled = point * level.cells
        cell = np.minimum(scaled.astype(np.int64), level.cells - 1)
        share = scaled - cell
        total = np.zeros(2)
        for corner in range(8):
            upper = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
            index = [int(n) for n in cell + upper]
            if level.hashed:
                mixed = 0
                for n, prime in zip(index, primes, strict=True):
                    mixed ^= n * prime % 2**32
                place = mixed % level.size
            else:
                place = index[0] + (level.cells + 1) * (index[1] + (level.cells + 1) * index[2])
            total += np.prod(np.where(upper, share, 1 - share)) * table[level.first + place]
        result += list(total)
    return np.array(result)


def merge(
    models: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(boundaries [K + 1], densities [K], colours [K, 3]) of algorithm 1 on one ray. models: (low [S], high [S],
    density [S], color [S, 3]) each"""
    boundaries = np.unique(np.concatenate([np.concatenate([low, high]) for low, high, _, _ in models]))
    densities, colors = [], []
    for first, last in itertools.pairwise(boundaries):
        middle, total, color = 0.5 * (first + last), 0.0, np.zeros(3)
        for low, high, density, channels in models:
            inside = np.flatnonzero((low <= middle) & (middle < high))
            if len(inside):
                total += density[inside[0]]
                color += density[inside[0]] * channels[inside[0]]
        densities.append(total)
        colors.append(color / total if total > 0 else color)
    return boundaries, np.array(densities), np.array(colors).reshape(-1, 3)


def network(shape: object, weights: list[np.ndarray], items: np.ndarray) -> np.ndarray:
    """[N, outputs] of inputs [N, inputs], with ReLU between layers. weights: as `initial_weights` orders them; what
    points share is 1"""
    value = items
    for i, (rows, columns) in enumerate(shape.sizes):
        value = value @ weights[1 + 2 * i].reshape(rows, columns).T + weights[2 + 2 * i]
        value = value + weights[0] if i == 0 else value
        value = np.maximum(value, 0) if i < shape.layers - 1 else value
    return value


def transmittance(
    density: Callable[[np.ndarray], np.ndarray],
    extent: np.ndarray,
    point: np.ndarray,
    sun: np.ndarray,
    bias: float,
    samples: int,
) -> float:
    """Share of the light that reaches a point [3] from `sun` [3] through what is in the box: midpoints of even
    intervals. density: of points [N, 3]"""
    ends = np.stack([np.zeros(3), extent]) - point
    with np.errstate(divide="ignore"):
        ends = ends / sun
    near, far = max(ends.min(axis=0).max(), bias), ends.max(axis=0).min()
    if far <= near:
        return 1.0
    t = near + (far - near) * (np.arange(samples) + 0.5) / samples
    return float(np.exp(-density(point + t[:, None] * sun).sum() * (far - near) / samples))
