"""``urrt register`` with many pairs: tables, folders, results, and how a run goes on. Nothing is computed."""

import csv
import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

from urrt_jax import cli, io
from urrt_jax.cli import many
from urrt_jax.result import Outcome


class Found(list):
    """Stands for ``Registrations``: a sequence of results, with reasons."""

    reasons: list[str]


@pytest.fixture
def calls(monkeypatch, answer) -> list[dict]:
    """The calls of ``register_pairs``, which answers with one result whatever the clouds; a target at x > 9 fails."""
    calls = []

    def register_pairs(sources, targets, **options):
        calls.append(options | {"sources": sources, "targets": targets})
        found = Found()
        for target in targets:
            wrong = bool(target[0, 0] > 9)
            outcome = Outcome.AMBIGUOUS if wrong else Outcome.CONVERGED
            found.append(dataclasses.replace(answer, converged=np.array(not wrong), outcome=np.array(outcome)))
        found.reasons = [str(each.reason) for each in found]
        return found

    monkeypatch.setattr(many, "register_pairs", register_pairs)
    return calls


@pytest.fixture
def scans(tmp_path, monkeypatch) -> Path:
    """The working folder: scans/ with three clouds and other things, the target model.ply, and far.ply."""
    monkeypatch.chdir(tmp_path)
    cloud = np.random.default_rng(0).normal(size=(100, 3))
    (tmp_path / "scans").mkdir()
    for name in ("scans/a.ply", "scans/b.xyz", "scans/c.npy", "scans/.hidden.ply", "model.ply"):
        io.write_cloud(tmp_path / name, cloud)
    io.write_cloud(tmp_path / "far.ply", cloud + 20)
    for name in ("notes.txt", "notes.md"):
        (tmp_path / "scans" / name).write_text("none of ours")
    return tmp_path


def run(files, *arguments: str) -> int:
    return cli.main(["register", *arguments, "--model", str(files["model.npz"])])


def table(text: str) -> str:
    Path("pairs.csv").write_text(text)
    return "pairs.csv"


def rows(path: str = "results.csv") -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def folder_run(files, *more: str) -> int:
    return run(files, "scans", "--to", "model.ply", "--out", "results.csv", *more)


def test_a_folder_gives_a_row_for_every_readable_file_in_order(files, scans, calls):
    assert folder_run(files) == 0
    assert [row["source"] for row in rows()] == ["scans/a.ply", "scans/b.xyz", "scans/c.npy"]
    assert {row["target"] for row in rows()} == {"model.ply"}


def test_text_files_that_may_be_no_clouds_are_left_out_of_a_folder_and_counted(files, scans, calls, capsys):
    folder_run(files)
    assert "left out, because they may be no clouds: 1 .txt or .csv" in capsys.readouterr().err


def test_a_folder_of_text_files_alone_is_registered(files, scans, calls):
    (scans / "texts").mkdir()
    for name in ("one.csv", "two.txt"):
        io.write_cloud(scans / "texts" / name, np.random.default_rng(0).normal(size=(100, 3)))
    assert run(files, "texts", "--to", "model.ply", "--out", "results.csv") == 0
    assert [row["source"] for row in rows()] == ["texts/one.csv", "texts/two.txt"]


def test_the_target_is_none_of_the_sources(files, scans, calls):
    assert run(files, "scans", "--to", "scans/b.xyz", "--out", "results.csv") == 0
    assert [row["source"] for row in rows()] == ["scans/a.ply", "scans/c.npy"]


def test_the_results_are_none_of_the_sources(files, scans, calls, monkeypatch):
    monkeypatch.setattr(many, "READABLE", (*many.READABLE, ".csv"))
    for _ in range(2):
        assert run(files, "scans", "--to", "model.ply", "--out", "scans/results.csv") == 0
    assert [row["source"][-5:] for row in rows("scans/results.csv")] == ["a.ply", "b.xyz", "c.npy"]


