"""The whole network: from two normalised clouds to a transform, in K steps.

Pure functions of a ``Model``, which is a pytree: static configuration and parameters. One pair at a time.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, subsample
from urrt_jax.features.moments import moment_invariants
from urrt_jax.frames import normalize_pair
from urrt_jax.loops import anyone, each_cloud, only_if
from urrt_jax.model.attention import RegionTransformer
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.decoder import decode, decode_hypotheses, init_decoder
from urrt_jax.model.encoder import PointEncoder, point_inputs
from urrt_jax.model.encoding import Encoding, encode_cloud
from urrt_jax.model.partition import init_branches
from urrt_jax.neighbors import nearest
from urrt_jax.rigid import Known, Rigid


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """A network: its configuration, static under jit, and its parameters, a plain dictionary of arrays."""

    config: ModelConfig = dataclasses.field(metadata={"static": True})
    params: dict

    def at_most(self, steps: int) -> "Model":
        """The same network, applied as often as before but not more often than this."""
        return dataclasses.replace(self, config=dataclasses.replace(self.config, steps=min(steps, self.config.steps)))


class _Step(NamedTuple):
    """What a step leaves: the pose that it finds, the pose in which it saw the source, and what it saw."""

    pose: Rigid
    seen: Rigid
    encoding: Encoding


class Estimate(NamedTuple):
    """The network's answer for one pair, in the frame of its input.

    Attributes:
      transform: source to target, after the last step.
      steps: the estimates after each step, stacked: rotation (K, 3, 3), translation (K, 3).
      seen: the transform that the source had undergone when the last step saw it.
      source: encoding of the source as the last step saw it.
      target: encoding of the target.
    """

    transform: Rigid
    steps: Rigid
    seen: Rigid
    source: Encoding
    target: Encoding


@functools.partial(jax.jit, static_argnames="config")
def init_model(key: Array, config: ModelConfig) -> Model:
    """A model with fresh parameters drawn from ``key``."""
    keys = jax.random.split(key, 4)
    n, d = config.regions, config.width
    params = {"encoder": PointEncoder(config).init(keys[0], jnp.zeros((1, point_inputs(config))))["params"]}
    if config.has_regions:
        sequence = jnp.zeros((n, d)), jnp.zeros((n, 3)), jnp.ones(n, bool)
        params["partition"] = init_branches(config, keys[1])
        # Without attention layers and position encoding this stage learns nothing and has no parameters.
        params["attention"] = RegionTransformer(config).init(keys[2], *sequence).get("params", {})
    params["decoder"] = init_decoder(config, keys[3])
    return Model(config, params)


def encode(model: Model, cloud: Cloud) -> Encoding:
    """The encoding of one normalised cloud, subsampled as for ``estimate``."""
    return encode_cloud(model.config, model.params, cloud, moment_invariants(cloud, model.config.octaves))


def estimate(model: Model, source: Cloud, target: Cloud, known: Known | None = None) -> Estimate:
    """The transform from source to target, of two clouds normalised together (``normalize_pair``).

    The network is applied ``config.steps`` times, each time to the source as moved so far; no derivative passes from
    one step to the one before it. The target is encoded once. Labels of regions carry no derivative (hard arg-max).
    Real points should come first, as ``subsample`` leaves them: among them those are chosen that are looked up.

    Args:
      model: the network.
      source: N points.
      target: M points.
      known: the pose, where something else tells it: the network then only sees the clouds in it. Where all poses of
        a batch are known, nothing is decoded, and the clouds are seen once.
    """
    config, params = model.config, model.params
    needed = True if known is None else anyone(~known.sure)
    invariants, target_invariants = each_cloud(lambda cloud: moment_invariants(cloud, config.octaves), source, target)
    target_encoding = encode_cloud(config, params, target, target_invariants, needed)

    @jax.jit  # so that it is traced once
    def apply(pose: Rigid) -> _Step:
        seen = jax.tree.map(jax.lax.stop_gradient, pose)
        moved = jnp.where(source.mask[:, None], rigid.apply(seen, source.points), 0.0)
        encoding = encode_cloud(config, params, source._replace(points=moved), invariants, needed)
        decoded = lambda: rigid.compose(decode(config, params["decoder"], encoding, target_encoding), seen)  # noqa: E731
        pose = only_if(needed, decoded, seen)
        return _Step(pose if known is None else rigid.choose(known.sure, seen, pose), seen, encoding)

    def step(now: _Step, first: Array) -> tuple[_Step, Rigid]:
        now = only_if(needed is True or (needed | first), lambda: apply(now.pose), now)
        return now, now.pose

    pose = rigid.identity() if known is None else rigid.choose(known.sure, known.transform, rigid.identity())
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(apply, pose))
    start = nothing._replace(pose=pose)
    last, steps = jax.lax.scan(step, start, jnp.arange(config.steps) == 0)
    return Estimate(last.pose, steps, last.seen, last.encoding, target_encoding)


def propose(model: Model, source: Cloud, target: Cloud, count: int) -> Rigid:
    """About ``count`` transforms that landmarks speak for, stacked, in one step from where the clouds are.

    Where ``estimate`` gives the one on which most landmarks agree, these are what single ones and those compatible with
    them would say. Clouds as for ``estimate``.
    """
    return decode_hypotheses(
        model.config, model.params["decoder"], *each_cloud(lambda cloud: encode(model, cloud), source, target), count
    )


def estimate_subsampled(model: Model, source: Cloud, target: Cloud) -> Estimate:
    """``estimate``, on at most ``config.points`` points of each normalised cloud."""
    return estimate(model, subsample(source, model.config.points), subsample(target, model.config.points))


def predict(model: Model, source: Cloud, target: Cloud) -> Rigid:
    """The network's transform between two clouds in any units: normalises, estimates, undoes the normalisation."""
    source, target, frame = normalize_pair(source, target)
    return frame.leave(estimate_subsampled(model, source, target).transform)


def point_regions(points: Array, cloud: Cloud, labels: Array, *, count: Array | None = None) -> Array:
    """The region (N,) int32 of any points (N, 3) in the network's frame; 0 for model A.

    The network sees at most ``config.points`` points of a cloud. A region is that of the nearest one of them.

    Args:
      points: on the cloud or off it.
      cloud: M points that the network saw (``Encoding.cloud``).
      labels: (M,), their regions (``Regions.labels``).
      count: (), the points from this row on are padding, whose answers mean nothing; None where all are wanted.
    """
    return labels[nearest(points, cloud, count=count).index]
