from __future__ import annotations

import json
import re

import pytest

from imitarm.benchmark.experiment import LIVE, MAIN, METHODS
from imitarm.benchmark.mapping import CAMERAS, MappingBenchmark, run_all, tables, write_tables
from imitarm.benchmark.mapping_comparisons import COMPARED
from imitarm.benchmark.mapping_report import mapping_report_html
from imitarm.benchmark.mapping_tables import (
    TEST,
    Results,
)
from imitarm.benchmark.recordings import CAPTURED
from imitarm.benchmark.running import Workers
from imitarm.errors import InputError, UnknownNameError

MEASURED = sorted({figure.name for figure in COMPARED} - {"limit_violations", "mean_torque"})


def test_every_experiment_of_a_recording_has_the_same_recording():
    benchmark = MappingBenchmark(people=3, repeats=2, data="somewhere")
    found = benchmark.experiments()
    assert len(set(found)) == len(found)
    plans = {e.plan for e in found if e.task != LIVE}
    for name in METHODS:
        assert {e.plan for e in found if e.task != LIVE and e.method == name} == plans
    assert {e.method for e in found if e.task == LIVE} == set(MAIN)
    assert sum(e.task == LIVE for e in found) == 3 * 2 * len(MAIN)
    full = {e.plan for e in MappingBenchmark().experiments() if e.task != LIVE}
    assert len(full) >= 30
    assert {plan.person for plan in full} == set(range(TEST, TEST + 10))


def test_nobody_whom_the_methods_were_tuned_with_judges_them_unless_asked():
    found = MappingBenchmark(data="somewhere").experiments()
    assert {e.seed for e in found} == set(range(200, 210))
    assert {(e.seed, e.repeat) for e in found if e.task == CAPTURED} == {(200, camera) for camera in range(CAMERAS)}
    again = MappingBenchmark(people=2, first=3, data="somewhere").experiments()
    assert {e.seed for e in again if e.task != CAPTURED} == {3, 4}
    seeds = {e.plan.number for e in found if e.task != LIVE}
    assert seeds.isdisjoint(e.plan.number for e in MappingBenchmark(people=200, first=0).experiments())
    assert len(seeds) == len({e.plan for e in found if e.task != LIVE})


@pytest.mark.parametrize(
    "bad", [{"people": 0}, {"repeats": 0}, {"first": -1}, {"methods": ()}, {"kinds": (), "live": False}]
)
def test_what_is_no_benchmark_is_refused(bad):
    with pytest.raises(InputError):
        MappingBenchmark(**bad)


def test_an_unknown_method_is_refused_by_name():
    with pytest.raises(UnknownNameError, match="modern"):
        MappingBenchmark(methods=("magic",)).experiments()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small but real benchmark: two people, two methods, the edge of reach."""
    folder = tmp_path_factory.mktemp("mapping")
    benchmark = MappingBenchmark(
        people=2, first=0, repeats=1, methods=("modern", "m3"), kinds=("inside", "edge"), seconds=4.0, live=False
    )
    return folder, Results(run_all(benchmark.experiments(), folder, Workers(1)))


@pytest.mark.slow
def test_a_small_benchmark_fills_its_tables(small, tmp_path):
    _, results = small
    assert not any(r.failure for r in results.all)
    found = tables(results)
    titles = [table.title for table in found]
    assert any(title.startswith("Accuracy, edge") for title in titles)
    assert any(title.startswith("Limit violations") for title in titles)
    for table in found:
        assert table.rows or table.title.startswith("Where another")
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert "nan" not in table.markdown()
    (limits,) = (t for t in found if t.title.startswith("Limit violations: inside, edge"))
    modern = next(row for row in limits.rows if row[0] == "modern")
    assert modern[1:5] == ("4 of 4", "0", "0", "0")
    document, data = write_tables(results, found, tmp_path)
    assert document.read_text().count("**") >= 2 * len(found)
    content = json.loads(data.read_text())
    assert len(content["results"]) == 8
    assert content["results"][0]["values"]["tool_rms"] > 0.0


@pytest.mark.slow
def test_the_report_is_complete_and_asks_nothing_of_the_network(small):
    folder, results = small
    page = mapping_report_html(results, tables(results), provenance={"command": "x"}, folder=folder / "recordings")
    assert page.count("<svg") >= 3
    assert "default-src 'none'" in page
    assert "Show in 3-D" in page
    assert 'id="method-modern"' in page
    assert 'id="method-m3"' in page
    assert "0 of 4 recordings" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?:https?:)?//""", page)
