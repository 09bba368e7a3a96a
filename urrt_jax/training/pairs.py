"""Training pairs, made on the device: a pure function of (seed, step).

A pair is one shape seen twice: posed at random and, in a share of the pairs, corrupted (noise, crops, outliers,
independent sampling). The true pose is known here and is kept for validation; no loss ever reads it.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.rigid import Rigid


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairConfig:
    """How pairs are drawn; lengths in units of the shape's bounding sphere, angles in degrees.

    Attributes:
      points: points drawn of a shape.
      max_angle: each of the three Euler angles is uniform in [0, max_angle] (DCP's protocol).
      signed: share of pairs whose angles take random signs, so that the whole range around zero is seen.
      translation: each component is uniform in ±translation.
      both_ways: share of pairs in which the source is the posed cloud; in the others it is the target (DCP's protocol).
      clean_share: first share of the training in which every pair is clean; then corruptions come in ...
      ramp_share: ... over this share, up to
      corrupted: the share of pairs that are corrupted at the end.
      noise: standard deviation of the coordinates' Gaussian noise is uniform in [0, noise], clipped at 0.05.
      cropped: share of the clouds of corrupted pairs that are cropped, each for itself.
      keep: a crop keeps a share of the points that is uniform in [keep, 1].
      outliers: share of points replaced by Gaussian ones is uniform in [0, outliers].
      outlier_sigma: their standard deviation.
    """

    points: int = 1024
    max_angle: float = 45.0
    signed: float = 0.5
    translation: float = 0.5
    both_ways: float = 0.5
    clean_share: float = 0.0
    ramp_share: float = 0.1
    corrupted: float = 0.75
    noise: float = 0.02
    cropped: float = 0.75
    keep: float = 0.5
    outliers: float = 0.2
    outlier_sigma: float = 0.5

    def __post_init__(self) -> None:
        for name in ("signed", "both_ways", "clean_share", "ramp_share", "corrupted", "cropped", "keep", "outliers"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a share in [0, 1], got {getattr(self, name)}")
        if self.points < 3:
            raise ValueError(f"points: expected at least 3, got {self.points}")
        for name in ("max_angle", "translation", "noise", "outlier_sigma"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")


class Pair(NamedTuple):
    """One training pair, or a batch of them with a leading axis.

    Attributes:
      source, target: what the network sees.
      whole_source, whole_target: the same two clouds before corruption, in the same poses: what the loss compares.
      transform: the true pose, target ≈ R @ source + t; for validation only.
      queries, inside: occupancy samples in the target's frame, (Q, 3) and (Q,); None when the shapes have none.
    """

    source: Cloud
    target: Cloud
    whole_source: Cloud
    whole_target: Cloud
    transform: Rigid
    queries: Array | None = None
    inside: Array | None = None


def euler_rotation(angles: Array) -> Array:
    """Rx·Ry·Rz (3, 3) for angles (3,) in radians: DCP's convention, SciPy's extrinsic "zyx" of the reversed angles."""
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(angles), jnp.sin(angles)
    about_x = jnp.array([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = jnp.array([[cy, 0, sy], [0, 1.0, 0], [-sy, 0, cy]])
    about_z = jnp.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    return jnp.linalg.multi_dot([about_x, about_y, about_z], precision=jax.lax.Precision.HIGHEST)


def corruption_share(config: PairConfig, progress: Array | float) -> Array:
    """The share of corrupted pairs at ``progress`` in [0, 1] of the training."""
    ramp = (jnp.asarray(progress) - config.clean_share) / max(config.ramp_share, 1e-6)
    return config.corrupted * jnp.clip(ramp, 0.0, 1.0)


def draw_pose(key: Array, config: PairConfig) -> Rigid:
    """A random pose."""
    turn, sign, signed, move = jax.random.split(key, 4)
    angles = jax.random.uniform(turn, (3,), maxval=jnp.deg2rad(config.max_angle))
    signs = jnp.where(jax.random.bernoulli(sign, 0.5, (3,)), 1.0, -1.0)
    angles = jnp.where(jax.random.bernoulli(signed, config.signed), angles * signs, angles)
    shift = jax.random.uniform(move, (3,), minval=-config.translation, maxval=config.translation)
    return Rigid(euler_rotation(angles), shift)


def add_noise(key: Array, cloud: Cloud, sigma: Array, clip: float = 0.05) -> Cloud:
    """The cloud with Gaussian noise on every coordinate, clipped at ±clip."""
    noise = jnp.clip(sigma * jax.random.normal(key, cloud.points.shape), -clip, clip)
    return cloud._replace(points=cloud.points + jnp.where(cloud.mask[:, None], noise, 0.0))


def crop(key: Array, cloud: Cloud, keep: Array) -> Cloud:
    """The share ``keep`` of the cloud nearest to a random point: one in the unit cube, or one far away."""
    place, near = jax.random.split(key)
    point = jax.random.uniform(place, (3,), minval=-1.0, maxval=1.0)
    point = jnp.where(jax.random.bernoulli(near), point, 100.0 * point)
    distance = jnp.where(cloud.mask, jnp.sum((cloud.points - point) ** 2, axis=-1), jnp.inf)
    kept = jnp.clip((keep * jnp.sum(cloud.mask)).astype(jnp.int32), 1, cloud.mask.shape[0])
    mask = cloud.mask & (distance <= jnp.sort(distance)[kept - 1])
    return Cloud(jnp.where(mask[:, None], cloud.points, 0.0), mask)


def add_outliers(key: Array, cloud: Cloud, share: Array, sigma: float) -> Cloud:
    """The cloud with a random share of its points replaced by zero-mean Gaussian ones."""
    which, where = jax.random.split(key)
    replaced = jax.random.bernoulli(which, share, cloud.mask.shape) & cloud.mask
    stray = sigma * jax.random.normal(where, cloud.points.shape)
    return cloud._replace(points=jnp.where(replaced[:, None], stray, cloud.points))


def make_pair(
    key: Array,
    shape: Array,
    config: PairConfig,
    share: Array | float,
    queries: Array | None = None,
    inside: Array | None = None,
) -> Pair:
    """One pair from the points (P, 3) of a shape in the unit sphere; ``share``: the chance that it is corrupted."""
    keys = iter(jax.random.split(key, 24))
    pose = draw_pose(next(keys), config)
    rows = jax.random.choice(next(keys), shape.shape[0], (config.points,), replace=config.points > shape.shape[0])
    points = shape[rows].astype(jnp.float32)
    whole = Cloud(points, jnp.ones(config.points, bool))

    corrupted = jax.random.bernoulli(next(keys), share)
    halves = corrupted & jax.random.bernoulli(next(keys), 0.5)
    first = jnp.arange(config.points) < config.points // 2

    def spoil(mask: Array) -> Cloud:
        cloud = Cloud(points, mask)
        level = jnp.where(jax.random.bernoulli(next(keys), 0.25), jax.random.uniform(next(keys)), 0.0)
        cloud = add_outliers(next(keys), cloud, config.outliers * level, config.outlier_sigma)
        level = jnp.where(jax.random.bernoulli(next(keys), config.cropped), jax.random.uniform(next(keys)), 0.0)
        return crop(next(keys), cloud, 1 - (1 - config.keep) * level)

    every = jnp.ones(config.points, bool)
    source = spoil(jnp.where(halves, first, every))
    target = spoil(jnp.where(halves, ~first, every))
    sigma = config.noise * jax.random.uniform(next(keys))
    noise_key = next(keys)
    source = add_noise(jax.random.fold_in(noise_key, 0), source, sigma)
    target = add_noise(jax.random.fold_in(noise_key, 1), target, sigma)
    source = jax.tree.map(lambda spoiled, clean: jnp.where(corrupted, spoiled, clean), source, whole)
    target = jax.tree.map(lambda spoiled, clean: jnp.where(corrupted, spoiled, clean), target, whole)

    # Either cloud may be the one in the canonical pose, so that the partition learns from both and poses go both ways.
    swap = jax.random.bernoulli(jax.random.fold_in(noise_key, 2), config.both_ways)
    still = rigid.identity()
    source_pose = jax.tree.map(lambda a, b: jnp.where(swap, a, b), pose, still)
    target_pose = jax.tree.map(lambda a, b: jnp.where(swap, a, b), still, pose)
    return Pair(
        source=_move(source_pose, source),
        target=_move(target_pose, target),
        whole_source=_move(source_pose, whole),
        whole_target=_move(target_pose, whole),
        transform=rigid.compose(target_pose, rigid.inverse(source_pose)),
        queries=None if queries is None else rigid.apply(target_pose, queries),
        inside=inside,
    )


def _move(pose: Rigid, cloud: Cloud) -> Cloud:
    return cloud._replace(points=jnp.where(cloud.mask[:, None], rigid.apply(pose, cloud.points), 0.0))


def make_batch(key: Array, shapes: dict[str, Array], config: PairConfig, size: int, share: Array | float) -> Pair:
    """A batch of ``size`` pairs of random shapes.

    Args:
      key: random key.
      shapes: "points" (S, P, 3) in the unit sphere, and where known "queries" (S, Q, 3) and "inside" (S, Q).
      config: how pairs are drawn.
      size: pairs in the batch.
      share: the chance that a pair is corrupted.
    """
    choose, draw = jax.random.split(key)
    rows = jax.random.randint(choose, (size,), 0, shapes["points"].shape[0])
    chosen = {name: values[rows] for name, values in shapes.items()}

    def one(pair_key: Array, shape: dict[str, Array]) -> Pair:
        return make_pair(pair_key, shape["points"], config, share, shape.get("queries"), shape.get("inside"))

    return jax.vmap(one)(jax.random.split(draw, size), chosen)
