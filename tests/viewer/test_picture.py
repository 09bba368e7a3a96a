"""The Matplotlib figure: written without a display, repeatable, and refusing what it cannot show."""

import dataclasses
import os
import sys
from contextlib import nullcontext

import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.viewer import plot_registration, region_colors


def words(figure) -> str:
    return " ".join(text.get_text() for text in figure.texts)


def test_picture_is_written_as_png(pair, registration, tmp_path):
    plot_registration(*pair, registration(*pair), path=tmp_path / "pair.png")
    assert (tmp_path / "pair.png").read_bytes().startswith(b"\x89PNG")


def test_picture_without_an_extension_is_png(pair, registration, tmp_path):
    plot_registration(*pair, registration(*pair), path=tmp_path / "pair")
    assert (tmp_path / "pair").read_bytes().startswith(b"\x89PNG")


def test_points_that_are_not_finite_are_left_out(pair, registration):
    holed = np.where(np.arange(500)[:, None] < 20, np.nan, pair[0])
    left, _ = plot_registration(holed, pair[1], registration(holed, pair[1])).axes
    assert len(left.collections[0].get_offsets()) == 880


def test_picture_leaves_pyplot_alone(pair, registration):
    import matplotlib

    before = matplotlib.get_backend(auto_select=False)
    plot_registration(*pair, registration(*pair))
    assert matplotlib.get_backend(auto_select=False) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_picture_states_the_diagnostics_and_the_title(pair, registration):
    shown = words(plot_registration(*pair, registration(*pair), title="A pair"))
    for word in ("A pair", "before", "after", "fitness 0.750", "rmse 0.0125", "converged"):
        assert word in shown
    assert "not converged" not in shown


def test_picture_says_when_it_did_not_converge(pair, registration):
    assert "not converged" in words(plot_registration(*pair, registration(*pair, converged=False)))


def test_both_panels_have_one_scale_and_equal_axes(pair, registration):
    left, right = plot_registration(*pair, registration(*pair)).axes
    assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()
    assert left.get_aspect() == right.get_aspect() == 1.0


def test_large_clouds_are_thinned_to_the_same_points_every_time(registration):
    random = np.random.default_rng(1)
    clouds = random.normal(size=(5000, 3)), random.normal(size=(4000, 3))
    shown = [plot_registration(*clouds, registration(*clouds)).axes[0].collections[0].get_offsets() for _ in range(2)]
    assert len(shown[0]) == 6000
    np.testing.assert_array_equal(*shown)


def test_clouds_in_far_frames_are_brought_closer_and_it_is_said(pair, registration):
    far = pair[0] + [1e6, 0, 0]
    result = dataclasses.replace(registration(far, pair[1]), translation=jnp.array([-1e6, 0, 0]))
    figure = plot_registration(far, pair[1], result)
    assert "moved closer" in words(figure)
    assert np.ptp(figure.axes[0].get_xlim()) < 100


def test_a_batch_is_refused(pair, registration):
    batch = dataclasses.replace(registration(*pair), rotation=jnp.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="one pair"):
        plot_registration(*pair, batch)


def test_other_clouds_than_the_registered_ones_are_refused(pair, registration):
    with pytest.raises(ValueError, match=r"source: expected the \(500, 3\)"):
        plot_registration(pair[0][:10], pair[1], registration(*pair))


def test_a_missing_extra_is_named(pair, registration, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'urrt-jax\[viz\]'"):
        plot_registration(*pair, registration(*pair))


def test_a_picture_that_breaks_off_leaves_the_old_file(pair, registration, monkeypatch, tmp_path):
    from matplotlib.figure import Figure

    def break_off(self, file, **options):
        with open(file, "wb") if isinstance(file, (str, os.PathLike)) else nullcontext(file) as opened:
            opened.write(b"half")
        raise OSError("no space left")

    path = tmp_path / "pair.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(Figure, "savefig", break_off)
    with pytest.raises(OSError, match="no space"):
        plot_registration(*pair, registration(*pair), path=path)
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == b"old"


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
