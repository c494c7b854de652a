"""CertifiedRCAMO: plan the rest of the motion again and again among moving obstacles, with a guaranteed clearance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmState
from imitarm.perception.margins import CoverageMargin
from imitarm.perception.steady_velocity import SteadyVelocities
from imitarm.policies.adaptation import adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.component_path import STILL, ComponentPath
from imitarm.policies.plan_in_execution import PlanInExecution
from imitarm.policies.policy import Observation, Policy
from imitarm.policies.prediction_margin import margins_in
from imitarm.policies.rcamo import RCAMO
from imitarm.policies.replanning import replan
from imitarm.policies.stopping import Stop, certified_stop
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number, instance, whole_number

Array = NDArray[np.float64]

_STANDS = 0.01  # [rad/s] an arm whose joints are all slower than this is at rest
_STANDING = 0.02  # [m/s] an obstacle slower than this can't be waited for
_LAST = 0.1  # [s] before the goal, no further plan is made
_BACK = 4  # every so many plans, the learned path is tried instead of the last plan
_SOME, _MOST = 2, 12  # attempts of a thorough search from rest, first and later; one of any other search
_HORIZON = 1.5  # [s] that the certificate of a plan in execution must cover among tracked obstacles
_AFRESH = 3  # every so many searches begin with the last plan, and not where the last search ended
_PAUSE, _THOROUGH = 8, 4  # every so many searches from rest are thorough; so many times more rounds
_SAME_START = 1e-4  # [m, rad] a start nearer than this to the learned one is the learned one


@dataclass(frozen=True, eq=False)
class _Stopping:
    """A certified stop that the arm executes."""

    stop: Stop
    began: float

    def joints_at(self, time: float) -> Array:
        times = self.stop.times
        return np.array([np.interp(time - self.began, times, column) for column in self.stop.joints.T])


class CertifiedRCAMO(Policy):
    r"""Plan the rest of the motion many times a second, and follow only plans that guarantee the whole arm's clearance.

    Each plan begins at the measured state of the arm, and predicts the obstacles from their observed positions and
    velocities. A plan is *certified* if the distance :math:`d_i(t)` of the whole arm from each predicted obstacle i is
    proven to satisfy

    .. math:: d_i(t) \ge c + m_i(t)

    Here, c is the required clearance and :math:`m_i` is the margin for the error of the prediction
    (:mod:`~imitarm.policies.prediction_margin`). A plan may also wait until an obstacle has passed
    (:mod:`~imitarm.policies.retiming`). A plan becomes void as soon as one of its assumptions fails
    (:mod:`~imitarm.policies.plan_in_execution`). For example, the arm is late, or an obstacle is farther from its
    prediction than its margin and too close to the rest of the plan. The policy then makes another plan at once. There
    are three cases:

    1. If a certified plan exists, the arm follows this plan.
    2. If no plan is certified, but a motion that brakes and then waits is certified
       (:func:`~imitarm.policies.stopping.certified_stop`), the arm brakes and waits.
    3. If neither a plan nor a stop is certified, for example because an obstacle comes towards the arm,
       :class:`~imitarm.policies.rcamo.RCAMO` commands the arm. The arm then evades without a certificate.

    If no plan has been certified for longer than ``patience``, RCAMO also commands the arm. In all cases, the search
    for a plan continues.

    The velocities of tracked obstacles are noisy. For obstacles that move steadily, the policy therefore uses their
    mean velocities over a longer time (:mod:`~imitarm.perception.steady_velocity`). If a new prediction of a tracked
    obstacle comes too close to a plan, the plan stays valid while its next 1.5 s keep the clearance.

    The reason in a command says why the arm brakes, waits or deviates from its path. As soon as a plan is certified,
    the motion continues. As with all policies, let a :class:`~imitarm.safety.SafetyFilter` check every command. If
    obstacles at rest make the motion impossible, ``reset`` raises an error. If only a moving obstacle makes the motion
    impossible, the arm waits.

    In a simulation, the time stands still while ``step`` computes a plan. On a real arm, the computation takes time;
    set ``planning_time`` to this time. Each plan then begins at the end of this time, at the state that is predicted
    for then.

    Args:
        skill: skill to reproduce.
        rate: number of plans per second [Hz].
        margin: a ``CoverageMargin``, which bounds the error of the predicted obstacle positions; None: predictions
            count as exact.
        margin_horizon: time after the last detection of an obstacle at which the margin stops growing [s]; None: never.
            Choose a time that covers the next few plans and the braking.
        planning_time: time from an observation until the arm follows the plan that was made from this observation [s].
        max_tilt: see :func:`~imitarm.policies.adapt`.
        goal_tilt: see :func:`~imitarm.policies.adapt`.
        pinned: see :func:`~imitarm.policies.adapt`.
        allowance: additional clearance for tracking errors [m]. If no plan has this additional clearance, the policy
            plans without it.
        hold: time for which the clearances must be guaranteed at the goal after the arrival, and at rest after a stop
            [s].
        gain: feedback gain of the joint positions [1/s].
        arrival: distance from the goal below which the tool has arrived [m].
        max_rounds: largest number of rounds of one search while the arm moves, to limit computing time. The next search
            continues with the result of this one. See :func:`~imitarm.policies.replan`. None: no limit.
        patience: time without a certified plan after which RCAMO commands the arm instead of waiting [s].
        options: arguments of :class:`~imitarm.policies.Policy`; ``arm`` is required.

    Attributes:
        plans: number of searches for a plan since ``reset``.
        certified: number of these searches that found a certified plan.
    """

    def __init__(
        self,
        skill: Skill,
        *,
        rate: float = 15.0,
        margin: CoverageMargin | None = None,
        margin_horizon: float | None = 1.0,
        planning_time: float = 0.0,
        max_tilt: float | None = None,
        goal_tilt: float = 0.0,
        pinned: Any = (),
        allowance: float = 0.005,
        hold: float = 0.5,
        gain: float = 8.0,
        arrival: float = 0.003,
        max_rounds: int | None = 5,
        patience: float = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        name = type(self).__name__
        if self.arm is None:
            raise InputError(f"{name}: plans the whole arm; pass arm=ArmModel.load(...)")
        self._arm = self.arm
        self._period = 1.0 / finite_number(rate, f"{name}: rate", "Hz", above=0.0)
        self._planning_time = finite_number(planning_time, f"{name}: planning_time", "s", at_least=0.0)
        self._hold = finite_number(hold, f"{name}: hold", "s", above=0.0)
        self._gain = finite_number(gain, f"{name}: gain", "1/s", above=0.0)
        self._patience = finite_number(patience, f"{name}: patience", "s", at_least=0.0)
        self._rounds = None if max_rounds is None else whole_number(max_rounds, f"{name}: max_rounds", at_least=1)
        self._arrival = finite_number(arrival, f"{name}: arrival", "m", above=0.0)
        self._margin: dict[str, Any] = {"margin": margin, "margin_horizon": margin_horizon}
        margins_in(Scene(), **self._margin)
        self._options: dict[str, Any] = {
            "arm": self._arm,
            "clearance": self.clearance,
            "forbidden": self.forbidden,
            "max_tilt": max_tilt,
            "goal_tilt": goal_tilt,
            "allowance": finite_number(allowance, f"{name}: allowance", "m", at_least=0.0),
            "hold": self._hold,
            **self._margin,
        }
        self._path = ComponentPath.of_skill(skill, pinned=pinned)
        self.evasion = RCAMO(
            skill,
            tool_spheres=self._arm.tool_spheres if self.tool_spheres is None else self.tool_spheres,
            clearance=self.clearance,
            forbidden=self.forbidden,
            margin=margin,
        )
        self._started = False

    # ----- start

    def reset(self, observation: Observation) -> None:
        """Plan the whole motion from the measured posture.

        Raises:
            InfeasibleError: when obstacles at rest or the limits of the arm make the motion impossible; the message
                gives the reason.
        """
        instance(observation, Observation, "CertifiedRCAMO.reset: observation")
        self.plans = self.certified = 0
        self._goal = observation.scene.goal
        self._plan: PlanInExecution | None = None
        self._next_plan: PlanInExecution | None = None
        self._last: PlanInExecution | None = None
        self._base: PlanInExecution | None = None
        self._stopping: _Stopping | None = None
        self._evades, self._attempts = False, _SOME
        self._guess: Array | None = None
        self._failures, self._velocities = 0, SteadyVelocities()
        self._learned, self._reason, self._since = 0.0, "", observation.time
        self._due = observation.time + self._period
        self.evasion.reset(observation)
        self._started = True
        begins = observation.time + self._planning_time
        scene = observation.scene.now(begins)
        found = self._adapted(observation.state, scene, None)
        if found.feasible:
            self._plan = self._begun(found, begins, 0.0, scene)
            return
        standing = [o for o in scene.obstacles if np.linalg.norm(o.velocity) < _STANDING]
        alone = found
        if len(standing) < len(scene.obstacles):
            alone = self._adapted(observation.state, replace_obstacles(scene, standing), None)
        if not alone.feasible:
            raise InfeasibleError(alone.reason)
        if not alone.moved.any():
            self._base = self._begun(alone, begins, 0.0, replace_obstacles(scene, standing))
        self._reason = found.reason

    def _adapted(self, state: ArmState, scene: Scene, max_attempts: int | None) -> Adaptation:
        """Plan the whole motion from rest."""
        self.plans += 1
        tool = self._arm.tool_pose(state.q)
        away = tool.error_to(self.skill.start_)
        away = away if self.skill.gmr_.has_orientation_ else away[:3]
        start = None if np.linalg.norm(away) <= _SAME_START else tool
        path = self._path.between(self.skill, start, scene.goal)
        found = adapt(path, scene, state=state, max_attempts=max_attempts, **self._options)
        self.plan = found
        return found

    def _begun(self, found: Adaptation, began: float, offset: float, scene: Scene) -> PlanInExecution:
        self.certified += 1
        margins = margins_in(scene, **self._margin)
        begun = PlanInExecution.of(self._arm, found, began, offset, scene, margins, self.clearance)
        if self._base is None and not found.moved.any():
            self._base = begun
        return begun

    # ----- each step

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command that follows the certified plan, brakes, or evades without a guarantee.

        Raises:
            InputError: when ``reset`` was not called, the goal has moved, or ``dt`` is not a positive number.
        """
        instance(observation, Observation, "CertifiedRCAMO.step: observation")
        dt = finite_number(dt, "CertifiedRCAMO.step: dt", "s", above=0.0)
        if not self._started:
            raise InputError("CertifiedRCAMO.step: call reset(observation) first")
        time, scene = observation.time, self._velocities.improved(observation.scene.now(observation.time))
        self._check_goal(scene)
        if self._next_plan is not None and time >= self._next_plan.began - 0.5 * dt:
            self._follow(self._next_plan)
            self._next_plan = None
        void = self._void(observation, scene)
        if (void or time >= self._due - 0.5 * dt) and self._next_plan is None:
            self._due = max(self._due + self._period, time + 0.5 * self._period)
            self._replan(observation, scene)
            if self._plan is None:
                self._brake(observation, scene)
        return self._command(observation, dt)

    def _check_goal(self, scene: Scene) -> None:
        goal, first = scene.goal, self._goal
        if goal is first or (goal is not None and first is not None and np.abs(goal.error_to(first)).max() <= STILL):
            return
        raise InputError(
            "CertifiedRCAMO: the goal has moved, and certified plans have a fixed goal; use policy 'rcamo'"
        )

    def _follow(self, plan: PlanInExecution) -> None:
        self._plan, self._stopping, self._evades, self._reason = plan, None, False, ""
        self._attempts, self._guess, self._failures = _SOME, None, 0

    def _void(self, observation: Observation, scene: Scene) -> bool:
        """Give up the plan if its certificate is void; return whether it was."""
        plan = self._plan
        if plan is None:
            return False
        time = observation.time
        late = plan.off_schedule(
            self._arm, time, observation.state, observation.tool_to_base, 0.5 * max(self.clearance, 0.01)
        )
        ends = time > plan.until - _HORIZON + self._period
        reason = late or plan.unforeseen(scene) or ("the guaranteed clearance of the plan ends" if ends else "")
        if reason and not late:
            again = plan.certified_again(self._arm, scene, margins_in(scene, **self._margin), self._hold, _HORIZON)
            if again is not None:
                plan, self._plan, reason = again, again, ""
        if not reason:
            self._learned = plan.learned_at(time)
            return False
        self._last, self._plan, self._reason, self._since = plan, None, reason, time
        self._next_plan = None
        return True

    def _replan(self, observation: Observation, scene: Scene) -> None:
        """Make a new plan; follow it if it is certified."""
        time = observation.time
        then = time + self._planning_time
        ahead, state = scene.now(then), self._state_at(then, observation)
        resting = float(np.abs(state.velocity).max()) < _STANDS
        plan = self._plan or self._last
        thorough = resting and self._plan is None and self._failures % _PAUSE == _PAUSE - 1
        if self._plan is not None and self._plan.end - then < _LAST:
            return
        learned = self._learned if self._plan is None else self._plan.learned_at(then)
        if plan is None or (learned == 0.0 and resting and self._plan is None):
            if not resting:
                return
            found, learned = self._adapted(state, ahead, self._attempts if thorough else 1), 0.0
        else:
            found = self._replanned(plan, learned, state, ahead, self._attempts if thorough else 1)
        if not found.feasible:
            if self._plan is None:
                self._guess = found.displacement
                self._reason = found.reason
                if thorough:
                    self._attempts = min(self._attempts + 1, _MOST)
                self._failures = self._failures + 1 if resting else 0
            return
        new = self._begun(found, then, learned, ahead)
        if self._planning_time > 0.0:
            self._next_plan = new
        else:
            self._follow(new)

    def _replanned(
        self, plan: PlanInExecution, learned: float, state: ArmState, scene: Scene, attempts: int
    ) -> Adaptation:
        """Plan the rest of the motion, sometimes along the learned path again, otherwise along the last plan."""
        options: dict[str, Any] = {**self._options, "max_attempts": attempts}
        if self._rounds is not None:
            options["max_rounds"] = self._rounds * (1 if attempts == 1 else _THOROUGH)
        base, self.plans = self._base, self.plans + 1
        if base is not None and base is not plan and plan.adaptation.moved.any() and self.plans % _BACK == 0:
            phase = base.phase_of(learned)
            if phase < base.adaptation.trajectory.times[-1]:
                found = replan(base.adaptation, scene, state=state, phase=phase, **{**options, "max_rounds": 1})
                if found.feasible and not found.moved.any():
                    return found
        last = plan.adaptation.trajectory.times[-1]
        phase = min(plan.phase_of(learned), float(last) - 1e-3)
        guess = self._guess if self.plans % _AFRESH else None
        if guess is not None and guess.shape == plan.adaptation.displacement.shape:
            options["displacement"] = guess
        return replan(plan.adaptation, scene, state=state, phase=phase, **options)

    def _state_at(self, time: float, observation: Observation) -> ArmState:
        """Return the state of the arm, predicted for a time at or after the observation."""
        now, ahead = observation.state, time - observation.time
        if ahead == 0.0:
            return now
        if self._plan is not None:
            error = now.q - self._plan.joints_at(observation.time)
            return replace(now, q=self._plan.joints_at(time) + error, velocity=self._plan.velocity_at(time))
        if self._stopping is not None:
            later = self._stopping.joints_at(time)
            return replace(now, q=later, velocity=(self._stopping.joints_at(time + 1e-3) - later) / 1e-3)
        q = np.clip(now.q + ahead * now.velocity, self._arm.lower, self._arm.upper)
        return replace(now, q=q)

    def _brake(self, observation: Observation, scene: Scene) -> None:
        """Brake to rest, if this is certified; otherwise evade."""
        stop = certified_stop(
            self._arm, observation.state, scene, clearance=self.clearance, horizon=self._hold + 0.5, **self._margin
        )
        tired = observation.time - self._since > self._patience
        if stop.certified and not tired:
            self._stopping, self._evades = _Stopping(stop, observation.time), False
            return
        self._stopping = None
        if not self._evades:
            self.evasion.resume(observation, min(self._learned / self.skill.duration_, 1.0))
            self._evades = True

    # ----- commands

    def _command(self, observation: Observation, dt: float) -> Command:
        if self._plan is not None:
            return self._along(self._plan, observation)
        if self._evades:
            return self._evasive(observation, dt)
        return self._braking(observation)

    def _along(self, plan: PlanInExecution, observation: Observation) -> Command:
        time = observation.time
        velocity = plan.velocity_at(time) + self._gain * (plan.joints_at(time) - observation.state.q)
        twist = self._arm.jacobian(observation.state.q) @ velocity
        progress = min(plan.learned_at(time) / self.skill.duration_, 1.0)
        if plan.waits_at(time):
            reason = "the plan waits until an obstacle has passed"
            return Command(twist, velocity, progress=progress, status=Status.WAITING, reason=reason)
        displaced = plan.displacement_at(time)
        if displaced:
            reason = f"the path is displaced by {1e3 * displaced:.0f} mm here because of an obstacle"
            return Command(twist, velocity, progress=progress, status=Status.AVOIDING, reason=reason)
        return Command(twist, velocity, progress=progress)

    def _evasive(self, observation: Observation, dt: float) -> Command:
        command = self.evasion.step(observation, dt)
        self._learned = max(self.evasion.phase * self.skill.duration_, 1e-6)
        reason = f"no certified plan ({self._reason}), so the arm evades; {command.reason or 'on its path'}"
        status = Status.AVOIDING if command.status is Status.NOMINAL else command.status
        return replace(command, status=status, reason=reason)

    def _braking(self, observation: Observation) -> Command:
        time, n = observation.time, self._arm.n_joints
        velocity = np.zeros(n)
        if self._stopping is not None:
            ahead = self._stopping.joints_at(time)
            velocity = (self._stopping.joints_at(time + 1e-3) - ahead) / 1e-3 + self._gain * (
                ahead - observation.state.q
            )
        twist = self._arm.jacobian(observation.state.q) @ velocity
        stands = float(np.abs(observation.state.velocity).max()) < _STANDS
        reason = f"no certified plan since the time {self._since:.1f} s: {self._reason}"
        status = Status.WAITING if stands else Status.BRAKING
        progress = min(self._learned / self.skill.duration_, 1.0)
        return Command(twist, velocity, progress=progress, status=status, reason=reason)

    def finished(self, observation: Observation) -> bool:
        """Return whether the plan has ended, and the tool is nearer than ``arrival`` to the goal."""
        if not self._started:
            return False
        goal = self.skill.goal_ if observation.scene.goal is None else observation.scene.goal
        if np.linalg.norm(observation.tool_to_base.position - goal.position) >= self._arrival:
            return False
        if self._plan is not None:
            return observation.time >= self._plan.end
        return self._evades and self.evasion.finished(observation)


def replace_obstacles(scene: Scene, obstacles: Any) -> Scene:
    """Return the scene with ``obstacles`` instead of its own obstacles."""
    return Scene(scene.goal, obstacles, scene.stamp, scene.fixtures)
