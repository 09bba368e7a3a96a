"""The 3D-URRT network (Hao and Fang): encoder, region partition, region attention, region decoders, fusion.

One module a stage, in that order; ``encoding.py`` composes the stages that see one cloud, ``network.py`` them all.
"""

from urrt_jax.model.config import ModelConfig
from urrt_jax.model.network import Estimate, Model, estimate, init_model

__all__ = ["Estimate", "Model", "ModelConfig", "estimate", "init_model"]
