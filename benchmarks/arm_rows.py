"""What ``make bench`` times of planning for the whole arm, against planning for the tool alone in the same scenes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import count, islice
from typing import Any

import numpy as np

from imitarm import Adaptation, ArmModel, Pose, Scene, Skill, adapt, find_posture, replan
from imitarm.benchmark.placements import placement
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.trajectory import Demonstration, Trajectory
from timing import Row

_SCENES, _REPAIRED = 8, 6  # of each arm, with three obstacles each
_TILT = np.deg2rad(30.0)
_SHIFT = 0.01  # [m] by which obstacles have moved when planning again
_CLEARANCE = 0.02  # [m] required


@dataclass(frozen=True, eq=False)
class _Case:
    """A skill of one arm, and a scene with three obstacles on its path."""

    skill: Skill
    arm: ArmModel
    state: ArmState
    scene: Scene

    def whole_arm(self) -> Adaptation:
        return adapt(self.skill, self.scene, arm=self.arm, state=self.state, max_tilt=_TILT)

    def again(self) -> Adaptation:
        """Plan the rest again where a third of the motion is done, among obstacles that have moved by 1 cm."""
        plan, arm = self.planned, self.arm
        times, phase = plan.trajectory.times, plan.trajectory.duration / 3.0
        assert plan.joints is not None
        rates = np.gradient(plan.joints, times, axis=0)
        q, velocity = (np.array([np.interp(phase, times, x) for x in values.T]) for values in (plan.joints, rates))
        state = ArmState(q, velocity, np.zeros(arm.n_joints), 0.0)
        return replan(plan, self.shifted, arm=arm, state=state, phase=phase, max_tilt=_TILT)

    @cached_property
    def shifted(self) -> Scene:
        """The scene after each obstacle has moved by 1 cm in a random direction."""
        rng, moved = np.random.default_rng(5), []
        for obstacle in self.scene.obstacles:
            way = rng.normal(size=3)
            there = replace(obstacle, velocity=_SHIFT * way / np.linalg.norm(way)).after(1.0)
            moved.append(replace(there, velocity=np.zeros(3)))
        return Scene(None, tuple(moved))

    @cached_property
    def planned(self) -> Adaptation:
        """The plan of the whole motion."""
        return self.whole_arm()

    @property
    def is_repaired(self) -> bool:
        """Whether the plan of the whole arm moves the tool in another way than the plan for the tool alone."""
        plan, tool = self.planned, self.tool_alone()
        return plan.approach is not None or plan.tilt > 0.0 or not np.array_equal(plan.displacement, tool.displacement)

    def tool_alone(self) -> Adaptation:
        start = self.arm.tool_pose(self.state.q)
        return adapt(self.skill, self.scene, tool_spheres=self.arm.tool_spheres, start=start)


def _carrying(arm: ArmModel) -> Skill:
    """Return a skill of 6 s that carries the tool to the side and turns it, learned from motions from home."""
    home, rng = arm.tool_pose(arm.home), np.random.default_rng(0)
    u = np.linspace(0.0, 1.0, 150)
    rise, arch = u**3 * (10.0 - 15.0 * u + 6.0 * u * u), np.sin(np.pi * u) ** 2
    shown = []
    for _ in range(6):
        across = np.array([0.02, 0.45, -0.05]) + 0.01 * rng.normal(size=3)
        positions = home.position + np.outer(rise, across) + np.outer(arch, [0.0, 0.0, 0.1 + 0.01 * rng.normal()])
        turn = quaternion_exp(np.outer(rise, [0.0, 0.0, 0.6 + 0.05 * rng.normal()]))
        rotations = quaternion_multiply(turn, np.tile(home.quaternion, (len(u), 1)))
        shown.append(Demonstration(Trajectory(6.0 * u, positions, rotations), task="carry"))
    return Skill(8).fit(shown)


def _first(number: int, suits: Callable[[_Case], bool]) -> tuple[_Case, ...]:
    """Return the first suitable scenes with three obstacles of each arm."""
    cases = []
    for name in ("sawyer", "panda"):
        arm = ArmModel.load(name, tool="gripper")
        skill = _carrying(arm)
        start = find_posture(arm, Pose(skill.start_.position, skill.start_.quaternion))
        state = ArmState(start, np.zeros(arm.n_joints), np.zeros(arm.n_joints), 0.0)
        seeds = count(2, 3)  # every third seed has three obstacles
        found = (case for seed in seeds if suits(case := _Case(skill, arm, state, placement(skill, arm, seed, start))))
        cases += islice(found, number)
    return tuple(cases)


@lru_cache
def _cases() -> tuple[_Case, ...]:
    """Return scenes in which all kinds of planning find a plan."""
    return _first(_SCENES, lambda case: case.tool_alone().feasible and case.planned.feasible and case.again().feasible)


@lru_cache
def _repaired() -> tuple[_Case, ...]:
    """Return scenes in which the whole arm can't follow the plan for the tool alone, and another plan is found."""
    return _first(_REPAIRED, lambda case: case.tool_alone().feasible and case.planned.feasible and case.is_repaired)


def _median(call: Callable[[_Case], Any], cases: Callable[[], tuple[_Case, ...]]) -> Callable[[], float]:
    """Return a function that returns the median time of a call over scenes [s]."""

    def seconds(case: _Case) -> float:
        begin = time.process_time()
        call(case)
        return time.process_time() - begin

    return lambda: float(np.median([seconds(case) for case in cases()]))


def _row(
    name: str, plan: Callable[[_Case], Adaptation], cost: float, cases: Callable[[], tuple[_Case, ...]] = _cases
) -> Row:
    """A row of a plan of the whole arm, against a plan of the tool alone in the same scenes."""

    def check() -> tuple[bool, str]:
        least = min(plan(case).certified_clearance for case in cases())
        return least >= _CLEARANCE, f"certified clearance at least {1e3 * least:.2f} mm (20 mm required)"

    times = _median(plan, cases), _median(_Case.tool_alone, cases)
    return Row(name, *times, "plan of the tool alone", cost=cost, check=check, repeats=9, self_timed=True)


def whole_arm() -> Row:
    """A plan of the whole arm among three obstacles; median of 16 scenes."""
    return _row("whole-arm plan, 3 obstacles (16 scenes)", _Case.whole_arm, 3.0)


def whole_arm_repaired() -> Row:
    """A plan of the whole arm where it can't follow the plan for the tool alone; median of 12 scenes."""
    return _row("whole-arm plan with repair, 3 obstacles (12 scenes)", _Case.whole_arm, 10.0, _repaired)


def whole_arm_again() -> Row:
    """The rest of a plan of the whole arm, after obstacles have moved."""
    return _row("rest of a whole-arm plan, planned again (16 scenes)", _Case.again, 1.5)


ROWS = (whole_arm, whole_arm_repaired, whole_arm_again)
