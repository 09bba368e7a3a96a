"""How sure it is that a pose is right: three checks, each of which can veto it.

Do surfaces lie on each other rather than cross; does no other pose fit as well; are the points enough to determine the
pose? Each check is a logistic regression on what was measured, and the confidence is the product of the three
probabilities. All were fitted together, by maximum likelihood, to training shapes, symmetric solids among them
(``experiments/confidence``, which measures them on others).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.assessment.alternatives import Alternatives
from urrt_jax.assessment.fit import Fit
from urrt_jax.assessment.precision import Precision

MEASURED = ("score", "significance", "spread", "deviation", "uncorrected")
"""What is measured of a pose (``measure``)."""
CHECKS: dict[str, dict[str, float]] = {
    "surfaces": {"bias": -14.07, "score": 21.99},
    "unique": {"bias": -2.56, "significance": 1.01},
    "determined": {"bias": 0.94, "deviation": -0.39, "uncorrected": -1.81, "spread": -1.79},
}
"""The logistic regression behind each check: its bias, and the weights of what it looks at."""


class Confidence(NamedTuple):
    """How sure a pose is.

    Attributes:
      surfaces: (), the probability that surfaces lie on each other.
      unique: (), that no other pose fits as well.
      determined: (), that the points determine the pose.
    """

    surfaces: Array
    unique: Array
    determined: Array

    @property
    def total(self) -> Array:
        """(), the probability that the pose is right: the product of all three."""
        return self.surfaces * self.unique * self.determined


def measure(found: Fit, others: Alternatives, precision: Precision) -> Array:
    """What confidence is made of, (5,), in the order of ``MEASURED``; no derivative passes.

    The score of the fit; the least significance of all alternatives; the logarithms of the spread and of both standard
    deviations of the rotation, in degrees.
    """
    degrees = jnp.rad2deg(jnp.stack([precision.deviation, precision.uncorrected]))
    logarithms = jnp.log(jnp.concatenate([precision.spread[None], degrees]) + 1e-3)
    measured = jnp.concatenate([jnp.stack([found.score, jnp.min(others.significance)]), logarithms])
    return jax.lax.stop_gradient(measured)


def confidence(measured: Array) -> Confidence:
    """How sure a pose is, of what was measured of it, (5,)."""
    return Confidence(*(jax.nn.sigmoid(_logit(check, measured)) for check in CHECKS))


def odds(others: Alternatives) -> Array:
    """The odds (K,) of each alternative against the pose itself: 1 where both fit alike, 0 where there is none."""
    return jnp.where(others.there, jnp.exp(-CHECKS["unique"]["significance"] * others.significance), 0.0)


def _logit(check: str, measured: Array) -> Array:
    weights = CHECKS[check]
    parts = [weights[name] * measured[k] for k, name in enumerate(MEASURED) if name in weights]
    return jnp.sum(jnp.stack(parts)) + weights["bias"]
