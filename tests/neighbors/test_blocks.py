"""Nearest neighbours through blocks: exactly SciPy's, whatever the cloud is like, and without large buffers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from urrt_jax.clouds import Cloud, curve_order, make_cloud, take
from urrt_jax.neighbors import Blocks, Neighbors, make_blocks, nearest
from urrt_jax.neighbors.blocks import nearest_in_blocks

_QUERIES, _MANY = 700, 5000  # neither a multiple of the tile nor of the block; the larger one goes through blocks


@jax.jit
def _nearest_within(query, points, mask, within) -> Neighbors:
    return nearest(query, make_cloud(points, mask), within=within)


def _nearest(query, points, mask, within=np.inf) -> Neighbors:
    return _nearest_within(query, points, mask, np.float32(within))


@jax.jit
def _nearest_distinct(query, points, mask) -> Neighbors:
    return nearest(query, make_cloud(points, mask), distinct=True)


def _clusters(rng: np.random.Generator, count: int) -> np.ndarray:
    """Clusters whose widths span six orders of magnitude."""
    centres, widths = rng.uniform(-1, 1, (12, 3)), 10.0 ** rng.uniform(-6, 0, 12)
    chosen = rng.integers(0, 12, count)
    return centres[chosen] + widths[chosen, None] * rng.normal(size=(count, 3))


# How to make both clouds, (rng, count) -> (count, 3).
_SHAPES = {
    "random": lambda rng, count: rng.normal(size=(count, 3)),
    "clusters of all densities": _clusters,
    "a plane": lambda rng, count: rng.uniform(-1, 1, (count, 3)) * [1, 1, 0],
    "a tilted plane": lambda rng, count: rng.uniform(-1, 1, (count, 2)) @ [[1, 0.3, -2], [0.2, 1, 0.7]],
    "a line": lambda rng, count: np.outer(rng.uniform(-1, 1, count), [0.3, -0.5, 0.8]),
    "a line along an axis": lambda rng, count: np.outer(rng.uniform(-1, 1, count), [0, 1, 0]),
    "far from the origin": lambda rng, count: 1000 + rng.normal(size=(count, 3)),
    "in tiny units": lambda rng, count: 1e-12 * rng.normal(size=(count, 3)),
    "in huge units": lambda rng, count: 1e12 * rng.normal(size=(count, 3)),
    "with a stray point": lambda rng, count: np.concatenate([[[1e6, 0, 0]], rng.normal(size=(count - 1, 3))]),
    "points repeated": lambda rng, count: np.repeat(rng.normal(size=(50, 3)), count // 50, axis=0),
}


def _clouds(shape: str, queries: int = _QUERIES, count: int = _MANY) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return _SHAPES[shape](rng, queries).astype(np.float32), _SHAPES[shape](rng, count).astype(np.float32)


def _distances(query: np.ndarray, points: np.ndarray, index) -> np.ndarray:
    return np.linalg.norm(query.astype(np.float64) - points[np.asarray(index)], axis=1)


def _agrees_with_a_tree(found: Neighbors, query: np.ndarray, points: np.ndarray, mask: np.ndarray) -> None:
    """The named rows are real and as near as the nearest; ties may fall either way in float32."""
    assert mask[np.asarray(found.index)].all()
    expected = cKDTree(points[mask].astype(np.float64)).query(query.astype(np.float64))[0]
    np.testing.assert_allclose(_distances(query, points, found.index), expected, rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(found.squared), expected, rtol=1e-5)


@jax.jit
def _counted_search(query, points, count) -> Neighbors:
    return nearest(query, make_cloud(points), count=count)


_ALL = np.ones(_MANY, bool)
_make_blocks = jax.jit(make_blocks)


@pytest.mark.parametrize("shape", _SHAPES)
def test_nearest_agrees_with_a_kd_tree(shape):
    query, points = _clouds(shape)
    _agrees_with_a_tree(_nearest(query, points, _ALL), query, points, _ALL)


@pytest.mark.parametrize("shape", ["clusters of all densities", "a line"])
def test_queries_elsewhere_agree_with_a_kd_tree(shape):
    points, query = _clouds(shape)[1], _clouds("random")[0]
    _agrees_with_a_tree(_nearest(query, points, _ALL), query, points, _ALL)


@pytest.mark.parametrize("offset", [(10.0, 0.0, 0.0), (-300.0, 200.0, 1000.0)])
def test_queries_far_outside_agree_with_a_kd_tree(offset):
    query, points = _clouds("random")
    query = query + np.array(offset, np.float32)
    _agrees_with_a_tree(_nearest(query, points, _ALL), query, points, _ALL)


def test_a_cloud_of_one_repeated_point_is_found_at_its_distance():
    query, _ = _clouds("random")
    points = np.ones((_MANY, 3), np.float32)
    _agrees_with_a_tree(_nearest(query, points, _ALL), query, points, _ALL)


def test_one_repeated_query_agrees_with_a_kd_tree():
    query, points = np.full((_QUERIES, 3), 0.3, np.float32), _clouds("random")[1]
    _agrees_with_a_tree(_nearest(query, points, _ALL), query, points, _ALL)


@pytest.mark.parametrize("share", [0.0003, 0.3, 0.98])
def test_padding_is_never_found(share):
    query, points = _clouds("random")
    mask = np.random.default_rng(1).uniform(size=_MANY) < share
    _agrees_with_a_tree(_nearest(query, points, mask), query, points, mask)


def test_nothing_is_found_among_padding():
    query, points = _clouds("random")
    assert bool(jnp.all(jnp.isinf(_nearest(query, points, ~_ALL).squared)))


@pytest.mark.parametrize("shape", ["random", "clusters of all densities"])
@pytest.mark.parametrize("quantile", [0.0, 0.1, 0.5, 1.0])
def test_exactly_those_within_are_found(shape, quantile):
    query, points = _clouds(shape)
    query[: _QUERIES // 4] += 20  # whole tiles with nothing near
    squared = np.asarray(_nearest(query, points, _ALL).squared)
    # Between two distances, so that rounding decides nothing.
    ordered = np.sort(np.sqrt(squared))
    place = int(quantile * (_QUERIES - 2))
    within = ordered[place : place + 2].mean()
    found = _nearest(query, points, _ALL, within).squared
    np.testing.assert_allclose(found, np.where(squared < within**2, squared, np.inf), rtol=1e-6)


def test_nothing_is_within_zero():
    points = _clouds("random")[1]
    assert bool(jnp.all(jnp.isinf(_nearest(points[:_QUERIES], points, _ALL, 0.0).squared)))


def test_a_point_finds_itself():
    points = _clouds("random")[1]
    np.testing.assert_array_equal(_nearest(points[:_QUERIES], points, _ALL).index, np.arange(_QUERIES))


@pytest.mark.parametrize("shape", ["random", "clusters of all densities", "points repeated"])
def test_distinct_passes_over_points_that_coincide_with_the_query(shape):
    points = _clouds(shape)[1]
    query = points[:: _MANY // _QUERIES][:_QUERIES]
    found = _nearest_distinct(query, points, _ALL)
    others = np.unique(points, axis=0).astype(np.float64)
    expected = cKDTree(others).query(query.astype(np.float64), k=2)[0][:, 1]
    np.testing.assert_allclose(_distances(query, points, found.index), expected, rtol=1e-6)


def test_distinct_finds_nothing_where_all_points_coincide_with_the_query():
    points = np.ones((_MANY, 3), np.float32)
    assert bool(jnp.all(jnp.isinf(_nearest_distinct(points[:_QUERIES], points, _ALL).squared)))


@pytest.mark.parametrize(("queries", "count"), [(1, 1), (1, 129), (127, 128), (129, 127)])
def test_every_size_agrees_with_a_kd_tree(queries, count):
    query, points = _clouds("random", queries, count)
    row, found = jax.jit(
        lambda q, p: nearest_in_blocks(q, make_blocks(make_cloud(p)), np.inf, False, count=jnp.array(queries))
    )(query, points)
    assert bool(jnp.all(found))
    np.testing.assert_array_equal(row, cKDTree(points).query(query)[1])


@pytest.fixture(scope="module")
def both_ways():
    """The sum of squared distances, the neighbours and the sum's gradients, through blocks and all at once."""

    def total(query, points, blocks):
        cloud = make_cloud(points)
        found = nearest(query, cloud, blocks=make_blocks(cloud)) if blocks else nearest(query, cloud, block=None)
        return jnp.sum(found.squared), found

    every = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True), static_argnums=2)
    return [every(*_clouds("random", 150, 300), blocks) for blocks in (True, False)]


