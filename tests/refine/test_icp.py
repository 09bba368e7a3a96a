"""Refinement on its own: what it recovers and resists, its derivatives, and that it says when it did not finish."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.frames import normalize_pair
from urrt_jax.neighbors import spacing
from urrt_jax.prepared import THINNED, Prepared, Sizes, prepare
from urrt_jax.refine import ICP, Settled, differentiable_pose, expect, find_basin, settle, settle_thinned
from urrt_jax.rigid import Rigid

TURN = Rotation.from_euler("zyx", [8, -5, 6], degrees=True).as_matrix()
# Compiling takes far longer than running: clouds are padded to one of three sizes, every stage is compiled once for
# each, and programs for derivatives, which run on small clouds, are not optimised.
_SMALL, _ROWS, _LARGE = 200, 1320, 6600
_SIZES = Sizes(sample=512, queries=ICP().points, normal_radius=ICP().normal_radius)

_normalize = jax.jit(normalize_pair)
_prepare, _find_basin, _thinned, _settle, _expect = map(jax.jit, (prepare, find_basin, settle_thinned, settle, expect))


def _at_end(
    how: ICP, clouds: tuple[Prepared, Prepared], start: Rigid, *, basin: bool = True
) -> tuple[Settled, Settled]:
    """What the second and the third stage end with, stage after stage, as ``register`` calls them.

    Without ``basin`` the first stage is left out.
    """
    pose, width = start, jnp.asarray(how.reach, clouds[0].spacing.dtype)
    if basin:
        pose, width = _find_basin(how, clouds[0].samples, clouds[1].samples, start)
    if len(clouds[0].cloud.mask) > THINNED:
        pose, width = _thinned(how, *clouds, pose, width)
    settled = _settle(how, *clouds, pose, width)
    return settled, _expect(how, *clouds, settled)


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


def _ready(source: np.ndarray, target: np.ndarray, rows: int = _ROWS) -> tuple[Prepared, Prepared]:
    """Both clouds in their frame, prepared."""
    source, target, _ = _normalize(_padded(source, rows), _padded(target, rows))
    return _prepare(_SIZES, source), _prepare(_SIZES, target)


def _outcome(end: Settled) -> tuple[float, bool]:
    """The rotation error in degrees against TURN, and whether it converged."""
    return float(rotation_degrees(end.transform.rotation, TURN)), bool(end.converged)


def refine(source: np.ndarray, target: np.ndarray, how: ICP = ICP(), *, rows: int = _ROWS) -> tuple[float, bool]:
    """The rotation error in degrees against TURN, from the identity, and whether it converged."""
    return _outcome(_at_end(how, _ready(source, target, rows), rigid.identity())[1])


def _error_of_the_second_stage(samples: list[tuple[Prepared, Prepared]], how: ICP) -> float:
    """The mean rotation error in degrees before the third stage, which would make up for much."""
    return float(np.mean([_outcome(_at_end(how, each, rigid.identity())[0])[0] for each in samples]))


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
    samples = [_ready(_surface(500, seed), _surface(500, seed + 100) @ TURN.T) for seed in range(4)]
    planes, points = (_error_of_the_second_stage(samples, how) for how in (ICP(), ICP(plane=0.0)))
    assert planes < 0.5 * points


def test_sparse_noisy_samples_gain_from_the_third_stage():
    """The nearest point is a poor counterpart; all points together know better."""
    random = np.random.default_rng(0)
    samples = [
        [_surface(400, 2 * k + side) + random.normal(scale=0.01, size=(400, 3)) for side in (0, 1)] for k in range(6)
    ]
    ends = [_at_end(ICP(), _ready(source, target @ TURN.T), rigid.identity()) for source, target in samples]
    assert all(bool(settled.sparse) for settled, _ in ends)
    second, third = ([_outcome(pair[k]) for pair in ends] for k in (0, 1))
    assert all(converged for _, converged in third)
    assert np.mean([error for error, _ in third]) < 0.8 * np.mean([error for error, _ in second])


@pytest.mark.parametrize("kind", ["the same points", "a crop", "outliers", "many points"])
def test_only_small_whole_clouds_without_counterparts_go_through_the_third_stage(kind, surface):
    points, other, random = _surface(400), _surface(400, 1), np.random.default_rng(1)
    source = {
        "the same points": points,
        "a crop": other[np.argsort(other[:, 0])[:200]],
        "outliers": np.concatenate([points[:300], random.uniform(-1, 1, size=(100, 3))]),
        "many points": _surface(ICP().em_points + 1, 1),
    }[kind]
    settled, expected = _at_end(ICP(), _ready(source, points @ TURN.T), rigid.identity())
    assert not bool(settled.sparse)
    jax.tree.map(np.testing.assert_array_equal, expected, settled)


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
    error, converged = refine(source, target @ TURN.T, rows=_LARGE)
    assert error < 1e-4
    assert converged


def test_large_clouds_take_all_iterations_and_no_more():
    dense = _surface(10_000)
    clouds = _ready(dense[::2], dense[1::2], _LARGE)
    start = Rigid(jnp.asarray(TURN.T, jnp.float32), jnp.zeros(3))
    _, found = _at_end(ICP(iterations=4), clouds, start)
    assert int(found.iterations) == 4 and not bool(found.converged)


def test_large_clouds_begin_thinned_near_the_answer():
    """Among a quarter of the queries, which is a good start for all of them."""
    dense = _surface(10_000)
    clouds = _ready(dense[::2], dense[1::2] @ TURN.T, _LARGE)
    pose, width = _find_basin(ICP(), *(each.samples for each in clouds), rigid.identity())
    near, narrow = _thinned(ICP(), *clouds, pose, width)
    errors = [float(rotation_degrees(each.rotation, TURN)) for each in (pose, near)]
    assert errors[1] < 0.5 * errors[0]
    assert float(narrow) == pytest.approx(max(float(each.spacing) for each in clouds), rel=1e-5)


def test_clouds_that_are_not_both_large_are_not_thinned():
    dense = _surface(10_000)
    clouds = _ready(dense[::2], dense[:500] @ TURN.T, _LARGE)
    start, width = Rigid(jnp.asarray(TURN, jnp.float32), jnp.ones(3)), jnp.float32(0.25)
    pose, same = _thinned(ICP(), *clouds, start, width)
    jax.tree.map(np.testing.assert_array_equal, pose, start)
    assert float(same) == 0.25


def test_without_points_the_first_stage_returns_its_start(surface):
    clouds = _ready(surface, surface)
    start = Rigid(jnp.asarray(TURN, jnp.float32), jnp.ones(3))
    pose, width = find_basin(ICP(coarse_points=0, reach=0.3), *(each.samples for each in clouds), start)
    jax.tree.map(np.testing.assert_array_equal, pose, start)
    assert float(width) == np.float32(0.3)


def test_the_width_stays_where_nothing_coincides():
    """Shrinking onto the few pairs that happen to be near would be worse than not shrinking at all."""
    samples = [_ready(_surface(500, seed), _surface(500, seed + 100) @ TURN.T) for seed in range(4)]
    usual, few = (_error_of_the_second_stage(samples, how) for how in (ICP(), ICP(inlier_distance=0.05)))
    assert usual < 0.6 * few


def test_too_few_iterations_are_not_called_converged(surface):
    _, converged = refine(surface[::2], surface[1::2] @ TURN.T, ICP(iterations=2, plane=0.0))
    assert not converged


def test_clouds_out_of_reach_are_not_called_converged(surface):
    clouds = _ready(surface, surface)
    far = Rigid(jnp.eye(3), jnp.array([50.0, 0.0, 0.0]))
    assert not bool(_at_end(ICP(plane=0.0), clouds, far, basin=False)[1].converged)


def test_an_empty_cloud_keeps_the_initial_transform(surface):
    clouds = tuple(_prepare(_SIZES, _padded(points)) for points in (surface, surface[:0]))
    initial = Rigid(jnp.asarray(TURN, jnp.float32), jnp.array([1.0, 2.0, 3.0]))
    _, result = _at_end(ICP(), clouds, initial)
    np.testing.assert_allclose(result.transform.rotation, TURN, atol=1e-6)
    np.testing.assert_allclose(result.transform.translation, initial.translation, atol=1e-6)
    assert not bool(result.converged)


def test_swapped_clouds_give_the_inverse(surface):
    """Both clouds have queries, so that neither is preferred; steps are told in the target's frame."""
    source, target = surface[surface[:, 0] < 0.5], surface[surface[:, 1] > -0.3] @ TURN.T
    start = Rigid(jnp.asarray(TURN, jnp.float32), jnp.zeros(3))
    forth, back = (
        _at_end(ICP(), clouds, first, basin=False)[1].transform
        for clouds, first in (
            (_ready(source, target), start),
            (_ready(target, source), rigid.inverse(start)),
        )
    )
    np.testing.assert_allclose(rigid.inverse(back).rotation, forth.rotation, atol=1e-4)
    np.testing.assert_allclose(rigid.inverse(back).translation, forth.translation, atol=1e-4)