def test_paths_of_a_table_are_relative_to_its_folder(files, scans, calls, monkeypatch):
    table(f"source,target\nscans/a.ply,model.ply\n{scans}/scans/c.npy,model.ply\n")
    (scans / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert run(files, "--pairs", "../pairs.csv", "--out", "results.csv") == 0
    assert [row["source"] for row in rows()] == ["scans/a.ply", f"{scans}/scans/c.npy"]


def test_the_results_have_the_matrix_in_full_precision(files, scans, calls, answer):
    folder_run(files)
    numbers = np.loadtxt("results.csv", delimiter=",", skiprows=1, quotechar='"', usecols=range(2, 18))
    np.testing.assert_array_equal(numbers.reshape(-1, 4, 4), [np.asarray(answer.matrix)] * 3)
    assert tuple(rows()[0]) == many.COLUMNS
    assert float(rows()[0]["fitness"]) == pytest.approx(float(answer.fitness), rel=1e-5)


def test_names_with_commas_quotes_and_umlauts_survive(files, scans, calls):
    name = 'scans/a, "schräg".ply'
    (scans / "scans/a.ply").rename(scans / name)
    assert folder_run(files) == 0
    assert rows()[0]["source"] == name
    assert folder_run(files) == 0
    assert len(calls) == 1


@pytest.mark.skipif(os.name == "nt", reason="names are bytes on POSIX alone")
def test_a_name_that_is_no_utf8_loses_no_row_and_is_known_again(files, scans, calls):
    os.rename(b"scans/a.ply", b"scans/a\xff.ply")
    assert folder_run(files) == 0
    assert Path("results.csv").read_bytes().count(b"\n") == 4
    assert folder_run(files) == 0
    assert len(calls) == 1


def test_results_that_can_not_be_written_are_found_out_before_any_work(files, scans, calls, capsys, monkeypatch):
    def fail(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(many, "write_atomically", fail)
    assert folder_run(files) == 2
    assert "results.csv: no space left on device" in capsys.readouterr().err
    assert not calls


def test_names_of_columns_may_be_capitals(files, scans, calls):
    assert run(files, "--pairs", table("Source, Target\nscans/a.ply,model.ply\n"), "--out", "results.csv") == 0


def test_a_file_that_takes_long_to_write_is_written_seldom(files, scans, calls, monkeypatch):
    """A second each, of 200 pairs that take a second each: at most a twentieth of the time goes into saving."""
    now, writes = [0.0], []

    def write(path, content):
        now[0] += 1.0
        writes.append(now[0])

    monkeypatch.setattr(many, "write_atomically", write)
    monkeypatch.setattr(many.time, "monotonic", lambda: now[0])
    pairs = [many.Pair(f"{number}", "target", (Path(f"{number}"), Path("target"), None)) for number in range(200)]
    results = many.Results(pairs, "", Path("results.csv"), echo=False)
    results.save()
    for pair in pairs:
        now[0] += 1.0
        results.add(pair, dict.fromkeys(many.COLUMNS, ""))
        results.save_if_due()
    assert 8 <= len(writes) <= 11


def test_reasons_that_differ_in_a_ratio_are_counted_together():
    reason = "it did not fit; the source is far larger than the target, scale ratio {}: is one in millimetres?"
    unsure = [{"m00": "1", "converged": "False", "reason": reason.format(ratio)} for ratio in ("986.1", "1e+03")]
    assert list(many.summary(unsure)["not_converged"].values()) == [2]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("missing.ply,model.ply", "missing.ply: no such file"),
        ("scans/notes.md,model.ply", "unknown extension"),
        ("scans/notes.txt,model.ply", "notes.txt: line 1: expected numbers"),
        ("broken.ply,model.ply", "broken.ply: "),
        ("scans/a.ply,", "line 3 of the table names no target"),
        ("scans/a.ply,model.ply,more,", "line 3 of the table has more cells"),
        ("scans,model.ply", "scans: unknown extension"),
        ("nul\0.ply,model.ply", "no such file"),
    ],
    ids=["missing", "extension", "text", "damaged", "no target", "too many cells", "a folder", "null byte"],
)
def test_a_bad_pair_gets_its_reason_and_stops_no_other(files, scans, calls, capsys, line, reason):
    Path("broken.ply").write_text("no cloud")
    pairs = table(f"source,target\nscans/a.ply,model.ply\n{line}\nscans/c.npy,model.ply\n")
    assert run(files, "--pairs", pairs, "--out", "results.csv") == 1
    first, bad, last = rows()
    assert first["converged"] == last["converged"] == "True"
    assert bad["converged"] == "False" and bad["m00"] == bad["fitness"] == "nan"
    assert reason in bad["reason"]
    assert bad["reason"] in capsys.readouterr().err


def test_a_chunk_that_fails_is_tried_pair_by_pair(files, scans, calls, monkeypatch):
    stub = many.register_pairs

    def short_of_memory(sources, targets, **options):
        if len(sources) > 1 or sources[0].dtype == np.float32:
            raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")
        return stub(sources, targets, **options)

    monkeypatch.setattr(many, "register_pairs", short_of_memory)
    np.save("scans/c.npy", np.load("scans/c.npy").astype(np.float32))
    assert folder_run(files) == 1
    assert [row["converged"] for row in rows()] == ["True", "True", "False"]
    assert rows()[2]["reason"] == "there is not enough memory for clouds of this size"


