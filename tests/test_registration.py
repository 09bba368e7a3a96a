"""The one call: what it recovers, what it is invariant to, how it says that it failed.

Compiling takes nearly all the time here. On arrays all clouds have at most 256 points, which is the first rung of the
ladder, and all tests run the same programs. Under ``jit`` and ``vmap`` tests share a few functions; none of these
searches, since a search takes long to compile into a program (``test_stages.py`` has it).
"""

import dataclasses
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from urrt_jax import ICP, Model, Registration, pad_clouds, register, registration
from urrt_jax.result import Outcome


def _angle(first, second) -> float:
    turn = np.asarray(first, np.float64).T @ np.asarray(second, np.float64)
    return float(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()))


def _finite(result) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(result))


@pytest.fixture(scope="module")
def call(small_model):
    """``register`` with the small model."""

    def register_small(source, target, **options):
        return register(source, target, **({"model": small_model} | options))

    return register_small


@pytest.fixture(scope="module")
def jitted(small_model):
    """``register`` under jit, of two clouds, masks, an initial transform and a distance: one program for all tests."""

    @jax.jit
    def register_jitted(source, target, source_mask, target_mask, initial, inlier_distance):
        return register(
            source,
            target,
            source_mask=source_mask,
            target_mask=target_mask,
            initial=initial,
            inlier_distance=inlier_distance,
            model=small_model,
            search=None,
        )

    def run(source, target, *, source_mask=None, target_mask=None, initial=np.eye(4), inlier_distance=0.1):
        masks = (
            np.ones(len(points), bool) if mask is None else mask
            for points, mask in ((source, source_mask), (target, target_mask))
        )
        return register_jitted(source, target, *masks, initial.astype(np.float32), inlier_distance)

    return run


@pytest.fixture(scope="module")
def batched(small_model):
    """``register`` of three pairs at a time, with masks and initial transforms: one program for all tests."""

    @jax.jit
    @jax.vmap
    def register_batched(source, target, source_mask, target_mask, initial):
        masks = {"source_mask": source_mask, "target_mask": target_mask}
        return register(source, target, **masks, initial=initial, model=small_model, search=None)

    def run(sources, targets, initial=np.stack([np.eye(4)] * 3)):
        clouds = [pad_clouds(each, size=256) for each in (sources, targets)]
        (source, source_mask), (target, target_mask) = clouds
        return register_batched(source, target, source_mask, target_mask, initial.astype(np.float32))

    return run


def _padded(points, count=223, fill=0.0):
    """The cloud with rows of padding behind it, and its mask."""
    rows = np.full((count - len(points), 3), fill, points.dtype)
    return np.concatenate([points, rows]), np.arange(count) < len(points)


@pytest.fixture(scope="module")
def call_padded(call):
    """``call`` of clouds padded to 223 rows, with these numbers in the padding."""

    def run(source, target, *, fills=(0.0, 0.0)):
        (source, source_mask), (target, target_mask) = (
            _padded(points, fill=fill) for points, fill in zip((source, target), fills, strict=True)
        )
        return call(source, target, source_mask=source_mask, target_mask=target_mask)

    return run


@pytest.fixture(scope="module")
def target(cloud, pose) -> np.ndarray:
    return (cloud @ pose[0].T + pose[1]).astype(np.float32)


@pytest.fixture(scope="module")
def plain(call, cloud, target) -> Registration:
    return call(cloud, target)


def test_the_grid_under_jit_is_that_of_the_dtype_at_hand(x64):
    """Doubles far from the origin have lost no digits."""
    far = _MAP[None]
    for dtype in (np.float32, np.float64):
        spacing = float(np.spacing(np.abs(far).max().astype(dtype)))
        assert spacing / 2 <= float(registration._grid(jnp.asarray(far, dtype))) <= 4 * spacing


def _same(result, expected, *, atol=1e-4, scale=1.0):
    assert _angle(result.rotation, expected.rotation) < atol
    np.testing.assert_allclose(np.asarray(result.translation) / scale, expected.translation, atol=atol)


def test_recovers_a_pose_of_ten_degrees(plain, pose):
    assert _angle(plain.rotation, pose[0]) < 1e-3
    np.testing.assert_allclose(plain.translation, pose[1], atol=1e-3)


def test_clean_pair_converges_with_full_fitness(plain):
    assert bool(plain.converged)
    assert float(plain.fitness) == 1
    assert float(plain.rmse) < 1e-3


@pytest.fixture(scope="module")
def unlike(target) -> np.ndarray:
    """The target with noise, so that it does not hold the source's points, which would tell the pose."""
    return target + np.random.default_rng(7).normal(scale=0.01, size=target.shape).astype(np.float32)


def test_network_alone_is_not_the_answer(call, cloud, unlike, pose):
    """Otherwise refinement would have nothing to do."""
    found = call(cloud, unlike)
    assert _angle(found.coarse.rotation, pose[0]) > 0.02
    assert _angle(found.rotation, pose[0]) < 0.02


def test_refinement_starts_after_two_steps_of_the_network(call, small_config, make_model, cloud, unlike):
    patient = make_model(dataclasses.replace(small_config, steps=3))
    two, three = (call(cloud, unlike, model=model, refine=None) for model in (patient.at_most(2), patient))
    assert _angle(two.rotation, three.rotation) > 1e-3
    coarse = call(cloud, unlike, model=patient).coarse
    np.testing.assert_allclose(coarse.rotation, two.rotation, atol=1e-6)
    np.testing.assert_allclose(coarse.translation, two.translation, atol=1e-6)


