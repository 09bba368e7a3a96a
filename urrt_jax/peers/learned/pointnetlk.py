"""PointNetLK (Aoki et al. 2019) and PointNetLK Revisited (Li et al. 2021): Lucas-Kanade on one feature of each cloud.

Clouds are centred first. Each has one feature vector, and Gauss-Newton steps move the source until its feature is that
of the target. The form is inverse compositional: the Jacobian is the derivative of the target's feature and is computed
once. Twists are (ω, v): rotation first, in radians, then translation.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.peers.learned import release
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.pointnet import PointNet
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables

_HIGHEST = jax.lax.Precision.HIGHEST
_STEP = 1e-2  # of the finite differences, in radians and units of length
_CONVERGED = 1e-7  # the length of a twist below which the iterations stop


class Alignment(NamedTuple):
    """The result of the iterations, in the frame in which both clouds are centred.

    Attributes:
      transform: after the last iteration.
      residual: (C,) the feature of the moved source minus the target's, as the last iteration found it before its step.
      series: the transform after each iteration, with a leading axis.
    """

    transform: Rigid
    residual: Array
    series: Rigid


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointNetLK(Network):
    """PointNetLK, whose Jacobian is made of finite differences. The defaults are the published network.

    Three things are our choice. Each pair stops when its own step is shorter than 1e-7, where the released code waits
    for the longest step of a batch. No step is taken where JᵀJ is singular to rounding, or where a cloud has no real
    point. Training starts from random weights and draws the project's pairs, where the published recipe starts from a
    PointNet trained to classify and draws twists of norm up to 0.8.

    Attributes:
      widths: of the layers of the PointNet.
      iterations: the largest number of steps.
    """

    widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    iterations: int = 10

    @property
    def name(self) -> str:
        return "pointnetlk"

    @property
    def title(self) -> str:
        return "PointNetLK"

    @property
    def module(self) -> PointNet:
        """The Flax module that makes the feature of a centred cloud."""
        return PointNet(self.widths)

    def init(self, key: Array) -> Variables:
        return dict(self.module.init(key, jnp.zeros((1, 3)), jnp.ones(1, bool), False))

    def feature(self, variables: Variables, cloud: Cloud) -> Array:
        """The feature (C,) of a centred cloud, with the stored statistics."""
        features: Any = self.module.apply(variables, cloud.points, cloud.mask, False)
        return features

    def jacobian(self, variables: Variables, target: Cloud) -> Array:
        """The derivative (C, 6) of the centred target's feature by a twist, from backward differences of 0.01."""
        here = self.feature(variables, target)

        def column(twist: Array) -> Array:
            moved = rigid.apply(_exponential(-_STEP * twist), target.points)
            return (here - self.feature(variables, target._replace(points=moved))) / _STEP

        return jax.vmap(column, out_axes=1)(jnp.eye(6, dtype=target.points.dtype))

    def align(self, variables: Variables, source: Cloud, target: Cloud) -> Alignment:
        """The iterations T ← exp(-(JᵀJ)⁻¹Jᵀ (f(T p) - f(q))) T on a centred source p and a centred target q."""
        goal, pseudo_inverse = self.feature(variables, target), _pseudo_inverse(self.jacobian(variables, target))

        def iterate(state: tuple[Rigid, Array, Array], _: None) -> tuple[tuple[Rigid, Array, Array], Rigid]:
            transform, active, last = state
            moved = source._replace(points=rigid.apply(transform, source.points))
            residual = jnp.where(active, self.feature(variables, moved) - goal, last)
            step = -jnp.matmul(pseudo_inverse, residual, precision=_HIGHEST)
            # As in the released code, a step that is short enough ends the iterations and is not taken itself.
            taken = active & jnp.all(jnp.isfinite(step)) & (jnp.sum(step**2) >= _CONVERGED**2)
            step = jnp.where(taken, step, 0.0)
            after = rigid.compose(_exponential(step), transform)
            transform = jax.tree.map(lambda new, old: jnp.where(taken, new, old), after, transform)
            return (transform, taken, residual), transform

        still = Rigid(jnp.eye(3, dtype=goal.dtype), jnp.zeros(3, goal.dtype))
        (transform, _, residual), series = jax.lax.scan(
            iterate, (still, jnp.any(source.mask), jnp.zeros_like(goal)), None, length=self.iterations
        )
        return Alignment(transform, residual, series)

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The transform that carries the source onto the target; ``key`` is not used."""
        source, target, means = _centred(source, target)
        with jax.default_matmul_precision("highest"):
            found = self.align(variables, source, target).transform
        return _uncentred(found, *means)

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The published loss: ‖T·T_gt⁻¹ - I‖² (Frobenius), "pose", plus the summed squared residual, "feature".

        One pass over both clouds updates the statistics of batch norm, which the iterations then use as they are. That
        the target comes first is our choice, and so is that T is the transform between the clouds before they are
        centred.
        """
        source, target, means = _centred(pair.source, pair.target)
        for cloud in (target, source):
            _, updated = self.module.apply(variables, cloud.points, cloud.mask, True, mutable=["batch_stats"])
            variables = {**variables, **updated}
        with jax.default_matmul_precision("highest"):
            aligned = self.align(variables, source, target)
        found = _uncentred(aligned.transform, *means)
        error = rigid.compose(found, rigid.inverse(pair.transform))
        pose = jnp.sum((error.rotation - jnp.eye(3)) ** 2) + jnp.sum(error.translation**2)
        feature = jnp.sum(aligned.residual**2)
        return pose + feature, {"pose": pose, "feature": feature}, variables["batch_stats"]

    def from_release(self, arrays: Mapping[str, np.ndarray]) -> Variables:
        """The variables in released weights, with the array names of the authors' code or those of learning3d.

        Raises:
          ValueError: an array is missing or has another shape.
        """
        if any(name.startswith("feature_model.") for name in arrays):
            names = [(f"feature_model.conv{row}", f"feature_model.bn{row}") for row in range(1, 6)]
        else:
            places = (("h1", 0), ("h1", 3), ("h2", 0), ("h2", 3), ("h2", 6))
            names = [(f"ptnet.{block}.{row}", f"ptnet.{block}.{row + 1}") for block, row in places]
        return self._read(arrays, names)

    def _read(self, arrays: Mapping[str, np.ndarray], names: list[tuple[str, str]]) -> Variables:
        params, stats = release.stack(arrays, names, (3, *self.widths[:-1]), self.widths, bias=True)
        return {"params": params, "batch_stats": stats}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointNetLKRevisited(PointNetLK):
    """PointNetLK Revisited: the Jacobian is the exact derivative, through batch norm, ReLU and the maximum.

    The loss and the training are those of ``PointNetLK``; that is our choice.
    """

    widths: tuple[int, ...] = (64, 128, 1024)
    iterations: int = 20

    @property
    def name(self) -> str:
        return "pointnetlk_revisited"

    @property
    def title(self) -> str:
        return "PointNetLK Revisited"

    def jacobian(self, variables: Variables, target: Cloud) -> Array:
        """The derivative (C, 6) of the centred target's feature by a twist.

        The released code has minus this, and the other sign in its step too, so that the iterations are the same.
        """

        def feature(twist: Array) -> Array:  # at zero, exp(twist) moves a point by ω × p + v
            moved = target.points + rigid.cross(twist[:3] + jnp.zeros_like(target.points), target.points) + twist[3:]
            return self.feature(variables, target._replace(points=moved))

        return jax.jacfwd(feature)(jnp.zeros(6, target.points.dtype))

    def from_release(self, arrays: Mapping[str, np.ndarray]) -> Variables:
        """The variables in the authors' released weights.

        Raises:
          ValueError: an array is missing or has another shape.
        """
        return self._read(arrays, [(f"ptnet.mlp{row}.0", f"ptnet.mlp{row}.1") for row in range(1, 4)])


