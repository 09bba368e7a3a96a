"""Evaluation: protocols make pairs with their truth, metrics compare, ``evaluate`` runs a whole set in batches."""

from urrt_jax.evaluation.evaluate import Evaluation, evaluate
from urrt_jax.evaluation.metrics import euler_angles, pose_errors, summarize
from urrt_jax.evaluation.protocols import PROTOCOLS, Trial

__all__ = ["PROTOCOLS", "Evaluation", "Trial", "euler_angles", "evaluate", "pose_errors", "summarize"]
