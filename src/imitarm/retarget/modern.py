"""ModernRetargeter: what we would use on a robot; every limit kept, the elbow followed, losses of sight survived."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import ROTATION_LENGTH, Rows
from imitarm.kinematics.limits import JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.kinematics.self_clearance import SelfClearance
from imitarm.kinematics.sew import one_angle
from imitarm.kinematics.tasks import ElbowTask, Task, TwistTask
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import EngagementRule
from imitarm.retarget.jerk_limit import JerkLimiter
from imitarm.retarget.retargeter import Goal, Retargeter
from imitarm.scene import Scene
from imitarm.scene.clearance_limit import ClearanceLimit

Array = NDArray[np.float64]

_FADE = 0.05  # [s] time constant of the fading motion
_BETWEEN = 0.07  # [s] since the last frame: cameras drop a frame now and then, which is no loss of the arm
_SWING_GAIN, _SWING_RATE = 2.5, 1.0  # [1/s], [rad/s] of the elbow
_BEHIND = 0.01  # [m] a tool that is farther than this from its target lets the elbow be, 1 rad counting as 0.3 m
_BENT = 0.1  # squared sine of the angle at the person's elbow below which its swing tells less and less
_BRAKING = 1.5  # [m/s^2] the tool can nearly always brake so hard, 1 rad counting as 0.3 m
# [m] what a radian counts as beside a metre: little where a camera saw the turn, more where the tool is to keep it
_TURN_LENGTHS = {"hand": (0.1, 0.1, 0.1), "upright": (0.2, 0.2, 0.05), "fixed": (0.3, 0.3, 0.3)}
_HELD = 0.02  # [rad] a joint that is farther than this behind its command is held up by something
_SLIP = 0.015  # [m] farther a hand does not lead the target from a tool that is held up
_STANDS, _STUCK = 0.03, 0.05  # [m/s] a tool that is slower for so long [s] is stuck
_METRES = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
_STILL = 1e-3  # [rad/s] slower is at rest


class ModernRetargeter(Retargeter):
    r"""Follow the hand with the tool and the elbow with the elbow, inside every limit (METHODS A.9).

    One step is

    1. the arm's estimate (:class:`~imitarm.retarget.arm_estimator.ArmEstimator`), carried on from its last frame at
       the estimated velocity, which fades: :math:`W + v\,\tau(1 - e^{-s/\tau})` after s seconds, tau = 50 ms;
    2. the clutch's target, and the twist that goes there, :math:`K \log(T_d T^{-1})` plus a share of the hand's
       velocity;
    3. a quadratic programme for the joints' velocities: the twist, the elbow's SEW angle, the box of position, velocity
       and acceleration that can always be kept, bounds that keep elbow and wrist off their singularities, rows that
       keep the links off each other and off the scene; while nobody leads, the arm goes nowhere by itself;
    4. a follower that limits the jerk (:class:`~imitarm.retarget.jerk_limit.JerkLimiter`), guards the limits again,
       and does not press on against what holds the arm up; a clutch whose tool stands held slips.

    The elbow's angle changes as the person's does, from where both were when the clutch engaged:
    :math:`\psi_d = \psi_0 + \psi_h - \psi_{h,0}`. It counts less the less surely the person's elbow is seen, and the
    straighter either arm is.

    Without a sight of the arm it coasts for 0.1 s, holds until 0.3 s, then stops; a stopped one waits until the arm has
    been seen for half a second and takes hold where both are then, so nothing jumps.

    Args:
        arm: the robot's arm with its tool.
        correspondence: what of the person's arm stands for what of the robot's.
        dt: control period [s].
        scene: obstacles to keep clear of.
        gain: K [1/s].
        lead: share of the hand's velocity that is fed forward, 0 to 1.
        turn_length: what one radian of the tool's turn counts as, beside a metre of its way, where the joints can't do
            both [m], about the base's x, y and z; None: 0.1 where the tool turns with the hand, which a camera
            sees badly, 0.3 where it keeps its turn; where it stays upright 0.2 against tilting and 0.05 about z.
        elbow: weight of the elbow's swing beside the tool [m^2]; 0: the elbow is free.
        clearance: to keep from the scene [m].
        own_clearance: of links from each other [m]; None: not watched.
        max_speed: the twist is cut to this [m/s], 1 rad counting as ``turn_length``.
        max_lead: how far a joint's command may lead its measured position [rad]; a robot that answers late needs more.

    Raises:
        InputError: when a number is out of range.
    """

    name: ClassVar[str] = "modern"
    caption: ClassVar[str] = (
        "The method to use on a robot: it keeps every limit, follows the elbow, and copes with a person who is lost."
    )
    rule: ClassVar[EngagementRule] = EngagementRule(follow_until=_BETWEEN)

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        gain: float = 15.0,
        lead: float = 0.9,
        turn_length: float | tuple[float, float, float] | None = None,
        elbow: float = 0.1,
        clearance: float = 0.01,
        own_clearance: float | None = 0.02,
        max_speed: float = 1.5,
        max_lead: float = 0.06,
    ) -> None:
        if not (0.0 < gain * dt <= 1.0 and 0.0 <= lead <= 1.0 and elbow >= 0.0 and max_speed > 0.0):
            raise InputError(
                f"ModernRetargeter: needs 0 < gain <= 1/dt = {1 / dt:g}, lead from 0 to 1, elbow >= 0, max_speed > 0"
            )
        self._gain, self._lead = gain, lead
        self._obstacles = ClearanceLimit(arm, clearance)
        known = arm.landmarks is not None  # else neither its elbow's angle nor its singularities are
        if turn_length is None:
            turn_length = _TURN_LENGTHS[(correspondence or Correspondence()).orientation]
        limits = [JointLimits(arm), *(singularity_limits(arm) if known else ())]
        self._solver = IKSolver(arm, limits, dt=dt)
        self._rotation_length, self._max_speed = turn_length, max_speed
        self._elbow = elbow if known else 0.0
        self._own = None if own_clearance is None else SelfClearance(arm, own_clearance).watch(dt)
        self._limiter = JerkLimiter(arm, dt, max_lead=max_lead)
        super().__init__(arm, correspondence, dt=dt, scene=scene)

    def _begin(self) -> None:
        if self._own is not None:
            self._own.reset()
        self._seeing = False  # a step with a new frame has less time for the rest
        self._stuck, self._held_at = 0, np.zeros(3)  # steps for which the tool has been held, and where
        self._offset: float | None = None  # of the robot's elbow angle from the person's

    def _rest_at(self, q: Array) -> None:
        self._limiter.start(q)
        self._q, self._velocity = self._limiter.q.copy(), np.zeros(self.arm.n_joints)  # of the reference

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        self._seeing = skeleton is not None
        return super()._see(skeleton)

    def _hand(self) -> tuple[Array, Array]:
        """Return wrist and hand, extrapolated from the last frame at a velocity that decays."""
        estimate, age = self._estimate, self._engagement.time_since_seen
        assert estimate is not None
        wrist, hand = estimate.wrist, estimate.hand
        if age > 0.0:
            seconds = _FADE * (1.0 - math.exp(-age / _FADE))
            wrist = wrist + seconds * estimate.velocity
            if self.correspondence.orientation != "fixed":
                hand = quaternion_multiply(quaternion_exp(seconds * estimate.angular_velocity), hand)
        return wrist, hand

    def _at_rest(self) -> bool:
        """Return whether the arm stands still; the rest of its motion, too slow to be seen, is removed."""
        if max(np.abs(self._velocity).max(), np.abs(self._limiter.velocity).max()) > _STILL:
            return False
        if self._velocity.any() or self._limiter.velocity.any():
            self._rest_at(self._limiter.q)
        return True

    def _velocity_at(self, before: Array, after: Array) -> Array:
        return self._limiter.velocity

    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        if goal is None:
            self._offset = None
            self._drive(np.zeros(6), None, led=False)
        else:
            ahead = np.zeros(6)
            ahead[:3] = (self._lead * math.exp(-goal.age / _FADE) * self.correspondence.scale) * goal.estimate.velocity
            self._reach(goal.target, ahead, self._elbow_task(goal.estimate), measured)
        return self._limiter.follow(self._q, self._velocity, measured)

    def _elbow_task(self, estimate: ArmEstimate) -> ElbowTask | None:
        """Return where the elbow should be; None when it is free, or one of the two angles is lost."""
        if self._elbow == 0.0:
            return None
        person = one_angle(estimate.shoulder.tolist(), estimate.elbow.tolist(), estimate.wrist.tolist())
        if person is None:
            return None
        if self._offset is None:
            robot = one_angle(*self.arm.sew_points(self._q).tolist())
            if robot is None:
                return None
            self._offset = robot.angle - person.angle
        confidence = estimate.confidence[0] * min(1.0, person.bend / _BENT)
        angle = math.remainder(person.angle + self._offset, math.tau)
        return ElbowTask(angle, self._elbow, confidence, _SWING_GAIN, _SWING_RATE)

    def _reach(self, target: Pose, ahead: Array, elbow: ElbowTask | None, measured: Array) -> None:
        """Move the reference towards a target; not on against what holds the arm up."""
        error = self.arm.tool_pose(self._q).error_to(target)
        x, y, z, u, v, w = error.tolist()
        weighted = math.hypot(x, y, z, ROTATION_LENGTH * u, ROTATION_LENGTH * v, ROTATION_LENGTH * w)
        # far away it goes no faster than it can brake again, or it would swing about the target
        gain = min(self._gain, math.sqrt(2.0 * _BRAKING / max(weighted, 1e-9)))
        if elbow is not None:  # a tool that is behind needs all the joints
            elbow = elbow._replace(confidence=elbow.confidence / (1.0 + (weighted / _BEHIND) ** 2))
        twist = gain * error + ahead
        held = max(map(abs, (self._limiter.q - measured).tolist()))
        if held > _HELD:
            self._slip(target, measured)
            twist = self._yielding(twist, measured, min((held - _HELD) / _HELD, 1.0))
        else:
            self._stuck = 0
        self._drive(twist, elbow)

    def _slip(self, target: Pose, measured: Array) -> None:
        """Let the clutch slip while the hand leads the target away from a tool that is held up and stands.

        Else the tool would leap after the target, and against whatever is there, as soon as it is free. A robot that is
        only late goes on, and is not taken for one that is held.
        """
        at = self.arm.tool_pose(measured).position
        moved, way = at - self._held_at, target.position - at
        self._held_at = at
        self._stuck = self._stuck + 1 if float(moved.dot(moved)) < (_STANDS * self.dt) ** 2 else 0
        length = math.sqrt(float(way.dot(way)))
        if self._stuck > _STUCK / self.dt and length > _SLIP:
            self._engagement.shift((_SLIP / length - 1.0) * way)

    def _yielding(self, twist: Array, measured: Array, share: float) -> Array:
        """Return a twist without a share of what goes on in the direction in which the tool is held back."""
        back = self.arm.tool_pose(measured).error_to(self.arm.tool_pose(self._limiter.q)) * _METRES
        square = float(back.dot(back))
        along = float(back.dot(twist * _METRES))
        if square < 1e-12 or along <= 0.0:
            return twist
        return twist - share * (along / square) * back / _METRES

    def _drive(self, twist: Array, elbow: ElbowTask | None, *, led: bool = True) -> None:
        """Move the reference by one step of inverse kinematics; an arm that nobody leads goes nowhere by itself."""
        obstacles = self._obstacles.rows(self._q, self.scene)
        own = None if self._own is None else self._own.rows(self._q, time_to_look=not self._seeing)
        rows = ([] if obstacles is None else [obstacles]) + ([] if own is None else [own])
        if not led:  # what is too near already is left when the person leads on
            rows = [Rows(part.matrix, np.minimum(part.lower, 0.0)) for part in rows]
        tasks: list[Task] = [TwistTask(twist, "tool", self._rotation_length, self._max_speed)]
        if elbow is not None:
            tasks.append(elbow)
        velocity = self._solver.solve(self._q, tasks, velocity=self._velocity, rows=rows)
        self._velocity = velocity
        self._q = self._q + self.dt * velocity