def _pseudo_inverse(jacobian: Array) -> Array:
    """(JᵀJ)⁻¹Jᵀ, (6, C), of a Jacobian (C, 6); zero, with a zero derivative, where JᵀJ is singular to rounding."""
    normal = jnp.matmul(jacobian.T, jacobian, precision=_HIGHEST)
    # A squared pivot of the Cholesky factor, over the diagonal entry, is the share of a column's square that the
    # columns before it do not explain. It is NaN where the factor does not exist, and a comparison with NaN is false.
    fixed = jax.lax.stop_gradient(normal)
    share = jnp.diagonal(jnp.linalg.cholesky(fixed)) ** 2 / jnp.diagonal(fixed)
    usable = jnp.all(share > 10 * jnp.finfo(normal.dtype).eps)
    normal = jnp.where(usable, normal, jnp.eye(6, dtype=normal.dtype))
    return jnp.linalg.solve(normal, jnp.where(usable, jacobian, 0.0).T)


def _exponential(twist: Array) -> Rigid:
    """The transform exp(twist) of a twist (ω, v); jaxlie's order is (v, ω)."""
    moved = jaxlie.SE3.exp(jnp.concatenate([twist[3:], twist[:3]]))
    return Rigid(moved.rotation().as_matrix(), moved.translation())


def _centred(source: Cloud, target: Cloud) -> tuple[Cloud, Cloud, tuple[Array, Array]]:
    """The clouds minus their means, with padding still at zero, and the means (3,); as they are if one is empty."""
    filled = jnp.any(source.mask) & jnp.any(target.mask)
    clouds, means = [], []
    for cloud in (source, target):
        weight = cloud.mask.astype(cloud.points.dtype)[:, None]
        mean = jnp.sum(weight * cloud.points, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
        mean = jnp.where(filled, mean, 0.0)
        clouds.append(cloud._replace(points=weight * (cloud.points - mean)))
        means.append(mean)
    return clouds[0], clouds[1], (means[0], means[1])


def _uncentred(found: Rigid, source_mean: Array, target_mean: Array) -> Rigid:
    """The transform between the clouds as they came, of the one between the centred clouds."""
    return found._replace(translation=found.translation + target_mean - rigid.rotate(found.rotation, source_mean))
