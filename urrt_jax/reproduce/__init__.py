"""Reproduction of tables and figures: an experiment is a folder with a ``config.toml``; one call writes its results.

``results.json`` holds every figure, ``table.md`` and the pictures are drawn from it alone.
"""

from urrt_jax.reproduce.experiment import Experiment, find_experiment, list_experiments
from urrt_jax.reproduce.pictures import draw_pairs
from urrt_jax.reproduce.run import reproduce
from urrt_jax.reproduce.tables import as_markdown

__all__ = ["Experiment", "as_markdown", "draw_pairs", "find_experiment", "list_experiments", "reproduce"]
