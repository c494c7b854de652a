from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.scene import Scene
from imitarm.viewer import Report, as_data
from viewer_samples import make_adaptation, make_path, make_report, make_result, make_rollout


def test_a_scenes_numbers_follow_from_what_was_measured() -> None:
    result = make_result(rollout=make_rollout(make_path(), clearance=0.0213))
    assert result.min_clearance == result.rollout.min_clearance and not result.contact
    assert result.unmoved_fraction == pytest.approx(4 / 7)
    assert result.peak_torque_ratio == pytest.approx(0.5, abs=0.01)


def test_touching_is_contact() -> None:
    touching = make_result(rollout=replace(make_rollout(make_path()), clearance=np.zeros(200)))
    assert touching.contact
    assert not Report("x", [touching]).passed
    assert Report("x", [touching]).verdict.startswith("no contact in 0 of 1 scenes with obstacles")


def test_what_was_not_done_is_not_called_clear() -> None:
    refused = make_result("refused", rollout=None, success=False, reason="the gap is too narrow")
    assert math.isnan(refused.min_clearance) and not refused.contact
    report = Report("x", [make_result("good"), refused])
    assert not report.passed
    assert report.verdict == "no contact in 1 of 2 scenes with obstacles; smallest clearance 22.0 mm; 1 not completed"


def test_the_verdict_counts_scenes_with_obstacles() -> None:
    assert make_report(scenes=4).verdict == "no contact in 4 of 4 scenes with obstacles; smallest clearance 22.0 mm"
    assert make_report(scenes=4).passed
    free = make_result("free", scene=Scene(), adaptation=make_adaptation(0.0))
    assert Report("x", [free]).verdict == "1 of 1 scenes completed"
    assert Report("x", []).verdict == "no scene was run"


def test_names_are_unique_and_not_empty() -> None:
    with pytest.raises(InputError, match="'a' is used twice"):
        Report("x", [make_result("a"), make_result("a")])
    with pytest.raises(InputError, match="name is empty"):
        make_result(" ", title="Untitled")


def test_every_number_is_there_in_si_units_and_is_json() -> None:
    data = json.loads(json.dumps(as_data(make_report(scenes=2)), allow_nan=False))
    assert data["passed"] is True and data["verdict"].startswith("no contact in 2 of 2")
    scene = data["scenes"][1]
    assert scene["required_clearance_m"] == 0.02
    assert scene["min_clearance_m"] == pytest.approx(0.022, abs=1e-3)
    assert scene["n_components"] == 7 and scene["n_moved_components"] == 3
    assert scene["adaptation_time_s"] == 0.00134
    assert scene["details"] == {"Crumbs in the pan": "6 of 6"}
    assert data["learning"]["alignment"]["method"] == "dtw"
    assert len(data["learning"]["alignment"]["kept_rows"]) == data["learning"]["n_demonstrations"] == 5
    assert data["learning"]["findings"][0]["code"] == "idle"
    assert [c["n_components"] for c in data["learning"]["candidates"]] == list(range(2, 13))
    assert data["provenance"]["Versions"] == {"numpy": "2.4"}


def test_what_is_not_known_is_none() -> None:
    free, refused = as_data(make_report(scenes=0))["scenes"][0], as_data(Report("x", [make_result(rollout=None)]))
    assert free["min_clearance_m"] is None  # there was nothing to be near to
    assert refused["scenes"][0]["motion_duration_s"] is None


def test_numpy_numbers_and_odd_values_become_plain() -> None:
    details = {
        "a": np.float64(1.5),
        "b": np.int32(2),
        "c": np.bool_(True),
        "d": np.arange(2),
        "e": float("nan"),
        "f": {1},
    }
    report = Report("x", [replace(make_result(), details=details)])
    assert as_data(report)["scenes"][0]["details"] == {
        "a": 1.5, "b": 2, "c": True, "d": [0, 1], "e": None, "f": "{1}",
    }  # fmt: skip
