r"""PlanInExecution: a plan with guaranteed clearance that an arm follows, and checks of the plan's assumptions.

A *certified* plan guarantees the required clearance c, for example to obstacle i. The guarantee assumes that the arm is
on time, and that the prediction of obstacle i is wrong by at most the margin :math:`m_i`. If the certified clearance
:math:`c_0` exceeds c, the error may be larger. It is sufficient that

.. math:: |p_i(t) - \hat p_i(t)| + r_i \, |\theta_i(t)| + s_i(t) \le m_i(t) + c_0 - c

Here, :math:`p_i` is the observed position of the obstacle, and :math:`\hat p_i` is the position that the plan predicted
for this time. :math:`r_i` is the radius of a sphere that contains the obstacle. :math:`\theta_i` is the angle between
the observed and the predicted rotation, and :math:`s_i` is the largest change of one of the obstacle's sizes since the
plan was made.

If the inequality does not hold, the rest of the plan may still keep the clearance. The guarantee is then computed again
for the same motion and the observed obstacles. This computation takes a fraction of the time of planning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.arm_path import ArmPath
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.scene.scene import Scene
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_ROUNDING = 1e-6  # [m]
_STANDS = 0.05  # rate of the motion below which it waits
_DISPLACED = 1e-3  # [m] from the learned path: less is not called avoiding


@dataclass(frozen=True, eq=False)
class PlanInExecution:
    """A certified plan of the whole arm, in execution since the time ``began``.

    Attributes:
        adaptation: the plan, as a result of ``adapt`` or ``replan``.
        began: time at which the execution of the plan began [s].
        offset: time in the learned motion that corresponds to the start of the plan [s].
        scene: the obstacles at the time ``seen``, for which the guarantee was computed.
        seen: time from which the guarantee holds [s].
        margins: margin of each of these obstacles, from the time ``seen`` on; None for an obstacle without a margin.
        clearance: required clearance [m].
        certified: guaranteed clearance [m].
        approach: duration of the motion to the first posture of the path, which is a part of the plan [s].
        trajectory: path of the tool in the whole plan; its times start at 0.
        joints: joint positions at the n samples of ``trajectory``, shape (n, n_joints) [rad].
        until: time at which the guarantee ends [s]; inf: it covers the whole plan.
    """

    adaptation: Adaptation
    began: float
    offset: float
    scene: Scene
    seen: float
    margins: Sequence[PredictionMargin | None]
    clearance: float
    certified: float
    approach: float
    trajectory: Trajectory
    joints: Array
    until: float = np.inf

    @classmethod
    def of(
        cls,
        arm: ArmModel,
        adaptation: Adaptation,
        began: float,
        offset: float,
        scene: Scene,
        margins: Sequence[PredictionMargin | None],
        clearance: float,
    ) -> PlanInExecution:
        """Return the plan; the arguments have the same meaning as the attributes with the same names."""
        path, joints, approach = adaptation.trajectory, adaptation.joints, adaptation.approach
        assert joints is not None
        lead = 0.0
        if approach is not None:
            lead = float(approach.times[-1])
            positions, quaternions = arm.tool_path(approach.joints[:-1])
            path = Trajectory(
                np.concatenate([approach.times[:-1], lead + path.times]),
                np.concatenate([positions, path.positions]),
                None if path.quaternions is None else np.concatenate([quaternions, path.quaternions]),
            )
            joints = np.concatenate([approach.joints[:-1], joints])
        certified = adaptation.certified_clearance
        return cls(adaptation, began, offset, scene, began, margins, clearance, certified, lead, path, joints)

    @property
    def end(self) -> float:
        """Time at which the arm is at the goal [s]."""
        return self.began + float(self.trajectory.times[-1])

    @cached_property
    def _velocities(self) -> Array:
        return np.gradient(self.joints, self.trajectory.times, axis=0)

    def joints_at(self, time: float) -> Array:
        """Return the planned joint positions at a time [s], shape (n_joints,) [rad]."""
        return _at(time - self.began, self.trajectory.times, self.joints)

    def velocity_at(self, time: float) -> Array:
        """Return the planned joint velocities at a time [s], shape (n_joints,) [rad/s]; 0 after the end."""
        if time >= self.end:
            return np.zeros(self.joints.shape[1])
        return _at(time - self.began, self.trajectory.times, self._velocities)

    def phase_at(self, time: float) -> float:
        """Return the time since the end of the approach [s] (the phase of the path) at ``time`` [s]."""
        return max(time - self.began - self.approach, 0.0)

    def learned_at(self, time: float) -> float:
        """Return the time in the learned motion [s] that the plan has reached at ``time`` [s]."""
        done, learned = self.adaptation.trajectory.times, self.adaptation.nominal.times
        return self.offset + float(np.interp(self.phase_at(time), done, learned))

    def phase_of(self, learned: float) -> float:
        """Return the phase [s], see :meth:`phase_at`, at which the plan reaches a time [s] in the learned motion."""
        done, times = self.adaptation.trajectory.times, self.adaptation.nominal.times
        return float(np.interp(learned - self.offset, times, done))

    def waits_at(self, time: float) -> bool:
        """Return whether the arm waits at ``time`` [s], according to the plan."""
        done, learned = self.adaptation.trajectory.times, self.adaptation.nominal.times
        phase = self.phase_at(time)
        i = int(np.clip(np.searchsorted(done, phase, side="right"), 1, len(done) - 1))
        return bool(phase < done[-1] and learned[i] - learned[i - 1] < _STANDS * (done[i] - done[i - 1]))

    def displacement_at(self, time: float) -> float:
        """Return the distance [m] of the planned path from the learned path at a time [s]; 0 if it is below 1 mm."""
        plan = self.adaptation
        away = np.linalg.norm(plan.trajectory.positions - plan.nominal.positions, axis=1)
        displaced = float(np.interp(self.phase_at(time), plan.trajectory.times, away))
        return displaced if displaced > _DISPLACED else 0.0

    def off_schedule(self, arm: ArmModel, time: float, state: ArmState, tool: Pose, patience: float) -> str:
        """Return a text that says how far the tool is from its planned position; empty if the distance is accepted.

        Args:
            arm: the arm.
            time: the current time [s].
            state: measured state of the arm.
            tool: measured pose of the tool.
            patience: largest accepted distance [m].
        """
        lag = float(np.linalg.norm(arm.tool_pose(self.joints_at(time)).position - tool.position))
        if lag > patience:
            return f"the tool is {1e3 * lag:.0f} mm from its planned position at {time:.2f} s"
        return ""

    def unforeseen(self, scene: Scene) -> str:
        """Return a text that names an obstacle that violates the plan's assumptions; empty if none does.

        Args:
            scene: the obstacles as observed now; its stamp is the current time.
        """
        seen = scene.packed
        if not len(seen):
            return ""
        predicted = self.scene.at(scene.stamp)
        index = _matches(predicted, scene)
        new = np.flatnonzero(index < 0)
        if len(new):
            return f"{scene.name_of(new[0])} is new"
        then = predicted.packed
        away = np.linalg.norm(seen.positions - then.positions[index], axis=1)
        away += np.abs(seen.sizes - then.sizes[index]).max(axis=1)
        turn = quaternion_log(quaternion_multiply(seen.quaternions, quaternion_conjugate(then.quaternions[index])))
        radii = np.where(np.isfinite(seen.radii), seen.radii, 0.0)
        rotating = then.angular_velocities[index].any(axis=1)
        away += np.where(rotating, 0.0, radii * np.linalg.norm(turn, axis=1))
        allowed = self._allowed(scene.stamp)[index]
        worst = int(np.argmax(away - allowed))
        if away[worst] <= allowed[worst]:
            return ""
        return (
            f"{scene.name_of(worst)} is {1e3 * away[worst]:.0f} mm from its predicted position "
            f"({1e3 * allowed[worst]:.0f} mm allowed)"
        )

    def certified_again(
        self,
        arm: ArmModel,
        scene: Scene,
        margins: Sequence[PredictionMargin | None],
        hold: float,
        horizon: float = np.inf,
    ) -> PlanInExecution | None:
        """Return the plan with a new guarantee for the observed obstacles; None if the rest of the plan is too close.

        Predictions of tracked obstacles are uncertain far ahead. If there are tracked obstacles, and only the next
        ``horizon`` seconds of the plan keep the clearance, the guarantee covers only this time. Call the method again
        before the guarantee ends.

        Args:
            arm: the arm.
            scene: the obstacles as observed now; its stamp is the current time.
            margins: margin of each of these obstacles from now on; None for an obstacle without a margin.
            hold: time for which the arm must keep its clearances at the goal after the arrival [s].
            horizon: smallest time that the guarantee must cover if there are tracked obstacles [s]; inf: the whole
                plan.
        """
        now, times = scene.stamp, self.trajectory.times + self.began
        later = times > now
        times = np.concatenate([[now], times[later], [max(self.end, now) + hold]]) - now
        joints = np.concatenate([self.joints_at(now)[None], self.joints[later], self.joints[-1:]])
        around = ArmAmongObstacles(arm, scene.obstacles, self.clearance, margins=margins)
        path, until = ArmPath.of(arm, joints), np.inf
        room = around.clearance_of(path, times).room
        near = int(np.searchsorted(times, horizon)) + 1
        if room < 0.0 and near < len(times) and (np.asarray(scene.packed.track_ids) >= 0).any():
            room, until = around.clearance_of(ArmPath.of(arm, joints[:near]), times[:near]).room, now + horizon
        if room < 0.0:
            return None
        return replace(self, scene=scene, seen=now, margins=margins, certified=self.clearance + room, until=until)

    def _allowed(self, time: float) -> Array:
        """Return the allowed error of each obstacle of the plan at a time [s], shape (n,) [m]."""
        spare = max(self.certified - self.clearance, 0.0)
        margins = [0.0 if m is None else float(m.at(np.array(time - self.seen))) for m in self.margins]
        return np.array(margins) + (min(spare, 1.0) + _ROUNDING)


def _matches(before: Scene, now: Scene) -> NDArray[np.intp]:
    """Return the index in ``before`` of each obstacle of ``now``: the same track, or else the same name and shape."""
    known = {_key(before, i): i for i in range(len(before.packed))}
    return np.array([known.get(_key(now, i), -1) for i in range(len(now.packed))], dtype=np.intp)


def _key(scene: Scene, i: int) -> tuple[int, str]:
    track = int(scene.packed.track_ids[i])
    return (track, "") if track >= 0 else (-1, scene.name_of(i))


def _at(time: float, times: Array, values: Array) -> Array:
    """Return the row at ``time``, shape (m,), interpolated linearly between the rows of ``values`` (n, m)."""
    i = int(np.clip(np.searchsorted(times, time, side="right"), 1, len(times) - 1))
    share = min(max((time - times[i - 1]) / (times[i] - times[i - 1]), 0.0), 1.0)
    return np.asarray(values[i - 1] + share * (values[i] - values[i - 1]))
