"""The page's file and what it holds; ``test_browser.py`` looks at it in a browser."""

import base64
import dataclasses
import html
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from urrt_jax.result import Outcome
from urrt_jax.viewer import save_page, show_registration

HOSTILE = '</script><script>alert(1)</script> & "quoted" {{three}} \\ \''


def content(page: str) -> dict:
    """What the page was given, with arrays in place of base64."""

    def refuse(name: str):
        raise AssertionError(f"JSON has no {name}")

    text = re.search(r'<script type="application/json" id="content">(.*?)</script>', page, re.DOTALL)[1]
    given = json.loads(text, parse_constant=refuse)
    for cloud in (given["source"], given["target"]):
        cloud["points"] = np.frombuffer(base64.b64decode(cloud["points"]), "<f4").reshape(-1, 3)
        cloud["labels"] = np.frombuffer(base64.b64decode(cloud["labels"]), np.uint8)
    for pose in given["poses"]:
        if "distances" in pose:
            pose["distances"] = np.frombuffer(base64.b64decode(pose["distances"]), np.uint8)
    return given


def test_clouds_of_other_libraries_make_the_page_of_their_points(pair, registration):
    result = registration(*pair)
    objects = [SimpleNamespace(points=pair[0]), trimesh.PointCloud(pair[1])]
    assert show_registration(*objects, result).html == show_registration(*pair, result).html


class Elements(HTMLParser):
    """Names of the elements of a page, in order, and the text of its title."""

    def __init__(self, page: str):
        super().__init__()
        self.names, self.title = [""], None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)

    def handle_data(self, data):
        if self.names[-1] == "title" and self.title is None:
            self.title = data


@pytest.fixture
def saved(tmp_path):
    """A function of (source, target, result): the text of the page that save_page writes."""

    def save(*arguments, **options) -> str:
        save_page(tmp_path / "page.html", *arguments, **options)
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    return save


def test_motion_ends_at_the_results_pose(pair, registration, matrix, saved):
    source, target = pair[0] + [3, 4, 5], pair[1] + [7, 8, 9]
    given = content(saved(source, target, registration(source, target, matrix=matrix)))
    pose = given["poses"][0]
    rotation = np.reshape(pose["matrix"], (4, 4))[:3, :3]
    shown = given["source"]["points"] @ rotation.T + pose["end"]
    true = source @ matrix[:3, :3].T + matrix[:3, 3] - target.mean(axis=0)
    np.testing.assert_allclose(shown, true, atol=1e-5)


def test_motion_starts_at_the_source(pair, registration, matrix, saved):
    given = content(saved(*pair, registration(*pair, matrix=matrix)))
    shown = given["source"]["points"] + given["start"]
    np.testing.assert_allclose(shown, pair[0] - pair[1].mean(axis=0), atol=1e-5)


def test_points_keep_their_digits_far_from_the_origin(pair, registration, saved):
    far = [cloud + 1e7 for cloud in pair]
    given = content(saved(*far, registration(*far)))
    np.testing.assert_allclose(given["target"]["points"], far[1] - far[1].mean(axis=0), atol=1e-5)


def test_source_in_a_far_frame_starts_nearer_and_ends_in_its_place(pair, registration, saved):
    far = pair[0] + [1e6, 0, 0]
    back = np.eye(4)
    back[0, 3] = -1e6
    given = content(saved(far, pair[1], registration(far, pair[1], matrix=back)))
    assert given["closer"] and np.linalg.norm(given["start"]) < 100
    np.testing.assert_allclose(given["poses"][0]["end"], pair[0].mean(axis=0) - pair[1].mean(axis=0), atol=1e-6)


def test_residuals_are_distances_to_the_nearest_of_all_target_points(pair, registration, matrix, saved):
    given = content(saved(*pair, registration(*pair, matrix=matrix)))
    true, _ = KDTree(pair[1]).query(pair[0] @ matrix[:3, :3].T + matrix[:3, 3])
    pose = given["poses"][0]
    assert pose["largest"] == pytest.approx(0.1)  # twice the inlier distance
    np.testing.assert_allclose(pose["distances"] * (0.1 / 255), np.minimum(true, 0.1), atol=0.1 / 255)


def test_other_poses_have_their_own_residuals_turn_and_weight(pair, registration, matrix, saved):
    given = content(saved(pair[1], pair[1], registration(pair[1], pair[1], others=((matrix, 0.4), (matrix, 0.001)))))
    own, other = given["poses"]
    assert (own["weight"], other["weight"]) == pytest.approx((0.6, 0.4))
    assert other["turned"] == pytest.approx(50)
    assert not own["distances"].any() and other["distances"].any()


def test_the_labels_of_points_are_their_regions(pair, registration, saved):
    result = registration(*pair)
    given = content(saved(*pair, dataclasses.replace(result, target_regions=jnp.arange(400))))
    np.testing.assert_array_equal(given["source"]["labels"], result.source_regions)
    np.testing.assert_array_equal(given["target"]["labels"], np.arange(400) % 12)


