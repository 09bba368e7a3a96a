"""Rigid registration of 3D point clouds in JAX.

``register(source, target)`` finds the rotation and translation with ``target ≈ R @ source + t``: an unsupervised
region-aware transformer (3D-URRT, Hao and Fang) followed by exact refinement, as one pure function.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urrt_jax.batches import Registrations, register_pairs
    from urrt_jax.clouds import pad_clouds
    from urrt_jax.model import Model, ModelConfig
    from urrt_jax.program_cache import use_compilation_cache
    from urrt_jax.refine import ICP
    from urrt_jax.registration import register
    from urrt_jax.result import OtherPoses, Outcome, Registration
    from urrt_jax.search import Search
    from urrt_jax.warm_up import warm_up
    from urrt_jax.weights import available_models, load_model, model_card, save_model

__version__ = "0.1.0"

__all__ = [
    "ICP",
    "Model",
    "ModelConfig",
    "OtherPoses",
    "Outcome",
    "Registration",
    "Registrations",
    "Search",
    "available_models",
    "load_model",
    "model_card",
    "pad_clouds",
    "register",
    "register_pairs",
    "save_model",
    "use_compilation_cache",
    "warm_up",
]

# Where the public names live. They are imported at their first use (PEP 562), so that the command line answers --help
# without waiting for JAX.
_HOMES = {
    "ICP": "urrt_jax.refine",
    "Model": "urrt_jax.model",
    "ModelConfig": "urrt_jax.model",
    "OtherPoses": "urrt_jax.result",
    "Outcome": "urrt_jax.result",
    "Registration": "urrt_jax.result",
    "Registrations": "urrt_jax.batches",
    "Search": "urrt_jax.search",
    "available_models": "urrt_jax.weights",
    "load_model": "urrt_jax.weights",
    "model_card": "urrt_jax.weights",
    "pad_clouds": "urrt_jax.clouds",
    "register": "urrt_jax.registration",
    "register_pairs": "urrt_jax.batches",
    "save_model": "urrt_jax.weights",
    "use_compilation_cache": "urrt_jax.program_cache",
    "warm_up": "urrt_jax.warm_up",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | _HOMES.keys())
