from __future__ import annotations

import math
from xml.etree import ElementTree

import pytest

from imitarm.benchmark import mapping_report
from imitarm.benchmark.experiment import LIVE, Experiment, Result
from imitarm.benchmark.mapping_tables import Results


def results():
    found = []
    for method in ("modern", "m2"):
        for person in range(3):
            values = {
                **{"mean_torque": [1.0 + person + joint for joint in range(7)], "path_length": 2.0 + person},
                **{"tool_rms": 0.03, "position_violations": 0, "velocity_violations": 2, "acceleration_violations": 1},
            }
            found.append(Result(Experiment("inside", method, seed=person), "0", values, "", 1.0))
            trial = {"success": method == "modern" and person > 0, "time": 30.0 + person}
            found.append(Result(Experiment(LIVE, method, seed=person), "0", trial, "", 1.0))
    return Results(found)


@pytest.mark.parametrize(
    "draw",
    [
        lambda r: mapping_report.torques(r, ["inside"]),
        lambda r: mapping_report.path_lengths(r, ["inside"]),
        lambda r: mapping_report.accuracy(r, ["inside"]),
        lambda r: mapping_report.limit_violations(r, ["inside"]),
        mapping_report.times,
        mapping_report.successes,
    ],
)
def test_each_figure_is_one_svg_that_names_its_methods(draw):
    svg = draw(results())
    root = ElementTree.fromstring(svg)
    assert root.tag == "svg" or root.tag.endswith("}svg")
    assert root.get("aria-label")
    text = "".join(root.itertext())
    assert "modern" in text
    assert "M2" in text
    assert "http" not in svg.replace("http://www.w3.org/", "")


def test_without_numbers_there_is_no_figure():
    empty = Results([Result(Experiment("inside", "modern"), "0", {"path_length": math.nan}, "", 1.0)])
    assert mapping_report.path_lengths(empty, ["inside"]) == ""
    assert mapping_report.times(empty) == ""
