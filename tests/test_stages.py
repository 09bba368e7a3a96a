"""The stages of a registration: what is compiled and run for which pairs, that padding changes no answer, and "auto".

All clouds have at most 256 points, the first rung of the ladder, except where rungs are what is tested.
"""

import collections
import contextlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import ICP, Registration, Search, programs, register, registration, rigid, stages
from urrt_jax.host import PairOnHost, abstract_pair
from urrt_jax.programs import Program
from urrt_jax.registration import make_options
from urrt_jax.search import Found
from urrt_jax.stages import approach, register_in_frame, rung

_COMPILED = "/jax/core/compile/backend_compile_duration"
_USUAL = {"prepare", "recognise", "estimate", "approach", "settle", "compare", "assess", "label"}
_RARE = {"search_quickly", "judge_quick_look", "search_thoroughly", "choose_finalist", "settle_thinned", "expect"}
_AXIS = np.array([0.31, -0.54, 0.78]) / np.linalg.norm([0.31, -0.54, 0.78])
_SHIFT = np.array([0.4, -0.2, 0.7])


def _turn(degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(np.deg2rad(degrees) * _AXIS).as_matrix()


def _moved(points: np.ndarray, degrees: float) -> np.ndarray:
    return (points @ _turn(degrees).T + _SHIFT).astype(np.float32)


def _degrees(first, second) -> float:
    turn = np.asarray(first, np.float64).T @ np.asarray(second, np.float64)
    return float(np.rad2deg(Rotation.from_matrix(turn).magnitude()))


@contextlib.contextmanager
def _compilations() -> Iterator[list[str]]:
    """The names of what XLA compiles (or JAX's cache on disk spares it from compiling) meanwhile."""
    names = []

    def note(event: str, _: float, **about: str | int) -> None:
        if event == _COMPILED:
            names.append(str(about.get("fun_name", "")))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


@pytest.fixture
def called(monkeypatch) -> list[str]:
    """The names of the stages that are called from now on. On abstract values none is compiled."""
    names = []

    def recorded(name: str, program: Program):
        def call(*arguments):
            names.append(name)
            if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(arguments)):
                return jax.eval_shape(program.function, *arguments)
            return program(*arguments)

        return call

    for name, program in list(vars(stages).items()):
        if isinstance(program, Program):
            monkeypatch.setattr(stages, name, recorded(name, program))
    monkeypatch.setattr(registration, "start_compiling", lambda *_: None)
    return names


@pytest.fixture(scope="module")
def call(small_model):
    """``register`` with the small model."""

    def register_small(source, target, **options) -> Registration:
        return register(source, target, **({"model": small_model} | options))

    return register_small


@pytest.fixture(scope="module")
def clean(cloud) -> tuple[np.ndarray, np.ndarray]:
    """A cloud and the same points moved, which the network and refinement align."""
    return cloud, _moved(cloud, 10)


@pytest.fixture(scope="module")
def hard(cloud) -> tuple[np.ndarray, np.ndarray]:
    """A cloud turned so far that network and refinement do not align it, with noise that hides that it is the same."""
    noise = np.random.default_rng(8).normal(scale=0.004, size=cloud.shape).astype(np.float32)
    return cloud, _moved(cloud, 150) + noise


@pytest.fixture(scope="module")
def sparse(make_cloud_points) -> tuple[np.ndarray, np.ndarray]:
    """Independent samples of one shape with noise: 250 points each, no two of which correspond."""
    rng = np.random.default_rng(0)
    source, target = (rng.permutation(make_cloud_points(seed, 2))[:250] for seed in (1, 2))
    noise = rng.normal(scale=0.02, size=(2, 250, 3)).astype(np.float32)
    return source + noise[0], _moved(target, 5) + noise[1]


@pytest.mark.parametrize(
    ("count", "size"), [(1, 256), (256, 256), (257, 1024), (1024, 1024), (1025, 4096), (40_000, 65_536)]
)
def test_rungs_are_powers_of_four(count, size):
    assert rung(count) == size


