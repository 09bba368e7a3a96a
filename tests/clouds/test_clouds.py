"""Clouds: what is refused and why, and that subsampling depends on the shape alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import (
    Cloud,
    centroid,
    check_cloud,
    curve_order,
    farthest_points,
    first,
    make_cloud,
    mean_square_radius,
    pad_clouds,
    shift,
    subsample,
    take,
    thin,
)

_farthest, _thin, _subsample = (jax.jit(each, static_argnums=1) for each in (farthest_points, thin, subsample))
_TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def _with(value: float, count: int) -> np.ndarray:
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    points.flat[:count] = value
    return points


@pytest.mark.parametrize(
    ("points", "says"),
    [
        pytest.param(np.zeros(3), r"shape \(N, 3\), got \(3,\)", id="one point"),
        pytest.param(np.zeros((2, 5, 3)), r"\(2, 5, 3\)", id="batch"),
        pytest.param(np.float32(1), r"got \(\)", id="scalar"),
        pytest.param(np.zeros((5, 2)), r"\(5, 2\)", id="two columns"),
        pytest.param(np.zeros((3, 5)), r"\(3, 5\)", id="transposed"),
        pytest.param(np.zeros((0, 3)), "empty", id="empty"),
        pytest.param([[0, 0, 0], [1, 1], [2, 2, 2]], "ragged", id="ragged"),
        pytest.param(np.ones((5, 3), bool), "bool", id="bool"),
        pytest.param(np.ones((5, 3), np.complex64), "complex64", id="complex"),
        pytest.param(np.full((5, 3), "1.0"), "dtype <U3", id="string"),
        pytest.param([["a", "b", "c"]] * 3, "dtype <U1", id="list of strings"),
        pytest.param(np.full((5, 3), None), "object", id="object"),
        pytest.param(_with(np.nan, 4), "4 values are not finite .4 NaN, 0 infinite", id="nan"),
        pytest.param(_with(np.inf, 2), "2 values are not finite .0 NaN, 2 infinite", id="inf"),
        pytest.param(_with(-np.inf, 1), "1 values are not finite", id="minus inf"),
        pytest.param(np.ones((5000, 3)), "at least 3 distinct points, got 1 among 5000", id="one point repeated"),
        pytest.param(np.repeat(_TRIANGLE[:2], 3000, 0), "distinct points, got 2 among 6000", id="two points repeated"),
        pytest.param(np.zeros((2, 3)), "distinct points, got 1 among 2", id="two points"),
        pytest.param(2**24 + 2 + np.arange(15).reshape(5, 3), "15 integers", id="large integers"),
        pytest.param(-(2**40) - np.arange(15).reshape(5, 3), "15 integers", id="large negative integers"),
    ],
)
def test_check_cloud_refuses_and_names_the_argument(points, says):
    with pytest.raises(ValueError, match=says) as caught:
        check_cloud(points, None, "target")
    assert str(caught.value).startswith("target")


@pytest.mark.parametrize("length", [2, 4, 0])
def test_check_cloud_names_a_mask_of_another_length(length):
    with pytest.raises(ValueError, match=rf"^source_mask: expected shape \(3,\) .*got \({length},\)"):
        check_cloud(_TRIANGLE, np.ones(length, bool), "source")


def test_check_cloud_counts_distinct_points_among_the_real_ones_only():
    with pytest.raises(ValueError, match="got 2 among 2"):
        check_cloud(_TRIANGLE, np.array([True, True, False]), "source")


def test_check_cloud_refuses_a_mask_without_real_points():
    with pytest.raises(ValueError, match="got 0 among 0"):
        check_cloud(_TRIANGLE, np.zeros(3, bool), "source")


def test_check_cloud_does_not_look_at_padding():
    padded = np.concatenate([_TRIANGLE, np.full((2, 3), np.nan, np.float32)])
    check_cloud(padded, np.array([True] * 3 + [False] * 2), "source")


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(_TRIANGLE.tolist(), id="list"),
        pytest.param(_TRIANGLE.astype(np.int64) * 2**24, id="integers up to 2**24"),
        pytest.param(_TRIANGLE.astype(np.float16), id="float16"),
        pytest.param(jnp.asarray(_TRIANGLE, jnp.bfloat16), id="bfloat16"),
        pytest.param(np.concatenate([np.zeros((5000, 3)), _TRIANGLE]), id="three distinct among many"),
    ],
)
def test_check_cloud_accepts(points):
    check_cloud(points, None, "source")


def test_check_cloud_refuses_a_wrong_shape_under_jit():
    with pytest.raises(ValueError, match=r"^source: expected shape"):
        jax.jit(lambda p: check_cloud(p, None, "source"))(jnp.zeros((5, 2)))


def test_make_cloud_masks_rows_that_are_not_finite():
    points = _with(np.nan, 1)
    assert jnp.array_equal(make_cloud(points).mask, jnp.array([False] + [True] * 9))


def test_make_cloud_zeroes_padding():
    made = make_cloud(_TRIANGLE + 7, np.array([True, False, True]))
    assert jnp.array_equal(made.points[1], jnp.zeros(3))


def test_pad_clouds_keeps_every_point_and_marks_the_rest():
    points, mask = pad_clouds([_TRIANGLE, _with(0, 0)])
    assert points.shape == (2, 10, 3)
    assert mask.sum(axis=1).tolist() == [3, 10]
    np.testing.assert_array_equal(points[0][mask[0]], _TRIANGLE)
    np.testing.assert_array_equal(points[0][~mask[0]], 0)


def test_pad_clouds_pads_to_the_size_asked_for():
    points, mask = pad_clouds([_TRIANGLE], size=7)
    assert points.shape == (1, 7, 3)
    assert int(mask.sum()) == 3


@pytest.mark.parametrize(
    ("clouds", "size", "says"),
    [
        pytest.param([], None, "^clouds: .*empty", id="none"),
        pytest.param([_TRIANGLE, np.zeros((4, 2))], None, r"^clouds\[1\]: .*\(4, 2\)", id="shape"),
        pytest.param([_TRIANGLE, _with(0, 0)], 9, "^size: .*10 points.* 9", id="too long"),
        pytest.param([_TRIANGLE, [[0, 0, 0], [1, 1]]], None, r"^clouds\[1\]: ", id="ragged"),
    ],
)
def test_pad_clouds_refuses_and_names_the_argument(clouds, size, says):
    with pytest.raises(ValueError, match=says):
        pad_clouds(clouds, size=size)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e4])
def test_centroid_keeps_its_digits_far_from_the_origin(cloud, offset):
    points = (cloud + np.float32(offset)).astype(np.float32)
    points = np.tile(points, (50, 1))  # a plain float32 sum of 10,000 of these is off by far more than one digit
    exact = points.astype(np.float64).mean(axis=0)
    found = jax.jit(centroid)(make_cloud(points))
    np.testing.assert_allclose(found, exact, atol=1e-6 + 1e-7 * offset)


def test_centroid_ignores_padding(cloud):
    mask = np.arange(200) % 3 == 0
    np.testing.assert_allclose(centroid(make_cloud(cloud, mask)), cloud[mask].mean(0), atol=1e-6)


def test_centroid_has_the_mean_s_derivative(cloud):
    gradient = jax.grad(lambda p: centroid(make_cloud(p))[1])(jnp.asarray(cloud))
    np.testing.assert_allclose(gradient, np.tile([0, 1 / 200, 0], (200, 1)), atol=1e-8)


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test_shift_moves_and_scales_real_points_only(cloud, scale):
    mask, offset = np.arange(200) % 3 > 0, np.array([1.0, -2.0, 3.0], np.float32)
    moved = shift(make_cloud(cloud, mask), offset, scale)
    np.testing.assert_allclose(moved.points[mask], (cloud[mask] - offset) / scale, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(moved.points[~mask], 0)
    np.testing.assert_array_equal(moved.mask, mask)


def test_mean_square_radius_ignores_padding(cloud):
    mask = np.arange(200) % 3 > 0
    expected = np.mean(np.sum(cloud[mask].astype(np.float64) ** 2, axis=1))
    assert float(mean_square_radius(make_cloud(cloud, mask))) == pytest.approx(expected, rel=1e-5)


def test_mean_square_radius_of_nothing_is_zero(cloud):
    assert float(mean_square_radius(make_cloud(cloud, np.zeros(200, bool)))) == 0


def _rows(points) -> set:
    return {tuple(row) for row in np.asarray(points).tolist()}


def test_farthest_points_do_not_depend_on_the_order(cloud):
    order = np.random.default_rng(1).permutation(200)
    index, _ = _farthest(make_cloud(cloud), 40)
    shuffled, _ = _farthest(make_cloud(cloud[order]), 40)
    np.testing.assert_array_equal(order[shuffled], index)


def test_farthest_points_do_not_depend_on_the_pose(cloud):
    turned = (cloud @ Rotation.random(rng=3).as_matrix().T * 2.5 + [3, -1, 2]).astype(np.float32)
    np.testing.assert_array_equal(_farthest(make_cloud(cloud), 40)[0], _farthest(make_cloud(turned), 40)[0])


def test_farthest_points_follow_the_textbook(cloud):
    points = cloud.astype(np.float64)
    chosen = [int(np.argmax(np.sum((points - points.mean(0)) ** 2, -1)))]
    while len(chosen) < 30:
        chosen.append(int(np.argmax(np.min(np.sum((points[:, None] - points[chosen]) ** 2, -1), 1))))
    np.testing.assert_array_equal(_farthest(make_cloud(cloud), 30)[0], chosen)


def test_farthest_points_start_at_the_farthest_one_under_jit_and_vmap():
    """The maximum and the comparison with it must see the same rounding, also where the compiler fuses them."""
    clouds = np.random.default_rng(5).normal(size=(200, 77, 3)).astype(np.float32)
    start = jax.jit(jax.vmap(lambda p: farthest_points(make_cloud(p), 2)[0][0]))(clouds)
    exact = clouds.astype(np.float64)
    radii = np.linalg.norm(exact - exact.mean(1, keepdims=True), axis=-1)
    found = np.take_along_axis(radii, np.asarray(start)[:, None], 1)[:, 0]
    np.testing.assert_allclose(found, radii.max(1), rtol=1e-5)


def test_farthest_points_pick_duplicates_once(cloud):
    index, new = _farthest(make_cloud(np.concatenate([cloud[:30]] * 4)), 50)
    assert int(new.sum()) == 30
    assert len({int(i) % 30 for i in index[new]}) == 30


def test_farthest_points_never_pick_padding(cloud):
    mask = np.arange(200) < 60
    points = np.where(mask[:, None], cloud, 50.0).astype(np.float32)
    index, new = _farthest(Cloud(jnp.asarray(points), jnp.asarray(mask)), 80)
    assert int(new.sum()) == 60
    assert np.all(np.asarray(index)[np.asarray(new)] < 60)


def test_farthest_points_of_nothing_flag_everything():
    _, new = _farthest(make_cloud(_TRIANGLE, np.zeros(3, bool)), 3)
    assert not bool(new.any())


@pytest.mark.parametrize("count", [7, 50, 64, 199])
def test_thin_takes_exactly_count_distinct_real_points(cloud, count):
    thinned = _thin(make_cloud(cloud), count)
    assert thinned.points.shape == (count, 3)
    assert bool(thinned.mask.all())
    assert len(_rows(thinned.points)) == count
    assert _rows(thinned.points) <= _rows(cloud)


def test_thin_takes_distinct_points_when_count_is_large():
    """Strides are products of two counts, which pass 2**31 from about 46,000 points on."""
    size, count = 100_000, 60_000
    points = np.random.default_rng(0).uniform(size=(size, 3)).astype(np.float32)
    thinned = _thin(make_cloud(points), count)
    assert len(np.unique(np.asarray(thinned.points), axis=0)) == count


def test_thin_keeps_every_real_point_when_there_are_fewer_than_count(cloud):
    mask = np.random.default_rng(0).permutation(200) < 40
    thinned = _thin(make_cloud(cloud, mask), 64)
    assert int(thinned.mask.sum()) == 40
    assert _rows(thinned.points[thinned.mask]) == _rows(cloud[mask])


@pytest.mark.parametrize("real", [64, 65, 130])
def test_thin_gives_only_real_points_when_there_are_more_than_count(cloud, real):
    mask = np.random.default_rng(0).permutation(200) < real
    thinned = _thin(make_cloud(cloud, mask), 64)
    assert bool(thinned.mask.all())
    assert len(_rows(thinned.points)) == 64
    assert _rows(thinned.points) <= _rows(cloud[mask])


def test_thin_does_not_depend_on_the_order(cloud):
    order = np.random.default_rng(1).permutation(200)
    np.testing.assert_array_equal(_thin(make_cloud(cloud), 50).points, _thin(make_cloud(cloud[order]), 50).points)


def test_thin_is_unchanged_by_padding(cloud):
    padded = make_cloud(np.concatenate([cloud, np.full((90, 3), np.nan, np.float32)]))
    np.testing.assert_array_equal(_thin(make_cloud(cloud), 50).points, _thin(padded, 50).points)


@pytest.mark.parametrize("real", [200, 130, 40])
def test_thin_of_an_ordered_cloud_needs_no_sort(cloud, real):
    whole = make_cloud(cloud, np.random.default_rng(0).permutation(200) < real)
    ordered = take(whole, curve_order(*whole))
    found = jax.jit(functools.partial(thin, count=64, ordered=True))(ordered)
    np.testing.assert_array_equal(found.mask, _thin(whole, 64).mask)
    np.testing.assert_array_equal(found.points, _thin(whole, 64).points)


def test_thin_follows_the_density():
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(0, 1, (3000, 3)), rng.uniform(4, 5, (1000, 3))
    thinned = _thin(make_cloud(np.concatenate([dense, sparse]).astype(np.float32)), 400)
    assert int(jnp.sum(thinned.points[:, 0] < 2)) == pytest.approx(300, abs=3)


@pytest.mark.parametrize("size", [40, 64, 65, 1024, 1025, 3000])
def test_subsample_has_the_static_size_and_only_real_points(size):
    points = np.random.default_rng(0).normal(size=(size, 3)).astype(np.float32)
    chosen = _subsample(make_cloud(points), 64)
    assert chosen.points.shape == (64, 3)
    np.testing.assert_array_equal(chosen.mask, np.arange(64) < size)
    assert len(_rows(chosen.points[chosen.mask])) == min(size, 64)
    assert _rows(chosen.points[chosen.mask]) <= _rows(points)


def test_subsample_zeroes_what_it_could_not_fill(cloud):
    chosen = _subsample(make_cloud(np.concatenate([cloud[:10]] * 20)), 64)
    assert chosen.points.shape == (64, 3)
    assert int(chosen.mask.sum()) == 10
    np.testing.assert_array_equal(chosen.points[~chosen.mask], 0)


def test_take_carries_the_mask(cloud):
    mask = np.arange(200) < 5
    assert take(make_cloud(cloud, mask), jnp.array([4, 5])).mask.tolist() == [True, False]


@pytest.mark.parametrize("count", [1, 60, 200, 300])
def test_first_rows_are_filled_up_with_padding(cloud, count):
    mask = np.arange(200) < 100
    head = first(make_cloud(cloud, mask), count)
    assert head.points.shape == (count, 3)
    np.testing.assert_array_equal(head.mask, np.arange(count) < 100)
    np.testing.assert_array_equal(head.points[: min(count, 100)], cloud[: min(count, 100)])
    np.testing.assert_array_equal(head.points[100:], 0)