def test_the_summary_counts_what_did_not_converge_by_reason(files, scans, calls, capsys):
    lines = "".join(f"scans/{name},far.ply\n" for name in ("a.ply", "b.xyz"))
    assert run(files, "--pairs", table("source,target\nscans/a.ply,model.ply\n" + lines)) == 1
    err = capsys.readouterr().err
    assert "3 pairs: 1 converged, 2 did not, 0 could not be read or registered" in err
    assert "2 did not converge: another pose fits about as well\n" in err


def test_without_out_the_rows_are_on_stdout_and_nothing_else(files, scans, calls, capsys):
    assert run(files, "scans", "--to", "model.ply") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == ",".join(many.COLUMNS) and len(lines) == 4


@pytest.mark.parametrize("out", [[], ["--out", "results.csv"]], ids=["stdout", "file"])
def test_json_is_one_object(files, scans, calls, capsys, out):
    pairs = table("source,target\nscans/a.ply,model.ply\nscans/a.ply,far.ply\nmissing.ply,model.ply\n")
    assert run(files, "--pairs", pairs, "--json", *out) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["pairs"], found["converged"], len(found["failed"])) == (3, 1, 1)
    assert sum(found["not_converged"].values()) == 1
    assert np.shape(found["results"][0]["matrix"]) == (4, 4) and found["results"][2]["matrix"] is None


class TestAnotherRun:
    def test_repeats_nothing(self, files, scans, calls, capsys):
        folder_run(files)
        before = Path("results.csv").read_bytes()
        assert folder_run(files) == 0
        assert len(calls) == 1 and Path("results.csv").read_bytes() == before
        assert "already in results.csv, not run again: 3 pairs of 3\n" in capsys.readouterr().err

    def test_goes_on_where_the_first_was_stopped(self, files, scans, calls, monkeypatch):
        monkeypatch.setattr(many, "pairs_at_once", lambda: 1)
        stub = many.register_pairs

        def interrupt_second(*arguments, **options):
            if len(calls) == 1:
                raise KeyboardInterrupt
            return stub(*arguments, **options)

        monkeypatch.setattr(many, "register_pairs", interrupt_second)
        assert folder_run(files) == 130
        assert len(rows()) == 1
        monkeypatch.setattr(many, "register_pairs", stub)
        assert folder_run(files) == 0
        assert len(calls) == len(rows()) == 3

    @pytest.mark.parametrize("name", ["scans/b.xyz", "model.ply"])
    def test_repeats_what_has_changed_and_says_so(self, files, scans, calls, capsys, name):
        folder_run(files)
        io.write_cloud(name, np.random.default_rng(1).normal(size=(50, 3)))
        capsys.readouterr()
        assert folder_run(files) == 0
        changed = 3 if name == "model.ply" else 1
        assert len(calls[1]["sources"]) == changed
        said = "3 pairs" if changed == 3 else "1 pair"
        assert f"have changed since, run again: {said}\n" in capsys.readouterr().err

    def test_repeats_what_has_another_initial_transform(self, files, scans, calls):
        np.savetxt("start.txt", np.eye(4))
        pairs = table("source,target,initial\nscans/a.ply,model.ply,start.txt\nscans/b.xyz,model.ply,\n")
        run(files, "--pairs", pairs, "--out", "results.csv")
        np.savetxt("start.txt", np.diag([-1.0, -1, 1, 1]))
        run(files, "--pairs", pairs, "--out", "results.csv")
        np.testing.assert_array_equal(calls[0]["initials"][0], np.eye(4))
        assert calls[0]["initials"][1] is None
        assert len(calls[1]["sources"]) == 1

    def test_with_other_options_is_refused(self, files, scans, calls, capsys):
        folder_run(files)
        before = Path("results.csv").read_bytes()
        assert folder_run(files, "--search", "never") == 2
        err = capsys.readouterr().err
        assert "holds results of other options" in err and "search never" in err
        assert Path("results.csv").read_bytes() == before

    def test_keeps_the_rows_of_pairs_that_are_not_asked_for(self, files, scans, calls, capsys):
        folder_run(files)
        (scans / "scans/b.xyz").unlink()
        assert folder_run(files) == 0
        assert [row["source"] for row in rows()] == ["scans/a.ply", "scans/c.npy", "scans/b.xyz"]
        assert "not asked for now, kept below the others: 1 pair\n" in capsys.readouterr().err

    @pytest.mark.parametrize("content", [b"", b"a,b\n1,2\n", b"\xff\xfe", b"cut"], ids=repr)
    def test_does_not_overwrite_a_file_of_another_kind(self, files, scans, calls, capsys, content):
        Path("results.csv").write_bytes(content)
        assert folder_run(files) == 2
        assert "is no results file" in capsys.readouterr().err
        assert Path("results.csv").read_bytes() == content


