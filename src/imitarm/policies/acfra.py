"""ACFRA, adaptive collision-free reaching (thesis Chapter 4): adapt the whole learned path, then follow it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InfeasibleError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.adaptation import adapt, adapter_named
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number, sequence

Array = NDArray[np.float64]

_ALLOWANCE, _ALLOWANCE_OF_ARM = 2e-3, 5e-3  # [m] usual margin of a plan for the tool, for the whole arm
_SAME_POSTURE = 1e-4  # [m, rad] the joints are planned from exactly where the arm is


class ACFRA(PathPolicy):
    r"""Adapt the whole path once, then follow it (thesis Chapter 4).

    The constructor decomposes the learned path ``x_0(t)`` into Gaussian components with responsibilities ``h_k(t)``.
    The method ``reset`` displaces the means of the components near an obstacle by ``Delta_k``::

        x(t) = x_0(t) + w(t) sum_k h_k(t) Delta_k

    The window ``w`` is 0 at the start, at the goal and at the pinned times. The method ``step`` follows this path as
    :class:`~imitarm.policies.path_policy.PathPolicy` describes.

    If the argument ``method`` is ``"certified"`` and no path keeps the clearance, ``reset`` raises an error. The
    thesis's potential fields (``"mapf"`` and ``"literal"``) serve for comparison: the robot follows their paths even if
    these do not keep the clearance.

    If the demonstrations take several different paths, fit one skill to each path (see
    :func:`~imitarm.demonstrations.group_by_path`). The policy then adapts each path to the same start and goal. It
    follows the feasible path with the smallest displacement, measured in standard deviations of the demonstrations of
    this path.

    Args:
        skill: skill to reproduce.
        alternatives: one skill for each other demonstrated path of the same task.
        method: name of the adaptation method in :data:`~imitarm.policies.ADAPTERS`.
        tool_radius: radius of one sphere about the tool's tip [m]; use it instead of ``tool_spheres``.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m].
        clearance: required distance of the tool to every obstacle [m].
        forbidden: directions in which the path must not be displaced from the learned path, shape (m, 3).
        pinned: times at which the path must keep its learned position [s].
        arm: the arm with its tool. If given, the policy plans and follows a joint path of the whole arm, and does not
            use ``tool_radius`` and ``tool_spheres``. None: the policy plans only the path of the tool.
        max_tilt: largest rotation of the tool of ``arm`` away from the learned rotation [rad]; see
            :func:`~imitarm.policies.adapt`.
        goal_tilt: largest rotation of the tool of ``arm`` at the goal [rad]; see :func:`~imitarm.policies.adapt`.
        allowance: additional clearance for the robot's tracking errors [m]. If no path has this additional clearance,
            the policy plans without it. None: 2 mm for a plan of the tool, and 5 mm for a plan of the whole arm.
        following: ``gain``, ``patience`` and ``arrival`` of :class:`~imitarm.policies.path_policy.PathPolicy`.

    Attributes:
        adaptation: result of the last adaptation, even if it is not feasible.
    """

    def __init__(
        self,
        skill: Skill,
        *,
        alternatives: Sequence[Skill] = (),
        method: str = "certified",
        tool_radius: float | None = None,
        tool_spheres: ArrayLike | None = None,
        clearance: float = 0.02,
        forbidden: ArrayLike = (),
        pinned: Sequence[float] = (),
        arm: ArmModel | None = None,
        max_tilt: float | None = None,
        goal_tilt: float = 0.0,
        allowance: float | None = None,
        **following: Any,
    ) -> None:
        super().__init__(
            skill, tool_spheres=tool_spheres, clearance=clearance, forbidden=forbidden, arm=arm, **following
        )
        self._refuses = adapter_named(method).refuses
        self._whole_arm = arm is not None and self._refuses
        self._options: dict[str, Any] = {"method": method, "forbidden": forbidden}
        if self._whole_arm:
            self._options |= {"arm": arm, "max_tilt": max_tilt, "goal_tilt": goal_tilt}
            self._same_start = _SAME_POSTURE
        else:
            self._options |= {"tool_radius": tool_radius, "tool_spheres": tool_spheres}
        self._skills = [skill, *sequence(alternatives, Skill, "ACFRA: alternatives")]
        self._paths = [ComponentPath.of_skill(one, pinned=pinned) for one in self._skills]
        usual = _ALLOWANCE_OF_ARM if self._whole_arm else _ALLOWANCE
        self._allowance = finite_number(
            usual if allowance is None else allowance, "ACFRA: allowance", "m", at_least=0.0
        )
        self.adaptation: Adaptation | None = None

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Adapt the path to the scene.

        Raises:
            InfeasibleError: when the clearance can't be kept; the message names the obstacle and the reason.
        """
        self.adaptation = found = self._best(scene, start, state)
        if not found.feasible and self._refuses:
            raise InfeasibleError(found.reason)
        trajectory, joints = _with_approach(found, self.arm)
        displaced = np.linalg.norm(found.trajectory.positions - found.nominal.positions, axis=1)
        displaced = np.concatenate([np.zeros(len(trajectory) - len(displaced)), displaced])
        return PathPlan(trajectory, displaced, joints, found.only_on_schedule, found)

    def _best(self, scene: Scene, start: Pose | None, state: ArmState | None) -> Adaptation:
        """Return the feasible adaptation with the smallest deviation, or that of the skill itself if none is."""
        found = self._adapted(0, scene, start, state)
        if found.feasible and not found.moved.any():
            return found
        best = found
        for i in range(1, len(self._paths)):
            other = self._adapted(i, scene, start, state)
            if other.feasible and (not best.feasible or other.deviation < best.deviation):
                best = other
        if not best.feasible and len(self._paths) > 1:
            reason = f"{best.reason}; none of the {len(self._paths) - 1} alternative paths is clear either"
            return replace(best, reason=reason)
        return best

    def _adapted(self, i: int, scene: Scene, start: Pose | None, state: ArmState | None) -> Adaptation:
        goal = scene.goal
        if i > 0:  # all paths have the ends of the skill itself
            start = self.skill.start_ if start is None else start
            goal = self.skill.goal_ if goal is None else goal
            scene = replace(scene, goal=goal)
        return adapt(
            self._paths[i].between(self._skills[i], start, goal),
            scene,
            clearance=self.clearance,
            allowance=self._allowance if self._refuses else 0.0,
            state=state if self._whole_arm else None,
            **self._options,
        )

    @property
    def plan(self) -> Adaptation | None:
        """The result of the last adaptation, for drawing it in reports."""
        return self.adaptation


def _with_approach(plan: Adaptation, arm: ArmModel | None) -> tuple[Trajectory, Array | None]:
    """Return the tool's path and the joints (n, n_joints) of the whole motion, which begins with the approach."""
    path, joints, approach = plan.trajectory, plan.joints, plan.approach
    if approach is None or joints is None or arm is None:
        return path, joints
    positions, quaternions = arm.tool_path(approach.joints[:-1])  # its last posture is the first one of the plan
    whole = Trajectory(
        np.concatenate([approach.times[:-1], approach.times[-1] + path.times]),
        np.concatenate([positions, path.positions]),
        None if path.quaternions is None else np.concatenate([quaternions, path.quaternions]),
    )
    return whole, np.concatenate([approach.joints[:-1], joints])
