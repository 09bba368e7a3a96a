"""Tables and figures of the paper, and tables beyond it, written from a configuration each.

An experiment is a folder of `experiments/` with a `config.toml`. `python -m experiments.reproduce NAME`, run from the
root of the clone, measures it and writes `results.json`, which holds every number; `table.md` and the figures are drawn
from `results.json` alone.
"""