def test_blocks_agree_with_comparing_all_at_once(both_ways):
    ((_, through), _), ((_, dense), _) = both_ways
    np.testing.assert_array_equal(through.index, dense.index)
    np.testing.assert_allclose(through.squared, dense.squared, rtol=1e-6)


@pytest.mark.parametrize("argument", [0, 1])
def test_the_gradient_is_that_of_comparing_all_at_once(both_ways, argument):
    (_, through), (_, dense) = both_ways
    np.testing.assert_allclose(through[argument], dense[argument], atol=1e-6)


def test_vmap_agrees_with_a_loop():
    shapes = ["random", "a line", "clusters of all densities"]  # which need different numbers of blocks
    queries, clouds = (np.stack(each) for each in zip(*(_clouds(shape) for shape in shapes), strict=True))
    masks = np.random.default_rng(2).uniform(size=clouds.shape[:2]) < 0.8
    together = jax.vmap(_nearest)(queries, clouds, masks)
    alone = [_nearest(*each).index for each in zip(queries, clouds, masks, strict=True)]
    np.testing.assert_array_equal(together.index, alone)


def _padded_blocks(count: int) -> tuple[Cloud, Blocks]:
    points = np.random.default_rng(4).normal(size=(count, 3)).astype(np.float32)
    mask = np.random.default_rng(5).uniform(size=count) < 0.6
    cloud = make_cloud(points, mask)
    return cloud, _make_blocks(cloud)


