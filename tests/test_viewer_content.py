from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.scene import Scene
from imitarm.viewer import Report
from viewer_samples import make_adaptation, make_path, make_report, make_result, make_rollout


def test_a_scenes_numbers_follow_from_what_was_measured() -> None:
    result = make_result(rollout=make_rollout(make_path(), clearance=0.0213))
    assert result.min_clearance == result.rollout.min_clearance and not result.contact
    assert result.unmoved_share == pytest.approx(4 / 7)
    assert result.peak_torque_share == pytest.approx(0.5, abs=0.01)


def test_touching_is_contact() -> None:
    touching = make_result(rollout=replace(make_rollout(make_path()), clearance=np.zeros(200)))
    assert touching.contact
    assert not Report("x", [touching]).passed
    assert Report("x", [touching]).verdict.startswith("0 of 1 scenes with obstacles without contact")


def test_what_was_not_done_is_not_called_clear() -> None:
    refused = make_result("refused", rollout=None, success=False, reason="the gap is too narrow")
    assert math.isnan(refused.min_clearance) and not refused.contact
    report = Report("x", [make_result("good"), refused])
    assert not report.passed
    assert report.verdict == "1 of 2 scenes with obstacles without contact; smallest clearance 22.0 mm; 1 not done"


def test_the_verdict_counts_scenes_with_obstacles() -> None:
    assert make_report(scenes=4).verdict == "4 of 4 scenes with obstacles without contact; smallest clearance 22.0 mm"
    assert make_report(scenes=4).passed
    free = make_result("free", scene=Scene(), adaptation=make_adaptation(0.0))
    assert Report("x", [free]).verdict == "1 of 1 scenes done"
    assert Report("x", []).verdict == "no scene was tried"


def test_names_are_unique_and_not_empty() -> None:
    with pytest.raises(InputError, match="'a' is used twice"):
        Report("x", [make_result("a"), make_result("a")])
    with pytest.raises(InputError, match="not empty"):
        make_result(" ", title="Untitled")
