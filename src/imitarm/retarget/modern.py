"""ModernRetargeter: the recommended method to convert the motion of a person's arm to the motion of a robot."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import Rows
from imitarm.kinematics.limits import JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.kinematics.sew import one_angle
from imitarm.kinematics.tasks import ElbowTask, Task, TwistTask
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import EngagementRule
from imitarm.retarget.retargeter import Goal, Retargeter
from imitarm.scene import Scene
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.validation import finite_number, finite_numbers

Array = NDArray[np.float64]

_FADE = 0.05  # [s] time constant of the velocity's decay after the last frame
_BETWEEN = 0.07  # [s] since the last frame: cameras drop a frame now and then, which is no loss of the arm
_SWING_GAIN, _SWING_RATE = 2.5, 1.0  # [1/s], [rad/s] of the elbow
_BEHIND = 0.01  # [m] error of the tool, 1 rad counted as 0.3 m, at which the elbow's weight is halved
_BENT = 0.1  # squared sine of the person's elbow angle, below which the swing angle loses weight
_BRAKING = 1.5  # [m/s^2] deceleration that the tool nearly always achieves, 1 rad counted as 0.3 m
# [m] that a radian counts as: little when a camera measured the rotation, more when the tool must keep its own
_ROTATION_LENGTHS = {"hand": (0.1, 0.1, 0.1), "upright": (0.2, 0.2, 0.05), "fixed": (0.3, 0.3, 0.3)}
_HELD = 0.02  # [rad] a joint farther than this behind its command is blocked by something
_SLIP = 0.015  # [m] largest distance of the target from a blocked tool
_STANDS, _STUCK = 0.03, 0.05  # [m/s], [s]: a tool that is slower for so long is stuck
_METRES = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
_STILL = 1e-3  # [rad/s] a slower joint is at rest


class ModernRetargeter(Retargeter):
    r"""The tool follows the person's hand, and the robot's elbow follows the person's elbow, within all limits.

    Each control step consists of four parts (see docs/retargeting.md):

    1. Extrapolate the arm estimate (:class:`~imitarm.retarget.arm_estimator.ArmEstimator`) from the last camera frame
       with a decaying velocity. Let W be the wrist's position and v its velocity at the last frame. After s seconds,
       the wrist is at :math:`W + v\,\tau(1 - e^{-s/\tau})`, with :math:`\tau` = 50 ms.
    2. Compute the target pose :math:`T_d` of the tool, and the desired twist of the tool. This twist is
       :math:`K \log(T_d T^{-1})` plus a fraction of the hand's velocity (feed-forward). Here, T is the tool's current
       pose.
    3. Solve a quadratic programme for the joint velocities. Its two tasks are the twist of the tool and the elbow angle
       (the SEW angle: the angle of the plane through shoulder, elbow and wrist). Its constraints are the joint limits
       of position, velocity and acceleration, and minimum distances between the links and from the links to obstacles.
       Further constraints keep elbow and wrist away from their singularities. While the robot follows nobody, the
       desired twist is zero.
    4. Limit the jerk of the joints, and limit their position, velocity and acceleration again (:class:`JerkLimiter`).
       If something blocks the arm, the arm does not push harder, and the target stays near the blocked tool.

    Let :math:`

    si_0` and :math:`

    si_{h,0}` be the elbow angles of robot and person when the robot began to follow the person. If the person's elbow
    angle is now :math:`

    si_h`, the desired elbow angle of the robot is :math:`

    si_d =

    si_0 +

    si_h -

    si_{h,0}`. The weight of the elbow task decreases in two cases: the camera sees the person's elbow poorly, or the
    arm of person or robot is nearly straight.

    When the camera loses the person, the robot continues along the extrapolated motion for 0.1 s. Then the robot holds
    its target, and 0.3 s after the loss it stops. When the camera has seen the person again for half a second, the
    robot follows again from the current poses of hand and tool. The target therefore does not jump.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: obstacles to avoid.
        gain: gain K of the twist towards the target [1/s].
        lead: fraction of the hand's velocity that is fed forward, 0 to 1.
        rotation_length: position error [m] that counts as much as a rotation error of one radian, if the joints can't
            correct both errors. Pass one number, or three numbers for rotations about the base's x, y and z axes. With
            None, the value depends on ``correspondence.orientation``: 0.1 m for ``"hand"``, because a camera measures
            the hand's rotation poorly, and 0.3 m for ``"fixed"``. For ``"upright"``, it is 0.2 m about x and y (tilt)
            and 0.05 m about z.
        elbow: weight of the elbow task relative to the tool's task [m^2]; 0: the robot's elbow does not follow the
            person's.
        clearance: required distance between the arm and the obstacles [m].
        own_clearance: required distance between the arm's own links [m]; None: not checked.
        max_speed: largest norm of the tool's twist [m/s]; a rotation of 1 rad counts as ``rotation_length``.
        max_lead: largest distance by which the command of a joint may be ahead of the measured position [rad]. A robot
            with a longer delay needs a larger value.

    Raises:
        InputError: when a number is out of range.
    """

    name: ClassVar[str] = "modern"
    caption: ClassVar[str] = (
        "The recommended method: the robot's elbow follows the person's elbow, and every joint limit is kept."
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
        rotation_length: float | tuple[float, float, float] | None = None,
        elbow: float = 0.1,
        clearance: float = 0.01,
        own_clearance: float | None = 0.02,
        max_speed: float = 1.5,
        max_lead: float = 0.06,
    ) -> None:
        super().__init__(arm, correspondence, dt=dt, scene=scene)
        self._gain = finite_number(gain, "ModernRetargeter: gain", "1/s", above=0.0, at_most=1.0 / dt)
        self._lead = finite_number(lead, "ModernRetargeter: lead", at_least=0.0, at_most=1.0)
        finite_number(elbow, "ModernRetargeter: elbow", "m^2", at_least=0.0)
        finite_number(max_speed, "ModernRetargeter: max_speed", "m/s", above=0.0)
        if not (isinstance(max_lead, float) and max_lead == math.inf):
            finite_number(max_lead, "ModernRetargeter: max_lead", "rad", above=0.0)
        if own_clearance is not None:
            finite_number(own_clearance, "ModernRetargeter: own_clearance", "m", at_least=0.0)
        self._obstacles = ClearanceLimit(arm, clearance)
        known = arm.landmarks is not None  # otherwise its elbow angle and its singularities are unknown
        if rotation_length is None:
            rotation_length = _ROTATION_LENGTHS[self.correspondence.orientation]
        lengths = finite_numbers(rotation_length, "ModernRetargeter: rotation_length", "m")
        if len(lengths) not in {1, 3} or not (lengths > 0.0).all():
            raise InputError(
                f"ModernRetargeter: rotation_length must be one or three lengths > 0, got {rotation_length!r}"
            )
        limits = [JointLimits(arm), *(singularity_limits(arm) if known else ())]
        self._solver = IKSolver(arm, limits, dt=dt)
        self._rotation_length, self._max_speed = rotation_length, max_speed
        self._elbow = elbow if known else 0.0
        self._own = None if own_clearance is None else SelfClearance(arm, own_clearance).periodic(dt)
        self._limiter = JerkLimiter(arm, dt, max_lead=max_lead)

    def _begin(self) -> None:
        if self._own is not None:
            self._own.reset()
        self._seeing = False  # a step with a new frame has less time for the rest
        self._stuck, self._held_at = 0, np.zeros(3)  # steps for which the tool has been blocked, and where
        self._offset: float | None = None  # of the robot's elbow angle to the person's

    def _rest_at(self, q: Array) -> None:
        self._limiter.start(q)
        self._q, self._velocity = self._limiter.q.copy(), np.zeros(self.arm.n_joints)  # of the reference

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        self._seeing = skeleton is not None
        return super()._see(skeleton)

    def _hand(self) -> tuple[Array, Array]:
        """Return wrist and hand, extrapolated from the last frame with a decaying velocity."""
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
        """Return whether the arm is at rest; a remaining motion that is imperceptibly slow is set to zero."""
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
            self._drive(np.zeros(6), None, engaged=False)
        else:
            ahead = np.zeros(6)
            ahead[:3] = (self._lead * math.exp(-goal.age / _FADE) * self.correspondence.scale) * goal.estimate.velocity
            self._reach(goal.target, ahead, self._elbow_task(goal.estimate), measured)
        return self._limiter.follow(self._q, self._velocity, measured)

    def _elbow_task(self, estimate: ArmEstimate) -> ElbowTask | None:
        """Return the task for the robot's elbow angle; None when the elbow is free or an angle is undefined."""
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
        """Move the joint reference towards the target, but not further against an object that blocks the arm."""
        error = self.arm.tool_pose(self._q).error_to(target)
        x, y, z, u, v, w = error.tolist()
        weighted = math.hypot(x, y, z, ROTATION_LENGTH * u, ROTATION_LENGTH * v, ROTATION_LENGTH * w)
        # far from the target it moves no faster than it can brake, or it would overshoot
        gain = min(self._gain, math.sqrt(2.0 * _BRAKING / max(weighted, 1e-9)))
        if elbow is not None:  # a tool that lags needs all the joints
            confidence = elbow.confidence / (1.0 + (weighted / _BEHIND) ** 2)
            elbow = ElbowTask(elbow.angle, elbow.weight, confidence, elbow.gain, elbow.max_rate)
        twist = gain * error + ahead
        held = max(map(abs, (self._limiter.q - measured).tolist()))
        if held > _HELD:
            self._slip(target, measured)
            twist = self._yielding(twist, measured, min((held - _HELD) / _HELD, 1.0))
        else:
            self._stuck = 0
        self._drive(twist, elbow)

    def _slip(self, target: Pose, measured: Array) -> None:
        """Shift the clutch's origin, so that the target does not move away from a tool that is blocked and at rest.

        Without the shift, the tool would jump to the target as soon as it is free, and could hit an object on its path.
        A robot that only responds with a delay keeps moving, so it is not mistaken for a blocked robot.
        """
        at = self.arm.tool_pose(measured).position
        moved, offset = at - self._held_at, target.position - at
        self._held_at = at
        self._stuck = self._stuck + 1 if float(moved.dot(moved)) < (_STANDS * self.dt) ** 2 else 0
        length = math.sqrt(float(offset.dot(offset)))
        if self._stuck > _STUCK / self.dt and length > _SLIP:
            self._engagement.shift((_SLIP / length - 1.0) * offset)

    def _yielding(self, twist: Array, measured: Array, fraction: float) -> Array:
        """Return the twist with a smaller component in the direction in which the tool is blocked."""
        back = self.arm.tool_pose(measured).error_to(self.arm.tool_pose(self._limiter.q)) * _METRES
        square = float(back.dot(back))
        along = float(back.dot(twist * _METRES))
        if square < 1e-12 or along <= 0.0:
            return twist
        return twist - fraction * (along / square) * back / _METRES

    def _drive(self, twist: Array, elbow: ElbowTask | None, *, engaged: bool = True) -> None:
        """Move the reference by one step of inverse kinematics; the arm rests if ``engaged`` is false."""
        obstacles = self._obstacles.rows(self._q, self.scene)
        own = None if self._own is None else self._own.rows(self._q, may_search=not self._seeing)
        rows = ([] if obstacles is None else [obstacles]) + ([] if own is None else [own])
        if not engaged:  # whatever is too close already is corrected once the robot follows
            rows = [Rows(part.matrix, np.minimum(part.lower, 0.0)) for part in rows]
        tasks: list[Task] = [TwistTask(twist, "tool", self._rotation_length, self._max_speed)]
        if elbow is not None:
            tasks.append(elbow)
        velocity = self._solver.solve(self._q, tasks, velocity=self._velocity, rows=rows)
        self._velocity = velocity
        self._q = self._q + self.dt * velocity


