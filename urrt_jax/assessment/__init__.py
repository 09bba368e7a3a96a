"""What is to be said of an alignment: how well clouds fit, how precise the pose is, and how sure.

``fit`` measures how surfaces lie on each other, ``find_alternatives`` looks for other poses that fit as well,
``precision`` tells what the residuals say of the pose, and ``confidence`` weighs all three.
"""

from urrt_jax.assessment.alternatives import Alternatives, find_alternatives
from urrt_jax.assessment.confidence import Confidence, confidence, measure, odds
from urrt_jax.assessment.fit import Fit, agreement, fit, fit_samples, inlier_share, well_posed
from urrt_jax.assessment.precision import Precision, information, moved_covariance, moved_information, precision

__all__ = [
    "Alternatives",
    "Confidence",
    "Fit",
    "Precision",
    "agreement",
    "confidence",
    "find_alternatives",
    "fit",
    "fit_samples",
    "information",
    "inlier_share",
    "measure",
    "moved_covariance",
    "moved_information",
    "odds",
    "precision",
    "well_posed",
]
