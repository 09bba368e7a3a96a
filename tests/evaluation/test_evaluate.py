"""Evaluation gives what single calls give, for every item once, whatever fails or stops on the way."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from urrt_jax import register, save_model
from urrt_jax.evaluation import PROTOCOLS, Ours, Poses, evaluate, find_method, load_evaluation, spread, values_path
from urrt_jax.peers import PrincipalAxes

ITEMS = np.arange(5)


@pytest.fixture(scope="module")
def clouds():
    """Five ellipsoids with a bump each: surfaces, which refinement settles on alike whatever the rounding."""
    points = np.random.default_rng(0).normal(size=(5, 300, 3))
    points *= [0.5, 0.35, 0.2] / np.linalg.norm(points, axis=2, keepdims=True)
    points[:, :90] = 0.3 * points[:, :90] + [0.4, 0.2, 0.1]
    return points.astype(np.float32)


@pytest.fixture(scope="module")
def evaluation(small_model, clouds):
    return evaluate(Ours(model=small_model), "dcp", clouds, batch=2, progress=False)


def identity(source, target):
    return np.eye(4)


def test_a_method_may_name_its_model(clouds, small_model, tmp_path):
    path = save_model(small_model, tmp_path / "mine.npz")
    named, plain = find_method(f"network:{path}"), find_method("network")
    assert named.title == "ours, network alone (mine)"
    assert named.identity() == Ours(model=small_model, refine=None).identity() != plain.identity()
    assert find_method(f"network:{path}", model="modelnet40").identity() == named.identity()
    kept = evaluate(named, "dcp", clouds, save=values_path(tmp_path, f"network:{path}", named, "dcp", clouds, ITEMS))
    assert len(kept) == len(list(tmp_path.glob("dcp-network-*.npz"))) * 5
    for wrong in ("network:nothing", "network:", "icp:modelnet40"):
        with pytest.raises(ValueError, match=r"expected one of|no packaged model"):
            find_method(wrong)


def test_every_item_is_evaluated_once_though_the_last_batch_is_short(evaluation):
    np.testing.assert_array_equal(evaluation.items, np.arange(5))
    assert evaluation.rotations.shape == (5, 3, 3)
    assert evaluation.chamfer.shape == evaluation.overlap.shape == evaluation.seconds.shape == (5,)


def test_batched_results_agree_with_single_calls(evaluation, small_model, clouds):
    trial = PROTOCOLS["dcp"](clouds, 4)
    single = register(trial.source, trial.target, model=small_model)
    np.testing.assert_allclose(evaluation.rotations[4], single.rotation, atol=1e-4)
    assert evaluation.converged[4] == float(single.converged)


def test_network_alone_is_the_same_model_without_refinement(evaluation, small_model, clouds):
    alone = evaluate(Ours(model=small_model, refine=None), "dcp", clouds, progress=False)
    trial = PROTOCOLS["dcp"](clouds, 2)
    single = register(trial.source, trial.target, model=small_model, refine=None)
    np.testing.assert_allclose(alone.rotations[2], single.rotation, atol=1e-4)
    assert alone.summary()["angle_mean"] > evaluation.summary()["angle_mean"]


def test_truth_is_the_protocols(evaluation, clouds):
    np.testing.assert_array_equal(evaluation.true_rotations[3], PROTOCOLS["dcp"](clouds, 3).rotation)


def test_chosen_items_keep_their_own_seeds(clouds):
    some = evaluate(identity, "dcp", clouds, items=np.array([3, 1]), progress=False)
    np.testing.assert_array_equal(some.true_rotations[0], PROTOCOLS["dcp"](clouds, 3).rotation)


def test_a_plain_function_can_be_evaluated(clouds):
    def true_pose(source, target):
        # Correspondences are lost, but principal axes of an asymmetric cloud are not.
        return find_method("principal_axes").function(source, target)

    found = evaluate(true_pose, "dcp", clouds, progress=False)
    assert found.method == "true_pose"
    assert found.summary()["angle_mean"] < 1e-3
    assert found.summary()["chamfer_mean"] < 1e-8
    assert found.summary()["converged"] is None


def test_a_method_that_raises_or_gives_nan_is_scored_as_identity_and_listed(clouds):
    calls = iter(range(5))

    def moody(source, target):
        call = next(calls)
        if call == 1:
            raise RuntimeError("no inliers")
        return np.full((4, 4), np.nan) if call == 3 else np.eye(4)

    found = evaluate(moody, "dcp", clouds, progress=False)
    assert len(found) == 5
    assert found.failures == {1: "RuntimeError: no inliers", 3: "values that are not finite"}
    np.testing.assert_array_equal(found.rotations[3], np.eye(3))
    assert found.summary()["failures"] == 2
    expected = evaluate(identity, "dcp", clouds, progress=False)
    np.testing.assert_array_equal(found.errors()["angle"], expected.errors()["angle"])


def test_one_bad_pair_does_not_spoil_its_batch(clouds):
    class Batched:
        title, batch = "batched", 4

        def identity(self):
            return {}

        def align(self, sources, targets):
            bad = PROTOCOLS["dcp"](clouds, 2).source
            if any(np.array_equal(source, bad) for source in sources):
                raise ValueError("bad pair")
            count = len(sources)
            return Poses(np.stack([np.eye(3)] * count), np.ones((count, 3)), np.ones(count), np.ones(count))

    found = evaluate(Batched(), "dcp", clouds, progress=False)
    assert found.failures == {2: "ValueError: bad pair"}
    np.testing.assert_array_equal(found.translations[[0, 1, 3, 4]], 1.0)
    np.testing.assert_array_equal(found.translations[2], 0.0)


def test_values_survive_the_file(evaluation, tmp_path):
    evaluation.save(tmp_path / "values.npz")
    loaded = load_evaluation(tmp_path / "values.npz")
    assert loaded.summary() == evaluation.summary()
    assert (loaded.method, loaded.protocol, loaded.failures) == (evaluation.method, "dcp", {})


def test_an_interrupted_run_continues_where_it_stopped(clouds, tmp_path):
    seen = []

    def stops(source, target):
        if len(seen) == 3:
            raise KeyboardInterrupt
        seen.append(len(source))
        return np.eye(4)

    stops.__name__, stops.__qualname__ = goes_on.__name__, goes_on.__qualname__
    save = tmp_path / "values.npz"
    with pytest.raises(KeyboardInterrupt):
        evaluate(stops, "dcp", clouds, save=save, progress=False)
    np.testing.assert_array_equal(load_evaluation(save).items, [0, 1, 2])
    found = evaluate(goes_on, "dcp", clouds, save=save, progress=False)
    np.testing.assert_array_equal(found.items, np.arange(5))
    np.testing.assert_array_equal(found.translations[:, 0], [0, 0, 0, 7, 7])
    whole = evaluate(stops, "dcp", clouds, save=save, progress=False)  # nothing is left to do, so nothing is called
    np.testing.assert_array_equal(whole.translations, found.translations)


def goes_on(source, target):
    pose = np.eye(4)
    pose[:3, 3] = 7
    return pose


def test_a_file_of_another_evaluation_is_refused(evaluation, clouds, tmp_path):
    evaluation.save(tmp_path / "values.npz")
    with pytest.raises(ValueError, match="another evaluation"):
        evaluate(identity, "dcp", clouds, save=tmp_path / "values.npz", progress=False)


def test_other_data_of_the_same_size_is_another_evaluation(clouds, tmp_path):
    evaluate(identity, "dcp", clouds, save=tmp_path / "values.npz", progress=False)
    with pytest.raises(ValueError, match="another evaluation"):
        evaluate(identity, "dcp", clouds + np.float32(1e-3), save=tmp_path / "values.npz", progress=False)


def _archive(path, **changes) -> None:
    """Changes what an evaluation's file holds; None leaves an array out."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files} | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def _described(path, **changes) -> None:
    with np.load(path) as archive:
        described = json.loads(str(archive["described"])) | changes
    _archive(path, described=json.dumps({name: value for name, value in described.items() if value != "left out"}))