def _far(degrees=150.0) -> np.ndarray:
    """A transform far from the identity, (4, 4) float64."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    matrix[:3, 3] = [3.0, -1.0, 2.0]
    return matrix


@pytest.fixture(scope="module")
def far_target(cloud, pose) -> np.ndarray:
    """The cloud moved far, and then by ``pose``."""
    moved = cloud @ _far()[:3, :3].T + _far()[:3, 3]
    return (moved @ pose[0].T + pose[1]).astype(np.float32)


@pytest.fixture(scope="module")
def begun(call, cloud, far_target) -> Registration:
    return call(cloud, far_target, initial=_far())


def test_a_rough_transform_is_what_registration_begins_with(call, cloud, far_target, pose, begun):
    np.testing.assert_allclose(begun.rotation, pose[0] @ _far()[:3, :3], atol=1e-4)
    np.testing.assert_allclose(begun.translation, pose[0] @ _far()[:3, 3] + pose[1], atol=1e-3)
    assert bool(begun.converged)
    noise = np.random.default_rng(8).normal(scale=0.004, size=cloud.shape)  # hides that both hold the same points
    without = call(cloud, (far_target + noise).astype(np.float32), search=None)
    assert _angle(without.rotation, begun.rotation) > 0.3


def test_beginning_somewhere_is_moving_the_source_there(call, cloud, far_target, begun):
    moved = (cloud @ _far()[:3, :3].T + _far()[:3, 3]).astype(np.float32)
    plain = call(moved, far_target)
    np.testing.assert_allclose(begun.matrix, np.asarray(plain.matrix, np.float64) @ _far(), atol=1e-4)
    np.testing.assert_array_equal(begun.correspondences, plain.correspondences)
    np.testing.assert_allclose(begun.information, plain.information, rtol=1e-3, atol=1e-2)


def test_a_rough_transform_that_lies_better_than_the_network_s_estimate_is_refined(call, cloud):
    """Two parts that hardly overlap: their centres, all that the network is told of places, are far apart."""
    source, target = cloud[cloud[:, 0] < 0.55], cloud[cloud[:, 0] > -0.25]
    rough = np.eye(4)
    rough[:3, :3], rough[:3, 3] = Rotation.from_rotvec([0.02, -0.03, 0.02]).as_matrix(), 0.02
    found = call(source, target, initial=rough, search=None)
    assert _angle(found.rotation, np.eye(3)) < 1e-3
    assert bool(found.converged)


def test_a_rough_transform_that_lies_better_is_refined_beside_an_automatic_search(call, cloud):
    source, target = cloud[cloud[:, 0] < 0.55], cloud[cloud[:, 0] > -0.25]
    rough = np.eye(4)
    rough[:3, :3], rough[:3, 3] = Rotation.from_rotvec([0.02, -0.03, 0.02]).as_matrix(), 0.02
    assert _angle(call(source, target, initial=rough).rotation, np.eye(3)) < 1e-3


def test_a_rough_transform_at_map_coordinates_costs_no_digits(call, cloud, far_target, begun):
    here, there = np.array([5e5, 4e6, 100.0]), np.array([4e5, 5e6, -200.0])
    initial = _far()
    initial[:3, 3] += there - initial[:3, :3] @ here
    found = call(cloud.astype(np.float64) + here, far_target.astype(np.float64) + there, initial=initial)
    np.testing.assert_allclose(found.apply(cloud + here) - there, begun.apply(cloud), atol=1e-4)


def test_each_pair_of_a_batch_begins_where_it_is_told(batched, cloud, far_target, target, pose, begun):
    found = batched([cloud] * 3, [far_target, target, far_target], np.stack([_far(), np.eye(4), _far()]))
    np.testing.assert_allclose(found.matrix[0], begun.matrix, atol=1e-3)
    assert _angle(found.rotation[1], pose[0]) < 1e-3
    np.testing.assert_allclose(found.matrix[2], begun.matrix, atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_rough_transform_that_is_not_finite_is_flagged_under_jit(jitted, cloud, target, bad):
    spoiled = _far()
    spoiled[0, 3] = bad
    found = jitted(cloud, target, initial=spoiled)
    assert _finite(found) and not bool(found.converged)
    assert found.reason == "the initial transform is not finite"


def test_a_rotation_that_is_rounded_gives_a_rotation(call, cloud, far_target, begun):
    rounded = np.round(_far(), 3)
    found = call(cloud, far_target, initial=rounded).rotation
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-5)
    assert _angle(found, begun.rotation) < 1e-3


_SKEWED = np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        pytest.param(np.eye(3), r"expected shape \(4, 4\), got \(3, 3\)", id="a rotation"),
        pytest.param(_SKEWED, "expected a rotation", id="sheared"),
        pytest.param(np.diag([1.0, 1, -1, 1]), "expected a rotation", id="a reflection"),
        pytest.param(np.diag([2.0, 2, 2, 1]), "expected a rotation", id="scaled"),
        pytest.param(np.full((4, 4), np.nan), "expected a rotation", id="not finite"),
        pytest.param(_far().T, "expected a rotation", id="transposed"),
    ],
)
def test_a_rough_transform_that_is_not_rigid_is_refused(call, cloud, target, initial, message):
    with pytest.raises(ValueError, match=f"^initial: {message}"):
        call(cloud, target, initial=initial)


def test_without_refinement_the_answer_is_the_network_s(call, cloud, unlike):
    alone, coarse = call(cloud, unlike, refine=None), call(cloud, unlike).coarse
    np.testing.assert_allclose(alone.rotation, coarse.rotation, atol=1e-6)
    np.testing.assert_allclose(alone.translation, coarse.translation, atol=1e-6)
    assert int(alone.steps) == 0


def test_other_ways_to_refine_find_the_same_pose(call, cloud):
    """tests/refine tries more of them."""
    small = Rotation.from_rotvec([0, 0, 0.02]).as_matrix()
    found = call(cloud, (cloud @ small.T + 0.005).astype(np.float32), refine=ICP(coarse_points=32, points=50))
    assert _angle(found.rotation, small) < 1e-3


@pytest.mark.parametrize("which", [0, 1])
def test_order_of_points_does_not_matter(call, cloud, target, plain, which):
    clouds = [cloud, target]
    clouds[which] = np.random.default_rng(0).permutation(clouds[which])
    _same(call(*clouds), plain)


@pytest.mark.parametrize("which", [0, 1])
def test_moving_a_cloud_moves_the_answer(call, cloud, target, plain, which):
    clouds, offset = [cloud, target], np.array([1000.0, -300, 500], np.float32)
    clouds[which] = clouds[which] + offset
    result = call(*clouds)
    # Coordinates near 1000 are rounded to 6e-5 before anything here sees them.
    assert _angle(result.rotation, plain.rotation) < 1e-3
    expected = plain.translation + (offset if which else -plain.rotation @ offset)
    np.testing.assert_allclose(result.translation, expected, atol=0.3)
    np.testing.assert_allclose(result.apply(clouds[0].mean(0)), clouds[1].mean(0), atol=1e-3)


@pytest.mark.parametrize("scale", [1e-3, 1e3, 1e6])
def test_common_scale_scales_the_answer(call, cloud, target, plain, scale):
    result = call(cloud * np.float32(scale), target * np.float32(scale))
    _same(result, plain, scale=scale)
    for name in ("rmse", "inlier_distance"):
        assert float(getattr(result, name)) / scale == pytest.approx(float(getattr(plain, name)), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("scale", [1e-25, 1e-12, 1e12])
def test_extreme_scale_scales_the_answer(call, cloud, target, plain, scale):
    result = call(cloud * np.float32(scale), target * np.float32(scale))
    assert _angle(result.rotation, plain.rotation) < 1e-3
    np.testing.assert_allclose(np.asarray(result.translation, np.float64) / scale, plain.translation, atol=1e-3)
    assert bool(result.converged)


@pytest.mark.parametrize(
    ("factor", "says"), [(1000, "millimetres"), (0.01, "centimetres"), (39.37, "inches"), (6.5, "another unit")]
)
def test_a_pair_that_differs_in_size_is_asked_about_its_units(call, cloud, target, factor, says):
    with pytest.warns(UserWarning, match=rf"scale ratio [\d.]+: is one in {says}\?"):
        result = call(cloud * np.float32(factor), target)
    assert not bool(result.converged)


def test_stray_points_are_no_question_of_units(call, cloud, target):
    stray = cloud.copy()
    stray[:3] *= np.float32(1000)
    call(stray, target)  # a warning would be an error here


@pytest.mark.parametrize("scale", [1e16, 1e30])
@pytest.mark.parametrize("which", ["source", "target"])
def test_clouds_that_spread_too_far_for_float32_are_refused(call, cloud, target, which, scale):
    clouds = {"source": cloud, "target": target}
    with pytest.raises(ValueError, match=rf"^{which}: the points spread over .*, more than the 1e\+15"):
        call(**clouds | {which: clouds[which] * np.float32(scale)})


@pytest.mark.parametrize("scale", [1e16, 1e30])
def test_clouds_that_spread_too_far_for_float32_are_finite_and_flagged_under_jit(jitted, cloud, target, scale):
    result = jitted(cloud * np.float32(scale), target * np.float32(scale))
    assert _finite(result)
    assert not bool(result.converged)
    assert int(result.outcome) == Outcome.DEGENERATE


_MAP = np.array([5e5, 4e6, 100.0])  # float32 numbers near 4e6 are a quarter apart


@pytest.mark.parametrize("way", ["eager", "jit"])
def test_map_coordinates_in_float32_are_flagged_and_the_reason_names_float32(call, jitted, cloud, target, way):
    """Whose spacing is below the step between float32 numbers."""
    far = [(points + _MAP).astype(np.float32) for points in (cloud, target)]
    result = (call if way == "eager" else jitted)(*far)
    assert _finite(result)
    assert not bool(result.converged)
    assert "float32" in result.reason


def test_the_same_map_coordinates_in_float64_converge(call, cloud, target, pose):
    result = call(*(points.astype(np.float64) + _MAP for points in (cloud, target)))
    assert bool(result.converged)
    assert result.reason == "converged"
    assert _angle(result.rotation, pose[0]) < 1e-3


def test_map_coordinates_in_float64_keep_the_rotation(call, cloud, pose):
    origin = np.array([5e6, 4e5, 300.0])
    source = cloud.astype(np.float64) + origin
    moved = cloud.astype(np.float64) @ pose[0].T + pose[1] + origin
    result = call(source, moved)
    assert _angle(result.rotation, pose[0]) < 1e-3
    assert bool(result.converged)


def test_map_coordinates_in_float64_carry_the_origin_in_the_translation(call, cloud, pose):
    origin = np.array([1000.0, -2000, 500])
    result = call(cloud.astype(np.float64) + origin, cloud.astype(np.float64) @ pose[0].T + pose[1])
    expected = pose[1] - np.asarray(result.rotation, np.float64) @ origin
    np.testing.assert_allclose(result.translation, expected, atol=2e-3)


@pytest.mark.parametrize(
    "convert",
    [
        pytest.param(lambda p: p.tolist(), id="lists"),
        pytest.param(lambda p: p.astype(np.float64), id="float64"),
        pytest.param(lambda p: jnp.asarray(p), id="jax"),
        pytest.param(lambda p: p.astype(np.float16), id="float16"),
        pytest.param(lambda p: jnp.asarray(p, jnp.float16), id="jax float16"),
        pytest.param(lambda p: jnp.asarray(p, jnp.bfloat16), id="jax bfloat16"),
        pytest.param(lambda p: np.round(p * 1e4).astype(np.int32), id="integers"),
        pytest.param(lambda p: jnp.asarray(np.round(p * 1e4), jnp.int32), id="jax integers"),
        pytest.param(lambda p: np.asfortranarray(p), id="column order"),
        pytest.param(lambda p: np.concatenate([p, p], 1)[:, :3], id="strided view"),
    ],
)
def test_every_real_dtype_gives_the_rotation_in_float32(call, cloud, target, pose, convert):
    result = call(convert(cloud), convert(target))
    assert result.rotation.dtype == jnp.float32
    assert _angle(result.rotation, pose[0]) < 0.02


@pytest.mark.parametrize("fills", [(1e4, 0.0), (0.0, 1e4), (np.nan, np.inf)], ids=["source", "target", "not finite"])
def test_padding_changes_nothing(call_padded, cloud, target, plain, fills):
    result = call_padded(cloud, target, fills=fills)
    _same(result, plain)
    assert float(result.fitness) == pytest.approx(float(plain.fitness))


def test_padding_of_float64_clouds_may_be_anything(call_padded, cloud, target, plain):
    _same(call_padded(cloud.astype(np.float64), target, fills=(1e12, 0.0)), plain)


def _scattered(points, count, seed):
    """The cloud in its order among ``count`` rows of which any may be padding, and the mask."""
    mask = np.zeros(count, bool)
    mask[np.random.default_rng(seed).permutation(count)[: len(points)]] = True
    rows = np.full((count, 3), 7.0, points.dtype)
    rows[mask] = points
    return rows, mask


def test_real_points_may_stand_anywhere_among_padding(call, cloud, target, plain):
    (source, source_mask), (goal, goal_mask) = _scattered(cloud, 301, 0), _scattered(target, 250, 1)
    result = call(source, goal, source_mask=source_mask, target_mask=goal_mask)
    _same(result, plain)
    assert result.correspondences.shape == result.source_regions.shape == (301,)
    assert result.target_regions.shape == (250,)
    np.testing.assert_array_equal(result.correspondences[~source_mask], -1)
    # The target's rows count in the array that was given.
    rows = np.flatnonzero(goal_mask)[np.asarray(plain.correspondences)]
    np.testing.assert_array_equal(result.correspondences[source_mask], rows)
    for labels, mask, expected in (
        (result.source_regions, source_mask, plain.source_regions),
        (result.target_regions, goal_mask, plain.target_regions),
    ):
        np.testing.assert_array_equal(labels[~mask], 0)
        np.testing.assert_array_equal(labels[mask], expected)


def test_real_points_may_stand_anywhere_among_padding_under_jit(call, jitted, cloud, target):
    kept = np.random.default_rng(0).permutation(200)[:150]
    mask = np.isin(np.arange(200), kept)
    spoiled = np.where(mask[:, None], cloud, np.float32(40))
    result, expected = jitted(spoiled, target, source_mask=mask), call(cloud[mask], target, initial=np.eye(4))
    _same(result, expected)
    np.testing.assert_array_equal(result.correspondences[~mask], -1)
    np.testing.assert_array_equal(result.source_regions[~mask], 0)
    assert float(result.confidence) == pytest.approx(float(expected.confidence), abs=1e-3)


def test_more_padding_under_jit_changes_no_answer(jitted, make_cloud_points, pose):
    """Of independent, noisy samples, which go through all stages of refinement."""
    rng = np.random.default_rng(0)
    source, target = (rng.permutation(make_cloud_points(seed))[:150] for seed in (1, 2))
    target = (target @ pose[0].T + pose[1] + rng.normal(scale=0.02, size=target.shape)).astype(np.float32)
    less, more = (
        jitted(*(_padded(each, rows)[0] for each in (source, target)), source_mask=mask, target_mask=mask)
        for rows, mask in ((rows, np.arange(rows) < 150) for rows in (200, 300))
    )
    _same(more, less, atol=1e-5)
    assert float(more.confidence) == pytest.approx(float(less.confidence), abs=1e-4)
    assert int(more.outcome) == int(less.outcome)
    for name in ("correspondences", "source_regions", "target_regions"):
        np.testing.assert_array_equal(getattr(more, name)[:150], getattr(less, name)[:150])


def test_regions_have_one_label_a_point_and_zero_at_padding(call_padded, cloud, target):
    result = call_padded(cloud, target, fills=(1.0, 1.0))
    for labels in (result.source_regions, result.target_regions):
        assert labels.shape == (223,)
        np.testing.assert_array_equal(labels[200:], 0)
        assert 0 <= int(labels.min()) <= int(labels.max()) < 4


def test_several_regions_are_in_use(plain):
    """Otherwise zero at padding would say nothing."""
    assert len(np.unique(plain.source_regions)) > 1


def test_jit_agrees_with_eager(jitted, cloud, target, plain):
    _same(jitted(cloud, target), plain, atol=1e-5)


@pytest.fixture(scope="module")
def batch(cloud, target, make_cloud_points):
    """Three pairs: a batch as long as a rotation, so that a wrong transpose would fit."""
    other = make_cloud_points(7)
    turn = Rotation.from_rotvec([0.1, -0.05, 0.1]).as_matrix()
    return np.stack([cloud, other, target]), np.stack([target, (other @ turn.T).astype(np.float32), cloud])


@pytest.fixture(scope="module")
def together(batched, batch):
    return batched(*batch)


def test_vmap_agrees_with_a_loop(call, batch, together):
    for i in range(3):
        alone = call(batch[0][i], batch[1][i], initial=np.eye(4))
        _same(jax.tree.map(lambda leaf, i=i: leaf[i], together), alone)


def test_batched_matrix_is_one_matrix_a_pair(together):
    matrix = np.asarray(together.matrix)
    assert matrix.shape == (3, 4, 4)
    np.testing.assert_array_equal(matrix[:, :3, :3], together.rotation)
    np.testing.assert_array_equal(matrix[:, :3, 3], together.translation)
    np.testing.assert_array_equal(matrix[:, 3], [[0, 0, 0, 1]] * 3)


def test_batched_apply_moves_every_cloud_by_its_own_transform(batch, together):
    moved = together.apply(batch[0])
    for i in range(3):
        expected = batch[0][i] @ np.asarray(together.rotation[i]).T + np.asarray(together.translation[i])
        np.testing.assert_allclose(moved[i], expected, atol=1e-5)


def test_batched_transform_agrees_with_the_batched_matrix(together):
    np.testing.assert_allclose(together.transform.as_matrix()[:, :3, :3], together.rotation, atol=1e-5)


def test_batch_of_clouds_of_several_sizes_agrees_with_a_loop(batched, call, cloud, target):
    sources, targets = [cloud, cloud[:150], cloud[20:]], [target, target, target[:180]]
    results = batched(sources, targets)
    for i, pair in enumerate(zip(sources, targets, strict=True)):
        _same(jax.tree.map(lambda leaf, i=i: leaf[i], results), call(*pair, initial=np.eye(4)))


def test_matrix_transform_and_apply_agree(plain, cloud, target):
    np.testing.assert_allclose(plain.apply(cloud), target, atol=2e-3)
    homogeneous = np.concatenate([cloud, np.ones((200, 1), np.float32)], 1) @ np.asarray(plain.matrix).T
    np.testing.assert_allclose(homogeneous[:, :3], plain.apply(cloud), atol=1e-5)
    np.testing.assert_allclose(plain.transform.apply(jnp.asarray(cloud)), plain.apply(cloud), atol=1e-5)


def test_clouds_of_other_libraries_are_moved_by_their_points(plain, cloud):
    np.testing.assert_array_equal(plain.apply(trimesh.PointCloud(cloud)), plain.apply(np.asarray(cloud, np.float64)))


def test_correspondences_are_the_nearest_points_within_the_inlier_distance(call_padded, cloud, target):
    half = target[:100]
    result = call_padded(cloud, half)
    distance, row = cKDTree(half).query(result.apply(cloud))
    inlier = distance < float(result.inlier_distance)
    assert 0 < inlier.sum() < len(cloud)
    np.testing.assert_array_equal(result.correspondences[:200], np.where(inlier, row, -1))
    np.testing.assert_array_equal(result.correspondences[200:], -1)
    assert float(result.fitness) == pytest.approx(inlier.mean())


@pytest.mark.parametrize("origin", [0.0, 5e5], ids=["near", "map coordinates"])
def test_information_is_about_the_origin_of_the_targets_own_frame(call, cloud, target, origin):
    """Against the sum of GᵀG over the corresponding target points, which float64 carries far from the origin too."""
    goal = target.astype(np.float64) + origin * np.array([1.0, -2.0, 0.5])
    result = call(cloud.astype(np.float64), goal)
    rows = np.asarray(result.correspondences)
    expected = np.zeros((6, 6))
    for x, y, z in goal[rows[rows >= 0]]:
        jacobian = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
        expected += jacobian.T @ jacobian
    np.testing.assert_allclose(result.information, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_swapping_the_clouds_gives_the_inverse(call, cloud, target, plain):
    back = call(target, cloud)
    np.testing.assert_allclose(back.matrix @ plain.matrix, np.eye(4), atol=1e-3)


@pytest.fixture(scope="module")
def apart(cloud) -> np.ndarray:
    """Points of the cloud of which no two are close to each other."""
    kept = cloud[:1]
    for point in cloud[1:]:
        if np.linalg.norm(kept - point, axis=1).min() > 0.15:
            kept = np.concatenate([kept, point[None]])
    return kept


_EXACT = ICP(em_points=0)  # EM-ICP has derivatives of its own: tests/refine


@pytest.fixture(scope="module")
def differentiate(small_model):
    """A function that returns the value and the gradient (source, target, inlier distance) of a sum over the result.

    Without jit: derivatives are compiled for a rung, so that all tests share the programs.
    """

    def total(arguments, weights, refine, masks):
        source, target, inlier_distance = arguments
        refine = dataclasses.replace(refine, inlier_distance=inlier_distance)
        result = register(source, target, **masks, model=small_model, refine=refine, search=None)
        turning, shifting, rest = weights
        return jnp.sum(result.rotation * turning) + jnp.sum(result.translation * shifting) + rest * result.rmse

    compiled = jax.value_and_grad(total)

    def run(source, target, weights=(0.0, 0.0, 0.0), *, inlier_distance=1.0, refine=_EXACT, masks=None):
        turning, shifting, rest = weights
        weights = np.broadcast_to(np.float32(turning), (3, 3)), np.broadcast_to(np.float32(shifting), 3), rest
        arguments = *(jnp.asarray(points, jnp.float32) for points in (source, target)), jnp.float32(inlier_distance)
        return compiled(arguments, weights, refine, masks or {})

    return run


@pytest.fixture(scope="module")
def noisy_target(apart, pose) -> np.ndarray:
    """Noise, so that the fit is not perfect; the points lie so far apart that correspondences hold."""
    noise = 0.01 * np.random.default_rng(0).normal(size=apart.shape)
    return (apart @ pose[0].T + pose[1] + noise).astype(np.float32)


_WEIGHTS = [
    (np.random.default_rng(1).normal(size=(3, 3)), 0.0, 0.0),
    (0.0, np.random.default_rng(2).normal(size=3), 0.0),
]
# Normals change when a neighbourhood does: points alone.
_POINTWISE = dataclasses.replace(_EXACT, plane=0.0, tolerance=3e-7)


@pytest.mark.parametrize("weights", _WEIGHTS, ids=["rotation", "translation"])
@pytest.mark.parametrize("which", [0, 1], ids=["source", "target"])
def test_derivative_in_the_points_agrees_with_finite_differences(differentiate, apart, noisy_target, which, weights):
    along = np.random.default_rng(3).normal(size=apart.shape).astype(np.float32)

    def at(step):
        clouds = [apart, noisy_target]
        clouds[which] = clouds[which] + np.float32(step) * along
        return differentiate(*clouds, weights, refine=_POINTWISE)

    step = 1e-4  # little against the noise, which the width of the weights follows
    expected = (float(at(step)[0]) - float(at(-step)[0])) / (2 * step)
    assert float(jnp.sum(at(0.0)[1][which] * along)) == pytest.approx(expected, rel=0.02, abs=5e-3)


@pytest.mark.parametrize("weights", _WEIGHTS, ids=["rotation", "translation"])
def test_derivative_in_the_inlier_distance_agrees_with_finite_differences(differentiate, apart, noisy_target, weights):
    """The distance is so short that it, and not the noise, bounds the width of the weights."""

    def at(distance):
        value, (_, _, slope) = differentiate(apart, noisy_target, weights, inlier_distance=distance, refine=_POINTWISE)
        return float(value), float(slope)

    short, step = 0.08, 2e-3
    expected = (at(short + step)[0] - at(short - step)[0]) / (2 * step)
    assert abs(expected) > 1e-3  # otherwise there is nothing to agree on
    assert at(short)[1] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivative_of_the_translation_follows_a_moved_cloud(differentiate, cloud, target, axis):
    _, (_, gradient, _) = differentiate(cloud, target, (0.0, np.eye(3)[axis], 0.0))
    np.testing.assert_allclose(jnp.sum(gradient, axis=0), np.eye(3)[axis], atol=1e-3)


def test_derivatives_of_two_sizes_are_traced_and_compiled_once(differentiate, monkeypatch, cloud, target):
    traced = []
    whole = registration.register_in_frame
    monkeypatch.setattr(registration, "register_in_frame", lambda *given: traced.append(given) or whole(*given))
    jax.clear_caches()
    for count in (200, 150, 101):
        differentiate(cloud[:count], target[: count - 1], (1.0, 1.0, 1.0))
    assert len(traced) == 1


@pytest.fixture(scope="module")
def differentiate_network(small_model):
    """The gradient, in the parameters and in the source, of a sum over the network's own estimate."""

    def total(params, source, target, masks):
        model = Model(small_model.config, params)
        result = register(source, target, **masks, model=model, refine=None)
        return jnp.sum(result.rotation * jnp.arange(9.0).reshape(3, 3)) + jnp.sum(result.translation) + result.rmse

    compiled = jax.grad(total, argnums=(0, 1))
    return lambda source, target, masks: compiled(small_model.params, jnp.asarray(source), target, masks)


