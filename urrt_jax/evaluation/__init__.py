"""Evaluation: protocols make pairs with their truth, methods align them, metrics compare, ``evaluate`` runs all."""

from urrt_jax.evaluation.evaluate import Evaluation, data_digest, evaluate, load_evaluation, spread, values_path
from urrt_jax.evaluation.interface import Method, Poses
from urrt_jax.evaluation.learned import Learned
from urrt_jax.evaluation.methods import Ours, find_method
from urrt_jax.evaluation.metrics import euler_angles, pose_errors, recall_curve, roc_curve, rotation_degrees, summarize
from urrt_jax.evaluation.protocols import PROTOCOLS, Trial, find_protocol
from urrt_jax.evaluation.scans import load_scan_pairs

__all__ = [
    "PROTOCOLS", "Evaluation", "Learned", "Method", "Ours", "Poses", "Trial", "data_digest", "euler_angles", "evaluate",
    "find_method", "find_protocol", "load_evaluation", "load_scan_pairs", "pose_errors", "recall_curve",
    "roc_curve", "rotation_degrees", "spread", "summarize", "values_path",
]  # fmt: skip