def test_large_clouds_are_thinned_to_the_same_points_every_time(pair, registration, saved):
    random = np.random.default_rng(1)
    large = random.normal(size=(200_500, 3))
    labels = np.zeros(len(large), np.int32)
    result = dataclasses.replace(registration(*pair), source_regions=labels)
    first, second = (content(saved(large, pair[1], result)) for _ in range(2))
    assert (first["source"]["count"], first["source"]["shown"]) == (200_500, 200_000)
    np.testing.assert_array_equal(first["source"]["points"], second["source"]["points"])


def test_a_page_of_large_clouds_is_a_few_megabytes(registration, saved):
    clouds = np.random.default_rng(2).normal(size=(2, 100_000, 3))
    assert len(saved(*clouds, registration(*clouds))) < 5e6


@pytest.mark.parametrize("value", [np.nan, np.inf], ids=str)
def test_numbers_that_are_not_finite_are_null(pair, registration, saved, value):
    result = dataclasses.replace(
        registration(*pair, matrix=np.full((4, 4), value), converged=False),
        **{name: jnp.array(value) for name in ("fitness", "rmse", "inlier_distance", "confidence")},
        overlap=jnp.full(2, value),
        covariance=jnp.full((6, 6), value),
    )
    given = content(saved(*pair, result))
    diagnostics = given["diagnostics"]
    assert {diagnostics[name] for name in ("fitness", "rmse", "inlier_distance", "confidence", "deviation")} == {None}
    assert diagnostics["overlap"] == [None, None]
    assert given["poses"][0]["matrix"][:12] == [None] * 12 and "end" not in given["poses"][0]


def test_points_that_are_not_finite_are_left_out(pair, registration, saved):
    holed = np.where(np.arange(500)[:, None] < 20, [np.nan, 0, np.inf], pair[0])
    given = content(saved(holed, pair[1], registration(holed, pair[1])))
    assert (given["source"]["count"], given["source"]["shown"]) == (500, 480)
    assert np.isfinite(given["source"]["points"]).all()


@pytest.mark.parametrize("which", [0, 1], ids=["source", "target"])
def test_a_cloud_without_finite_points_makes_a_page(pair, registration, saved, which):
    clouds = list(pair)
    clouds[which] = np.full((5, 3), np.nan)
    given = content(saved(*clouds, registration(*clouds)))
    assert given[("source", "target")[which]]["shown"] == 0


def test_a_title_is_text_and_nothing_else(pair, registration, saved):
    plain = saved(*pair, registration(*pair), title="plain")
    page = saved(*pair, registration(*pair), title=HOSTILE)
    assert Elements(page).names == Elements(plain).names
    assert Elements(page).title == HOSTILE and content(page)["title"] == HOSTILE


def test_the_verdict_is_the_results(pair, registration, saved):
    ambiguous = dataclasses.replace(
        registration(*pair, converged=False), outcome=jnp.array(Outcome.MISFIT), confidence=jnp.array(0.25)
    )
    diagnostics = content(saved(*pair, ambiguous))["diagnostics"]
    assert diagnostics["converged"] is False and diagnostics["confidence"] == 0.25
    assert diagnostics["reason"] == ambiguous.reason


def test_every_placeholder_is_filled(pair, registration, saved):
    assert "{{" not in re.sub(r"<script>.*?</script>", "", saved(*pair, registration(*pair)), flags=re.DOTALL)


def test_the_library_in_the_page_comes_with_its_licence(pair, registration, saved):
    assert "The MIT License Copyright © 2010-2026 three.js authors" in saved(*pair, registration(*pair))


def test_a_notebook_shows_the_saved_page_in_a_frame(pair, registration, saved):
    shown = show_registration(*pair, registration(*pair))
    frame = shown._repr_html_()
    inside = re.fullmatch(r'<iframe [^>]*? srcdoc="([^"]*)"></iframe>', frame, re.DOTALL)[1]
    assert html.unescape(inside) == shown.html == saved(*pair, registration(*pair))


def test_a_notebooks_page_prints_in_a_word(pair, registration):
    assert len(repr(show_registration(*pair, registration(*pair)))) < 40


def test_a_batch_is_refused(pair, registration, tmp_path):
    batch = dataclasses.replace(registration(*pair), rotation=jnp.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="one pair"):
        save_page(tmp_path / "page.html", *pair, batch)


def test_other_clouds_than_the_registered_ones_are_refused(pair, registration, tmp_path):
    with pytest.raises(ValueError, match=r"target: expected the \(400, 3\)"):
        save_page(tmp_path / "page.html", pair[0], pair[1][:10], registration(*pair))


def test_a_missing_folder_is_named(pair, registration, tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        save_page(tmp_path / "nowhere" / "page.html", *pair, registration(*pair))