def test_numbers_that_are_not_static_compile_nothing_anew(surface):
    clouds = _ready(surface[::2], surface[1::2] @ TURN.T)
    _at_end(ICP(), clouds, rigid.identity())
    stages = _find_basin, _settle, _expect
    before = [each._cache_size() for each in stages]
    other = ICP(coarse_iterations=5, reach=0.2, iterations=7, inlier_distance=0.7, plane=0.5, tolerance=1e-3)
    _at_end(other, clouds, rigid.identity())
    assert [each._cache_size() for each in stages] == before


def test_a_number_that_is_traced_is_as_good_as_one_that_is_written(surface):
    clouds = _ready(surface[::2], surface[1::2] @ TURN.T)
    written = _at_end(ICP(plane=0.5, inlier_distance=0.7), clouds, rigid.identity())[1]
    traced = ICP(plane=jnp.float32(0.5), inlier_distance=jnp.float32(0.7))
    found = _at_end(traced, clouds, rigid.identity())[1]
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), found, written)


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
    clouds = tuple(_prepare(_SIZES, _padded(each)) for each in _turned(shape, angle))
    rotation, translation = _at_end(ICP(), clouds, rigid.identity())[1].transform
    assert np.isfinite(translation).all()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)


_EXACTLY = ICP(tolerance=1e-9, iterations=400)
_PERTURBED = "source", "target", "plane", "inlier_distance"