def test_a_clean_pair_runs_no_rare_stage(called, call, clean):
    assert bool(call(*clean).converged)
    assert set(called) == _USUAL


def test_where_both_clouds_hold_the_same_points_the_network_is_not_asked_for_the_pose(call, cloud):
    turned = _moved(cloud, 150)
    found = call(cloud, turned)
    assert _degrees(found.coarse.rotation, _turn(150)) < 0.1
    assert _degrees(call(cloud, turned, refine=None).coarse.rotation, _turn(150)) > 10


def test_a_sparse_noisy_pair_runs_the_third_stage_of_refinement(called, call, sparse):
    call(*sparse, search=None)
    assert set(called) == _USUAL | {"expect"}


def test_a_pair_turned_far_runs_the_search(called, call, hard):
    call(*hard)
    assert set(called) == _USUAL | {"search_thoroughly"}


def test_without_search_a_pair_turned_far_runs_none(called, call, hard):
    call(*hard, search=None)
    assert not _RARE & set(called) - {"expect"}


def test_clouds_of_the_same_points_are_found_without_a_search(called, call, cloud):
    found = call(cloud, _moved(cloud, 150), search=Search())
    assert _degrees(found.rotation, _turn(150)) < 0.01
    assert set(called) == _USUAL


def test_a_search_that_is_asked_for_runs_for_an_easy_pair_too(called, call, sparse):
    call(*sparse, search=Search())
    assert set(called) == _USUAL | {"search_thoroughly", "expect"}


def test_without_refinement_the_network_is_all_that_runs(called, call, hard):
    call(*hard, refine=None)
    assert set(called) == {"prepare", "estimate", "compare", "assess", "label"}


@pytest.fixture
def compiled(monkeypatch):
    """What would be compiled, as pairs of a program's name and the key of its compilation; nothing is."""
    keys: dict = {}

    def pretend(self, compilation, key, in_background):
        assert in_background
        keys[key] = self.name
        _, tree, signature, _ = key
        out = jax.eval_shape(
            self.function, *jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*each) for each in signature])
        )
        compilation.outputs.set_result(programs._Outputs(jax.tree.structure(out), jax.tree.leaves(out)))

    monkeypatch.setattr(programs, "_compilations", {})
    monkeypatch.setattr(programs.Program, "_start", pretend)
    return keys


_SEARCH = {"search_quickly", "judge_quick_look", "search_thoroughly", "choose_finalist"}  # of dense clouds
_LARGE = {"settle_thinned"}  # of more than 4,096 points, which nearly all pairs of such rungs have


@pytest.mark.parametrize(
    ("size", "rare", "expected"),
    [
        (256, False, _USUAL),
        (256, True, _USUAL | {"search_thoroughly", "expect"}),
        (4096, True, _USUAL | _SEARCH),
        (16_384, False, _USUAL | _LARGE),
        (16_384, True, _USUAL | _LARGE | _SEARCH),
    ],
)
def test_what_is_compiled_ahead_on_a_rung(compiled, small_model, size, rare, expected):
    register_in_frame(make_options(small_model, ICP(), "auto"), *abstract_pair(size), rare=rare)
    assert set(compiled.values()) == expected


def test_clouds_of_50_to_a_million_points_take_42_programs(compiled, small_model):
    """Seven rungs, of which four are of large clouds and two of small ones; all other stages are compiled once."""
    options = make_options(small_model, ICP(), "auto")
    for size in sorted({rung(int(count)) for count in np.geomspace(50, 1_000_000, 1000)}):
        register_in_frame(options, *abstract_pair(size), rare=True)
    on_rungs = dict.fromkeys(("prepare", "settle", "assess", "label"), 7) | {"settle_thinned": 4, "expect": 2}
    once = {"recognise", "estimate", "approach", "compare"} | _SEARCH
    assert collections.Counter(compiled.values()) == on_rungs | dict.fromkeys(once, 1)


