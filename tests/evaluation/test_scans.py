"""Pairs of scans: which overlap, in which pose, and what is said of files that hold something else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation import evaluate, load_scan_pairs


@pytest.fixture(scope="module")
def world():
    """A wavy sheet of 20 × 10 cm, in metres."""
    rng = np.random.default_rng(0)
    plane = rng.uniform([0, 0], [0.2, 0.1], (4000, 2))
    return np.column_stack([plane, 0.01 * np.sin(40 * plane[:, 0]) + 0.02 * plane[:, 1]])


@pytest.fixture
def scans(world, tmp_path, monkeypatch):
    """Three scans: 'left' and 'middle' share two thirds of each, 'right' touches 'middle' only a little."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    poses, clouds = [], {}
    for index, (name, low, high) in enumerate((("left", 0.0, 0.12), ("middle", 0.04, 0.16), ("right", 0.15, 0.2))):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(random_state=index).as_matrix()
        pose[:3, 3] = [0.1 * index, -0.2, 0.3]
        part = world[(world[:, 0] >= low) & (world[:, 0] < high)]
        clouds[f"pts_{name}"] = (part - pose[:3, 3]) @ pose[:3, :3]
        poses.append(pose)
    path = tmp_path / "scans.npz"
    np.savez(path, names=np.array(["left", "middle", "right"]), pose_to_world=np.stack(poses), **clouds)
    return path


def test_pairs_that_overlap_come_in_both_orders(scans):
    pairs, about = load_scan_pairs(scans)
    assert [(each["source"], each["target"]) for each in about] == [("left", "middle"), ("middle", "left")]
    assert len(pairs) == 2
    assert all(0.6 < each["overlap"] < 0.75 for each in about)


def test_pairs_that_overlap_less_may_be_asked_for_alone(scans):
    _, every = load_scan_pairs(scans, least_overlap=0.01)
    _, about = load_scan_pairs(scans, least_overlap=0.01, below_overlap=0.4)
    assert {(each["source"], each["target"]) for each in about} == {("middle", "right"), ("right", "middle")}
    assert [each for each in every if each["overlap"] < 0.4] == about


def test_truth_lays_the_source_on_the_target(scans):
    (trial, back), _ = load_scan_pairs(scans)
    moved = trial.source @ trial.rotation.T + trial.translation
    shared = np.sum(np.isclose(moved[:, None, 0], trial.target[None, :, 0], atol=1e-5).any(axis=1))
    assert shared > 0.6 * len(moved)
    np.testing.assert_allclose(back.rotation, trial.rotation.T, atol=1e-9)
    assert trial.scale == pytest.approx(back.scale)


def test_overlaps_are_computed_once(scans, tmp_path, monkeypatch):
    first = load_scan_pairs(scans)[1]
    assert list((tmp_path / "cache" / "urrt_jax").glob("overlaps_*.npy"))
    monkeypatch.setattr("urrt_jax.evaluation.scans._overlaps", lambda *arguments: pytest.fail("computed again"))
    assert load_scan_pairs(scans)[1] == first


def test_scans_are_a_protocol_like_any_other(scans):
    pairs, _ = load_scan_pairs(scans)

    def truth(source, target):
        trial = next(each for each in pairs if len(each.source) == len(source) and np.allclose(each.source, source))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = trial.rotation, trial.translation
        return pose

    summary = evaluate(truth, "scans", pairs, progress=False).summary()
    assert summary["recall_2deg_0.02"] == 1.0
    assert summary["chamfer_mean"] is None  # no clean shape is known


def test_translations_are_judged_by_the_diagonal(scans):
    """A pose 5 cm off is within 0.1 of nothing here, though 0.05 < 0.1 as plain numbers."""
    pairs, _ = load_scan_pairs(scans)

    def shifted(source, target):
        trial = pairs[0] if np.allclose(pairs[0].source[0], source[0]) else pairs[1]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = trial.rotation, trial.translation + np.array([0.05, 0, 0])
        return pose

    assert evaluate(shifted, "scans", pairs, progress=False).summary()["recall_5deg_0.1"] == 0.0


@pytest.mark.parametrize("content", ["missing", "text", "other keys", "wrong poses", "no overlap"])
def test_bad_files_are_named(scans, tmp_path, content):
    path = tmp_path / "bad.npz"
    with np.load(scans) as archive:
        values = dict(archive)
    if content == "text":
        path.write_text("hello")
    elif content == "other keys":
        np.savez(path, names=values["names"])
    elif content == "wrong poses":
        np.savez(path, **(values | {"pose_to_world": np.eye(4)}))
    elif content == "no overlap":
        far = values["pose_to_world"].copy()
        far[:, 0, 3] += [0, 5, 10]
        np.savez(path, **(values | {"pose_to_world": far}))
    with pytest.raises(ValueError, match=r"bad\.npz"):
        load_scan_pairs(path)