def test_two_pairs_of_the_same_files_with_other_initial_transforms_are_two(files, scans, calls):
    for name, turn in (("one.txt", np.eye(4)), ("two.txt", np.diag([-1.0, -1, 1, 1]))):
        np.savetxt(name, turn)
    pairs = table("source,target,initial\nscans/a.ply,model.ply,one.txt\nscans/a.ply,model.ply,two.txt\n")
    assert run(files, "--pairs", pairs, "--out", "results.csv") == 0
    assert len(calls[0]["sources"]) == len(rows()) == 2
    assert run(files, "--pairs", pairs, "--out", "results.csv") == 0
    assert len(calls) == 1


def test_a_pair_that_is_named_twice_is_registered_once(files, scans, calls, capsys):
    pairs = table("source,target\nscans/a.ply,model.ply\nscans/a.ply,model.ply\n")
    assert run(files, "--pairs", pairs, "--out", "results.csv") == 0
    assert len(calls[0]["sources"]) == 1 and len(rows()) == 2
    assert run(files, "--pairs", pairs, "--out", "results.csv") == 0
    assert "not run again: 2 pairs of 2" in capsys.readouterr().err


def test_a_target_that_repeats_is_read_once(files, scans, calls, monkeypatch):
    read = []
    monkeypatch.setattr(many, "read_cloud", lambda path, samples: read.append(path) or io.read_cloud(path))
    folder_run(files)
    assert sorted(path.name for path in read) == ["a.ply", "b.xyz", "c.npy", "model.ply"]


def test_small_pairs_run_in_full_batches_of_one_size_and_large_ones_alone(files, scans, calls, monkeypatch):
    monkeypatch.setattr(many, "pairs_at_once", lambda: 2)
    sizes = {"a": 100, "b": 5000, "c": 100, "d": 300, "e": 100, "f": 300}
    for path in Path("scans").iterdir():
        path.unlink()
    for name, size in sizes.items():
        io.write_cloud(f"scans/{name}.npy", np.random.default_rng(0).normal(size=(size, 3)))
    folder_run(files)
    assert [[len(source) for source in call["sources"]] for call in calls] == [[5000], [100, 100], [300, 300], [100]]
    assert [Path(row["source"]).stem for row in rows()] == sorted(sizes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scans", "model.ply"], "'urrt register scans --to model.ply' registers all its files"),
        (["scans/a.ply", "--to", "model.ply"], "scans/a.ply is a file"),
        (["nowhere", "--to", "model.ply"], "nowhere is no folder"),
        (["scans", "--to", "nowhere.ply"], "--to: nowhere.ply: there is no such file"),
        (["empty", "--to", "model.ply"], "empty: holds no file to register"),
        (["scans", "model.ply", "--to", "model.ply"], "name two files"),
        (["scans"], "name two files"),
        (["--pairs", "nowhere.csv"], "--pairs: nowhere.csv: no such file"),
        (["--pairs", "scans"], "no table of pairs: scans: is a directory"),
        (["--pairs", "semicolons.csv"], "separated by a comma"),
        (["--pairs", "rowless.csv"], "names no pairs"),
        (["--pairs", "model.ply"], "no table of pairs"),
        (["--pairs", "good.csv", "--initial", "x.txt"], "a column initial"),
        (["--pairs", "good.csv", "--out", "good.csv"], "good.csv is read"),
        (["--pairs", "good.csv", "--out", "moved.ply"], "written as .csv"),
        (["--pairs", "good.csv", "--out", "nowhere/results.csv"], "there is no folder"),
        (["--pairs", "good.csv", "--picture", "pair.png"], "--picture: shows one pair"),
        (["--pairs", "good.csv", "--inlier-distance", "0"], "expected a positive length"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_use_is_refused_before_any_work(files, scans, calls, capsys, arguments, message):
    Path("empty").mkdir()
    Path("good.csv").write_text("source,target\nscans/a.ply,model.ply\n")
    Path("semicolons.csv").write_text("source;target\nscans/a.ply;model.ply\n")
    Path("rowless.csv").write_text("source,target\n\n")
    assert run(files, *arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""
    assert not calls
