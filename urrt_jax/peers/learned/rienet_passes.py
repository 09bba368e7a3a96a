"""The passes of RIENet, each by its stages: features, matches, matches refined by the neighbours', inlier weights."""

import functools
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.peers.learned.graph import EdgeConvolutions, neighbor_rows
from urrt_jax.peers.learned.inliers import InlierWeights
from urrt_jax.peers.learned.matching import soft_matches, soft_targets
from urrt_jax.rigid import Rigid


class Pass(NamedTuple):
    """What one pass computes of a source (N points) and a target (M points).

    Attributes:
      source: as this pass sees it, moved by the passes before.
      source_neighbors, target_neighbors: (N, k) and (M, k) rows, nearest first; k: the larger number of neighbours.
      source_features, target_features: (N, C) and (M, C).
      distance: (N, M), Euclidean, between features.
      match: (N, M), softmax of the negative distance (eq. 1).
      neighbor_match: (N, M), the matches between the neighbours of both points (eq. 2).
      refined: (N, M), the match that is used (eq. 3).
      matched: (N, 3), the soft targets (eq. 4), zero for padding.
      weights: (N,), of the soft targets (eq. 7).
      transform: carries ``source`` onto the target.
    """

    source: Cloud
    source_neighbors: Array
    target_neighbors: Array
    source_features: Array
    target_features: Array
    distance: Array
    match: Array
    neighbor_match: Array
    refined: Array
    matched: Array
    weights: Array
    transform: Rigid


class Passes(nn.Module):
    """All passes of RIENet, with the same parameters. For its attributes see ``RIENet``."""

    widths: tuple[int, ...]
    width: int
    neighbors: int
    match_neighbors: int
    margin: float
    hidden: int
    passes: int

    def setup(self) -> None:
        self.convolutions = EdgeConvolutions(self.widths, self.width)
        self.inliers = InlierWeights(self.hidden)

    def __call__(self, source: Cloud, target: Cloud, training: bool) -> tuple[Pass, ...]:
        """What every pass computes. The gradient runs through all of them, as published."""
        passes = []
        for _ in range(self.passes):
            passes.append(self.single(source, target, training))
            points = rigid.apply(passes[-1].transform, source.points)
            source = source._replace(points=jnp.where(source.mask[:, None], points, 0.0))
        return tuple(passes)

    def single(self, source: Cloud, target: Cloud, training: bool) -> Pass:
        """What one pass computes; in training, batch norm sees the source first, then the target."""
        source_neighbors, source_features = self.embed(source, training)
        target_neighbors, target_features = self.embed(target, training)
        distance = feature_distance(source_features, target_features)
        match = jnp.where(source.mask[:, None], soft_matches(-distance, target.mask), 0.0)
        others = slice(1, self.match_neighbors)
        neighbor_match = sum_over_neighbors(match, source_neighbors[:, others], target_neighbors[:, others])
        neighbor_match = neighbor_match / (self.match_neighbors - 1)  # once, as published, though both are summed
        refined = soft_matches(-jnp.exp(self.margin - neighbor_match) * distance, target.mask)
        matched = jnp.where(source.mask[:, None], soft_targets(refined, target.points), 0.0)
        graph = source_neighbors[:, : self.neighbors]
        edge_mask = source.mask[graph] & source.mask[:, None]
        edges, matched_edges = (points[:, None] - points[graph] for points in (source.points, matched))
        weights = self.inliers(edges, matched_edges, edge_mask, source.mask, training)
        transform = rigid.procrustes(source.points, matched, weights)
        return Pass(
            source,
            source_neighbors,
            target_neighbors,
            source_features,
            target_features,
            distance,
            match,
            neighbor_match,
            refined,
            matched,
            weights,
            transform,
        )

    def embed(self, cloud: Cloud, training: bool) -> tuple[Array, Array]:
        """The rows (N, k) of every point's neighbours, and its features (N, C): the same wherever the cloud is."""
        count = min(max(self.neighbors, self.match_neighbors), cloud.mask.shape[0])
        rows = neighbor_rows(cloud.points, cloud.mask, count)
        graph = rows[:, : self.neighbors]
        edges = cloud.points[graph] - cloud.points[:, None]
        edge_mask = cloud.mask[graph] & cloud.mask[:, None]
        return rows, self.convolutions(edges, edge_mask, cloud.mask, training)


def feature_distance(source: Array, target: Array) -> Array:
    """The Euclidean distances (N, M) between features (N, C) and (M, C); the derivative at zero is zero."""
    products = jnp.matmul(source, target.T, precision=jax.lax.Precision.HIGHEST)
    squared = jnp.sum(source**2, axis=1)[:, None] + jnp.sum(target**2, axis=1) - 2 * products
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def sum_over_neighbors(match: Array, source_neighbors: Array, target_neighbors: Array) -> Array:
    """For all i and j the sum (N, M) of the matches between i's neighbours and j's: rows first, then columns.

    Args:
      match: (N, M), zero where a point is padding.
      source_neighbors: (N, K) rows.
      target_neighbors: (M, L) columns.
    """

    def sum_rows(matrix: Array, rows: Array) -> Array:
        # One neighbour after the other, so that no array is larger than the matrix.
        return sum((matrix[row] for row in rows.T[1:]), matrix[rows.T[0]])

    return sum_rows(sum_rows(match, source_neighbors).T, target_neighbors).T


def total(passes: tuple[Pass, ...]) -> Rigid:
    """The transform of all passes, one after the other."""
    return functools.reduce(lambda inner, outer: rigid.compose(outer, inner), (each.transform for each in passes))
