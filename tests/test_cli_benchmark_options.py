"""Contradictory options of ``imitarm benchmark``, and options without effect, are errors before any work."""

from __future__ import annotations

import argparse

import pytest

from imitarm import cli
from imitarm.benchmark import placements
from imitarm.benchmark.mapping import MappingBenchmark
from imitarm.benchmark.placement_results import Setup
from imitarm.cli import benchmark_moving, benchmark_static


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("moving --fresh --reuse", "not allowed with argument"),
        ("static --reuse --fresh", "not allowed with argument"),
        ("mapping --fresh --reuse", "not allowed with argument"),
        ("moving --count 3 compare folder", "--count: an option before 'compare' has no effect"),
        ("moving --methods rcamo --out other compare folder", "--methods --out: an option before 'compare'"),
        ("static --count 5 tune", "--count: an option before 'tune' has no effect"),
        ("static --out other refusals", "--out: an option before 'refusals' has no effect"),
        ("moving --world sawyer --dimensions 2", "--dimensions applies only to --world tool"),
        ("moving --noise -5", "--noise, --rate, --latency, --dropout or --occlusions: SensorModel: noise"),
        ("moving --rate 1e9", "of at most 10000"),
        ("tracking --windows 200 --noise nan", "--noise, --dropout or --seed: SensorModel: noise"),
        ("moving compare folder --play M1,2,2000", "--play draws scenes in the page of --report"),
        ("static compare folder --play nonsense --report page.html", "--play nonsense: write family"),
        ("packing --seeds 0", "--seeds must be at least 1"),
        ("pushed-cube --first -1", "--first at least 0"),
        ("mapping --no-replay --kinds edge", "--kinds selects recordings, but --no-replay"),
        ("mapping --no-replay --data .", "--data selects recordings, but --no-replay"),
        ("placements --robot panda --robots sawyer", "not allowed with argument"),
        ("placements --flange tip", "unrecognized arguments: --flange"),
        ("placements --discard-meshes", "unrecognized arguments: --discard-meshes"),
        ("placements --reuse", "--reuse needs --out"),
        ("placements --max-tilt nan", "--max-tilt must be a finite number"),
        ("placements --max-tilt -5", "--max-tilt must be a finite number of at least 0"),
    ],
)
def test_it_is_refused_before_the_work(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["benchmark", *words.split()]) == 2
    written = capsys.readouterr().err
    assert said in " ".join(written.split()) and "Traceback" not in written
    assert not any(tmp_path.iterdir())


def parsed(add, command, words):
    parser = argparse.ArgumentParser()
    add(parser.add_subparsers())
    return parser.parse_args([command, *words.split()])


def test_what_is_named_twice_is_run_once(monkeypatch):
    twice = "--count 1 --families M1 M1 --dimensions 2 2 --noise 5 5 --methods rcamo rcamo --world tool tool"
    moving = parsed(benchmark_moving.add_moving, "moving", twice)
    assert len(benchmark_moving.experiments_of(moving)) == 1
    static = parsed(benchmark_static.add_static, "static", "--count 1 --families S1 S1 --dimensions 3 3")
    assert benchmark_static._scenes(static) == [("S1", 3, static.first)]
    assert len(MappingBenchmark(1, kinds=("edge", "edge"), methods=("modern", "modern"), live=False).experiments()) == 1
    ran = []
    monkeypatch.setattr(placements, "run_placement", lambda *run: ran.append(run) or placements_result(*run))
    found = placements.run_placements(["acfra", "acfra"], [Setup("a.json", "panda", None)] * 2, [1, 1])
    assert len(ran) == len(found) == 1


def placements_result(policy, setup, seed, max_tilt):
    return placements.PlacementResult(
        policy, setup, seed, "refused", clearance=0.1, duration=1.0, planning=0.1, reason="", max_tilt=max_tilt
    )


def test_the_same_option_after_the_action_is_used():
    tuning = parsed(benchmark_static.add_static, "static", "tune --count 7")
    assert tuning.count == 7