@pytest.mark.parametrize("count", [1, 1300])
def test_blocks_hold_every_real_point_once(count):
    cloud, blocks = _padded_blocks(count)
    points = np.swapaxes(blocks.points, 1, 2)
    held = np.isfinite(points).all(axis=2)
    np.testing.assert_array_equal(np.sort(np.asarray(blocks.rows)[held]), np.flatnonzero(cloud.mask))
    np.testing.assert_array_equal(points[held], np.asarray(cloud.points)[np.asarray(blocks.rows)[held]])


def test_what_blocks_hold_beside_real_points_is_infinitely_far_away():
    cloud, blocks = _padded_blocks(1300)
    assert np.isinf(blocks.points).sum() == 3 * (blocks.rows.size - int(cloud.mask.sum()))


def test_boxes_are_those_of_their_points():
    _, blocks = _padded_blocks(1300)
    points = np.asarray(blocks.points)
    np.testing.assert_array_equal(blocks.low, np.where(np.isfinite(points), points, np.inf).min(axis=2))
    np.testing.assert_array_equal(blocks.high, np.where(np.isfinite(points), points, -np.inf).max(axis=2))


def test_blocks_are_compact():
    """Of points spread evenly over a cube, 40 blocks have sides of about 0.3; in any other order sides are about 1."""
    points = np.random.default_rng(6).uniform(size=(_MANY, 3)).astype(np.float32)
    blocks = _make_blocks(make_cloud(points))
    assert np.mean(np.asarray(blocks.high - blocks.low)) < 0.4


def test_blocks_of_an_ordered_cloud_need_no_sort():
    """The same blocks, of other rows."""
    cloud, expected = _padded_blocks(1300)
    rows = jax.jit(curve_order)(*cloud)
    blocks = jax.jit(lambda each: make_blocks(each, ordered=True))(take(cloud, rows))
    for found, one in zip(blocks._replace(rows=0), expected._replace(rows=0), strict=True):
        np.testing.assert_array_equal(found, one)
    held = np.isfinite(np.asarray(blocks.points)[:, 0])
    np.testing.assert_array_equal(np.asarray(rows)[np.asarray(blocks.rows)[held]], np.asarray(expected.rows)[held])


