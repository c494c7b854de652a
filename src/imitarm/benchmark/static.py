"""The benchmark of avoidance in static scenes: an experiment tests one method in one scene.

``StaticExperiment("S1", 3, 2000, "acfra").run()`` makes a scene of family S1, plans a path with the method ``acfra``,
and measures the path.
"""

from __future__ import annotations

import contextlib
import math
import time as clock
import tracemalloc
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.controls import CONTROLS
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.result_lines import ResultFormat
from imitarm.benchmark.static_measures import MAX_ACCELERATION, MAX_SPEED, OUTCOMES, measure, outcome
from imitarm.benchmark.static_scenes import FAMILIES, StaticCase, static_case
from imitarm.errors import ImitarmError, InfeasibleError, InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.arm_path import track
from imitarm.kinematics.pose import Pose
from imitarm.policies import POLICIES, PathPlan, PathPolicy
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Options = tuple[tuple[str, float | str], ...]

VARIANTS: Mapping[str, tuple[str, Options]] = {
    "acfra-literal": ("acfra", (("method", "literal"),)),
    "acfra-mapf": ("acfra", (("method", "mapf"),)),
}
"""Variants of ACFRA with fixed options. ``literal`` uses the potential as the thesis prints it (Eq 4.7), and ``mapf``
uses a corrected potential."""
_WHOLE_ARM = ("rrt-connect", "rrt-connect-tilt")  # these plan joints only, so they need an arm
_TOOL_ON_ARM = np.array([0.65, 0.0, 0.30])  # [m] where the middle of a path is put in front of the Sawyer
_POSTURES = 100  # along the path, for torques
_REACHED = 1e-3  # [m] a posture whose tool is farther away does not reach the path


def method_names() -> tuple[str, ...]:
    """Return the names of all methods.

    These are the methods that check the benchmark, the policies that plan a whole path, and variants of these policies.
    """
    planners = [n for n in POLICIES if n not in _WHOLE_ARM and issubclass(POLICIES[n], PathPolicy)]
    return (*CONTROLS, *planners, *VARIANTS)


def policy_class(method: str) -> type[PathPolicy]:
    """Return the class of a method.

    Raises:
        UnknownNameError: when there is no such method, or the method does not plan a whole path.
    """
    name = VARIANTS[method][0] if method in VARIANTS else method
    if name in CONTROLS:
        return CONTROLS[name]
    found = POLICIES[name] if name in POLICIES else None  # noqa: SIM401 (a registry's get raises an error)
    if found is None or not issubclass(found, PathPolicy):
        raise UnknownNameError.among("method", method, method_names())
    return found


def build(method: str, case: StaticCase, options: Options = ()) -> PathPolicy:
    """Return the policy of a method for a scene. ``options`` replace the defaults of the method.

    Raises:
        InputError: when the method does not take an option.
    """
    fixed = VARIANTS[method][1] if method in VARIANTS else ()
    known = {
        "tool_spheres": case.tool_spheres,
        "clearance": case.clearance,
        "forbidden": case.forbidden,
        "pinned": case.pinned,
    }
    return policy_class(method).build(case.skill, **known, **dict(fixed), **dict(options))


