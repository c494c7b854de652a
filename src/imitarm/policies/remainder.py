r"""Remainder: the rest of a planned motion, which starts at the measured posture and joins the plan smoothly.

A plan displaces the learned path :math:`x_0(t)` by :math:`B(t)\,\Delta`, where :math:`\Delta` are the displacements of
the path's components. At the time s, the measured position of the tool is x. The path of the rest of the motion is

.. math:: x(t) = x_0(t) + f(t)\,\bigl(x - x_0(s) + (t - s)\,\dot B(s)\,\Delta_0\bigr)
          + \bigl(B(t) - f(t)\,(B(s) + (t - s)\,\dot B(s))\bigr)\,\Delta .

Here, :math:`\Delta_0` are the planned displacements, and f decreases smoothly from 1 at the time s to 0. For every
:math:`\Delta`, this path begins at x and in the planned direction of motion. If the tool is at its planned position,
the path with :math:`\Delta = \Delta_0` is the planned path. The tilt (the rotation of the tool away from the learned
rotation) joins the planned tilt in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies.arm_planner import ArmPlan
from imitarm.policies.component_path import ComponentPath, quintic_step
from imitarm.policies.tilts import Tilts
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_JOIN = 0.1  # of the remaining duration, in which the path joins what was planned
_FEWEST = 16  # samples
_STANDING = (
    1e-3  # [rad/s] along the path: at a smaller planned speed, the measured velocity says nothing about the rate
)


@dataclass(frozen=True, eq=False)
class Remainder:
    """The rest of a planned motion, which is the first guess of a new plan.

    Attributes:
        components: the rest of the path with its components; its times start at 0.
        displacement: planned displacements of the components, shape (n_components, 3) [m].
        tilts: smooth functions of time for the tilt of the tool.
        tilt: planned coefficients of the tilts, shape (n_tilts, 3) [rad].
        joints: planned joint positions at the samples, shape (n, n_joints) [rad]; near the start, they are shifted so
            that the first is the measured posture.
        rate: measured joint speed along the path at the start, divided by the planned joint speed at the learned times.
        begins: time in the learned motion at which the rest begins [s].
    """

    components: ComponentPath
    displacement: Array
    tilts: Tilts
    tilt: Array
    joints: Array
    rate: float
    begins: float

    @classmethod
    def of(cls, plan: ArmPlan, begins: float, state: ArmState) -> Remainder:
        """Return the rest of a plan from a measured state on.

        Args:
            plan: a plan of the whole motion.
            begins: time in the learned motion at which the rest begins [s].
            state: measured state of the arm.
        """
        path, times = plan.components, plan.components.nominal.times
        join = _Join.at(path, begins)
        t, fade = join.times, join.fade
        learned, rotations = path.nominal.at(t)
        tool = plan.path.arm.tool_pose(state.q)
        moved = tool.position - learned[0] + (t - begins)[:, None] * (join.slope(path.basis) @ plan.displacement)
        positions = learned + fade * moved
        assert rotations is not None  # the path of an arm's tool always has rotations
        turned = quaternion_log(quaternion_multiply(tool.quaternion, quaternion_conjugate(rotations[0])))
        tilted = plan.tilts.vectors(plan.tilt)
        fixed = join.joined(plan.tilts.fixed) + fade * (turned + (t - begins)[:, None] * join.slope(tilted))
        joints = join.spread(plan.path.joints)
        along = join.slope(plan.path.joints)
        speed = float(np.linalg.norm(along))
        rate = 1.0 if speed < _STANDING else max(float(along @ state.velocity) / speed**2, 0.0)
        later = [time - begins for time in path.fixed_times if time > begins]
        components = replace(
            path,
            nominal=Trajectory(t - begins, positions, rotations),
            fixed_times=(0.0, *later),
            responsibilities=join.spread(path.responsibilities),
            basis=join.joined(path.basis),
            centres=np.clip(np.searchsorted(t, times[path.centres]), 0, len(t) - 1),
            tolerance=join.spread(path.tolerance.reshape(len(times), -1)).reshape(len(t), *path.tolerance.shape[1:]),
            rotation_tolerance=np.interp(t, times, path.rotation_tolerance),
        )
        tilts = Tilts(join.joined(plan.tilts.basis), fixed)
        joints = joints + fade * (state.q - joints[0])
        return cls(components, plan.displacement, tilts, plan.tilt, joints, rate, begins)


@dataclass(frozen=True, eq=False)
class _Join:
    """Samples of the rest of a motion, and how it is joined to the motion before.

    Attributes:
        old: times of the samples of the whole motion, shape (m,) [s].
        times: times of the samples of the rest, shape (n,) [s]; the first one is the time at which the rest begins.
        fade: f, shape (n, 1).
    """

    old: Array
    times: Array
    fade: Array

    @classmethod
    def at(cls, path: ComponentPath, begins: float) -> _Join:
        old = path.nominal.times
        later = old[old > begins + 0.25 * float(np.diff(old).mean())]
        times = np.concatenate([[begins], later])
        if len(times) < _FEWEST:
            pins = [time for time in path.fixed_times[1:-1] if time > begins]
            times = np.union1d(np.linspace(begins, old[-1], _FEWEST), pins)
        ends = min(begins + _JOIN * (old[-1] - begins), *(time for time in path.fixed_times if time > begins))
        return cls(old, times, 1.0 - quintic_step((times - begins) / (ends - begins))[:, None])

    def spread(self, values: Array) -> Array:
        """Return values (m, k) at the samples of the rest, (n, k)."""
        return np.stack([np.interp(self.times, self.old, column) for column in values.T], axis=1)

    def slope(self, values: Array) -> Array:
        """Return the derivative of values (m, k) where the rest begins, (k,)."""
        i = int(np.clip(np.searchsorted(self.old, self.times[0], side="right"), 1, len(self.old) - 1))
        return np.asarray((values[i] - values[i - 1]) / (self.old[i] - self.old[i - 1]))

    def joined(self, values: Array) -> Array:
        """Return values (m, k) less what they are and how they change where the rest begins, (n, k)."""
        spread = self.spread(values)
        ahead = (self.times - self.times[0])[:, None]
        return np.asarray(spread - self.fade * (spread[0] + ahead * self.slope(values)))
