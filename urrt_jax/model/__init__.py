"""The 3D-URRT network (Hao and Fang): encoder, region partition, region attention, region decoders, fusion.

One module a stage, in that order; ``network.py`` composes them.
"""

from urrt_jax.model.config import ModelConfig
from urrt_jax.model.network import Estimate, Model, estimate, init_model

__all__ = ["Estimate", "Model", "ModelConfig", "estimate", "init_model"]
