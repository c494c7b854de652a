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
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import Adjustment, Gains
from imitarm.skills.gmr import GMR
from imitarm.skills.quaternion_dmp import with_other_ends
from imitarm.skills.skill_content import dmp_content, gmr_content, read_dmp, read_gmr
from imitarm.skills.skill_file import read_skill, write_skill
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
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.dynamical_systems.Gains` (see DMP).
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
        self._take(gmr, self._dmp.fit(gmr.trajectory(_SAMPLES), exact_ends=True), " + ".join(tasks), provenance)
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

    def nominal(
        self, times: ArrayLike, start: Pose | ArrayLike | None = None, goal: Pose | ArrayLike | None = None
    ) -> Trajectory:
        r"""Return the nominal path, which policies reproduce, at ``times`` [s] of the learned duration.

        It starts and ends exactly at ``start`` and ``goal``, for any number of samples. The learned path is
        :meth:`~imitarm.skills.gmr.GMR.nominal`. Other ends change it as in the primitive's adjustment ``"progress"``:

        .. math:: x(t) = x_0(t) + (1 - p(t)) \delta_{start} + p(t) \delta_{goal}

        with p the fraction of the path that is done. The rotation changes likewise, along a minimum-jerk profile.

        Args:
            times: strictly increasing, from 0 to the learned duration, shape (n,) [s].
            start: a Pose, or a position (3,) [m] with the learned rotation; None: as learned.
            goal: likewise.

        Raises:
            InputError: when not fitted, or a start, a goal or a time is not valid.
        """
        state = self._fitted().begin(start, goal)
        t = np.asarray(times, dtype=float)
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
                "gmr": gmr_content(self.gmr_),
                "dmp": dmp_content(self.dmp_),
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
            gmr, dmp = read_gmr(fields.group("gmr")), read_dmp(fields.group("dmp"))
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
            if not fields.group("gmr").has("ends"):  # a file of before: the primitive's ends are the nominal path's
                gmr.ends_ = _ends_of(dmp, gmr)
        except FileFormatError:
            raise
        except InputError as error:
            raise FileFormatError(f"{os.fspath(path)}: {error}") from error
        skill = cls(gmr.n_components_, gains=dmp.gains_, n_basis=dmp.n_basis)
        skill._take(gmr, dmp, task, origin)
        return skill


def _pose(position: Array, quaternion: Array | None) -> Pose:
    return Pose(position, np.array([1.0, 0.0, 0.0, 0.0]) if quaternion is None else quaternion)


def _ends_of(dmp: DMP, gmr: GMR) -> Array:
    """Return start and goal of a primitive in the columns of a regression, shape (2, D)."""
    ends = np.stack([dmp.start_, dmp.goal_])
    if gmr.reference_ is None or dmp.orientation_ is None:
        return ends
    quaternions = np.stack([dmp.orientation_.start_, dmp.orientation_.goal_])
    return np.hstack([ends, gmr.reference_.to_vectors([0.0, gmr.duration_], quaternions)])
