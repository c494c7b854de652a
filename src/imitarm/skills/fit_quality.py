"""How well a skill fits its demonstrations: the distance to each demonstration, and the bias of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.skills.dmp import DMP
from imitarm.skills.gmr import GMR
from imitarm.skills.path_length import relative_length
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

LARGEST_BIAS = 0.05  # of the motion's extent: a skill with a larger bias does not reproduce the motion
LEAST_LENGTH = 0.8  # of the length of the average motion: a skill with a shorter path has lost bends
_NO_BIAS = 0.0005, float(np.deg2rad(1.0))  # [m], [rad] a bias that is never too large: motions that hardly move
_ROUNDING = 1e-9  # [m]
_FEWEST, _MOST = 200, 2000  # times at which a fit is compared
_REPEATS = 0.1  # of the difference between unrelated positions: a motion repeats when it differs less a period later


class PoorFitWarning(UserWarning):
    """A skill does not reproduce the motion of its demonstrations; ``Skill.fit_quality_`` has the measures."""


@dataclass(frozen=True)
class DemonstrationDistance:
    """Distance between a skill's nominal path (the mean of its regression) and one demonstration at equal times.

    Attributes:
        source: source of the demonstration, for example a file name.
        rms: root mean square of the distance over the samples of the demonstration [m].
        largest: largest distance [m].
        start: distance at the first sample of the demonstration [m].
        goal: distance at the last sample of the demonstration [m].
    """

    source: str
    rms: float
    largest: float
    start: float
    goal: float


@dataclass(frozen=True)
class FitQuality:
    """Measures of how well a skill fits its demonstrations.

    The bias is the root mean square distance between the skill and the average of the demonstrations at the same times.
    Differences between demonstrations do not count as bias; the skill uses them as its tolerance. A skill is not
    :attr:`faithful` if its bias exceeds 5 % of the motion's extent. It is also not faithful if its path is much shorter
    than the average motion, because bends of the motion are then missing.

    Attributes:
        distances: distances of the nominal path to each demonstration.
        n_components: number of Gaussian components of the skill.
        extent: diagonal of the box that contains the average motion [m].
        bias: bias of the nominal path, which is the mean path of the regression [m].
        primitive_bias: bias of the movement primitive's path [m].
        rotation_extent: largest angle between the average rotation and its start [rad]; 0 without rotations.
        rotation_bias: bias of the nominal rotation [rad]; 0 without rotations.
        period: time after which the motion repeats [s]; None when it repeats less than three times.
        length: length of the nominal path, divided by the length of the average motion. Both lengths ignore bends
            smaller than 2 % of the extent.
    """

    distances: tuple[DemonstrationDistance, ...]
    n_components: int
    extent: float
    bias: float
    primitive_bias: float
    rotation_extent: float = 0.0
    rotation_bias: float = 0.0
    period: float | None = None
    length: float = 1.0

    @property
    def relative_bias(self) -> float:
        """The larger of ``bias`` and ``primitive_bias``, as a fraction of the motion's extent."""
        largest = max(self.bias, self.primitive_bias)
        if largest <= _ROUNDING:
            return 0.0
        return largest / self.extent if self.extent > 0.0 else float(np.inf)

    @property
    def faithful(self) -> bool:
        """Whether every bias is at most 5 % of the motion's extent, and the path at least 80 % as long as the motion.

        Biases up to 0.5 mm and 1 degree always pass.
        """
        return not self.problem

    @property
    def problem(self) -> str:
        """The problem of the fit and its remedy; empty when the skill is faithful."""
        texts: list[str] = []
        allowed = max(LARGEST_BIAS * self.extent, _NO_BIAS[0])
        for name, bias in (("nominal path", self.bias), ("movement primitive", self.primitive_bias)):
            if bias > allowed and not texts:
                texts.append(
                    f"the {name} is {1e3 * bias:.1f} mm (root mean square) from the average of the demonstrations, "
                    f"{self._percent(bias, self.extent)} of the motion's extent"
                )
        if self.length < LEAST_LENGTH and self.bias > _NO_BIAS[0] and not texts:
            texts.append(
                f"the nominal path has lost bends of the motion: it is {100.0 * self.length:.0f} % as long as the "
                f"average demonstration (required: at least {100 * LEAST_LENGTH:g} %)"
            )
        if self.rotation_bias > max(LARGEST_BIAS * self.rotation_extent, _NO_BIAS[1]):
            texts.append(
                f"the rotation is {np.rad2deg(self.rotation_bias):.1f} degrees (root mean square) from the average of "
                f"the demonstrations, {self._percent(self.rotation_bias, self.rotation_extent)} of the rotation's "
                "extent"
            )
        if not texts:
            return ""
        remedy = f"use more than {self.n_components} components, or cut long recordings into shorter motions"
        if self.period is not None:
            remedy += f"; {self.suggestion}"
        limit = f" (at most {100 * LARGEST_BIAS:g} %)" if "root mean square" in texts[-1] else ""
        return f"{' and '.join(texts)}{limit}: {remedy}"

    @property
    def suggestion(self) -> str:
        """A hint for a motion that repeats; empty for other motions."""
        if self.period is None:
            return ""
        return (
            f"the motion repeats every {self.period:.3g} s: one period can be learned as a rhythmic primitive "
            f"(imitarm.skills.RhythmicDMP().fit(trajectory, period={self.period:.3g}))"
        )

    @staticmethod
    def _percent(bias: float, extent: float) -> str:
        return f"{100.0 * bias / extent:.0f} %" if extent > 0.0 else "all"


