"""Reach into an open box among obstacles, with a skill learned from one teacher and from several teachers.

The teachers are synthetic. Each teacher has habits, which are errors that he repeats in all of his demonstrations. A
skill that is learned from one teacher contains his habits. In a skill of several teachers, most habits average out. The
box and the obstacles are solid bodies in the simulator. The policy plans the motion of the whole arm.
"""

from __future__ import annotations

import numpy as np

from imitarm import ACFRA, Box, InfeasibleError, Pose, SafetyFilter, Scene, Skill, align, reproduce
from imitarm.tasks import OpenBoxTask
from imitarm.tasks.habits import demonstrations_by


def main() -> None:
    motion = OpenBoxTask.motion()
    ideal = motion.curve(np.linspace(0.0, 1.0, 2000))
    for teachers in (1, 3, 10):
        skill = Skill(n_components=8).fit(align(demonstrations_by(motion, teachers)))
        path = skill.nominal(np.linspace(0.0, skill.duration_, 400)).positions
        away = np.linalg.norm(path[:, None] - ideal, axis=2).min(axis=1)
        print(f"{teachers} teachers: the learned path is {1e3 * away.mean():.0f} mm from the ideal path on average")

    arm = OpenBoxTask.arm()  # a Panda with a gripper
    for n_obstacles in (1, 2, 3):
        task = OpenBoxTask(seed=4, n_obstacles=n_obstacles)
        robot, scene = task.robot(arm=arm), task.scene()
        policy = ACFRA(skill, arm=arm, clearance=task.clearance)
        safety = SafetyFilter(arm, clearance=task.clearance)
        rollout = task.evaluate(robot, reproduce(policy, robot, scene.at, safety=safety))
        away, nearest = 1e3 * rollout.details["distance_to_goal"], 1e3 * rollout.min_clearance
        print(f"{n_obstacles} obstacles: {rollout.reason}, {away:.1f} mm from the goal, clearance {nearest:.0f} mm")

    # A policy that sees no obstacles, without the safety filter, shows that the obstacles are really in the way.
    robot = task.robot(arm=arm)
    blind, unfiltered = Scene(fixtures=scene.fixtures), SafetyFilter(arm, clearance=None)
    rollout = reproduce(ACFRA(skill, arm=arm), robot, lambda _: blind, safety=unfiltered)
    print(f"without avoidance: {task.evaluate(robot, rollout).reason}")

    # A lid on the box leaves no path, and the task is refused before the arm moves.
    lid = Box(Pose([*task.goal.position[:2], 0.16], [1.0, 0.0, 0.0, 0.0]), [0.32, 0.32, 0.012], name="lid")
    closed = Scene(None, (*scene.obstacles, lid), fixtures=scene.fixtures)
    robot = task.robot(arm=arm)
    try:
        reproduce(ACFRA(skill, arm=arm), robot, closed.at)
    except InfeasibleError as refusal:
        print(f"with a lid: {refusal}")


if __name__ == "__main__":
    main()