def test_network_alone_differentiates_in_the_parameters(differentiate_network, cloud, target):
    gradient, _ = differentiate_network(cloud, target, {})
    leaves = jax.tree.leaves(gradient["decoder"]) + jax.tree.leaves(gradient["encoder"])
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves)
    assert any(bool(jnp.any(leaf)) for leaf in leaves)


_SPHERE = np.random.default_rng(0).normal(size=(200, 3))
_SPHERE = (_SPHERE / np.linalg.norm(_SPHERE, axis=1, keepdims=True)).astype(np.float32)
_CUBE = np.stack(np.meshgrid(*[np.linspace(-1, 1, 6)] * 3), -1).reshape(-1, 3)
_CUBE = _CUBE[np.abs(_CUBE).max(1) > 0.99].astype(np.float32)


@pytest.mark.parametrize("points", [_SPHERE, _CUBE, _CUBE * [1, 1, 0]], ids=["sphere", "cube", "square"])
@pytest.mark.parametrize("refined", [False, True], ids=["network", "icp"])
def test_gradient_is_finite_for_equal_symmetric_clouds(differentiate, differentiate_network, points, refined):
    rows, mask = _padded(points.astype(np.float32), 200)
    masks = {"source_mask": mask, "target_mask": mask}
    if refined:
        _, gradient = differentiate(rows, rows, (np.arange(9.0).reshape(3, 3), 1.0, 1.0), masks=masks)
    else:
        gradient = differentiate_network(rows, rows, masks)
    assert _finite(gradient)


