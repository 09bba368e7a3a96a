"""Rigid registration of 3D point clouds in JAX.

``register(source, target)`` finds the rotation and translation with ``target ≈ R @ source + t``: an unsupervised
region-aware transformer (3D-URRT, Hao and Fang) followed by exact refinement, as one pure function. ``stages`` tells
how, step by step, and ``model`` what the network does.

- One pair and many: ``registration`` (``register``), ``batches`` (``register_pairs``), ``result`` (``Registration``).
- The way of a pair: ``frames`` (its frame), ``prepared`` (a cloud prepared for all stages), ``stages``, and then
  ``model`` (the network), ``search`` (hypotheses), ``refine`` (ICP and EM-ICP), ``assessment`` (confidence).
- Geometry: ``clouds`` (points and mask, samples, normals), ``neighbors``, ``features``, ``rigid`` (rigid transforms).
- Compilation: ``programs`` (compiled once a shape), ``program_cache`` (kept on disk), ``warming``, ``loops``.
- Training: ``training``, ``losses``, ``data`` (shapes), ``weights`` (the packaged models).
- Measuring: ``evaluation`` (protocols, metrics, ``evaluate``), ``peers`` (other libraries' methods).
- Files, pictures, commands: ``io``, ``viewer``, ``cli``.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urrt_jax import (
        assessment,
        clouds,
        data,
        evaluation,
        features,
        io,
        losses,
        model,
        neighbors,
        peers,
        refine,
        rigid,
        search,
        stages,
        training,
        viewer,
    )
    from urrt_jax.batches import Registrations, register_pairs
    from urrt_jax.clouds import pad_clouds
    from urrt_jax.model import Model, ModelConfig
    from urrt_jax.program_cache import use_compilation_cache
    from urrt_jax.refine import ICP
    from urrt_jax.registration import register
    from urrt_jax.result import OtherPoses, Outcome, Registration
    from urrt_jax.search import Search
    from urrt_jax.warming import warm_up
    from urrt_jax.weights import available_models, load_model, model_card, save_model

__version__ = "0.2.0.dev0"

__all__ = [
    "ICP",
    "Model",
    "ModelConfig",
    "OtherPoses",
    "Outcome",
    "Registration",
    "Registrations",
    "Search",
    "assessment",
    "available_models",
    "clouds",
    "data",
    "evaluation",
    "features",
    "io",
    "load_model",
    "losses",
    "model",
    "model_card",
    "neighbors",
    "pad_clouds",
    "peers",
    "refine",
    "register",
    "register_pairs",
    "rigid",
    "save_model",
    "search",
    "stages",
    "training",
    "use_compilation_cache",
    "viewer",
    "warm_up",
]

# Where the public names live; what is not here is a module. All are imported at their first use (PEP 562), so that the
# command line answers --help without waiting for JAX.
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
    "warm_up": "urrt_jax.warming",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in _HOMES:
        return importlib.import_module(f"{__name__}.{name}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
