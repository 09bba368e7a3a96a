"""Refinement on its own: what it recovers and resists, its derivatives, and that it says when it did not finish."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, make_cloud, normalize_pair
from urrt_jax.geometry.neighbors import spacing
from urrt_jax.refine import ICP, icp

TURN = Rotation.from_euler("zyx", [8, -5, 6], degrees=True).as_matrix()
# Compiling takes far longer than running: all clouds are padded to this size, and programs for derivatives, which run
# on small clouds, are not optimised.
_ROWS = 1320
_HASTY = {"xla_backend_optimization_level": 0}
_icp = functools.partial(jax.jit, static_argnames="config")(icp)
_normalize_pair = jax.jit(normalize_pair)


def _surface(count: int, seed: int = 0) -> np.ndarray:
    """Points of an asymmetric surface: a bent ellipsoid with a bump, (count, 3)."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= [1.0, 0.7, 0.45]
    points[:, 2] += 0.3 * points[:, 0] ** 2
    return points + 0.35 * np.exp(-8 * np.sum((points - [0.7, 0.4, 0.3]) ** 2, axis=1))[:, None] * [0.5, 1.0, 0.2]


@pytest.fixture(scope="module")
def surface():
    return _surface(1200)


def _padded(points: np.ndarray, rows: int = _ROWS) -> Cloud:
    values = np.zeros((rows, 3))
    values[: len(points)] = points
    return make_cloud(jnp.asarray(values, jnp.result_type(float)), np.arange(rows) < len(points))


def refine(source: np.ndarray, target: np.ndarray, config: ICP = ICP(), *, rows: int = _ROWS) -> tuple[float, bool]:
    """The rotation error in degrees against TURN, from the identity, and whether it converged."""
    source_cloud, target_cloud, _ = _normalize_pair(_padded(source, rows), _padded(target, rows))
    result = _icp(source_cloud, target_cloud, rigid.identity(), config)
    return float(rotation_degrees(result.transform.rotation, TURN)), bool(result.converged)


def test_same_points_are_aligned_exactly(surface):
    error, converged = refine(surface, surface @ TURN.T)
    assert error < 1e-3
    assert converged


def test_points_without_counterparts_are_aligned_within_their_spacing(surface):
    source = surface[::2]
    error, converged = refine(source, surface[1::2] @ TURN.T)
    radius = np.sqrt(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1)))
    assert error < np.degrees(float(spacing(make_cloud(jnp.asarray(source, jnp.float32)))) / radius)
    assert converged


def test_planes_align_independent_samples_better_than_points_do():
    """Points of one sample lie between those of the other, and hold each other where they happen to be."""
    samples = [(_surface(500, seed), _surface(500, seed + 100) @ TURN.T) for seed in range(4)]
    planes, points = (np.mean([refine(*each, config)[0] for each in samples]) for config in (ICP(), ICP(plane=0.0)))
    assert planes < 0.5 * points


def test_sparse_noisy_samples_end_softly():
    """The nearest point is a poor counterpart; all points together know better."""
    random = np.random.default_rng(0)
    samples = [
        [_surface(400, 2 * k + side) + random.normal(scale=0.01, size=(400, 3)) for side in (0, 1)] for k in range(6)
    ]
    soft, hard = (
        [refine(source, target @ TURN.T, config, rows=400) for source, target in samples]
        for config in (ICP(), ICP(soft_points=0))
    )
    assert all(converged for _, converged in soft)
    assert np.mean([error for error, _ in soft]) < 0.8 * np.mean([error for error, _ in hard])


@pytest.mark.parametrize("kind", ["the same points", "a crop", "outliers"])
def test_only_whole_clouds_without_counterparts_end_softly(kind):
    points, other, random = _surface(400), _surface(400, 1), np.random.default_rng(1)
    source = {
        "the same points": points,
        "a crop": other[np.argsort(other[:, 0])[:200]],
        "outliers": np.concatenate([points[:300], random.uniform(-1, 1, size=(100, 3))]),
    }[kind]
    soft, hard = (refine(source, points @ TURN.T, config, rows=400) for config in (ICP(), ICP(soft_points=0)))
    assert soft == hard


def test_gross_outliers_do_not_pull(surface):
    stray = np.random.default_rng(1).uniform(-1.5, 1.5, size=(120, 3))
    error, converged = refine(np.concatenate([surface, stray]), surface @ TURN.T)
    assert error < 1e-3
    assert converged


