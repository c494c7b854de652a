from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from imitarm.viewer import Report, as_data
from viewer_samples import make_report, make_result


def test_every_number_is_there_in_si_units_and_is_json() -> None:
    data = json.loads(json.dumps(as_data(make_report(scenes=2)), allow_nan=False))
    assert data["passed"] is True and data["verdict"].startswith("2 of 2")
    scene = data["scenes"][1]
    assert scene["asked_clearance_m"] == 0.02
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
