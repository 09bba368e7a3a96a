"""Reading and writing one point cloud or mesh, and reading a transform.

Coordinates keep their digits: text and PLY are read and written in double precision, because a cloud in map
coordinates (500,000 m) loses centimetres in single precision. What a header promises is compared with the file's length
before memory is asked for. Every complaint about a file is a `ValueError` that names it.
"""

from urrt_jax.io.cloud import MAX_POINTS, PointCloud
from urrt_jax.io.formats import CLOUD_FORMATS, MESH_FORMATS, READABLE, WRITABLE, holds_colors, holds_normals
from urrt_jax.io.reading import read_cloud, read_geometry, read_mesh, read_point_cloud
from urrt_jax.io.surface import MAX_SAMPLES, check_samples, sample_surface
from urrt_jax.io.transform import read_transform
from urrt_jax.io.writing import check_writable, write_cloud

__all__ = [
    "CLOUD_FORMATS",
    "MAX_POINTS",
    "MAX_SAMPLES",
    "MESH_FORMATS",
    "READABLE",
    "WRITABLE",
    "PointCloud",
    "check_samples",
    "check_writable",
    "holds_colors",
    "holds_normals",
    "read_cloud",
    "read_geometry",
    "read_mesh",
    "read_point_cloud",
    "read_transform",
    "sample_surface",
    "write_cloud",
]
