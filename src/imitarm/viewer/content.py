"""The content of a report: the results of runs, and numbers that are computed from these results.

:mod:`~imitarm.viewer.report` draws a page from this content.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations import Alignment, Finding
from imitarm.errors import InputError
from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Rollout, Trajectory
from imitarm.viewer.recording import Recording

CERTIFICATE_VOID = (
    "an obstacle moves, so the certificate requires that the motion stays on schedule; the motion did not finish"
)

Array = NDArray[np.float64]


@runtime_checkable
class AdaptedPath(Protocol):
    """An adapted path with all attributes that the report draws, such as :class:`imitarm.policies.Adaptation`."""

    @property
    def nominal(self) -> Trajectory:
        """The learned path."""

    @property
    def trajectory(self) -> Trajectory:
        """The adapted path, around the obstacles."""

    @property
    def means(self) -> Array:
        """Centres of the components before they were moved, shape (n_components, 3) [m]."""

    @property
    def covariances(self) -> Array:
        """Position covariances of the components, shape (n_components, 3, 3) [m^2]."""

    @property
    def displacement(self) -> Array:
        """Displacement of each component's mean, shape (n_components, 3) [m]."""

    @property
    def moved(self) -> NDArray[np.bool_]:
        """Which components were moved, shape (n_components,)."""

    @property
    def tolerance(self) -> Array:
        """Covariance of the demonstrations along the path, shape (n, 3, 3) [m^2]."""

    @property
    def certified_clearance(self) -> float:
        """Guaranteed lower bound of the tool's clearance on the whole planned path [m]."""

    @property
    def only_on_schedule(self) -> bool:
        """Whether an obstacle moves, so that the certified clearance holds only while the motion is on schedule."""

    @property
    def feasible(self) -> bool:
        """Whether the certified clearance is at least the required clearance."""

    @property
    def method(self) -> str:
        """Name of the method that adapted the path."""

    @property
    def compute_time(self) -> float:
        """Computing time of the adaptation [s]."""


@dataclass(frozen=True, eq=False)
class SceneResult:
    """The results in one scene: the planned path and the measured motion of the robot.

    Attributes:
        name: short name for links, unique in the report.
        title: title as shown to the reader.
        scene: goal and obstacles.
        success: whether the task succeeded.
        required_clearance: distance that the robot must keep from every obstacle [m].
        rollout: the measured motion; None when the robot did not start.
        adaptation: the planned path; None when the path was not adapted.
        nominal: the learned path, drawn when there is no ``adaptation``; None: not drawn.
        rmse: root mean square distance from the measured path to the demonstrations [m]; NaN when unknown.
        reason: explanation of why the run ended.
        tool_radius: radius of the sphere that contained the tool in the plan [m].
        tool_spheres: spheres that contained the tool in the plan, as rows of x, y, z and radius in the tool frame,
            shape (m, 4) [m]. None: one sphere with ``tool_radius``.
        recording: recorded poses of all bodies, for the 3-D playback.
        torque_limits: rated torques, shape (n_joints,) [N m].
        joint_names: joint names, used as titles of the torque charts.
        caption: one sentence that describes the scene.
        details: further measured values of the task; each name becomes a column of the table of results.

    Raises:
        InputError: when ``name`` is empty.
    """

    name: str
    title: str
    scene: Scene
    success: bool
    required_clearance: float
    rollout: Rollout | None = None
    adaptation: AdaptedPath | None = None
    rmse: float = math.nan
    reason: str = ""
    tool_radius: float = 0.0
    tool_spheres: Array | None = None
    recording: Recording | None = None
    torque_limits: Array | None = None
    joint_names: tuple[str, ...] = ()
    caption: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)
    nominal: Trajectory | None = None

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise InputError(f"SceneResult {self.title!r}: the name is empty; give the scene a name")

    @property
    def tool(self) -> Array:
        """Spheres that covered the tool in the plan: rows of x, y, z, radius in the tool frame, shape (m, 4) [m]."""
        if self.tool_spheres is None:
            return np.array([[0.0, 0.0, 0.0, self.tool_radius]])
        return np.asarray(self.tool_spheres, dtype=float).reshape(-1, 4)

    @property
    def min_clearance(self) -> float:
        """Smallest measured clearance [m]: inf without obstacles, NaN when the robot did not start."""
        return math.nan if self.rollout is None else self.rollout.min_clearance

    @property
    def certificate_void(self) -> bool:
        """Whether the certified clearance is void: an obstacle moves, and the motion did not finish on schedule."""
        return self.adaptation is not None and self.adaptation.only_on_schedule and not self.success

    @property
    def contact(self) -> bool:
        """Whether the arm or its tool touched an obstacle."""
        return self.min_clearance <= 0.0

    @property
    def unmoved_fraction(self) -> float:
        """Fraction of the Gaussian components that were not moved; NaN without an adaptation."""
        return math.nan if self.adaptation is None else float(1.0 - np.mean(self.adaptation.moved))

    @property
    def peak_torque_ratio(self) -> float:
        """Highest measured torque divided by the rated torque of its joint; NaN when unknown."""
        if self.rollout is None or self.torque_limits is None:
            return math.nan
        return float(np.max(np.abs(self.rollout.torques) / np.asarray(self.torque_limits, dtype=float)))


