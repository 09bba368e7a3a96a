"""The Chamfer distance by hand, against SciPy and finite differences, and without an N × M matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from urrt_jax.clouds import make_cloud
from urrt_jax.losses import chamfer

_PENALTIES = ["squared", "distance", "geman_mcclure"]
_chamfer = jax.jit(chamfer, static_argnames=("penalty", "scale", "trim", "block"))
_SOURCE = np.array([[0, 0, 0], [1, 0, 0], [0, 3, 0]], np.float32)
_TARGET = np.array([[0, 0, 2], [1, 0, 2]], np.float32)


def _clouds(seed: int = 0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(40, 3)).astype(dtype), rng.normal(size=(40, 3)).astype(dtype)


def _by_hand(source, target, penalty, scale=0.1):
    def one_way(query, reference):
        distance = cKDTree(reference).query(query)[0]
        if penalty == "squared":
            return np.mean(distance**2)
        if penalty == "distance":
            return np.mean(np.sqrt(distance**2 + (scale / 100) ** 2) - scale / 100)
        return np.mean(distance**2 / (distance**2 + scale**2))

    return (one_way(source, target) + one_way(target, source)) / 2


def test_squared_chamfer_of_two_small_clouds_by_hand():
    # Source to target: 4, 4, 9 + 4; target to source: 4, 4.
    assert float(_chamfer(make_cloud(_SOURCE), make_cloud(_TARGET))) == pytest.approx((21 / 3 + 4) / 2)


def test_geman_mcclure_chamfer_of_two_points_by_hand():
    one, other = make_cloud(_SOURCE[:1]), make_cloud(_SOURCE[:1] + 3)
    found = _chamfer(one, other, penalty="geman_mcclure", scale=3.0)
    assert float(found) == pytest.approx(27 / (27 + 9))


@pytest.mark.parametrize("penalty", _PENALTIES)
def test_chamfer_agrees_with_a_kd_tree(penalty):
    source, target = _clouds()
    found = _chamfer(make_cloud(source), make_cloud(target), penalty=penalty)
    assert float(found) == pytest.approx(_by_hand(source, target, penalty), rel=1e-5)


@pytest.mark.parametrize("penalty", _PENALTIES)
@pytest.mark.parametrize("trim", [0.0, 0.3])
def test_chamfer_is_symmetric(penalty, trim):
    source, target = map(make_cloud, _clouds())
    there = _chamfer(source, target, penalty=penalty, trim=trim)
    assert float(there) == pytest.approx(float(_chamfer(target, source, penalty=penalty, trim=trim)), rel=1e-6)


@pytest.mark.parametrize("penalty", _PENALTIES)
@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_chamfer_of_identical_clouds_is_zero(penalty, offset):
    cloud = make_cloud(_clouds()[0] + np.float32(offset))
    assert float(_chamfer(cloud, cloud, penalty=penalty)) == 0


@pytest.mark.parametrize("penalty", _PENALTIES)
@pytest.mark.parametrize("trim", [0.0, 0.3])
def test_chamfer_is_unchanged_by_padding(penalty, trim):
    source, target = _clouds()
    padded = make_cloud(np.concatenate([source, np.full((17, 3), 99.0, np.float32)]), np.arange(57) < 40)
    plain = _chamfer(make_cloud(source), make_cloud(target), penalty=penalty, trim=trim)
    for pair in ((padded, make_cloud(target)), (make_cloud(target), padded)):
        assert float(_chamfer(*pair, penalty=penalty, trim=trim)) == pytest.approx(float(plain), rel=1e-6)


@pytest.mark.parametrize("block", [None, 1, 32, 1000])
def test_chamfer_does_not_depend_on_the_block(block):
    source, target = map(make_cloud, _clouds())
    assert float(_chamfer(source, target, block=block)) == pytest.approx(float(_chamfer(source, target)), rel=1e-6)


@pytest.mark.parametrize("penalty", _PENALTIES)
@pytest.mark.parametrize("trim", [0.0, 0.25])
def test_chamfer_gradient_agrees_with_finite_differences(penalty, trim, x64):
    source, target = _clouds(dtype=np.float64)
    rng = np.random.default_rng(7)
    along = rng.normal(size=source.shape), rng.normal(size=target.shape)

    @jax.jit
    @jax.value_and_grad
    def loss(step):
        moved = [make_cloud(points + step * way) for points, way in zip((source, target), along, strict=True)]
        return chamfer(*moved, penalty=penalty, scale=0.5, trim=trim)

    step = 1e-6
    difference = float(loss(step)[0] - loss(-step)[0]) / (2 * step)
    assert float(loss(0.0)[1]) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("penalty", _PENALTIES)
def test_chamfer_gradient_is_finite_for_identical_clouds(penalty):
    points = jnp.asarray(_clouds()[0])
    gradient = jax.grad(lambda p: chamfer(make_cloud(p), make_cloud(points), penalty=penalty))(points)
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_chamfer_gradient_is_zero_at_padding():
    source, target = _clouds()
    mask = np.arange(40) < 20
    gradient = jax.grad(lambda p: chamfer(make_cloud(p, mask), make_cloud(target)))(jnp.asarray(source))
    np.testing.assert_array_equal(gradient[20:], 0)


def test_trimmed_chamfer_ignores_a_cluster_without_a_counterpart():
    source, _ = _clouds()
    cluster = 50 + np.random.default_rng(1).normal(size=(8, 3)).astype(np.float32)
    target = np.concatenate([source, cluster])
    assert float(_chamfer(make_cloud(source), make_cloud(target), trim=0.25)) == 0


def test_trim_leaves_out_the_share_asked_for():
    source = np.zeros((10, 3), np.float32)
    source[:, 0] = np.arange(10)
    target = np.zeros((10, 3), np.float32)
    one_way = np.mean(np.arange(8.0) ** 2)
    found = _chamfer(make_cloud(source), make_cloud(target), trim=0.2)
    assert float(found) == pytest.approx(one_way / 2, rel=1e-6)


@pytest.mark.parametrize("distance", [0.1, 10.0, 1e6])
def test_geman_mcclure_chamfer_is_bounded_by_one(distance):
    source, target = _clouds()
    found = _chamfer(make_cloud(source), make_cloud(target + np.float32(distance)), penalty="geman_mcclure")
    assert 0 <= float(found) <= 1


@pytest.mark.parametrize("penalty", _PENALTIES)
def test_chamfer_of_an_empty_cloud_is_zero(penalty):
    source, target = _clouds()
    assert float(_chamfer(make_cloud(source, np.zeros(40, bool)), make_cloud(target), penalty=penalty)) == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        pytest.param({"penalty": "cubed"}, "^penalty: .*'cubed'", id="penalty"),
        pytest.param({"scale": 0.0}, "^scale: .*0.0", id="scale zero"),
        pytest.param({"scale": -1.0}, "^scale: .*-1.0", id="scale negative"),
        pytest.param({"scale": float("nan")}, "^scale: .*nan", id="scale nan"),
        pytest.param({"trim": 1.0}, "^trim: .*1.0", id="trim one"),
        pytest.param({"trim": -0.1}, "^trim: .*-0.1", id="trim negative"),
    ],
)
def test_chamfer_refuses_and_names_the_option(options, says):
    cloud = make_cloud(_SOURCE)
    with pytest.raises(ValueError, match=says):
        _chamfer(cloud, cloud, **options)


def test_chamfer_gradient_needs_no_matrix_of_distances():
    count = 4096
    points = jnp.zeros((count, 3))
    gradient = jax.grad(lambda p, q: chamfer(make_cloud(p), make_cloud(q)))
    memory = jax.jit(gradient).lower(points, points).compile().memory_analysis()
    assert memory.temp_size_in_bytes < count * count * 4 / 16