def _pose_sum(numbers: dict, clouds: tuple[Cloud, Cloud], ends: tuple[Settled, Settled]) -> jax.Array:
    """A weighted sum of the refined pose, with derivatives in both clouds and in numbers of ICP."""
    weights = jnp.asarray(np.random.default_rng(5).normal(scale=100.0, size=(3, 4)))
    ready = prepare(_SIZES, clouds[0]), prepare(_SIZES, clouds[1])
    pose = differentiable_pose(dataclasses.replace(_EXACTLY, **numbers), *ready, *ends)
    return jnp.sum(weights * jnp.concatenate([pose.rotation, pose.translation[:, None]], axis=1))


_slope = jax.jit(jax.value_and_grad(_pose_sum, argnums=(0, 1), allow_int=True))


def _sum_and_slope(clouds: tuple[Cloud, Cloud], how: ICP = _EXACTLY):
    """The sum, its gradients as a dictionary, and the ends of the second and of the third stage."""
    ends = _at_end(how, tuple(_prepare(_SIZES, each) for each in clouds), rigid.identity())
    value, (numbers, moved) = _slope({"plane": how.plane, "inlier_distance": how.inlier_distance}, clouds, ends)
    return value, numbers | {"source": moved[0].points, "target": moved[1].points}, ends


