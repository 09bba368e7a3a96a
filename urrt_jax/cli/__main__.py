"""``python -m urrt_jax.cli``, the same as ``urrt``."""

import sys

from urrt_jax.cli import main

sys.exit(main())