@dataclass(frozen=True)
class StaticExperiment:
    """The definition of one run: one method in one scene.

    Another process or machine can run it, because it contains only text and numbers.

    Attributes:
        family: one of :data:`~imitarm.benchmark.static_scenes.FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: seed of the scene.
        method: one of :func:`method_names`.
        teachers: number of teachers from whom the skill was learned.
        options: options that replace the defaults of the method, such as those found by tuning.
        torque: whether to compute the joint torques of a Sawyer too. This computation takes most of the time of a run.
        memory: whether to measure the peak memory. For this purpose, the method plans a second time, which takes
            several times as long and is not timed.
        skill: file of the skill on whose path the obstacles stand; if empty, the skill of the family is used.

    Raises:
        UnknownNameError: when family or method is not known.
        InputError: when a number is out of range.
    """

    family: str
    dimension: int
    seed: int
    method: str = "acfra"
    teachers: int = 1
    options: Options = ()
    torque: bool = False
    memory: bool = False
    skill: str = ""

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise UnknownNameError.among("family", self.family, FAMILIES)
        if self.dimension not in (2, 3):
            raise InputError(f"StaticExperiment: dimension must be 2 or 3, got {self.dimension}")
        if self.seed < 0 or self.teachers < 1:
            raise InputError(
                "StaticExperiment: seed must be at least 0 and teachers at least 1, got "
                f"{self.seed} and {self.teachers}"
            )
        policy_class(self.method)
        object.__setattr__(self, "options", tuple(sorted((str(k), v) for k, v in self.options)))

    @property
    def scene(self) -> tuple[str, int, int, int, str]:
        """The key of the scene; experiments of different methods in the same scene have the same key."""
        return self.family, self.dimension, self.seed, self.teachers, self.skill

    def case(self) -> StaticCase:
        """Return the scene.

        Raises:
            InputError: when the file of the skill can't be read, or its path is too short for the obstacles.
        """
        skill = saved_skill(self.skill) if self.skill else None
        return static_case(self.family, self.dimension, self.seed, teachers=self.teachers, skill=skill)

    def run(self) -> StaticResult:
        """Plan a path with the method in its scene, and measure the path.

        Where the tool would exceed its limit of speed or acceleration, the motion is slowed down first.

        Returns:
            The result. If the method raises an error, the outcome is "failed", and the reason contains the error.
        """
        values: dict[str, Any] = {}
        try:
            case = self.case()
            values = {"n_obstacles": len(case.scene.obstacles), "must_refuse": case.must_refuse}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of numerical methods in hard scenes: the path is measured anyway
                found, reason = self._measured(case, values)
        except InfeasibleError as refusal:
            found, reason = "refused", str(refusal)
        except (ImitarmError, ArithmeticError, ValueError, TypeError, LookupError, np.linalg.LinAlgError) as error:
            found, reason = "failed", f"{type(error).__name__}: {error}"
        return StaticResult(self, code_version(), found, reason, values)

    def _measured(self, case: StaticCase, values: dict[str, Any]) -> tuple[str, str]:
        """Plan, and add the measured values to ``values``; return the outcome and its explanation."""
        _warm_up(self.method, case)
        began = clock.perf_counter()
        policy = build(self.method, case, self.options)
        values["build_seconds"] = clock.perf_counter() - began
        began, cpu = clock.perf_counter(), clock.process_time()
        try:
            plan = policy.plan_motion(case.scene)
        finally:
            values["plan_seconds"] = clock.perf_counter() - began
            values["plan_cpu"] = clock.process_time() - cpu
            answer = getattr(policy, "answer", None)
            if answer is not None:
                values["answer"] = answer.value
        plan = plan.within(MAX_SPEED, MAX_ACCELERATION)  # the same for every method
        measures = measure(case, plan.trajectory)
        values.update(asdict(measures))
        if plan.adaptation is not None:
            values["unmoved"] = plan.adaptation.unmoved_fraction
        if self.torque:
            values.update(torques_on_sawyer(plan.trajectory))
        if self.memory:
            values["peak_memory"] = self._peak_memory(case)
        return outcome(case, measures)

    def planned(self) -> tuple[StaticCase, PathPlan | None]:
        """Return the scene and the plan, for drawing; None if the method refuses or fails."""
        case = self.case()
        try:
            return case, build(self.method, case, self.options).plan_motion(case.scene)
        except (ImitarmError, ArithmeticError, ValueError, TypeError, LookupError, np.linalg.LinAlgError):
            return case, None

    def _peak_memory(self, case: StaticCase) -> int:
        """Return the peak of the memory that Python allocates while the method is built and plans [bytes]."""
        tracemalloc.start()
        try:
            build(self.method, case, self.options).plan_motion(case.scene)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