def _even_surface(seed: int) -> np.ndarray:
    """A bent ellipsoid sampled evenly, with noise, (200, 3): every neighbourhood has enough points for a normal."""
    height, around = 1 - (2 * np.arange(200) + 1) / 200, np.pi * (1 + 5**0.5) * np.arange(200)
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(around), ring * np.sin(around), height], 1)
    points = sphere @ Rotation.random(random_state=seed).as_matrix() * [1.0, 0.7, 0.45]
    points[:, 2] += 0.3 * points[:, 0] ** 2
    return points + 0.01 * np.random.default_rng(seed).normal(size=points.shape)


def _crop_and_whole() -> tuple[np.ndarray, np.ndarray]:
    source, target = _even_surface(1), _even_surface(2) @ TURN.T + [0.05, -0.03, 0.04]
    return source[source[:, 0] < 0.4], target


def _agrees_with_finite_differences(
    clouds, how: ICP, argument: str, *, sparse: bool, rel: float, small: float = 1e-6
) -> None:
    """Two stages of iterations at ± a small step against the derivative of their end."""
    rows = dict(zip(_PERTURBED[:2], clouds, strict=True))
    direction = np.random.default_rng(7).normal(size=rows[argument].shape if argument in rows else ())

    def at(step):
        moved = [
            points + step * direction * (name == argument) if name == argument else points
            for name, points in rows.items()
        ]
        numbers = {} if argument in rows else {argument: getattr(how, argument) + float(step * direction)}
        return _sum_and_slope(tuple(_padded(each, _SMALL) for each in moved), dataclasses.replace(how, **numbers))

    _, gradients, (settled, expected) = at(0.0)
    assert bool(settled.converged) and bool(expected.converged)
    assert bool(settled.sparse) == sparse
    difference = float(at(small)[0] - at(-small)[0]) / (2 * small)
    gradient = np.asarray(gradients[argument])
    slope = float(np.sum(gradient[: len(direction)] * direction if argument in rows else gradient * direction))
    assert abs(difference) > 1e-3
    assert slope == pytest.approx(difference, rel=rel)


@pytest.mark.parametrize("argument", _PERTURBED)
@pytest.mark.parametrize("plane", [0.9, 0.0])
def test_derivative_agrees_with_finite_differences(plane, argument, x64):
    """Where the width is the inlier distance, which the samples are too far apart for to shrink it."""
    how = dataclasses.replace(_EXACTLY, plane=plane or 1e-3, inlier_distance=0.4)
    _agrees_with_finite_differences(_crop_and_whole(), how, argument, sparse=False, rel=1e-4)


@pytest.mark.parametrize("argument", ["source", "target"])
def test_derivative_of_the_third_stage_agrees_with_finite_differences(argument, x64):
    """Which begins where the second one ends, and asks it where the surface is.

    In smaller steps, within which no point enters or leaves a normal's neighbourhood among both clouds' points.
    """
    clouds = _even_surface(1), _even_surface(2) @ TURN.T + [0.05, -0.03, 0.04]
    how = dataclasses.replace(_EXACTLY, tolerance=1e-11)
    _agrees_with_finite_differences(clouds, how, argument, sparse=True, rel=2e-3, small=1e-7)


def test_the_differentiable_pose_is_the_end_of_the_last_stage(x64):
    for clouds in (_crop_and_whole(), (_even_surface(1), _even_surface(2) @ TURN.T)):
        ready = tuple(_prepare(_SIZES, _padded(each, _SMALL)) for each in clouds)
        ends = _at_end(_EXACTLY, ready, rigid.identity())
        jax.tree.map(np.testing.assert_array_equal, _pose(_EXACTLY, *ready, *ends), ends[1].transform)


_pose = jax.jit(differentiable_pose)