@pytest.mark.parametrize(("size", "refined_by"), [(4096, {"settle"}), (16_384, {"settle_thinned"})])
def test_finalists_of_large_clouds_are_compared_before_the_last_refinement(compiled, small_model, size, refined_by):
    """Which takes most of the time, the more so from a wrong pose."""
    source, target, told = abstract_pair(size)
    sizes = stages.sizes_of(make_options(small_model, ICP(), "auto"))
    clouds = stages.prepare(sizes, source), stages.prepare(sizes, target)
    found = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), _found([np.eye(3)] * 3))
    stages._verified((ICP(), Search()), *clouds, found, told)
    assert set(compiled.values()) == {"prepare", "compare", "assess", "choose_finalist"} | refined_by


def test_rare_stages_are_compiled_for_the_first_pair_that_needs_them(monkeypatch, call, clean, sparse, hard):
    """As in a new process."""
    known: dict = {}
    monkeypatch.setattr(programs, "_compilations", known)
    monkeypatch.setattr(programs, "_compiled_ahead", set())
    names = lambda: {key[0].name for key in known}  # noqa: E731
    call(*clean)
    assert names() == _USUAL
    call(*sparse, search=None)
    assert names() == _USUAL | {"expect"}
    call(*hard)
    assert names() == _USUAL | {"expect", "search_thoroughly"}


def _found(turns: list[np.ndarray]) -> Found:
    """What a thorough search has found whose finalists have these turns."""
    poses = rigid.Rigid(np.stack(turns).astype(np.float32), np.zeros((len(turns), 3), np.float32))
    first = jax.tree.map(lambda leaf: leaf[0], poses)
    return Found(first, np.float32(0.9), np.float32(0.3), np.bool_(True), poses)


def _verified(source: np.ndarray, target: np.ndarray, turns: list[np.ndarray], search: Search, verify=stages._verified):
    """The finalist that is kept of two clouds of one size, centred, of those with these turns."""
    options = make_options(None, ICP(), "auto")
    *clouds, told = PairOnHost(source, target.astype(np.float32), None, None, None, None).padded(256)
    prepared = (stages.prepare(stages.sizes_of(options), each) for each in clouds)
    return verify((ICP(), search), *prepared, _found(turns), told)


@pytest.mark.parametrize("verify", [stages._verified, jax.jit(stages._verified)], ids=["arrays", "traced"])
def test_of_the_finalists_the_one_that_fits_once_refined_is_kept(cloud, verify):
    turns = [_turn(150), _turn(97), _turn(30)]  # the truth is 100°
    moved = _moved(cloud, 100) + np.random.default_rng(0).normal(scale=1e-3, size=cloud.shape)
    kept = _verified(cloud, moved, turns, Search(), verify)
    assert _degrees(kept.transform.rotation, _turn(100)) < 0.5
    assert not kept.pending


def test_a_finalist_that_turns_too_far_is_not_kept(cloud):
    turns = [_turn(30), _turn(97), _turn(150)]  # the truth is 100°
    kept = _verified(cloud, _moved(cloud, 100), turns, Search(max_angle=60))
    assert _degrees(kept.transform.rotation, np.eye(3)) < 61


@pytest.mark.parametrize(("preference", "expected"), [(0.0, 180), (0.2, 0)])
def test_of_finalists_that_fit_alike_the_one_that_turns_less_is_kept(cloud, preference, expected):
    half = Rotation.from_rotvec(np.pi * _AXIS)
    symmetric = np.concatenate([cloud[:100] - cloud[:100].mean(axis=0)] * 2)
    symmetric[100:] = half.apply(symmetric[100:])
    turns = [half.as_matrix(), np.eye(3), _turn(90)]
    kept = _verified(symmetric.astype(np.float32), symmetric, turns, Search(preference=preference))
    assert _degrees(kept.transform.rotation, _turn(expected)) < 1


@pytest.mark.parametrize(("search", "expected"), [("auto", 0.2), (Search(preference=0.1), 0.1), (None, 0.0)])
def test_the_first_pose_is_judged_by_what_turns_cost_in_the_search(monkeypatch, call, clean, search, expected):
    told = []
    monkeypatch.setattr(stages, "approach", lambda options, *rest: told.append(options[2]) or approach(options, *rest))
    monkeypatch.setattr(registration, "start_compiling", lambda *_: None)
    call(*clean, search=search)
    assert told == [expected]


