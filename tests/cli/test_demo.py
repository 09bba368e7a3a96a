"""``urrt demo``: the pair that it makes up, and its picture."""

import numpy as np
import pytest

from urrt_jax import cli
from urrt_jax.cli.demo import demo_pair


def test_demo_writes_its_picture_and_says_where(files, capsys, tmp_path):
    out = tmp_path / "demo.png"
    assert cli.main(["demo", "--model", str(files["model.npz"]), "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "against the truth" in captured.out and captured.err == f"urrt: wrote {out}\n"
    assert cli.main(["demo", "--out", str(tmp_path / "nowhere" / "demo.png")]) == 2  # named before any work


def test_demo_without_matplotlib_prints_the_result_and_says_how_to_get_the_picture(
    files, capsys, tmp_path, monkeypatch
):
    monkeypatch.setattr("urrt_jax.cli.outputs.has_matplotlib", lambda: False)
    out = tmp_path / "demo.png"
    assert cli.main(["demo", "--model", str(files["model.npz"]), "--out", str(out)]) == 0
    page = tmp_path / "demo.html"
    assert cli.main(["demo", "--model", str(files["model.npz"]), "--view", str(page)]) == 0
    assert "urrt demo" in page.read_text()  # the page needs no Matplotlib
    captured = capsys.readouterr()
    assert not out.exists()
    assert "against the truth" in captured.out and "pip install 'urrt-jax[viz]'" in captured.err


def test_demo_pair_without_noise_and_cut_is_aligned_by_its_truth():
    source, target, rotation, translation = demo_pair(1, noise=0.0, keep=1.0)
    assert len(source) == len(target)
    moved = source @ rotation.T + translation
    gaps = np.linalg.norm(moved[:200, None] - target[None], axis=-1).min(axis=1)
    assert np.median(gaps) < 0.05
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_demo_pair_keeps_the_share_asked_for():
    assert len(demo_pair(0, noise=0.0, keep=0.5)[0]) == pytest.approx(1024, abs=2)


@pytest.mark.parametrize("flags", [{"keep": 0.0}, {"keep": 1.1}, {"noise": -1.0}, {"noise": np.inf}], ids=str)
def test_demo_pair_refuses_nonsense(flags):
    with pytest.raises(ValueError, match="expected"):
        demo_pair(0, **({"noise": 0.0, "keep": 1.0} | flags))
