"""Shapes to train on and to evaluate with: ModelNet40, folders of meshes and clouds, and made-up solids."""

from urrt_jax.data.procedural import demo_shape, procedural_shapes
from urrt_jax.data.shapes import Shapes
from urrt_jax.data.solid import sample_occupancy, voxelize_solid
from urrt_jax.data.sources import find_data, load_shapes
from urrt_jax.data.symmetric import symmetric_shapes, symmetry

__all__ = [
    "Shapes",
    "demo_shape",
    "find_data",
    "load_shapes",
    "procedural_shapes",
    "sample_occupancy",
    "symmetric_shapes",
    "symmetry",
    "voxelize_solid",
]