def _flip_values(path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 255
    path.write_bytes(content)


_DAMAGES = {
    "no archive": lambda path: path.write_bytes(b"not an archive"),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "flipped": _flip_values,
    "an array alone": lambda path: path.write_bytes(b"\x93NUMPY\x01\x00"),
    "no rotations": lambda path: _archive(path, rotations=None),
    "rotations of fewer items": lambda path: _archive(path, rotations=np.zeros((2, 3, 3))),
    "translations of another shape": lambda path: _archive(path, translations=np.zeros((5, 4))),
    "items that are text": lambda path: _archive(path, items=np.array(list("abcde"))),
    "items without an axis": lambda path: _archive(path, items=np.array(3)),
    "scales that are text": lambda path: _archive(path, scales=np.array(list("abcde"))),
    "description that is no JSON": lambda path: _archive(path, described="{"),
    "description that is a list": lambda path: _archive(path, described="[]"),
    "description a thousand deep": lambda path: _archive(path, described="[" * 100_000),
    "no failures": lambda path: _described(path, failures="left out"),
    "failures that are nothing": lambda path: _described(path, failures=None),
    "failure of no item": lambda path: _described(path, failures={"first": "no"}),
    "no method": lambda path: _described(path, method="left out"),
    "identity that is a list": lambda path: _described(path, identity=[]),
}


@pytest.fixture(scope="module")
def whole(clouds, tmp_path_factory):
    """The file of a whole evaluation of ``identity``."""
    path = tmp_path_factory.mktemp("whole") / "values.npz"
    evaluate(identity, "dcp", clouds, save=path, progress=False)
    return path


@pytest.fixture
def kept(whole, tmp_path):
    """A copy of ``whole``, to be damaged."""
    return Path(shutil.copy(whole, tmp_path / "values.npz"))


@pytest.mark.parametrize("damage", _DAMAGES.values(), ids=_DAMAGES)
def test_a_file_that_holds_no_evaluation_is_named(kept, damage):
    damage(kept)
    with pytest.raises(ValueError, match=r"values\.npz: holds no evaluation, or is damaged"):
        load_evaluation(kept)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ValueError, match="nothing: cannot be read"):
        load_evaluation(tmp_path / "nothing")


