"""What is measured of regions, on labels made by hand and on a small network."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import make_cloud, subsample
from urrt_jax.model.network import encode


@pytest.fixture
def regions(load_script):
    return load_script("regions/run.py")


def _cut(regions, source, target, counterpart, near):
    source, target, counterpart = (np.array([each]) for each in (source, target, counterpart))
    return regions.Cut(source, source, target, counterpart, np.array([near]), np.array([[True]]), np.zeros(1))


def test_consistency_is_of_points_that_have_a_counterpart(regions):
    found = _cut(regions, [0, 1, 2, 2], [2, 1, 0], [2, 1, 1, 0], [True, True, True, False])
    assert regions.consistency(found.source, found) == pytest.approx(2 / 3)


def test_entropy_is_in_bits(regions):
    np.testing.assert_allclose(regions.entropy(np.array([[0.25] * 4, [1.0, 0, 0, 0]])), [2, 0], atol=1e-9)


def test_parts_of_the_same_points_are_the_same_before_anything_is_aligned(regions, parts_model, cloud):
    points = np.stack([cloud - cloud.mean(axis=0), cloud[:, ::-1] ** 2]).astype(np.float32)
    numbers, found, sources, targets = regions.measure(parts_model, np.tile(points, (1, 6, 1))[:, :1024], 1)
    assert numbers["consistency before alignment, clean"] > 0.99
    assert numbers["consistency before alignment, D.I. two-sided"] < 1
    assert numbers["pairs"] == len(sources) == len(targets) == len(found.source) == 2
    table = regions.as_markdown({"places": numbers, "parts": numbers})
    assert table.count("\n") == 2 + len(numbers) and table.startswith("| test pairs | places | parts |")


def test_how_far_centroids_of_regions_are_off_agrees_with_scipy(regions, small_model, cloud):
    source = (cloud - cloud.mean(axis=0)).astype(np.float32)
    turn = Rotation.from_rotvec([0.2, -0.3, 0.1])
    target = source @ turn.as_matrix().T.astype(np.float32)
    pair = source[None], target[None], turn.as_matrix()[None].astype(np.float32), np.zeros((1, 3), np.float32)
    off = float(regions.cut(small_model, *pair).off[0])
    sides = [make_cloud(points) for points in (source, target)]
    normal = regions.normalize_pair(*sides)[:2]
    ours, theirs = (encode(small_model, subsample(each, small_model.config.points)).regions for each in normal)
    shared = (ours.counts > 0) & (theirs.counts > 0)
    weights = np.where(shared, ours.counts + theirs.counts, 0.0)
    middles = [np.average(each.centroids, axis=0, weights=weights) for each in (ours, theirs)]
    found, _ = Rotation.align_vectors(theirs.centroids - middles[1], ours.centroids - middles[0], weights=weights)
    assert off == pytest.approx(np.rad2deg((found * turn.inv()).magnitude()), abs=0.2)
    assert off > 1  # fresh regions by place follow the pose
