"""What a report says: plain, frozen results, and the numbers that follow from them.

These nouns know nothing of pages. :mod:`~imitarm.viewer.report` turns them into one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations import Alignment, Finding
from imitarm.errors import InputError
from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Rollout, Trajectory
from imitarm.viewer.recording import Recording

Array = NDArray[np.float64]


class AdaptedPath(Protocol):
    """What is drawn of an adaptation: :class:`imitarm.policies.Adaptation` has all of it."""

    @property
    def nominal(self) -> Trajectory:
        """The learnt path."""

    @property
    def trajectory(self) -> Trajectory:
        """The path around the obstacles."""

    @property
    def means(self) -> Array:
        """Centres of the components before they moved, shape (n_components, 3) [m]."""

    @property
    def covariances(self) -> Array:
        """Of the components' positions, shape (n_components, 3, 3) [m^2]."""

    @property
    def displacement(self) -> Array:
        """Of each component, shape (n_components, 3) [m]."""

    @property
    def moved(self) -> NDArray[np.bool_]:
        """Which components were displaced, shape (n_components,)."""

    @property
    def tolerance(self) -> Array:
        """Covariance of the demonstrations along the path, shape (n, 3, 3) [m^2]."""

    @property
    def certified_clearance(self) -> float:
        """Proven clearance of the planned path of the tool [m]."""

    @property
    def feasible(self) -> bool:
        """Whether the asked clearance was reached."""

    @property
    def method(self) -> str:
        """How it was found."""

    @property
    def compute_time(self) -> float:
        """How long that took [s]."""


@dataclass(frozen=True, eq=False)
class SceneResult:
    """One scene: what was planned in it and what the robot did.

    Attributes:
        name: short and unique in the report, used in links.
        title: what people read.
        scene: goal and obstacles.
        success: whether the task was done as it should be.
        asked_clearance: distance to every obstacle that was asked for [m].
        rollout: what the robot did and what was measured; None when it was not sent off.
        adaptation: the planned path; None when nothing was adapted.
        rmse: root mean square distance of the measured path to the demonstrations [m]; nan when not known.
        reason: why it ended as it did, in words.
        tool_radius: radius of the sphere that held the tool in the plan [m].
        tool_spheres: instead of one radius, rows of x, y, z, radius in the tool's frame, shape (m, 4) [m].
        recording: for the 3-D playback.
        torque_limits: rated torques, shape (n_joints,) [N m].
        joint_names: names for the charts of the torques.
        caption: a sentence about what is to be seen.
        details: anything more the task measured: one column in the table for each name.

    Raises:
        InputError: when the name is empty.
    """

    name: str
    title: str
    scene: Scene
    success: bool
    asked_clearance: float
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

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise InputError(f"SceneResult {self.title!r}: needs a name that is not empty")

    @property
    def tool(self) -> Array:
        """Spheres that held the tool in the plan: rows of x, y, z, radius in the tool's frame, shape (m, 4) [m]."""
        if self.tool_spheres is None:
            return np.array([[0.0, 0.0, 0.0, self.tool_radius]])
        return np.asarray(self.tool_spheres, dtype=float).reshape(-1, 4)

    @property
    def min_clearance(self) -> float:
        """Smallest measured clearance [m]: inf without obstacles, nan when the robot was not sent off."""
        return math.nan if self.rollout is None else self.rollout.min_clearance

    @property
    def contact(self) -> bool:
        """Whether something was touched."""
        return self.min_clearance <= 0.0

    @property
    def unmoved_share(self) -> float:
        """Share of the Gaussian components that stayed where they were learnt; nan without an adaptation."""
        return math.nan if self.adaptation is None else float(1.0 - np.mean(self.adaptation.moved))

    @property
    def peak_torque_share(self) -> float:
        """Greatest measured torque as a share of its joint's rated torque; nan when not known."""
        if self.rollout is None or self.torque_limits is None:
            return math.nan
        return float(np.max(np.abs(self.rollout.torques) / np.asarray(self.torque_limits, dtype=float)))


class Candidate(Protocol):
    """A number of components that was tried: :class:`imitarm.skills.mixture_fitting.Candidate`."""

    @property
    def n_components(self) -> int:
        """The number K."""

    @property
    def bic(self) -> float:
        """Bayesian information criterion."""

    @property
    def aic(self) -> float:
        """Akaike information criterion."""

    @property
    def held_out_rmse_mm(self) -> float:
        """Error on left-out demonstrations [mm]; nan when there was none to leave out."""


@dataclass(frozen=True, eq=False)
class LearningSummary:
    """What was shown and what was learnt from it.

    Attributes:
        demonstrations: as they were learnt from (checked and aligned).
        means: of the Gaussian components' positions, shape (n_components, 3) [m].
        covariances: of the Gaussian components' positions, shape (n_components, 3, 3) [m^2].
        predicted: the learnt path.
        candidates: numbers of components that were tried.
        findings: what lint said about the recordings.
        alignment: what align changed; None when it was not used.
        details: anything more to state, by name.
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
        """How many Gaussian components were learnt."""
        return len(self.means)


@dataclass(frozen=True, eq=False)
class Report:
    """Everything that one run has to tell.

    Attributes:
        title: of the page.
        scenes: results, in the order in which they are shown; names must be unique.
        summary: a sentence or two on what this is about.
        learning: what was shown and learnt.
        provenance: what is needed to do it again (command, seed, platform, versions, ...), by name; values that are
            mappings become tables of their own.

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
            raise InputError(f"Report: the scene name {twice[0]!r} is used twice; give every scene its own")

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
        """The result in one line."""
        if not self.scenes:
            return "no scene was tried"
        obstructed = [scene for scene in self.scenes if scene.scene.obstacles]
        done = sum(scene.success for scene in self.scenes)
        if not obstructed:
            return f"{done} of {len(self.scenes)} scenes done"
        clear = sum(scene.rollout is not None and not scene.contact for scene in obstructed)
        parts = [f"{clear} of {len(obstructed)} scenes with obstacles without contact"]
        if math.isfinite(self.min_clearance):
            parts.append(f"smallest clearance {1000.0 * self.min_clearance:.1f} mm")
        if done < len(self.scenes):
            parts.append(f"{len(self.scenes) - done} not done")
        return "; ".join(parts)
