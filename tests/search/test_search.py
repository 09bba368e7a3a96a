"""Search: poses of any angle at partial overlap, what the answer is invariant to, and what it does when there is none.

Almost all tests run the same compiled stages: clouds are padded to the first rung, and one configuration fixes shapes.
"""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import load_model, register, rigid, stages
from urrt_jax.assessment import agreement
from urrt_jax.clouds import make_cloud
from urrt_jax.frames import normalize_pair
from urrt_jax.model.network import estimate, propose
from urrt_jax.prepared import Sizes, coarser
from urrt_jax.refine import ICP
from urrt_jax.rigid import Known
from urrt_jax.search import Found, Search
from urrt_jax.search.search import DENSE, FINALISTS, _finalists, _refine, _scores, _similarity, search_thoroughly

_SMALL = Search(points=128, matches=16, landmarks=0, tried=16)
_SIZE = 256
_SIZES = Sizes(sample=512, queries=ICP().points, normal_radius=ICP().normal_radius)
_TOLD = stages.Told(np.bool_(False), np.zeros(3, np.float32), np.bool_(True), np.float32(0), np.float32(0))
_AXIS = np.array([0.31, -0.54, 0.78]) / np.linalg.norm([0.31, -0.54, 0.78])
_SHIFT = np.array([0.4, -0.2, 0.7])