def test_cloud_onto_itself_stays(call, cloud):
    result = call(cloud, cloud)
    assert _angle(result.rotation, np.eye(3)) < 1e-3
    np.testing.assert_allclose(result.translation, 0, atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_points_under_jit_are_ignored(jitted, cloud, target, plain, bad):
    spoilt = cloud.copy()
    spoilt[[3, 50], [0, 2]] = bad
    result = jitted(spoilt, target)
    assert _finite(result)
    assert _angle(result.rotation, plain.rotation) < 5e-3


@pytest.mark.parametrize("which", ["source", "target"])
def test_cloud_of_nan_under_jit_is_finite_and_flagged(jitted, cloud, target, which):
    clouds = {"source": cloud, "target": target}
    clouds[which] = np.full((200, 3), np.nan, np.float32)
    result = jitted(**clouds)
    assert _finite(result)
    assert not bool(result.converged)


@pytest.mark.parametrize("which", ["source_mask", "target_mask"])
def test_masked_out_cloud_under_jit_is_finite_and_flagged(jitted, cloud, target, which):
    result = jitted(cloud, target, **{which: np.zeros(200, bool)})
    assert _finite(result)
    assert not bool(result.converged)


@pytest.mark.parametrize("which", ["source", "target", "both"])
def test_collinear_clouds_along_an_axis_are_flagged(call, cloud, which):
    line = np.zeros((200, 3), np.float32)
    line[:, 0] = np.linspace(-1, 1, 200)
    result = call(cloud if which == "target" else line, cloud if which == "source" else line)
    assert _finite(result)
    assert not bool(result.converged)


def test_collinear_clouds_in_any_direction_are_flagged(batched):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(7, 3, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    lines = (np.linspace(-1, 1, 200)[:, None] * directions[:, :, None]).astype(np.float32)
    assert not any(bool(jnp.any(batched(list(three), list(three)).converged)) for three in lines)


def test_planar_clouds_are_not_flagged(call, cloud):
    flat = cloud * np.array([1, 1, 0], np.float32)
    turn = Rotation.from_rotvec([0.05, 0.02, 0.1]).as_matrix()
    result = call(flat, (flat @ turn.T).astype(np.float32))
    assert bool(result.converged)


def test_unrelated_clouds_are_not_called_converged(call):
    rng = np.random.default_rng(0)
    dense_line = np.outer(np.linspace(-1, 1, 200), [1, 0, 0]) + 0.001 * rng.normal(size=(200, 3))
    ring = np.stack([np.cos(np.arange(200)), np.sin(np.arange(200)), np.zeros(200)], 1)
    result = call(dense_line.astype(np.float32), ring.astype(np.float32))
    assert _finite(result)
    assert float(result.fitness) < 0.3
    assert not bool(result.converged)


def _tower(seed: int) -> np.ndarray:
    """200 points of a box that four turns about its axis map to itself."""
    random, rows = np.random.default_rng(seed), np.arange(200)
    points = random.uniform(size=(200, 3))
    points[rows, rows % 3] = random.integers(2, size=200)
    return points * [1, 1, 2]


def _reasons(call, cloud, target) -> dict[Outcome, Registration]:
    """Pairs that end in this or that way."""
    line = np.outer(np.linspace(-1, 1, 200), [0.3, -0.5, 0.8])
    return {
        Outcome.CONVERGED: call(cloud, target),
        Outcome.DEGENERATE: call(line, line),
        Outcome.UNSETTLED: call(cloud, target, refine=ICP(iterations=1)),
        Outcome.MISFIT: call(cloud, _SPHERE),
        Outcome.AMBIGUOUS: call(_tower(10), _tower(11)),
        Outcome.DIGITS: call(*((points + _MAP).astype(np.float32) for points in (cloud, target))),
    }


def test_every_outcome_is_told_in_words_of_its_own(call, cloud, target):
    found = _reasons(call, cloud, target)
    assert {outcome: Outcome(int(result.outcome)) for outcome, result in found.items()} == {
        each: each for each in found
    }
    words = {
        Outcome.CONVERGED: "converged",
        Outcome.DEGENERATE: "one line",
        Outcome.UNSETTLED: "iterations",
        Outcome.MISFIT: "do not lie on each other",
        Outcome.AMBIGUOUS: "another pose fits",
        Outcome.DIGITS: "float32",
    }
    for outcome, result in found.items():
        assert words[outcome] in result.reason
        assert bool(result.converged) == (outcome == Outcome.CONVERGED)


def test_every_outcome_has_a_reason_and_a_batch_has_one_each(plain):
    codes = jnp.array([int(outcome) for outcome in Outcome])
    batch = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(codes), *np.shape(leaf))), plain)
    reasons = dataclasses.replace(batch, outcome=codes).reason
    assert len(set(reasons)) == len(Outcome) and all(reasons)
    assert reasons[0] == plain.reason == "converged"