def _random_pair(rng: np.random.Generator, cloud: np.ndarray) -> dict:
    """Arguments of ``register``: a pair of other sizes, as arrays of another kind, with other options."""
    kinds = [
        lambda points: points.astype(np.float32),
        lambda points: points.astype(np.float64),
        lambda points: jax.device_put(points.astype(np.float32)),  # asarray would compile
    ]
    arguments: dict = {}
    for name, points in (("source", cloud), ("target", cloud @ _turn(rng.uniform(0, 180)).T + rng.normal(size=3))):
        count = int(rng.integers(20, 200))
        points = rng.permutation(points)[:count] + rng.normal(scale=rng.choice([0.0, 0.03]), size=(count, 3))
        if rng.uniform() < 0.5:
            mask = rng.uniform(size=count + 56) < 0.9
            points = np.concatenate([points, rng.normal(size=(56, 3))])
            arguments[f"{name}_mask"] = jax.device_put(mask) if rng.uniform() < 0.5 else mask
        arguments[name] = kinds[rng.integers(3)](points)
    if rng.uniform() < 0.5:
        arguments["initial"] = np.block([[_turn(rng.uniform(0, 90)), rng.normal(size=(3, 1))], [np.eye(4)[3:]]])
    if rng.uniform() < 0.5:
        arguments["inlier_distance"] = kinds[rng.integers(3)](np.array(rng.uniform(0.01, 0.5)))
    arguments["refine"] = ICP(
        coarse_iterations=int(rng.integers(5, 40)),
        reach=float(rng.choice([rng.uniform(0.2, 0.6), 1])),
        iterations=int(rng.integers(5, 80)),
        inlier_distance=rng.uniform(0.5, 2),
        plane=rng.choice([0, 1, 0.5]),
        normal_radius=int(rng.integers(2, 5)),
        tolerance=rng.uniform(1e-5, 1e-3),
    )
    if rng.uniform() < 0.3:
        arguments["search"] = Search(max_angle=int(rng.integers(20, 180)), preference=rng.uniform(), sure=1)
    return arguments


def test_after_one_pair_of_each_kind_nothing_is_compiled_on_a_rung(call, cloud, clean, sparse, hard):
    for pair in (clean, sparse, hard):
        call(*pair)
    call(*sparse, search=None)
    rng = np.random.default_rng(0)
    with _compilations() as names:
        for _ in range(50):
            call(**_random_pair(rng, cloud))
    assert names == []


def test_the_first_pair_on_a_rung_compiles_each_usual_stage_once(monkeypatch, call, clean):
    monkeypatch.setattr(programs, "_compilations", {})
    monkeypatch.setattr(programs, "_compiled_ahead", set())
    with _compilations() as names:
        call(*clean)
    assert sorted(name.removeprefix("jit_").removeprefix("jit(").removesuffix(")") for name in names) == sorted(_USUAL)