@pytest.mark.parametrize("shape", _DEGENERATE)
@pytest.mark.parametrize("angle", [0.0, 0.2])
def test_derivatives_of_a_degenerate_cloud_are_finite(shape, angle, x64):
    _, gradients, _ = _sum_and_slope(tuple(_padded(each, _SMALL) for each in _turned(shape, angle)))
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())


def _whole(how: ICP, points: jax.Array, source: Cloud, target: Cloud) -> tuple[jax.Array, Settled]:
    """All stages in one trace: the sum of the refined pose, and where they ended."""
    ready = prepare(_SIZES, source._replace(points=points)), prepare(_SIZES, target)
    pose, width = find_basin(how, ready[0].samples, ready[1].samples, rigid.identity())
    settled = settle(how, *ready, *settle_thinned(how, *ready, pose, width))
    expected = expect(how, *ready, settled)
    pose = differentiable_pose(how, *ready, settled, expected)
    return jnp.sum(pose.rotation) + jnp.sum(pose.translation), expected


@pytest.mark.parametrize("plane", [0.0, 0.97])
def test_single_precision_stays_so_where_double_precision_is_on(plane, x64):
    cloud = make_cloud(jnp.asarray(_surface(60), jnp.float32))
    gradient, found = jax.eval_shape(
        functools.partial(jax.grad(_whole, argnums=1, has_aux=True), ICP(plane=plane)), cloud.points, cloud, cloud
    )
    floats = (*found.transform, found.width, found.deviations, gradient)
    assert {leaf.dtype for leaf in floats} == {jnp.dtype("float32")}


@pytest.fixture(scope="module")
def ready_pairs() -> list[tuple[Prepared, Prepared]]:
    """One that coincides, one that goes through the third stage, and one of a crop."""
    whole, other = _even_surface(1), _even_surface(2) @ TURN.T
    pairs = [(whole, whole @ TURN.T), (whole, other), (whole[whole[:, 0] < 0.4], other)]
    return [tuple(_prepare(_SIZES, _padded(each, _SMALL)) for each in pair) for pair in pairs]


def _stacked(pairs):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)


def test_vmap_agrees_with_a_loop(ready_pairs):
    def stages(source, target):
        pose, width = find_basin(ICP(), source.samples, target.samples, rigid.identity())
        return expect(ICP(), source, target, settle(ICP(), source, target, pose, width))

    together = jax.jit(jax.vmap(stages))(*_stacked(ready_pairs))
    alone = [_at_end(ICP(), pair, rigid.identity())[1] for pair in ready_pairs]
    np.testing.assert_array_equal(together.sparse, [False, True, False])
    np.testing.assert_array_equal(together.converged, [bool(each.converged) for each in alone])
    # The steps that are left when iteration stops are about as large as its tolerance, 5e-5.
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, atol=2e-4), together.transform, _stacked(alone).transform
    )


def test_derivatives_in_a_batch_agree_with_a_loop(ready_pairs):
    """In the source's queries, of the second stage alone."""
    how = ICP(em_points=0)

    def slope(source, target, end):
        def total(points):
            moved = source._replace(queries=source.queries._replace(points=points))
            return jnp.sum(differentiable_pose(how, moved, target, end, end).translation)

        return jax.grad(total)(source.queries.points)

    ends = [_at_end(ICP(), pair, rigid.identity())[0] for pair in ready_pairs]
    together = jax.jit(jax.vmap(slope))(*_stacked(ready_pairs), _stacked(ends))
    alone = [jax.jit(slope)(*pair, end) for pair, end in zip(ready_pairs, ends, strict=True)]
    for found, expected in zip(together, alone, strict=True):
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose(found, expected, atol=1e-3 * float(jnp.max(jnp.abs(expected))))


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
        {"em_points": -1},
        {"em_points": 640.5},
    ],
)
def test_unusable_options_are_named(options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))}: expected"):
        ICP(**options)
