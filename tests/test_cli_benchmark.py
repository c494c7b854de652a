from __future__ import annotations

import json

import pytest

from imitarm import cli
from imitarm.benchmark import experiment, recordings
from imitarm.benchmark.tables import END
from imitarm.cli import benchmark
from imitarm.errors import TaskFailedError

BEGIN = "<!-- imitarm benchmark mapping -->"
WHOM = ("--people", "1", "--first", "0")  # no method is tried on test persons
SMALL = ("benchmark", "mapping", *WHOM, "--seconds", "4", "--kinds", "inside", "--no-live", "--jobs", "1")


@pytest.mark.slow
def test_one_command_prints_tables_and_leaves_files(tmp_path, capsys):
    out, page, document = tmp_path / "out", tmp_path / "page.html", tmp_path / "doc.md"
    document.write_text(f"before\n{BEGIN}\n{END}\nafter\n")
    words = [*SMALL, "--methods", "modern", "m3", "--out", str(out), "--report", str(page), "--fill", str(document)]
    assert cli.main(words) == 0
    printed = capsys.readouterr()
    for said in ("Claims of the thesis", "Table 3.1", "Accuracy, inside", "Limit violations", "held?"):
        assert said in printed.out
    assert "--data" in printed.err  # what was left out is said
    assert (out / "mapping.md").read_text().startswith("**Claims of the thesis")
    assert len(json.loads((out / "mapping.json").read_text())["results"]) == 2
    assert "<svg" in page.read_text()
    assert "Accuracy, inside" in document.read_text()
    assert str(tmp_path) not in document.read_text()
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").iterdir()}
    assert cli.main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "runs").iterdir()} == kept


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--people", "0"], "people"),
        (["--jobs", "0"], "--jobs"),
        (["--sigma", "500"], "sigma"),
        (["--seconds", "1"], "seconds"),
        (["--data", "nowhere"], "no such folder"),
        (["--first", "-1"], "first person"),
        (["--report", "."], "is a folder"),
        (["--data", ".", "--out", "."], "is also the folder of --data"),
        (["--fill", "nowhere.md"], "can't be read"),
        (["--methods", "magic"], "modern"),
        (["--kinds", "dance"], "edge"),
    ],
)
def test_what_is_wrong_is_said_before_the_work(more, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*SMALL, *more]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_reports_folder_is_made_before_the_work_or_the_work_is_not_begun(tmp_path, monkeypatch, capsys):
    """Also one in a folder of results that is still to be made; nothing is made when something else is wrong."""
    monkeypatch.chdir(tmp_path)
    begun = []

    def run_all(experiments, folder, *_, **__):
        begun.append((len(experiments), (tmp_path / "out" / "pages").is_dir(), folder.name))
        raise TaskFailedError("far enough")

    monkeypatch.setattr(benchmark, "run_all", run_all)
    words = [*SMALL, "--methods", "modern", "--out", "out", "--report", "out/pages/page.html"]
    assert cli.main([*words, "--sigma", "500"]) == 2
    assert cli.main([*words, "--fill", "nowhere.md"]) == 2
    assert not list(tmp_path.iterdir())
    assert not begun
    assert cli.main(words) == 1
    assert begun == [(1, True, "out")]
    (tmp_path / "file").write_text("")
    assert cli.main([*SMALL, "--report", "file/page.html"]) == 2
    assert "--report file/page.html: its folder can't be created" in capsys.readouterr().err
    assert len(begun) == 1


def test_what_could_not_be_done_is_told_once(tmp_path, monkeypatch, capsys):
    """One person's recording fails; the others' figures are there all the same."""
    make = recordings.make_recording

    def fails(plan, arm):
        if plan.person == 1:
            raise TaskFailedError("person 1 stacked no tower")
        return make(plan, arm)

    monkeypatch.setattr(experiment, "make_recording", fails)
    words = [*SMALL, "--people", "2", "--methods", "modern", "m3", "--out", str(tmp_path), "--backend", "threading"]
    assert cli.main(words) == 0
    printed = capsys.readouterr()
    assert printed.err.count("person 1 stacked no tower") == 1
    assert "inside, person 1, repeat 0, modern, m3: TaskFailedError" in printed.err
    assert "1 of 2" in printed.out


def test_a_report_replaces_no_document(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = f"precious\n{BEGIN}\n{END}\n"
    (tmp_path / "paper.md").write_text(text)
    assert cli.main([*SMALL, "--report", "paper.md"]) == 2
    assert "already exists and is not an HTML page; name another file\n" in capsys.readouterr().err
    assert cli.main([*SMALL, "--fill", "paper.md", "--report", "paper.md"]) == 2
    assert "--report paper.md: is also the file of --fill" in capsys.readouterr().err
    (tmp_path / "results").mkdir()
    assert cli.main([*SMALL, "--out", "results", "--report", "results/mapping.json"]) == 2
    assert "--report results/mapping.json: is also the file of --out" in capsys.readouterr().err
    assert not list((tmp_path / "results").iterdir())
    assert cli.main([*SMALL, "--out", "paper.md"]) == 2
    assert "--out paper.md: is not a folder" in capsys.readouterr().err
    assert (
        sorted(path.name for path in tmp_path.iterdir()) == ["paper.md", "results"]
        and (tmp_path / "paper.md").read_text() == text
    )


def test_the_avoidance_benchmark_stands_beside_it(capsys):
    assert cli.main(["benchmark", "avoidance", "--seeds", "1", "--methods", "certified"]) == 0
    printed = capsys.readouterr().out
    assert "1 scenes per row" in printed
    assert "gap too narrow" in printed
    assert cli.main(["benchmark", "avoidance", "--seeds", "0"]) == 2
    assert cli.main(["benchmark"]) == 2