def test_what_a_file_holds_besides_does_not_matter(kept):
    _archive(kept, more=np.zeros(3))
    _described(kept, more="said")
    assert len(load_evaluation(kept)) == 5


def test_items_of_a_damaged_file_are_evaluated_anew_and_the_file_is_kept(clouds, kept):
    kept.write_bytes(b"not an archive")
    with pytest.warns(UserWarning, match=r"all items are evaluated anew, and the file is now values\.npz\.damaged"):
        found = evaluate(identity, "dcp", clouds, save=kept, progress=False)
    assert len(found) == len(load_evaluation(kept)) == 5
    assert kept.with_name("values.npz.damaged").read_bytes() == b"not an archive"


@pytest.mark.parametrize("answer", [None, np.eye(3), [1, 2], [[1], [2, 3]], "text"], ids=str)
def test_a_function_that_gives_no_matrix_fails_with_a_sentence(clouds, answer):
    found = evaluate(lambda source, target: answer, "dcp", clouds, items=np.array([0]), progress=False)
    assert "instead of a matrix (4, 4)" in found.failures[0]


def test_a_method_that_gives_other_arrays_fails_with_a_sentence(clouds):
    class Single:
        title, batch = "single", 1

        def identity(self):
            return {}

        def align(self, sources, targets):
            return Poses(np.eye(3), np.zeros(3), np.ones(1), np.ones(1))

    found = evaluate(Single(), "dcp", clouds, items=np.array([0]), progress=False)
    assert found.failures[0].startswith("ValueError: the method gave arrays of shapes [(3, 3), (3,), (1,), (1,)]")


def test_a_function_may_give_a_matrix_as_lists(clouds):
    found = evaluate(lambda source, target: np.eye(4).tolist(), "dcp", clouds, items=np.array([0]), progress=False)
    assert not found.failures


def test_a_failure_without_a_message_has_a_reason(clouds):
    def fails(source, target):
        raise AssertionError

    found = evaluate(fails, "dcp", clouds, items=np.array([0]), progress=False)
    assert found.failures == {0: "AssertionError: without a message"}


def test_some_rows_can_be_looked_at_alone(clouds):
    def fails_on_two(source, target):
        raise RuntimeError("always")

    found = evaluate(fails_on_two, "dcp", clouds, progress=False).take(np.array([0, 2]))
    assert len(found) == 2 and set(found.failures) == {0, 2}
    assert json.dumps(found.summary())


