import numpy as np
import pytest
from scipy.spatial import KDTree

from urrt_jax.data import demo_shape, procedural_shapes
from urrt_jax.data.procedural import _INSIDE, _outer_surface, _Part, _template, _visible

HALF_TURNS = [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)]


@pytest.fixture(scope="module")
def shapes():
    return procedural_shapes(48, points=1024, seed=5)


def test_same_seed_gives_same_shapes(shapes):
    np.testing.assert_array_equal(procedural_shapes(6, seed=5).points, shapes.points[:6])


def test_another_seed_gives_other_shapes(shapes):
    assert np.abs(procedural_shapes(2, seed=6).points - shapes.points[:2]).max(axis=(1, 2)).min() > 0.1


def test_queries_leave_the_clouds_alone(shapes):
    np.testing.assert_array_equal(procedural_shapes(2, seed=5, queries=16).points, shapes.points[:2])


def test_number_of_points_leaves_the_form_alone(shapes):
    few = procedural_shapes(4, points=300, seed=5)
    for cloud, reference in zip(few.points, shapes.points, strict=False):
        # The frame moves a little, as it is taken from the points.
        assert KDTree(reference).query(cloud)[0].mean() < 0.06


def test_shapes_are_centred_in_the_unit_sphere(shapes):
    np.testing.assert_allclose(shapes.points.mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shapes.points, axis=2).max(axis=1), 1, atol=1e-6)


def test_families_take_turns(shapes):
    assert shapes.classes == ("blocks", "turned", "round", "mixed")
    np.testing.assert_array_equal(shapes.labels, np.arange(48) % 4)
    assert shapes.names[1] == "turned_0001"


def test_principal_moments_are_distinct(shapes):
    moments = np.linalg.eigvalsh(np.einsum("snd,sne->sde", shapes.points, shapes.points))
    assert (moments[:, 1:] / moments[:, :-1]).min() > 1.03


def test_no_half_turn_maps_a_shape_to_itself(shapes):
    for cloud, name in zip(shapes.points, shapes.names, strict=True):
        aligned = cloud @ np.linalg.eigh(cloud.T @ cloud)[1]
        one, other = aligned[:512], aligned[512:]  # in random order, so these are two samples of one surface
        noise = KDTree(one).query(other)[0].mean()
        turned = min(KDTree(one).query(other * signs)[0].mean() for signs in HALF_TURNS)
        assert turned > 1.2 * noise, name


@pytest.mark.parametrize("solid", sorted(_INSIDE))
def test_template_lies_on_the_boundary_of_its_solid(solid):
    corners = _template(solid).reshape(-1, 3)
    centres = _template(solid).mean(axis=1)
    if solid == "torus":  # not star-shaped: measured from its core circle
        ring = centres[:, :2] / np.linalg.norm(centres[:, :2], axis=1, keepdims=True) * 0.7
        middle = np.column_stack([ring, np.zeros(len(ring))])
    else:
        middle = np.broadcast_to([-0.2, 0, -0.2], centres.shape)
    assert _INSIDE[solid](middle + 0.98 * (centres - middle)).all()
    assert not _INSIDE[solid](middle + 1.02 * (centres - middle)).any()
    np.testing.assert_allclose(np.abs(corners).max(axis=0)[2], 0.3 if solid == "torus" else 1, atol=1e-9)


def test_part_under_an_affine_map_contains_what_its_map_gives():
    linear = np.array([[2.0, 1, 0], [0, 0.5, 0], [0.3, 0, 1]])
    part = _Part("ball", linear, np.array([5.0, -1, 2]))
    canonical = np.random.default_rng(0).uniform(-1, 1, size=(500, 3))
    inside = np.linalg.norm(canonical, axis=1) < 1
    np.testing.assert_array_equal(part.contains(canonical @ linear.T + part.centre), inside)


def test_covered_surface_is_dropped():
    ball, box = _Part("ball", np.eye(3), np.zeros(3)), _Part("box", 0.5 * np.eye(3), np.array([1.0, 0, 0]))
    owners, points = _visible([ball, box], 4000, np.random.default_rng(0))
    assert np.linalg.norm(points[owners == 1], axis=1).min() >= 1
    assert (np.abs(points[owners == 0] - [1, 0, 0]).max(axis=1) >= 0.5).all()


def test_outer_surface_is_area_uniform():
    # Two separate cubes with edges of 2 and 1: four fifths of the surface belong to the larger.
    cubes = [_Part("box", np.eye(3), np.zeros(3)), _Part("box", 0.5 * np.eye(3), np.array([5.0, 0, 0]))]
    points = _outer_surface(cubes, 8000, np.random.default_rng(0))
    assert np.mean(points[:, 0] < 2) == pytest.approx(0.8, abs=0.02)
    assert np.mean(points[:1000, 0] < 2) == pytest.approx(0.8, abs=0.05)  # so any prefix is a fair sample too


@pytest.fixture(scope="module")
def asked():
    return procedural_shapes(8, points=2048, seed=1, queries=1500)


def test_queries_cover_both_states(asked):
    assert asked.queries.shape == (8, 1500, 3)
    share = asked.inside.mean(axis=1)
    assert (share > 0.1).all() and (share < 0.6).all()


def test_queries_are_dense_near_the_surface(asked):
    for cloud, queries in zip(asked.points, asked.queries, strict=True):
        assert np.median(KDTree(cloud).query(queries)[0]) < 0.12  # uniform ones: 0.4 and more


def test_surface_points_separate_inside_from_outside(asked):
    # Between a query inside and one outside there is surface: near neighbours of unlike state lie close to the cloud.
    for cloud, queries, inside in zip(asked.points, asked.queries, asked.inside, strict=True):
        distance, nearest = KDTree(queries[inside]).query(queries[~inside])
        middle = (queries[~inside] + queries[inside][nearest]) / 2
        assert (KDTree(cloud).query(middle)[0] < distance / 2 + 0.15).all()


def test_demo_shape_is_the_same_each_time():
    cloud = demo_shape(500)
    assert cloud.shape == (500, 3) and cloud.dtype == np.float32
    np.testing.assert_array_equal(cloud, demo_shape(500))
    assert np.linalg.norm(cloud, axis=1).max() == pytest.approx(1)


@pytest.mark.parametrize("wrong", [{"count": 0}, {"points": 0}, {"queries": -1}, {"seed": -1}])
def test_impossible_requests_are_refused(wrong):
    with pytest.raises(ValueError, match="needs count > 0"):
        procedural_shapes(**wrong)
