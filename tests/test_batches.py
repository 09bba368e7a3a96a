"""Lists of pairs: each answer is that of ``register``, in order, compiled once, whatever is wrong with other pairs."""

import re
import threading

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import Outcome, batches, programs, register, register_pairs, stages, warm_up
from urrt_jax.programs import clear_programs

SIZES = (200, 150, 300, 180, 260, 199, 120)  # on the rungs 256 and 1,024


@pytest.fixture(scope="module")
def pairs(make_cloud_points) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Seven pairs of clouds, each of other sizes and in another pose; two on the larger rung."""
    random, sources, targets = np.random.default_rng(0), [], []
    for seed, size in enumerate(SIZES):
        cloud = make_cloud_points(seed, 2)
        turn = Rotation.from_rotvec(random.normal(size=3) * 0.1).as_matrix()
        sources.append(cloud[random.permutation(400)[:size]])
        moved = cloud[random.permutation(400)[: size - 10]] @ turn.T + random.normal(size=3)
        targets.append(moved.astype(np.float32))
    return sources, targets


@pytest.fixture(scope="module")
def call(small_model):
    """``register_pairs`` with the small model, four pairs at once."""

    def run(sources, targets, **options):
        return register_pairs(sources, targets, **({"model": small_model, "batch": 4} | options))

    return run


@pytest.fixture(scope="module")
def found(call, pairs):
    return call(*pairs)


@pytest.fixture(scope="module")
def singles(small_model, pairs):
    return [register(*pair, model=small_model) for pair in zip(*pairs, strict=True)]


def _same(result, expected):
    np.testing.assert_allclose(result.rotation, expected.rotation, atol=1e-4)
    np.testing.assert_allclose(result.translation, expected.translation, atol=1e-4)
    for name in ("fitness", "confidence", "rmse", "inlier_distance", "overlap"):
        np.testing.assert_allclose(getattr(result, name), getattr(expected, name), atol=1e-3, err_msg=name)
    assert result.reason == expected.reason


def test_every_pair_gets_the_answer_of_register_in_the_order_of_the_lists(found, singles):
    assert len(found) == len(singles)
    for result, expected in zip(found, singles, strict=True):
        _same(result, expected)


def test_results_have_an_entry_for_each_point(found, pairs, singles):
    for result, source, target, expected in zip(found, *pairs, singles, strict=True):
        assert result.correspondences.shape == result.source_regions.shape == (len(source),)
        assert result.target_regions.shape == (len(target),)
        assert np.mean(result.correspondences == expected.correspondences) > 0.98
        assert np.mean(result.source_regions == expected.source_regions) > 0.98


def test_arrays_of_all_pairs_have_a_leading_axis(found):
    count = len(SIZES)
    assert found.rotation.shape == (count, 3, 3) and found.matrix.shape == (count, 4, 4)
    assert found.translation.shape == (count, 3) and found.translation.dtype == np.float64
    assert found.fitness.shape == found.confidence.shape == found.converged.shape == (count,)
    assert all(isinstance(leaf, np.ndarray) and len(leaf) == count for leaf in jax.tree.leaves(found.results))
    np.testing.assert_array_equal(found.matrix[3], found[3].matrix)


def test_arrays_of_points_are_padded_to_the_longest_cloud(found):
    longest, shortest = max(SIZES), SIZES.index(min(SIZES))
    assert found.results.correspondences.shape == (len(SIZES), longest)
    assert np.all(found.results.correspondences[shortest, min(SIZES) :] == -1)
    assert np.all(found.results.source_regions[shortest, min(SIZES) :] == 0)


def test_some_of_the_results_are_results_too(found):
    some = found[2:4]
    assert len(some) == 2 and some.reasons == found.reasons[2:4]
    np.testing.assert_array_equal(some[-1].rotation, found[3].rotation)
    with pytest.raises(IndexError):
        found[len(SIZES)]


def test_one_pair_at_a_time_gives_the_same(call, pairs, found):
    alone = call(*pairs, batch=1)
    np.testing.assert_allclose(alone.matrix, found.matrix, atol=1e-4)


def test_clouds_may_be_lists_and_float64_and_jax_arrays(call, pairs, found):
    sources, targets = (list(each) for each in pairs)
    sources[0], sources[1], targets[1] = sources[0].tolist(), sources[1].astype(np.float64), jax.numpy.array(targets[1])
    np.testing.assert_allclose(call(sources, targets).matrix, found.matrix, atol=1e-4)


def test_a_far_origin_costs_no_digits(call, pairs, found):
    sources, targets = ([cloud.astype(np.float64) for cloud in each] for each in pairs)
    origin = np.array([4e5, 5e6, -200.0])
    moved = call([cloud + origin for cloud in sources], [cloud + origin for cloud in targets])
    for result, expected, source in zip(moved, found, sources, strict=True):
        np.testing.assert_allclose(result.apply(source + origin) - origin, expected.apply(source), atol=1e-4)


def _bad(pairs, number):
    sources, targets = (list(each) for each in pairs)
    initials = [None] * len(sources)
    if number == 0:
        sources[1] = sources[1] * np.nan
    elif number == 1:
        targets[1] = np.zeros((5, 2))
    elif number == 2:
        sources[1] = [[0.0, 0.0, 0.0], [1.0, 0.0]]
    elif number == 3:
        targets[1] = 1e30 * targets[1].astype(np.float64)
    elif number == 4:
        sources[1] = 3.0
    else:
        initials[1] = 2 * np.eye(4)
    return sources, targets, initials


@pytest.mark.parametrize(
    ("number", "says"),
    [(0, "source: 450 values are not finite"), (1, "target: expected shape"), (2, "source: .*ragged"),
     (3, "target: the points spread"), (4, "source: expected shape"), (5, "initial: expected a rotation")],
)  # fmt: skip
def test_a_bad_pair_is_reported_and_stops_no_other(call, pairs, found, number, says):
    sources, targets, initials = _bad(pairs, number)
    result = call(sources, targets, initials=initials)
    refused = result[1]
    np.testing.assert_array_equal(refused.matrix, np.eye(4))
    assert (refused.confidence, refused.converged, refused.outcome) == (0.0, False, Outcome.REFUSED)
    assert re.match(says, result.reasons[1])
    others = [0, *range(2, len(SIZES))]
    np.testing.assert_allclose(result.matrix[others], found.matrix[others], atol=1e-4)


def test_a_cloud_in_another_unit_is_asked_about_and_the_others_are_not(call, pairs, found):
    sources, targets = (list(each) for each in pairs)
    sources[1] = 1000 * sources[1]
    reasons = call(sources, targets).reasons
    assert re.search(
        r"; the source is far larger than the target, scale ratio [\d.]+: is one in millimetres\?$", reasons[1]
    )
    others = [0, *range(2, len(SIZES))]
    assert [reasons[each] for each in others] == [found.reasons[each] for each in others]


def test_lists_of_bad_pairs_alone_are_reported(call):
    result = call([np.zeros((0, 3))], [np.zeros((5, 3))])
    assert "empty" in result.reasons[0] and not result.converged[0]


def test_reasons_are_in_words(found, singles):
    assert found.reasons == [single.reason for single in singles]


def test_each_pair_may_begin_somewhere_else(call, pairs, small_model):
    sources, targets = pairs
    rough = np.eye(4)
    rough[:3, :3] = Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()
    turned = [cloud @ rough[:3, :3] for cloud in sources]
    initials = [rough, None, rough, None, rough, None, rough]
    result = call([new if each is not None else old for new, old, each in zip(turned, sources, initials, strict=True)],
                  targets, initials=initials)  # fmt: skip
    for index in (0, 1):
        source = turned[index] if initials[index] is not None else sources[index]
        _same(result[index], register(source, targets[index], model=small_model, initial=initials[index]))


def test_a_pair_that_needs_a_search_is_searched_in_its_batch(call, pairs, small_model):
    sources, targets = pairs
    turn = Rotation.from_rotvec([0.0, 3.0, 0.0]).as_matrix().astype(np.float32)
    sources = [sources[0] @ turn.T, *sources[1:]]
    result = call(sources, targets)
    _same(result[0], register(sources[0], targets[0], model=small_model))


def test_a_pair_whose_pose_is_known_is_the_same_beside_others(call, pairs, small_model):
    """The network runs for the whole batch then, and must not be asked about the known pair."""
    sources, targets = (each[:3] for each in pairs)
    turn = Rotation.from_rotvec([0.0, 1.0, 0.0]).as_matrix().astype(np.float32)
    copy = sources[0] @ turn.T
    result = call([sources[0], *sources], [copy, *targets])
    np.testing.assert_allclose(result[0].coarse.rotation, turn, atol=1e-3)
    for single, source, target in zip(result, [sources[0], *sources], [copy, *targets], strict=True):
        expected = register(source, target, model=small_model)
        _same(single, expected)
        np.testing.assert_allclose(single.coarse.rotation, expected.coarse.rotation, atol=1e-4)
        assert np.mean(single.source_regions == expected.source_regions) > 0.98


@pytest.fixture
def threads(monkeypatch) -> set[threading.Thread]:
    """In which batches are registered from now on."""
    seen, real = set(), batches._register_batch

    def watched(*arguments):
        seen.add(threading.current_thread())
        return real(*arguments)

    monkeypatch.setattr(batches, "_register_batch", watched)
    return seen


def test_batches_are_registered_side_by_side(call, pairs, found, threads):
    again = call(*(each * 4 for each in pairs))
    assert threads and threading.main_thread() not in threads
    np.testing.assert_allclose(again.matrix, np.tile(found.matrix, (4, 1, 1)), atol=1e-4)


def test_settings_of_this_thread_hold_for_all_batches(call, pairs, threads):
    with jax.default_matmul_precision("highest"):
        call(*pairs)
    assert threads == {threading.main_thread()}


def test_what_goes_wrong_in_a_batch_is_raised(call, pairs, monkeypatch):
    def broken(*_):
        raise MemoryError("no room")

    monkeypatch.setattr(batches, "_register_batch", broken)
    with pytest.raises(MemoryError, match="no room"):
        call(*(each * 4 for each in pairs))


def test_the_network_alone_runs_in_batches(call, pairs, small_model):
    result = call(*pairs, refine=None)
    expected = register(pairs[0][3], pairs[1][3], model=small_model, refine=None)
    np.testing.assert_allclose(result.matrix[3], expected.matrix, atol=1e-4)
    np.testing.assert_array_equal(result.results.steps, 0)


def test_a_second_list_on_the_same_rungs_compiles_nothing(call, pairs, found, monkeypatch):
    sources, targets = pairs
    monkeypatch.setattr(programs.Program, "_start", lambda self, *rest: pytest.fail(f"{self} was compiled"))
    order = [1, 0, 3, 5, 6, 4, 2]  # more on the smaller rung, and other sizes
    again = call([sources[i][:-2] for i in order], [targets[i][:-1] for i in order])
    assert len(again) == len(SIZES)


@pytest.mark.parametrize(
    "sources, targets, options, says",
    [
        ([], [], {}, "at least 1"),
        ([np.eye(3)], [], {}, "expected lists of one length"),
        ([np.eye(3)], [np.eye(3)], {"initials": [None, None]}, "initials"),
        ([np.eye(3)], [np.eye(3)], {"batch": 0}, "batch"),
        ([np.eye(3)], [np.eye(3)], {"batch": 2.0}, "batch"),
        ([np.eye(3)], [np.eye(3)], {"search": "always"}, "search"),
        ([np.eye(3)], [np.eye(3)], {"inlier_distance": -1.0}, "inlier_distance"),
    ],
)
def test_bad_arguments_are_named(call, sources, targets, options, says):
    with pytest.raises(ValueError, match=says):
        call(sources, targets, **options)


def test_progress_is_shown_only_on_request(call, pairs, capsys):
    call(pairs[0][:1], pairs[1][:1])
    assert capsys.readouterr().err == ""
    call(pairs[0][:1], pairs[1][:1], progress=True)
    assert "registering" in capsys.readouterr().err


def test_after_warm_up_register_compiles_nothing(pairs, small_model, capsys, monkeypatch):
    clear_programs()
    warm_up([200], model=small_model, progress=True)
    assert "compiling" in capsys.readouterr().err
    monkeypatch.setattr(programs.Program, "_start", lambda self, *rest: pytest.fail(f"{self} was compiled"))
    register(pairs[0][0], pairs[1][0], model=small_model)
    turn = Rotation.from_rotvec([0.0, 3.0, 0.0]).as_matrix().astype(np.float32)
    register(pairs[0][1] @ turn.T, pairs[1][1], model=small_model)  # with a search


def test_the_first_call_asks_for_common_stages_before_it_runs_any(pairs, small_model, monkeypatch):
    seen, real = [], stages.register_in_frame

    def watched(options, source, target, told, **flags):
        seen.append(type(source.points))
        return real(options, source, target, told, **flags)

    monkeypatch.setattr("urrt_jax.registration.register_in_frame", watched)
    monkeypatch.setattr("urrt_jax.programs._compiled_ahead", set())
    for _ in range(2):
        register(pairs[0][0], pairs[1][0], model=small_model)
    assert seen == [jax.ShapeDtypeStruct, np.ndarray, np.ndarray]


@pytest.mark.parametrize("sizes", [(), (0,), (1.5,), ("many",), 800], ids=str)
def test_warm_up_refuses_what_is_no_size(sizes):
    with pytest.raises(ValueError, match="sizes"):
        warm_up(sizes)