class JerkLimiter:
    r"""Makes the joints follow a reference, and limits their position, velocity, acceleration and jerk.

    The reference of a joint has the position :math:`q_r` and the velocity :math:`v_r`; the joint itself has the
    commanded position q and velocity v. A critically damped follower computes the desired acceleration :math:`a_d =
    \omega^2 (q_r - q) + 2\omega (v_r - v)`. This acceleration is clipped to :math:`|a| \le a_{max}` and to :math:`|a -
    a_p| \le j\,dt`, where :math:`a_p` is the previous acceleration and j the jerk limit. The resulting velocity
    :math:`v + a\,dt` is then clipped so that the joint can still stop before its limit. Each step moves the joint by
    the mean of two successive velocities times dt. Let D be the distance to the position limit. In the next equation, a
    is :math:`a_{max}`. The highest velocity from which the joint can still stop is

    .. math:: v_b = -\tfrac12 a\,dt + \sqrt{\tfrac14 a^2 dt^2 + 2 a D'}, \qquad D' = D - \tfrac12 v\,dt.

    If D' is negative, the bound :math:`v_b` is :math:`2 D'/dt` instead.

    If the velocity of a joint is at most :math:`v_b` in one step, braking with :math:`a_{max}` keeps it within the
    bound in all later steps. Near a position limit, clipping the velocity to :math:`v_b` may exceed the jerk limit. The
    limits of position, velocity and acceleration are always kept.

    A blocked arm falls behind its commands, and its drives push harder as the error grows. Therefore, when the command
    of a joint is ahead of the measured position by more than half of ``max_lead``, the command brakes. It brakes as if
    the joint had a position limit at the distance ``max_lead`` from the measured position.

    Args:
        arm: arm model that provides the joint limits.
        dt: control period [s].
        frequency: natural frequency omega of the follower [rad/s]; must be well below 1/dt.
        rise_time: shortest time in which the acceleration rises from 0 to a_max [s]; the jerk limit is j = a_max /
            rise_time.
        max_lead: largest distance by which a command may be ahead of the measured position [rad]. If a joint at full
            speed moves by more than half of ``max_lead`` within the robot's delay, the limiter slows the joint down.

    Raises:
        InputError: when a number is out of range.
    """

    def __init__(
        self, arm: ArmModel, dt: float, *, frequency: float = 30.0, rise_time: float = 0.02, max_lead: float = math.inf
    ) -> None:
        if not 0.0 < frequency * dt < 1.0:
            raise InputError(f"JerkLimiter: frequency must be positive and below 1/dt = {1 / dt:g} rad/s")
        if not rise_time >= dt:
            raise InputError(f"JerkLimiter: rise_time must be at least dt = {dt:g} s, got {rise_time:g}")
        if not max_lead > 0.0:
            raise InputError(f"JerkLimiter: max_lead must be positive [rad], got {max_lead:g}")
        self._dt = dt
        # semi-implicit: uses the error at the end of the period, which keeps the follower stable at a large omega dt
        calm = 1.0 + 2.0 * frequency * dt + frequency * frequency * dt * dt
        self._stiffness, self._damping = frequency * frequency / calm, 2.0 * frequency / calm
        self.max_jerk = arm.max_acceleration / rise_time
        # farther than this from a position limit, that limit never restricts the velocity
        room = arm.max_velocity * (arm.max_velocity / (2.0 * arm.max_acceleration) + 2.0 * dt)
        columns = (
            arm.max_velocity,
            arm.max_acceleration,
            arm.max_acceleration * dt,
            arm.max_acceleration * (dt / rise_time),
            arm.lower,
            arm.upper,
            arm.lower + room,
            arm.upper - room,
        )
        self._joints = list(zip(*(column.tolist() for column in columns), strict=True))
        self._lead = max_lead
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Reset to rest at ``q``, shape (n_joints,) [rad]."""
        self.q: Array = np.array(q, dtype=float)
        self.velocity: Array = np.zeros_like(self.q)
        self._acceleration = [0.0] * len(self.q)

    @property
    def acceleration(self) -> Array:
        """Joint accelerations of the last period, shape (n_joints,) [rad/s^2]."""
        return np.array(self._acceleration)

    def follow(self, q: Array, velocity: Array, measured: Array | None = None) -> Array:
        """Move towards a reference for one period; return the joint positions reached, shape (n_joints,) [rad].

        Args:
            q: joint positions of the reference, shape (n_joints,) [rad].
            velocity: velocity of the reference, shape (n_joints,) [rad/s].
            measured: measured joint positions, shape (n_joints,) [rad]; None: the joints are where they were commanded
                to be.
        """
        # plain floats without min and max: for so few numbers twice as fast as NumPy
        dt, half, stiffness, damping = self._dt, 0.5 * self._dt, self._stiffness, self._damping
        half_lead = 0.5 * self._lead
        at = self.q.tolist()
        columns = (at, self.velocity.tolist(), self._acceleration, q.tolist(), velocity.tolist())
        positions, velocities, accelerations = [], [], []
        for x, v, a, x_r, v_r, m, joint in zip(
            *columns, at if measured is None else measured.tolist(), self._joints, strict=True
        ):
            v_max, a_max, step, jerk_step, _, _, inner_lower, inner_upper = joint
            wanted = stiffness * (x_r - x - dt * v) + damping * (v_r - v)
            low, high = a - jerk_step, a + jerk_step
            low = -a_max if low < -a_max else low
            high = a_max if high > a_max else high
            wanted = low if wanted < low else wanted
            after = v + dt * (high if wanted > high else wanted)
            low, high = v - step, v + step
            low = -v_max if low < -v_max else low
            high = v_max if high > v_max else high
            if not (inner_lower < x < inner_upper and -half_lead < x - m < half_lead):
                low, high = self._stoppable(x, v, m, low, high, joint)
            after = low if after < low else after
            after = high if after > high else after
            positions.append(x + half * (v + after))
            velocities.append(after)
            accelerations.append((after - v) / dt)
        self.q, self.velocity, self._acceleration = np.array(positions), np.array(velocities), accelerations
        return self.q

    def _stoppable(
        self, x: float, v: float, measured: float, low: float, high: float, joint: tuple[float, ...]
    ) -> tuple[float, float]:
        """Return the lowest and highest velocity of a joint from which it can still stop before its limits.

        Args:
            x: its position [rad].
            v: its velocity [rad/s].
            measured: measured position of the joint [rad].
            low: lowest velocity that the other limits allow [rad/s].
            high: highest velocity that the other limits allow [rad/s].
            joint: its limits.
        """
        _, a_max, step, _, bottom, top, _, _ = joint
        if abs(x - measured) > 0.5 * self._lead:  # a joint that keeps up is not slowed
            top, bottom = min(top, measured + self._lead), max(bottom, measured - self._lead)
        ahead = x + 0.5 * self._dt * v
        return (
            min(max(-self._braking(ahead - bottom, a_max, step), low), high),
            max(min(self._braking(top - ahead, a_max, step), high), low),
        )

    def _braking(self, distance: float, a_max: float, step: float) -> float:
        """Return the highest velocity from which a joint can stop within ``distance``; negative beyond the limit."""
        bound = math.sqrt(0.25 * step * step + 2.0 * a_max * max(distance, 0.0)) - 0.5 * step
        return bound + min(distance, 0.0) * (2.0 / self._dt)