def test_what_is_no_rotation_is_a_failure(clouds):
    matrices = iter([np.diag([1.0, 1.0, -1.0, 1.0]), 3 * np.eye(4), np.zeros((4, 4)), np.eye(4), np.eye(4)])
    found = evaluate(lambda source, target: next(matrices), "dcp", clouds, progress=False)
    assert found.failures == dict.fromkeys((0, 1, 2), "no rotation")
    assert np.isfinite(found.summary()["mae_rotation"])


def test_a_failure_is_not_converged_and_blanks_no_other_figure(clouds):
    class Sometimes:
        title, batch = "sometimes", 1

        def identity(self):
            return {}

        def align(self, sources, targets):
            if np.array_equal(sources[0], PROTOCOLS["dcp"](clouds, 0).source):
                raise ValueError("no")
            return Poses(np.eye(3)[None], np.zeros((1, 3)), np.ones(1), np.ones(1))

    summary = evaluate(Sometimes(), "dcp", clouds, progress=False).summary()
    assert (summary["converged"], summary["fitness_mean"], summary["failures"]) == (0.8, 1.0, 1)


def test_a_peer_can_be_given_itself(clouds):
    assert evaluate(PrincipalAxes(), "dcp", clouds, progress=False).summary()["angle_mean"] < 1e-3


@pytest.mark.parametrize(
    "count, limit, stride, expected",
    [(5, None, 1, [0, 1, 2, 3, 4]), (5, 2, 1, [0, 3]), (5, None, 2, [0, 2, 4]), (5, 9, 2, [0, 2, 4]), (2, 1, 1, [0])],
)
def test_items_are_spread_evenly(count, limit, stride, expected):
    np.testing.assert_array_equal(spread(count, limit, stride), expected)


@pytest.mark.parametrize("data", [([], []), "shapes", np.zeros((3, 2)), None])
def test_data_that_is_no_array_of_shapes_is_named(data):
    with pytest.raises(ValueError, match="data: expected an array"):
        evaluate("identity", "dcp", data, progress=False)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"method": "nonesuch"}, "method: expected one of network"),
        ({"method": 3}, "method: expected a name"),
        ({"protocol": "nonesuch"}, "protocol: expected one of dcp"),
        ({"items": np.array([], int)}, "items"),
        ({"items": np.array([5])}, r"indices in 0\.\.4"),
        ({"items": np.array([-1])}, r"indices in 0\.\.4"),
        ({"items": np.array([0.5])}, "items: expected whole numbers"),
        ({"items": np.array(1)}, "items: expected whole numbers"),
        ({"protocol": "scans"}, "data: expected the trials of load_scan_pairs"),
        ({"batch": 0}, "batch"),
    ],
)
def test_bad_arguments_are_named(clouds, arguments, message):
    given = {"method": "identity", "protocol": "dcp"} | arguments
    with pytest.raises(ValueError, match=message):
        evaluate(given.pop("method"), given.pop("protocol"), clouds, progress=False, **given)


def test_an_informed_method_begins_at_the_rotation_that_the_protocol_expects(clouds, small_model):
    plain = Ours(model=small_model, refine=None, batch=2)
    informed = dataclasses.replace(plain, informed=True)
    found = evaluate(informed, "dcp", clouds, items=np.array([0, 1]), progress=False)
    for row in range(2):
        trial = PROTOCOLS["dcp"](clouds, row)
        initial = np.eye(4)
        initial[:3, :3] = trial.expected
        expected = register(trial.source, trial.target, model=small_model, refine=None, initial=initial)
        np.testing.assert_allclose(found.rotations[row], expected.rotation, atol=1e-3)
    uninformed = evaluate(plain, "dcp", clouds, items=np.array([0, 1]), progress=False)
    assert np.abs(uninformed.rotations - found.rotations).max() > 1e-2


def test_what_an_informed_method_knows_is_part_of_its_identity(small_model):
    plain = Ours(model=small_model)
    assert dataclasses.replace(plain, informed=True).identity() != plain.identity()
    assert find_method("search_near").informed and not find_method("search").informed  # type: ignore[attr-defined]