class Candidate(Protocol):
    """Criteria of one number of components, as in :class:`imitarm.skills.mixture_fitting.Candidate`."""

    @property
    def n_components(self) -> int:
        """Number of components K."""

    @property
    def bic(self) -> float:
        """Bayesian information criterion."""

    @property
    def aic(self) -> float:
        """Akaike information criterion."""

    @property
    def held_out_rmse_mm(self) -> float:
        """Error on demonstrations that were held out of learning [mm]; NaN if no demonstration was held out."""


@dataclass(frozen=True, eq=False)
class LearningSummary:
    """The demonstrations and the result of learning.

    Attributes:
        demonstrations: checked and aligned demonstrations, as used for learning.
        means: means of the Gaussian components' positions, shape (n_components, 3) [m].
        covariances: covariances of the Gaussian components' positions, shape (n_components, 3, 3) [m^2].
        predicted: the learned path.
        candidates: criteria of the numbers of components that were compared.
        findings: findings of ``lint`` about the recordings.
        alignment: result of ``align``; None when the demonstrations were not aligned.
        details: further facts about learning, by name.
    """

    demonstrations: Sequence[Demonstration]
    means: Array
    covariances: Array
    predicted: Trajectory | None = None
    candidates: Sequence[Candidate] = ()
    findings: Sequence[Finding] = ()
    alignment: Alignment | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n_components(self) -> int:
        """Number of Gaussian components that were learned."""
        return len(self.means)


@dataclass(frozen=True, eq=False)
class Report:
    """The content of a report page about one run of a command.

    Attributes:
        title: title of the page.
        scenes: results, in the order in which they are shown; names must be unique.
        summary: one or two sentences that introduce the page.
        learning: demonstrations and result of learning.
        provenance: facts that are needed to repeat the run, such as command, seed, platform and versions, by name. A
            value that is a mapping becomes a separate table.

    Raises:
        InputError: when two scenes have the same name.
    """

    title: str
    scenes: Sequence[SceneResult]
    summary: str = ""
    learning: LearningSummary | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [scene.name for scene in self.scenes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"Report: the scene name {twice[0]!r} is used twice; give each scene a different name")

    @property
    def passed(self) -> bool:
        """Whether every scene succeeded without contact."""
        return all(scene.success and not scene.contact for scene in self.scenes)

    @property
    def min_clearance(self) -> float:
        """Smallest measured clearance of all scenes [m]; inf without obstacles."""
        return min((s.min_clearance for s in self.scenes if not math.isnan(s.min_clearance)), default=math.inf)

    @property
    def verdict(self) -> str:
        """The result of all scenes in one line."""
        if not self.scenes:
            return "no scene was run"
        obstructed = [scene for scene in self.scenes if scene.scene.obstacles]
        done = sum(scene.success for scene in self.scenes)
        if not obstructed:
            return f"{done} of {len(self.scenes)} scenes completed"
        clear = sum(scene.rollout is not None and not scene.contact for scene in obstructed)
        parts = [f"no contact in {clear} of {len(obstructed)} scenes with obstacles"]
        if math.isfinite(self.min_clearance):
            parts.append(f"smallest clearance {1000.0 * self.min_clearance:.1f} mm")
        if done < len(self.scenes):
            parts.append(f"{len(self.scenes) - done} not completed")
        return "; ".join(parts)


def as_data(report: Report) -> dict[str, Any]:
    """Return the report's numbers in SI units as Python objects for JSON; unknown numbers become None."""
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
                "required_clearance_m": scene.required_clearance,
                "min_clearance_m": scene.min_clearance,
                "certified_clearance_m": adaptation.certified_clearance
                if adaptation and not scene.certificate_void
                else None,
                "rmse_to_demonstrations_m": scene.rmse,
                "n_components": len(adaptation.moved) if adaptation else None,
                "n_moved_components": int(np.sum(adaptation.moved)) if adaptation else None,
                "unmoved_fraction": scene.unmoved_fraction,
                "adaptation_method": adaptation.method if adaptation else None,
                "adaptation_time_s": adaptation.compute_time if adaptation else None,
                "motion_duration_s": scene.rollout.trajectory.duration if scene.rollout else None,
                "peak_torque_ratio": scene.peak_torque_ratio,
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
    """Return ``value`` for JSON: NumPy values become plain Python values; NaN and infinity become None."""
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