def evaluate_fit(gmr: GMR, dmp: DMP, trajectories: Sequence[Trajectory], sources: Sequence[str]) -> FitQuality:
    """Compare a regression and a primitive with the demonstrations that they were learned from.

    Args:
        gmr: regression fitted to the demonstrations.
        dmp: primitive fitted to the nominal path of ``gmr``.
        trajectories: the demonstrations; their times are scaled to the duration of ``gmr``.
        sources: source of each demonstration, for example a file name.
    """
    T = gmr.duration_
    distances = []
    for trajectory, source in zip(trajectories, sources, strict=True):
        times = (trajectory.times - trajectory.times[0]) * (T / trajectory.duration)
        d = np.linalg.norm(gmr.nominal(times)[0] - trajectory.positions, axis=1)
        rms = float(np.sqrt(np.mean(d * d)))
        distances.append(DemonstrationDistance(source, rms, float(d.max()), float(d[0]), float(d[-1])))
    n = int(np.clip(max(len(k) for k in trajectories), _FEWEST, _MOST))
    grid = np.linspace(0.0, T, n)
    shown = [k.at(k.times[0] + grid * (k.duration / T)) for k in trajectories]
    average = np.mean([positions for positions, _ in shown], axis=0)
    nominal, quaternions = gmr.nominal(grid)
    primitive = dmp.generate(dt=T / (n - 1)).positions
    rotation_extent = rotation_bias = 0.0
    if gmr.reference_ is not None and quaternions is not None:
        vectors = np.mean([gmr.reference_.to_vectors(grid, q) for _, q in shown if q is not None], axis=0)
        rotation_bias = _rms(gmr.reference_.to_vectors(grid, quaternions) - vectors)
        q = gmr.reference_.to_quaternions(grid, vectors)
        angles = np.linalg.norm(quaternion_log(quaternion_multiply(q, quaternion_conjugate(q[:1]))), axis=1)
        rotation_extent = float(angles.max())
    extent = float(np.linalg.norm(np.ptp(average, axis=0)))
    return FitQuality(
        tuple(distances),
        gmr.n_components_,
        extent,
        _rms(nominal - average),
        _rms(primitive - average),
        rotation_extent,
        rotation_bias,
        _period(grid, average),
        relative_length(nominal, average),
    )


def _rms(differences: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


def _period(times: Array, positions: Array) -> float | None:
    """Return the period [s] of a motion, ignoring a constant drift; None when it repeats less than three times.

    For each lag, the function computes the mean squared difference between the motion and the motion one lag later. The
    reference is the mean squared difference between independent positions. The period is the first local minimum below
    10 % of the reference, provided that the difference exceeded 50 % of the reference at a shorter lag.
    """
    n = len(times)
    drift = np.linspace(0.0, 1.0, n)[:, None] * (positions[-1] - positions[0])
    x = positions - positions[0] - drift
    scale = 2.0 * float(np.sum(x.var(axis=0)))
    if scale <= 1e-12:
        return None
    difference = np.array([np.mean(np.sum((x[lag:] - x[:-lag]) ** 2, axis=1)) for lag in range(1, n // 3 + 1)]) / scale
    far = np.flatnonzero(difference > 0.5)
    if not len(far):
        return None
    near = [
        i
        for i in range(int(far[0]) + 1, len(difference) - 1)
        if difference[i] < _REPEATS and difference[i] <= min(difference[i - 1], difference[i + 1])
    ]
    return float((near[0] + 1) * (times[1] - times[0])) if near else None
