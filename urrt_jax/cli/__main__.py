"""``python -m urrt_jax.cli``, the same as ``urrt``."""

import sys

from urrt_jax.cli import console

sys.exit(console())
