"""A skill: a motion learned from demonstrations, and the precision that each part of the motion requires."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

import imitarm
from imitarm.errors import FileFormatError, InputError
from imitarm.html_table import html_table
from imitarm.kinematics.pose import Pose
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import Adjustment, Gains
from imitarm.skills.fit_quality import FitQuality, PoorFitWarning, evaluate_fit
from imitarm.skills.gmr import GMR
from imitarm.skills.rotations import with_other_ends
from imitarm.skills.skill_file import dmp_of, fit_of, gmr_of, read_skill, write_skill
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import choice, file_path, finite_array, finite_number, finite_numbers, sequence, text

Array = NDArray[np.float64]

_SAMPLES, _SAMPLES_PER_BASIS = 400, 5  # of the nominal path that the primitive is trained on, at least
_NUMBERS_OF_BASIS = (40, 80, 160)  # that "auto" tries
_CLOSE_ENOUGH = 1e-4, 0.002  # [m], or of the motion's extent: root mean square from the nominal path to the primitive


class Skill:
    """A motion learned from demonstrations (thesis Chapter 5: GMM, then GMR, then DMP).

    A :class:`~imitarm.skills.gmr.GMR` learns the mean motion and its covariance, which shows how much the
    demonstrations differ at each time. A :class:`~imitarm.skills.dmp.DMP` is fitted to the nominal path (the mean
    motion with exact start and goal). The DMP can change the start, the goal and the duration of the motion. The
    covariance serves as a tolerance, because the robot must be precise where the person was precise. A skill does not
    depend on obstacles; policies avoid obstacles.

    The nominal path and the primitive start and end exactly at the means of the demonstrated starts and goals.

    Args:
        n_components: number of Gaussians, or ``"auto"`` (see GMR).
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.dynamical_systems.Gains` (see DMP).
        n_basis: number of basis functions of the primitive. ``"auto"`` chooses the smallest of 40, 80 and 160 with a
            small error. The root mean square distance between the primitive and the nominal path must be below 0.1 mm
            or 0.2 % of the motion's extent.
        random_state: seed of all random choices in learning.

    Attributes:
        gmr_: mean and covariance over time.
        dmp_: the movement primitive.
        task_: name of the demonstrated task, for example ``"sweep"``.
        duration_: learned duration [s].
        start_: learned start, tool_to_base; its rotation is the identity when no rotation was learned.
        goal_: learned goal, tool_to_base.
        n_demonstrations_: number of demonstrations.
        fit_quality_: distances between the skill's motion and each demonstration, and whether the skill reproduces the
            demonstrations. None if the skill was read from a file without these measures.
        provenance_: origin of the skill: ``"imitarm"`` (version that learned it), ``"sources"`` (one per
            demonstration), ``"notes"`` (for example findings of lint), and ``"date"`` if a date was given.

    Raises:
        InputError: when an option is out of range.
    """

    gmr_: GMR
    dmp_: DMP
    task_: str
    n_demonstrations_: int
    fit_quality_: FitQuality | None
    provenance_: dict[str, Any]

    def __init__(
        self,
        n_components: int | Literal["auto"] = "auto",
        *,
        gains: str | Gains = "critical",
        n_basis: int | Literal["auto"] = "auto",
        random_state: int = 0,
    ) -> None:
        self._gmr = GMR(n_components, random_state=random_state)
        if isinstance(n_basis, str):
            choice(n_basis, ("auto",), "n_basis of Skill (a whole number or a name)")
        numbers = _NUMBERS_OF_BASIS if isinstance(n_basis, str) else (n_basis,)
        self._primitives = [DMP(gains, n_basis=n) for n in numbers]

    def fit(
        self, demonstrations: Sequence[Demonstration], *, notes: Sequence[str] = (), date: str | None = None
    ) -> Self:
        """Learn from demonstrations, which should be aligned first (``imitarm.demonstrations.align``).

        Args:
            demonstrations: at least one demonstration; three or more show how much the demonstrations vary.
            notes: texts that are saved with the skill, for example the findings of ``lint``.
            date: date of learning; None: the file contains no date, so that the same input gives the same file.

        Raises:
            InputError: for the same reasons as :meth:`GMR.fit` and :meth:`DMP.fit`.

        Warns:
            PoorFitWarning: when the skill does not reproduce the motion, see ``fit_quality_``.
        """
        notes = sequence(notes, str, "Skill.fit: notes")
        provenance: dict[str, Any] = {"imitarm": imitarm.__version__, "sources": [], "notes": list(notes)}
        if date is not None:
            provenance["date"] = text(date, "Skill.fit: date")
        gmr = self._gmr.fit(demonstrations)
        shown = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
        provenance["sources"] = [d.source if isinstance(d, Demonstration) else "" for d in demonstrations]
        tasks = dict.fromkeys(d.task for d in demonstrations if isinstance(d, Demonstration) and d.task)
        dmp = self._primitive(gmr)
        quality = evaluate_fit(gmr, dmp, shown, provenance["sources"])
        self._take(gmr, dmp, " + ".join(tasks), provenance, quality)
        if not quality.faithful:
            warnings.warn(f"Skill.fit: {quality.problem}", PoorFitWarning, stacklevel=2)
        return self

    def _primitive(self, gmr: GMR) -> DMP:
        """Train primitives on the nominal path; return the smallest that follows it, or the largest if none does."""
        for dmp in self._primitives:
            nominal = gmr.trajectory(max(_SAMPLES, _SAMPLES_PER_BASIS * dmp.n_basis))
            dmp.fit(nominal, exact_ends=True)
            if dmp is self._primitives[-1]:
                break
            done = dmp.generate(dt=nominal.duration / (len(nominal) - 1)).positions
            error = np.sqrt(np.mean(np.sum((done - nominal.positions) ** 2, axis=1)))
            extent = np.linalg.norm(np.ptp(nominal.positions, axis=0))
            if error <= max(_CLOSE_ENOUGH[0], _CLOSE_ENOUGH[1] * extent):
                break
        return dmp

    def _take(self, gmr: GMR, dmp: DMP, task: str, provenance: Mapping[str, Any], quality: FitQuality | None) -> None:
        self.gmr_, self.dmp_, self.task_, self.provenance_ = gmr, dmp, task, dict(provenance)
        self.n_demonstrations_, self.fit_quality_ = gmr.n_demonstrations_, quality

    def __repr__(self) -> str:
        if not hasattr(self, "gmr_"):
            return "Skill(not fitted)"
        return (
            f"Skill({self.task_ or 'unnamed'!r}, {self.n_demonstrations_} demonstrations, {self.duration_:.3g} s, "
            f"{self.gmr_.n_components_} components, {'with' if self.gmr_.has_orientation_ else 'without'} orientation)"
        )

    def _repr_html_(self) -> str:
        if not hasattr(self, "gmr_"):
            return html_table("Skill", {"fitted": "no"})
        quality = self.fit_quality_
        bias = problem = ""
        if quality is not None:
            bias = f"{1e3 * quality.bias:.2g} mm ({100.0 * quality.relative_bias:.2g} % of the motion's extent)"
            problem = quality.problem
        rows = {
            "task": self.task_,
            "demonstrations": self.n_demonstrations_,
            "duration": f"{self.duration_:.4g} s",
            "components": self.gmr_.n_components_,
            "orientation": "learned" if self.gmr_.has_orientation_ else "not in the demonstrations",
            "bias": bias,
            "problem": problem,
        }
        return html_table("Skill", rows)

    def _fitted(self) -> DMP:
        if not hasattr(self, "dmp_"):
            raise InputError("Skill: not learned yet; call fit, or Skill.load")
        return self.dmp_

    @property
    def duration_(self) -> float:
        """Learned duration [s]."""
        return self._fitted().duration_

    @property
    def start_(self) -> Pose:
        """Learned start, tool_to_base."""
        dmp = self._fitted()
        return _pose(dmp.start_, None if dmp.orientation_ is None else dmp.orientation_.start_)

    @property
    def goal_(self) -> Pose:
        """Learned goal, tool_to_base."""
        dmp = self._fitted()
        return _pose(dmp.goal_, None if dmp.orientation_ is None else dmp.orientation_.goal_)

    def nominal(
        self, times: ArrayLike, start: Pose | ArrayLike | None = None, goal: Pose | ArrayLike | None = None
    ) -> Trajectory:
        r"""Return the nominal path, which policies reproduce, at ``times``.

        The path starts and ends exactly at ``start`` and ``goal``, for any number of samples. The learned path is
        :meth:`~imitarm.skills.gmr.GMR.nominal`. Another start or goal changes the path in the same way as the
        adjustment ``"progress"`` of the movement primitive:

        .. math:: x(t) = \bar x(t) + (1 - p(t)) \delta_{start} + p(t) \delta_{goal}

        Here, :math:`\bar x` is the learned path, p is the fraction of the path that has been travelled, and
        :math:`\delta_{start}` and :math:`\delta_{goal}` are the changes of start and goal. The rotation changes along a
        minimum-jerk profile.

        Args:
            times: strictly increasing times from 0 to the learned duration, shape (n,) [s].
            start: a Pose, or a position (3,) [m] with the learned start rotation; None: the learned start.
            goal: a Pose, or a position (3,) [m] with the learned goal rotation; None: the learned goal.

        Raises:
            InputError: when not fitted, or a start, a goal or a time is not valid.
        """
        state = self._fitted().begin(start, goal)
        t = finite_array(times, (None,), "Skill.nominal: times", "s")
        positions, quaternions = self.gmr_.nominal(t)
        moved = np.stack([state.target.start - self.dmp_.start_, state.target.goal - self.dmp_.goal_])
        if moved.any():
            p = self.dmp_.progress(t)
            positions = positions + np.stack([1.0 - p, p], axis=1) @ moved
        if quaternions is not None and state.rotation is not None:
            changes = state.rotation.start_change, state.rotation.goal_change
            quaternions = with_other_ends(quaternions, t / self.duration_, *changes)
        return Trajectory(t, positions, quaternions)

    def generate(
        self,
        start: Pose | ArrayLike | None = None,
        goal: Pose | ArrayLike | None = None,
        duration: float | None = None,
        dt: float = 0.01,
        *,
        adjustment: Adjustment = "progress",
    ) -> Trajectory:
        """Return the primitive's motion, ``round(duration / dt) + 1`` samples, with the rotation if one was learned.

        Args:
            start: a Pose, or a position (3,) [m] with the learned start rotation; None: the learned start.
            goal: a Pose, or a position (3,) [m] with the learned goal rotation; None: the learned goal.
            duration: duration of the motion [s]; None: the learned duration.
            dt: length of a step [s], adjusted so that a whole number of steps fills the duration.
            adjustment: name of the method that changes the motion for another start or goal (see
                :class:`~imitarm.skills.dmp.DMP`).

        Raises:
            InputError: when not fitted, or an argument is out of range.
        """
        return self._fitted().generate(start, goal, duration, dt, adjustment=adjustment)

    def tolerance(self, times: ArrayLike, duration: float | None = None) -> Array:
        """Return how much the demonstrated positions differ at ``times`` (n,) [s]: covariances (n, 3, 3) [m^2].

        Args:
            times: times since the start of a motion that lasts ``duration``, shape (n,) [s].
            duration: duration of the motion [s]; None: the learned duration.

        Raises:
            InputError: when not fitted, or an argument is not valid.
        """
        T = self.duration_
        t = finite_numbers(times, "Skill.tolerance: times", "s")
        if duration is not None:
            t = t * (T / finite_number(duration, "Skill.tolerance: duration", "s", above=0.0))
        return self.gmr_.predict(t)[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a skill file in JSON (:mod:`imitarm.skills.skill_file`).

        Args:
            path: file to write; an existing file is replaced.

        Raises:
            InputError: when not learned yet, or the file can't be written.
        """
        dmp = self._fitted()
        write_skill(
            file_path(path, "Skill.save: path"), self.task_, self.provenance_, self.gmr_, dmp, self.fit_quality_
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Skill:
        """Read a skill file.

        Args:
            path: path of the file.

        Raises:
            InputError: when there is no such file or it can't be read.
            FileFormatError: when the file is not a skill file, was cut or altered, or has a newer version.
        """
        document = read_skill(file_path(path, "Skill.load: path"))
        provenance = {k: v for k, v in msgspec.to_builtins(document.provenance).items() if v is not None}
        try:
            gmr, dmp = gmr_of(document.gmr), dmp_of(document.dmp)
            if gmr.has_orientation_ != (dmp.orientation_ is not None):
                raise InputError(
                    "only one of gmr and dmp has learned the rotation, so they do not match; learn the skill again"
                )
            quality = None
            if document.fit is not None:
                quality = fit_of(document.fit, document.provenance.sources, gmr.n_components_)
        except InputError as error:
            raise FileFormatError(f"{os.fspath(path)}: {error}") from error
        if document.gmr.ends is None:  # version 1: the nominal path ends where the primitive does
            gmr.ends_ = _ends_of(dmp, gmr)
        skill = cls(gmr.n_components_, gains=dmp.gains_, n_basis=dmp.n_basis)
        skill._take(gmr, dmp, document.task, provenance, quality)
        return skill


def _pose(position: Array, quaternion: Array | None) -> Pose:
    return Pose(position, np.array([1.0, 0.0, 0.0, 0.0]) if quaternion is None else quaternion)


def _ends_of(dmp: DMP, gmr: GMR) -> Array:
    """Return start and goal of a primitive as two rows, with the same columns as the data of ``gmr``, shape (2, D)."""
    ends = np.stack([dmp.start_, dmp.goal_])
    if gmr.reference_ is None or dmp.orientation_ is None:
        return ends
    quaternions = np.stack([dmp.orientation_.start_, dmp.orientation_.goal_])
    return np.hstack([ends, gmr.reference_.to_vectors([0.0, gmr.duration_], quaternions)])
