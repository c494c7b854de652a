"""A perfect controller for the stacking task: it knows where everything is."""

from __future__ import annotations

import numpy as np

from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.tasks import TwistTask
from imitarm.tasks.stack import CLOSED, LOOKING_DOWN, OPEN, SIDE, CubeHistory

DT = 0.01


class Script:
    """Drives the robot of a StackTask from place to place, and watches."""

    def __init__(self, task, robot):
        self.task, self.robot, self.history, self.steps = task, robot, CubeHistory(), 0

    def hold(self, seconds):
        for _ in range(round(seconds / DT)):
            self._move(np.zeros(7))

    def go(self, place, speed=0.25):
        target = Pose(np.asarray(place), np.array(LOOKING_DOWN))
        for _ in range(800):
            error = self.robot.arm.tool_pose(self.robot.set_point).error_to(target)
            if np.linalg.norm(error[:3]) < 5e-4:
                break
            twist = 8.0 * error
            twist[:3] *= min(1.0, speed / np.linalg.norm(twist[:3]))
            arm, q = self.robot.arm, self.robot.set_point
            self._move(solve_ik(arm, q, TwistTask(twist), dt=DT, velocity=self.robot.velocity))
        self.hold(0.15)

    def grasp(self, opening):
        self.robot.grasp(opening)
        self.hold(0.6)

    def pick(self, i):
        x, y, z = self.task.cubes(self.robot)[i]
        self.go([x, y, 0.18])
        self.go([x, y, z + 0.004])
        self.grasp(CLOSED)
        self.go([x, y, 0.18])

    def put(self, i):
        cubes = self.task.cubes(self.robot)
        offset = self.robot.tool_to_base.position - cubes[i]
        x, y, z = cubes[i - 1] + offset
        self.go([x, y, 0.18])
        self.go([x, y, z + SIDE + 0.0005])
        self.grasp(OPEN)
        self.go([x, y, 0.19])

    def stack(self):
        for i in range(1, 4):
            self.pick(i)
            self.put(i)
        self.hold(0.3)
        return self.task.evaluate(self.robot, self.history)

    def _move(self, velocity):
        self.robot.move(velocity, DT)
        self.steps += 1
        if self.steps % 5 == 0:
            self.task.watch(self.robot, self.history)