def test_what_has_no_counterpart_does_not_pull(surface):
    """Points that are in both clouds lie on each other in the end, exactly, whatever else the clouds hold."""
    sparse, random = _surface(300), np.random.default_rng(0)
    pairs = [
        (surface[surface[:, 0] < 0.5], surface[surface[:, 1] > -0.3]),
        (sparse[random.random(300) < 0.7], sparse[random.random(300) < 0.7]),
        (sparse[::2], sparse),
    ]
    for source, target in pairs:
        error, converged = refine(source, target @ TURN.T)
        assert error < 1e-3
        assert converged


def test_what_has_no_counterpart_does_not_pull_in_dense_clouds():
    """Of which some points ask and blocks answer, and which are thinned first, so that hardly any point has one."""
    dense, random = _surface(9000), np.random.default_rng(0)
    source, target = (dense[random.random(9000) < 0.7] for _ in range(2))
    error, converged = refine(source, target @ TURN.T, rows=6600)
    assert error < 1e-4
    assert converged


def test_large_clouds_take_all_iterations_and_no_more():
    dense = _surface(10_000)
    source, target = _padded(dense[::2], 6600), _padded(dense[1::2], 6600)
    found = _icp(source, target, rigid.Rigid(jnp.asarray(TURN.T, jnp.float32), jnp.zeros(3)), ICP(iterations=4))
    assert int(found.iterations) == 4 and not bool(found.converged)


def test_the_reach_stays_where_nothing_coincides():
    """Shrinking onto the few pairs that happen to be near would be worse than not shrinking at all."""
    samples = [(_surface(500, seed), _surface(500, seed + 100) @ TURN.T) for seed in range(4)]
    usual, few = (
        np.mean([refine(*each, config)[0] for each in samples]) for config in (ICP(), ICP(inlier_distance=0.05))
    )
    assert usual < 0.6 * few


def test_too_few_iterations_are_not_called_converged(surface):
    _, converged = refine(surface[::2], surface[1::2] @ TURN.T, ICP(iterations=2, plane=0.0))
    assert not converged


def test_clouds_out_of_reach_are_not_called_converged(surface):
    source = _padded(surface)
    far = rigid.Rigid(jnp.eye(3), jnp.array([50.0, 0.0, 0.0]))
    assert not bool(_icp(source, source, far, ICP(coarse_points=0, plane=0.0)).converged)


def test_an_empty_cloud_keeps_the_initial_transform(surface):
    source = _padded(surface)
    initial = rigid.Rigid(jnp.asarray(TURN, jnp.float32), jnp.array([1.0, 2.0, 3.0]))
    result = _icp(source, _padded(surface[:0]), initial, ICP())
    np.testing.assert_allclose(result.transform.rotation, TURN, atol=1e-6)
    assert not bool(result.converged)


# Clouds that leave part of the pose or all of it open, at most 200 points.
_DEGENERATE = {
    "a plane": np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0],
    "a sphere": Rotation.random(200, random_state=0).as_matrix()[:, 0],
    "a line": np.outer(np.linspace(-1, 1, 200), [0.3, -0.5, 0.8]),
    "coincident points": np.ones((200, 3)),
    "three points": np.eye(3),
    "two points": np.eye(3)[:2],
    "one point": np.eye(3)[:1],
}


def _turned(shape: str, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A degenerate cloud, and the same turned and moved."""
    points, turn = _DEGENERATE[shape], Rotation.from_rotvec([0, angle, 0.5 * angle]).as_matrix()
    return points, points @ turn.T + 0.3 * angle


@pytest.mark.parametrize("shape", _DEGENERATE)
@pytest.mark.parametrize("angle", [0.0, 0.2])
def test_the_transform_of_a_degenerate_cloud_is_rigid(shape, angle):
    source, target = (_padded(each) for each in _turned(shape, angle))
    rotation, translation = _icp(source, target, rigid.identity(), ICP()).transform
    assert np.isfinite(translation).all()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)


_EXACTLY = {"tolerance": 1e-9, "iterations": 400, "coarse_points": 64}
_HARD = _EXACTLY | {"soft_points": 0}
_FROM_HERE = _HARD | {"coarse_points": 0, "plane": 0.0}


def _slope(source: Cloud, target: Cloud, config: ICP):
    """A weighted sum of the refined pose, whether it converged, and the sum's gradients."""
    weights = jnp.asarray(np.random.default_rng(5).normal(scale=100.0, size=(3, 4)))

    def total(source_points, target_points):
        clouds = source._replace(points=source_points), target._replace(points=target_points)
        found = icp(*clouds, rigid.identity(), config)
        pose = jnp.concatenate([found.transform.rotation, found.transform.translation[:, None]], axis=1)
        return jnp.sum(weights * pose), found.converged

    return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(source.points, target.points)


_jitted_slope = functools.partial(jax.jit, static_argnames="config", compiler_options=_HASTY)(_slope)


def _even_surface(seed: int) -> np.ndarray:
    """A bent ellipsoid sampled evenly, with noise, (200, 3): every neighbourhood has enough points for a normal."""
    height, around = 1 - (2 * np.arange(200) + 1) / 200, np.pi * (1 + 5**0.5) * np.arange(200)
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(around), ring * np.sin(around), height], 1)
    points = sphere @ Rotation.random(random_state=seed).as_matrix() * [1.0, 0.7, 0.45]
    points[:, 2] += 0.3 * points[:, 0] ** 2
    return points + 0.01 * np.random.default_rng(seed).normal(size=points.shape)


