"""The report's numbers as plain values, for other programs to read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from imitarm.demonstrations import Alignment
from imitarm.viewer.content import Report


def as_data(report: Report) -> dict[str, Any]:
    """Return the report's numbers as plain values in SI units, ready for JSON; what is not known is None."""
    scenes = []
    for scene in report.scenes:
        adaptation = scene.adaptation
        scenes.append(
            {
                "name": scene.name,
                "title": scene.title,
                "success": scene.success,
                "reason": scene.reason,
                "n_obstacles": len(scene.scene.obstacles),
                "asked_clearance_m": scene.asked_clearance,
                "min_clearance_m": scene.min_clearance,
                "certified_clearance_m": adaptation.certified_clearance if adaptation else None,
                "rmse_to_demonstrations_m": scene.rmse,
                "n_components": len(adaptation.moved) if adaptation else None,
                "n_moved_components": int(np.sum(adaptation.moved)) if adaptation else None,
                "unmoved_share": scene.unmoved_share,
                "adaptation_method": adaptation.method if adaptation else None,
                "adaptation_time_s": adaptation.compute_time if adaptation else None,
                "motion_duration_s": scene.rollout.trajectory.duration if scene.rollout else None,
                "peak_torque_share": scene.peak_torque_share,
                "details": dict(scene.details),
            }
        )
    data: dict[str, Any] = {
        "title": report.title,
        "passed": report.passed,
        "verdict": report.verdict,
        "scenes": scenes,
        "provenance": dict(report.provenance),
    }
    if report.learning is not None:
        learning = report.learning
        data["learning"] = {
            "n_demonstrations": len(learning.demonstrations),
            "sources": [demonstration.source for demonstration in learning.demonstrations],
            "n_components": learning.n_components,
            "candidates": [
                {"n_components": c.n_components, "bic": c.bic, "aic": c.aic, "held_out_rmse_mm": c.held_out_rmse_mm}
                for c in learning.candidates
            ],
            "findings": [asdict(finding) for finding in learning.findings],
            "alignment": _alignment_data(learning.alignment) if learning.alignment is not None else None,
            "details": dict(learning.details),
        }
    return plain(data)


def _alignment_data(alignment: Alignment) -> dict[str, Any]:
    return {
        "method": alignment.method,
        "duration_s": alignment.duration,
        "kept_rows": alignment.kept_rows.tolist(),
        "durations_s": alignment.durations.tolist(),
        "largest_shift_s": alignment.largest_shift.tolist(),
    }


def plain(value: Any) -> Any:
    """Return ``value`` with NumPy numbers and mappings as Python's own and numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value if value is None else str(value)
