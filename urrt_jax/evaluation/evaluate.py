"""Evaluation of a model over a data set: jitted, batched, with the values of every item kept."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from urrt_jax.evaluation.metrics import pose_errors, summarize
from urrt_jax.evaluation.protocols import PROTOCOLS, Trial
from urrt_jax.model import Model
from urrt_jax.refine import ICP
from urrt_jax.registration import register


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The poses found for every item, before and after refinement, and the truth.

    Attributes:
      protocol: its name.
      refined: whether the network's estimates were refined.
      items: (B,) int, the items evaluated.
      rotations, translations: (B, 3, 3) and (B, 3), as ``register`` returned them.
      coarse_rotations, coarse_translations: the network's own.
      true_rotations, true_translations: the truth.
      fitness, rmse: (B,).
      converged: (B,) bool.
    """

    protocol: str
    refined: bool
    items: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    coarse_rotations: np.ndarray
    coarse_translations: np.ndarray
    true_rotations: np.ndarray
    true_translations: np.ndarray
    fitness: np.ndarray
    rmse: np.ndarray
    converged: np.ndarray

    def errors(self, *, coarse: bool = False) -> dict[str, np.ndarray]:
        """``pose_errors`` of every item, after refinement or (``coarse``) of the network alone."""
        found = (self.coarse_rotations, self.coarse_translations) if coarse else (self.rotations, self.translations)
        return pose_errors(*found, self.true_rotations, self.true_translations)

    def summary(self) -> dict[str, Any]:
        """The figures of the network alone and after refinement, as plain numbers."""
        refined = {"refined": summarize(self.errors())} if self.refined else {}
        return {
            "protocol": self.protocol,
            "items": len(self.items),
            "network": summarize(self.errors(coarse=True)),
            **refined,
            "converged": float(np.mean(self.converged)),
            "converged_but_off_by_5deg": float(np.mean(self.converged & (self.errors()["angle"] > 5.0))),
            "fitness_mean": float(np.mean(self.fitness)),
        }


def evaluate(
    model: Model,
    clouds: np.ndarray,
    *,
    protocol: str = "dcp",
    refine: ICP | None = ICP(),
    items: np.ndarray | None = None,
    batch: int = 64,
    progress: bool = True,
) -> Evaluation:
    """The evaluation of ``model`` with ``register`` over all items.

    Args:
      model: to evaluate.
      clouds: (S, P, 3) shapes in the unit sphere; item i is shape i.
      protocol: a name in ``PROTOCOLS``.
      refine: passed to ``register``.
      items: which items; all by default.
      batch: pairs at once.
      progress: whether a progress bar is shown.

    Raises:
      ValueError: an unknown protocol, or no items.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol: expected one of {sorted(PROTOCOLS)}, got {protocol!r}")
    chosen = np.arange(len(clouds)) if items is None else np.asarray(items)
    if len(chosen) == 0:
        raise ValueError("items: there is nothing to evaluate")
    if batch < 1:
        raise ValueError(f"batch: expected at least 1, got {batch}")
    batch = min(batch, len(chosen))

    @jax.jit
    def align(source: jax.Array, target: jax.Array) -> dict[str, jax.Array]:
        result = jax.vmap(lambda a, b: register(a, b, model=model, refine=refine))(source, target)
        return {
            "rotations": result.rotation,
            "translations": result.translation,
            "coarse_rotations": result.coarse.rotation,
            "coarse_translations": result.coarse.translation,
            "fitness": result.fitness,
            "rmse": result.rmse,
            "converged": result.converged,
        }

    found: list[dict[str, np.ndarray]] = []
    with tqdm(total=len(chosen), unit="pair", disable=not progress) as bar:
        for start in range(0, len(chosen), batch):
            part = chosen[start : start + batch]
            # The last batch is filled up with its own first item, so that one compiled program serves all.
            filled = np.concatenate([part, np.full(batch - len(part), part[0])])
            trials = [PROTOCOLS[protocol](clouds, int(item), points=clouds.shape[1]) for item in filled]
            stacked = Trial(*(np.stack(values) for values in zip(*trials, strict=True)))
            output = jax.device_get(align(jnp.asarray(stacked.source), jnp.asarray(stacked.target)))
            output |= {"true_rotations": stacked.rotation, "true_translations": stacked.translation}
            found.append({name: values[: len(part)] for name, values in output.items()})
            bar.update(len(part))
    joined = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    return Evaluation(protocol=protocol, refined=refine is not None, items=chosen, **joined)
