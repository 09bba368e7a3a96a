import numpy as np
import pytest
import trimesh

from urrt_jax.data import sample_occupancy, voxelize_solid
from urrt_jax.data.solid import draw_queries, grid_half_width, voxel_centres


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3)


@pytest.mark.parametrize("resolution", [16, 32, 64])
def test_hollow_sphere_is_filled(ball, resolution):
    voxel = 2 * grid_half_width(resolution) / resolution
    radius = np.linalg.norm(voxel_centres(resolution), axis=-1)
    inside = voxelize_solid(ball, resolution)
    assert inside[radius < 0.98].all()
    assert not inside[radius > 1 + voxel].any()


def test_cavity_of_a_thick_shell_is_filled_too(ball):
    # The flood comes from outside, so what it cannot reach is inside: a cavity counts as solid.
    cavity = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    cavity.invert()
    np.testing.assert_array_equal(voxelize_solid(trimesh.util.concatenate([ball, cavity])), voxelize_solid(ball))


def test_units_and_place_of_the_mesh_do_not_matter(ball):
    moved = ball.copy()
    moved.apply_scale(1000).apply_translation([0, 4096, -512])
    assert (voxelize_solid(moved) != voxelize_solid(ball)).mean() < 1e-4


def test_torus_keeps_its_hole():
    torus = trimesh.creation.torus(0.7, 0.2)
    inside = voxelize_solid(torus)
    assert not inside[32, 32, 32]
    assert inside[int(32 + 0.7 / 0.9 * 32 * 61 / 64), 32, 32]


def test_outermost_layer_is_outside():
    inside = voxelize_solid(trimesh.creation.box())  # touches the sphere with its corners
    cube = voxelize_solid(trimesh.creation.icosphere(subdivisions=4), 16)
    for grid in (inside, cube):
        assert not grid[[0, -1]].any() and not grid[:, [0, -1]].any() and not grid[:, :, [0, -1]].any()


@pytest.mark.parametrize("turn", range(6))
def test_turned_box_of_large_triangles_has_no_leak(turn):
    box = trimesh.creation.box((1.5, 0.7, 0.4))
    box.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(turn).random(3)))
    volume = voxelize_solid(box, 48).sum() * (2 * grid_half_width(48) / 48) ** 3
    radius = np.linalg.norm(box.vertices - box.bounds.mean(axis=0), axis=1).max()
    assert 1 < volume / (box.volume / radius**3) < 1.5  # thicker by about half a voxel


def test_faces_turned_the_wrong_way_do_no_harm(ball):
    faces = ball.faces.copy()
    faces[::3] = faces[::3, ::-1]
    turned = trimesh.Trimesh(ball.vertices, faces, process=False)
    np.testing.assert_array_equal(voxelize_solid(turned), voxelize_solid(ball))


def test_open_surface_is_refused(ball):
    bowl = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.3], process=False)
    with pytest.raises(ValueError, match="not closed at a resolution of 64"):
        voxelize_solid(bowl)


def test_hole_smaller_than_a_voxel_does_no_harm(ball):
    fine = ball.subdivide()
    pierced = trimesh.Trimesh(fine.vertices, fine.faces[1:], process=False)
    assert voxelize_solid(pierced, 16)[8, 8, 8]


def test_closed_plate_thinner_than_a_voxel_is_accepted():
    assert voxelize_solid(trimesh.creation.box((1, 1, 0.001))).any()


def test_vertices_stored_once_a_face_still_count_as_watertight():
    plate = trimesh.creation.box((1, 1, 0.001))
    soup = trimesh.Trimesh(plate.triangles.reshape(-1, 3), np.arange(36).reshape(12, 3), process=False)
    assert voxelize_solid(soup).any()


def test_vertices_without_a_face_do_not_shrink_the_mesh(ball):
    stray = trimesh.Trimesh(np.vstack([ball.vertices, [[100, 0, 0]]]), ball.faces, process=False)
    np.testing.assert_array_equal(voxelize_solid(stray), voxelize_solid(ball))


def test_occupancy_of_a_ball_is_right_but_for_one_voxel(ball):
    moved = ball.copy()
    moved.apply_scale(5).apply_translation([10, 0, -3])
    queries, inside = sample_occupancy(moved, 3000, seed=0)
    assert queries.shape == (3000, 3) and queries.dtype == np.float32
    radius = np.linalg.norm(queries - [10, 0, -3], axis=1) / 5
    voxel = 2 * grid_half_width(64) / 64
    assert inside[radius < 0.99].all()
    assert not inside[radius > 1 + 2 * voxel].any()


def test_occupancy_of_a_box_is_right_but_for_one_voxel():
    box = trimesh.creation.box((1, 2, 3))
    queries, inside = sample_occupancy(box, 3000, seed=0)
    depth = (np.array([0.5, 1, 1.5]) - np.abs(queries)).min(axis=1)
    voxel = 2 * grid_half_width(64) / 64 * np.linalg.norm([0.5, 1, 1.5])
    assert inside[depth > 0].all()
    assert not inside[depth < -voxel].any()


def test_samples_are_the_same_for_the_same_seed(ball):
    once, again, other = (sample_occupancy(ball, 100, seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(once, again)
    assert (once != other).any()


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_any_count_is_met(ball, count):
    queries, inside = sample_occupancy(ball, count, seed=0)
    assert queries.shape == (count, 3) and inside.shape == (count,)


@pytest.mark.parametrize("resolution", [16, 32, 64])
def test_finer_resolutions_keep_nearer_to_the_surface(ball, resolution):
    occupied = voxelize_solid(ball, resolution)
    radius = np.linalg.norm(draw_queries(occupied, 2000, np.random.default_rng(0), (resolution,)), axis=1)
    voxel = 2 * grid_half_width(resolution) / resolution
    near = np.abs(radius - 1) < 3.5 * voxel  # two voxels either way, and their diagonals
    assert near.mean() > 0.78
    assert (radius < 0.5).any() and (radius > 1.3).any()


@pytest.mark.parametrize("resolutions", [(16, 24, 64), (0, 64), (16, 32)])
def test_resolutions_that_do_not_divide_the_grid_are_refused(ball, resolutions):
    with pytest.raises(ValueError, match="must each divide the last"):
        draw_queries(voxelize_solid(ball, 64), 10, np.random.default_rng(0), resolutions)


def test_too_coarse_a_grid_is_refused(ball):
    with pytest.raises(ValueError, match="at least 8 voxels, got 4"):
        voxelize_solid(ball, 4)
