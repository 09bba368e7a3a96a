"""``urrt register`` with two files: what it prints, writes and answers to mistakes."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

import urrt_jax
from urrt_jax import io
from urrt_jax.cli.printing import as_dict, as_table
from urrt_jax.cli.register import Register
from urrt_jax.data import demo_shape
from urrt_jax.programs import clear_programs
from urrt_jax.result import Outcome

RAN = (0, 1)  # whether an untrained model converges is not what these tests are about


def test_json_is_one_object_with_exactly_the_promised_keys(register, files, capsys):
    assert register("--json") in RAN
    found = json.loads(capsys.readouterr().out)
    promised = "matrix rotation translation fitness rmse overlap confidence converged reason information"
    assert list(found) == [*promised.split(), "covariance", "alternatives"]
    matrix = np.array(found["matrix"])
    np.testing.assert_array_equal(matrix[:3, :3], found["rotation"])
    np.testing.assert_array_equal(matrix[:3, 3], found["translation"])
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    assert isinstance(found["fitness"], float) and isinstance(found["rmse"], float)
    assert isinstance(found["converged"], bool)
    assert len(found["overlap"]) == 2 and np.shape(found["information"]) == (6, 6)
    assert np.shape(found["covariance"]) == (6, 6) and isinstance(found["alternatives"], list)


@pytest.mark.parametrize("field", ["fitness", "rmse", "overlap", "confidence", "information", "covariance"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_json_has_null_for_a_number_that_is_not_finite(answer, field, value):
    whole = np.asarray(getattr(answer, field))
    first = dataclasses.replace(answer, **{field: np.where(np.arange(whole.size).reshape(whole.shape), whole, value)})
    found = json.loads(json.dumps(as_dict(first), allow_nan=False))
    expected = as_dict(answer)
    assert np.ravel(np.array(found[field], object))[0] is None
    np.testing.assert_array_equal(np.ravel(found[field])[1:], np.ravel(expected[field])[1:])
    assert {name: each for name, each in found.items() if name != field} == {
        name: each for name, each in expected.items() if name != field
    }


def test_table_shows_the_transform_and_the_diagnostics(register, files, capsys):
    assert register() in RAN
    out = capsys.readouterr().out
    measures = ("fitness", "rmse", "overlap", "confidence", "converged")
    for word in ("a.ply, 200 points", "b.xyz, 200 points", "R, turns by", *measures):
        assert word in out


def test_a_failure_is_said_with_its_reason(answer):
    failed = dataclasses.replace(answer, converged=np.array(False), outcome=np.array(Outcome.AMBIGUOUS))
    assert as_table(failed).endswith("converged    NO       " + failed.reason)
    assert as_dict(failed)["reason"] == failed.reason
    found = dataclasses.replace(answer, converged=np.array(True), outcome=np.array(Outcome.CONVERGED))
    assert as_table(found).endswith("converged    yes")


def test_a_terminal_is_told_once_that_programs_are_compiled(register, files, capsys, monkeypatch):
    clear_programs()
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    told = []
    for _ in range(2):
        assert register("--json", "--no-refine") in RAN
        told.append(capsys.readouterr().err)
    assert told[0].startswith("urrt: compiling, once for clouds of up to 256 points\n") and told[1] == ""


@pytest.mark.parametrize("extension", ["ply", "xyz", "npy"])
def test_out_holds_the_moved_source(register, files, capsys, tmp_path, extension):
    assert register("--json", "--out", str(tmp_path / f"moved.{extension}")) in RAN
    matrix = np.array(json.loads(capsys.readouterr().out)["matrix"])
    expected = io.read_cloud(files["a.ply"]) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(io.read_cloud(tmp_path / f"moved.{extension}"), expected, atol=1e-12)


def test_out_as_ply_is_coloured(register, files, capsys, tmp_path):
    assert register("--out", str(tmp_path / "moved.ply")) in RAN
    assert b"property uchar red" in (tmp_path / "moved.ply").read_bytes()


def test_map_coordinates_cost_no_digits(register, files, capsys, tmp_path):
    origins = np.array([5e5, 4e6, 100.0]), np.array([4e5, 5e6, -200.0])
    moved = []
    for offsets in ((0, 0), origins):
        for name, file, offset in zip(("a", "b"), ("a.ply", "b.xyz"), offsets, strict=True):
            io.write_cloud(tmp_path / f"{name}.ply", io.read_cloud(files[file]) + offset)
        out = tmp_path / "moved.ply"
        assert register("--out", str(out), source=tmp_path / "a.ply", target=tmp_path / "b.ply") in RAN
        moved.append(io.read_cloud(out) - offsets[1])
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-5)


def test_no_refine_gives_the_networks_own_estimate(register, files, capsys):
    assert register("--no-refine", "--json") in RAN
    found = json.loads(capsys.readouterr().out)
    clouds = [io.read_cloud(files[name]) for name in ("a.ply", "b.xyz")]
    expected = urrt_jax.register(*clouds, model=urrt_jax.load_model(files["model.npz"]), refine=None)
    np.testing.assert_allclose(found["rotation"], expected.coarse.rotation, atol=1e-5)


def test_what_json_printed_is_a_rough_transform_to_begin_with(register, files, capsys, tmp_path):
    assert register("--json", "--no-refine") in RAN
    rough = tmp_path / "rough.json"
    rough.write_text(capsys.readouterr().out)
    assert register("--json", "--initial", str(rough)) in RAN
    found = json.loads(capsys.readouterr().out)
    clouds = [io.read_cloud(files[name]) for name in ("a.ply", "b.xyz")]
    options = {"model": urrt_jax.load_model(files["model.npz"]), "search": "auto"}
    expected = urrt_jax.register(*clouds, **options, initial=np.array(json.loads(rough.read_text())["matrix"]))
    np.testing.assert_allclose(found["matrix"], expected.matrix, atol=1e-5)


def test_picture_is_a_png(register, files, capsys, tmp_path):
    assert register("--picture", str(tmp_path / "pair.png")) in RAN
    assert (tmp_path / "pair.png").read_bytes().startswith(b"\x89PNG")


def never_read(monkeypatch) -> None:
    for name in ("read_cloud", "read_point_cloud"):
        monkeypatch.setattr(f"urrt_jax.io.{name}", lambda *_, **__: pytest.fail("the clouds were read first"))


@pytest.fixture
def registered(monkeypatch, answer):
    """A function that sets what ``register`` returns, without computation: the made-up result with other fields."""

    def given(**fields) -> None:
        result = dataclasses.replace(answer, **fields)
        monkeypatch.setattr("urrt_jax.register", lambda *_, **__: result)

    return given


@pytest.mark.parametrize(("converged", "code"), [(True, 0), (False, 1)])
@pytest.mark.parametrize("flags", [[], ["--json"]], ids=["text", "json"])
def test_the_exit_code_says_whether_it_converged(register, registered, converged, code, flags):
    registered(converged=np.array(converged))
    assert register(*flags) == code


@pytest.mark.parametrize("flag, name", [("--out", "moved.ply"), ("--picture", "pair.png"), ("--view", "pair.html")])
def test_a_file_that_cannot_be_written_costs_no_result(register, registered, capsys, tmp_path, monkeypatch, flag, name):
    def fail(*_, **__):
        raise OSError(28, "No space left on device", name)

    registered(converged=np.array(True))
    for place in ("urrt_jax.io.write_cloud", "urrt_jax.cli.printing.write_picture", "urrt_jax.viewer.save_page"):
        monkeypatch.setattr(place, fail)
    assert register("--json", flag, str(tmp_path / name)) == 2
    captured = capsys.readouterr()
    assert np.shape(json.loads(captured.out)["matrix"]) == (4, 4)
    assert captured.err == f"urrt: error: {tmp_path / name} was not written: {name}: no space left on device\n"


def test_a_file_that_cannot_be_written_stops_no_other(register, registered, capsys, tmp_path, monkeypatch):
    registered()
    monkeypatch.setattr("urrt_jax.io.write_cloud", lambda *_, **__: (_ for _ in ()).throw(OSError("full")))
    assert register("--out", str(tmp_path / "moved.ply"), "--picture", str(tmp_path / "pair.png")) == 2
    assert (tmp_path / "pair.png").exists()


def test_only_results_are_on_stdout(register, registered, capsys, tmp_path):
    registered()
    out = tmp_path / "moved.ply"
    register("--json", "--out", str(out))
    captured = capsys.readouterr()
    json.loads(captured.out)
    assert captured.err == f"urrt: wrote {out}\n"


def test_out_keeps_the_sources_own_colours_and_turns_its_normals(register, registered, tmp_path, monkeypatch):
    turn, written = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), {}
    normals, colors = np.tile([1.0, 0, 0], (200, 1)), np.full((200, 3), 7, np.uint8)
    registered(rotation=turn)
    cloud = io.PointCloud(demo_shape(200).astype(np.float64), normals, colors)
    monkeypatch.setattr("urrt_jax.io.read_point_cloud", lambda *_, **__: cloud)
    monkeypatch.setattr("urrt_jax.io.write_cloud", lambda path, points, **more: written.update(more))
    register("--out", str(tmp_path / "moved.ply"))
    np.testing.assert_array_equal(written["colors"], colors)
    np.testing.assert_allclose(written["normals"], np.tile([0.0, 1, 0], (200, 1)), atol=1e-12)


def test_out_drops_what_its_format_does_not_hold(register, registered, files, tmp_path, monkeypatch):
    registered()
    points = io.read_cloud(files["a.ply"])
    cloud = io.PointCloud(points, np.ones_like(points), np.ones(points.shape, np.uint8))
    monkeypatch.setattr("urrt_jax.io.read_point_cloud", lambda *_, **__: cloud)
    assert register("--out", str(tmp_path / "moved.npy")) == 0
    assert io.read_cloud(tmp_path / "moved.npy").shape == points.shape


def test_help_names_every_readable_format():
    said = (Register.__doc__ or "").partition("Reads ")[2].partition("Both files")[0]
    assert set(io.READABLE) <= {"." + word.strip(".,") for word in said.split()}


def test_view_writes_a_page_of_what_was_registered(register, registered, files, tmp_path, monkeypatch):
    pages = []
    registered()
    monkeypatch.setattr("urrt_jax.viewer.save_page", lambda *given, title: pages.append((*given, title)))
    register("--view", str(tmp_path / "pair.html"))
    ((path, source, target, _, title),) = pages
    assert title == "a.ply → b.xyz"
    assert path == tmp_path / "pair.html"
    np.testing.assert_array_equal(source, io.read_cloud(files["a.ply"]))
    np.testing.assert_array_equal(target, io.read_cloud(files["b.xyz"]))


@pytest.mark.parametrize(
    "flags",
    [
        ["--out", "a.ply"],
        ["--out", "linked.ply"],
        ["--out", "./sub/../a.ply"],
        ["--out", "x.ply", "--initial", "x.ply"],
        ["--out", "pair.png", "--picture", "pair.png"],
        ["--picture", "pair.html", "--view", "pair.html"],
    ],
    ids=" ".join,
)
def test_no_file_of_the_command_is_overwritten_by_it(register, files, capsys, tmp_path, monkeypatch, flags):
    (tmp_path / "sub").mkdir()
    for name in ("a.ply", "x.ply"):
        (tmp_path / name).write_bytes(files["a.ply"].read_bytes())
    (tmp_path / "linked.ply").hardlink_to(tmp_path / "a.ply")
    monkeypatch.chdir(tmp_path)
    never_read(monkeypatch)
    assert register(*flags, source=Path("a.ply")) == 2
    assert "choose another name" in capsys.readouterr().err


@pytest.mark.parametrize(
    "flags",
    [
        ["--out", "moved.abc"],
        ["--picture", "pair.abc"],
        ["--view", "pair.abc"],
        ["--out", "folder.ply"],
        ["--view", "pipe.html"],
    ],
    ids=" ".join,
)
def test_a_file_of_no_known_kind_is_refused_before_any_work(register, capsys, tmp_path, monkeypatch, flags):
    (tmp_path / "folder.ply").mkdir()
    os.mkfifo(tmp_path / "pipe.html")
    monkeypatch.chdir(tmp_path)
    never_read(monkeypatch)
    assert register(*flags) == 2
    assert flags[1] in capsys.readouterr().err


def test_a_search_without_refinement_is_refused_not_dropped(register, capsys):
    assert register("--no-refine", "--search", "always") == 2
    assert "--no-refine: keeps the network's own estimate" in capsys.readouterr().err


def test_a_folder_in_the_place_of_the_target_is_called_one(register, capsys, tmp_path):
    assert register(target=tmp_path) == 2
    assert f"{tmp_path} is a folder, a file was expected" in capsys.readouterr().err


def test_a_picture_without_matplotlib_is_refused_before_any_work(register, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("urrt_jax.cli.outputs.has_matplotlib", lambda: False)
    never_read(monkeypatch)
    assert register("--picture", str(tmp_path / "pair.png")) == 2
    assert "pip install 'urrt-jax[viz]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "flags"),
    [
        ({"source": Path("missing.ply")}, []),
        ({}, ["--model", "no-such-model"]),
        ({}, ["--out", "moved.docx"]),
        ({}, ["--inlier-distance", "-1"]),
        ({}, ["--out", "no-such-folder/moved.ply"]),
        ({}, ["--initial", "missing.txt"]),
    ],
    ids=["missing file", "unknown model", "unknown extension", "negative distance", "missing folder", "no transform"],
)
def test_a_mistake_is_one_line_on_stderr(register, files, capsys, tmp_path, monkeypatch, change, flags):
    monkeypatch.chdir(tmp_path)
    assert register("--json", *flags, **change) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("urrt: error: ") and captured.err.count("\n") == 1


def test_a_missing_folder_for_the_output_is_named_before_any_work(register, files, capsys, tmp_path, monkeypatch):
    never_read(monkeypatch)
    assert register("--out", str(tmp_path / "nowhere" / "moved.ply")) == 2
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.parametrize("samples", ["0", "-1", "10000001", "1000000000000"])
def test_samples_out_of_range_are_named_before_any_work(register, files, capsys, monkeypatch, samples):
    never_read(monkeypatch)
    assert register("--samples", samples) == 2
    error = capsys.readouterr().err
    assert error == f"urrt: error: --samples: expected a whole number from 1 to 10,000,000, got {samples}\n"
