"""What a simulated robot measured when it did what a method commanded, for ``imitarm retarget --drive``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imitarm.evaluation.driving import Driven
from imitarm.viewer.retarget_content import Measure, MethodResult


def with_driven(result: MethodResult, driven: Driven) -> MethodResult:
    """Return a method's result with what the robot measured."""
    measures = [
        Measure("driven: worst joint behind, RMS", 1e3 * driven.behind_rms, "mrad", 1, "less"),
        Measure("driven: worst joint behind, at most", 1e3 * driven.behind_max, "mrad", 0, "less"),
        Measure("driven: highest torque", 100.0 * driven.peak_torque_ratio, "% of the rated", 0, "less"),
        Measure("driven: commands cut by the robot's limits", driven.cut, "frames", 0, "less"),
    ]
    notes = []
    if np.isfinite(driven.clearance):
        notes.append(f"driven: the arm came as near as {1e3 * driven.clearance:.0f} mm to an obstacle")
    if driven.touched:
        notes.append("driven: touched " + ", ".join(driven.touched))
    if driven.fault:
        notes.append(f"driven: after {driven.duration:.1f} s the robot stopped itself ({driven.fault})")
    return replace(result, measures=[*result.measures, *measures], notes=[*result.notes, *notes])
