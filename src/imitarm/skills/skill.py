"""A skill: a motion learnt from demonstrations, with how exact each part of it must be."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

import imitarm
from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills.course import Adjustment
from imitarm.skills.dmp import DMP
from imitarm.skills.gmr import GMR
from imitarm.skills.quaternion_dmp import QuaternionDMP
from imitarm.skills.rotation_reference import RotationReference
from imitarm.skills.selection import Candidate
from imitarm.skills.skill_file import Fields, read_skill, write_skill
from imitarm.skills.spring import Gains
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

_SAMPLES = 400  # of the mean motion that the primitive is trained on


class Skill:
    """A motion learnt from demonstrations (thesis Chapter 5: GMM, then GMR, then DMP).

    A :class:`~imitarm.skills.gmr.GMR` learns the mean motion and, as its covariance, how much demonstrations differ
    at each instant. A :class:`~imitarm.skills.dmp.DMP` is trained on the mean: it reproduces the motion from another
    start, to another goal, in another time. The covariance stays as the tolerance: where the person was exact, the
    robot must be. A skill knows nothing of obstacles; policies do.

    Args:
        n_components: number of Gaussians, or ``"auto"`` (see GMR).
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.spring.Gains` (see DMP).
        n_basis: number of basis functions of the primitive.
        random_state: seed of everything random in learning.

    Attributes:
        gmr_: mean and covariance over time.
        dmp_: the primitive.
        task_: what was shown, for example ``"sweep"``.
        duration_: [s].
        start_: learnt start, tool_to_base; its rotation is the identity when none was learnt.
        goal_: learnt goal, likewise.
        n_demonstrations_: number of demonstrations.
        provenance_: where it comes from: ``"imitarm"`` (version that learnt it), ``"sources"`` (one a demonstration),
            ``"notes"`` (for example what lint found), and ``"date"`` when one was given.

    Raises:
        InputError: when an option is out of range.
    """

    gmr_: GMR
    dmp_: DMP
    task_: str
    n_demonstrations_: int
    provenance_: dict[str, Any]

    def __init__(
        self,
        n_components: int | Literal["auto"] = "auto",
        *,
        gains: str | Gains = "critical",
        n_basis: int = 40,
        random_state: int = 0,
    ) -> None:
        self._gmr = GMR(n_components, random_state=random_state)
        self._dmp = DMP(gains, n_basis=n_basis)

    def fit(
        self, demonstrations: Sequence[Demonstration], *, notes: Sequence[str] = (), date: str | None = None
    ) -> Self:
        """Learn from demonstrations, aligned beforehand (``imitarm.demonstrations.align``).

        Args:
            demonstrations: at least one; three or more tell how much a person varies.
            notes: what is worth knowing later, for example what lint found.
            date: when it was learnt; left out when None, so that the same input gives the same file.

        Raises:
            InputError: as :meth:`GMR.fit` and :meth:`DMP.fit`.
        """
        gmr = self._gmr.fit(demonstrations)
        tasks = dict.fromkeys(d.task for d in demonstrations if isinstance(d, Demonstration) and d.task)
        sources = [d.source for d in demonstrations if isinstance(d, Demonstration)]
        provenance: dict[str, Any] = {"imitarm": imitarm.__version__, "sources": sources, "notes": list(notes)}
        if date is not None:
            provenance["date"] = date
        self._take(gmr, self._dmp.fit(gmr.trajectory(_SAMPLES)), " + ".join(tasks), provenance)
        return self

    def _take(self, gmr: GMR, dmp: DMP, task: str, provenance: Mapping[str, Any]) -> None:
        self.gmr_, self.dmp_, self.task_, self.provenance_ = gmr, dmp, task, dict(provenance)
        self.n_demonstrations_ = gmr.n_demonstrations_

    def __repr__(self) -> str:
        if not hasattr(self, "gmr_"):
            return "Skill(not fitted)"
        return (
            f"Skill({self.task_ or 'unnamed'!r}, {self.n_demonstrations_} demonstrations, {self.duration_:.3g} s, "
            f"{self.gmr_.n_components_} components, {'with' if self.gmr_.has_orientation_ else 'without'} orientation)"
        )

    def _fitted(self) -> DMP:
        if not hasattr(self, "dmp_"):
            raise InputError("Skill: not learnt yet; call fit, or Skill.load")
        return self.dmp_

    @property
    def duration_(self) -> float:
        """Learnt duration [s]."""
        return self._fitted().duration_

    @property
    def start_(self) -> Pose:
        """Learnt start, tool_to_base."""
        dmp = self._fitted()
        return _pose(dmp.start_, None if dmp.orientation_ is None else dmp.orientation_.start_)

    @property
    def goal_(self) -> Pose:
        """Learnt goal, tool_to_base."""
        dmp = self._fitted()
        return _pose(dmp.goal_, None if dmp.orientation_ is None else dmp.orientation_.goal_)

    def generate(
        self,
        start: Pose | ArrayLike | None = None,
        goal: Pose | ArrayLike | None = None,
        duration: float | None = None,
        dt: float = 0.01,
        *,
        adjustment: Adjustment = "progress",
    ) -> Trajectory:
        """Return the motion, ``round(duration / dt) + 1`` samples, with quaternions when rotation was learnt.

        Args:
            start: a Pose, or a position (3,) [m] with the learnt rotation; None: as learnt.
            goal: likewise.
            duration: [s]; None: as learnt.
            dt: step [s], stretched so that a whole number of steps fills the duration.
            adjustment: how the motion gives way to other ends (see :class:`~imitarm.skills.dmp.DMP`).

        Raises:
            InputError: when not fitted, or an argument is out of range.
        """
        return self._fitted().generate(start, goal, duration, dt, adjustment=adjustment)

    def tolerance(self, times: ArrayLike, duration: float | None = None) -> Array:
        """Return how much the demonstrations differ at ``times`` (n,) [s]: covariances (n, 3, 3) [m^2].

        Args:
            times: since the start of a motion that takes ``duration``.
            duration: [s]; None: as learnt.
        """
        T = self.duration_
        scale = 1.0 if duration is None else T / duration
        return self.gmr_.predict(np.asarray(times, dtype=float) * scale)[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a skill file (:mod:`imitarm.skills.skill_file`): JSON, human-readable, checked when read.

        Raises:
            InputError: when not learnt yet, or the file can't be written.
        """
        self._fitted()
        write_skill(
            path,
            {
                "task": self.task_,
                "provenance": self.provenance_,
                "gmr": _gmr_content(self.gmr_),
                "dmp": _dmp_content(self.dmp_),
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Skill:
        """Read a skill file.

        Raises:
            InputError: when there is no such file or it can't be read.
            FileFormatError: when it is no skill file, was cut or altered, or is of a newer version.
        """
        fields = read_skill(path)
        try:
            gmr, dmp = _read_gmr(fields.group("gmr")), _read_dmp(fields.group("dmp"))
            if gmr.has_orientation_ != (dmp.orientation_ is not None):
                raise FileFormatError("rotation was learnt by one of gmr and dmp only")
            provenance = fields.group("provenance")
            origin: dict[str, Any] = {
                "imitarm": provenance.text("imitarm"),
                "sources": list(provenance.texts("sources")),
                "notes": list(provenance.texts("notes")),
            }
            if provenance.has("date"):
                origin["date"] = provenance.text("date")
            task = fields.text("task")
        except FileFormatError:
            raise
        except InputError as error:
            raise FileFormatError(f"{os.fspath(path)}: {error}") from error
        skill = cls(gmr.n_components_, gains=dmp.gains_, n_basis=dmp.n_basis)
        skill._take(gmr, dmp, task, origin)
        return skill


def _pose(position: Array, quaternion: Array | None) -> Pose:
    return Pose(position, np.array([1.0, 0.0, 0.0, 0.0]) if quaternion is None else quaternion)


def _gmr_content(gmr: GMR) -> dict[str, Any]:
    content: dict[str, Any] = {
        "duration": gmr.duration_,
        "n_demonstrations": gmr.n_demonstrations_,
        "weights": gmr.weights_,
        "means": gmr.means_,
        "covariances": gmr.covariances_,
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


def _read_gmr(fields: Fields) -> GMR:
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
        selection=selection,
        degenerate_axes=[int(i) for i in fields.array("degenerate_axes", 1)],
        converged=fields.flag("converged"),
        lower_bound=fields.number("log_likelihood") if fields.has("log_likelihood") else np.nan,
    )


def _dmp_content(dmp: DMP) -> dict[str, Any]:
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


def _read_dmp(fields: Fields) -> DMP:
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
