"""Normals of clouds: masked local principal component analysis."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds.cloud import Cloud
from urrt_jax.rigid import cross

_AT_ONCE = 128  # points whose neighbourhoods are summed at once
_FAR = 1e18  # radii; its square is still a float32 number
_REACH, _GAIN = 1.5, 2.0  # in radii, of the neighbours that vote; and the growth of signs that agree, up to ±1
_HIGHEST = jax.lax.Precision.HIGHEST
_SINGULAR = 2e-3  # what rounding, of which arccos makes its root, leaves of a cross product that should vanish


def normals(points: Array, cloud: Cloud, radius: Array | float, centre: Array) -> Array:
    """Unit normals (N, 3) of the surface that ``cloud`` samples, at ``points`` (N, 3).

    The direction in which the cloud's points within ``radius`` vary least (Hoppe et al. 1992). Its sign is the one that
    points away from ``centre`` (3,), the cloud's centroid, say: scans and solids are oriented alike then, wherever they
    are not seen edge-on. Where fewer than three points are near, it is still a unit vector, of no meaning. Derivatives
    are those of the neighbourhoods at hand.

    Args:
      points: where.
      cloud: M points, real ones finite. Memory is O(N + M) without derivatives, O(N·M) with them.
      radius: of the neighbourhood.
      centre: what normals point away from.
    """
    radius = jax.lax.stop_gradient(jnp.asarray(radius, points.dtype))
    normal = jax.vmap(least_axis)(_spreads(points, cloud, radius))
    inward = jnp.sum(normal * (points - centre), axis=-1, keepdims=True) < 0
    return jnp.where(inward, -normal, normal)


def face_alike(normals: Array, cloud: Cloud, radius: Array | float, *, steps: Array | int) -> Array:
    """The normals (N, 3) of a cloud's N points, turned around where that makes them agree with their neighbours'.

    Each sign becomes, step by step, what the neighbours say of it, by how near they are and how nearly parallel their
    normals. So normals of a patch face alike; a patch as a whole may still be the wrong way around. Memory is O(N²).

    Args:
      normals: unit vectors; where they point away from the cloud's centroid is what the iteration begins with.
      cloud: the points.
      radius: within which neighbours count most.
      steps: how often they are asked; 0 leaves normals pointing away from the origin.
    """
    squared = jnp.sum((cloud.points[:, None] - cloud.points) ** 2, axis=-1)
    near = cloud.mask & (squared > 0)
    parallel = jnp.matmul(normals, normals.T, precision=_HIGHEST) ** 3
    votes = jnp.where(near, jnp.exp(-squared / (_REACH * radius) ** 2) * parallel, 0.0)
    votes = votes / jnp.maximum(jnp.sum(jnp.abs(votes), axis=1, keepdims=True), 1e-9)
    outward = jnp.sum(normals * cloud.points, axis=1)
    typical = jnp.sum(jnp.where(cloud.mask, jnp.abs(outward), 0.0)) / jnp.maximum(jnp.sum(cloud.mask), 1)
    outward = outward / jnp.maximum(typical, 1e-9)
    begin = jnp.clip(outward, -1.0, 1.0)
    signs = jax.lax.fori_loop(0, steps, lambda _, signs: jnp.clip(_GAIN * votes @ signs, -1.0, 1.0), begin)
    return jnp.where(signs[:, None] < 0, -normals, normals)


def _spreads(points: Array, cloud: Cloud, radius: Array) -> Array:
    """The covariances (N, 3, 3), in squared radii, of the cloud's points within the radius of each point (N, 3).

    Sums over neighbours are a product of matrices: one tells which points are near, the other holds the moments of each
    point. Moments are taken about the middle of a few queries, which are near each other where clouds are sorted along
    a curve: so float32 keeps their digits.
    """
    count = points.shape[0]
    few = min(_AT_ONCE, count)
    # Mirrored at the end, so that what fills the last few up is near them.
    queries = jnp.pad(points, ((0, -count % few), (0, 0)), mode="reflect").reshape(-1, few, 3)

    def some(queries: Array) -> Array:
        # Between their quartiles: a stray query, far away or not finite, hardly moves it.
        in_order = jnp.sort(jax.lax.stop_gradient(queries), axis=0)
        centre = (in_order[few // 4] + in_order[-1 - few // 4]) / 2
        at, others = (queries - centre) / radius, (cloud.points - centre) / radius
        # Padding lies far away, which costs less than to ask the mask again of every query.
        apart = jnp.where(cloud.mask[:, None], others, _FAR)
        squared = sum((at[:, None, k] - apart[None, :, k]) ** 2 for k in range(3))
        near = jax.lax.stop_gradient(jnp.where(squared < 1, jnp.ones_like(squared), 0.0))
        x, y, z = jnp.where(cloud.mask, others.T, 0.0)
        moments = jnp.stack([jnp.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
        return jnp.matmul(near, moments, precision=_HIGHEST)

    number, *sums = jax.lax.map(some, queries).reshape(-1, 10)[:count].T
    x, y, z, xx, xy, xz, yy, yz, zz = (each / jnp.maximum(number, 1) for each in sums)
    xx, xy, xz, yy, yz, zz = xx - x * x, xy - x * y, xz - x * z, yy - y * y, yz - y * z, zz - z * z
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)


@jax.custom_jvp
def least_axis(spread: Array) -> Array:
    """A unit eigenvector (3,) of the smallest eigenvalue of a symmetric matrix (3, 3) of any scale, in closed form.

    The eigenvalue by Smith's trigonometric formula (1961), the vector as the longest cross product of two rows of what
    then is singular. Where the two smallest eigenvalues agree, that vanishes, and any direction across the longest row
    will do; z for a multiple of the identity.
    """
    axes = jnp.eye(3, dtype=spread.dtype)
    largest = jnp.max(jnp.abs(spread))
    spread = spread / jnp.where(largest > 0, largest, 1.0)
    mean = jnp.trace(spread) / 3
    rest = spread - mean * axes
    size = jnp.sqrt(jnp.maximum(jnp.sum(rest**2) / 6, 1e-30))
    rest = rest / size
    angle = jnp.arccos(jnp.clip(jnp.linalg.det(rest) / 2, -1.0, 1.0)) / 3
    rows = rest - 2 * jnp.cos(angle + 2 * jnp.pi / 3) * axes
    crosses = jnp.stack([cross(rows[0], rows[1]), cross(rows[1], rows[2]), cross(rows[2], rows[0])])
    longest = crosses[jnp.argmax(jnp.sum(crosses**2, axis=-1))]
    row = rows[jnp.argmax(jnp.sum(rows**2, axis=-1))]
    across = cross(row, axes[jnp.argmin(jnp.abs(row))])
    vector = jnp.where(jnp.linalg.norm(longest) > _SINGULAR, longest, across)
    length = jnp.linalg.norm(vector)
    return jnp.where(length > _SINGULAR, vector / jnp.maximum(length, _SINGULAR), axes[2])


@least_axis.defjvp
def _least_axis_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """First-order perturbation of an eigenvector; nothing where another eigenvalue is nearly the same."""
    (spread,), (change,) = primals, tangents
    vector = least_axis(spread)
    least = vector @ jnp.matmul(spread, vector, precision=_HIGHEST)
    # In closed form in the plane across the vector: batches of LAPACK's eigh may wait for each other for ever on a CPU.
    first = cross(vector, jnp.eye(3, dtype=vector.dtype)[jnp.argmin(jnp.abs(vector))])
    first /= jnp.linalg.norm(first)
    plane = jnp.stack([first, cross(vector, first)])
    above = jnp.matmul(plane, jnp.matmul(spread, plane.T, precision=_HIGHEST), precision=_HIGHEST)
    above -= least * jnp.eye(2, dtype=least.dtype)
    along = jnp.matmul(plane, jnp.matmul(change, vector, precision=_HIGHEST), precision=_HIGHEST)
    determinant = above[0, 0] * above[1, 1] - above[0, 1] * above[1, 0]
    usable = determinant > 1e-3 * jnp.maximum(jnp.trace(above) ** 2, jnp.finfo(spread.dtype).tiny)
    adjugate = jnp.array([[above[1, 1], -above[0, 1]], [-above[1, 0], above[0, 0]]])
    turn = jnp.matmul(adjugate, along, precision=_HIGHEST) / jnp.where(usable, determinant, 1.0)
    return vector, -jnp.matmul(jnp.where(usable, turn, 0.0), plane, precision=_HIGHEST)