def test_cloud_of_two_far_blobs_is_registered(call, cloud, pose):
    source = np.concatenate([cloud[:140], 0.5 * cloud[:60] + np.float32(8)])
    moved = (source @ pose[0].T + pose[1]).astype(np.float32)
    result = call(source, moved)
    assert _angle(result.rotation, pose[0]) < 1e-3
    assert bool(result.converged)


def test_every_point_given_twice_changes_nothing(call, cloud, target, pose):
    """As the corners of a triangle soup are."""
    result = call(np.repeat(cloud[::2], 2, axis=0), np.repeat(target[::2], 2, axis=0))
    assert _angle(result.rotation, pose[0]) < 1e-3
    assert bool(result.converged)


def test_three_points_are_enough(call):
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], np.float32)
    result = call(triangle, triangle + 1)
    assert _finite(result)


@pytest.mark.parametrize("which", ["source", "target"])
@pytest.mark.parametrize(
    ("points", "says"),
    [
        pytest.param(np.zeros((5, 2)), r"\(5, 2\)", id="shape"),
        pytest.param(np.zeros((0, 3)), "empty", id="empty"),
        pytest.param(np.full((5, 3), np.nan), "15 NaN", id="nan"),
        pytest.param(np.ones((5, 3)), "distinct points, got 1", id="one point"),
        pytest.param(np.ones((5, 3), bool), "bool", id="dtype"),
        pytest.param(np.array([[2**25, 0, 0], [1, 1, 1], [2, 2, 0]]), r"2\*\*24", id="large integers"),
    ],
)
def test_bad_input_names_the_argument(call, cloud, which, points, says):
    with pytest.raises(ValueError, match=rf"^{which}: .*{says}"):
        call(**{"source": cloud, "target": cloud, which: points})


