"""What a skill file holds of the regression and of the primitive."""

from __future__ import annotations

from typing import Any

import numpy as np

from imitarm.errors import FileFormatError
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import Gains
from imitarm.skills.gmr import GMR
from imitarm.skills.quaternion_dmp import QuaternionDMP
from imitarm.skills.rotation_reference import RotationReference
from imitarm.skills.selection import Candidate
from imitarm.skills.skill_file import Fields


def gmr_content(gmr: GMR) -> dict[str, Any]:
    """Return what a file holds of a regression."""
    content: dict[str, Any] = {
        "duration": gmr.duration_,
        "n_demonstrations": gmr.n_demonstrations_,
        "weights": gmr.weights_,
        "means": gmr.means_,
        "covariances": gmr.covariances_,
        "ends": gmr.ends_,
        "degenerate_axes": gmr.degenerate_axes_,
        "converged": gmr.converged_,
    }
    if not np.isnan(gmr.lower_bound_):
        content["log_likelihood"] = gmr.lower_bound_
    if gmr.reference_ is not None:
        content["reference"] = {"times": gmr.reference_.times, "quaternions": gmr.reference_.quaternions}
    if gmr.selection_:
        rows = [[c.n_components, c.bic, c.aic, c.bias_rmse_mm] for c in gmr.selection_]
        content["selection"] = {"n_components, bic, aic, bias_rmse_mm": rows}
        if not np.isnan(gmr.selection_[0].held_out_rmse_mm):
            content["selection"]["held_out_rmse_mm"] = [c.held_out_rmse_mm for c in gmr.selection_]
    return content


def read_gmr(fields: Fields) -> GMR:
    """Build a regression from what a file holds.

    Raises:
        InputError: when a field is missing, of another kind, or out of range.
    """
    reference = None
    if fields.has("reference"):
        keys = fields.group("reference")
        reference = RotationReference(keys.array("times", 1), keys.array("quaternions", 2))
    selection: list[Candidate] = []
    if fields.has("selection"):
        group = fields.group("selection")
        rows = group.array("n_components, bic, aic, bias_rmse_mm", 2)
        errors = group.array("held_out_rmse_mm", 1) if group.has("held_out_rmse_mm") else np.full(len(rows), np.nan)
        if rows.shape[1] != 4 or len(rows) != len(errors):
            raise FileFormatError("gmr, selection: rows of 4 numbers needed, with one error each")
        selection = [
            Candidate(int(k), bic, aic, error, bias)
            for (k, bic, aic, bias), error in zip(rows.tolist(), errors.tolist(), strict=True)
        ]
    return GMR.from_mixture(
        fields.array("weights", 1),
        fields.array("means", 2),
        fields.array("covariances", 3),
        duration=fields.number("duration"),
        n_demonstrations=fields.integer("n_demonstrations"),
        reference=reference,
        ends=fields.array("ends", 2) if fields.has("ends") else None,
        selection=selection,
        degenerate_axes=[int(i) for i in fields.array("degenerate_axes", 1)],
        converged=fields.flag("converged"),
        lower_bound=fields.number("log_likelihood") if fields.has("log_likelihood") else np.nan,
    )


def dmp_content(dmp: DMP) -> dict[str, Any]:
    """Return what a file holds of a primitive."""
    content: dict[str, Any] = {
        "duration": dmp.duration_,
        "stiffness": dmp.gains_.stiffness,
        "damping": dmp.gains_.damping,
        "start": dmp.start_,
        "goal": dmp.goal_,
        "start_velocity": dmp.start_velocity_,
        "path_length": dmp.path_length_,
        "weights": dmp.weights_,
        "progress_weights": dmp.progress_weights_,
    }
    if dmp.orientation_ is not None:
        content["orientation"] = {
            "knots": dmp.orientation_.knots_,
            "coefficients": dmp.orientation_.coefficients_,
        }
    return content


def read_dmp(fields: Fields) -> DMP:
    """Build a primitive from what a file holds.

    Raises:
        InputError: when a field is missing, of another kind, or out of range.
    """
    gains = Gains(fields.number("stiffness"), fields.number("damping"))
    orientation = None
    if fields.has("orientation"):
        spline = fields.group("orientation")
        orientation = QuaternionDMP.from_spline(spline.array("knots", 1), spline.array("coefficients", 2), gains)
    return DMP.from_weights(
        fields.array("weights", 2),
        fields.array("progress_weights", 1),
        gains=gains,
        start=fields.array("start", 1),
        goal=fields.array("goal", 1),
        start_velocity=fields.array("start_velocity", 1),
        duration=fields.number("duration"),
        path_length=fields.number("path_length"),
        orientation=orientation,
    )
