"""A cloud is (points, mask): checking, padding, ordering and subsampling it, and its normals."""

from urrt_jax.clouds.checks import CloudLike, as_array, check_cloud
from urrt_jax.clouds.cloud import Cloud, centroid, first, make_cloud, mean_square_radius, pad_clouds, shift, take
from urrt_jax.clouds.curve import curve_order
from urrt_jax.clouds.normals import face_alike, normals
from urrt_jax.clouds.sampling import farthest_points, subsample, thin, thinned_rows

__all__ = [
    "Cloud",
    "CloudLike",
    "as_array",
    "centroid",
    "check_cloud",
    "curve_order",
    "face_alike",
    "farthest_points",
    "first",
    "make_cloud",
    "mean_square_radius",
    "normals",
    "pad_clouds",
    "shift",
    "subsample",
    "take",
    "thin",
    "thinned_rows",
]