def test_padding_does_not_change_which_blocks_are_compared():
    """Blocks of padding have no box, so that nothing can be near them."""
    _, blocks = _padded_blocks(1300)
    empty = ~np.isfinite(np.asarray(blocks.points)).any(axis=(1, 2))
    assert empty.any()
    assert np.isposinf(np.asarray(blocks.low)[empty]).all()


@pytest.fixture(scope="module")
def two_hundred_thousand():
    """200,000 queries, as many points, and the search for one among the other, compiled."""
    query, points = _clouds("a tilted plane", 200_000, 200_000)
    points = points + 0.001 * np.random.default_rng(7).normal(size=points.shape).astype(np.float32)
    search = jax.jit(lambda q, p: nearest(q, make_cloud(p))).lower(query, points).compile()
    return query, points, search


def test_two_hundred_thousand_points_agree_with_a_kd_tree(two_hundred_thousand):
    query, points, search = two_hundred_thousand
    index = search(query, points).index
    expected = cKDTree(points).query(query[::40])[0]
    np.testing.assert_allclose(_distances(query[::40], points, index[::40]), expected, rtol=1e-5)


def test_memory_is_a_few_copies_of_both_clouds(two_hundred_thousand):
    """The distance of every query to every block would be 625 MB; to every point, 160 GB. This is 14 MB."""
    query, points, search = two_hundred_thousand
    assert search.memory_analysis().temp_size_in_bytes < 5 * (query.nbytes + points.nbytes)


@pytest.fixture(scope="module")
def ordered_search():
    """A search among 5,000 points by queries that are said to be in order, of the first ``count`` queries."""
    return jax.jit(lambda query, points, count: nearest(query, make_cloud(points), ordered=True, count=count))


@pytest.mark.parametrize("order", ["along the curve", "at random"])
def test_the_order_that_is_promised_changes_time_alone(order, ordered_search):
    query, points = _clouds("random")
    rows = np.random.default_rng(1).permutation(len(query))
    if order == "along the curve":
        rows = np.asarray(curve_order(jnp.asarray(query), jnp.ones(len(query), bool)))
    found = ordered_search(query[rows], points, _QUERIES)
    np.testing.assert_array_equal(found.index, np.asarray(_nearest(query, points, _ALL).index)[rows])


@pytest.mark.parametrize("count", [0, 1, 64, 65, 500, _QUERIES])
@pytest.mark.parametrize("ordered", [True, False])
def test_queries_that_are_wanted_are_answered(count, ordered, ordered_search):
    """Those behind them, whatever they hold, don't disturb; they find the nearest point or nothing."""
    query, points = _clouds("random")
    expected = _nearest(query, points, _ALL)
    disturbed = np.where(np.arange(_QUERIES)[:, None] < count, query, np.float32(50))
    search = ordered_search if ordered else _counted_search
    found = search(disturbed, points, count)
    np.testing.assert_array_equal(found.index[:count], expected.index[:count])
    np.testing.assert_allclose(found.squared[:count], expected.squared[:count], rtol=1e-6)


def test_queries_that_are_not_wanted_take_no_time():
    """Their tiles are not walked: beyond the last tile that has a wanted query, nothing is found."""
    query, points = _clouds("random")
    blocks = _make_blocks(make_cloud(points))
    walk = jax.jit(lambda count: nearest_in_blocks(query, blocks, np.inf, False, ordered=True, count=count)[1])
    assert not bool(walk(0).any())
    np.testing.assert_array_equal(walk(65), np.arange(_QUERIES) < 128)


def test_under_vmap_the_most_wanted_queries_end_the_walk():
    query, points = _clouds("random")
    blocks = _make_blocks(make_cloud(points))
    walk = jax.vmap(lambda count: nearest_in_blocks(query, blocks, np.inf, False, ordered=True, count=count)[1])
    np.testing.assert_array_equal(jax.jit(walk)(jnp.array([3, 65]))[0], np.arange(_QUERIES) < 128)


def test_blocks_at_hand_change_nothing():
    query, points = _clouds("random")
    cloud = make_cloud(points)
    found = jax.jit(lambda q, each, blocks: nearest(q, each, blocks=blocks))(query, cloud, _make_blocks(cloud))
    np.testing.assert_array_equal(found.index, _nearest(query, points, _ALL).index)