def _padded(points: np.ndarray, rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The points in their order among ``rows`` rows, of which any may be padding, and the mask."""
    mask = np.zeros(rows, bool)
    mask[np.random.default_rng(seed).permutation(rows)[: len(points)]] = True
    values = np.full((rows, 3), 3.0, np.float32)
    values[mask] = points
    return values, mask


@pytest.mark.parametrize("rows", [256, 700, 4200])
def test_padding_of_arrays_changes_no_answer(call, sparse, rows):
    expected = call(*sparse)
    (source, source_mask), (target, target_mask) = (_padded(points, rows, k) for k, points in enumerate(sparse))
    found = call(source, target, source_mask=source_mask, target_mask=target_mask)
    for name in ("matrix", "fitness", "rmse", "overlap", "confidence", "converged", "outcome", "steps"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    np.testing.assert_array_equal(found.source_regions[source_mask], expected.source_regions)
    np.testing.assert_array_equal(found.target_regions[target_mask], expected.target_regions)


@pytest.mark.parametrize("kind", ["clean", "sparse", "hard"])
def test_a_higher_rung_changes_no_answer(request, small_model, kind):
    """The stages themselves see four times as many rows."""
    source, target = request.getfixturevalue(kind)
    options = make_options(small_model, ICP(), "auto")
    pair = PairOnHost(source, target)
    found, expected = (
        pair.restore(jax.device_get(register_in_frame(options, *pair.padded(size)))) for size in (1024, 256)
    )
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-5, err_msg=name)
    for name in ("fitness", "rmse", "overlap", "confidence", "inlier_distance"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-4, err_msg=name)
    np.testing.assert_allclose(found.information, expected.information, rtol=1e-4, atol=1e-3)
    for name in ("converged", "outcome", "correspondences", "source_regions", "target_regions"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.fixture(scope="module")
def automatic(small_model):
    """``register`` with its own search, under jit."""
    return jax.jit(lambda source, target: register(source, target, model=small_model))


def test_without_search_a_turn_by_150_degrees_is_missed(call, hard):
    """Otherwise the tests of "auto" would test nothing."""
    assert _degrees(call(*hard, search=None).rotation, _turn(150)) > 20


def test_auto_finds_a_turn_by_150_degrees(call, hard):
    result = call(*hard)
    assert _degrees(result.rotation, _turn(150)) < 0.1
    assert bool(result.converged)


@pytest.mark.parametrize("kind", ["clean", "hard"])
def test_auto_under_jit_gives_the_eager_result(request, call, automatic, kind):
    pair = request.getfixturevalue(kind)
    _check_same(automatic(*pair), call(*pair))


def test_auto_under_vmap_finds_a_turn_by_150_degrees_beside_a_pair_that_needs_no_search(call, small_model, clean, hard):
    sources, targets = (jnp.asarray(np.stack(sides)) for sides in zip(clean, hard, strict=True))
    together = jax.vmap(lambda source, target: register(source, target, model=small_model))(sources, targets)
    for row, pair in enumerate((clean, hard)):
        _check_same(jax.tree.map(lambda leaf, row=row: leaf[row], together), call(*pair))


def _check_same(found: Registration, expected: Registration) -> None:
    assert np.deg2rad(_degrees(found.rotation, expected.rotation)) < 1e-4
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-4)
    np.testing.assert_array_equal(found.correspondences, expected.correspondences)
    assert float(found.confidence) == pytest.approx(float(expected.confidence), abs=1e-3)
    assert int(found.outcome) == int(expected.outcome)
    assert (found.correspondences.shape, found.rotation.dtype) == (expected.correspondences.shape, jnp.float32)


_GRID = np.stack(np.meshgrid(*[np.linspace(-1, 1, 6)] * 3), -1).reshape(-1, 3)
_CUBE = _GRID[np.abs(_GRID).max(axis=1) > 0.99]
_ROUND = np.linspace(0, 2 * np.pi, 10, endpoint=False)
_PRISM = np.stack([np.tile(f(_ROUND), 16) for f in (np.cos, np.sin)] + [np.repeat(np.linspace(-1.5, 1.5, 16), 10)], -1)


@pytest.mark.parametrize(
    "points", [_CUBE, _CUBE * [1, 1, 2], _CUBE * [1, 1.5, 2], _PRISM], ids=["cube", "tower", "box", "prism"]
)
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_auto_does_not_turn_a_symmetric_shape_around(call, points, noise):
    """The pose that turns least stays, though others fit as well, whether or not the search looks at them."""
    rng = np.random.default_rng(0)
    source, target = points + noise * rng.normal(size=points.shape), points @ _turn(6).T
    source, target = (each.astype(np.float32) for each in (source, target + noise * rng.normal(size=points.shape)))
    # Which of the prism's ten equal poses the random network is nearest to is decided by rounding: it is told.
    initial = np.eye(4) if points is _PRISM else None
    assert _degrees(call(source, target, initial=initial).rotation, _turn(6)) < 4


def test_swapping_a_pair_that_is_searched_gives_the_inverse(call, hard):
    forth, back = call(*hard), call(*reversed(hard))
    np.testing.assert_allclose(back.matrix @ forth.matrix, np.eye(4), atol=1e-4)