@pytest.mark.parametrize("argument", [0, 1], ids=["source", "target"])
@pytest.mark.parametrize(
    "config",
    [
        pytest.param(ICP(**_HARD), id="planes"),
        pytest.param(ICP(**_HARD, plane=0.0), id="points"),
        pytest.param(ICP(**_FROM_HERE, mutual=True), id="mutual"),
        pytest.param(ICP(**_FROM_HERE, trim=True), id="trim"),
    ],
)
def test_derivative_agrees_with_finite_differences(config, argument, x64):
    source, target = _even_surface(1), _even_surface(2) @ TURN.T + [0.05, -0.03, 0.04]
    clouds = source[source[:, 0] < 0.4], target
    direction = np.random.default_rng(7).normal(size=clouds[argument].shape)

    def at(step):
        moved = [each + step * direction if i == argument else each for i, each in enumerate(clouds)]
        return _jitted_slope(*(_padded(each, 200) for each in moved), config)

    (_, converged), gradients = at(0.0)
    assert bool(converged)
    expected = float(at(1e-6)[0][0] - at(-1e-6)[0][0]) / 2e-6
    slope = float(jnp.sum(gradients[argument][: len(direction)] * direction))
    assert slope == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("shape", "angle"),
    [
        *((shape, 0.0) for shape in _DEGENERATE),
        *((shape, 0.2) for shape in _DEGENERATE),
    ],
)
def test_derivatives_of_a_degenerate_cloud_are_finite(shape, angle, x64):
    _, gradients = _jitted_slope(*(_padded(each, 200) for each in _turned(shape, angle)), ICP(**_EXACTLY))
    assert np.isfinite(gradients).all()


@pytest.mark.parametrize("plane", [0.0, 0.97])
def test_single_precision_stays_so_where_double_precision_is_on(plane, x64):
    cloud = make_cloud(jnp.asarray(_surface(60), jnp.float32))
    config = ICP(plane=plane)

    def shift(points):
        found = icp(cloud._replace(points=points), cloud, rigid.identity(), config).transform
        return jnp.sum(found.translation), found

    gradient, found = jax.eval_shape(jax.grad(shift, has_aux=True), cloud.points)
    assert {leaf.dtype for leaf in (*found, gradient)} == {jnp.dtype("float32")}


def test_vmap_agrees_with_a_loop(x64):
    pairs = [(_surface(200, seed), _surface(200 - 40 * seed, seed) @ TURN.T) for seed in range(3)]
    pairs = [tuple(_padded(each, 200) for each in pair) for pair in pairs]
    config = ICP(**_HARD, plane=0.0)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    together = jax.jit(jax.vmap(lambda *pair: _slope(*pair, config)), compiler_options=_HASTY)(*stacked)
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), *(_jitted_slope(*pair, config) for pair in pairs))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6), together, alone)


@pytest.mark.parametrize(
    "options",
    [
        {"points": 2},
        {"points": 100.0},
        {"iterations": 0},
        {"reach": 0.0},
        {"tolerance": float("nan")},
        {"coarse_points": -1},
        {"inlier_distance": float("inf")},
        {"plane": 1.5},
        {"plane": -0.1},
        {"plane": float("nan")},
        {"normal_radius": 0.0},
        {"normal_radius": -3.0},
        {"soft_points": -1},
        {"soft_points": 640.5},
    ],
)
def test_unusable_options_are_named(options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))}: expected"):
        ICP(**options)
