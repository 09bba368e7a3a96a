"""Pictures of registrations: written without a display, repeatable, and refusing what they cannot show."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.result import OtherPoses, Outcome, Registration
from urrt_jax.rigid import Rigid
from urrt_jax.viewer import plot_registration, region_colors, show_registration


def registration(source: np.ndarray, target: np.ndarray, *, converged: bool = True) -> Registration:
    """A made-up result: the identity, with regions by octant."""
    octants = [((cloud > cloud.mean(axis=0)) @ [1, 2, 4]).astype(np.int32) for cloud in (source, target)]
    return Registration(
        rotation=jnp.eye(3),
        translation=jnp.zeros(3),
        fitness=jnp.array(0.75),
        rmse=jnp.array(0.0125),
        inlier_distance=jnp.array(0.05),
        overlap=jnp.array([0.75, 0.8]),
        confidence=jnp.array(0.9),
        converged=jnp.array(converged),
        outcome=jnp.array(Outcome.CONVERGED if converged else Outcome.MISFIT, jnp.int32),
        correspondences=jnp.zeros(len(source), jnp.int32),
        information=jnp.eye(6),
        covariance=jnp.eye(6),
        alternatives=OtherPoses(jnp.eye(3)[None], jnp.zeros((1, 3)), jnp.zeros(1)),
        source_regions=jnp.asarray(octants[0]),
        target_regions=jnp.asarray(octants[1]),
        coarse=Rigid(jnp.eye(3), jnp.zeros(3)),
        steps=jnp.array(3),
    )


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return random.normal(size=(500, 3)), random.normal(size=(400, 3)) * [2, 1, 1]


def words(figure) -> str:
    return " ".join(text.get_text() for text in figure.texts)


def test_picture_is_written_as_png(pair, tmp_path):
    plot_registration(*pair, registration(*pair), path=tmp_path / "pair.png")
    assert (tmp_path / "pair.png").read_bytes().startswith(b"\x89PNG")


def test_picture_leaves_pyplot_alone(pair):
    import matplotlib

    before = matplotlib.get_backend(auto_select=False)
    plot_registration(*pair, registration(*pair))
    assert matplotlib.get_backend(auto_select=False) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_picture_states_the_diagnostics_and_the_title(pair):
    shown = words(plot_registration(*pair, registration(*pair), title="A pair"))
    for word in ("A pair", "before", "after", "fitness 0.750", "rmse 0.0125", "converged"):
        assert word in shown
    assert "not converged" not in shown


def test_picture_says_when_it_did_not_converge(pair):
    assert "not converged" in words(plot_registration(*pair, registration(*pair, converged=False)))


def test_both_panels_have_one_scale_and_equal_axes(pair):
    left, right = plot_registration(*pair, registration(*pair)).axes
    assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()
    assert left.get_aspect() == right.get_aspect() == 1.0


def test_large_clouds_are_thinned_to_the_same_points_every_time():
    random = np.random.default_rng(1)
    clouds = random.normal(size=(5000, 3)), random.normal(size=(4000, 3))
    shown = [plot_registration(*clouds, registration(*clouds)).axes[0].collections[0].get_offsets() for _ in range(2)]
    assert len(shown[0]) == 6000
    np.testing.assert_array_equal(*shown)


def test_clouds_in_far_frames_are_brought_closer_and_it_is_said(pair):
    far = pair[0] + [1e6, 0, 0]
    result = dataclasses.replace(registration(far, pair[1]), translation=jnp.array([-1e6, 0, 0]))
    figure = plot_registration(far, pair[1], result)
    assert "moved closer" in words(figure)
    assert np.ptp(figure.axes[0].get_xlim()) < 100


def test_a_batch_is_refused(pair):
    batch = dataclasses.replace(registration(*pair), rotation=jnp.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="one pair"):
        plot_registration(*pair, batch)


def test_other_clouds_than_the_registered_ones_are_refused(pair):
    with pytest.raises(ValueError, match=r"source: expected the \(500, 3\)"):
        plot_registration(pair[0][:10], pair[1], registration(*pair))


@pytest.mark.parametrize(("draw", "module"), [(plot_registration, "matplotlib"), (show_registration, "plotly")])
def test_a_missing_extra_is_named(pair, monkeypatch, draw, module):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'urrt-jax\[viz\]'"):
        draw(*pair, registration(*pair))


def test_interactive_figure_shows_both_clouds_before_and_after(pair):
    figure = show_registration(*pair, registration(*pair))
    assert [trace.name for trace in figure.data] == ["target", "source", "target", "source"]
    assert figure.layout.scene.aspectmode == figure.layout.scene2.aspectmode == "data"


def test_colors_are_one_for_each_region():
    colors = region_colors(jnp.array([0, 1, 1, 11, 12]))
    assert colors.shape == (5, 3) and colors.dtype == np.uint8
    assert len(np.unique(region_colors(np.arange(12)), axis=0)) == 12
    np.testing.assert_array_equal(colors[1], colors[2])
    np.testing.assert_array_equal(colors[4], colors[0])


@pytest.mark.parametrize("labels", [np.array([0.5]), np.array([-1]), np.zeros((2, 2), int)], ids=str)
def test_labels_that_are_none_are_refused(labels):
    with pytest.raises(ValueError, match="labels"):
        region_colors(labels)