def _turn(degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(np.deg2rad(degrees) * _AXIS).as_matrix()


def _degrees(first, second) -> float:
    turn = np.asarray(first, np.float64).T @ np.asarray(second, np.float64)
    return float(np.rad2deg(Rotation.from_matrix(turn).magnitude()))


def _pad(points: np.ndarray, rows: np.ndarray | None = None):
    """Points and mask of ``_SIZE`` rows, the points at the given ones."""
    rows = np.arange(len(points)) if rows is None else rows
    padded, mask = np.zeros((_SIZE, 3), np.float32), np.zeros(_SIZE, bool)
    padded[rows], mask[rows] = points, True
    return padded, mask


@jax.jit
def _normalized(source, target):
    return normalize_pair(make_cloud(*source), make_cloud(*target))[:2]


def _samples(source, target):
    """Samples of both clouds (points and mask) in their frame."""
    return [stages.prepare(_SIZES, cloud).samples for cloud in _normalized(source, target)]


def _plain(transform: rigid.Rigid | None = None) -> Found:
    """The pose that a search begins with, by default the identity."""
    transform = transform or rigid.identity()
    finalists = jax.tree.map(lambda leaf: jnp.stack([leaf] * FINALISTS), transform)
    return Found(transform, jnp.zeros(()), jnp.zeros(()), jnp.array(True), finalists)


@pytest.fixture(scope="module")
def find(small_model):
    """A function of two clouds (and a configuration, and a pose at hand), padded here: what the search finds."""

    def find_small(source, target, config=_SMALL, plain=None) -> Found:
        source, target = (cloud if isinstance(cloud, tuple) else _pad(cloud) for cloud in (source, target))
        return stages.search_thoroughly((config, small_model), *_samples(source, target), _plain(plain))

    return find_small


@pytest.fixture(scope="module")
def look():
    """A function of two clouds (and options of the search): what a quick look finds."""

    def look_quickly(source, target, **options) -> Found:
        config = dataclasses.replace(_SMALL, **options)
        clouds = (stages.prepare(_SIZES, cloud) for cloud in _normalized(_pad(source), _pad(target)))
        return stages._look_quickly((ICP(), config), *clouds, _plain(), _TOLD)

    return look_quickly


@pytest.fixture(scope="module")
def partial(cloud):
    """A function of degrees: two clouds that lack another quarter each, the second one turned and moved."""
    source = cloud[np.argsort(cloud[:, 0])[len(cloud) // 4 :]]
    rest = cloud[np.argsort(cloud[:, 1])[: 3 * len(cloud) // 4]]
    return lambda degrees: (source, (rest @ _turn(degrees).T + _SHIFT).astype(np.float32))


@pytest.fixture(scope="module")
def found(find, partial) -> Found:
    return find(*partial(120))


def _same(result: Found, expected: Found, atol: float = 1e-4) -> None:
    for leaf, other in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(leaf, other, atol=atol)


@pytest.mark.parametrize("degrees", [0, 60, 120, 180])
def test_finds_any_turn_at_partial_overlap(find, partial, degrees):
    assert _degrees(find(*partial(degrees)).transform.rotation, _turn(degrees)) < 3


@pytest.mark.parametrize("seed", range(4))
def test_finds_any_turn_of_another_sample_of_the_shape(find, make_cloud_points, seed):
    """No point has an exact counterpart."""
    source, rotation = make_cloud_points(1), Rotation.random(random_state=seed).as_matrix()
    target = (make_cloud_points(2) @ rotation.T + _SHIFT).astype(np.float32)
    assert _degrees(find(source, target).transform.rotation, rotation) < 12


def test_score_of_the_cloud_itself_is_one(find, cloud):
    # Both clouds are sampled alike, whatever the pose.
    assert float(find(cloud, (cloud @ _turn(100).T).astype(np.float32)).score) == pytest.approx(1, abs=1e-3)


def test_score_of_a_partial_overlap_is_between_zero_and_one(found):
    assert 0.5 < float(found.score) < 0.95


def test_score_of_another_shape_is_lower(find, cloud):
    box = np.random.default_rng(0).uniform(-1, 1, cloud.shape).astype(np.float32)
    found, samples = find(cloud, box), _samples(_pad(cloud), _pad(box))
    assert float(found.score) < 0.95
    even = tuple(each.even for each in samples)
    poses = jax.tree.map(lambda leaf: leaf[None], found.transform)
    assert float(agreement(poses, even, even, 1.5 * coarser(*samples))[0]) < 0.8


def test_swapping_the_clouds_inverts_the_transform(find, partial, found):
    back = find(*reversed(partial(120)))
    assert _degrees(rigid.inverse(back.transform).rotation, found.transform.rotation) < 3


def test_swapping_the_clouds_keeps_the_score(find, partial, found):
    back = find(*reversed(partial(120)))
    assert float(back.score) == pytest.approx(float(found.score), abs=0.03)


def test_swapping_the_clouds_keeps_the_width(find, partial, found):
    back = find(*reversed(partial(120)))
    assert float(back.width) == pytest.approx(float(found.width), rel=1e-5)


def test_turning_the_target_turns_the_answer(find, partial, found):
    source, target = partial(120)
    turn = Rotation.from_rotvec([1.0, 0.5, -2.0]).as_matrix()
    turned = find(source, (target @ turn.T).astype(np.float32))
    assert _degrees(turned.transform.rotation, turn @ np.asarray(found.transform.rotation, np.float64)) < 0.5


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_unit_does_not_matter(find, partial, found, scale):
    source, target = partial(120)
    _same(find(source * np.float32(scale), target * np.float32(scale)), found, atol=1e-3)


def test_is_the_same_every_time(find, partial, found):
    again = find(*partial(120))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True))


def test_order_of_points_does_not_matter(find, partial, found):
    rng = np.random.default_rng(0)
    _same(find(*(rng.permutation(cloud) for cloud in partial(120))), found, atol=1e-3)


def test_place_of_padding_does_not_matter(find, partial, found):
    rng = np.random.default_rng(0)
    padded = (_pad(cloud, rng.permutation(_SIZE)[: len(cloud)]) for cloud in partial(120))
    _same(find(*padded), found, atol=1e-3)


def test_padding_does_not_matter(find, partial, found):
    bare = ((cloud, np.ones(len(cloud), bool)) for cloud in partial(120))
    _same(find(*bare), found, atol=1e-3)


def test_non_finite_padding_does_not_matter(find, partial, found):
    padded = [_pad(cloud) for cloud in partial(120)]
    _same(find(*((np.where(mask[:, None], points, np.nan), mask) for points, mask in padded)), found)


def test_vmap_agrees_with_a_loop(small_model, find, partial):
    pairs = [[_pad(cloud) for cloud in partial(degrees)] for degrees in (60, 180)]
    samples = jax.tree.map(lambda *leaves: np.stack(leaves), *(_samples(*pair) for pair in pairs))
    together = jax.jit(jax.vmap(lambda s, t: search_thoroughly((_SMALL, small_model), s, t, _plain())))(*samples)
    for i, pair in enumerate(pairs):
        _same(jax.tree.map(lambda leaf, i=i: leaf[i], together), find(*pair), atol=1e-3)


def test_max_angle_excludes_a_half_turn(find, cloud):
    target = (cloud @ _turn(180).T).astype(np.float32)
    bound = dataclasses.replace(_SMALL, max_angle=90.0)
    assert _degrees(find(cloud, target, bound).transform.rotation, np.eye(3)) <= 90.01


def test_the_given_estimate_is_kept_where_every_hypothesis_turns_too_far(find, cloud):
    """With a score of 0: it was not found, but was there."""
    plain = rigid.Rigid(jnp.asarray(_turn(120), jnp.float32), jnp.array([0.1, 0.2, 0.3]))
    bound = dataclasses.replace(_SMALL, max_angle=1e-3)
    found = find(cloud, (cloud @ _turn(150).T).astype(np.float32), bound, plain)
    assert float(found.score) == 0
    jax.tree.map(lambda leaf, other: np.testing.assert_allclose(leaf, other, atol=1e-6), found.transform, plain)


def test_without_matches_the_network_alone_gives_a_rigid_answer(find, partial):
    _assert_rigid(find(*partial(60), dataclasses.replace(_SMALL, points=64, matches=0, landmarks=32)))


def test_landmarks_speak_for_a_pose_that_the_estimate_misses(make_cloud_points):
    """Another sample on either side, a third of both missing elsewhere, a turn far beyond the training's."""

    @jax.jit
    def both(source, target):
        source, target, _ = normalize_pair(make_cloud(source), make_cloud(target))
        model = load_model()
        return estimate(model, source, target).transform.rotation, propose(model, source, target, 256).rotation

    samples = make_cloud_points(1, 2), make_cloud_points(2, 2)
    crops = [sample[np.argsort(sample[:, axis])[len(sample) // 3 :]] for axis, sample in enumerate(samples)]
    estimated, proposed = both(crops[0], (crops[1] @ _turn(120).T).astype(np.float32))
    assert _degrees(estimated, _turn(120)) > 15
    assert min(_degrees(rotation, _turn(120)) for rotation in proposed) < 10


def _assert_rigid(answer: Found) -> None:
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(answer))
    np.testing.assert_allclose(answer.transform.rotation @ answer.transform.rotation.T, np.eye(3), atol=1e-4)
    assert 0 <= float(answer.score) <= 1


_LINE = np.outer(np.linspace(-1, 1, 60), _AXIS)


@pytest.mark.parametrize(
    "degenerate",
    [
        pytest.param(_LINE, id="a line"),
        pytest.param(np.ones((60, 3)), id="coincident"),
        pytest.param(np.ones((1, 3)), id="one point"),
        pytest.param(np.eye(3)[:2], id="two points"),
        pytest.param(np.eye(3), id="three points"),
        pytest.param(np.zeros((0, 3)), id="empty"),
        pytest.param(_LINE * [1, 1, 0] + np.random.default_rng(0).normal(size=(60, 3)) * [1, 1, 0], id="a plane"),
    ],
)
@pytest.mark.parametrize("against", ["itself", "a cloud"])
def test_answer_for_a_degenerate_cloud_is_rigid(find, cloud, degenerate, against):
    _assert_rigid(find(degenerate, degenerate if against == "itself" else cloud))


def test_a_stray_point_does_not_matter(find, partial):
    source, target = partial(120)
    source = np.concatenate([source, [[6, 5, -4]]]).astype(np.float32)
    assert _degrees(find(source, target).transform.rotation, _turn(120)) < 3


@pytest.mark.parametrize(("preference", "expected"), [(0.0, 70), (0.5, 20)])
def test_of_poses_that_fit_nearly_alike_the_one_that_turns_less_is_preferred(find, preference, expected):
    """A cloud of four-fold symmetry but for a few points, turned by 70 degrees: a turn by -20 degrees nearly fits."""
    random = np.random.default_rng(0)
    quarter = random.uniform([0.3, 0.1, -1], [1.0, 0.3, 1], (30, 3))  # 126 points in all: the subsample has them all
    turns = Rotation.from_rotvec(np.outer(np.arange(4) * np.pi / 2, [0, 0, 1])).as_matrix()
    few = random.uniform([0.3, 0.5, -1], [0.5, 0.7, 1], (6, 3))
    source = np.concatenate([*(quarter @ turn.T for turn in turns), few]).astype(np.float32)
    turn, other = (Rotation.from_rotvec([0, 0, np.deg2rad(angle)]).as_matrix() for angle in (70, -20))
    plain = rigid.Rigid(jnp.asarray(other, jnp.float32), jnp.zeros(3))
    config = dataclasses.replace(_SMALL, preference=preference)
    found = find(source, (source @ turn.T).astype(np.float32), config, plain)
    assert _degrees(found.transform.rotation, np.eye(3)) == pytest.approx(expected, abs=4)
    assert float(found.score) > 0.9  # what a turn costs is not taken from it


def test_finalists_are_the_best_poses_that_are_far_from_each_other():
    angles, scores = [10.0, 12.0, 100.0, 95.0, 60.0, 170.0], jnp.array([0.9, 0.8, 0.5, 0.7, 0.1, 0.6])
    turns = np.stack([_turn(angle) for angle in angles]).astype(np.float32)
    poses = rigid.Rigid(jnp.asarray(turns), jnp.zeros((6, 3)))
    found = jax.tree.map(lambda leaf: leaf[0], poses)
    np.testing.assert_array_equal(_finalists(found, poses, scores, Search()).rotation, turns[[0, 3, 5]])
    alike = jax.tree.map(lambda leaf: leaf[:2], poses)
    np.testing.assert_array_equal(_finalists(found, alike, scores[:2], Search()).rotation, turns[[0, 0, 0]])
    near = _finalists(found, poses, scores, Search(max_angle=98))  # poses that turn farther are not considered
    np.testing.assert_array_equal(near.rotation, turns[[0, 3, 4]])
    dear = _finalists(found, poses, scores, Search(preference=1.0))  # what turns cost decides at last
    np.testing.assert_array_equal(dear.rotation, turns[[0, 3, 5]])


@pytest.mark.parametrize(("dense", "least", "most"), [(True, 0.95, 1.0), (False, 0.0, 0.3)])
def test_points_of_dense_surfaces_are_alike_whichever_way_their_normals_point(dense, least, most):
    """Normals point away from the origin, so that those of the lower patch are turned around."""
    place = np.random.default_rng(0).uniform(-1, 1, (_SIZE, 2))
    bumps = 0.2 * np.sin(3 * place[:, 0]) * np.cos(2 * place[:, 1] + 1) + 0.1 * np.sin(5 * place[:, 1])
    above, below = (np.c_[place, bumps + height].astype(np.float32) for height in (2, -2))
    clouds = tuple(make_cloud(each, np.ones(_SIZE, bool)) for each in (above, below))
    samples = tuple(SimpleNamespace(thinned=each) for each in clouds)
    alike = _similarity(samples, clouds, jnp.array(0.1), Search(), jnp.array(dense))
    found = jnp.mean(jnp.argmax(alike, axis=1) == jnp.arange(_SIZE))
    assert least <= float(found) <= most


@pytest.mark.parametrize(("dense", "sizes"), [(True, 2), (False, 1)])
def test_points_of_dense_clouds_are_compared_by_neighborhoods_of_two_sizes(cloud, dense, sizes):
    """A point and itself have a similarity of one for each size."""
    one = make_cloud(*_pad(cloud))
    alike = _similarity((SimpleNamespace(thinned=one),) * 2, (one, one), jnp.array(0.2), Search(), jnp.array(dense))
    np.testing.assert_allclose(jnp.diagonal(alike)[: len(cloud)], sizes, atol=1e-4)


@pytest.mark.parametrize("groups", [1, 2, 3, 9])
def test_only_the_first_groups_of_poses_are_refined_and_scored(cloud, groups):
    """Of seven poses, three at a time; there are three groups, of which the last is not whole."""
    few = (make_cloud(*_pad(cloud)),) * 2
    turns = np.stack([_turn(4.0 + row) for row in range(7)]).astype(np.float32)
    poses = rigid.Rigid(jnp.asarray(turns), jnp.zeros((7, 3)))
    refined = jax.jit(lambda: _refine(poses, few, jnp.array(0.2), 3, groups))()
    scores = jax.jit(lambda: _scores(poses, few, jnp.array(0.2), 3 * groups))()
    there = np.arange(7) < 3 * groups
    angles = np.array([_degrees(turn, np.eye(3)) for turn in refined.rotation])
    assert refined.rotation.shape == (7, 3, 3)
    assert (angles[there] < 0.5).all()
    np.testing.assert_array_equal(refined.rotation[~there], turns[~there])
    np.testing.assert_array_equal(np.isfinite(scores), there)


@pytest.mark.parametrize(("dense", "pending"), [(DENSE, False), (100, True)])
def test_what_a_thorough_search_of_dense_clouds_finds_is_still_to_be_verified(
    small_model, cloud, monkeypatch, dense, pending
):
    monkeypatch.setattr("urrt_jax.search.search.DENSE", dense)
    samples = _samples(_pad(cloud), _pad(cloud))
    found = jax.jit(lambda: search_thoroughly((_SMALL, small_model), *samples, _plain()))()
    assert bool(found.pending) == pending


@pytest.mark.parametrize("degrees", [0, 60, 120, 180])
def test_a_quick_look_finds_any_turn_at_partial_overlap(look, partial, degrees):
    assert _degrees(look(*partial(degrees)).transform.rotation, _turn(degrees)) < 5


@pytest.mark.parametrize(("sure", "pending"), [(1e-6, False), (10.0, True)])
def test_a_quick_look_calls_for_the_thorough_search_where_it_is_not_sure(look, partial, sure, pending):
    assert bool(look(*partial(120), sure=sure).pending) == pending


@pytest.mark.parametrize(
    ("asked", "unanimous", "pending"), [(0.9, False, False), (1.1, False, True), (1.9, True, False), (2.1, True, True)]
)
def test_half_the_confidence_settles_a_quick_look_in_which_most_hypotheses_agree(asked, unanimous, pending):
    judged = stages.judge_quick_look(Search(sure=0.4 * asked), _plain(), np.bool_(unanimous), np.float32(0.4))
    assert bool(judged.pending) == pending


def test_a_quick_look_at_another_shape_is_not_sure(look, cloud):
    box = np.random.default_rng(0).uniform(-1, 1, cloud.shape).astype(np.float32)
    assert bool(look(cloud, box).pending)


def test_a_quick_look_at_samples_is_judged_by_whole_clouds(partial):
    source, target = (stages.prepare(_SIZES, cloud) for cloud in _normalized(*map(_pad, partial(120))))
    box = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    other = stages.prepare(_SIZES, _normalized(_pad(box), _pad(box))[0])._replace(samples=source.samples)
    look = lambda whole: stages._look_quickly((ICP(), _SMALL), whole, target, _plain(), _TOLD)  # noqa: E731
    assert not look(source).pending
    assert look(other).pending


@pytest.mark.parametrize(
    ("counts", "quick"), [((DENSE, DENSE), True), ((DENSE - 1, 10**6), False), ((10**6, DENSE - 1), False)]
)
def test_only_dense_clouds_are_looked_at_quickly(cloud, make_cloud_points, counts, quick):
    samples = _samples(_pad(cloud), _pad(make_cloud_points(1)))
    unknown = Known(rigid.identity(), np.bool_(False))
    plan = stages.approach((ICP(), True, 0.0), *samples, tuple(map(np.int32, counts)), unknown, rigid.identity())
    assert bool(plan.quick) == quick
    assert plan.found.pending


@pytest.mark.parametrize(
    ("degrees", "preference", "pending"), [(170, 0.0, False), (170, 0.3, True), (20, 0.3, False), (170, 0.03, False)]
)
def test_a_pose_that_fits_is_searched_only_where_its_turn_costs_much(cloud, degrees, preference, pending):
    turn = _turn(degrees)
    samples = _samples(_pad(cloud), _pad((cloud @ turn.T).astype(np.float32)))
    counts, unknown = (np.int32(len(cloud)),) * 2, Known(rigid.identity(), np.bool_(False))
    start = rigid.Rigid(np.float32(turn), np.zeros(3, np.float32))
    plan = stages.approach((ICP(), False, preference), *samples, counts, unknown, start)
    assert bool(plan.found.pending) == pending
    assert _degrees(plan.found.transform.rotation, turn) < 1


def test_clouds_of_the_same_points_are_not_searched(partial):
    samples = _samples(*(_pad(cloud) for cloud in partial(120)))
    known = stages.recognise(None, *(each.constellations for each in samples))
    plan = stages.approach((ICP(), True, 0.0), *samples, (np.int32(DENSE),) * 2, known, rigid.identity())
    assert not plan.found.pending and not plan.quick
    assert _degrees(plan.found.transform.rotation, _turn(120)) < 0.01


@pytest.mark.parametrize("preference", [-0.1, 1.5, float("nan"), "much"])
def test_a_preference_that_is_no_share_is_refused(preference):
    with pytest.raises(ValueError, match=f"^preference: expected a share from 0 to 1, got {preference!r}"):
        Search(preference=preference)


@pytest.mark.parametrize("name", ["points", "support", "tried", "kept"])
def test_too_few_are_refused_by_name(name):
    with pytest.raises(ValueError, match=f"^{name}: expected at least .*, got 0$"):
        Search(**{name: 0})


@pytest.mark.parametrize("name", ["matches", "landmarks"])
def test_negative_numbers_are_refused_by_name(name):
    with pytest.raises(ValueError, match=f"^{name}: expected at least 0, got -1"):
        Search(**{name: -1})


def test_a_search_without_hypotheses_is_refused():
    with pytest.raises(ValueError, match=r"^matches and landmarks: "):
        Search(matches=0, landmarks=0)


@pytest.mark.parametrize(
    "name", ["normal_radius", "feature_radius", "match_distance", "max_angle", "inlier_distance", "sure"]
)
@pytest.mark.parametrize("length", [0.0, -1.0, float("nan")])
def test_lengths_that_are_not_positive_are_refused_by_name(name, length):
    with pytest.raises(ValueError, match=f"^{name}: expected a positive number, got {length}"):
        Search(**{name: length})


@pytest.fixture(scope="module")
def half_turned(cloud) -> np.ndarray:
    """The cloud turned by 150 degrees and moved, with noise that hides that its points are the same."""
    noise = np.random.default_rng(8).normal(scale=0.004, size=cloud.shape)
    return (cloud @ _turn(150).T + _SHIFT + noise).astype(np.float32)


@pytest.fixture(scope="module")
def searched(small_model, cloud, half_turned):
    return register(cloud, half_turned, model=small_model, search=_SMALL)


def test_register_with_search_recovers_a_turn_by_150_degrees(searched):
    assert _degrees(searched.rotation, _turn(150)) < 1


def test_register_with_search_recovers_the_translation(searched):
    np.testing.assert_allclose(searched.translation, _SHIFT, atol=1e-3)


def test_register_with_search_converges(searched):
    assert bool(searched.converged)


@pytest.fixture(scope="module")
def unsearched(small_model, cloud, half_turned):
    return register(cloud, half_turned, model=small_model, search=None)


def test_register_without_search_does_not_recover_a_turn_by_150_degrees(unsearched):
    """Otherwise the tests of search here would test nothing."""
    assert _degrees(unsearched.rotation, _turn(150)) > 20


def test_register_with_search_still_reports_the_network_s_estimate(unsearched, searched):
    np.testing.assert_allclose(searched.coarse.rotation, unsearched.coarse.rotation, atol=1e-5)


def test_register_without_refinement_returns_the_search_s_pose(small_model, cloud, half_turned):
    alone = register(cloud, half_turned, model=small_model, search=_SMALL, refine=None)
    assert _degrees(alone.rotation, _turn(150)) < 3


def test_register_with_automatic_search_leaves_a_converged_result_alone(small_model, cloud, pose):
    target = (cloud @ pose[0].T + pose[1]).astype(np.float32)
    plain = register(cloud, target, model=small_model, search=None)
    found = register(cloud, target, model=small_model, search="auto")
    np.testing.assert_array_equal(found.matrix, plain.matrix)


@pytest.mark.parametrize("wrong", [3, True, "always", Search, {"points": 128}])
def test_register_refuses_what_is_no_search(small_model, cloud, wrong):
    with pytest.raises(ValueError, match=r"^search: expected a Search"):
        register(cloud, cloud, model=small_model, search=wrong)
