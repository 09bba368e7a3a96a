"""Frames: entering undoes leaving, units and origins change nothing inside, and no digit is lost on the host."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.frames import Frame, normalize_on_host, normalize_pair
from urrt_jax.rigid import Rigid

_normalize = jax.jit(normalize_pair)
_leave, _enter = jax.jit(Frame.leave), jax.jit(Frame.enter)
_UTM = np.array([512_345.678, 5_403_210.987, 432.1])  # map coordinates, in metres
_STILL = Rigid(np.eye(3), np.zeros(3))


def _rigid(seed: int, size: float = 1.0, dtype: type = np.float32) -> Rigid:
    """A turn by about ``size`` radians and a move by about as many units."""
    random = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(size * random.normal(size=3)).as_matrix()
    return Rigid(turn.astype(dtype), (size * random.normal(size=3)).astype(dtype))


def _target(cloud, pose) -> np.ndarray:
    return (cloud[:150] @ pose[0].T + pose[1]).astype(np.float32)


def _frame(cloud, pose, rough: Rigid | None = None, scale: float = 1.0) -> Frame:
    source, target = (make_cloud(np.float32(scale) * each) for each in (cloud, _target(cloud, pose)))
    return _normalize(source, target, rigid.identity() if rough is None else rough)[2]


def _close(first: Rigid, second: Rigid, atol: float, length: float = 1.0) -> None:
    np.testing.assert_allclose(first.rotation, second.rotation, atol=atol)
    np.testing.assert_allclose(first.translation, second.translation, atol=atol * length)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_frame_of_a_pair_is_about_both_centroids_and_of_unit_size(cloud, pose, scale):
    scale = np.float32(scale)
    raw = make_cloud(scale * cloud), make_cloud(scale * _target(cloud, pose))
    *clouds, frame = _normalize(*raw, rigid.identity())
    for one in clouds:
        np.testing.assert_allclose(jnp.mean(one.points, 0), 0, atol=1e-6)
    squares = [float(jnp.mean(jnp.sum(one.points**2, -1))) for one in clouds]
    assert np.mean(squares) == pytest.approx(1, rel=1e-5)
    lengths = [np.mean(np.sum((np.asarray(each.points) - np.mean(each.points, 0)) ** 2, -1)) for each in raw]
    assert float(frame.scale) == pytest.approx(np.sqrt(np.mean(lengths)), rel=1e-5)


def test_both_clouds_of_a_frame_have_one_unit(cloud):
    source, target, _ = _normalize(make_cloud(cloud), make_cloud(2 * cloud), rigid.identity())
    np.testing.assert_allclose(target.points, 2 * source.points, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("size", [1e-3, 1.0, 3.0])
def test_leaving_undoes_entering(cloud, pose, scale, size):
    frame = _frame(cloud, pose, _rigid(1)._replace(translation=scale * _rigid(1).translation), scale)
    one = _rigid(2, size)._replace(translation=np.float32(scale) * _rigid(2, size).translation)
    _close(_leave(frame, _enter(frame, one)), one, 5e-6, scale)


@pytest.mark.parametrize("size", [1e-3, 1.0, 3.0])
def test_entering_undoes_leaving(cloud, pose, size):
    frame, one = _frame(cloud, pose, _rigid(1)), _rigid(2, size)
    _close(_enter(frame, _leave(frame, one)), one, 5e-6)


@pytest.mark.parametrize("rough", [False, True])
def test_leaving_moves_the_given_points_as_the_frame_s_transform_moves_its_own(cloud, pose, rough):
    source, target = make_cloud(cloud), make_cloud(_target(cloud, pose))
    inside, _, frame = _normalize(source, target, _rigid(1) if rough else rigid.identity())
    one = _rigid(2)
    expected = frame.target_center + frame.scale * rigid.apply(one, inside.points)
    np.testing.assert_allclose(rigid.apply(_leave(frame, one), source.points), expected, atol=1e-5)


def test_entering_the_rough_transform_gives_what_is_left_of_it(cloud, pose):
    """A rough transform that is the truth leaves clouds which lie on each other."""
    truth = Rigid(*(np.asarray(part, np.float32) for part in pose))
    target = make_cloud((cloud @ pose[0].T + pose[1]).astype(np.float32))
    source, target, frame = _normalize(make_cloud(cloud), target, truth)
    np.testing.assert_allclose(source.points, target.points, atol=2e-6)
    _close(_enter(frame, truth), rigid.identity(), 2e-6)
    _close(_leave(frame, rigid.identity()), truth, 2e-6)


def test_a_rough_transform_is_a_moved_source(cloud, pose):
    rough, target = _rigid(3), make_cloud(_target(cloud, pose))
    source, _, frame = _normalize(make_cloud(cloud), target, rough)
    moved, _, plain = _normalize(make_cloud(rigid.apply(rough, jnp.asarray(cloud))), target, rigid.identity())
    np.testing.assert_allclose(source.points, moved.points, atol=2e-6)
    one = _rigid(4)
    _close(_leave(frame, one), rigid.compose(_leave(plain, one), rough), 5e-6)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_changes_nothing_inside(cloud, pose, scale):
    plain, scaled = (
        _normalize(*(make_cloud(np.float32(k) * each) for each in (cloud, _target(cloud, pose))), rigid.identity())
        for k in (1.0, scale)
    )
    for one, other in zip(plain[:2], scaled[:2], strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=2e-6)
    one = _rigid(5)
    left = _leave(plain[2], one)
    _close(_leave(scaled[2], one), left._replace(translation=scale * left.translation), 5e-6, scale)


@pytest.mark.parametrize("which", [0, 1])
def test_the_origin_changes_nothing_inside(cloud, pose, which):
    offset = np.zeros((2, 3), np.float32)
    offset[which] = [8.0, -4.0, 16.0]
    raw = cloud, _target(cloud, pose)
    plain, moved = (
        _normalize(*(make_cloud(each + by) for each, by in zip(raw, k * offset, strict=True)), rigid.identity())
        for k in (0, 1)
    )
    for one, other in zip(plain[:2], moved[:2], strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-5)
    one = _rigid(6)
    there = rigid.apply(_leave(moved[2], one), jnp.asarray(cloud + offset[0])) - offset[1]
    np.testing.assert_allclose(there, rigid.apply(_leave(plain[2], one), jnp.asarray(cloud)), atol=5e-5)


def test_padding_changes_nothing(cloud, pose):
    padded = np.full((300, 3), 7.0, np.float32)
    padded[:200] = cloud
    target = make_cloud(_target(cloud, pose))
    *_, expected = _normalize(make_cloud(cloud), target, _rigid(1))
    source, _, found = _normalize(make_cloud(padded, np.arange(300) < 200), target, _rigid(1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), found, expected)
    np.testing.assert_array_equal(source.points[200:], 0)


@pytest.mark.parametrize("rough", [_STILL, _rigid(1, dtype=np.float64)], ids=["none", "rough"])
def test_the_host_agrees_with_the_trace(cloud, pose, rough):
    source, target = cloud, _target(cloud, pose)
    on_host = normalize_on_host(source, target, rough)
    traced = _normalize(make_cloud(source), make_cloud(target), Rigid(*(np.float32(part) for part in rough)))
    for one, other in zip(traced[:2], on_host[:2], strict=True):
        np.testing.assert_allclose(one.points, other, atol=2e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), traced[2], on_host[2])
    one = _rigid(2)
    _close(_leave(traced[2], one), on_host[2].leave(Rigid(*(np.float64(part) for part in one))), 5e-6)
    _close(_enter(traced[2], one), on_host[2].enter(Rigid(*(np.float64(part) for part in one))), 5e-6)


def test_the_host_keeps_the_digits_at_map_coordinates(cloud, pose):
    """float32 has steps of 0.5 m there."""
    cloud = cloud.astype(np.float64)
    truth = Rigid(pose[0], _UTM - pose[0] @ _UTM + pose[1])
    source = cloud + _UTM
    target = source @ truth.rotation.T + truth.translation
    *inside, frame = normalize_on_host(source, target, _STILL)
    plain = cloud - cloud.mean(axis=0)
    np.testing.assert_allclose(inside[0] * frame.scale, plain, atol=1e-8)
    np.testing.assert_allclose(inside[1] * frame.scale, plain @ pose[0].T, atol=1e-8)
    moved = frame.leave(Rigid(pose[0], np.zeros(3)))
    np.testing.assert_allclose(source @ moved.rotation.T + moved.translation, target, atol=1e-8)
    _close(frame.enter(truth), Rigid(pose[0], np.zeros(3)), 1e-8)


@pytest.mark.parametrize("part", ["leave", "enter"])
def test_what_is_float64_on_the_host_stays_so(cloud, part):
    *clouds, frame = normalize_on_host(cloud, cloud + 1, _rigid(1))
    found = getattr(frame, part)(_rigid(2, dtype=np.float64))
    for leaf in (*clouds, *jax.tree.leaves(frame), *found):
        assert isinstance(leaf, np.ndarray | np.float64)
        assert leaf.dtype == np.float64


def test_a_pair_without_extent_keeps_its_unit():
    points = np.full((5, 3), 3.0, np.float32)
    for frame in (
        _normalize(make_cloud(points), make_cloud(points), rigid.identity())[2],
        normalize_on_host(points, points, _STILL)[2],
    ):
        assert float(frame.scale) == 1
        np.testing.assert_array_equal(frame.source_center, points[0])


def test_a_pair_without_extent_has_a_finite_gradient():
    def total(points):
        source, target, frame = normalize_pair(make_cloud(points), make_cloud(points))
        return jnp.sum(source.points) + jnp.sum(target.points) + frame.scale

    assert bool(jnp.all(jnp.isfinite(jax.grad(total)(jnp.full((5, 3), 3.0)))))


def test_derivatives_pass_through_the_frame(cloud, pose, x64):
    """A transform that is left as it is inside still follows the clouds, whose centroids and unit it is told in."""
    points, target = jnp.asarray(cloud, x64), make_cloud(jnp.asarray(_target(cloud, pose), x64))
    inside, direction = _rigid(2, dtype=np.float64), np.random.default_rng(0).normal(size=cloud.shape)

    @jax.jit
    def at(step):
        *_, frame = normalize_pair(make_cloud(points + step * direction), target, _rigid(1, dtype=np.float64))
        return frame.leave(inside).translation

    _, slope = jax.jvp(at, (0.0,), (1.0,))
    np.testing.assert_allclose(slope, (at(1e-6) - at(-1e-6)) / 2e-6, rtol=1e-7)