@pytest.mark.parametrize("which", ["source_mask", "target_mask"])
def test_mask_of_the_wrong_length_is_named(call, cloud, which):
    with pytest.raises(ValueError, match=rf"^{which}: "):
        call(cloud, cloud, **{which: np.ones(199, bool)})


@pytest.mark.parametrize("distance", [0.0, -1.0, float("nan")])
def test_inlier_distance_must_be_positive(call, cloud, distance):
    with pytest.raises(ValueError, match=r"^inlier_distance: "):
        call(cloud, cloud, inlier_distance=distance)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"points": 2}, "^points: .*2"),
        ({"iterations": 0}, "^iterations: .*0"),
        ({"coarse_points": -1}, "^coarse_points: .*-1"),
        ({"reach": 0.0}, "^reach: .*0.0"),
        ({"tolerance": float("nan")}, "^tolerance: .*nan"),
    ],
)
def test_icp_refuses_and_names_the_option(fields, says):
    with pytest.raises(ValueError, match=says):
        ICP(**fields)


@pytest.mark.parametrize("inlier_distance", [0.01, 0.05, 0.2, 10.0])
def test_fitness_and_rmse_agree_with_a_kd_tree_over_all_points(call, make_cloud_points, pose, inlier_distance):
    source = make_cloud_points(1)
    noise = 0.02 * np.random.default_rng(2).normal(size=source.shape)
    moved = (source @ pose[0].T + pose[1] + noise)[: len(source) // 2].astype(np.float32)
    result = call(source, moved, inlier_distance=inlier_distance)
    assert float(result.inlier_distance) == pytest.approx(inlier_distance, rel=1e-5)
    distance = cKDTree(moved).query(np.asarray(result.apply(source)))[0]
    inlier = distance <= inlier_distance
    assert float(result.fitness) == pytest.approx(inlier.mean(), abs=2e-3)
    assert float(result.rmse) == pytest.approx(np.sqrt(np.mean(distance[inlier] ** 2)), rel=1e-2, abs=1e-5)


def test_default_inlier_distance_is_one_and_a_half_spacings(plain, cloud):
    apart = cKDTree(cloud).query(cloud, k=2)[0][:, 1]
    spacing = np.sqrt(np.mean(np.minimum(apart, 3 * np.sort(apart)[len(apart) // 2]) ** 2))
    assert float(plain.inlier_distance) == pytest.approx(1.5 * spacing, rel=1e-3)


def test_inlier_distance_may_be_traced(jitted, cloud, target):
    result = jitted(cloud, target, inlier_distance=0.07)
    assert float(result.inlier_distance) == pytest.approx(0.07, rel=1e-5)


def test_same_input_gives_the_same_answer(call, cloud, target, plain):
    again = call(cloud, target)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(one, other)


_LARGE = """
    import jax, jax.numpy as jnp, numpy as np
    from urrt_jax import ModelConfig, register
    from urrt_jax.model import init_model

    model = init_model(jax.random.key(0), ModelConfig(
        regions=4, width=16, encoder_widths=(16,), branch_width=8, position_widths=(8,), decoder_widths=(16,),
        steps=1, points=64))
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1_000_000, 3))
    points *= np.array([1.0, 0.7, 0.4]) / np.linalg.norm(points, axis=1, keepdims=True)
    points[:300_000] = 0.3 * points[:300_000] + [0.8, 0.5, 0.2]
    angle = 0.05
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    result = register(points.astype(np.float32), (points @ turn.T).astype(np.float32), model=model)
    assert np.abs(np.asarray(result.rotation) - turn).max() < 1e-3, result.rotation
    assert result.fitness > 0.99, result.fitness
    # Not ru_maxrss: a child inherits that from the process that started it.
    print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak memory from Linux's /proc")
def test_two_clouds_of_a_million_points_take_less_than_three_gibibytes():
    # Without the flags of conftest.py, with which programs compile quickly and run slowly.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "-c", textwrap.dedent(_LARGE)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) * 1024 < 3 * 2**30


@pytest.mark.parametrize("radii", [10.0, 100.0, 1000.0])
def test_one_stray_point_does_not_move_the_inlier_distance(call, cloud, radii):
    stray = cloud.copy()
    stray[0] = [radii, 0.0, 0.0]
    plain, spoiled = call(cloud, cloud), call(stray, cloud)
    assert float(spoiled.inlier_distance) == pytest.approx(float(plain.inlier_distance), rel=0.1)


def test_host_batch_applies_every_transform_to_its_own_cloud(batched, cloud):
    """Three clouds of three points, where a shift along the wrong axis would go unnoticed by the shapes."""
    sources = np.stack([cloud, cloud + 1, cloud + 2])
    batch = batched(list(sources), [cloud] * 3)
    host = jax.device_get(batch)
    np.testing.assert_allclose(host.apply(sources[:, :3]), batch.apply(sources[:, :3]), atol=1e-5)
    assert host.matrix.shape == (3, 4, 4)


def test_matrix_keeps_the_digits_of_map_coordinates(small_model, cloud):
    far = np.array([5e6, 4e5, 300.0])
    result = register(cloud.astype(np.float64) + far, cloud.astype(np.float64) + far, model=small_model)
    assert result.matrix.dtype == np.float64
    np.testing.assert_allclose(result.matrix[:3, 3], result.translation, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"model": "modelnet40"}, "model"),
        ({"refine": True}, "refine"),
        ({"inlier_distance": np.ones(3)}, "inlier_distance"),
        ({"source_mask": np.arange(200)}, "source_mask"),
    ],
)
def test_options_of_the_wrong_kind_are_named(cloud, options, name):
    with pytest.raises(ValueError, match=name):
        register(cloud[:200], cloud[:200], **options)


def test_coordinates_too_large_for_float32_are_refused(small_model, cloud):
    huge = cloud.astype(np.float64)
    huge[0] = 1e39
    with pytest.raises(ValueError, match="source"):
        register(huge, cloud, model=small_model)