@dataclass(frozen=True, eq=False)
class StaticResult:
    """The result of an experiment, as plain values.

    Attributes:
        experiment: the experiment that was run.
        code: version of the code that ran, see :func:`~imitarm.benchmark.provenance.code_version`.
        outcome: one of :data:`~imitarm.benchmark.static_measures.OUTCOMES`.
        reason: explanation of the outcome; empty after a success.
        values: measures by name. They include the attributes of
            :class:`~imitarm.benchmark.static_measures.PathMeasures`, ``n_obstacles``, and ``must_refuse`` of the scene.
            ``build_seconds`` is the time of the construction, ``plan_seconds`` the time of planning, and ``plan_cpu``
            the processor time of planning [s]. ``unmoved`` is the fraction of the skill's components that the method
            did not move. ``answer`` is the answer of the oracle. ``torque_rms`` [N m] and ``torque_peak`` (relative to
            the rated torque) are joint torques. ``peak_memory`` is in bytes.
    """

    experiment: StaticExperiment
    code: str
    outcome: str
    reason: str
    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.outcome not in OUTCOMES:
            raise UnknownNameError.among("outcome", self.outcome, OUTCOMES)

    def value(self, name: str) -> float:
        """Return the measure with this name; nan when it is unknown."""
        found = self.values.get(name)
        return math.nan if found is None else float(found)


@lru_cache(maxsize=32)
def saved_skill(path: str) -> Skill:
    """Return the skill in a file. Each process reads the file only once."""
    return Skill.load(path)


_warm: set[tuple[str, int]] = set()  # method, and identity of the skill


def _warm_up(method: str, case: StaticCase) -> None:
    """Plan once without timing, in each process and for each skill, so that imports and caches are not timed later."""
    key = (method, id(case.skill))  # skills are kept, see learned_skill and saved_skill
    if key in _warm or method in CONTROLS:
        return
    _warm.add(key)
    with contextlib.suppress(ImitarmError, ArithmeticError, ValueError, TypeError, LookupError):
        build(method, case).plan_motion(case.scene)


def run_experiment(experiment: StaticExperiment) -> StaticResult:
    """Run an experiment; a function for worker processes."""
    return experiment.run()


def torques_on_sawyer(trajectory: Trajectory) -> dict[str, float]:
    """Compute the joint torques of a Sawyer whose tool follows a path, by inverse kinematics and inverse dynamics.

    The path is rotated by 90 degrees about the vertical axis, so that its x axis runs sideways in front of the arm. The
    middle of the path is 0.65 m in front of the base. The tool points down.

    Returns:
        Two values, which are nan if the arm can't reach the path. ``torque_rms`` is the root mean square over time of
        the norm of the joint torques [N m]. ``torque_peak`` is the largest ratio of a joint's torque to its rated
        torque.
    """
    arm = _sawyer()
    even = trajectory.resample(_POSTURES)
    x, y, z = even.positions.T
    turned = np.stack([-y, x, z], axis=1)
    turned += _TOOL_ON_ARM - 0.5 * (turned.min(axis=0) + turned.max(axis=0))
    down = np.array([0.0, 1.0, 0.0, 0.0])
    try:
        start = find_posture(arm, Pose(turned[0], down))
    except ImitarmError:
        return {"torque_rms": math.nan, "torque_peak": math.nan}
    joints = track(arm, start, turned, np.broadcast_to(down, (_POSTURES, 4)))
    if np.linalg.norm(arm.tool_path(joints)[0] - turned, axis=1).max() > _REACHED:
        return {"torque_rms": math.nan, "torque_peak": math.nan}
    dt = even.duration / (_POSTURES - 1)
    velocity = np.gradient(joints, dt, axis=0)
    acceleration = np.gradient(velocity, dt, axis=0)
    torques = np.array([arm.inverse_dynamics(q, v, a) for q, v, a in zip(joints, velocity, acceleration, strict=True)])
    return {
        "torque_rms": float(np.sqrt(np.mean(np.sum(torques**2, axis=1)))),
        "torque_peak": float((np.abs(torques) / arm.max_torque).max()),
    }


@lru_cache(maxsize=1)
def _sawyer() -> ArmModel:
    return ArmModel.load("sawyer", tool="gripper")


RESULTS = ResultFormat("imitarm-static-result 1", StaticExperiment, StaticResult, "imitarm benchmark static")
"""How results are written and read."""
