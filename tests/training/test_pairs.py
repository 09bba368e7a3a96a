"""Training pairs: the pose is the true one, corruptions are as strong as asked for, and nothing but the key decides."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.training.pairs import (
    PairConfig,
    add_noise,
    add_outliers,
    corruption_share,
    crop,
    draw_pose,
    euler_rotation,
    make_batch,
    make_pair,
)

_CONFIG = PairConfig(points=64)
_KEYS = jax.random.split(jax.random.key(0), 200)


@pytest.fixture(scope="module")
def shapes(cloud, make_cloud_points):
    queries = np.random.default_rng(0).uniform(-1, 1, (2, 30, 3)).astype(np.float32)
    points = np.stack([cloud, make_cloud_points(1)]) / 1.5
    return {"points": jnp.asarray(points), "queries": jnp.asarray(queries), "inside": jnp.asarray(queries[..., 0] > 0)}


# One program for all tests: what differs between them is traced.
_batch = jax.jit(make_batch, static_argnames=("config", "size"))


@pytest.fixture(scope="module")
def clean(shapes):
    return _batch(_KEYS[0], shapes, _CONFIG, 64, 0.0)


@pytest.fixture(scope="module")
def corrupted(shapes):
    return _batch(_KEYS[1], shapes, _CONFIG, 64, 1.0)


@pytest.fixture(scope="module")
def noisy(shapes):
    """Corrupted pairs without crops and outliers: either two halves of one draw or the whole of it twice."""
    config = dataclasses.replace(_CONFIG, noise=0.02, keep=1.0, outliers=0.0)
    return _batch(_KEYS[2], shapes, config, 64, 1.0)


def test_transform_maps_source_onto_target(clean):
    moved = jax.vmap(rigid.apply)(clean.transform, clean.source.points)
    np.testing.assert_allclose(moved, clean.target.points, atol=1e-5)


def test_transform_maps_the_whole_clouds_of_corrupted_pairs(corrupted):
    moved = jax.vmap(rigid.apply)(corrupted.transform, corrupted.whole_source.points)
    np.testing.assert_allclose(moved, corrupted.whole_target.points, atol=1e-5)


def test_clean_pairs_show_the_whole_clouds(clean):
    for seen, whole in ((clean.source, clean.whole_source), (clean.target, clean.whole_target)):
        np.testing.assert_array_equal(seen.points, whole.points)
        assert bool(seen.mask.all())


def test_points_of_a_pair_are_distinct(clean):
    assert all(len(np.unique(np.asarray(points), axis=0)) == 64 for points in clean.source.points)


def test_queries_follow_the_target_s_points(clean, shapes):
    """The target's pose is found from the queries; undone, every point of the target is one of the shape's."""
    known = np.asarray(shapes["points"], np.float64)
    asked = np.asarray(shapes["queries"], np.float64)
    for i in range(8):
        moved, target = np.asarray(clean.queries[i], np.float64), np.asarray(clean.target.points[i], np.float64)
        gaps = []
        for points, queries in zip(known, asked, strict=True):
            turn, _ = Rotation.align_vectors(moved - moved.mean(0), queries - queries.mean(0))
            back = turn.inv().apply(target - moved.mean(0)) + queries.mean(0)
            gaps.append(np.linalg.norm(back[:, None] - points[None], axis=-1).min(1).max())
        assert min(gaps) < 1e-5
        np.testing.assert_array_equal(clean.inside[i], shapes["inside"][int(np.argmin(gaps))])


def test_same_key_gives_the_same_pairs(shapes, corrupted):
    again = _batch(_KEYS[1], shapes, _CONFIG, 64, 1.0)
    jax.tree.map(np.testing.assert_array_equal, again, corrupted)


def test_another_key_gives_other_pairs(shapes, clean):
    other = _batch(_KEYS[2], shapes, _CONFIG, 64, 0.0)
    assert not np.any(np.all(np.asarray(other.transform.rotation) == np.asarray(clean.transform.rotation), axis=(1, 2)))


def test_pairs_of_a_batch_differ(clean):
    assert len(np.unique(np.asarray(clean.transform.rotation).reshape(64, 9), axis=0)) == 64


def test_either_cloud_may_be_the_posed_one(corrupted):
    """The posed cloud is the one whose centre lies farther from the origin, in nearly every pair."""
    source, target = (
        np.linalg.norm(np.asarray(whole.points).mean(1), axis=-1)
        for whole in (corrupted.whole_source, corrupted.whole_target)
    )
    assert 0.2 < np.mean(source < target) < 0.8


@pytest.mark.parametrize(("both_ways", "still"), [(0.0, "source"), (1.0, "target")])
def test_only_one_cloud_is_posed_where_asked(cloud, both_ways, still):
    shape = jnp.asarray(cloud)
    pair = jax.vmap(lambda key: make_pair(key, shape, PairConfig(points=200, both_ways=both_ways), 0.0))(_KEYS[:8])
    for points in np.asarray(getattr(pair, still).points):
        np.testing.assert_allclose(np.sort(points, axis=0), np.sort(cloud, axis=0), atol=1e-6)


@pytest.mark.parametrize("max_angle", [0.0, 10.0, 45.0])
@pytest.mark.parametrize("signed", [0.0, 1.0])
def test_angles_and_translations_stay_in_their_ranges(max_angle, signed):
    config = PairConfig(max_angle=max_angle, signed=signed, translation=0.5)
    pose = jax.vmap(lambda key: draw_pose(key, config))(_KEYS)
    angles = Rotation.from_matrix(np.asarray(pose.rotation)).as_euler("zyx", degrees=True)
    least = -max_angle if signed else 0.0
    assert least - 1e-2 <= angles.min()
    assert angles.max() <= max_angle + 1e-2
    assert np.ptp(angles) >= 0.9 * (max_angle - least)
    assert np.abs(pose.translation).max() <= 0.5
    assert np.ptp(np.asarray(pose.translation)) > 0.9


def test_euler_convention_is_scipy_s_zyx():
    angles = np.random.default_rng(0).uniform(0, np.pi / 4, (20, 3))
    ours = jax.vmap(euler_rotation)(jnp.asarray(angles, jnp.float32))
    np.testing.assert_allclose(ours, Rotation.from_euler("zyx", angles[:, ::-1]).as_matrix(), atol=1e-6)


def test_euler_rotation_about_one_axis_is_right_handed():
    np.testing.assert_allclose(
        euler_rotation(jnp.array([0, 0, jnp.pi / 2])) @ jnp.array([1.0, 0, 0]), [0, 1, 0], atol=1e-6
    )


@pytest.mark.parametrize(
    ("progress", "share"), [(0.0, 0.0), (0.3, 0.0), (0.35, 0.375), (0.4, 0.75), (0.7, 0.75), (1.0, 0.75)]
)
def test_corruption_share_follows_the_schedule(progress, share):
    config = PairConfig(clean_share=0.3, ramp_share=0.1)
    assert float(corruption_share(config, progress)) == pytest.approx(share, abs=1e-5)


def test_corruption_share_without_a_ramp_is_a_step():
    config = PairConfig(clean_share=0.5, ramp_share=0.0, corrupted=1.0)
    assert [float(corruption_share(config, p)) for p in (0.0, 0.49, 0.51, 1.0)] == [0, 0, 1, 1]


def test_corruption_from_the_start_is_possible():
    assert float(corruption_share(PairConfig(clean_share=0.0, ramp_share=0.0, corrupted=0.5), 0.001)) == 0.5


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_share_of_corrupted_pairs_is_the_one_asked_for(shapes, share):
    batch = _batch(_KEYS[3], shapes, _CONFIG, 64, share)
    same = np.all(np.asarray(batch.source.points) == np.asarray(batch.whole_source.points), axis=(1, 2))
    assert np.mean(~same) == pytest.approx(share, abs=0.15)


_crop_counts = jax.jit(jax.vmap(lambda key, cloud, keep: jnp.sum(crop(key, cloud, keep).mask), in_axes=(0, None, None)))


@pytest.mark.parametrize("keep", [0.5, 0.7, 0.9, 1.0])
def test_crop_keeps_the_share_asked_for(cloud, keep):
    counts = _crop_counts(_KEYS[:20], make_cloud(cloud), jnp.float32(keep))
    assert np.abs(np.asarray(counts) - keep * 200).max() <= 1


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_share_of_cropped_clouds_is_the_one_asked_for(shapes, share):
    config = dataclasses.replace(_CONFIG, noise=0.0, outliers=0.0, cropped=share)
    batch = _batch(_KEYS[4], shapes, config, 64, 1.0)
    # Half of the pairs have half of the points in each cloud to begin with.
    left = np.stack([cloud.mask.sum(axis=1) for cloud in (batch.source, batch.target)])
    assert np.mean(~np.isin(left, [32, 64])) == pytest.approx(share, abs=0.15)


def test_crop_of_a_padded_cloud_keeps_a_share_of_its_real_points(cloud):
    mask = np.arange(200) < 100
    cropped = crop(_KEYS[0], make_cloud(cloud, mask), jnp.float32(0.5))
    assert abs(int(cropped.mask.sum()) - 50) <= 1
    assert not np.any(np.asarray(cropped.mask) & ~mask)


def test_crop_zeroes_what_it_takes_away(cloud):
    cropped = crop(_KEYS[0], make_cloud(cloud), jnp.float32(0.5))
    np.testing.assert_array_equal(cropped.points[~cropped.mask], 0)


def test_noise_is_clipped(cloud):
    noisy = add_noise(_KEYS[0], make_cloud(cloud), jnp.float32(1.0))
    difference = np.abs(np.asarray(noisy.points) - cloud)
    assert difference.max() <= 0.05 + 1e-6
    assert np.mean(difference > 0.049) > 0.9


def test_noise_has_the_standard_deviation_asked_for(cloud):
    noisy = add_noise(_KEYS[0], make_cloud(cloud), jnp.float32(0.01))
    assert np.std(np.asarray(noisy.points) - cloud) == pytest.approx(0.01, rel=0.1)


def test_noise_leaves_padding_alone(cloud):
    mask = np.arange(200) < 100
    np.testing.assert_array_equal(add_noise(_KEYS[0], make_cloud(cloud, mask), jnp.float32(0.01)).points[100:], 0)


def test_noise_of_the_two_clouds_is_independent(noisy):
    both = np.asarray(noisy.source.mask & noisy.target.mask)
    lengths = [
        np.linalg.norm(np.asarray(seen.points - whole.points)[both], axis=-1)
        for seen, whole in ((noisy.source, noisy.whole_source), (noisy.target, noisy.whole_target))
    ]
    assert not np.any(np.isclose(*lengths, rtol=1e-4, atol=0) & (lengths[0] > 1e-3))


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_outliers_replace_the_share_asked_for(cloud, share):
    shares = [
        np.any(np.asarray(add_outliers(key, make_cloud(cloud), share, 0.5).points) != cloud, axis=1).mean()
        for key in _KEYS[:5]
    ]
    assert np.mean(shares) == pytest.approx(share, abs=0.06)


def test_independent_halves_share_no_point(noisy):
    source, target = np.asarray(noisy.source.mask), np.asarray(noisy.target.mask)
    halves = ~source.all(axis=1)
    assert 0.25 < halves.mean() < 0.75
    assert not np.any(source[halves] & target[halves])
    assert np.all(source[halves].sum(axis=1) == 32)
    assert np.all(target[halves].sum(axis=1) == 32)


def test_corrupted_pairs_are_finite_and_keep_points(corrupted):
    for cloud in (corrupted.source, corrupted.target):
        assert bool(jnp.all(jnp.isfinite(cloud.points)))
        np.testing.assert_array_equal(np.asarray(cloud.points)[~np.asarray(cloud.mask)], 0)
        assert int(cloud.mask.sum(axis=1).min()) >= int(_CONFIG.keep * 32) - 1


def test_shape_with_fewer_points_than_asked_for_is_drawn_with_repetition(shapes):
    pair = jax.jit(make_pair, static_argnums=2)(_KEYS[0], shapes["points"][0, :20], _CONFIG, 0.0)
    assert pair.source.points.shape == (64, 3)
    assert bool(jnp.all(jnp.isfinite(pair.source.points)))


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"points": 2}, "^points: .*2"),
        ({"keep": 1.5}, "^keep: .*1.5"),
        ({"corrupted": -0.1}, "^corrupted: .*-0.1"),
        ({"noise": -1.0}, "^noise: .*-1.0"),
        ({"signed": float("nan")}, "^signed: .*nan"),
        ({"max_angle": float("nan")}, "^max_angle: .*nan"),
    ],
)
def test_pair_config_refuses_and_names_the_field(fields, says):
    with pytest.raises(ValueError, match=says):
        PairConfig(**fields)
